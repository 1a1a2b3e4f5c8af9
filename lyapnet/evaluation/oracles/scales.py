"""Scaling of a transcribed task to numbers of about 1, from the extents and costs of trial paths."""

import math

import numpy as np
import torch

from lyapnet.base.types import State
from lyapnet.task.problem import Problem
from lyapnet.value.expansions import Path, at_rest, cheapest, greedy_law, path_under, riccati, sizes

TEST_STATES = 16  # number of random states of X₀ for trial paths


class Scales:
    """The extents of trial paths from X₀: the cheapest of the control at rest, the Riccati law, and the middle of U.

    Attributes:
        of_states, of_controls: (n,), (m,); for a component that does not change, its size, or 1.

    Args:
        problem: in float64 on the CPU; U a box.
    """

    def __init__(self, problem: Problem):
        self.problem = problem
        self._riccati = riccati(problem) if problem.has_goal else None
        if self._riccati is not None and not all(part.isfinite().all() for part in self._riccati):
            self._riccati = None
        x0 = torch.cat(
            [
                problem.initial_states.sample(TEST_STATES, torch.Generator().manual_seed(0)),
                problem.initial_states.ends(TEST_STATES),
            ]
        )
        paths = self.paths(x0)
        some = paths.cost.isfinite()
        x = paths.x[:, some] if bool(some.any()) else x0[None]
        box = torch.stack([problem.initial_states.lower, problem.initial_states.upper])
        self.of_states = _extents(torch.cat([x.flatten(0, 1), box]))
        self.of_controls = self._of_controls(paths.u[:, some])
        size = sizes(problem, paths.cost[some])
        self._of_cost = (float(size.median()) if len(size) else 0.0) or 1.0

    def paths(self, x0: State) -> Path:
        """The cheapest trial path from each state (b, n)."""
        low, high = (side.expand(self.problem.system.m) for side in self._limits)
        middle = ((low + high) / 2).where(low.isfinite() & high.isfinite(), 0.0)
        laws = [at_rest(self.problem), lambda _, x: middle.expand(*x.shape[:-1], -1)]
        if self._riccati is not None:
            laws.append(greedy_law(self.problem, self._riccati))
        return cheapest([path_under(self.problem, law, x0) for law in laws])

    def of_cost(self, x0: np.ndarray) -> float:
        """An estimate of the size of J*(x₀); scaling is needed because IPOPT's barrier parameter is absolute."""
        if self._riccati is not None:
            cost = float(self._riccati.initially(torch.from_numpy(x0)))
            if 0 < cost < math.inf:
                return min(cost, self._of_cost)
        return self._of_cost

    @property
    def _limits(self) -> tuple[torch.Tensor, torch.Tensor]:
        limits = self.problem.controls.limits
        assert limits is not None
        return limits[0].double(), limits[1].double()  # Unbounded has limits of torch's default dtype

    def _of_controls(self, u: torch.Tensor) -> np.ndarray:
        """Half the width of U, or the extent of the trial controls where U is unbounded."""
        low, high = (side.expand(self.problem.system.m) for side in self._limits)
        width = (high - low) / 2
        tried = torch.from_numpy(_extents(u.flatten(0, 1))) if u.numel() else torch.ones_like(width)
        return width.where(width.isfinite(), tried).numpy()


def _extents(values: torch.Tensor) -> np.ndarray:
    """The range of each column, or its size if it is constant, or 1 if it is 0."""
    extent, size = values.amax(0) - values.amin(0), values.abs().amax(0)
    return extent.where(extent > 1e-9 * size, size.where(size > 0, 1.0)).numpy()
