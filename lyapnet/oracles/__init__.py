"""Ground truth: optima known by another route than learning. Never used in training."""

from collections.abc import Callable
from functools import partial

from lyapnet.cost import QuadraticCost
from lyapnet.oracles.riccati import RiccatiSolution, continuous_riccati, discrete_riccati
from lyapnet.rollout import Horizon
from lyapnet.systems import ControlAffineSystem, Linear
from lyapnet.types import PerState, State

__all__ = ["RiccatiSolution", "continuous_riccati", "discrete_riccati", "optimal_cost"]


def optimal_cost(
    system: ControlAffineSystem, cost: QuadraticCost, horizon: Horizon, method: str = "euler"
) -> Callable[[State], PerState] | None:
    """x₀ ↦ J*(x₀), the least cost from each of a batch of initial states, in their own dtype.

    With Euler it is the optimum of the discretised task, J_N*; with any other integrator, that of the continuous one.
    None where lyapnet has no formula for it: a system that is not `Linear`, or an R given as a function of x.

    Raises:
        ValueError: a weight of the cost does not fit the system's dimensions.
    """
    if not isinstance(system, Linear) or cost.R_constant is None:
        return None
    solve = discrete_riccati if method == "euler" else continuous_riccati
    return partial(solve(system, cost, horizon).value, 0)
