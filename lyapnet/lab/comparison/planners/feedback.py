"""Regulators: feedback around the goal, and around an optimal trajectory from where a closed loop starts."""

import numpy as np
import torch
from numpy.typing import NDArray

from lyapnet.base.contracts import copied
from lyapnet.base.errors import UsageError
from lyapnet.lab.comparison.planners.planner import LoopLaw, Planner
from lyapnet.task.problem import Problem
from lyapnet.value.expansions import (
    at_rest,
    greedy_law,
    in_float64,
    optimal_trajectories,
    path_under,
    regulator,
    riccati,
)


class Rest(Planner):
    """The projection of u* onto U."""

    def __init__(self, problem: Problem):
        self.problem = copied(problem)

    def law(self) -> LoopLaw:
        def control(step: int, x: NDArray) -> NDArray:
            return self.problem.controls.project(self.problem.rest_at(torch.from_numpy(x))).numpy()

        return control


class Regulator(Planner):
    """LQR: u_n = ū_n + K_n(x − x*) of the task linearised at its goal, for its own horizon; U is not known to it.

    Noise changes K only where σ depends on x.
    """

    def __init__(self, problem: Problem):
        if problem.follows_reference:
            raise UsageError("Expected a goal that stays for lqr, got a reference; leave lqr out.")
        self.goal = problem.goal.double().cpu().numpy()
        self.feedforward, self.gain = (part.numpy() for part in regulator(problem))

    def law(self) -> LoopLaw:
        return lambda step, x: self.feedforward[step] + self.gain[step] @ (x - self.goal)


class IterativeRegulator(Planner):
    """iLQR, with second derivatives at the end, from x₀ at t = 0; its plan is then followed, the plant being the model.

    It is begun twice, with the control that costs nothing and with LQR's, and the cheaper of the two plans is taken.

    Raises:
        UsageError: the task has noise, under which nobody follows a plan without feedback.
    """

    def __init__(self, problem: Problem):
        if problem.noise is not None:
            raise UsageError(
                "Expected a task without noise for ilqr, got some; its plan has no feedback: leave it out of methods, "
                "or take mpc_100, which plans again at each step."
            )
        self.problem, self.linear = in_float64(problem), riccati(problem)

    def law(self) -> LoopLaw:
        plan: list[NDArray] = []

        def control(step: int, x: NDArray) -> NDArray:
            if not plan:
                plan.append(self._plan(x))
            return plan[0][step]

        return control

    def _plan(self, x: NDArray) -> NDArray:
        x0 = torch.from_numpy(x)[None]
        laws = at_rest(self.problem), greedy_law(self.problem, self.linear)
        u = torch.cat([path_under(self.problem, law, x0).u for law in laws], 1)
        path = optimal_trajectories(self.problem, x0.expand(u.shape[1], -1), u).path
        return np.ascontiguousarray(path.u[:, int(path.cost.argmin())].numpy())
