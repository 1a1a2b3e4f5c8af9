"""Closed loops under noise: their exact gradient, the expectations that programs see, and what must fail."""

import math

import numpy as np
import pytest
import torch
from numpy.polynomial.hermite_e import hermegauss
from torch import Tensor
from torch.testing import assert_close

from lyapnet.loop.programs import LyapunovProgram, ValueProgram
from lyapnet.loop.rollout import Rollout, routines
from lyapnet.loop.rollout.expectations import MOST_SOURCES, certainty_equivalent, expected_value, sampled_value
from lyapnet.loop.rollout.integration import NoisyTrajectory
from lyapnet.loop.rollout.runge_kutta import Step
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.horizon import TABLEAUX, Horizon
from lyapnet.task.noise import Noise, StateNoise
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box, Unbounded
from lyapnet.task.systems import Linear
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.expansions import riccati
from lyapnet.value.networks import FCN, Scaling
from lyapnet.value.policy import HJBPolicy, SampledPolicy
from lyapnet.value.risk import mean_with_risk
from tests.marks import sample
from tests.problems import OfExpansion

N, DT = 20, 0.1


class BilinearNoise(Linear):
    """A double integrator with two sources of noise that depend on the state."""

    def noise(self, x: Tensor) -> Tensor:
        position, velocity = x.unbind(-1)
        none = torch.zeros_like(position)
        first = torch.stack([0.3 * position + 0.1, 0.2 * velocity], -1)
        return torch.stack([first, torch.stack([none, 0.5 + 0.1 * position], -1)], -1)


