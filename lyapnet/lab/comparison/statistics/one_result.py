"""Statistics of one result: its costs relative to the optimum, and when its training came close to it."""

import torch
from torch import Tensor

from lyapnet.evaluation.optimality import mean_optimum, ratio_of_means
from lyapnet.lab.comparison.results import Measurement, Result


def cost_ratio(result: Result) -> float | None:
    """Mean cost / mean optimum over the states whose optimum is known."""
    known = _costs_and_optima(result)
    return known and ratio_of_means(*known)


def optimum(result: Result) -> float | None:
    """The mean optimum of the states where it is known."""
    known = _costs_and_optima(result)
    return known and mean_optimum(known[1])


def relative_costs(result: Result) -> list[float] | None:
    """J(x₀) / J*(x₀) of the states whose optimum is known and not 0; None where none is known."""
    known = _costs_and_optima(result)
    if known is None or not known[1].isfinite().any():
        return None
    costs, optima = known
    return (costs / optima)[optima > 0].tolist()


def first_within(result: Result, ratio: float) -> Measurement | None:
    """The first validation whose cost is within a ratio of the optimum; later ones may be worse again."""
    return next((one for one in result.curve if one.cost_ratio is not None and one.cost_ratio <= ratio), None)


def best_until(result: Result, steps: float, *, and_next: bool = False) -> float | None:
    """The least cost / optimum of the validations at or before an environment step; None where one is not known.

    Args:
        and_next: where none is at that very step, the next one counts too.
    """
    points = [one for one in result.curve if one.environment_steps <= steps]
    if and_next and points and points[-1].environment_steps < steps:
        points += result.curve[len(points) : len(points) + 1]
    known = [one.cost_ratio for one in points if one.cost_ratio is not None]
    return min(known) if known and len(known) == len(points) else None


def best_validation(result: Result) -> Measurement:
    """The validation with the least cost, the later of two; a baseline is evaluated with its checkpoint."""
    return min(reversed(result.curve), key=lambda one: one.cost)


def _costs_and_optima(result: Result) -> tuple[Tensor, Tensor] | None:
    """The costs and optima (k,) of the evaluation states; None where there was no oracle."""
    if result.optima is None:
        return None
    costs, optima = (torch.tensor(list(values), dtype=torch.float64) for values in (result.costs, result.optima))
    return costs, optima
