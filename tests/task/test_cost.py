"""The quadratic cost against plain numpy, and what every cost can do."""

import math

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from lyapnet.task.cost import Cost, QuadraticCost

Q = [[2.0, 0.5], [0.5, 1.0]]
Q_T = [[4.0, -1.0], [-1.0, 3.0]]
R = [[1.0, 0.2], [0.2, 2.0]]


def state_dependent_R(x):
    """Positive definite for x₁ > −1."""
    return (1 + x[..., :1, None]) * torch.tensor(R).to(x)


COSTS = {"constant": lambda x: np.array(R), "of the state": lambda x: (1 + x[0]) * np.array(R)}


@pytest.fixture(params=COSTS)
def weights(request):
    """A cost, and its R as a plain function of one state."""
    return QuadraticCost(Q, R if request.param == "constant" else state_dependent_R, Q_T), COSTS[request.param]


def matches_numpy(cost, plain_R, Q=Q):
    for batch in ((), (0,), (2,), (5,), (3, 2)):
        x, u = torch.rand(*batch, 2), torch.randn(*batch, 2)
        running, state, control = cost.running(x, u), cost.state(x), cost.control(x, u)
        terminal, solved = cost.terminal(x), cost.solve_R(x, u)
        assert running.shape == state.shape == control.shape == terminal.shape == batch
        assert cost.R(x).shape == (*batch, 2, 2)
        for i in np.ndindex(*batch):
            xi, ui = x[i].numpy(), u[i].numpy()
            np.testing.assert_allclose(state[i], xi @ np.array(Q) @ xi)
            np.testing.assert_allclose(control[i], ui @ plain_R(xi) @ ui)
            np.testing.assert_allclose(running[i], xi @ np.array(Q) @ xi + ui @ plain_R(xi) @ ui)
            np.testing.assert_allclose(terminal[i], xi @ np.array(Q_T) @ xi)
            np.testing.assert_allclose(solved[i], np.linalg.solve(plain_R(xi), ui))


def test_cost_against_plain_numpy(weights):
    matches_numpy(*weights)


def test_another_matrix_is_noticed(weights):
    cost, plain_R = weights
    with pytest.raises(AssertionError):
        matches_numpy(cost, lambda x: plain_R(x) + 1e-3)
    with pytest.raises(AssertionError):
        matches_numpy(cost, plain_R, Q=np.array(Q) + 1e-3)


@pytest.mark.parametrize("R", [[[4.0]], lambda x: 4 * torch.ones(*x.shape[:-1], 1, 1)])
def test_one_control(R):
    x, u = torch.randn(3, 2), torch.randn(3, 1)
    assert_close(QuadraticCost(Q, R, Q_T).solve_R(x, u), u / 4)


NO_WEIGHTS = {
    "rectangular": ([[1.0, 0.0]], "as a square matrix"),
    "a vector": (torch.ones(2), "as a square matrix"),
    "a batch": (torch.ones(1, 2, 2), "as a square matrix"),
    "ragged": ([[1.0, 0.0], [0.0]], "as a square matrix"),
    "empty": ([], "as a square matrix"),
    "not a number": ([[math.nan, 0.0], [0.0, 1.0]], "finite"),
    "infinite": ([[math.inf, 0.0], [0.0, 1.0]], "finite"),
    "asymmetric": ([[1.0, 0.1], [0.0, 1.0]], "symmetric"),
    "indefinite": ([[1.0, 2.0], [2.0, 1.0]], "positive (semi)?definite, got smallest eigenvalue -1"),
}


@pytest.mark.parametrize("name", ["Q", "R", "Q_T"])
@pytest.mark.parametrize(("matrix", "reason"), NO_WEIGHTS.values(), ids=NO_WEIGHTS)
def test_matrices_without_meaning_are_refused(name, matrix, reason):
    accepted = {"Q": Q, "R": R, "Q_T": Q_T}
    QuadraticCost(**accepted)
    with pytest.raises(ValueError, match=f"Expected {name} .*{reason}"):
        QuadraticCost(**accepted | {name: matrix})


def test_shapes_of_Q_and_Q_T_must_agree():
    with pytest.raises(ValueError, match="Expected Q and Q_T of the same shape"):
        QuadraticCost(Q, R, [[1.0]])


def test_a_semidefinite_matrix_serves_for_the_state_but_not_for_the_control():
    flat = [[1.0, 1.0], [1.0, 1.0]]
    QuadraticCost(flat, R, torch.zeros(2, 2))
    for matrix in (flat, torch.zeros(2, 2)):
        with pytest.raises(ValueError, match="Expected R symmetric positive definite"):
            QuadraticCost(Q, matrix, Q_T)


def test_the_caller_keeps_its_matrix():
    given_Q = torch.tensor(Q)
    cost = QuadraticCost(given_Q, R, Q_T)
    given_Q.zero_()
    assert cost.Q.tolist() == Q


LOSES_DEFINITENESS = {  # where x₁ < −1
    "indefinite": lambda x: (1 + x) * torch.eye(3),
    "asymmetric": lambda x: torch.eye(3) + torch.relu(-1 - x) * torch.eye(3).roll(1, 0),
    "infinite": lambda x: torch.eye(3) + torch.where(x > -1, 0.0, math.inf),
    "not a number": lambda x: torch.eye(3) * (1 + x).sqrt(),
}


