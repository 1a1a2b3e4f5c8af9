"""A figure of the walker and the gap, from runs that `run.py gap --certainty` kept: python -m THIS RUNS OUT"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import torch

from lyapnet.controller import Controller
from tests.noise_tasks.run import PATHS, cost_under, draw, load, measure, test_states

SHOWN = 40  # paths of the noise in each panel, all from the same state


def main(runs: Path, out: Path) -> None:
    """Draw closed loops of the laws trained with and without noise, under the same noise."""
    laws = {"trained with the noise": load(runs, []), "trained without it": load(runs / "without_noise", [])}
    task = laws["trained with the noise"]
    start = torch.tensor([[0.0, 0.0]]).to(task.problem.goal).repeat(SHOWN, 1)
    noise, x0 = draw(task, start, 0), test_states(task).to(task.problem.goal)
    figure, axes = plt.subplots(1, 2, figsize=(8, 3.4), sharey=True, layout="constrained")
    for axis, (name, law) in zip(axes, laws.items(), strict=True):
        mean = measure(task, None).mean if law is task else float(
            torch.stack([cost_under(task.problem, x0, draw(task, x0, path), law) for path in range(PATHS)]).mean()
        )  # fmt: skip
        draw_wall(axis)
        for path in paths(task, law, start, noise).unbind(1):
            axis.plot(path[:, 0], path[:, 1], color="C0", alpha=0.35, linewidth=0.8)
        axis.set(title=f"{name}: mean cost {mean:.2f}", xlabel="forward (m)", xlim=(0, 2), ylim=(-1.8, 1.2))
    axes[0].set_ylabel("aside (m)")
    figure.savefig(out, dpi=110)


def draw_wall(axis: plt.Axes) -> None:
    """The wall with its gap."""
    for low, high in ((-0.8, -0.15), (0.15, 2.0)):
        axis.fill_between([0.9, 1.1], low, high, color="0.55", linewidth=0)


@torch.no_grad()
def paths(task: Controller, law: Controller, x: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
    """The states (N + 1, b, n) of a law under the task's noise."""
    states, problem = [x], task.problem
    assert problem.noise is not None
    for n, increment in enumerate(noise):
        following = problem.step(x, law.policy(n * problem.horizon.dt, x))[0]
        x = following + problem.noise.displacement(x, increment)
        states.append(x)
    return torch.stack(states)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
