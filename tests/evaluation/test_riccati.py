"""Ground truth for linear systems, held against routes that share nothing with the recursions."""

import functools
import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
import scipy.linalg
import torch
from torch import Tensor

from lyapnet.base.errors import OracleError
from lyapnet.evaluation.oracles import (
    RiccatiOracle,
    RiccatiSolution,
    continuous_riccati,
    discrete_riccati,
    optimal_cost,
    oracle_of,
)
from lyapnet.evaluation.oracles.transcription import Transcription
from lyapnet.loop.rollout import Rollout
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.horizon import Horizon
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box
from lyapnet.task.systems import Cartpole, ControlAffineSystem, DoubleIntegrator, Linear, is_linear
from lyapnet.value.policy import HJBPolicy
from tests.problems import Quadratic, problem_of

F64 = torch.float64
Task = tuple[Linear, QuadraticCost]

SECOND_MOMENT = torch.diag(torch.tensor([1 / 3, 0.49 / 3], dtype=F64))  # E x₀x₀ᵀ over X₀ = ±1 × ±0.7


def double_integrator(R: float = 1.0) -> Task:
    weight = [[10.0, 0.0], [0.0, 0.1]]
    return DoubleIntegrator().double(), QuadraticCost(weight, [[R]], weight).double()


def random_linear() -> Task:
    """n = 3, m = 2, unstable in open loop; Q_T unlike Q, R with a coupling."""
    draw = functools.partial(torch.randn, generator=torch.Generator().manual_seed(0), dtype=F64)
    half, terminal_half = draw(3, 3), draw(3, 3)
    Q, Q_T = half @ half.mT + torch.eye(3).to(F64), terminal_half @ terminal_half.mT + torch.eye(3).to(F64)
    R = torch.tensor([[0.5, 0.2], [0.2, 1.0]], dtype=F64)
    return Linear(draw(3, 3), draw(3, 2)).double(), QuadraticCost(Q, R, Q_T).double()


TASKS = pytest.mark.parametrize("task", [double_integrator(), random_linear()], ids=["double_integrator", "random"])
REFERENCE = Horizon(400, 0.01)


def reference_problem(system: ControlAffineSystem, cost: QuadraticCost) -> Problem:
    return problem_of(system, cost, REFERENCE.steps, REFERENCE.dt)


def states(n: int, count: int = 16) -> Tensor:
    return torch.randn(count, n, generator=torch.Generator().manual_seed(1), dtype=F64)


def euler_cost(task: Task, dt: float, x: Tensor, controls: Tensor) -> Tensor:
    """J_N of a control sequence (N, m) from one state, written as TASKS.md writes it."""
    system, cost = task
    J = torch.zeros((), dtype=F64)
    for u in controls:
        J = J + dt * cost.running(x, u)
        x = x + dt * system.dynamics(x, u)
    return J + cost.terminal(x)


def brute_force(task: Task, horizon: Horizon, x: Tensor) -> Tensor:
    """The minimising control sequence (N, m): J is quadratic in all controls at once, so one Newton step is exact."""
    shape = horizon.steps, task[0].m

    def J(controls: Tensor) -> Tensor:
        return euler_cost(task, horizon.dt, x, controls.reshape(shape))

    origin = torch.zeros(math.prod(shape), dtype=F64)
    gradient = torch.autograd.functional.jacobian(J, origin)
    hessian = torch.autograd.functional.hessian(J, origin)
    assert isinstance(gradient, Tensor)
    assert isinstance(hessian, Tensor)
    return -torch.linalg.solve(hessian, gradient).reshape(shape)


def gain_cost(task: Task, horizon: Horizon, K: Tensor, x0: Tensor) -> Tensor:
    """J_N of u_n = −K_n x_n from a batch of states."""
    system, cost = task
    x, J = x0, torch.zeros(len(x0), dtype=F64)
    for gain in K:
        u = -x @ gain.mT
        J = J + horizon.dt * cost.running(x, u)
        x = x + horizon.dt * system.dynamics(x, u)
    return J + cost.terminal(x)