@pytest.mark.parametrize("of_x1", LOSES_DEFINITENESS.values(), ids=LOSES_DEFINITENESS)
def test_an_R_that_loses_definiteness_somewhere_is_refused_there(of_x1):
    cost = QuadraticCost(Q, lambda x: of_x1(x[..., :1, None]), Q_T)
    fine, bad = torch.rand(4, 2), torch.tensor([[-1.5, 0.25]])
    cost.check(fine)
    with pytest.raises(ValueError, match=r"Expected R\(x\) symmetric positive definite.*x = \[-1.5, 0.25\]"):
        cost.check(torch.cat([fine, bad, 2 * bad]))


def test_every_system_has_a_cost_that_passes_the_check(system, cost):
    cost.check(torch.randn(100, system.n))


# Constant R


@pytest.mark.parametrize("m", range(1, 5))
def test_a_constant_R_has_one_inverse(m, monkeypatch):
    factor, x, v = torch.randn(m, m), torch.randn(5, 2), torch.randn(5, m)
    R = factor @ factor.mT + torch.eye(m)
    cost, of_state = (QuadraticCost(Q, weight, Q_T) for weight in (R, lambda x: R.expand(*x.shape[:-1], m, m)))
    assert_close(cost.R_inverse @ R, torch.eye(m))
    assert of_state.R_inverse is of_state.R_constant is None
    assert_close(cost.solve_R(x, v), of_state.solve_R(x, v))
    monkeypatch.setattr("lyapnet.task.cost.base.solve", None)
    cost.solve_R(x, v)
    with pytest.raises(TypeError):
        of_state.solve_R(x, v)


# A cost of the user's own, of which the base class derives the rest


class Swing(Cost):
    """q = x₁⁴ + (1 − cos x₃), R = 2 + x₁², φ = x₁²; x₂ is free."""

    def state(self, x):
        return x[..., 0] ** 4 + 1 - torch.cos(x[..., 2])

    def R(self, x):
        return (2 + x[..., :1, None] ** 2).expand(*x.shape[:-1], 1, 1)

    def terminal(self, x):
        return x[..., 0] ** 2


def test_a_cost_needs_three_methods():
    cost, x, u = Swing(), torch.randn(6, 3), torch.randn(6, 1)
    assert cost.goal is cost.R_constant is cost.R_inverse is None
    assert_close(cost.running(x, u), x[:, 0] ** 4 + 1 - x[:, 2].cos() + (2 + x[:, 0] ** 2) * u[:, 0] ** 2)
    assert_close(cost.solve_R(x, u), u / (2 + x[:, :1] ** 2))
    assert_close(cost.terminal_gradient(x), torch.stack([2 * x[:, 0], *torch.zeros(2, 6)], -1))
    cost.check(x)


def test_the_gradient_of_the_terminal_cost_joins_the_callers_graph_where_there_is_one():
    x = torch.randn(4, 3)
    for cost in (Swing(), QuadraticCost(torch.eye(3), [[1.0]], torch.diag(torch.tensor([1.0, 0.0, 0.0])))):
        with torch.no_grad():
            assert not cost.terminal_gradient(x).requires_grad
        leaf = x.clone().requires_grad_()
        (second,) = torch.autograd.grad(cost.terminal_gradient(leaf).sum(), leaf)
        assert_close(second, torch.tensor([2.0, 0.0, 0.0]).expand(4, 3))


def test_states_that_a_cost_does_not_depend_on_are_found():
    diagonal = QuadraticCost(torch.diag(torch.tensor([1.0, 0.0, 2.0])), [[1.0]], torch.zeros(3, 3))
    for cost in (Swing(), diagonal):
        assert [cost.ignores(i, 3) for i in range(3)] == [False, True, False]


def test_a_cost_restricted_to_some_states_is_the_cost_with_the_others_at_zero():
    x, kept = torch.randn(5, 2), [0, 2]
    whole = torch.stack([x[:, 0], torch.zeros(5), x[:, 1]], -1)
    full = torch.randn(3, 3)
    for cost in (Swing(), QuadraticCost(full @ full.mT, [[1.0]], full.mT @ full)):
        restricted = cost.restricted_to(kept, 3)
        assert_close(restricted.state(x), cost.state(whole))
        assert_close(restricted.terminal(x), cost.terminal(whole))
        assert_close(restricted.terminal_gradient(x), cost.terminal_gradient(whole)[:, kept])
        assert not torch.allclose(restricted.state(x), cost.state(whole + 0.1))


@pytest.mark.parametrize(
    ("method", "broken", "message"),
    [
        ("state", lambda x: 1 / (0 * x[..., 0]), r"Expected finite q\(x\), got inf"),
        ("terminal", lambda x: math.nan * x[..., 0], r"Expected finite φ\(x\), got nan"),
    ],
)
def test_a_cost_that_breaks_its_contract_is_refused(method, broken, message):
    cost, x = Swing(), torch.rand(4, 3)
    cost.check(x)
    setattr(cost, method, broken)
    with pytest.raises(ValueError, match=message):
        cost.check(x)


def test_a_quadratic_cost_with_another_term_is_refused():
    """Certificates and oracles know a quadratic cost by its matrices."""
    with pytest.raises(TypeError, match="the state of QuadraticCost in Bent, got another; derive from Cost"):

        class Bent(QuadraticCost):
            def state(self, x):
                return super().state(x) ** 2
