"""The programs' terms against numbers by hand, exact cost-to-go, and the bound they promise."""

import math
from functools import partial
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn
from torch.testing import assert_close

from lyapnet.base.errors import DivergenceError, UsageError
from lyapnet.loop.programs import PROGRAMS, LyapunovProgram, Tolerances, ValueProgram
from lyapnet.loop.programs.terms import (
    MIN_COST_SHARE,
    cost_to_go_error,
    hinge,
    residual,
    satisfied,
    terminal_hinge,
    terminal_residual,
    value_floored,
    violation,
)
from lyapnet.loop.programs.value import lost
from lyapnet.loop.rollout import Rollout, Trajectory
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.horizon import Horizon
from lyapnet.task.systems import DoubleIntegrator
from lyapnet.value.policy import HJBPolicy
from tests.problems import problem_of

TERMS = ("constraint", "terminal", "trajectory_cost")
programs = pytest.mark.parametrize("program", PROGRAMS.values(), ids=PROGRAMS)

# Two trajectories of three steps: V at the nodes, the cost of each step, the cost at the end.
VALUES = torch.tensor([[10.0, 4.0], [7.0, 4.0], [5.0, 1.0], [1.0, 1.0]])
STEP_COST = torch.tensor([[2.0, 1.0], [3.0, 2.0], [4.0, 0.0]])
TERMINAL_COST = torch.tensor([1.5, 0.25])
VIOLATION = torch.tensor([[-1.0, 1.0], [1.0, -1.0], [0.0, 0.0]])


def test_terms_by_hand():
    assert_close(violation(VALUES, STEP_COST), VIOLATION)
    assert residual(VALUES, STEP_COST).tolist() == [2.0, 2.0]
    assert hinge(VALUES, STEP_COST).tolist() == [1.0, 1.0]
    assert terminal_residual(VALUES, TERMINAL_COST).tolist() == [0.25, 0.5625]
    assert terminal_hinge(VALUES, TERMINAL_COST).tolist() == [0.5, 0.0]
    # V_n − J_n = (−0.5, −1.5, −0.5, −0.5) and (0.75, 1.75, 0.75, 0.75)
    assert cost_to_go_error(VALUES, STEP_COST, TERMINAL_COST).tolist() == [0.75, 1.1875]


@given(st.lists(st.tuples(st.floats(-9, 9), st.floats(0, 9)), min_size=2, max_size=6), st.floats(0, 9))
def test_distance_from_the_cost_to_go_is_the_violations_summed_up(nodes, terminal_cost):
    """V_n − J_n = V_N − φ − Σ_{k≥n} violation_k, for any numbers."""
    value, step_cost = torch.tensor(nodes).T.unsqueeze(-1)
    terminal_cost = torch.tensor([terminal_cost])
    later = violation(value, step_cost[:-1]).flip(0).cumsum(0).flip(0)
    error = value[-1] - terminal_cost - torch.cat([later, torch.zeros(1, 1)])
    assert_close(cost_to_go_error(value, step_cost[:-1], terminal_cost), (error**2).mean(0))


def test_margin_asks_for_that_share_of_the_step_cost_more():
    assert_close(violation(VALUES, STEP_COST, 0.5), VIOLATION + 0.5 * STEP_COST)
    assert hinge(VALUES, STEP_COST, 0.5).tolist() == [0.0 + 2.5 + 2.0, 1.5 + 0.0 + 0.0]


def trajectory_of(value=VALUES, step_cost=STEP_COST, terminal_cost=TERMINAL_COST):
    """A trajectory with these V and costs; its states and controls play no part in the terms."""
    steps, *batch = step_cost.shape
    running_cost = torch.cat([torch.zeros(1, *batch), step_cost.cumsum(0)])
    x, u = torch.arange((steps + 1.0) * math.prod(batch)).reshape(steps + 1, *batch, 1), torch.zeros(steps, *batch, 1)
    return Trajectory(torch.arange(steps + 1.0), x, u, running_cost, terminal_cost, value)