def ode_residual(task: Task, P: Tensor, dt: float) -> float:
    """max |Ṗ + Q + AᵀP + PA − PBR⁻¹BᵀP| relative to |Q|, Ṗ by central differences at the inner nodes."""
    system, cost = task
    A, B, inner = system.A, system.B, P[1:-1]
    assert cost.R_constant is not None
    P_t = (P[2:] - P[:-2]) / (2 * dt)
    residual = P_t + cost.Q + A.mT @ inner + inner @ A - inner @ B @ torch.linalg.inv(cost.R_constant) @ B.mT @ inner
    return float(residual.abs().max() / cost.Q.abs().max())


@TASKS
@pytest.mark.parametrize("step", [0, 5])
def test_discrete_value_and_policy_are_the_brute_force_optimum(task: Task, step: int):
    horizon = Horizon(12, 0.1)
    solution = discrete_riccati(*task, horizon)
    for x in states(task[0].n, 4):
        tail = Horizon(horizon.steps - step, horizon.dt)
        controls = brute_force(task, tail, x)
        J = euler_cost(task, horizon.dt, x, controls)
        torch.testing.assert_close(solution.value(step, x), J, rtol=1e-11, atol=0)
        torch.testing.assert_close(solution.policy(step, x), controls[0], rtol=1e-10, atol=1e-12)
        # twins: other controls cost more, and another node's value is another number
        assert euler_cost(task, horizon.dt, x, controls + 1e-3) > J * (1 + 1e-9)
        assert abs(solution.value(step + 1, x) / J - 1) > 1e-6


@TASKS
def test_rolling_out_the_gains_costs_what_P_says_and_other_gains_cost_more(task: Task):
    solution, x0 = discrete_riccati(*task, REFERENCE), states(task[0].n)
    attained = gain_cost(task, REFERENCE, solution.K, x0)
    torch.testing.assert_close(attained, solution.value(0, x0), rtol=1e-12, atol=0)
    for factor in (0.98, 1.02):
        assert (gain_cost(task, REFERENCE, factor * solution.K, x0) > attained * (1 + 1e-6)).all()


@TASKS
def test_long_horizons_reach_the_algebraic_equations(task: Task):
    system, cost = task
    assert cost.R_constant is not None
    A, B, Q, R = (matrix.numpy() for matrix in (system.A, system.B, cost.Q, cost.R_constant))
    horizon = Horizon(2000, 0.02)
    F, G = np.eye(system.n) + horizon.dt * A, horizon.dt * B
    stationary = {
        discrete_riccati: scipy.linalg.solve_discrete_are(F, G, horizon.dt * Q, horizon.dt * R),
        continuous_riccati: scipy.linalg.solve_continuous_are(A, B, Q, R),
    }
    for solve, P in stationary.items():
        np.testing.assert_allclose(solve(*task, horizon).P[0].numpy(), P, rtol=1e-9, atol=1e-9)
        short = solve(*task, Horizon(10, horizon.dt)).P[0].numpy()  # twin: not yet stationary
        assert np.abs(short - P).max() > 1e-2 * np.abs(P).max()


@TASKS
def test_continuous_P_satisfies_the_Riccati_equation(task: Task):
    residuals = []
    for dt in (1e-3, 5e-4):
        horizon = Horizon(round(1 / dt), dt)
        P = continuous_riccati(*task, horizon).P
        assert torch.equal(P[-1], task[1].Q_T)
        residuals.append(ode_residual(task, P, dt))
        # twins: a shifted P, the P of the discrete recursion, and the right P on a clock 1 % off
        for wrong in (P + 0.01 * torch.eye(task[0].n), discrete_riccati(*task, horizon).P):
            assert ode_residual(task, wrong, dt) > 100 * residuals[-1]
        assert ode_residual(task, P, 1.01 * dt) > 100 * residuals[-1]
    assert residuals[-1] < 2e-4
    assert math.log2(residuals[0] / residuals[1]) == pytest.approx(2, abs=0.05)  # all that is left is the difference


@TASKS
def test_continuous_P_depends_on_no_step_length(task: Task):
    coarse, fine = continuous_riccati(*task, Horizon(4, 10.0)), continuous_riccati(*task, Horizon(4000, 0.01))
    torch.testing.assert_close(coarse.P, fine.P[::1000], rtol=1e-9, atol=1e-9)


