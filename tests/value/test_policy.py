"""Control laws against brute force, the Riccati equation and the theorems that define them."""

import math

import pytest
import torch
from scipy.linalg import solve_continuous_are
from torch.testing import assert_close

from lyapnet.task.cost import QuadraticCost, TargetCost
from lyapnet.task.sets import ControlBox, ControlSet
from lyapnet.task.systems import DoubleIntegrator, Linear
from lyapnet.value.calculus import gradients, time_derivative
from lyapnet.value.networks import PartiallyConvexNetwork, Scaling
from lyapnet.value.networks.anchored import GoalAnchor
from lyapnet.value.policy import POLICIES, HJBPolicy, LookaheadPolicy, SampledPolicy, SontagPolicy
from tests.marks import sample
from tests.problems import Formula, problem_of


def draw(system, *batch):
    return torch.rand(batch), torch.randn(*batch, system.n)


def lie(V, system, cost, t, x):
    """V_t, LfV, LgV, q and σ = LgV R⁻¹ LgVᵀ."""
    V_t, V_x = gradients(V, t, x)
    LfV = torch.einsum("bn,bn->b", V_x, system.f(x))
    LgV = torch.einsum("bn,bnm->bm", V_x, system.g(x))
    return V_t, LfV, LgV, cost.state(x), torch.einsum("bi,bij,bj->b", LgV, torch.linalg.inv(cost.R(x)), LgV)


def minimises_the_hamiltonian(u, system, cost, V, t, x):
    """No perturbation of u, small or large, lowers H(x, u, V_x) = ℓ(x, u) + V_xᵀ(f + gu)."""
    V_x = gradients(V, t, x)[1].detach()

    def hamiltonian(u):
        states = x.expand(*u.shape[:-1], system.n)
        return cost.running(states, u) + (V_x * system.dynamics(states, u)).sum(-1)

    sizes = torch.logspace(-4, 1, 200)[:, None, None]
    assert (hamiltonian(u + sizes * torch.randn(200, *u.shape)) - hamiltonian(u) > -1e-12).all()


def test_hjb_policy_minimises_the_hamiltonian(system, cost, V):
    t, x = draw(system, 8)
    u = HJBPolicy(problem_of(system, cost), V)(t, x).detach()
    minimises_the_hamiltonian(u, system, cost, V, t, x)
    for wrong in (0.99 * u, -u, u + 1e-2):
        with pytest.raises(AssertionError):
            minimises_the_hamiltonian(wrong, system, cost, V, t, x)


@pytest.mark.parametrize("policy", POLICIES.values(), ids=POLICIES)
def test_control_comes_with_its_value_function(policy, system, cost, V):
    t, x = draw(system, 8)
    law = policy(problem_of(system, cost), V)
    expected = law(t, x), V(t, x), gradients(V, t, x)[1]
    for value, wanted, other in zip(law.with_value(t, x), expected, law.with_value(t + 0.1, x), strict=True):
        assert_close(value, wanted)
        assert not torch.allclose(other, wanted)


def test_under_the_hjb_policy_the_hjb_residual_has_its_closed_form(system, cost, V):
    """V̇ + ℓ = V_t + V_xᵀf + q − ¼ V_xᵀg R⁻¹ gᵀV_x."""
    t, x = draw(system, 50)
    policy = HJBPolicy(problem_of(system, cost), V)
    V_t, LfV, _, q, sigma = lie(V, system, cost, t, x)
    expected = V_t + LfV + q - sigma / 4
    assert_close(time_derivative(V, system, t, x, policy(t, x)) + cost.running(x, policy(t, x)), expected)

    def scaled(t, x):
        return 1.2 * policy(t, x)

    residual = time_derivative(V, system, t, x, scaled(t, x)) + cost.running(x, scaled(t, x))
    assert (residual >= expected).all()
    assert not torch.allclose(residual, expected)