@pytest.mark.parametrize(
    ("program", "constraint", "terminal"),
    [(ValueProgram(), 2.0, 0.40625), (LyapunovProgram(), 1.0, 0.25), (LyapunovProgram(margin=0.5), 3.0, 0.25)],
    ids=["value", "lyapunov", "lyapunov with margin"],
)
def test_programs_by_hand(program, constraint, terminal):
    """Without normalisation each term is the mean over the batch; the constraint loss never has weight or margin."""
    J = (10.5 + 3.25) / 2
    weighted = type(program)(**vars(program) | dict(zip(TERMS, (2.0, 3.0, 5.0), strict=True)) | {"normalise": False})
    output = weighted(trajectory_of())
    assert [float(output.terms[name]) for name in TERMS] == [constraint, terminal, J]
    assert output.loss == 2 * constraint + 3 * terminal + 5 * J
    assert output.constraint_loss == (2.0 if isinstance(program, ValueProgram) else 1.0)
    assert output.trajectory_cost == J


@pytest.mark.parametrize(("normalise", "unit"), [(False, 1.0), (True, (10.5 + 3.25) / 2)])
def test_bound_by_hand(normalise, unit):
    """The mean of V(0, x₀), weighted; the value program, whose V is no bound, has no such term."""
    without, weighted = (LyapunovProgram(bound=b, normalise=normalise)(trajectory_of()) for b in (0.0, 0.5))
    bound = (10.0 + 4.0) / 2 / unit
    assert weighted.terms["bound"].item() == pytest.approx(bound)
    assert (weighted.loss - without.loss).item() == pytest.approx(0.5 * bound)
    assert "bound" not in ValueProgram()(trajectory_of()).terms


@programs
def test_the_papers_program_is_the_mean_sum_alone(program):
    output = program(constraint=1.0, normalise=False)(trajectory_of())
    assert output.loss == output.constraint_loss == output.terms["constraint"]


def test_value_program_weighs_the_distance_from_the_cost_to_go():
    """With its weight in the loss, without it in the record alone."""
    for weight in (0.0, 3.0):
        output = ValueProgram(2.0, cost_to_go=weight, normalise=False)(trajectory_of())
        assert output.terms["cost_to_go"] == (0.75 + 1.1875) / 2
        assert output.loss == 2 * 2.0 + weight * output.terms["cost_to_go"]
    assert "cost_to_go" not in LyapunovProgram()(trajectory_of()).terms


def test_a_relative_distance_counts_against_the_cost_of_its_own_trajectory():
    """The costs are 10.5 and 3.25; of one that costs next to nothing, a share of their mean."""
    relative = ValueProgram(relative=True)
    assert_close(relative(trajectory_of()).terms["cost_to_go"], torch.tensor(0.75 / 10.5**2 + 1.1875 / 3.25**2) / 2)
    assert_close(ValueProgram()(trajectory_of()).terms["cost_to_go"], torch.tensor((0.75 + 1.1875) / 2 / 6.875**2))
    shares = torch.tensor([1.0, 1e-6])
    little = relative(trajectory_of(VALUES * shares + 0.1, STEP_COST * shares, TERMINAL_COST * shares))
    expected = cost_to_go_error(VALUES * shares + 0.1, STEP_COST * shares, TERMINAL_COST * shares)
    mean = (10.5 + 3.25e-6) / 2
    assert_close(little.terms["cost_to_go"], (expected / torch.tensor([10.5, 0.05 * mean]) ** 2).mean())
    for name in ("constraint", "terminal"):
        assert_close(relative(trajectory_of()).terms[name], ValueProgram()(trajectory_of()).terms[name])
    absolute = ValueProgram(relative=True, normalise=False)(trajectory_of())
    assert absolute.terms["cost_to_go"] == (0.75 + 1.1875) / 2