def problem(constant: bool = True, method: str = "euler", noise: Noise | None = None) -> Problem:
    """A double integrator with noise."""
    own = StateNoise([0.0, 0.4]) if noise is None else noise
    system = (Linear if constant else BilinearNoise)([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
    cost = QuadraticCost(torch.eye(2), 0.3 * torch.eye(1), 2 * torch.eye(2))
    box, horizon = Box([-1.0, -1.0], [1.0, 1.0]), Horizon(N, DT, method)
    return Problem(system, cost, Unbounded(), box, horizon, noise=own if constant else None)


def value_of(problem: Problem, share: float = 1.0, constant: float = 1.0) -> OfExpansion:
    """The value function of a problem, with its constant and the rest scaled."""
    return OfExpansion(problem, riccati(problem), share, constant)


def initial_states(problem: Problem, count: int = 8) -> Tensor:
    return problem.initial_states.sample(count, torch.Generator().manual_seed(1))


def drawn(problem: Problem, x0: Tensor, seed: int = 2) -> Tensor:
    assert problem.noise is not None
    return problem.noise.draw(N, DT, x0, torch.Generator().manual_seed(seed))


def loss_of(x: Tensor, running_cost: Tensor, value: Tensor) -> Tensor:
    return 0.3 * (x**2).sum() + running_cost.mean() + (value**2).mean()


@pytest.mark.parametrize("form", ["in blocks", "step by step", pytest.param("compiled", marks=pytest.mark.gate)])
@pytest.mark.parametrize("law", [HJBPolicy, SampledPolicy])
@pytest.mark.parametrize("method", sample(["euler", "rk4"], 2))
@pytest.mark.parametrize("constant", [True, False])
def test_the_gradient_is_that_of_autograd_through_the_same_path(constant, method, law, form, monkeypatch):
    if form == "step by step":
        monkeypatch.setattr(routines, "MOST_STATES_OF_BLOCKS", 1)
    task = problem(constant, method)
    torch.manual_seed(0)
    V = FCN(Scaling([1.0, 1.0], 2.0, 1.0), [16, 16])
    rollout, x0 = Rollout(task, law(task, V), gradient="discrete"), initial_states(task).requires_grad_()
    increments = drawn(task, x0)
    step = Step(rollout.stepped, TABLEAUX["euler" if rollout.stepped is not rollout.closed_loop else method])
    x, paid, values = [x0], torch.zeros(()), []
    for n in range(N):
        following, _, cost, _, value = step(torch.tensor(n * DT), torch.tensor(DT), increments[n], x[-1])
        x.append(following)
        paid = paid + cost
        values.append(value)
    values.append(V(torch.tensor(N * DT), x[-1]))
    leaves = [x0, *V.parameters()]
    expected = torch.autograd.grad(loss_of(torch.stack(x), paid, torch.stack(values)), leaves)
    if form == "compiled":
        assert rollout.discrete is not None
        rollout.discrete.compile(x0.detach())
    trajectory = rollout(x0, increments)
    found = torch.autograd.grad(loss_of(trajectory.x, trajectory.running_cost[-1], trajectory.require_value()), leaves)
    assert_close(trajectory.x, torch.stack(x), rtol=1e-13, atol=1e-13)
    for one, other in zip(found, expected, strict=True):
        assert (one - other).abs().max() <= 1e-12 * other.abs().max()


def test_without_increments_the_loop_is_that_without_noise():
    task = problem()
    V = value_of(task)
    x0 = initial_states(task)
    with torch.no_grad():
        quiet = Rollout(task, SampledPolicy(task, V), gradient="discrete")(x0)
        other = Rollout(task.without_noise(), SampledPolicy(task, V), gradient="discrete")(x0)
    assert torch.equal(quiet.x, other.x)
    assert not isinstance(quiet, NoisyTrajectory)
    assert quiet.expected_cost is not None
    assert quiet.compensated() is quiet


def test_the_same_seed_draws_the_same_noise_with_variance_dt():
    task = problem()
    x0 = task.initial_states.sample(4000, torch.Generator().manual_seed(0))
    assert torch.equal(drawn(task, x0), drawn(task, x0))
    assert not torch.equal(drawn(task, x0), drawn(task, x0, seed=3))
    assert abs(float(drawn(task, x0).var()) / DT - 1) < 0.02


@pytest.mark.gate
@pytest.mark.parametrize("constant", [True, False])
def test_for_the_value_function_every_path_has_residual_zero(constant):
    task = problem(constant)
    V, x0 = value_of(task), initial_states(task)
    trajectory = Rollout(task, SampledPolicy(task, V), gradient="discrete")(x0, drawn(task, x0))
    seen = trajectory.compensated()
    program = ValueProgram(constraint=1, cost_to_go=1, terminal=1, normalise=False)
    output = program(seen)
    for name in ("constraint", "cost_to_go", "terminal"):
        assert output.terms[name].item() < 1e-20
    (gradient,) = torch.autograd.grad(output.terms["cost_to_go"], V.weight)
    assert abs(gradient.item()) < 1e-12
    raw = program(trajectory)  # without expectations the noise is a floor
    assert raw.terms["cost_to_go"].item() > 1e-3


@pytest.mark.parametrize(("share", "constant"), [(1.05, 1.0), (1.0, 1.05)])
def test_a_wrong_value_has_a_residual(share, constant):
    task = problem()
    x0 = initial_states(task)
    V = value_of(task, share, constant)
    trajectory = Rollout(task, SampledPolicy(task, V), gradient="discrete")(x0, drawn(task, x0)).compensated()
    assert ValueProgram(cost_to_go=1, normalise=False)(trajectory).terms["cost_to_go"].item() > 1e-5


@pytest.mark.gate
def test_the_minimiser_is_not_biased():
    """Over many paths the gradient by a factor of V vanishes at the value function; the raw residual's does not."""
    task = problem()
    V = value_of(task)
    x0 = task.initial_states.sample(2000, torch.Generator().manual_seed(0))
    trajectory = Rollout(task, SampledPolicy(task, V), gradient="discrete")(x0, drawn(task, x0))
    program = ValueProgram(constraint=1, normalise=False)
    slopes = [
        torch.autograd.grad(program(each).terms["constraint"], V.weight, retain_graph=True)[0]
        for each in (trajectory.compensated(), trajectory)
    ]
    assert abs(float(slopes[0])) < 1e-10
    assert float(slopes[1]) > 1e-2  # a smaller V has less variance


@pytest.mark.gate
def test_the_lyapunov_condition_is_one_in_expectation():
    task = problem()
    x0, program = initial_states(task, 64), LyapunovProgram(terminal=1)
    for V, holds in ((value_of(task), True), (value_of(task, constant=0.5), False)):
        loop = Rollout(task, SampledPolicy(task, V), gradient="discrete")
        trajectory = loop(x0, drawn(task, x0)).compensated()
        hinge = program.constraint_loss(trajectory.require_value(), trajectory)
        assert (hinge.max().item() < 1e-12) == holds


@torch.no_grad()
def test_the_control_variate_keeps_the_mean_and_removes_variance():
    task, paths = problem(), 4000
    x0 = torch.tensor([0.5, -0.3]).expand(paths, -1)
    optimal, other = value_of(task), value_of(task, 1.3, 0.0)
    trajectory, wrong = (
        Rollout(task, SampledPolicy(task, V), gradient="discrete")(x0, drawn(task, x0)) for V in (optimal, other)
    )
    for each in (trajectory, wrong):  # M has mean zero for any V
        assert isinstance(each, NoisyTrajectory)
        assert abs(float(each.martingale.mean())) < 4 * float(each.martingale.std()) / math.sqrt(paths)
    cost, expected = trajectory.expected_cost, float(optimal(torch.zeros(()), x0[:1]))
    assert abs(float(cost.mean()) - expected) < 4 * float(cost.std()) / math.sqrt(paths)
    assert float(cost.std()) < 0.6 * float(trajectory.cost.std())
    assert float(wrong.cost.mean()) > expected


def test_points_are_exact_for_the_third_degree_and_not_for_the_fourth():
    class Power(ValueFunction):
        def __init__(self, degree: int):
            super().__init__()
            self.degree = degree

        def forward(self, t: Tensor, x: Tensor) -> Tensor:
            return (x[..., 0] + 2 * x[..., 1]) ** self.degree

    noise, x = StateNoise([0.3, 0.5]), torch.tensor([[0.7, -0.2]])
    mean, variance = 0.3, DT * (0.3**2 + 4 * 0.5**2)
    third, fourth = mean**3 + 3 * mean * variance, mean**4 + 6 * mean**2 * variance + 3 * variance**2
    found = [float(expected_value(Power(d), noise, torch.zeros(()), x, x, DT)) for d in (3, 4)]
    assert abs(found[0] - third) < 1e-12
    assert abs(found[1] - fourth) > 1e-4


def test_euler_maruyama_converges_with_its_orders():
    """Strong order 1/2 for σ = 0.8 x on geometric Brownian motion, whose path is known; 1 for a constant σ."""

    class Geometric(Linear):
        def noise(self, x: Tensor) -> Tensor:
            return 0.8 * x[..., None]

    def error(steps: int, geometric: bool) -> float:
        fine, T, paths = 256, 1.0, 2000
        draw = torch.Generator().manual_seed(0)
        w = math.sqrt(T / fine) * torch.randn(fine, paths, 1, generator=draw)
        cost = QuadraticCost(torch.eye(1), torch.eye(1), torch.eye(1))
        system = Geometric([[0.0]], [[1.0]]) if geometric else Linear([[-1.0]], [[1.0]])
        own = None if geometric else StateNoise([0.5])
        task = Problem(system, cost, Unbounded(), Box([1.0], [1.0]), Horizon(steps, T / steps, "euler"), noise=own)
        V = FCN(Scaling([1.0], T, 0.0), [4])
        with torch.no_grad():
            for parameter in V.parameters():
                parameter.zero_()
            path = Rollout(task, HJBPolicy(task, V), gradient="discrete")(
                torch.ones(paths, 1), w.reshape(steps, fine // steps, paths, 1).sum(1)
            )
        if geometric:
            exact = torch.exp(-0.32 + 0.8 * w.sum(0))
        else:  # the Ornstein–Uhlenbeck path on the finest grid
            exact = torch.ones(paths, 1)
            for k in range(fine):
                exact = exact - T / fine * exact + 0.5 * w[k]
        return float((path.x[-1] - exact).abs().mean())

    for geometric, order in ((True, 0.5), (False, 1.0)):
        coarse, finer = error(8, geometric), error(32, geometric)
        assert abs(math.log2(coarse / finer) / 2 - order) < 0.2


@pytest.mark.parametrize("strengths", [[0.0, 0.0], [-0.1, 0.2], [math.inf, 0.1], [math.nan, 0.1]])
def test_noise_of_no_or_negative_strength_is_refused(strengths):
    with pytest.raises(ValueError, match="Expected strengths ≥ 0"):
        StateNoise(strengths)


def test_increments_of_another_shape_or_without_noise_are_refused():
    task = problem()
    V, x0 = value_of(task), initial_states(task)
    rollout = Rollout(task, SampledPolicy(task, V), gradient="discrete")
    with pytest.raises(ValueError, match="Expected increments of shape"):
        rollout(x0, drawn(task, x0)[:-1])
    quiet = Rollout(task.without_noise(), SampledPolicy(task, V), gradient="discrete")
    with pytest.raises(ValueError, match="Expected increments of shape None"):
        quiet(x0, drawn(task, x0))
    with pytest.raises(ValueError, match="take discrete"):
        Rollout(task, SampledPolicy(task, V), gradient="backprop")(x0, drawn(task, x0))


class Coupled(Linear):
    """Ten states, each with a source of noise that grows with it."""

    def noise(self, x: Tensor) -> Tensor:
        return torch.diag_embed(0.3 + 0.1 * x)


@pytest.mark.gate
@pytest.mark.parametrize("constant", [True, False])
@pytest.mark.parametrize("wrong", sample([0.0, 0.05], 2))
def test_many_sources_leave_no_residual_of_the_value_function_either(constant, wrong):
    n = MOST_SOURCES + 2
    system = (Linear if constant else Coupled)((torch.ones(n, n) / n - torch.eye(n)).tolist(), torch.eye(n).tolist())
    cost = QuadraticCost(torch.diag(torch.linspace(0.1, 3, n)), torch.eye(n), torch.eye(n))
    box, noise = Box([-1.0] * n, [1.0] * n), StateNoise([0.4] * n) if constant else None
    task = Problem(system, cost, Unbounded(), box, Horizon(N, DT), noise=noise)
    V, x0 = value_of(task, 1 + wrong), initial_states(task)
    seen = Rollout(task, SampledPolicy(task, V), gradient="discrete")(x0, drawn(task, x0)).compensated()
    output = ValueProgram(constraint=1, cost_to_go=1, normalise=False)(seen)
    for name in ("constraint", "cost_to_go"):
        assert (output.terms[name].item() < 1e-18) == (wrong == 0)


class Fourth(ValueFunction):
    """Σ x_i⁴, of which no model of the curvature is known, or a wrong one."""

    def __init__(self, modelled: bool):
        super().__init__()
        self.modelled = modelled

    def forward(self, t: Tensor, x: Tensor) -> Tensor:
        return (x**4).sum(-1)

    def curvature(self, t: Tensor) -> Tensor | None:
        return torch.eye(10).expand(*t.shape, 10, 10) if self.modelled else None


@pytest.mark.parametrize("modelled", [True, False])
def test_a_sampled_expectation_is_unbiased_for_the_fourth_degree_too(modelled):
    x, sigma = torch.linspace(-1, 1, 10), 0.5
    noise, many = StateNoise([sigma] * 10), 20_000
    draws = math.sqrt(DT) * torch.randn(3, many, 10, generator=torch.Generator().manual_seed(0))
    at = x.expand(many, -1)
    found = sampled_value(Fourth(modelled), noise, torch.zeros(()), at, at, list(draws), DT)
    s = sigma**2 * DT
    exact = float((x**4 + 6 * s * x**2 + 3 * s**2).sum())
    error = 4 * float(found.std()) / math.sqrt(many)
    assert abs(float(found.mean()) - exact) < error
    points = expected_value(Fourth(modelled), noise, torch.zeros(()), x, x, DT)
    assert abs(float(points) - exact) > error  # 2k points are exact for the third degree alone


class Quartic(ValueFunction):
    """V = ½ xᵀHx + pᵀx + s (x₁ + x₂)⁴, with H as its model of the curvature, or none."""

    def __init__(self, s: float, modelled: bool = True):
        super().__init__()
        self.H = torch.tensor([[2.0, 0.5], [0.5, 1.0]]).double()
        self.p, self.modelled = torch.tensor([0.3, -0.8]).double(), modelled
        self.s = torch.nn.Parameter(torch.tensor(s).double())

    def forward(self, t, x):
        return ((x @ self.H) * x).sum(-1) / 2 + x @ self.p + self.s * x.sum(-1) ** 4 + 0 * t

    def curvature(self, t):
        return self.H if self.modelled else None


def integral_with_risk(V: ValueFunction, noise: Noise, mean: Tensor, x: Tensor, risk: float) -> Tensor:
    """(1/θ) log E exp(θV(mean + σΔW)) by 40² points of Gauss and Hermite."""
    nodes, weights = hermegauss(40)
    z = torch.tensor(np.stack(np.meshgrid(nodes, nodes, indexing="ij"), -1).reshape(-1, 1, 2))
    w = torch.tensor(np.outer(weights, weights).reshape(-1, 1) / (2 * math.pi))
    values = V(torch.zeros(()), mean + math.sqrt(DT) * (noise(x) @ z[..., None])[..., 0])
    return (w * torch.exp(risk * values)).sum(0).log() / risk


@pytest.mark.parametrize("modelled", [True, False])
@pytest.mark.parametrize("constant", [True, False])
def test_the_certainty_equivalent_is_its_integral(constant, modelled):
    task = problem(constant, noise=StateNoise([0.3, 0.4])).double()
    noise, x = task.noise, initial_states(task).double()
    assert noise is not None
    mean, at, risk = 0.9 * x + 0.1, torch.zeros(()).double(), 0.5
    with torch.no_grad():
        errors = list[float]()
        for s in (0.0, 0.02):
            V = Quartic(s, modelled)
            found = certainty_equivalent(V, noise, at, mean, x, DT, risk)
            errors.append(float((found - integral_with_risk(V, noise, mean, x, risk)).abs().max()))
        assert errors[0] < (1e-12 if modelled else 2e-3)
        assert errors[1] < 2e-3
        plain = expected_value(Quartic(0.02), noise, at, mean, x, DT)
        assert float((plain - found).abs().max()) > 0.01  # the mean is another number


def test_the_certainty_equivalent_has_the_derivatives_of_its_integral():
    task = problem(False).double()
    noise, V, at = task.noise, Quartic(0.02), torch.zeros(()).double()
    assert noise is not None
    x = initial_states(task).double().requires_grad_()
    found, exact = (
        torch.autograd.grad(value.sum(), [x, V.s])
        for value in (
            certainty_equivalent(V, noise, at, 0.9 * x + 0.1, x, DT, 0.5),
            integral_with_risk(V, noise, 0.9 * x + 0.1, x, 0.5),
        )
    )
    for one, other in zip(found, exact, strict=True):
        assert_close(one, other, rtol=0.02, atol=0.02)


@pytest.mark.gate
def test_exponentials_of_surprises_have_mean_one_with_risk_and_not_without():
    task = problem().replaced(risk=0.8)
    V = value_of(task)
    rollout = Rollout(task, SampledPolicy(task, V), gradient="discrete")
    x0 = task.initial_states.center.expand(20_000, -1)
    with torch.no_grad():
        trajectory = rollout(x0, drawn(task, x0))
    assert isinstance(trajectory, NoisyTrajectory)
    assert trajectory.surprise is not None
    each = torch.exp(0.8 * trajectory.surprise.sum(0))
    assert abs(float(each.mean()) - 1) < 4 * float(each.std()) / math.sqrt(len(each)) < 0.02
    other = torch.exp(0.8 * (trajectory.surprise.sum(0) + 0.05))
    assert abs(float(other.mean()) - 1) > 4 * float(each.std()) / math.sqrt(len(each))
    # V is right, so that paths differ by the errors of their steps alone
    growth, moved = trajectory.exponentials
    V0 = float(trajectory.require_value()[0, 0])
    assert_close(V0 + math.log1p(float(growth.mean())) / 0.8, V0, rtol=0.01, atol=0)
    assert float(growth.std()) / 0.8 < 0.7 * float(trajectory.cost.std())
    assert abs(float(moved.mean()) - 1) < 0.02
    assert float(trajectory.expected_cost.mean()) < V0 - 0.01
    # another V, which is wrong by a constant, gives the same number
    wrong = trajectory._replace(value=trajectory.require_value() + 0.2)
    again = V0 + 0.2 + math.log1p(float(wrong.exponentials[0].mean())) / 0.8
    assert_close(again, V0, rtol=0.02, atol=0)


def test_with_the_right_value_function_compensated_residuals_vanish_with_risk():
    task = problem().replaced(risk=0.8).double()
    x0 = initial_states(task)
    for V, right in ((value_of(task), True), (value_of(task.replaced(risk=0.0)), False)):
        with torch.no_grad():
            trajectory = Rollout(task, SampledPolicy(task, V), gradient="discrete")(x0, drawn(task, x0)).compensated()
        error = float(ValueProgram().constraint_loss(trajectory.require_value(), trajectory).max())
        assert (error < 1e-20) == right


def test_weights_give_the_derivative_of_the_cost_with_risk():
    """d/da of (1/θ) log E exp(θ J_a), by differences on common paths, for the shares a of the feedback."""
    risk, task = 0.8, problem().replaced(risk=0.8).double()
    x0 = task.initial_states.upper.expand(4000, -1)
    increments = drawn(task, x0)

    def cost(share: Tensor) -> Tensor:
        x, J = x0, torch.zeros(len(x0)).double()
        for increment in increments:
            u = -share * (x @ torch.tensor([[1.0], [1.2]]).double())
            x, paid = task.step(x, u)[0], task.step(x, u)[1]
            x = x + task.noise.displacement(x, increment)  # pyright: ignore[reportOptionalMemberAccess]
            J = J + paid
        return J + task.cost.terminal(x)

    share = torch.tensor(0.9).double().requires_grad_()
    J = cost(share)
    weights = len(J) * torch.softmax(risk * J.detach(), 0)
    (found,) = torch.autograd.grad((weights * J).mean(), share)
    (plain,) = torch.autograd.grad(cost(share).mean(), share)
    with torch.no_grad():
        after, before = (mean_with_risk(cost(share + h), risk) for h in (1e-5, -1e-5))
    assert_close(found, (after - before) / 2e-5, rtol=1e-6, atol=0)
    assert abs(float(plain - found)) > 0.02 * abs(float(found))
