"""Derivatives along trajectories, where some of them do not exist at a node."""

import pytest
import torch
from torch.testing import assert_close

from lyapnet import Box, ControlAffineSystem, ControlBox, Horizon, Problem, QuadraticCost
from lyapnet.value.derivatives import StepDerivatives, costates, jacobian, steps_along, with_curvature
from lyapnet.value.expansions import at_rest, optimal_trajectories, path_under


class Drone(ControlAffineSystem):
    """A point in the plane with drag |v|v, of which the second derivative does not exist at rest."""

    state_names, state_units = ("x", "y", "vx", "vy"), ("",) * 4
    control_names, control_units = ("fx", "fy"), ("",) * 2

    def speed(self, v):
        return torch.linalg.vector_norm(v, dim=-1, keepdim=True)

    def f(self, x):
        return torch.cat([x[..., 2:], -0.3 * self.speed(x[..., 2:]) * x[..., 2:]], -1)

    def g(self, x):
        return torch.tensor([[0.0, 0], [0, 0], [1, 0], [0, 1]]).to(x).expand(*x.shape[:-1], 4, 2)


class Rooted(Drone):
    """The same, with a norm of which the first derivative does not exist at rest either."""

    def speed(self, v):
        return v.square().sum(-1, keepdim=True).sqrt()


def drone(system=None):
    cost = QuadraticCost(*(torch.tensor(d).diag().tolist() for d in ([1, 1, 0.1, 0.1], [0.1, 0.1], [10.0, 10, 1, 1])))
    box = Box([1, -5, 0, 0], [5, 5, 0, 0])
    return Problem(system or Drone(), cost, ControlBox(-4, 4), box, Horizon(30, 0.1))


def along(problem, x, u):
    return steps_along(StepDerivatives(problem.step, problem.system.n), problem.cost.terminal, x, u)


def of(problem, x0):
    return optimal_trajectories(problem, x0, torch.zeros(30, len(x0), 2))


@pytest.mark.gate
def test_a_curvature_that_is_missing_at_one_node_does_not_cost_the_others_theirs():
    problem, x0 = drone(), torch.tensor([[3.0, 1.0, 0, 0], [2.0, 0.9, 0, 0]])
    for system in (Drone(), Rooted()):
        optimum = of(drone(system), x0)
        assert all(part.isfinite().all() for part in optimum.expansion)
        assert optimum.replaced.tolist() == [1, 1]
    h = 1e-3
    moved = x0 + torch.tensor([h, 0, 0, 0])
    slope = (of(problem, moved).path.cost - of(problem, moved - torch.tensor([2 * h, 0, 0, 0])).path.cost) / (2 * h)
    assert_close(optimum.expansion.gradient[0, :, 0], slope, rtol=1e-4, atol=0)
    moving = of(problem, x0 + torch.tensor([0, 0, 0.1, 0]))
    assert moving.replaced.tolist() == [0, 0], "away from rest nothing is missing"


def test_without_that_it_is_no_number():
    problem, x0 = drone(), torch.tensor([[3.0, 1.0, 0, 0]])
    with torch.enable_grad():
        x = x0.clone().requires_grad_()
        slope = jacobian(problem.system.f(x), x)
        assert slope.isfinite().all()
        assert jacobian(slope[..., 2, :], x).isnan().any()
        assert jacobian(Rooted().f(x), x).isnan().any()


def test_derivatives_that_exist_are_left_as_they_are():
    problem, x0 = drone(), torch.tensor([[3.0, 1.0, 0.5, 0.2]])
    path = path_under(problem, lambda n, x: torch.full_like(x[..., :2], 0.5), x0)
    steps = along(problem, path.x, path.u)
    assert not steps.replaced.any()
    p = torch.randn(30, 1, 4)
    curved = with_curvature(StepDerivatives(problem.step, 4), steps, p)
    z = steps.z[4, 0]
    hessian = torch.autograd.functional.hessian(lambda z: problem.step(z[:4], z[4:])[0] @ p[4, 0], z)
    assert_close(curved.l_zz[4, 0] - steps.l_zz[4, 0], hessian)
    rest = path_under(problem, at_rest(problem), x0 * torch.tensor([1.0, 1, 0, 0]))
    still = with_curvature(StepDerivatives(problem.step, 4), along(problem, rest.x, rest.u), p)
    assert bool(still.replaced[:-1].all()), "at rest it is missing at every node"
    assert still.l_zz.isfinite().all()


def test_costates_are_the_slopes_of_what_controls_cost_from_a_node_on():
    problem, x0 = drone(), torch.tensor([[3.0, 1.0, 0.5, 0.2], [-2.0, 1.0, 0.1, -0.4]])
    path = path_under(problem, lambda n, x: torch.full_like(x[..., :2], 0.5), x0)
    p = costates(along(problem, path.x, path.u))
    for k in (1, 17, 30):

        def cost_from(x, controls=path.u[k:]):
            total = torch.zeros(len(x))
            for u in controls:
                x, paid = problem.step(x, u)
                total = total + paid
            return (total + problem.cost.terminal(x)).sum()

        assert_close(p[k - 1], torch.autograd.functional.jacobian(cost_from, path.x[k]))