def test_under_sontags_formula_every_V_falls_at_its_rate(system, cost, V):
    """V̇ = −√(a² + qσ), with a = V_t + LfV; the HJB policy of the same V lets it rise somewhere."""
    t, x = draw(system, 200)
    V_t, LfV, LgV, q, sigma = lie(V, system, cost, t, x)
    assert (LgV.abs().amax(-1) > 0).all()
    sontag, hjb = (policy(problem_of(system, cost), V) for policy in (SontagPolicy, HJBPolicy))
    Vdot = time_derivative(V, system, t, x, sontag(t, x))
    assert_close(Vdot, -torch.sqrt((V_t + LfV) ** 2 + q * sigma))
    assert (Vdot < 0).all()
    assert (time_derivative(V, system, t, x, hjb(t, x)) > 0).any()


LINEAR = {
    "double integrator": (DoubleIntegrator, [[1.0]]),
    "unstable, two controls": (
        lambda: Linear([[0.5, 1.0, 0.0], [0.0, -0.2, 1.0], [1.0, 0.0, 0.3]], [[0.0, 1.0], [0.2, 0.0], [1.0, 0.3]]),
        [[1.0, 0.3], [0.3, 2.0]],
    ),
}


@pytest.mark.parametrize(("build", "R"), LINEAR.values(), ids=LINEAR)
def test_with_the_riccati_solution_both_policies_are_the_linear_regulator(build, R, quadratic):
    system = build()
    cost = QuadraticCost(torch.diag(torch.linspace(1, 2, system.n)), R, torch.eye(system.n))
    A, B = system.A.numpy(), system.B.numpy()
    P = torch.from_numpy(solve_continuous_are(A, B, cost.Q.numpy(), R))
    K = torch.linalg.solve(torch.tensor(R), system.B.mT @ P)
    t, x = draw(system, 50)

    def controls(P):
        return [policy(problem_of(system, cost), quadratic(P))(t, x) for policy in (HJBPolicy, SontagPolicy)]

    for u in controls(P):
        assert_close(u, -x @ K.mT)
    hjb, sontag = controls(1.2 * P)
    assert_close(hjb, -1.2 * x @ K.mT)
    assert not torch.allclose(sontag, hjb, rtol=1e-2)


# At and near the goal


def anchored(system):
    scaling = Scaling([1.0] * system.n, duration=1.0, value=3.0)
    return GoalAnchor(PartiallyConvexNetwork(scaling, hidden=(8, 8)))


class UnguardedSontag(SontagPolicy):
    """The formula as printed."""

    def forward(self, t, x):
        V_t, LfV, LgV, q, sigma = lie(self.V, self.system, self.cost, t, x)
        a = V_t + LfV
        return -((a + torch.sqrt(a**2 + q * sigma)) / sigma)[:, None] * self.cost.solve_R(x, LgV)


def is_finite_at_the_goal(policy, system):
    """The control and all its derivatives, at the goal and where only some states vanish."""
    t = torch.full((4,), 0.3)
    x = torch.cat([torch.zeros(2, system.n), torch.eye(system.n)[:1], -torch.eye(system.n)[-1:]]).requires_grad_()
    u = policy(t, x)
    slopes = torch.autograd.grad(u.sum(), [x, *policy.parameters()], materialize_grads=True, allow_unused=True)
    for value in (u, *slopes):
        assert torch.isfinite(value).all()


@pytest.mark.parametrize("policy", POLICIES.values(), ids=POLICIES)
def test_control_and_its_gradients_are_finite_at_the_goal(policy, system, cost, V):
    for value in (V, anchored(system)):
        is_finite_at_the_goal(policy(problem_of(system, cost), value), system)


def test_the_formula_as_printed_is_not_finite_at_the_goal(system, cost):
    if bool(system.f(torch.zeros(system.n)).any()):
        return  # the goal is no equilibrium, and the formula does not vanish there
    with pytest.raises(AssertionError):
        is_finite_at_the_goal(UnguardedSontag(problem_of(system, cost), anchored(system)), system)