def test_hamiltonian_exponential_in_one_piece_is_lost_to_rounding():
    """The twin of the test above: why continuous_riccati restarts from (I, P) instead of using exp(−TH) at once."""
    system, cost = random_linear()
    assert cost.R_constant is not None
    S = system.B @ torch.linalg.solve(cost.R_constant, system.B.mT)
    H = torch.cat([torch.cat([system.A, -S], 1), torch.cat([-cost.Q, -system.A.mT], 1)])
    start = torch.cat([torch.eye(3).to(F64), cost.Q_T])

    def one_piece(T: float) -> Tensor:
        X, Y = (torch.linalg.matrix_exp(-T * H) @ start).split(3)
        return Y @ torch.linalg.pinv(X)

    torch.testing.assert_close(one_piece(0.5), continuous_riccati(system, cost, Horizon(1, 0.5)).P[0])
    assert not torch.allclose(one_piece(40.0), continuous_riccati(system, cost, Horizon(1, 40.0)).P[0], rtol=1e-3)


@TASKS
def test_discrete_P_converges_to_continuous_P_with_order_one(task: Task):
    def errors(limit: RiccatiSolution) -> list[float]:
        steps = (200, 400, 800)
        return [float((discrete_riccati(*task, Horizon(N, 1.0 / N)).P[0] - limit.P[0]).norm()) for N in steps]

    def orders(e: list[float]) -> list[float]:
        return [math.log2(a / b) for a, b in itertools.pairwise(e)]

    horizon = Horizon(10, 0.1)
    assert orders(errors(continuous_riccati(*task, horizon))) == pytest.approx([1, 1], abs=0.05)
    # twin: the limit of another problem is not approached
    other = QuadraticCost(1.1 * task[1].Q, task[1].R_constant, task[1].Q_T).double()  # pyright: ignore[reportArgumentType]
    assert max(orders(errors(continuous_riccati(task[0], other, horizon)))) < 0.5


def test_double_integrator_costs_what_TASKS_says():
    mean = float((discrete_riccati(*double_integrator(), REFERENCE).P[0] @ SECOND_MOMENT).trace())
    assert 3.05 < mean < 3.15
    X0 = Box([-1.0, -0.7], [1.0, 0.7]).to(F64)
    J = optimal_cost(reference_problem(*double_integrator()))
    assert J is not None
    sampled = J(X0.sample(20_000, torch.Generator().manual_seed(0)))
    assert float(sampled.mean()) == pytest.approx(mean, abs=4 * float(sampled.std()) / math.sqrt(20_000))
    # twin: the released code's R = 0.1 is another task
    other = discrete_riccati(*double_integrator(R=0.1), REFERENCE)
    assert not 3.05 < float((other.P[0] @ SECOND_MOMENT).trace()) < 3.15


def test_HJB_policy_of_the_continuous_value_is_optimal_in_the_rollout():
    (system, cost), x0 = double_integrator(), states(2, 64)
    P = continuous_riccati(system, cost, REFERENCE).P
    optimum = discrete_riccati(system, cost, REFERENCE).value(0, x0)

    def excess(P: Tensor) -> Tensor:
        problem = problem_of(system, cost, REFERENCE.steps, REFERENCE.dt)
        policy = HJBPolicy(problem, Quadratic(P, REFERENCE.dt))
        with torch.no_grad():
            return Rollout(problem, policy, method="euler", gradient="backprop")(x0).cost / optimum - 1

    assert excess(P).min() > -1e-12
    assert excess(P).max() < 1e-3
    for wrong in (P.flip(0), 0.8 * P, cost.Q_T.expand_as(P)):
        assert excess(wrong).max() > 1e-3


def test_continuous_policy_is_the_HJB_policy_at_every_node():
    system, cost = random_linear()
    horizon, x = Horizon(20, 0.05), states(3)
    solution = continuous_riccati(system, cost, horizon)
    hjb = HJBPolicy(problem_of(system, cost), Quadratic(solution.P, horizon.dt))
    for step, t in enumerate(horizon.times(x)):
        torch.testing.assert_close(solution.policy(step, x), hjb(t, x))
        assert not torch.allclose(solution.policy(0, x), hjb(t, x)) or step == 0


