"""Linearisation of a problem at its goal, or the reason why it does not exist."""

import copy
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.base.contracts import TO_WRITE
from lyapnet.base.errors import one_line
from lyapnet.base.types import InputMatrix, Matrix, PerState, State
from lyapnet.task.cost import Cost, CostWrapper, SmoothedCost, goal_in_words
from lyapnet.task.domain import as_written
from lyapnet.task.problem import Problem
from lyapnet.value.derivatives import jacobian
from lyapnet.value.expansions import Expansion, in_float64, riccati

LinAlgError = torch.linalg.LinAlgError  # pyright: ignore[reportPrivateImportUsage]
NAME_A_GOAL = "name target: in the config, or cost.goal, where the task has a goal"
NEARBY_STATES, NEARBY_DISTANCE = 8, 1e-3  # random states near the goal; their distance, in units of X₀
# ε of smoothing, relative to the usual size: large enough to learn V in training, small for optima
TRAINED, SOLVED = 3e-3, 1e-4
SCALE_STATES = 256  # random states around the goal, at the distance of X₀, that give the usual size of a cost
KINK_DISTANCE = 1e-9  # distance from the goal at which slopes are compared to find a kink, in units of X₀
KINK_JUMP = 1e-2  # relative jump of the slope that counts as a kink


class Missing(NamedTuple):
    """The reason why something does not exist, and what to do about it."""

    reason: str
    remedy: str


TOO_MUCH_RISK = Missing("under any law E exp(risk · J) is infinite there", "choose a smaller risk")


class Linearisation(NamedTuple):
    """ẋ ≈ f + gu* + A(x − x*) + g(u − u*) around the goal x* and the control at rest u*; may be non-finite."""

    f: State
    g: InputMatrix
    A: Matrix  # ∂(f + gu*)/∂x
    missing_values: Missing | None  # why f or g does not exist at the goal
    missing: Missing | None  # why f, g or A does not exist


def linearised(problem: Problem) -> Linearisation:
    """The dynamics linearised at the goal, in float64."""
    problem = in_float64(problem)
    with torch.enable_grad():
        x = problem.goal.clone().requires_grad_()
        A = jacobian(problem.system.dynamics(x, problem.rest), x).detach()
    f, g = (part.detach() for part in problem.system.affine_model(problem.goal, problem.rest))
    values = _missing_values(problem, f, g)
    return Linearisation(f, g, A, values, values or _missing_slope(problem, A))


def riccati_or_reason(problem: Problem) -> Expansion | Missing:
    """The Riccati solution at the goal, or why there is none."""
    problem = in_float64(problem)
    if not problem.has_goal:
        return Missing(problem.no_goal, NAME_A_GOAL)
    dynamics = linearised(problem)
    if missing := dynamics.missing or _missing_cost(problem):
        return missing
    try:
        expansion = riccati(problem)
    except LinAlgError as error:
        return singular(error)
    if not all(part.isfinite().all() for part in expansion):
        if problem.risk and all(part.isfinite().all() for part in riccati(problem.replaced(risk=0.0))):
            return TOO_MUCH_RISK
        return Missing(
            "the Riccati recursion leaves the finite numbers", "choose a shorter horizon, or a smaller horizon.dt"
        )
    return expansion


@torch.no_grad()
def smooth_kinks(problem: Problem, share: float = TRAINED) -> Problem:
    """The problem with a smoothed cost, if q or φ has a kink at the goal that can be smoothed; else the problem itself.

    Towards a kink where closed loops end, V_xx grows without bound, so that methods with second derivatives fail.

    Args:
        share: ε, relative to the size of the root, norm or absolute value around the goal at the distance of X₀.
    """
    if smoothed_part(problem.cost) is not None or not problem.has_goal:
        return problem
    own = in_float64(problem)
    written, x = as_written(own.cost), _around(own, SCALE_STATES, 1.0)
    if not _has_kink(own, written, x):
        return problem
    smooth = SmoothedCost(as_written(problem.cost), x, own.goal, share)
    if not smooth.words or _has_kink(own, SmoothedCost(written, x, own.goal, share), x):
        return problem
    return problem.replaced(cost=_replace_innermost(problem.cost, smooth).to(problem.initial_states.lower))


def _replace_innermost(cost: Cost, written: Cost) -> Cost:
    """Replace the innermost cost; the penalties of constraints and of a domain around it stay."""
    if cost is as_written(cost) or not isinstance(cost, CostWrapper):
        return written
    outer = copy.deepcopy(cost)
    outer.cost = _replace_innermost(cost.cost, written)
    return outer


def smoothed_part(cost: Cost) -> SmoothedCost | None:
    """The part of a cost that smooths its kinks; None if there is none."""
    while isinstance(cost, CostWrapper) and not isinstance(cost, SmoothedCost):
        cost = cost.cost
    return cost if isinstance(cost, SmoothedCost) else None