def vanishes_with_the_state(policy, t, x):
    """‖u(t, sx)‖ ≤ c s for every s down to the fourth root of the smallest number (u has fourth powers of s inside)."""
    near = policy(t, 1e-2 * x).abs().max() / 1e-2
    for s in torch.logspace(-2, math.log10(torch.finfo(x.dtype).tiny) / 4, 60, dtype=x.dtype):
        assert policy(t, s * x).abs().max() <= 10 * s * near


@pytest.mark.parametrize("policy", sample(POLICIES.values(), 2), ids=POLICIES)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
def test_control_vanishes_with_the_state(policy, dtype, system, cost, V):
    if bool(system.f(torch.zeros(system.n)).any()):
        pytest.skip("a control holds the origin, which does not vanish there")
    smooth = Formula(lambda t, x: (2 + torch.sin(3 * t)) * ((x**2).sum(-1) + (x**4).sum(-1)))
    sloped = Formula(lambda t, x: V(t, x) + 100 * t)
    t, x = (v.to(dtype) for v in draw(system, 64))
    vanishes_with_the_state(policy(problem_of(system, cost), smooth).to(dtype), t, x)
    with pytest.raises(AssertionError):
        vanishes_with_the_state(policy(problem_of(system, cost), sloped).to(dtype), t, x)


def test_sontag_does_nothing_where_V_falls_by_itself_and_nothing_is_asked(system, V):
    """With q = 0: u = 0 where a ≤ 0, and u ≠ 0 where a > 0."""
    t, x = draw(system, 20)
    free = QuadraticCost(torch.zeros(system.n, system.n), torch.eye(system.m), torch.eye(system.n))
    tilted = [Formula(lambda t, x, c=c: V(t, x) + c * t) for c in (-100, 100)]
    falling, rising = (SontagPolicy(problem_of(system, free), value) for value in tilted)
    assert (falling(t, x) == 0).all()
    assert (rising(t, x) != 0).all()


# Sets of controls


class Small(ControlSet):
    """|u_i| ≤ 0.1, for R = 1."""

    def minimise(self, R, b):
        return self.project(-b / 2)

    def contains(self, u):
        return (u.abs() <= 0.1).all(-1)

    def project(self, u):
        return u.clamp(-0.1, 0.1)


def test_the_hjb_policy_keeps_within_the_control_set():
    """It minimises the Hamiltonian over U: no admitted control is better; and the law without limits leaves U."""
    system = DoubleIntegrator()
    cost, V = QuadraticCost(torch.eye(2), [[1.0]], torch.eye(2)), Formula(lambda t, x: (x**2).sum(-1))
    t, x = draw(system, 30)
    limited, free = (HJBPolicy(problem_of(system, cost, controls=c), V) for c in (Small(), None))
    V_x = gradients(V, t, x)[1]

    def hamiltonian(u):
        return cost.running(x, u) + (V_x * system.dynamics(x, u)).sum(-1)

    u = limited(t, x)
    assert Small().contains(u).all()
    assert not Small().contains(free(t, x)).all()
    for other in torch.linspace(-0.1, 0.1, 21):
        assert (hamiltonian(u) <= hamiltonian(other.expand(30, 1)) + 1e-12).all()
    assert_close(u, Small().project(free(t, x)))
    assert_close(limited.with_value(t, x).u, u)


