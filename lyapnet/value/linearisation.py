"""A problem linearised at its goal, or the reason why it cannot be."""

import copy
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.base.contracts import TO_WRITE
from lyapnet.base.errors import one_line
from lyapnet.base.types import InputMatrix, Matrix, PerState, State
from lyapnet.task.cost import Cost, MadeOfAnother, SmoothedCost, goal_in_words
from lyapnet.task.domain import as_written
from lyapnet.task.problem import Problem
from lyapnet.value.derivatives import jacobian
from lyapnet.value.expansions import Expansion, in_float64, riccati

LinAlgError = torch.linalg.LinAlgError  # pyright: ignore[reportPrivateImportUsage]
NAME_A_GOAL = "name target: in the config, or cost.goal, where the task has a goal"
NEARBY, NEAR = 8, 1e-3  # states around the goal, and how far away they are, in units of X₀
TRAINED, SOLVED = 3e-3, 1e-4  # ε of a kink, in units of the usual size: V can be learned, optima cost what they do
USUAL = 256  # states around the goal as far away as X₀, by which the size of a cost is known
KINK, BENT = 1e-9, 1e-2  # how far from the goal slopes are compared, in units of X₀; by how much they differ at a kink


class Missing(NamedTuple):
    """Why something is not known, and what to do about it."""

    reason: str
    remedy: str


class Linearisation(NamedTuple):
    """ẋ ≈ f + gu* + A(x − x*) + g(u − u*) around the goal x* and the control u* that costs nothing.

    Entries may not be finite.
    """

    f: State
    g: InputMatrix
    A: Matrix  # ∂(f + gu*)/∂x
    missing_values: Missing | None  # why there is no f or no g at the goal
    missing: Missing | None  # the same, or why there is no A


def linearised(problem: Problem) -> Linearisation:
    """The dynamics linearised at the goal, in float64."""
    problem = in_float64(problem)
    with torch.enable_grad():
        x = problem.goal.clone().requires_grad_()
        A = jacobian(problem.system.dynamics(x, problem.rest), x).detach()
    f, g = problem.system.f(problem.goal).detach(), problem.system.g(problem.goal).detach()
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
        return Missing(
            "the Riccati recursion leaves the finite numbers", "choose a shorter horizon, or a smaller horizon.dt"
        )
    return expansion


@torch.no_grad()
def rounded(problem: Problem, share: float = TRAINED) -> Problem:
    """The problem with a cost that is smooth at the goal, where q or φ has a kink there that can be rounded; else it
    itself.

    Where closed loops end and stay, V_xx grows without bound towards a kink: neither second derivatives nor solvers
    that need them lead to an optimum.

    Args:
        share: of what a root, a norm or an absolute value is around the goal, as far away as X₀: ε.
    """
    if smoothed_part(problem.cost) is not None or not problem.has_goal:
        return problem
    own = in_float64(problem)
    written, x = as_written(own.cost), _around(own, USUAL, 1.0)
    if not _has_kink(own, written, x):
        return problem
    smooth = SmoothedCost(as_written(problem.cost), x, own.goal, share)
    if not smooth.words or _has_kink(own, SmoothedCost(written, x, own.goal, share), x):
        return problem
    return problem.replaced(cost=_with_written(problem.cost, smooth).to(problem.initial_states.lower))


def _with_written(cost: Cost, written: Cost) -> Cost:
    """A cost with another one in the place of what is written; the prices of constraints and of a domain stay."""
    if cost is as_written(cost) or not isinstance(cost, MadeOfAnother):
        return written
    outer = copy.deepcopy(cost)
    outer.cost = _with_written(cost.cost, written)
    return outer


def smoothed_part(cost: Cost) -> SmoothedCost | None:
    """What rounds the kinks of a cost, where something does."""
    while isinstance(cost, MadeOfAnother) and not isinstance(cost, SmoothedCost):
        cost = cost.cost
    return cost if isinstance(cost, SmoothedCost) else None


def _has_kink(problem: Problem, cost: Cost, x: State) -> bool:
    """Whether q or φ has no finite first and second derivative at the goal, or slopes that jump there."""
    goal = problem.goal
    for function in (cost.state, cost.terminal):
        value, *derivatives = _to_second_order(function, goal)
        if bool(value.isfinite()) and not all(part.isfinite().all() for part in derivatives):
            return True
        steps = [distance * (x - goal) for distance in (KINK, KINK / 10)]
        bend, closer = ((function(goal + step) + function(goal - step) - 2 * value).abs() for step in steps)
        size = function(x).abs()
        # where slopes jump it falls to a tenth, where they do not to a hundredth
        if bool(((bend > BENT * KINK * size[size.isfinite()].mean()) & (closer > bend / 30)).any()):
            return True
    return False


def singular(error: RuntimeError) -> Missing:
    """What an error of torch's linear algebra says to a user."""
    return Missing(
        f"a matrix of second derivatives is singular, or not finite ({one_line(error)})",
        "give every control a weight in R, and look at f, g and the cost where trajectories lead",
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
    rates = torch.nonzero(~A.isfinite().all(1) & _bent(problem, by)).flatten()
    names = list(problem.system.state_names)
    what, states = (", ".join(names[i] for i in which.tolist()) for which in (rates, by))
    return Missing(f"f + gu* has no finite slope at the goal: that of the rate of {what}, by {states}", TO_WRITE)


def _bent(problem: Problem, by: Tensor) -> Tensor:
    """Which rates have slopes by some states that change near the goal, or all: at the goal a NaN spreads to others."""
    with torch.enable_grad():
        x = _around(problem, NEARBY, NEAR).requires_grad_()
        rate = problem.system.dynamics(x, problem.rest.expand(NEARBY, -1))
        slopes = jacobian(rate, x).detach()[..., by]
    bent = (slopes - slopes[0]).abs().amax((0, -1)) > 0
    return bent if bent.any() else torch.ones_like(bent)


def _around(problem: Problem, count: int, distance: float) -> State:
    """States (b, n) around the goal, at a distance in units of X₀."""
    extent = problem.initial_states.reach_from(problem.goal)
    away = torch.randn(count, problem.system.n, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return problem.goal + distance * away * extent.where(extent > 0, 1)


def _missing_cost(problem: Problem) -> Missing | None:
    """Why the cost has no second order at the goal."""
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
    """The value, slope and second derivative of a function at a state."""
    x = x.detach().clone().requires_grad_()
    value = function(x)
    slope = jacobian(value[None], x)[0]
    return value.detach(), slope.detach(), jacobian(slope, x).detach()