def test_a_lost_trajectory_does_not_teach_V_what_it_costs():
    """Its cost is no guess of the optimum: V is held against what the others still pay."""
    shares = torch.tensor([1.0, 1.1, 0.9, 1.0, 1.0])
    value = (torch.tensor([10.0, 7.0, 5.0, 1.0])[:, None] * shares).requires_grad_()
    step_cost, terminal_cost = torch.tensor([3.0, 2.0, 4.0])[:, None] * shares, shares.clone()
    terminal_cost[4] = 60.0
    trajectory, program = trajectory_of(value, step_cost, terminal_cost), ValueProgram(0, cost_to_go=1, relative=True)
    (slope,) = torch.autograd.grad(program(trajectory).loss, value)
    assert not slope[:, 4].any()
    error, cost = cost_to_go_error(value, step_cost, terminal_cost), trajectory.cost
    assert_close(program(trajectory).loss, (error / cost**2).mean(), msg="it counts all the same")
    (pulled,) = torch.autograd.grad(ValueProgram(0, cost_to_go=1)(trajectory).loss, value)
    assert (pulled[:, 4] < 0).all(), "without `relative` it is"
    low = (0.1 * value.detach()).requires_grad_()
    (slope,) = torch.autograd.grad(program(trajectory_of(low, step_cost, terminal_cost)).loss, low)
    assert (slope[:, :4] < 0).all(), "a V that is too low everywhere finds none of them lost"


@programs
@pytest.mark.parametrize("name", TERMS)
def test_a_weight_of_zero_leaves_a_term_out(program, name):
    """Out of the loss, though not out of the record."""
    weights = dict.fromkeys(TERMS, 2.0) | {name: 0.0}
    output = program(**weights)(trajectory_of())
    assert_close(output.loss, sum(2.0 * output.terms[other] for other in TERMS if other != name))
    assert output.terms[name] != 0


# Normalisation


def slopes(program, rollout, x0):
    loss = program(rollout(x0)).loss
    return torch.cat([g.flatten() for g in torch.autograd.grad(loss, list(rollout.parameters()))])


@pytest.fixture
def loop(quadratic):
    """The double integrator under the HJB policy of V = xᵀPx, with a P that is not optimal."""
    problem = problem_of(DoubleIntegrator(), steps=5, dt=0.1)
    policy = HJBPolicy(problem, quadratic([[2.0, 0.5], [0.5, 1.0]]))
    return Rollout(problem, policy, gradient="backprop"), torch.randn(8, 2)


@programs
def test_normalised_gradients_are_relative_to_the_mean_cost(program, loop):
    """log J̄ has the gradient ∇J̄/J̄; C and B are divided by a J̄ that takes no part in the gradient."""
    rollout, x0 = loop
    J, N = rollout(x0).cost.mean().item(), rollout.horizon.steps
    value = program is ValueProgram
    factors = (N / J**2, 1 / J**2, 1 / J) if value else (1 / J, 1 / J, 1 / J)
    for name, factor in [*zip(TERMS, factors, strict=True), *([("cost_to_go", 1 / J**2)] if value else [])]:
        alone = partial(program, **dict.fromkeys(TERMS, 0.0) | {name: 1.0})
        plain, normalised = (slopes(alone(normalise=on), rollout, x0) for on in (False, True))
        assert plain.norm() > 1e-3
        assert_close(normalised, factor * plain)
        assert not torch.allclose(normalised, plain, rtol=1e-3)


@programs
def test_normalised_terms_have_no_unit_of_cost(program):
    def terms(unit, normalise):
        trajectory = trajectory_of(unit * VALUES, unit * STEP_COST, unit * TERMINAL_COST)
        output = program(1.0, 1.0, normalise=normalise)(trajectory)
        return torch.stack([term for name, term in output.terms.items() if name != "trajectory_cost"])

    assert_close(terms(7.0, normalise=True), terms(1.0, normalise=True))
    assert not torch.allclose(terms(7.0, normalise=False), terms(1.0, normalise=False))