def test_the_sampled_law_within_limits_is_the_best_held_control():
    """Of one step by brute force, at states where V is quadratic; two controls, with a coupled R."""
    system = Linear([[0.0, 1.0], [-1.0, 0.3]], [[1.0, 0.2], [0.0, 1.0]])
    cost = QuadraticCost(torch.eye(2), [[1.0, 0.4], [0.4, 0.5]], torch.eye(2))
    P = torch.tensor([[3.0, 1.0], [1.0, 2.0]])
    problem = problem_of(system, cost, dt=0.3, controls=ControlBox([-0.2, -0.1], [0.3, 0.1]))

    class Known(Formula):
        def curvature(self, t):
            return 2 * P

    policy = SampledPolicy(problem, Known(lambda t, x: ((x @ P) * x).sum(-1)))
    x = torch.randn(20, 2)
    u = policy(torch.tensor(0.0), x)
    grid = torch.cartesian_prod(torch.linspace(-0.2, 0.3, 51), torch.linspace(-0.1, 0.1, 21))

    def paid(u):
        after = x[:, None] + 0.3 * (x[:, None] @ system.A.mT + u @ system.B.mT)
        return 0.3 * ((u @ cost.R(x[0])) * u).sum(-1) + ((after @ P) * after).sum(-1)

    assert problem.controls.contains(u).all()
    assert (paid(u[:, None])[:, 0] <= paid(grid[None]).amin(1) + 1e-12).all()
    assert (paid(0.9 * u[:, None])[:, 0] > paid(u[:, None])[:, 0]).all(), "another control costs more"


def steep(t, x):
    """A wall: no quadratic that is the same for all states is close to it."""
    return (x**2).sum(-1) + 5 * torch.relu(x[..., 0] + x[..., 1] - 0.5) ** 3


@pytest.fixture(params=[None, ControlBox([-3.0], [1.0])], ids=["free", "limited"])
def held(request):
    """A problem of one control, and Q(u) of one held step from some states by its definition."""
    problem = problem_of(DoubleIntegrator(), dt=0.3, controls=request.param)

    def paid(x, u):
        return 0.3 * (u**2).sum(-1) + steep(None, x + 0.3 * problem.system.dynamics(x, u))

    return problem, paid


def test_the_lookahead_law_is_the_best_held_control_where_V_is_steep(held):
    problem, paid = held
    x, V, t = torch.rand(200, 2) - 0.5, Formula(steep), torch.tensor(0.0)
    grid = torch.linspace(-12, 12, 24_001)
    grid = grid[problem.controls.contains(grid[:, None])]
    least = paid(x[:, None].expand(-1, len(grid), -1), grid[:, None].expand(200, -1, 1)).amin(1)
    excess = {law: paid(x, POLICIES[law](problem, V)(t, x).detach()) - least for law in ("lookahead", "sampled")}
    assert float(excess["lookahead"].max()) < 1e-4
    assert float(excess["sampled"].max()) > 0.5
    assert problem.controls.contains(POLICIES["lookahead"](problem, V)(t, x)).all()


@pytest.mark.gate
def test_the_lookahead_law_of_two_limited_controls_is_the_best_of_a_grid():
    """With a coupled R, and a V that is not convex: where Q is not, the law still lowers what the sampled one pays."""
    system = Linear([[0.0, 1.0], [-1.0, 0.3]], [[1.0, 0.2], [0.0, 1.0]])
    cost = QuadraticCost(torch.eye(2), [[1.0, 0.4], [0.4, 0.5]], torch.eye(2))
    problem = problem_of(system, cost, dt=0.3, controls=ControlBox([-2.0, -1.0], [3.0, 1.0]))
    x, t = torch.rand(100, 2) - 0.5, torch.tensor(0.0)
    grid = torch.cartesian_prod(torch.linspace(-2, 3, 251), torch.linspace(-1, 1, 101))

    def paid(V, u):
        states = x[:, None].expand(-1, u.shape[1], -1)
        after = states + 0.3 * system.dynamics(states, u)
        return 0.3 * cost.control(states, u) + V(t, after)

    for value, tolerance in ((steep, 1e-3), (lambda t, x: steep(t, x) + 0.5 * torch.cos(4 * x).sum(-1), 0.05)):
        V = Formula(value)
        u = {law: POLICIES[law](problem, V)(t, x).detach() for law in ("lookahead", "sampled")}
        least = paid(V, grid.expand(100, -1, -1)).amin(1)
        ahead, sampled = (paid(V, u[law][:, None])[:, 0] for law in ("lookahead", "sampled"))
        assert (ahead <= sampled + 1e-12).all()
        assert float((ahead - least).mean()) < tolerance < float((sampled - least).mean())
        assert problem.controls.contains(u["lookahead"]).all()


