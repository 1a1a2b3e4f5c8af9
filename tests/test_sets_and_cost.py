"""Boxes of states, and the quadratic cost, against brute force and plain numpy."""

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from lyapnet.cost import QuadraticCost
from lyapnet.sets import Box


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.fixture
def box():
    """With one fixed component, and one that excludes the origin."""
    return Box([-1.0, 0.5, 2.0], [1.0, 0.5, 6.0])


def test_a_box_knows_its_geometry(box):
    assert box.dimension == 3
    assert box.center.tolist() == [0.0, 0.5, 4.0]
    assert box.widths.tolist() == [2.0, 0.0, 4.0]
    assert box.magnitude.tolist() == [1.0, 0.5, 6.0]


def looks_uniform(samples, lower, upper):
    """Mean and variance of every component within five standard errors of the uniform distribution's."""
    count, lower, widths = len(samples), torch.tensor(lower), torch.tensor(upper) - torch.tensor(lower)
    unit = (samples - lower)[:, widths > 0] / widths[widths > 0]
    mean_error, variance_error = math.sqrt(1 / 12 / count), math.sqrt(1 / 180 / count)
    assert ((unit.mean(0) - 1 / 2).abs() < 5 * mean_error).all()
    assert ((unit.var(0) - 1 / 12).abs() < 5 * variance_error).all()


def test_samples_are_uniform_in_the_box(box):
    samples = box.sample(20_000, seeded())
    assert samples.shape == (20_000, 3)
    assert box.contains(samples).all()
    looks_uniform(samples, [-1.0, 0.5, 2.0], [1.0, 0.5, 6.0])


@pytest.mark.parametrize("upper", [[1.1, 0.5, 6.0], [1.0, 0.5, 5.9]])
def test_another_box_does_not_pass_for_uniform(box, upper):
    with pytest.raises(AssertionError):
        looks_uniform(box.sample(20_000, seeded()), [-1.0, 0.5, 2.0], upper)


def test_a_seed_names_the_samples(box):
    assert torch.equal(box.sample(5, seeded(3)), box.sample(5, seeded(3)))
    assert not torch.equal(box.sample(5, seeded(3)), box.sample(5, seeded(4)))
    assert_close(box.float().sample(5, seeded(3)).double(), box.double().sample(5, seeded(3)), rtol=1e-6, atol=1e-6)


@given(st.integers(0, 2**32), st.floats(-1e3, 1e3, width=32), st.floats(0, 1e3, width=32))
def test_samples_stay_in_the_box_in_single_precision(seed, low, width):
    box = Box([low], [low + width]).float()
    assert box.sample(64, seeded(seed)).dtype == torch.float32
    assert box.contains(box.sample(64, seeded(seed))).all()


def test_a_sample_at_the_upper_end_stays_in_the_box(monkeypatch):
    """lower + (upper − lower) can exceed upper by a rounding."""
    monkeypatch.setattr(torch, "rand", lambda *size, **_: torch.full(size, 1 - 2**-53))
    box = Box([-0.2], [0.1]).float()
    assert box.lower + box.widths > box.upper
    assert box.contains(box.sample(1)).all()


def test_contains_is_closed_and_looks_at_every_component(box):
    inside = torch.tensor([[-1.0, 0.5, 2.0], [1.0, 0.5, 6.0], [0.0, 0.5, 3.0]])
    outside = torch.tensor([[-1.01, 0.5, 2.0], [1.0, 0.5 + 1e-9, 6.0], [0.0, 0.5, 6.01], [math.nan, 0.5, 3.0]])
    assert box.contains(inside).all()
    assert not box.contains(outside).any()
    assert box.contains(inside[0]).shape == ()


def test_extreme_point_is_the_best_corner(box):
    directions = torch.randn(50, 3)
    corners = torch.tensor(list(itertools.product(*zip(box.lower.tolist(), box.upper.tolist(), strict=True))))
    best = (directions @ corners.mT).amax(-1)
    assert_close((directions * box.extreme_point(directions)).sum(-1), best)
    assert not torch.allclose((directions * box.extreme_point(-directions)).sum(-1), best)
    assert box.extreme_point(torch.zeros(3)).tolist() == box.upper.tolist()


@pytest.mark.parametrize(
    ("lower", "upper", "reason"),
    [
        ([0.0], [1.0, 2.0], "same shape"),
        ([], [], "same shape"),
        (torch.tensor(0.0), torch.tensor(1.0), "same shape"),
        (torch.zeros(1, 2), torch.ones(1, 2), "same shape"),
        ([-math.inf], [0.0], "finite"),
        ([0.0], [math.nan], "finite"),
        ([0.0, 2.0], [1.0, 1.0], "2.0 > 1.0 at index 1"),
    ],
)
def test_bounds_without_meaning_are_refused(lower, upper, reason):
    with pytest.raises(ValueError, match=f"Expected .*{reason}"):
        Box(lower, upper)


def test_integer_bounds_make_a_box_of_floats():
    assert Box([0, -1], [1, 1]).lower.dtype == torch.float64


# Cost

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
