"""Costs of controls beside uᵀRu: their minimisers, by the conditions of an optimum and by closed forms."""

import itertools
import math

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from lyapnet.base.errors import UsageError
from lyapnet.task.ball import ControlBall, minimise_in_ball
from lyapnet.task.cost import control_costs
from lyapnet.task.cost.control_costs import (
    AbsoluteCost,
    ControlCosts,
    EntropyCost,
    LogCosCost,
    NormCost,
    PowerCost,
    PseudoHuberControlCost,
    SeparableCost,
    local_shape,
)
from lyapnet.task.sets import ControlBox, ControlSet, Unbounded

WEIGHTS = [0.5, 1.0, 1.5, 0.8, 0.4, 1.2]


class FourthPower(SeparableCost):
    """A cost of a user's own: its value alone."""

    def forward(self, u):
        return (self.weight * u**4).sum(-1)


def costs_of(m: int) -> dict[str, ControlCosts]:
    w = WEIGHTS[:m]
    return {
        "absolute": ControlCosts([AbsoluteCost(w)]),
        "power 1.5": ControlCosts([PowerCost(w, 1.5)]),
        "power 3": ControlCosts([PowerCost(w, 3)]),
        "pseudo-Huber": ControlCosts([PseudoHuberControlCost(w, 0.05)]),
        "log-cos": ControlCosts([LogCosCost(w, 2.2)]),
        "entropy": ControlCosts([EntropyCost(w, 2.2)]),
        "absolute and log-cos": ControlCosts([AbsoluteCost(0.3), LogCosCost(w, 2.2)]),
        "own": ControlCosts([FourthPower(w)]),
    }


def draws(m: int, count: int = 300):
    """R of a condition up to 1e5 and b of sizes from 0.01 to 100."""
    A, size = torch.randn(count, m, m), 10 ** (3 * torch.rand(count, 1, 1) - 2)
    return A @ A.mT * size + 1e-3 * torch.eye(m), torch.randn(count, m) * 10 ** (4 * torch.rand(count, 1) - 2)


def separable_residual(costs: ControlCosts, box: ControlSet, R, b, u):
    """How far 0 is from the subdifferential of uᵀRu + bᵀu + s(u) over a box, relative to the size of its parts."""
    smooth = [cost for cost in costs.separable if not isinstance(cost, AbsoluteCost)]
    kinks = sum((cost.weight for cost in costs.separable if isinstance(cost, AbsoluteCost)), torch.zeros(u.shape[-1]))
    v = u.clone().requires_grad_()
    by_s = sum((cost(v).sum() for cost in smooth), (0 * v).sum())
    (own,) = torch.autograd.grad(by_s, v)
    own = own.nan_to_num(0.0)  # |u|ᵖ at 0 itself
    slope = 2 * (R @ u[..., None])[..., 0] + b + own
    low, high = slope - kinks, slope + kinks
    low, high = torch.where(u > 0, high, low), torch.where(u < 0, low, high)
    lower, upper = (side.expand(u.shape[-1]) for side in box.limits)
    low = torch.where(u <= lower, -math.inf, low)
    high = torch.where(u >= upper, math.inf, high)
    return torch.maximum(low, -high).clamp_min(0) / (b.abs().amax(-1, keepdim=True) + own.abs() + 1)


BOXES = {"limits": lambda m: ControlBox([-1.0] * m, [2.0] * m), "without limits": lambda _: Unbounded()}


@pytest.mark.parametrize("kind", costs_of(1))
@pytest.mark.parametrize("m", [1, 2, 3])
@pytest.mark.parametrize("box", BOXES.values(), ids=BOXES)
def test_the_minimiser_meets_the_conditions_of_an_optimum(kind, m, box):
    costs, controls = costs_of(m)[kind], box(m)
    if costs.open_limits and not controls.limited:
        controls = ControlBox([-2.199] * m, [2.199] * m)
    R, b = draws(m)
    u = costs.minimise(controls, R, b)
    assert controls.contains(u).all()
    assert float(separable_residual(costs, controls, R, b, u).max()) < 1e-9
    moved = controls.project(u + 1e-3 * (1 + u.abs()))
    assert float(separable_residual(costs, controls, R, b, moved).max()) > 1e-6, "the conditions tell another control"


