"""Bounds of the best control with other costs and in a ball: no control and no minimum lies outside."""

import pytest
import torch
from torch.testing import assert_close

from lyapnet.base.linear_algebra import apply
from lyapnet.prover import minima
from lyapnet.prover.bounds import BoundedFunction
from lyapnet.prover.taylor import box_form, monomials
from lyapnet.task.ball import ControlBall
from lyapnet.task.cost.control_costs import (
    AbsoluteCost,
    ControlCosts,
    EntropyCost,
    LogCosCost,
    NormCost,
    PowerCost,
    PseudoHuberControlCost,
)
from lyapnet.task.cost.minimum import least_over, register_minimum, traced_minimum
from lyapnet.task.sets import ControlBox, Unbounded
from tests.marks import at_the_gate, sample

AXES, CORNER = 3, torch.full((3,), 2.0, dtype=torch.float64)
WEIGHTS = [0.5, 1.0, 1.5, 0.8, 0.4, 1.2]


def pairs(m):
    """Name ↦ (s, U), each cost of lyapnet's with each set that it may have."""
    w = WEIGHTS[:m]
    each = {
        "absolute": [AbsoluteCost(w)],
        "power 1.5": [PowerCost(w, 1.5)],
        "power 3": [PowerCost(w, 3)],
        "pseudo-Huber": [PseudoHuberControlCost(w, 0.05)],
        "log-cos": [LogCosCost(w, 2.2)],
        "entropy": [EntropyCost(w, 2.2)],
        "absolute and log-cos": [AbsoluteCost(0.3), LogCosCost(w, 2.2)],
    }
    costs = {name: ControlCosts(parts) for name, parts in each.items()}
    limits = {f"{name}, limits": (cost, ControlBox([-1.0] * m, [2.0] * m)) for name, cost in costs.items()}
    wide = {f"{name}, far limits": (cost, ControlBox([-3.0] * m, [3.0] * m)) for name, cost in costs.items()}
    free = {f"{name}, no limits": (cost, Unbounded()) for name, cost in costs.items() if not cost.open_limits}
    fuel = ControlCosts([NormCost(0.7)])
    return {
        **limits, **wide, **free,
        "absolute, from 0 on": (costs["absolute"], ControlBox([0.0] * m, [2.0] * m)),
        "absolute, without 0": (costs["absolute"], ControlBox([0.3] * m, [2.0] * m)),
        "norm, ball": (fuel, ControlBall(1.3)),
        "norm, no limits": (fuel, Unbounded()),
        "ball": (None, ControlBall(1.3)),
    }  # fmt: skip


def matrix(kind, m):
    """W as a function of x (*batch, AXES)."""
    A, d = torch.randn(m, m), torch.rand(m)
    W = {
        "multiple of the identity": 0.4 * torch.eye(m),
        "diagonal": torch.diag(d + 0.1),
        "full": 0.3 * A @ A.mT + 0.1 * torch.eye(m),
        "of the point": torch.diag(d + 0.3),
    }[kind]
    moves = 0.05 * (kind == "of the point")
    return lambda x: W + moves * torch.diag_embed(torch.sin(x[..., :1].expand(*x.shape[:-1], m))) if moves else W


KINDS = ("multiple of the identity", "diagonal", "full", "of the point")