def _has_kink(problem: Problem, cost: Cost, x: State) -> bool:
    """Whether q or φ has a non-finite first or second derivative at the goal, or a slope that jumps there."""
    goal = problem.goal
    for function in (cost.state, cost.terminal):
        value, *derivatives = _to_second_order(function, goal)
        if bool(value.isfinite()) and not all(part.isfinite().all() for part in derivatives):
            return True
        steps = [distance * (x - goal) for distance in (KINK_DISTANCE, KINK_DISTANCE / 10)]
        bend, closer = ((function(goal + step) + function(goal - step) - 2 * value).abs() for step in steps)
        size = function(x).abs()
        # at a tenth of the distance it falls to a tenth if the slope jumps, else to a hundredth
        if bool(((bend > KINK_JUMP * KINK_DISTANCE * size[size.isfinite()].mean()) & (closer > bend / 30)).any()):
            return True
    return False


def singular(error: RuntimeError) -> Missing:
    """A message to the user for an error of torch's linear algebra."""
    return Missing(
        f"a matrix of second derivatives is singular, or not finite ({one_line(error)})",
        "give every control a weight in R, and check f, g and the cost at states of trajectories",
    )


def _missing_values(problem: Problem, f: State, g: InputMatrix) -> Missing | None:
    remedy = NAME_A_GOAL if problem.cost.goal is None else "choose a target at which it is"
    domain = problem.domain
    if domain is not None and not torch.equal(domain.nearest(problem.goal), problem.goal):
        return Missing(f"outside the domain ({domain}) lies {goal_in_words(problem.cost, problem.goal)}", remedy)
    for symbol, value in (("f", f[:, None]), ("g", g)):
        bad = torch.nonzero(~value.isfinite())
        if len(bad):
            row, column = bad[0].tolist()
            rate = f"the rate of {problem.system.state_names[row]} has {float(value[row, column])} there"
            return Missing(f"{symbol} is not finite at {goal_in_words(problem.cost, problem.goal)}; {rate}", remedy)
    return None


def _missing_slope(problem: Problem, A: Matrix) -> Missing | None:
    if A.isfinite().all():
        return None
    by = torch.nonzero(~A.isfinite().all(0)).flatten()
    rates = torch.nonzero(~A.isfinite().all(1) & _varying_rates(problem, by)).flatten()
    names = list(problem.system.state_names)
    what, states = (", ".join(names[i] for i in which.tolist()) for which in (rates, by))
    return Missing(f"f + gu* has no finite slope at the goal: that of the rate of {what}, by {states}", TO_WRITE)


def _varying_rates(problem: Problem, by: Tensor) -> Tensor:
    """Which rates have slopes by some states that vary near the goal, else all; at the goal itself a NaN spreads."""
    with torch.enable_grad():
        x = _around(problem, NEARBY_STATES, NEARBY_DISTANCE).requires_grad_()
        rate = problem.system.dynamics(x, problem.rest.expand(NEARBY_STATES, -1))
        slopes = jacobian(rate, x).detach()[..., by]
    bent = (slopes - slopes[0]).abs().amax((0, -1)) > 0
    return bent if bent.any() else torch.ones_like(bent)


def _around(problem: Problem, count: int, distance: float) -> State:
    """Random states (b, n) around the goal, at about a distance in units of X₀."""
    extent = problem.initial_states.reach_from(problem.goal)
    away = torch.randn(count, problem.system.n, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return problem.goal + distance * away * extent.where(extent > 0, 1)


def _missing_cost(problem: Problem) -> Missing | None:
    """The reason why the cost has no second order expansion at the goal; None if it has one."""
    R = problem.cost.R(problem.goal).detach()
    if not R.isfinite().all() or float(torch.linalg.eigvalsh(R).min()) <= 0:
        return Missing(f"R is not positive definite at the goal: {R.tolist()}", "give every control a weight")
    for symbol, function in (("q", problem.cost.state), ("φ", problem.cost.terminal)):
        orders = _to_second_order(function, problem.goal)
        for part, what in zip(orders, ("value", "slope", "second derivative"), strict=True):
            if not part.isfinite().all():
                return Missing(f"{symbol} has no finite {what} at the goal", TO_WRITE)
    return None


@torch.enable_grad()
def _to_second_order(function: Callable[[State], PerState], x: State) -> tuple[Tensor, Tensor, Tensor]:
    """The value, gradient and Hessian of a function at a state."""
    x = x.detach().clone().requires_grad_()
    value = function(x)
    slope = jacobian(value[None], x)[0]
    return value.detach(), slope.detach(), jacobian(slope, x).detach()
