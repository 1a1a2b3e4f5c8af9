"""Two families of optima between soft walls, and V: python docs/contact/draw.py CKPT families.png."""

import sys

import matplotlib
import torch

import lyapnet
from lyapnet.value.expansions import follow_expansions, greedy_law, in_float64, optimal_trajectories, path_under, riccati

matplotlib.use("Agg")
import matplotlib.pyplot as plt

WALL, TIP, START, STATES = 0.35, 0.6, 0.2, 31
COLOURS = {"away from the wall": "tab:blue", "leaning on the wall": "tab:red"}

controller, out = lyapnet.load(sys.argv[1]), sys.argv[2]
problem = in_float64(controller.problem)
positions = torch.linspace(0.15, 0.3, STATES, dtype=torch.float64)
x0 = torch.stack([positions, 0 * positions, 0 * positions + 0.3, 0 * positions], -1)
middle = int((positions - START).abs().argmin())


def family(softer_first):
    """The optima of a family: sought from the middle, then handed from neighbour to neighbour."""
    law = path_under(problem, greedy_law(problem, riccati(problem)), x0[[middle]])
    found = {middle: optimal_trajectories(problem, x0[[middle]], law.u, softer_first=softer_first)}
    for k in (*range(middle + 1, STATES), *range(middle - 1, -1, -1)):
        near = found[k - 1 if k > middle else k + 1]
        path = follow_expansions(problem, near.expansion, x0[[k]])
        found[k] = optimal_trajectories(problem, x0[[k]], path.u, softer_first=False)
    cost = [float(found[k].path.cost) for k in range(STATES)]
    return cost, found[middle].path.x[:, 0]


figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
times = controller.horizon.dt * torch.arange(controller.horizon.steps + 1)
for name, softer_first in zip(COLOURS, (False, True), strict=True):
    cost, x = family(softer_first)
    left.plot(positions, cost, color=COLOURS[name], label=f"optima {name}")
    right.plot(times, x[:, 0] - TIP * x[:, 1], color=COLOURS[name], label=name)
left.plot(positions, controller.value(0.0, x0), "k--", label="V(0, x)")
left.plot(positions, controller.rollout(x0).cost, "k.", label="cost of the law")
left.set(xlabel="position at the start (m)", ylabel="cost", title="V has a kink where the families cross")
left.set_ylim(0, 1.2 * float(torch.tensor(cost).max()))
right.axhline(WALL, color="grey", linewidth=4, alpha=0.5)
right.set(xlabel="time (s)", ylabel="tip of the pole (m)", title=f"optima from {START} m, moving at 0.3 m/s")
for axes in (left, right):
    axes.legend(frameon=False, fontsize=8)
figure.savefig(out, dpi=110)