@pytest.mark.parametrize("value", [lambda t, x: x.sum(-1), lambda t, x: 0 * t + torch.ones_like(x[..., 0])])
def test_the_lookahead_law_of_a_V_without_curvature(value):
    problem, x = problem_of(DoubleIntegrator(), dt=0.3), torch.randn(5, 2)
    V = Formula(lambda t, x: value(t, x) + 0 * x.sum(-1))
    u = LookaheadPolicy(problem, V)(torch.tensor(0.0), x).detach()
    slope = torch.autograd.functional.jacobian(lambda y: value(torch.tensor(0.0), y).sum() + 0 * y.sum(), x)
    assert_close(u, -0.5 * slope[:, 1:], rtol=0, atol=1e-9)


def test_the_derivative_of_the_lookahead_law_is_that_of_the_minimiser(held):
    problem, paid = held
    x, h = torch.rand(50, 2) - 0.5, 1e-6
    law = LookaheadPolicy(problem, Formula(steep))
    states = x.clone().requires_grad_()
    u = law(torch.tensor(0.0), states)
    slope = torch.autograd.grad(u.sum(), states)[0]

    def minimiser(x):
        """By bisection of Q_u, which rises."""
        least, most = (torch.full((len(x), 1), each) for each in (-30.0, 30.0))
        for _ in range(60):
            middle = ((least + most) / 2).requires_grad_()
            rising = torch.autograd.grad(paid(x, middle).sum(), middle)[0] > 0
            least, most = torch.where(rising, least, middle).detach(), torch.where(rising, middle, most).detach()
        return problem.controls.project(most)

    exact = torch.stack([(minimiser(x + h * e) - minimiser(x - h * e))[:, 0] / (2 * h) for e in torch.eye(2)], -1)
    smooth = ((x + 0.3 * problem.system.dynamics(x, u.detach())).sum(-1) - 0.5).abs() > 1e-3
    assert_close(u.detach(), minimiser(x), rtol=0, atol=5e-3)
    assert_close(slope[smooth], exact[smooth], rtol=0.02, atol=1e-3)
    assert float(exact.abs().max()) > 1


def test_with_a_quadratic_V_the_lookahead_law_is_the_sampled_one():
    """About a target too, whose control is not zero; two controls with a coupled R."""
    system = Linear([[0.0, 1.0], [-1.0, 0.3]], [[1.0, 0.2], [0.0, 1.0]])
    cost = QuadraticCost(torch.eye(2), [[1.0, 0.4], [0.4, 0.5]], torch.eye(2))
    P = torch.tensor([[3.0, 1.0], [1.0, 2.0]])

    class Known(Formula):
        def curvature(self, t):
            return 2 * P

    for about in (cost, TargetCost(cost, [0.5, 0.2], [0.3, -0.1])):
        goal = problem_of(system, about).goal
        V = Known(lambda t, x, goal=goal: ((x - goal) @ P * (x - goal)).sum(-1) + 0.7 * (x - goal).sum(-1))
        problem = problem_of(system, about, dt=0.3)
        t, x = torch.tensor(0.1), torch.randn(20, 2)
        assert_close(LookaheadPolicy(problem, V)(t, x), SampledPolicy(problem, V)(t, x))
        assert not torch.allclose(LookaheadPolicy(problem, V)(t, x), HJBPolicy(problem, V)(t, x), rtol=1e-2)


def test_sontags_formula_is_refused_where_controls_are_limited(V):
    system = DoubleIntegrator()
    SontagPolicy(problem_of(system), V)
    with pytest.raises(ValueError, match="Expected controls without limits for Sontag's formula, got Small"):
        SontagPolicy(problem_of(system, controls=Small()), V)