def test_normalised_residual_is_a_mean_over_time():
    """Refining the grid of the same V and ℓ leaves the value program's normalised residual where it is."""

    def term(steps, normalise):
        t = torch.linspace(0, 1, steps + 1)
        trajectory = trajectory_of((2 - t)[:, None], torch.full((steps, 1), 1.5 / steps), torch.ones(1))
        return ValueProgram(normalise=normalise)(trajectory).terms["constraint"]

    assert_close(term(10, normalise=True), term(40, normalise=True))
    assert_close(term(10, normalise=False), 4 * term(40, normalise=False))


# Exact cost-to-go of a fixed linear policy


class LinearFeedback(nn.Module):
    """u = −Kx."""

    def __init__(self, K):
        super().__init__()
        self.K = K

    def forward(self, t, x):
        return -x @ self.K.mT


@pytest.fixture
def cost_to_go(quadratic):
    """The double integrator under u = −Kx, and P_n by the discrete Lyapunov equation
    P_n = Δt(Q + KᵀRK) + FᵀP_{n+1}F, P_N = Q_T, with F = I + Δt(A − BK)."""
    system, horizon = DoubleIntegrator(mass=2.0), Horizon(30, 0.05)
    cost = QuadraticCost([[3.0, 0.5], [0.5, 1.0]], [[0.7]], [[2.0, 0.0], [0.0, 4.0]])
    K = torch.tensor([[1.0, 2.0]])
    F = torch.eye(2) + horizon.dt * (system.A - system.B @ K)
    P = [cost.Q_T]
    for _ in range(horizon.steps):
        P.insert(0, horizon.dt * (cost.Q + K.mT @ torch.tensor([[0.7]]) @ K) + F.mT @ P[0] @ F)
    trajectory = Rollout(problem_of(system, cost, horizon.steps, horizon.dt), LinearFeedback(K))(torch.randn(6, 2))
    return SimpleNamespace(V=lambda scale=1.0: quadratic(scale * torch.stack(P), horizon.dt), trajectory=trajectory)


def losses(program, V, trajectory):
    """What V is off by: every term but the two that are costs themselves."""
    values = V(trajectory.t[:, None], trajectory.x)
    output = program(1.0, 1.0, normalise=False)(trajectory._replace(value=values))
    return tuple(term.item() for name, term in output.terms.items() if name not in ("trajectory_cost", "bound"))


@programs
def test_the_exact_cost_to_go_leaves_nothing(program, cost_to_go):
    V, trajectory = cost_to_go.V(), cost_to_go.trajectory
    assert_close(V(trajectory.t[0], trajectory.x[0]), trajectory.cost)
    assert max(losses(program, V, trajectory)) < 1e-12


def test_any_other_V_leaves_a_residual(cost_to_go):
    for scale in (0.9, 1.1):
        assert min(losses(ValueProgram, cost_to_go.V(scale), cost_to_go.trajectory)) > 1e-3


def test_the_hinge_bounds_the_cost_from_above(cost_to_go):
    """Zero for a V that is too large, which bounds J_N; positive for one that is too small, which does not."""
    trajectory = cost_to_go.trajectory
    large, small = cost_to_go.V(1.1), cost_to_go.V(0.9)
    assert losses(LyapunovProgram, large, trajectory) == (0, 0)
    assert (trajectory.cost <= large(trajectory.t[0], trajectory.x[0])).all()
    assert min(losses(LyapunovProgram, small, trajectory)) > 1e-3
    assert (trajectory.cost > small(trajectory.t[0], trajectory.x[0])).all()


