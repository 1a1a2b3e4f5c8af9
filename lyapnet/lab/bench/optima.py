"""Time for the optima from which a training starts, and how their costs compare with the oracle's."""

import math
from dataclasses import dataclass

import torch

from lyapnet.base.random_streams import START, stream
from lyapnet.base.threads import seconds_of_work
from lyapnet.evaluation.oracles import optimal_cost
from lyapnet.evaluation.oracles.multistart import SAME
from lyapnet.lab.bench.cases import Case
from lyapnet.training.optima import MAX_OPTIMA, minima, optima_for
from lyapnet.training.stage_messages import StageReport, silent
from lyapnet.training.start import expansions_of
from lyapnet.value.expansions import Expansion


@dataclass(frozen=True)
class OptimaTiming:
    """The optima from which a training of one task starts, by differential dynamic programming.

    Costs J are compared with those J* of the oracle: Riccati's for a linear task, else IPOPT's.
    """

    task: str
    states: int  # n
    controls: int  # m
    steps: int  # N
    asked: int  # number of initial states
    found: int  # number of minima among them
    seconds: float  # of work for all of them, after the traces and the expansions from which the search begins
    compared: int  # number of states whose J* is known
    largest_excess: float  # max (J − J*)/|J*|; NaN if none is known
    largest_saving: float  # max (J* − J)/|J*|
    as_low: float  # share of these with (J − J*)/|J*| ≤ SAME


def time_optima(case: Case, compared: int, report: StageReport = silent) -> OptimaTiming:
    """Search for the optima of a case, and compare the costs of the first of them with the oracle's.

    Args:
        compared: number of states that the oracle solves, outside of the seconds.
        report: called with each stage of the work.
    """
    problem = case.problem
    known = [each for _, each in expansions_of(problem, report) if isinstance(each, Expansion)]
    states = problem.initial_states.sample(MAX_OPTIMA, stream(0, START, 2)).to(problem.goal)
    began = seconds_of_work()
    solutions = optima_for(problem, known, states, report)
    seconds, path = seconds_of_work() - began, minima(problem, solutions).path
    oracle, some = optimal_cost(problem.without_noise()), path.x[0][:compared]
    excess = torch.empty(0)
    if oracle is not None and len(some):
        best = oracle.solve(some, progress=lambda done, of: report("optima by the oracle", done, of)).cost.double()
        excess = ((path.cost[:compared] - best) / best.abs())[best.isfinite()]
    worst, saved, share = math.nan, math.nan, math.nan
    if len(excess):
        worst, saved = float(excess.max()), float(-excess.min())
        share = float((excess <= SAME).double().mean())
    size = problem.system.n, problem.system.m, problem.horizon.steps
    return OptimaTiming(
        case.name, *size, len(solutions.path.cost), len(path.cost), seconds, len(excess), worst, saved, share
    )  # fmt: skip