def examine(s, U, m, kind, degree, boxes, points, by_kernel=False):
    """(samples, how many lie outside, how many would lie outside of bounds 30 % narrower), or None without a kernel."""
    torch.manual_seed(m)
    W, B, C = matrix(kind, m), 2 * torch.randn(m, AXES), 0.3 * torch.randn(m, AXES, AXES)

    def b(x):
        return apply(B, x) + torch.einsum("mij,...j,...i->...m", C, x, x)

    def traced(t, x):
        found = traced_minimum(s, U, W(x), apply(B, x) + ((C @ x) * x).sum(-1))
        return found.u, found.value[None]

    corner = torch.cat([torch.zeros(1), torch.full((AXES,), 2.0)])
    bounded = BoundedFunction(traced, (-corner, corner), degree)
    middle = 4 * torch.rand(boxes, AXES) - 2
    half = torch.rand(boxes, AXES) * 10.0 ** -(torch.arange(boxes) % 5)[:, None]
    at = torch.zeros(boxes, 1)
    lower, upper = torch.cat([at, middle - half], -1), torch.cat([at, middle + half], -1)
    kernel = bounded.kernel(lower, upper) if by_kernel else None
    if by_kernel and kernel is None:
        return None
    forms = bounded.image(box_form(lower, upper, degree)) if kernel is None else kernel.forms(lower, upper)
    epsilon = (3 * torch.rand(points, boxes, AXES) - 1.5).clamp(-1, 1)
    x = middle + half * epsilon
    R = W(x)
    found = least_over(s, U, R.expand(*x.shape[:-1], m, m), b(x))
    outside = narrower = 0
    for form, values in zip(forms, (found.u, found.value[..., None]), strict=True):
        assert form.radius.isfinite().all()
        for i in range(values.shape[-1]):
            one = form.with_parts(form.terms[..., i], form.radius[..., i])
            off = (values[..., i] - polynomial(one, epsilon)).abs()
            outside += int((off > one.radius * (1 + 1e-9) + 1e-13 * one.magnitude).sum())
            narrower += int((off > 0.7 * one.radius).sum())
    return x.shape[0] * x.shape[1], outside, narrower


def polynomial(form, epsilon):
    """The polynomial of a form at points of its boxes, (points, boxes)."""
    powers = [epsilon[..., list(axes)].prod(-1) for axes in monomials(form.dimension, form.degree)]
    return torch.stack([term * power for term, power in zip(form.terms, powers, strict=True)]).sum(0)


CASES = [(name, m, kind) for m in (1, 2, 3) for name in pairs(m) for kind in KINDS if m > 1 or kind != "full"]


@pytest.mark.parametrize(("name", "m", "kind"), sample(CASES, 24))
def test_no_control_lies_outside(name, m, kind):
    for degree in (1, 2, 3):
        samples, outside, _ = examine(*pairs(m)[name], m, kind, degree, 200, 20)
        assert outside == 0
        assert samples == 4000


@pytest.mark.gate
@pytest.mark.parametrize(("name", "m", "kind"), CASES)
def test_no_control_lies_outside_of_a_hundred_thousand(name, m, kind):
    samples, outside, _ = examine(*pairs(m)[name], m, kind, 2, 1000, 100)
    assert outside == 0
    assert samples == 100_000


@pytest.mark.parametrize(
    "name", ["absolute, limits", "absolute, no limits", "absolute, from 0 on", "absolute, without 0", "ball"]
)
@pytest.mark.parametrize("m", [1, 2, at_the_gate(3)])
def test_machine_code_has_those_of_closed_forms(name, m):
    for degree in (1, 2, 3):
        found = examine(*pairs(m)[name], m, "multiple of the identity", degree, 300, 30, by_kernel=True)
        assert found is not None
        assert found[1] == 0


def test_machine_code_leaves_others_to_the_interpreter():
    for name in ("power 3, limits", "norm, ball"):
        assert examine(*pairs(2)[name], 2, "diagonal", 2, 10, 10, by_kernel=True) is None


@pytest.mark.parametrize("name", ["absolute, limits", "power 1.5, no limits", "entropy, limits", "norm, ball", "ball"])
def test_bounds_that_are_too_narrow_are_found(name, monkeypatch):
    """The twin: without the doubt about slopes."""
    slopes, kind = minima._bound_slopes, "full" if name in ("absolute, limits", "ball") else "multiple of the identity"
    monkeypatch.setattr(minima, "_bound_slopes", lambda program: (slopes(program)[0], 0 * slopes(program)[1]))
    assert examine(*pairs(2)[name], 2, kind, 2, 200, 20)[1] > 0


@pytest.mark.parametrize(("name", "function"), [("absolute, limits", "leaky"), ("ball", "slope_within_ball")])
def test_closed_forms_that_are_too_narrow_are_found(name, function, monkeypatch):
    exact = minima.FUNCTIONS[function]
    monkeypatch.setitem(minima.FUNCTIONS, function, lambda x: exact(x).with_parts(exact(x).terms, 0 * x.radius))
    assert examine(*pairs(2)[name], 2, "multiple of the identity", 2, 200, 20)[1] > 0


