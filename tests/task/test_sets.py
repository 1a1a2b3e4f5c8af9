"""Boxes of states against brute force; sets of controls."""

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import lsq_linear
from torch.testing import assert_close

from lyapnet.task.ball import ControlBall
from lyapnet.task.control_sets import CONTROL_SETS
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.ellipsoid import ControlEllipsoid
from lyapnet.task.polytope import ControlPolytope
from lyapnet.task.sets import Box, ControlBox, Unbounded
from lyapnet.task.varying_limits import LimitTable
from tests.marks import at_the_gate


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


def test_a_box_has_corners_and_shows_its_bounds(box):
    assert {tuple(corner) for corner in box.corners().tolist()} == {
        (i, 0.5, k) for i in (-1.0, 1.0) for k in (2.0, 6.0)
    }
    assert {tuple(corner) for corner in box.corners(axes=1).tolist()} == {(-1.0, 0.5, 4.0), (1.0, 0.5, 4.0)}
    assert repr(box) == "Box([-1.0, 0.5, 2.0], [1.0, 0.5, 6.0])"


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


@pytest.mark.gate
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


# Sets of controls


@pytest.mark.parametrize("m", range(1, 5))
def test_without_limits_the_minimum_is_where_the_gradient_vanishes(m):
    """2Ru + b = 0."""
    factor, b = torch.randn(7, m, m), torch.randn(7, m)
    R = factor @ factor.mT + torch.eye(m)
    u = Unbounded().minimise(R, b)
    assert_close(2 * (R @ u[..., None])[..., 0] + b, torch.zeros(7, m), rtol=0, atol=1e-10)
    assert not torch.allclose(u, Unbounded().minimise(R.roll(1, 0), b))


def test_only_the_unbounded_set_itself_has_no_limits():
    class Halved(Unbounded):
        def minimise(self, R, b):
            return super().minimise(R, b) / 2

    assert not Unbounded().limited
    assert Halved().limited, "else its own law would be passed over, and an optimum without limits be its own"


SETS = {
    **CONTROL_SETS, "box": lambda: ControlBox([-0.3, -0.1], [0.1, 0.4]), "ball": lambda: ControlBall(0.3),
    "ellipsoid": lambda: ControlEllipsoid([0.4, 0.2], [0.1, 0.0]),
    "polytope": lambda: ControlPolytope([[1, 1], [-1, 0], [0, -1]], [0.3, 0.2, 0.1]),
    "table": lambda: LimitTable("x", [0, 1], [2, 1]),
}  # fmt: skip


@pytest.mark.parametrize("controls", SETS.values(), ids=SETS)
def test_every_registered_set_keeps_its_contract(controls):
    """The minimum and every projection lie in the set; no admitted control is better than the minimum."""
    controls, b, others = controls(), torch.randn(50, 2), torch.randn(50, 200, 2)
    R = QuadraticCost(torch.eye(2), [[2.0, 0.3], [0.3, 1.0]], torch.eye(2)).R(torch.zeros(50, 2))

    def objective(u):
        return torch.einsum("...i,...ij,...j->...", u, R[0], u) + (b.reshape(50, *[1] * (u.ndim - 2), 2) * u).sum(-1)

    u = controls.minimise(R, b)
    assert u.shape == b.shape
    assert controls.contains(u).all()
    assert controls.contains(controls.project(others)).all()
    assert_close(controls.project(controls.project(others)), controls.project(others))
    assert (objective(u)[:, None] <= objective(controls.project(others)) + 1e-12).all()
    assert not (objective(0.9 * u)[:, None] <= objective(u[:, None])).any(), "a control that is not the minimum"
    assert not controls.contains(torch.tensor([0.0, math.nan]))


def cheapest(R, b, lower, upper):
    """argmin of uᵀRu + bᵀu within limits, by scipy's solver of bounded least squares."""
    root = np.linalg.cholesky(R).T
    return lsq_linear(root, -np.linalg.solve(root.T, b) / 2, (lower, upper), method="bvls", tol=1e-14, max_iter=100).x


def minimise_in_graph(controls, R, b):
    """As a trace has it, which may not look at numbers."""
    return controls.minimise(R, b.clone().requires_grad_()).detach()


