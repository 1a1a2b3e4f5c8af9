"""A closed loop whose condition is known to hold, and planted violations of it, for several tests."""

from functools import cache

import torch
from scipy.linalg import solve_continuous_are

from lyapnet.prover.condition import DecreaseCondition
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.sets import Box
from lyapnet.task.systems import DoubleIntegrator
from tests.problems import Formula, hjb_loop, problem_of

DURATION = 2.0
Q = [[10.0, 0.0], [0.0, 0.1]]


class Planted(DecreaseCondition):
    """A condition with a violation planted: a bump of width `side` that lifts c to `height` at one point."""

    def plant(self, point, side, height):
        self.point, self.side = point, side
        with torch.no_grad():
            self.lift = height - float(super().parts(point[0], point[1:])[0])
        return self

    def parts(self, t, x):
        c, W, rise = super().parts(t, x)
        distance = (t - self.point[0]) ** 2 + ((x - self.point[1:]) ** 2).sum(-1)
        return c + self.lift * torch.exp(-distance / self.side**2), W, rise


def riccati():
    """P of V = xᵀPx, the optimum of the double integrator on an infinite horizon."""
    return _riccati().copy()  # a copy, so that no test can change it for others


@cache
def _riccati():
    return solve_continuous_are([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], Q, [[1.0]])


def stationary(P):
    """V = xᵀPx for every t."""
    P = torch.as_tensor(P)
    return Formula(lambda t, x: ((x @ P) * x).sum(-1) + 0 * t)


def cost():
    return QuadraticCost(Q, [[1.0]], Q)


def loop(P, system=None):
    """The closed loop of V = xᵀPx."""
    return hjb_loop(system or DoubleIntegrator(), cost(), stationary(P))


def X0():
    return Box(torch.tensor([-1.0, -0.7]), torch.tensor([1.0, 0.7]))


def problem():
    """The double integrator from X₀ over 2 s."""
    return problem_of(DoubleIntegrator(), cost(), 100, DURATION / 100, X0())


def domain():
    """A box of (t, x) around X₀."""
    return torch.tensor([0.0, -1.5, -2.0]), torch.tensor([DURATION, 1.5, 2.0])