@pytest.mark.parametrize("name", ["absolute, limits", "ball"])
def test_machine_code_and_the_interpreter_agree(name):
    """Otherwise a leaf that one of them closed might stay undecided when its proof is checked."""
    s, U = pairs(2)[name]
    bounded = BoundedFunction(
        lambda t, x: tuple(traced_minimum(s, U, 0.4 * torch.eye(2), x + 0 * t)), (-CORNER, CORNER)
    )
    middle, half = 4 * torch.rand(200, 3) - 2, torch.rand(200, 3)
    box = middle - half, middle + half
    kernel = bounded.kernel(*box)
    assert kernel is not None
    for one, other in zip(kernel.forms(*box), bounded.image(box_form(*box, 2)), strict=True):
        for a, b in zip(one.interval(), other.interval(), strict=True):
            assert_close(a, b, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", pairs(2))
def test_what_is_no_minimum_is_told(name):
    s, U = pairs(2)[name]
    W, b = 0.4 * torch.eye(2).expand(500, 2, 2), 4 * torch.randn(500, 2)
    u = least_over(s, U, W, b).u
    assert minima.is_minimum(s, U, W, b, u).all()
    assert not minima.is_minimum(s, U, W, b, 0.999 * u - 1e-4).any()


def test_a_law_that_is_no_minimum_has_no_bounds(monkeypatch):
    s, U = pairs(2)["power 3, limits"]
    exact = minima.least_over
    monkeypatch.setattr(minima, "least_over", lambda *a: exact(*a)._replace(u=exact(*a).u + 1e-6))
    with pytest.raises(AssertionError):
        examine(s, U, 2, "diagonal", 2, 10, 10)


@pytest.mark.parametrize("coupling", [0.0, 0.01])
@pytest.mark.parametrize("costs", [[AbsoluteCost(0.01)], [AbsoluteCost(0.01), PowerCost(1e-6, 3)]])
def test_no_control_lies_outside_where_another_one_hides_its_cost(costs, coupling):
    """b₂ is so close to a kink that the cheapest of the minima in orthants is lost in the rounding of b₁'s cost."""
    s, U, W = ControlCosts(costs), Unbounded(), torch.tensor([[0.5, coupling], [coupling, 0.5]])
    bounded = BoundedFunction(lambda t, x: tuple(traced_minimum(s, U, W, x)), (-CORNER, CORNER))
    off = torch.linspace(-5e-7, 5e-7, 1000)
    second = 2 * coupling * 99.99 + off + 0.01 * off.sign()
    b = torch.stack([torch.full_like(off, 100.0), second], -1)
    at = torch.cat([torch.zeros(len(b), 1), b], -1)
    law = least_over(s, U, W.expand(len(b), 2, 2), b)
    for kernel in (None, bounded.kernel(at - 1e-9, at + 1e-9)):
        box = at - 1e-9, at + 1e-9
        form = (bounded.image(box_form(*box, 2)) if kernel is None else kernel.forms(*box))[0]
        low, high = form.interval()
        assert bool(((low <= law.u) & (law.u <= high)).all())


def test_a_sum_of_costs_of_a_users_own_has_no_description():
    class Twice(ControlCosts):
        def forward(self, u):
            return 2 * super().forward(u)

    assert register_minimum(ControlCosts([AbsoluteCost(0.5)]), Unbounded()) is not None
    assert register_minimum(Twice([AbsoluteCost(0.5)]), Unbounded()) is None


def test_a_description_has_all_numbers():
    costs = [ControlCosts([PowerCost(0.5, p)]) for p in (1.5, 1.5000000001)] + [ControlCosts([LogCosCost(0.5, 2.2)])]
    sets = [ControlBall(1.0), ControlBall(1 + 1e-15), ControlBox(-1.0, 1.0), Unbounded()]
    assert len({register_minimum(cost, U) for cost in costs for U in sets}) == len(costs) * len(sets)
