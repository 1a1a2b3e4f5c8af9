"""Optima of a task whose cost has a kink at the goal, from the optima of the task with a smoothed kink."""

import math

import torch

from lyapnet.base.types import ControlPath, State
from lyapnet.evaluation.oracles.base import Optima, Oracle, Report, silent
from lyapnet.task.problem import Problem
from lyapnet.value.expansions import in_float64, path_under

NO_CONTROLS = "no controls lead along the optimum of the smoothed cost"


class OracleOfSmoothed(Oracle):
    """The original cost of the controls that are optimal for the smoothed cost.

    It is at least the optimum, and exceeds it at most by the smoothing error: smoothing lowers the cost, by at most ε
    for each root, norm and absolute value.

    Args:
        smoothed: the oracle of the smoothed task.
        problem: the original task.
        method: integrator of the steps.
    """

    def __init__(self, smoothed: Oracle, problem: Problem, method: str):
        self.smoothed, self.problem = smoothed, in_float64(problem.in_steps(method=method))

    def solve(
        self, x0: State, known: ControlPath | None = None, progress: Report = silent, seconds: float = math.inf
    ) -> Optima:
        optima = self.smoothed.solve(x0, known, progress, seconds)
        assert optima.u is not None
        u = optima.u.double().cpu()
        cost = path_under(self.problem, lambda n, _: u[n], x0.detach().double().cpu()).cost.to(x0)
        known = optima.cost.isfinite() & cost.isfinite()
        pairs = zip(optima.reasons, known.tolist(), strict=True)
        reasons = [reason or ("" if is_known else NO_CONTROLS) for reason, is_known in pairs]
        return Optima(cost.masked_fill(~known, torch.nan), reasons, optima.u)