@pytest.mark.parametrize("count", [200, at_the_gate(12_000), pytest.param(100_000, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("m", range(1, 7))
def test_within_limits_the_minimum_is_that_of_another_solver(m, count):
    """Some controls are held at a limit, in some states; the clipped minimum of all is another."""
    factor, b = torch.randn(count, m, m), 4 * torch.randn(count, m)
    R = factor @ factor.mT + 0.05 * torch.eye(m)
    lower, upper = -torch.rand(m), torch.rand(m)
    controls = ControlBox(lower, upper)
    u = controls.minimise(R, b)
    expected = np.stack([cheapest(*map(np.asarray, (*one, lower, upper))) for one in zip(R, b, strict=True)])
    assert_close(u, torch.from_numpy(expected), rtol=0, atol=1e-9)
    held = ((u == lower) | (u == upper)).double().mean()
    assert 0.2 < float(held) < 0.9
    assert controls.contains(u).all(), "to the last bit"
    clipped = controls.project(Unbounded().minimise(R, b))
    assert torch.allclose(u, clipped) == (m == 1)
    assert_close(controls.minimise(R[7], b[7]), u[7])
    assert_close(minimise_in_graph(controls, R, b), u, rtol=0, atol=1e-12)
    assert_close(minimise_in_graph(controls, R[7], b[7]), u[7], rtol=0, atol=1e-12)


def test_all_of_a_batch_are_settled_by_rounds_alone(monkeypatch):
    """Where all controls change sides at once for ever, some go round in circles."""
    factor, b = torch.randn(4000, 6, 6), 3 * torch.randn(4000, 6)
    R, controls = factor @ factor.mT + 0.1 * torch.eye(6), ControlBox(-1.0, 1.0)
    expected, asked = minimise_in_graph(controls, R, b), []
    monkeypatch.setattr(
        ControlBox, "_minimise_by_active_set", lambda *given: asked.append(len(given[2])) or controls.project(given[2])
    )
    assert_close(controls.minimise(R, b), expected, rtol=0, atol=1e-10)
    assert not asked
    monkeypatch.setattr("lyapnet.task.sets.SIMULTANEOUS_ROUNDS", 1)
    controls.minimise(R, b)
    assert 0 < asked[0] < 4000, "in fewer rounds some are not settled"


@pytest.mark.parametrize("m", [1, 2])
def test_limits_on_one_side_or_none(m):
    factor, b = torch.randn(50, m, m), torch.randn(50, m)
    R = factor @ factor.mT + torch.eye(m)
    free = Unbounded().minimise(R, b)
    assert_close(ControlBox(-math.inf, math.inf).minimise(R, b), free)
    above = ControlBox(0.0, math.inf).minimise(R, b)
    assert (above >= 0).all()
    assert (above == 0).any()
    assert above.isfinite().all()
    assert_close(above[(free > 0).all(-1)], free[(free > 0).all(-1)])


def slope_inwards(R, b, u, controls):
    """How far a step down the slope of uᵀRu + bᵀu leads within the limits: zero at the minimum, and there alone."""
    step = (2 * (R @ u[..., None])[..., 0] + b) / (2 * R.diagonal(dim1=-2, dim2=-1))
    return (controls.project(u - step) - u).abs().amax(-1)


@pytest.mark.parametrize("m", range(1, 9))
@pytest.mark.parametrize("condition", [10, 1e6])
def test_no_step_within_the_limits_is_downhill_from_the_minimum(m, condition):
    """Of a convex cost that is enough; on R of any condition, ties and limits on one side among them."""
    rotation = torch.linalg.qr(torch.randn(4000, m, m))[0]
    R = (rotation * condition ** torch.rand(4000, 1, m)) @ rotation.mT
    R, b = (R + R.mT) / 2, 2 * torch.randn(4000, m) * condition ** torch.rand(4000, 1)
    b[:1000] = b[:1000].round()
    lower = torch.where(torch.arange(m) % 3 == 2, -math.inf, -torch.rand(m))
    controls = ControlBox(lower, torch.rand(m))
    u = controls.minimise(R, b)
    assert controls.contains(u).all()
    assert float(slope_inwards(R, b, u, controls).max()) < 1e-9
    u = minimise_in_graph(controls, R, b)
    assert controls.contains(u).all()
    assert float(slope_inwards(R, b, u, controls).max()) < 1e-9
    assert float(slope_inwards(R, b, controls.project(0.99 * u), controls).max()) > 1e-3


@pytest.mark.parametrize("m", range(1, 5))
def test_a_control_that_is_held_has_exactly_its_limit(m):
    """And not a rounding less: shares of steps at a limit, and which controls answer to the state, go by that."""
    factor, b = torch.randn(400, m, m), 8 * torch.randn(400, m)
    R = factor @ factor.mT + 0.05 * torch.eye(m)
    controls = ControlBox([-1.03, -0.37, -0.7, -0.21][:m], [1.03, 0.37, 0.7, 0.21][:m])
    u = controls.minimise(R, b)
    near = torch.minimum((u - controls.lower).abs(), (controls.upper - u).abs()) < 1e-12
    assert near.any()
    assert ((u == controls.lower) | (u == controls.upper))[near].all()


def test_the_minimum_within_limits_in_single_precision():
    """Of total costs, a small component drowns in a large one; and a matrix may seem singular."""
    controls = ControlBox([-0.7, -0.7], [0.9, 0.9])
    R, b = torch.tensor([[0.5345, -0.0826], [-0.0826, 0.3963]]), torch.tensor([-14041.8, 0.6738])
    exact = controls.minimise(R, b)
    assert float(exact[1]) == pytest.approx(-0.6625, abs=1e-3)
    assert_close(controls.float().minimise(R.float(), b.float()), exact.float(), rtol=0, atol=1e-5)
    wide = ControlBox(-1.0, 1.0).float().minimise(torch.ones(2, 2).float(), torch.tensor([0.5, 0.6]).float())
    assert_close(wide, torch.tensor([0.7, -1.0]).float(), rtol=0, atol=0.06)


@given(st.floats(-1e3, 1e3), st.floats(1e-9, 1e3))
def test_in_single_precision_limits_are_no_wider(low, width):
    box = ControlBox([low], [low + width])
    single = ControlBox([low], [low + width]).float()
    if single.lower < single.upper:  # else it does not tell them apart
        assert single.lower.double() >= box.lower
        assert single.upper.double() <= box.upper
    assert_close(single.lower.double(), box.lower, rtol=3e-7, atol=1e-30)
    assert single.lower.dtype == torch.float32


def test_limits_that_single_precision_does_not_tell_apart():
    box = ControlBox([0.1], [0.1 + 1e-12]).float()
    assert box.lower == box.upper
    assert box.contains(box.project(torch.zeros(1).float()))


def test_limits_that_are_none_are_no_limits():
    assert not ControlBox([-math.inf], [math.inf]).limited
    assert ControlBox([-math.inf], [0.0]).limited


@pytest.mark.parametrize("m", [1, 2])
def test_within_limits_what_is_no_number_stays_none(m):
    """A law that hid it behind a limit would look as if V were known."""
    u = ControlBox(-1.0, 1.0).minimise(torch.eye(m).expand(2, m, m), torch.tensor([[math.nan] * m, [1.0] * m]))
    assert u[0].isnan().all()
    assert_close(u[1], torch.full((m,), -0.5))


def test_the_minimum_within_limits_has_a_gradient_where_controls_are_free():
    R, b = torch.tensor([[2.0, 0.5], [0.5, 1.0]]), torch.tensor([1.0, -10.0], requires_grad=True)
    u = ControlBox(-1.0, 1.0).minimise(R, b)
    assert u[1] == 1
    (slope,) = torch.autograd.grad(u[0], b)
    assert_close(slope, torch.tensor([-0.25, 0.0]))


@pytest.mark.parametrize(
    ("lower", "upper", "reason"),
    [
        (1.0, -1.0, "lower < upper, .*swap the two"), (math.nan, 1.0, "lower < upper"),
        (math.inf, math.inf, "lower < upper"), (-math.inf, -math.inf, "lower < upper"),
        ([-1.0, 2.0], [1.0, 2.0], "lower < upper, .*belongs into f"), (0.0, -0.0, "lower < upper"),
        ([-1.0], [1.0, 2.0], "one for each control"),
    ],
)  # fmt: skip
def test_limits_without_meaning_are_refused(lower, upper, reason):
    with pytest.raises(ValueError, match=f"Expected .*{reason}"):
        ControlBox(lower, upper)


@pytest.mark.parametrize("m", [1, 3, 5])
def test_limits_of_another_number_of_controls_are_refused(m):
    with pytest.raises(ValueError, match=f"Expected limits of {m} controls, got 2"):
        ControlBox([-1.0, -1.0], [1.0, 1.0]).minimise(torch.eye(m), torch.ones(m))


def test_two_controls_that_are_not_coupled_have_their_derivatives():
    """Their roots are equal up to rounding, between which clamp would have no derivative."""
    R = torch.diag_embed(0.1 + torch.rand(1000, 2, generator=torch.Generator().manual_seed(0)))
    b = (0.3 * torch.randn(1000, 2, generator=torch.Generator().manual_seed(1))).requires_grad_()
    u = ControlBox([-2.0, -0.6], [2.0, 0.6]).minimise(R, b)
    inside = u[:, 1].abs() < 0.6
    (slope,) = torch.autograd.grad(u[:, 1].sum(), b)
    assert_close(slope[inside][:, 1], -0.5 / R[inside][:, 1, 1])
    assert not slope[~inside][:, 1].any()
    assert 0 < inside.double().mean() < 1


@pytest.mark.parametrize("limits", [(-1.0, -0.5), (0.5, 1.0), (-1.0, 0.0), (0.0, 1.0), (-1.0, 1.0)])
@pytest.mark.parametrize("m", [2, 3])
def test_in_every_orthant_controls_stay_within_limits(m, limits):
    low, high = limits
    U, R, b = ControlBox([low] * m, [high] * m), (torch.eye(m) + 0.3).expand(200, m, m), 3 * torch.randn(200, m)
    for signs in itertools.product((1.0, -1.0), repeat=m):
        assert bool(U.contains(U.minimise_in_orthant(R, b, torch.tensor(signs))).all())
