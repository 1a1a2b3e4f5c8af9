"""Plants whose parameters are known, and noisy data of them: a pendulum, a cart-pole and two tanks."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch

from lyapnet import ControlAffineSystem
from lyapnet.experiment.config import Config, config_from_plain
from lyapnet.lab.identification import Measurements
from lyapnet.task.systems import SYSTEMS, ControlSystem


class Tanks(ControlAffineSystem):
    """Two tanks in a row: a pump fills the upper one, which flows out into the lower one; as on the page on outputs."""

    state_names, state_units = ("upper level", "lower level"), ("m", "m")
    control_names, control_units = ("pump",), ("L/s",)

    def __init__(self, area: float = 0.0154, outlet: float = 5e-5):
        super().__init__()
        self.area, self.outlet = area, outlet

    def f(self, x):
        flow = self.outlet * torch.sqrt(2 * 9.81 * x)  # Torricelli, in m³/s
        return torch.stack([-flow[..., 0], flow[..., 0] - flow[..., 1]], -1) / self.area

    def g(self, x):
        return x.new_tensor([[1e-3], [0.0]]).expand(*x.shape[:-1], 2, 1) / self.area


class Plant(NamedTuple):
    """A plant and how it is measured."""

    name: str  # of its system
    true: dict[str, float]
    config: dict[str, float]  # what a config has instead
    x0: Sequence[float]
    u: Callable[[np.random.Generator, np.ndarray], np.ndarray]
    measured: Sequence[str]
    sigma: Sequence[float]
    box: Sequence[Sequence[float]]
    dt: float
    seconds: float = 60.0

    @property
    def cls(self) -> type[ControlSystem]:
        return SYSTEMS.get(self.name, Tanks)

    def settings(self, **others) -> Config:
        """A config of it with parameters that are not right."""
        name = self.name if self.name in SYSTEMS else f"{__name__}:Tanks"
        plain = {
            "experiment": "x",
            "system": {"name": name, "parameters": self.config},
            "initial_states": {"lower": self.box[0], "upper": self.box[1]},
            "horizon": {"steps": 100, "dt": 0.02},
        }
        return config_from_plain({**plain, **others})


def levels(size: float, middle: float, hold: float):
    """Controls at random levels, each held for some seconds."""

    def draw(generator, t):
        drawn = middle + size * generator.uniform(-1, 1, int(t[-1] / hold) + 2)
        return drawn[(t / hold + 1e-9).astype(int), None]

    return draw


PLANTS = {
    "pendulum": Plant(
        "pendulum", {"mass": 1.0, "length": 0.5, "damping": 0.1}, {"mass": 1.3, "length": 0.6, "damping": 0.05},
        [np.pi, 0.0], levels(1.5, 0.0, 0.4), ["angle"], [0.01], [[2.6, -0.5], [3.7, 0.5]], 0.02,
    ),
    "cartpole": Plant(
        "cartpole",
        {"cart_mass": 1.0, "pole_mass": 0.3, "length": 0.5, "cart_damping": 0.5, "pole_damping": 0.02},
        {"cart_mass": 1.3, "pole_mass": 0.2, "length": 0.6, "cart_damping": 0.3, "pole_damping": 0.01},
        [0.0, np.pi, 0.0, 0.0], levels(4.0, 0.0, 0.5), ["cart position", "pole angle"], [0.005, 0.01],
        [[-1, 2.6, -0.5, -0.5], [1, 3.7, 0.5, 0.5]], 0.02,
    ),
    "tanks": Plant(
        "tanks", {"area": 0.0154, "outlet": 5e-5}, {"area": 0.02, "outlet": 7e-5}, [0.3, 0.2],
        levels(0.12, 0.15, 5.0), ["upper level", "lower level"], [0.004, 0.004], [[0.1, 0.1], [0.7, 0.7]], 0.1,
    ),
}  # fmt: skip


def simulate(system: ControlSystem, x0: Sequence[float], t: np.ndarray, u: np.ndarray) -> np.ndarray:
    """States (N, *batch, n) at times (N,), with controls (N, *batch, m) held between them.

    By the usual Runge–Kutta method with four steps in each interval.
    """
    x, path = torch.tensor(x0, dtype=torch.float64).expand(*u.shape[1:-1], -1), []
    controls = torch.from_numpy(u)
    with torch.no_grad():
        for k in range(len(t)):
            path.append(x)
            h = (t[min(k + 1, len(t) - 1)] - t[k]) / 4
            for _ in range(4):
                a = system.dynamics(x, controls[k])
                b = system.dynamics(x + h / 2 * a, controls[k])
                c = system.dynamics(x + h / 2 * b, controls[k])
                d = system.dynamics(x + h * c, controls[k])
                x = x + h / 6 * (a + 2 * b + 2 * c + d)
    return torch.stack(path).numpy()


def record(
    plant: Plant,
    seeds: Sequence[int] = (0,),
    size: float = 1.0,
    system: ControlSystem | None = None,
    seconds: float | None = None,
    measured: Sequence[str] | None = None,
    colour: float = 0.0,
) -> list[Measurements]:
    """Noisy measurements of a plant, a recording for each seed.

    Args:
        size: of the noise, relative to what the plant says.
        system: another one that makes the data.
        seconds: how long; None: as the plant says.
        measured: the states; None: as the plant says.
        colour: correlation of the noise from sample to sample.
    """
    generators = [np.random.default_rng(seed) for seed in seeds]
    t = np.arange(0.0, seconds or plant.seconds, plant.dt)
    u = np.stack([plant.u(generator, t) for generator in generators], 1)
    system = plant.cls(**plant.true).double() if system is None else system
    names = list(plant.measured if measured is None else measured)
    sigma = dict(zip(plant.measured, plant.sigma, strict=True))
    y = simulate(system, plant.x0, t, u)[..., [list(system.state_names).index(name) for name in names]]
    deviation = size * np.array([sigma.get(name, 0.01) for name in names])
    recordings = []
    for k, generator in enumerate(generators):
        noise = generator.standard_normal(y[:, k].shape)
        for i in range(1, len(noise)):
            noise[i] = colour * noise[i - 1] + np.sqrt(1 - colour**2) * noise[i]
        read = y[:, k] + deviation * noise
        recordings.append(Measurements("data.csv", t, u[:, k], read, tuple(names)))
    return recordings
