"""A mechanical system with three degrees of freedom: solved without the library, everywhere that its graph is read."""

import pytest
import torch
from torch.testing import assert_close

from lyapnet.evaluation.oracles.transcription import Transcription
from lyapnet.graphs.tracing import name_of, trace
from lyapnet.loop.rollout import Rollout
from lyapnet.prover.bounds import BoundedFunction
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.sets import Box
from lyapnet.task.systems import ThreeLinkArm
from lyapnet.value.policy import HJBPolicy
from tests.problems import Formula, problem_of

TEMPTING = {"_linalg_solve_ex", "linalg_inv_ex", "linalg_lu_solve"}  # what the compiler hands back to the library


@pytest.fixture
def arm():
    return ThreeLinkArm()


def states(*batch):
    return torch.randn(*batch, 6), torch.randn(*batch, 3)


def operators(graph_module):
    return {name_of(node.target) for node in graph_module.graph.nodes if node.op == "call_function"}


def test_dynamics_against_the_library(arm):
    x, u = states(50)
    q, qdot = x[:, :3], x[:, 3:]
    force = arm.forces(q, qdot) - arm.D * qdot + u @ arm.B.mT
    qddot = torch.linalg.solve(arm.mass_matrix(q), force)
    assert_close(arm.dynamics(x, u), torch.cat([qdot, qddot], -1))
    assert_close(arm.inverse_mass(x), arm.B.mT @ torch.linalg.solve(arm.mass_matrix(q), arm.B))
    assert torch.autograd.gradcheck(arm.dynamics, [y[:3].clone().requires_grad_() for y in (x, u)])


def test_energy_is_that_of_a_rigid_body(arm):
    """Ė = q̇ᵀBu − q̇ᵀDq̇."""
    x, u = states(20)
    x.requires_grad_()
    (slope,) = torch.autograd.grad(arm.energy(x).sum(), x)
    power = (x[:, 3:] * (u @ arm.B.mT - arm.D * x[:, 3:])).sum(-1)
    assert_close((slope * arm.dynamics(x, u)).sum(-1), power)


def test_no_library_call_is_left_in_the_trace_of_dynamics_and_their_derivatives(arm):
    def function(x, u):
        with torch.enable_grad():
            leaves = [y.detach().requires_grad_() for y in (x, u)]
            xdot = arm.dynamics(*leaves)
            return xdot.detach(), *torch.autograd.grad(xdot.sum(), leaves), arm.inverse_mass(x)

    graph = trace(function, states(4))
    assert not TEMPTING & operators(graph)
    other = states(4)
    for result, expected in zip(graph(*other), function(*other), strict=True):
        assert_close(result, expected)
    assert TEMPTING & operators(trace(lambda x: (torch.linalg.inv(arm.mass_matrix(x[:, :3])),), states(4)[:1]))


@pytest.mark.gate
@pytest.mark.parametrize("R", ["inverse mass", "constant"])
def test_the_discrete_gradient_is_that_of_backpropagation(R, arm):
    cost = QuadraticCost(torch.eye(6), arm.inverse_mass if R == "inverse mass" else torch.eye(3) + 0.2, torch.eye(6))
    P, x0, gradients = torch.eye(6).requires_grad_(), 0.3 * torch.randn(4, 6), []
    V = Formula(lambda t, x: ((x @ V.P) * x).sum(-1))
    V.P = torch.nn.Parameter(P.detach())
    problem = problem_of(arm, cost, steps=5, dt=0.05)
    for gradient in ("discrete", "backprop"):
        J = Rollout(problem, HJBPolicy(problem, V), gradient=gradient)(x0).cost.mean()
        gradients += torch.autograd.grad(J, [V.P])
    assert_close(*gradients, rtol=1e-9, atol=1e-12)
    assert gradients[0].abs().max() > 1e-3


def test_bounds_enclose_its_acceleration(arm):
    """By random points of boxes; and they tighten with the box."""
    center = torch.cat([torch.zeros(1), 0.3 * torch.randn(6)])
    widths = []
    for half in (0.1, 0.02):
        lower, upper = center - half, center + half
        function = BoundedFunction(lambda t, x: (arm.f(x),), (lower, upper))
        ((low, high),) = function.bounds(lower[None], upper[None])
        points = Box(lower, upper).sample(2000, torch.Generator().manual_seed(0))
        values = arm.f(points[:, 1:])
        assert (low <= values).all()
        assert (values <= high).all()
        spread = values.amax(0) - values.amin(0)
        widths.append(float((high - low)[0, 3:].sum() / spread[3:].sum()))
        assert not (values <= high - 0.5 * spread).all(), "bounds that are too low"
    assert widths[1] < widths[0]
    assert widths[1] < 2


def test_the_transcription_reads_it(arm):
    """Its translation is held against the system when it is made; the optimum costs less than no control."""
    cost = QuadraticCost(torch.eye(6), arm.inverse_mass, 10 * torch.eye(6))
    problem = problem_of(arm, cost, steps=4, dt=0.1)
    oracle, x0 = Transcription(problem), torch.tensor([[0.3, -0.2, 0.1, 0.5, 0.0, -0.5]])
    optimum = oracle.solve(x0)
    _, idle = oracle.rollout(x0, torch.zeros(4, 1, 3))
    _, again = oracle.rollout(x0, optimum.u)
    assert_close(again, optimum.cost)
    assert (optimum.cost < idle).all()