@pytest.mark.gate
def test_optimal_cost_of_linear_systems_with_constant_R_is_riccatis():
    system, cost = double_integrator()
    J = optimal_cost(reference_problem(system, cost))
    assert J is not None
    x0 = states(2, 6).reshape(3, 2, 2)
    assert torch.equal(J(x0), discrete_riccati(system, cost, REFERENCE).value(0, x0))
    assert J(x0).shape == (3, 2)
    assert J(x0[0, 0]).shape == ()
    assert isinstance(optimal_cost(reference_problem(system, cost), "rk4"), RiccatiOracle)
    # of any other task it is that of a transcription, in continuous time too
    varying, weight = QuadraticCost(cost.Q, system.inverse_mass, cost.Q_T), torch.eye(4).to(F64)
    assert isinstance(optimal_cost(reference_problem(system, varying), "rk4"), Transcription)
    other = reference_problem(Cartpole(), QuadraticCost(weight, [[1.0]], weight))
    assert isinstance(optimal_cost(other, "dopri5"), Transcription)


@pytest.mark.parametrize("build", [double_integrator, random_linear])
def test_float32_tasks_are_solved_in_float64(build: Callable[[], Task]):
    exact = discrete_riccati(*build(), REFERENCE)
    system, cost = build()
    rounded = discrete_riccati(system.float(), cost.float(), REFERENCE)
    assert rounded.P.dtype == rounded.K.dtype == F64
    torch.testing.assert_close(rounded.P, exact.P, rtol=1e-5, atol=1e-6)
    J, x0 = optimal_cost(reference_problem(system, cost)), states(system.n)
    assert J is not None
    torch.testing.assert_close(J(x0.float()), exact.value(0, x0).float(), rtol=1e-5, atol=0)  # dtypes must agree too
    assert J(x0).dtype == F64
    assert rounded.policy(0, x0.float()).dtype == torch.float32


@pytest.mark.parametrize("solve", [discrete_riccati, continuous_riccati])
def test_refusals_say_what_to_do(solve):
    system, cost = double_integrator()
    with pytest.raises(ValueError, match=r"^Expected a constant R, got a function R\(x\); .*matrix"):
        solve(system, QuadraticCost(cost.Q, system.inverse_mass, cost.Q_T), REFERENCE)
    two_inputs = Linear([[0.0, 1.0], [0.0, 0.0]], [[1.0, 0.0], [0.0, 1.0]])
    with pytest.raises(ValueError, match=r"^Expected a cost of 2 states and 2 controls, got 2 and 1; "):
        solve(two_inputs, cost, REFERENCE)
    with pytest.raises(ValueError, match=r"^Expected a cost of 2 states and 1 controls, got 3 and 1; "):
        solve(system, QuadraticCost(torch.eye(3), [[1.0]], torch.eye(3)), REFERENCE)
    assert solve(system, cost, Horizon(1, 0.01)).P.shape == (2, 2, 2)  # twin: what fits is solved


def test_a_linear_system_with_another_drift_is_not_linear():
    class Bent(DoubleIntegrator):
        def f(self, x):
            return torch.sin(super().f(x))

    assert is_linear(DoubleIntegrator())
    assert not is_linear(Bent())
    assert isinstance(oracle_of(problem_of(DoubleIntegrator())), RiccatiOracle)
    assert not isinstance(oracle_of(problem_of(Bent())), RiccatiOracle)


@pytest.mark.parametrize("A", [[[1e300, 1.0], [1.0, 0.0]], [[1e12, 0.0], [0.0, 1.0]], [[0.0, 1e308], [1e308, 0.0]]])
def test_matrices_that_leave_no_solution_are_one_line(A):
    linear = problem_of(Linear(A, [[0.0], [1.0]]), steps=2, dt=0.1)
    with pytest.raises(OracleError, match="Expected a Riccati equation that can be solved despite rounding"):
        oracle_of(linear, "rk4")
