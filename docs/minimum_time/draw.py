"""The law of conf/minimum_time.yaml beside the exact switching curve: python docs/minimum_time/draw.py CKPT OUT.png.

Prints the time until d ≤ 1 (see lyapnet.TimeCost) from 2000 unseen states of X₀, relative to the least time T* to the
origin: T* = v + 2√(x + v²/2) where x + v|v|/2 ≥ 0, and mirrored where it is negative (Athans, Falb, Optimal Control,
1966, § 7.2).
"""

import sys

import matplotlib.pyplot as plt
import torch

import lyapnet
from lyapnet.task.cost import arrival_steps

checkpoint, out = sys.argv[1:]
controller = lyapnet.load(checkpoint)
problem, dt = controller.problem, controller.horizon.dt
X0 = problem.initial_states


def least_time(x: torch.Tensor) -> torch.Tensor:
    """T* from states (b, 2)."""
    position, velocity = x.unbind(-1)
    side = torch.where(position + velocity * velocity.abs() / 2 >= 0, 1.0, -1.0)
    return side * velocity + 2 * (side * position + velocity**2 / 2).clamp_min(0).sqrt()


x0 = X0.sample(2000, torch.Generator().manual_seed(2026)).to(X0.lower)
time = dt * arrival_steps(problem.cost, controller.rollout(x0).x)
least = least_time(x0)
print(f"arrived: {float((time <= controller.horizon.duration).double().mean()):.2%} of 2000 states")
print(f"time / T*: {float(time.sum() / least.sum()):.4f}; T*: {float(least.mean()):.4g} s in the mean")
far = least > 0.5
ratio = time[far] / least[far]
print(f"from states with T* > 0.5 s: median {float(ratio.median()):.4f}, largest {float(ratio.max()):.4f}")

axis = torch.linspace(-2, 2, 241)
grid = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), -1).to(X0.lower)
with torch.no_grad():
    u = controller.policy(grid.new_zeros(()), grid.flatten(0, 1)).reshape(241, 241)
figure, axes = plt.subplots(figsize=(5.4, 4.4), layout="constrained")
shown = axes.pcolormesh(axis, axis, u, cmap="RdBu_r", vmin=-1, vmax=1, rasterized=True)
figure.colorbar(shown, label="u(0, x) in m/s²")
v = torch.linspace(-2, 2, 200)
axes.plot(-v * v.abs() / 2, v, "k--", label="exact switching curve")
paths = controller.rollout(torch.tensor([[-1.7, -1.0], [1.6, 0.6], [1.2, -1.9], [-1.4, 1.8]]).to(X0.lower)).x
for k, path in enumerate(paths.unbind(1)):
    axes.plot(*path.T, color="k", linewidth=0.9, label=None if k else "closed loops")
axes.set(xlabel="position in m", ylabel="velocity in m/s", xlim=(-2.05, 2.05), ylim=(-2.05, 2.05))
axes.legend(loc="upper right")
figure.savefig(out, dpi=110)
