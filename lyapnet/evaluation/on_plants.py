"""Measures of a controller on plants with random parameters that it does not know."""

from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.base.errors import OracleError
from lyapnet.base.random_streams import PLANTS, TEST, stream
from lyapnet.base.types import PerState, State
from lyapnet.evaluation.optimality import mean_optimum, ratio_of_means
from lyapnet.evaluation.oracles import Report, oracle_of, silent
from lyapnet.loop.random_plants import RandomPlants, StateOfPlant
from lyapnet.value.expansions import in_float64, path_under


class OnPlants(NamedTuple):
    """The closed loops from some states, each on another plant."""

    plants: RandomPlants
    z0: StateOfPlant  # (x₀, p) of each closed loop
    cost: PerState  # J; infinite where a closed loop is not finite
    optimal_cost: PerState | None  # J* of the same plant from the same state, NaN if none was found; None: no oracle

    @property
    def ratio(self) -> Tensor:
        """J / J* of each closed loop; NaN where J* is unknown."""
        return self.cost / (torch.full_like(self.cost, torch.nan) if self.optimal_cost is None else self.optimal_cost)

    def summary(self) -> dict[str, float | None]:
        """Mean J, mean J*, the ratio of these means, the largest J / J*, and the share of finite closed loops."""
        optimal = torch.full_like(self.cost, torch.nan) if self.optimal_cost is None else self.optimal_cost
        known = self.ratio[self.ratio.isfinite() | self.cost.isinf()]
        return {
            "cost_mean": float(self.cost.mean()),
            "optimal_cost_mean": mean_optimum(optimal),
            "cost_ratio": ratio_of_means(self.cost, optimal),
            "largest_ratio": float(known.max()) if self.optimal_cost is not None and len(known) else None,
            "finite_fraction": float(self.cost.isfinite().double().mean()),
        }


@torch.no_grad()
def measure_on_plants(
    plants: RandomPlants, x0: State, seed: int = 0, optimum: bool = True, progress: Report = silent
) -> OnPlants:
    """The closed loops from a batch of states on random plants, with controls held for Δt.

    Args:
        seed: seed of the parameters.
        optimum: whether to compute the optimum of each plant, if there is an oracle.
    """
    z0, goal = plants.draw(x0, stream(seed, PLANTS, TEST)), plants.problem.goal
    policy, times = plants.rollout.closed_loop.policy, plants.problem.horizon.times(goal)
    path = path_under(in_float64(plants.problem), lambda n, z: policy(times[n], z.to(goal)).to(z), z0.double().cpu())
    found = None
    if optimum:
        try:
            found = oracle_of(plants.problem, plants.rollout.method).solve(z0, path.u.to(z0), progress).cost
        except OracleError:
            found = None
    return OnPlants(plants, z0, path.cost.to(z0), found)