@pytest.mark.gate
@pytest.mark.parametrize("m", [4, 5, 6])
def test_many_controls_with_kinks(m):
    costs, controls = ControlCosts([AbsoluteCost(WEIGHTS[:m])]), ControlBox([-1.0] * m, [2.0] * m)
    R, b = draws(m, 1000)
    u = costs.minimise(controls, R, b)
    assert float(separable_residual(costs, controls, R, b, u).max()) < 1e-9
    assert all(bool((u == value).any()) for value in (-1, 0, 2))


@pytest.mark.parametrize("kind", costs_of(1))
@pytest.mark.parametrize("m", [1, 2])
def test_a_trace_finds_the_same_without_reading_values(kind, m, monkeypatch):
    costs, controls = costs_of(m)[kind], ControlBox([-1.0] * m, [2.0] * m)
    R, b = draws(m)
    u = costs.minimise(controls, R, b)
    monkeypatch.setattr(control_costs, "has_values", lambda _: False)
    assert_close(costs.minimise(controls, R, b), u, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("kind", costs_of(1))
@pytest.mark.parametrize("m", [1, 2])
def test_its_derivative_is_that_of_differences(kind, m):
    costs, controls = costs_of(m)[kind], ControlBox([-1.0] * m, [2.0] * m)
    R, b = draws(m)
    leaves = [R.clone().requires_grad_(), b.clone().requires_grad_()]
    by_R, by_b = torch.autograd.grad(costs.minimise(controls, *leaves).sum(), leaves)
    S, h = torch.randn_like(R), 1e-6
    S = (S + S.mT) * R.diagonal(dim1=-2, dim2=-1).amin(-1)[..., None, None]
    d = torch.randn_like(b) * b.abs()

    def along(size):
        return costs.minimise(controls, R + size * S, b + size * d).sum(-1)

    slope = (along(h) - along(-h)) / (2 * h)
    own = (by_R * S).sum((-2, -1)) + (by_b * d).sum(-1)
    off = (slope - own).abs() > 1e-4 * own.abs() + 1e-6
    assert float(off.double().mean()) < 0.02, "all but those at a kink"
    assert float(own.abs().max()) > 1e-3


def test_closed_forms():
    b, one = torch.linspace(-9, 9, 37)[:, None], torch.ones(37, 1, 1)
    free = Unbounded()
    soft = -b.sign() * (b.abs() - 0.7).clamp_min(0) / 2
    assert_close(ControlCosts([AbsoluteCost(0.7)]).minimise(free, one, b), soft)
    assert_close(ControlCosts([AbsoluteCost(0.7)]).minimise(ControlBox(-1.0, 0.5), one, b), soft.clamp(-1, 0.5))
    tiny, box = 1e-12 * one, ControlBox(-1.9999999, 1.9999999)
    assert_close(ControlCosts([EntropyCost(0.7, 2)]).minimise(box, tiny, b), -2 * torch.tanh(b / (2 * 0.7 * 2)))
    log_cos = -4 / math.pi * torch.atan(b * math.pi / (8 * 0.7))
    assert_close(ControlCosts([LogCosCost(0.7, 2)]).minimise(box, tiny, b), log_cos)
    power = -b.sign() * (b.abs() / (1.5 * 0.7)) ** 2
    assert_close(ControlCosts([PowerCost(0.7, 1.5)]).minimise(free, tiny, b), power, rtol=1e-6, atol=1e-6)


def test_no_minimiser_reaches_an_open_limit():
    b = torch.linspace(-1e4, 1e4, 2001)[:, None]
    for dtype in (torch.float32, torch.float64):
        for cost in (EntropyCost(1.0, 1.0), LogCosCost(1.0, 1.0)):
            box = ControlBox(-(1 - 1e-6), 1 - 1e-6).to(dtype)
            u = ControlCosts([cost]).to(dtype).minimise(box, torch.full((2001, 1, 1), 0.1).to(dtype), b.to(dtype))
            assert cost(u).isfinite().all()
            assert cost(torch.ones(1, 1)).isinf()


def test_costs_near_zero_and_at_their_limits():
    u = torch.tensor([[1e-9], [1e-3], [0.5]])
    for cost in (LogCosCost(0.7, 2), EntropyCost(0.7, 2)):
        assert_close(cost(u[:2]), 0.7 * u[:2, 0] ** 2, rtol=1e-6, atol=0)
        assert cost(torch.tensor([[2.0], [-2.5]])).isinf().all()
        v = u.clone().requires_grad_()
        assert_close(cost.slope(u), torch.autograd.grad(cost(v).sum(), v)[0])
        assert_close(cost.inverse_slope(cost.slope(u)), u)
    assert_close(PseudoHuberControlCost(0.7, 0.01)(10 * u[2:]), torch.tensor([0.7 * 5]), rtol=3e-3, atol=0)


def norm_residual(R, b, u, weight, radius):
    """How far 0 is from the subdifferential of uᵀRu + bᵀu + w‖u‖ over a ball, relative to b."""
    size = u.norm(dim=-1)
    slope = 2 * (R @ u[..., None])[..., 0] + b
    direction = u / size.clamp_min(1e-300)[..., None]
    along = (slope * direction).sum(-1)
    across = (slope - along[..., None] * direction).norm(dim=-1)
    at_border = size >= radius * (1 - 1e-12)
    outwards = torch.where(at_border, (along + weight).clamp_min(0), (along + weight).abs())
    at_zero = (slope.norm(dim=-1) - weight).clamp_min(0)
    return torch.where(size > 0, across + outwards, at_zero) / (1 + b.norm(dim=-1))


@pytest.mark.parametrize("m", [2, 3, 4, 6])
@pytest.mark.parametrize("radius", [1.5, math.inf])
def test_the_norm_in_a_ball(m, radius):
    controls = Unbounded() if radius == math.inf else ControlBall(radius)
    R, b = draws(m, 2000)
    u = ControlCosts([NormCost(0.7)]).minimise(controls, R, b)
    assert controls.contains(u).all()
    assert float(norm_residual(R, b, u, 0.7, radius).max()) < 1e-9
    assert (u == 0).all(-1).any()
    assert float(norm_residual(R, b, 1.001 * u + 1e-3, 0.7, radius).max()) > 1e-5
    if radius < math.inf:
        plain = controls.minimise(R, b)
        assert float(norm_residual(R, b, plain, 0.0, radius).max()) < 1e-9
        assert float(plain.norm(dim=-1).max()) > 1.5 * (1 - 1e-12)


def test_the_derivative_in_a_ball_is_that_of_differences():
    R, b = draws(3)
    leaf = b.clone().requires_grad_()
    for weight in (None, torch.tensor(0.7)):
        (by_b,) = torch.autograd.grad(minimise_in_ball(R, leaf, torch.tensor(1.5), weight).sum(), leaf)
        h = 1e-6 * b
        ends = [minimise_in_ball(R, b + sign * h, torch.tensor(1.5), weight).sum(-1) for sign in (1, -1)]
        own = 2 * (by_b * h).sum(-1)
        off = (ends[0] - ends[1] - own).abs() > 1e-4 * own.abs() + 1e-11
        assert float(off.double().mean()) < 0.02


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_no_control_leaves_the_ball_by_a_bit(dtype):
    controls = ControlBall(1.6).to(dtype)
    u = controls.project(
        torch.randn(10_000, 3, dtype=dtype) * 10 ** torch.linspace(-3, 30, 10_000, dtype=dtype)[:, None]
    )
    assert ((u.double() ** 2).sum(-1) <= controls.radius.double() ** 2).all()
    assert controls.contains(u).all()
    assert not controls.contains(u[-1] * (1 + 1e-5))
    assert torch.equal(controls.project(u), u)


def test_how_the_minimiser_moves_is_its_derivative():
    """−P (P(2R + S)P + 1 − P)⁻¹ P of local_shape against automatic differentiation of the minimiser."""
    cases = [
        (costs_of(2)["absolute"], ControlBox([-1.0, -1.0], [2.0, 2.0])),
        (costs_of(2)["power 1.5"], ControlBox([-1.0, -1.0], [2.0, 2.0])),
        (costs_of(2)["absolute and log-cos"], ControlBox([-1.0, -1.0], [2.0, 2.0])),
        (ControlCosts([NormCost(0.7)]), ControlBall(1.5)),
        (ControlCosts([NormCost(0.7)]), Unbounded()),
        (None, ControlBall(1.5)),
    ]
    one = [
        (ControlCosts([NormCost(0.7), LogCosCost(0.5, 2.2)]), ControlBox([-2.0], [2.0])),
        (ControlCosts([PowerCost(0.5, 1.5)]), ControlBall(1.5)),
        (ControlCosts([AbsoluteCost(0.5)]), ControlBall(1.5)),
        (None, ControlBall(1.5)),
    ]
    for m, (costs, controls) in [*((2, case) for case in cases), *((1, case) for case in one)]:
        R, b = draws(m)
        leaf = b.clone().requires_grad_()
        u = controls.minimise(R, leaf) if costs is None else costs.minimise(controls, R, leaf)
        rows = [torch.autograd.grad(u[:, i].sum(), leaf, retain_graph=True)[0] for i in range(m)]
        u = u.detach()
        P, S = local_shape(costs, controls, u, 2 * (R @ u[..., None])[..., 0] + b)
        A = P @ (2 * R + (0 if S is None else S)) @ P + torch.eye(m) - P
        assert_close(-P @ torch.linalg.solve(A, P), torch.stack(rows, -2), rtol=1e-6, atol=1e-6)
        assert P.abs().sum() > 10
        assert (torch.eye(2) != P).any()


def test_sets_and_costs_that_do_not_go_together_are_refused():
    R, b = draws(2)
    for costs, controls in (
        ([NormCost(1.0)], ControlBox(-1.0, 1.0)),
        ([AbsoluteCost(1.0)], ControlBall(1.0)),
        ([NormCost(1.0), AbsoluteCost(1.0)], Unbounded()),
    ):
        with pytest.raises(UsageError, match=r"Expected costs of controls with a known minimiser in \w+, got .+; .+\."):
            ControlCosts(costs).minimise(controls, R, b)
    one = torch.ones(3, 1, 1)
    assert_close(
        ControlCosts([NormCost(1.0), AbsoluteCost(0.5)]).minimise(
            ControlBall(1.0), one, torch.tensor([[4.0], [1.0], [-2.0]])
        ),
        torch.tensor([[-1.0], [0.0], [0.25]]),
    )


@pytest.mark.parametrize(
    ("build", "text"),
    [
        (lambda: AbsoluteCost(-1.0), "weight"),
        (lambda: AbsoluteCost("a"), "weight"),
        (lambda: AbsoluteCost(True), "weight"),
        (lambda: AbsoluteCost([0.0, 0.0]), "weight"),
        (lambda: PowerCost([0.0, 1.0], 2.0), "weight"),
        (lambda: NormCost("a"), "weight"),
        (lambda: NormCost([1.0, 2.0]), "weight"),
        (lambda: LogCosCost(1.0, 1e300), "limit"),
        (lambda: PseudoHuberControlCost(1.0, 1e300), "width"),
        (lambda: ControlBall("3"), "radius"),
        (lambda: AbsoluteCost([1.0, math.nan]), "weight"),
        (lambda: PowerCost(1.0, 1.0), "exponent"),
        (lambda: PowerCost(1.0, 1.01), "exponent"),
        (lambda: PseudoHuberControlCost(1.0, 0.0), "width"),
        (lambda: LogCosCost(1.0, 0.0), "limit"),
        (lambda: ControlBall(0.0), "radius"),
        (lambda: ControlBall(math.nan), "radius"),
    ],
)
def test_wrong_numbers_are_refused(build, text):
    with pytest.raises(ValueError, match=f"Expected .*{text}.*, got .+[;:,] .+"):
        build()


def test_brute_force_in_two_controls():
    """A grid over all signs and limits finds nothing cheaper."""
    costs, controls = costs_of(2)["absolute and log-cos"], ControlBox([-1.0, 0.2], [2.0, 1.5])
    R, b = draws(2, 40)
    u = costs.minimise(controls, R, b)
    axes = [np.unique(np.concatenate([np.linspace(low, high, 301), [0.0]])) for low, high in ((-1, 2), (0.2, 1.5))]
    grid = controls.project(torch.tensor(list(itertools.product(*axes))))

    def value(v, k):
        return ((v @ R[k]) * v).sum(-1) + v @ b[k] + costs(v)

    for k in range(40):
        assert float(value(u[k : k + 1], k)) <= float(value(grid, k).min()) + 1e-12
        assert float(value(u[k : k + 1], k)) >= float(value(grid, k).min()) - 1e-2 * (1 + abs(float(b[k].abs().max())))
