"""A loop with an estimator beside a tuned PID, on two tanks: a setpoint that rises, then a load of a fifth of the pump.

python docs/outputs/beside_pid.py CKPT FIGURE, beside tanks.py of the page on outputs; CKPT is of `family:
{target_lower_level: [0.25, 0.55]}`. PI and PID have those numbers of a grid with which they settle soonest.
"""

import itertools
import sys
from collections.abc import Callable

import numpy as np
import torch
from matplotlib.figure import Figure
from tanks import Tanks

import lyapnet

STEPS, DT, MOST, LOAD, BAND = 600, 2.0, 0.3, -0.06, 2e-3  # pump and load in L/s, band in m
RISES, LOADED = 50, 300  # steps
LEVELS = np.where(np.arange(STEPS) < RISES, 0.3, 0.45)
GRID = (0.5, 0.8, 1.2, 2, 3, 5, 8), (60, 90, 130, 180, 250), (0, 0.3, 0.6, 1)  # gain, integral time, setpoint weight
DERIVATIVE, FILTER = (0, 15, 30, 60), 4.0  # s
plant = Tanks()


def simulate(control: Callable[[float, float], float]) -> tuple[np.ndarray, np.ndarray]:
    """Lower levels and pump of 1200 s from rest at 0.3 m, under (level, setpoint) ↦ pump."""
    x, levels, pump = torch.full((2,), 0.3, dtype=torch.float64), [], []
    for k in range(STEPS):
        levels.append(float(x[1]))
        pump.append(control(levels[-1], LEVELS[k]))
        for _ in range(4):
            x = x + DT / 4 * plant.dynamics(x, x.new_tensor([pump[-1] + (LOAD if k >= LOADED else 0)]))
    return np.array(levels), np.array(pump)


def pid(gain: float, integral_time: float, share: float, derivative_time: float) -> Callable[[float, float], float]:
    """u = K(br − y − T_d ẏ) + (K/T)∫(r − y) between its limits; the integral stops where it would wind up."""
    at_rest = plant.outlet * np.sqrt(2 * 9.81 * 0.3) / 1e-3
    integral, seen, slope = at_rest - gain * (share - 1) * 0.3, 0.3, 0.0

    def control(y: float, r: float) -> float:
        nonlocal integral, seen, slope
        slope += DT / (DT + FILTER) * ((y - seen) / DT - slope)
        seen = y
        u = gain * (share * r - y - derivative_time * slope) + integral
        held = min(max(u, 0.0), MOST)
        if u == held or (u - held) * (r - y) < 0:
            integral += gain / integral_time * DT * (r - y)
        return held

    return control


def settling(levels: np.ndarray) -> tuple[float, float]:
    """Seconds until the level stays within the band, after the setpoint rises and after the load; infinite if never."""
    found = []
    for part in (levels[RISES:LOADED], levels[LOADED:]):
        outside = np.flatnonzero(abs(part - 0.45) > BAND)
        last = outside[-1] + 1 if len(outside) else 0
        found.append(DT * last if last < len(part) else np.inf)
    return found[0], found[1]


loop = lyapnet.load(sys.argv[1], system=plant).with_estimator(noise=1e-4, input_disturbances={"pump": 0.002})
runs = {"with estimator": simulate(lambda y, r: float(loop.step([y], target_lower_level=r)[0]))}
for name, times in (("PI", DERIVATIVE[:1]), ("PID", DERIVATIVE)):
    tried = {each: simulate(pid(*each)) for each in itertools.product(*GRID, times)}
    best = min(tried, key=lambda each: sum(settling(tried[each][0])))
    runs[name] = tried[best]
    print(name, "with gain {:g} L/s per m, T = {:g} s, b = {:g}, T_d = {:g} s".format(*best))
figure = Figure(figsize=(7, 3.6), layout="constrained")
panels = figure.subplots(2, 1, sharex=True)
t = DT * np.arange(STEPS)
panels[0].plot(t, LEVELS, ":", color="grey", label="setpoint")
for (name, (levels, pump)), color in zip(runs.items(), ("tab:blue", "tab:orange", "tab:green"), strict=True):
    rise, load = settling(levels)
    deep = 1e3 * (0.45 - levels[LOADED:].min())
    print(f"{name}: settles in {rise:g} s, after the load in {load:g} s, which takes {deep:.1f} mm")
    for panel, curve in zip(panels, (levels, pump), strict=True):
        panel.plot(t, curve, color=color, label=name)
panels[0].set_ylabel("lower level (m)")
panels[1].set(ylabel="pump (L/s)", xlabel="time (s)")
panels[0].legend(frameon=False, fontsize=8)
figure.savefig(sys.argv[2], dpi=110)
