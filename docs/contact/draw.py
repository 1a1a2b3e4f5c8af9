"""Two families of optima between soft walls, and V: python docs/contact/draw.py CKPT families.png."""

import sys

import matplotlib
import torch

import lyapnet
from lyapnet.value.expansions import greedy_law, in_float64, optimal_trajectories, path_under, riccati

matplotlib.use("Agg")
import matplotlib.pyplot as plt

WALL, TIP, START, STATES = 0.35, 0.6, 0.2, 21
COLOURS = {"away from the wall": "tab:blue", "leaning on the wall": "tab:red"}

controller, out = lyapnet.load(sys.argv[1]), sys.argv[2]
problem = in_float64(controller.problem)
positions = torch.linspace(0.1, 0.3, STATES, dtype=torch.float64)
x0 = torch.stack([positions, 0 * positions, 0 * positions + 0.3, 0 * positions], -1)
middle = int((positions - START).abs().argmin())


law = path_under(problem, greedy_law(problem, riccati(problem)), x0)
found = [optimal_trajectories(problem, x0, law.u, softer_first=softer).path for softer in (False, True)]


def family(leaning):
    """The cheapest optimum of a family from each state, NaN where none was found, and the tip from START."""
    tips = torch.stack([path.x[..., 0] - TIP * path.x[..., 1] for path in found])
    meets = tips.amax(1) > WALL
    cost = torch.stack([path.cost for path in found]).where(meets == leaning, torch.inf)
    best, which = cost.min(0)
    return best.where(best.isfinite(), torch.nan), tips[which[middle], :, middle]


figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
times = controller.horizon.dt * torch.arange(controller.horizon.steps + 1)
for name, leaning in zip(COLOURS, (False, True), strict=True):
    cost, tip = family(leaning)
    left.plot(positions, cost, color=COLOURS[name], label=f"optima {name}")
    right.plot(times, tip, color=COLOURS[name], label=name)
left.plot(positions, controller.value(0.0, x0), "k--", label="V(0, x)")
left.plot(positions, controller.rollout(x0).cost, "k.", label="cost of the law")
box = controller.initial_states
left.axvspan(float(box.lower[0]), float(box.upper[0]), color="grey", alpha=0.1, label="X₀")
left.locator_params(axis="x", nbins=5)
left.set(xlabel="position at the start (m)", ylabel="cost", title="two optima from each start, moving at 0.3 m/s")
right.axhline(WALL, color="grey", linewidth=4, alpha=0.5)
right.set(xlabel="time (s)", ylabel="tip of the pole (m)", title=f"optima from {START} m")
for axes in (left, right):
    axes.legend(frameon=False, fontsize=8)
figure.savefig(out, dpi=110)