def test_with_the_bound_no_V_is_better_than_the_cost_to_go(cost_to_go):
    """Above it the bound costs more; below it the hinges do, unless they weigh less. Without it any larger V does."""

    def loss(scale, **weights):
        V, trajectory = cost_to_go.V(scale), cost_to_go.trajectory
        values = V(trajectory.t[:, None], trajectory.x)
        return LyapunovProgram(**weights, normalise=False)(trajectory._replace(value=values)).loss.item()

    exact, large, small = (loss(scale, constraint=1.0, terminal=1.0, bound=0.5) for scale in (1.0, 1.1, 0.9))
    assert exact == pytest.approx(0.5 * cost_to_go.trajectory.cost.mean().item())
    assert min(large, small) > exact + 1e-3
    assert loss(1.1, constraint=1.0, terminal=1.0) == pytest.approx(loss(1.0, constraint=1.0, terminal=1.0), abs=1e-12)
    assert loss(0.9, constraint=0.51, terminal=0.1, bound=0.5) < exact - 1e-3


NUMBERS = st.floats(-1e3, 1e3)


@given(
    st.integers(1, 6).flatmap(lambda n: st.tuples(*(st.lists(NUMBERS, min_size=k, max_size=k) for k in (n + 1, n, 1))))
)
def test_cost_is_at_most_V_plus_both_hinges(numbers):
    """J_N ≤ V(0, x₀) + hinge + terminal hinge, for any numbers: the sum telescopes."""
    values, step_cost, terminal_cost = (torch.tensor(v)[:, None] for v in numbers)
    J = step_cost.sum(0) + terminal_cost[0]
    slack = hinge(values, step_cost) + terminal_hinge(values, terminal_cost[0])
    assert (values[0] + slack >= J - 1e-9).all()


# Shapes, and what is refused


@programs
@pytest.mark.parametrize("batch", [(), (4,), (2, 3)], ids=str)
def test_any_batch(program, batch):
    trajectory = trajectory_of(torch.rand(4, *batch), torch.rand(3, *batch), torch.rand(batch))
    output = program(1.0, 1.0, 1.0)(trajectory)
    assert output.loss.shape == output.constraint_loss.shape == output.trajectory_cost.shape == ()
    assert_close(output.trajectory_cost, trajectory.cost.mean())


@programs
@pytest.mark.parametrize(
    "weights",
    [*({name: value} for name in TERMS for value in (-1.0, math.nan)), dict.fromkeys(TERMS, 0.0)],
    ids=str,
)
def test_weights_without_meaning_are_refused(program, weights):
    with pytest.raises(ValueError, match="Expected"):
        program(**weights)
    program(**dict.fromkeys(weights, 1.0))


@pytest.mark.parametrize("weight", [-1.0, math.nan])
def test_a_weight_of_the_cost_to_go_without_meaning_is_refused(weight):
    with pytest.raises(ValueError, match="Expected weight cost_to_go ≥ 0"):
        ValueProgram(cost_to_go=weight)
    ValueProgram(constraint=0.0, cost_to_go=1.0)


@pytest.mark.parametrize("margin", [-0.1, math.nan])
def test_a_negative_margin_is_refused(margin):
    with pytest.raises(ValueError, match="Expected margin ≥ 0"):
        LyapunovProgram(margin=margin)


@pytest.mark.parametrize("bound", [-0.1, math.nan, 1.0, 2.0])
def test_a_bound_that_outweighs_the_hinge_is_refused(bound):
    with pytest.raises(ValueError, match=r"Expected (weight )?bound"):
        LyapunovProgram(constraint=1.0, bound=bound)
    LyapunovProgram(constraint=1.0, bound=0.99)


@programs
@pytest.mark.parametrize("batch", [(2,), ()], ids=str)
def test_a_term_that_is_not_finite_names_itself_and_the_initial_state(program, batch):
    last = (slice(None), *(-1 for _ in batch))
    values = torch.ones(4, *batch)
    values[last][1] = math.inf
    values.requires_grad_()
    with pytest.raises(DivergenceError, match=rf"term constraint from x0 = \[{float(len(batch)):.1f}\]"):
        program()(trajectory_of(values, torch.ones(3, *batch), torch.ones(batch)))


