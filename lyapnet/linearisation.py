"""A problem linearised at its goal, or the reason why it cannot be."""

from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.errors import one_line
from lyapnet.expansions import Expansion, in_float64, jacobian, riccati
from lyapnet.problem import Problem
from lyapnet.types import InputMatrix, Matrix, State

LinAlgError = torch.linalg.LinAlgError  # pyright: ignore[reportPrivateImportUsage]
TO_WRITE = "write √(v² + ε²) in the place of √(v²) and |v|, and √(p + ε) in the place of √p, with a small ε"


class Missing(NamedTuple):
    """Why something is not known, and what to do about it."""

    reason: str
    remedy: str


class Linearisation(NamedTuple):
    """ẋ ≈ f + A(x − x*) + g u around the goal x*; entries may not be finite."""

    f: State
    g: InputMatrix
    A: Matrix
    missing_values: Missing | None  # why there is no f or no g at the goal
    missing: Missing | None  # the same, or why there is no A


def linearised(problem: Problem) -> Linearisation:
    """The dynamics linearised at the goal, in float64."""
    problem = in_float64(problem)
    with torch.enable_grad():
        x = problem.goal.clone().requires_grad_()
        f = problem.system.f(x)
        A = jacobian(f, x).detach()
    f, g = f.detach(), problem.system.g(problem.goal).detach()
    values = _missing_values(problem, f, g)
    return Linearisation(f, g, A, values, values or _missing_slope(problem, "f", A))


def riccati_or_reason(problem: Problem) -> Expansion | Missing:
    """The Riccati solution at the goal, or why there is none."""
    problem = in_float64(problem)
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


def singular(error: RuntimeError) -> Missing:
    """What an error of torch's linear algebra says to a user."""
    return Missing(
        f"a matrix of second derivatives is singular, or not finite ({one_line(error)})",
        "give every control a weight in R, and look at f, g and the cost where trajectories lead",
    )


def goal_in_words(problem: Problem) -> str:
    """The goal, and where nobody named it that it stands in for one."""
    if problem.cost.goal is None:
        return "the origin, which stands in for a target: nobody named one"
    return f"the goal {_listed(problem.goal)}"


def _missing_values(problem: Problem, f: State, g: InputMatrix) -> Missing | None:
    for symbol, value in (("f", f[:, None]), ("g", g)):
        bad = torch.nonzero(~value.isfinite())
        if len(bad):
            row, column = bad[0].tolist()
            remedy = "name target: in the config, or cost.goal, where the task has a goal"
            if problem.cost.goal is not None:
                remedy = "choose a target at which it is"
            rate = f"the rate of {problem.system.state_names[row]} has {float(value[row, column])} there"
            return Missing(f"{symbol} is not finite at {goal_in_words(problem)}; {rate}", remedy)
    return None


def _missing_slope(problem: Problem, symbol: str, slope: Tensor) -> Missing | None:
    bad = torch.nonzero(~slope.isfinite())
    if not len(bad):
        return None
    row, column = bad[0].tolist()
    names = problem.system.state_names
    return Missing(
        f"{symbol} has no finite slope at {goal_in_words(problem)}: the rate of {names[row]} by {names[column]} has "
        f"{float(slope[row, column])} there",
        TO_WRITE,
    )


def _missing_cost(problem: Problem) -> Missing | None:
    """Why the cost has no second order at the goal."""
    place = goal_in_words(problem)
    R = problem.cost.R(problem.goal).detach()
    if not R.isfinite().all() or float(torch.linalg.eigvalsh(R).min()) <= 0:
        return Missing(f"R is not positive definite at {place}: {R.tolist()}", "give every control a weight")
    for symbol, function in (("q", problem.cost.state), ("φ", problem.cost.terminal)):
        with torch.enable_grad():
            x = problem.goal.clone().requires_grad_()
            value = function(x)
            slope = jacobian(value[None], x)[0]
            curvature = jacobian(slope, x)
        for part, what in ((value[None], "value"), (slope, "slope"), (curvature, "second derivative")):
            if not part.isfinite().all():
                return Missing(f"{symbol} has no finite {what} at {place}", TO_WRITE)
    return None


def _listed(values: Tensor) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in values.tolist()) + ")"
