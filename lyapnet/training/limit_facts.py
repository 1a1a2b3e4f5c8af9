"""The share of X₀ that controls within their limits can hold near the goal, by the linear model there."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.base.linear_algebra import apply
from lyapnet.base.random_streams import START, stream
from lyapnet.task.problem import Problem
from lyapnet.task.systems import moving_states
from lyapnet.training.config_facts import Fact
from lyapnet.value.expansions import in_float64
from lyapnet.value.linearisation import Linearisation, linearised

STATES = 4096  # number of random states of X₀ from which the share is estimated
DEMANDING = 0.5  # part of the limits above which the need of states of X₀ is reported
FAR = 1e9  # size of a control whose projection onto U is taken for the end of U in its direction
ROUNDING = 1e-9  # relative size below which an imaginary part, or the effect of the controls, counts as zero


class Demand(NamedTuple):
    """The part of the limits that is needed to stop a growing mode.

    Args:
        mode: its eigenvalue in 1/s.
        taken: this part for each state; above 1 the mode grows for every u.
    """

    mode: float
    taken: Tensor


def limit_facts(problem: Problem) -> list[Fact]:
    """The share of X₀ that no controls within their limits can hold near the goal, by the linear model there.

    For a real eigenvalue λ > 0 of A with left eigenvector l, and δ = x − x*,

        d/dt lᵀδ = λ lᵀδ + lᵀF(x*, u*) + lᵀB(u − u*).

    If the first two terms together are larger than the last one for every u ∈ U, lᵀδ grows without bound, and the
    difference grows like e^{λt}. For the linear model it is therefore necessary that they are not larger. This is not
    sufficient, and the nonlinear system may differ. Modes that grow by less than a factor e within T are left out.
    """
    if not problem.controls.limited or not problem.has_goal or problem.follows_reference:
        return []
    problem = in_float64(problem)
    around = linearised(problem)
    demands = [] if around.missing is not None else list(_find_demands(problem, around))
    if not demands:
        return []
    hardest = max(demands, key=lambda demand: float(demand.taken.max()))
    most, mode = float(hardest.taken.max()), f"the mode {hardest.mode:.3g} 1/s"
    if most <= 1:
        told = f"the linear model at the goal takes up to {most:.0%} of the limits to hold X₀ against {mode}"
        return [Fact("limits", told)] if most > DEMANDING else []
    outside = float(torch.stack([demand.taken > 1 for demand in demands]).any(0).double().mean())
    share = "all" if outside == 1 else "less than 1%" if outside < 0.01 else f"{min(outside, 0.99):.0%}"
    times = math.exp(hardest.mode * problem.horizon.duration)
    found = (
        f"the limits are too small for {share} of X₀, by the linear model at the goal: there {mode} grows whatever u "
        f"is, and what is missing {times:.2g}-fold within T"
    )
    if outside == 1:
        return [Fact("limits", f"{found}; a swing beyond that model may reach the goal")]
    return [Fact("limits", found, "a smaller X₀ or wider controls, if all of X₀ is to stay near the goal")]


def _find_demands(problem: Problem, around: Linearisation) -> Iterator[Demand]:
    """The demands of all growing modes with real eigenvalues that the controls act on, for random states of X₀."""
    moving, controls = moving_states(problem.system), problem.controls
    A, B = around.A[moving][:, moving], around.g[moving]
    rest = (around.f + apply(around.g, problem.rest))[moving]
    x = problem.initial_states.sample(STATES, stream(0, START))
    away = (x - problem.goal)[:, moving]
    values, vectors = torch.linalg.eig(A.mT)
    for value, vector in zip(values.tolist(), vectors.mT, strict=True):
        left = vector.real
        slope = B.mT @ left
        oscillates, weak = abs(value.imag) > ROUNDING * abs(value), slope.norm() <= ROUNDING * B.norm()
        if oscillates or weak or value.real * problem.horizon.duration < 1:
            continue
        growth = value.real * (away @ left) + rest @ left
        end = FAR * slope / slope.norm()
        least, most = (slope @ (controls.project(u) - problem.rest) for u in (-end, end))
        yield Demand(
            value.real, torch.where(growth > 0, growth / (-least).relu(), -growth / most.relu()).nan_to_num(0.0)
        )