@programs
def test_a_control_law_without_V_has_no_program(program, cost_to_go):
    assert cost_to_go.trajectory.value is None
    with pytest.raises(ValueError, match="Expected a trajectory under the control law of a V, got another law"):
        program()(cost_to_go.trajectory)


def test_the_goal_satisfies_the_condition_in_spite_of_rounding():
    value = torch.tensor([0.0, 5.0, 5.0])
    summed = torch.tensor([1e-33, 0.05, 0.0501])
    assert satisfied(summed, value, 1e-2).tolist() == [True, True, False]
    assert not satisfied(torch.tensor([1e-9, 0.0]), torch.tensor([0.0, 5.0]), 1e-2)[0]


# What a program says of a closed loop away from the batch


def test_excess_and_penalty_by_hand():
    """V̇ + ℓ, or with a margin V̇ + 1.5ℓ, at V̇ = −3, −2, −1 and ℓ = 2."""
    rate, running = torch.tensor([-3.0, -2.0, -1.0]), torch.tensor(2.0)
    value, lyapunov = ValueProgram(), LyapunovProgram(margin=0.5)
    assert value.excess(rate, running).tolist() == [-1, 0, 1]
    assert value.penalty(value.excess(rate, running)).tolist() == [1, 0, 1]
    assert lyapunov.excess(rate, running).tolist() == [0, 1, 2]
    assert lyapunov.penalty(LyapunovProgram().excess(rate, running)).tolist() == [0, 0, 1]


def test_tolerances_of_the_programs():
    """A value function need not fall along its own closed loop; a Lyapunov function must."""
    assert ValueProgram().tolerances() == Tolerances(radius=None, decrease=None, cost=0.05)
    assert LyapunovProgram().tolerances(0.1, 0.0) == Tolerances(radius=0.1, decrease=0.01, cost=0.0)
    assert LyapunovProgram().tolerances() == Tolerances(radius=None, decrease=0.01, cost=0.05)
    assert Tolerances() == Tolerances(radius=None, decrease=0.01, cost=0.0, constraints=False)
    assert ValueProgram().tolerances(0.1).asked == ["terminal", "cost"]
    assert LyapunovProgram().tolerances().asked == ["decrease", "cost"]
    for name in ("radius", "decrease", "cost"):
        with pytest.raises(ValueError, match=f"Expected tolerance {name} ≥ 0, got -1"):
            Tolerances(**{name: -1.0})


def test_a_bound_asks_for_a_terminal_weight_unless_V_ends_as_the_terminal_cost():
    for program in (LyapunovProgram(terminal=1.0, bound=0.5), LyapunovProgram(), ValueProgram()):
        program.check_terminal(exact=False)
    program = LyapunovProgram(terminal=0.5, bound=0.5)
    program.check_terminal(exact=True)
    with pytest.raises(UsageError, match=r"Expected program.terminal > program.bound = 0.5, got 0.5"):
        program.check_terminal(exact=False)


def test_lost_trajectories_cost_far_more_than_V_and_not_merely_much():
    values, cost = torch.tensor([[1.0, 1.0, 100.0], [0.0, 0.0, 0.0]]), torch.tensor([1.0, 3.0, 110.0])
    running = torch.stack([torch.zeros(3), cost])
    path = Trajectory(torch.arange(2.0), torch.zeros(2, 3, 1), torch.zeros(1, 3, 1), running, torch.zeros(3), values)
    assert lost(values, path).tolist() == [False, True, False]


def test_relative_costs_have_no_denominator_near_zero():
    value, cost = torch.tensor([-1.0, 0.0, 3.0]), torch.tensor([1.0, 2.0, 9.0])
    least = 2 * MIN_COST_SHARE
    assert_close(value_floored(value, cost), torch.tensor([least, least, 3.0]))
