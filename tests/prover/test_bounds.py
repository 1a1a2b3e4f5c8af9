"""Bounds on boxes: sound on random points, exact digits and whole conditions; tight to second order."""

import math

import mpmath
import pytest
import torch

from lyapnet.base.errors import UsageError
from lyapnet.loop.rollout import ClosedLoop
from lyapnet.prover import elementary_functions as functions
from lyapnet.prover import taylor
from lyapnet.prover.bound_rules import ARRANGEMENTS, RULES
from lyapnet.prover.bounds import BoundedFunction
from lyapnet.prover.condition import DecreaseCondition
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.systems import SYSTEMS
from lyapnet.value.networks import FCN, NETWORKS, Scaling, TerminalAnchor
from lyapnet.value.policy import POLICIES
from tests.functions import FUNCTIONS, SMOOTH, box, points_in, without_remainder
from tests.marks import sample
from tests.problems import problem_of


def violations(bounded, function, lower, upper):
    """How many values at points of the boxes lie outside the bounds."""
    points = points_in(lower, upper)
    count = 0
    values = torch.func.vmap(torch.func.vmap(lambda p: function(p[0], p[1:])))(points)
    for (low, high), value in zip(bounded.bounds(lower, upper), values, strict=True):
        count += int(((value < low[:, None]) | (value > high[:, None]) | low[:, None].isnan()).sum())
    return count


WITH_REMAINDERS = [
    (name, degree) for name in SMOOTH for degree in (1, 3) if degree == 1 or name not in ("power", "sin")
]


def several(function):
    return lambda t, x: (function(t, x),)


UNIT = torch.tensor([0.0, -1.0, -1.0]), torch.tensor([1.0, 1.0, 1.0])


def unit():
    return tuple(side.double() for side in UNIT)


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_values_lie_within_bounds(name, degree):
    function = several(FUNCTIONS[name])
    bounded = BoundedFunction(function, unit(), degree)
    for width in (2.0, 0.5, 0.1, 1e-2, 1e-5, 0.0):
        lower, upper = box(width)
        assert violations(bounded, function, lower, upper) == 0
    assert all(torch.stack(pair).isfinite().all() for pair in bounded.bounds(*box(0.1)))


@pytest.mark.parametrize(
    ("name", "degree"),
    [*((name, 1) for name in SMOOTH), *((name, 3) for name in SMOOTH if name not in ("power", "sin"))],
)
def test_functions_without_their_remainder_are_caught(name, degree, monkeypatch):
    """In third degree a power has none, as it is multiplied out, and that of sin is smaller than the slack of Σ|C|."""
    monkeypatch.setattr(functions, "linearised", without_remainder(functions.linearised))
    function = several(FUNCTIONS[name])
    assert violations(BoundedFunction(function, unit(), degree), function, *box(0.5 * degree)) > 0


@pytest.mark.parametrize("degree", [1, 3])
def test_products_without_their_remainder_are_caught(degree, monkeypatch):
    monkeypatch.setattr(taylor, "multiply", without_remainder(taylor.multiply))
    function = several(lambda t, x: FUNCTIONS["product"](t, x) ** 2)
    assert violations(BoundedFunction(function, unit(), degree), function, *box(0.5)) > 0


@pytest.mark.parametrize("name", ["exp", "sigmoid", "sin", "cos", "sqrt", "log1p", "reciprocal", "square", "softplus"])
def test_the_remainder_of_a_function_is_no_larger_than_needed(name):
    """On wide intervals too: the band a x + b ± e touches the graph of f on both sides."""
    function = getattr(functions, name)
    lower = torch.linspace(0.3, 4, 50)[:, None]
    if name not in ("sqrt", "log1p", "reciprocal"):
        lower = lower - 3
    form = function(taylor.box_form(lower, lower + 2.5))
    y = torch.linspace(-1, 1, 20_001)[:, None]
    value = {
        "square": lambda x: x**2, "reciprocal": lambda x: 1 / x, "softplus": torch.nn.functional.softplus,
    }.get(name, getattr(torch, name, None))(lower[:, 0] + 1.25 * (y + 1))  # fmt: skip
    distance = value - (form.center[:, 0] + form.coefficients[0, :, 0] * y)
    radius = form.radius[:, 0]
    torch.testing.assert_close(distance.amax(0), radius, rtol=1e-5, atol=1e-9)
    torch.testing.assert_close(distance.amin(0), -radius, rtol=1e-5, atol=1e-9)


EXPANDED = {
    "exp": torch.exp, "log": torch.log, "log1p": torch.log1p, "sqrt": torch.sqrt, "reciprocal": torch.reciprocal,
    "sigmoid": torch.sigmoid, "softplus": torch.nn.functional.softplus, "sin": torch.sin, "cos": torch.cos,
}  # fmt: skip


def distances_from_polynomials(name, width, degree):
    """(f − (c + A ε + B ε² + C ε³) on [l, l + width], (points, l); r) for many l."""
    lower = torch.linspace(0.3, 4, 200)[:, None]
    if name in ("sigmoid", "softplus", "sin", "cos", "exp"):
        lower = 2 * lower - 5
    form = getattr(functions, name)(taylor.box_form(lower, lower + width, degree))
    y = torch.linspace(-1, 1, 2001)[:, None]
    value = EXPANDED[name](lower[:, 0] + width / 2 * (y + 1))
    polynomial = sum(form.terms[k, :, 0] * y**k for k in range(degree + 1))
    return (value - polynomial).abs(), form.radius[:, 0]


@pytest.mark.parametrize("degree", [2, 3])
@pytest.mark.parametrize("width", [2.5, 0.5, 1e-2, 1e-5])
@pytest.mark.parametrize("name", EXPANDED)
def test_functions_lie_within_their_polynomials(name, width, degree):
    distance, radius = distances_from_polynomials(name, width, degree)
    assert (distance <= radius).all()


@pytest.mark.parametrize("degree", [2, 3])
@pytest.mark.parametrize("name", EXPANDED)
def test_remainders_are_of_the_next_order_and_not_idle(name, degree):
    """At least a third of them is needed somewhere; eight or sixteen times less on half the width."""
    distance, radius = distances_from_polynomials(name, 0.1, degree)
    _, smaller = distances_from_polynomials(name, 0.05, degree)
    assert (distance.amax(0) / radius).median() > 1 / 3
    assert math.log2(radius.median() / smaller.median()) == pytest.approx(degree + 1, abs=0.3 * (degree - 1))


def test_a_product_of_second_degree_is_exact_up_to_third_order():
    """(ε₁ + ε₁ε₂)(ε₂ + ε₂²) over a box of points: no cancellation is lost below third order."""
    x, y = (taylor.box_form(*(torch.full((1, 2), side) for side in (-0.1, 0.1)), degree=2) for _ in range(2))
    product = taylor.multiply(x, y)
    assert taylor.monomials(2, 2)[3:] == [(0, 0), (0, 1), (1, 1)]
    torch.testing.assert_close(product.products[:, 0], torch.tensor([[0.01, 0.0], [0.0, 0.0], [0.0, 0.01]]))
    assert float(product.radius.max()) < 1e-15
    curved = taylor.multiply(product, taylor.add(x, product))
    assert 0 < float(curved.radius.max()) < 3 * 0.1**3


def test_a_product_of_third_degree_is_exact_up_to_fourth_order():
    """(1 + ε₁)(1 + ε₂)(1 + ε₁ + ε₂), multiplied out; no cancellation is lost below fourth order."""
    box = taylor.box_form(torch.zeros(1, 2), torch.full((1, 2), 2.0), degree=3)  # 1 + ε
    x, y = (box.with_parts(box.terms[..., k], box.radius[..., k]) for k in range(2))
    both = taylor.shift(taylor.add(x, y), torch.tensor(-1.0))
    product = taylor.multiply(taylor.multiply(x, y), both)
    names = {(): 1.0, (0,): 2.0, (1,): 2.0, (0, 0): 1.0, (0, 1): 3.0, (1, 1): 1.0, (0, 0, 1): 1.0, (0, 1, 1): 1.0}
    expected = torch.tensor([names.get(axes, 0.0) for axes in taylor.monomials(2, 3)])
    torch.testing.assert_close(product.terms[:, 0], expected)
    assert float(product.radius.max()) < 1e-12
    fourth = taylor.multiply(product, both)
    assert 0 < float(fourth.radius.max()) <= 4 + 1e-9  # Σ|C| times Σ|A|


def test_bounds_of_a_parabola_know_its_vertex():
    """−x² + x on [0, 1] is at most ¼, which lies in the middle; −(x² + y²) + xy is at most 0, where both meet."""
    form = taylor.box_form(torch.zeros(1, 1), torch.ones(1, 1), degree=2)
    low, high = taylor.add(form, taylor.negate(functions.square(form))).interval()
    assert (float(low), float(high)) == pytest.approx((0.0, 0.25), abs=1e-12)
    x, y = (
        form.with_parts(form.terms[..., k : k + 1], form.radius[..., k : k + 1])
        for form in [taylor.box_form(-torch.ones(1, 2), torch.ones(1, 2), degree=2)]
        for k in range(2)
    )
    definite = taylor.add(taylor.multiply(x, y), taylor.negate(taylor.add(functions.square(x), functions.square(y))))
    assert float(definite.interval()[1]) == pytest.approx(0, abs=1e-12)


EXACT = {
    "affine": (lambda x: 0.1 * x / 3 - 0.3 * (x + 0.1), lambda x: x * D(0.1) / 3 - D(0.3) * (x + D(0.1))),
    "cubes": (lambda x: (x + 0.1) ** 3 - x * x * x, lambda x: (x + D(0.1)) ** 3 - x**3),
    "exp": (lambda x: torch.exp(x) / (1 + x**2), lambda x: mpmath.exp(x) / (1 + x**2)),
    "sigmoid": (lambda x: torch.sigmoid(x) + torch.tanh(x), lambda x: 1 / (1 + mpmath.exp(-x)) + mpmath.tanh(x)),
    "waves": (lambda x: torch.sin(9 * x) * torch.cos(x), lambda x: mpmath.sin(9 * x) * mpmath.cos(x)),
    "softplus": (lambda x: torch.log1p(torch.exp(x)).sqrt(), lambda x: mpmath.sqrt(mpmath.log(1 + mpmath.exp(x)))),
}  # fmt: skip


def D(number):
    return mpmath.mpf(number)


def digits_outside(name):
    """The number of values, of 50 digits at 50 points, that lie outside their bounds at the point."""
    function, exact = EXACT[name]
    bounded = BoundedFunction(lambda t, x: (function(x),), unit())
    point = box(0.0, 50)[0]
    ((low, high),) = bounded.bounds(point, point)
    assert float((high - low).max()) < 1e-12
    with mpmath.workdps(50):
        true = [[exact(D(float(v))) for v in row[1:]] for row in point]
        return sum(
            not (D(float(low[i, j])) <= value <= D(float(high[i, j])))
            for i, row in enumerate(true)
            for j, value in enumerate(row)
        )


@pytest.mark.parametrize("name", EXACT)
def test_rounding_is_covered(name):
    assert digits_outside(name) == 0


@pytest.mark.parametrize("name", ["affine", "cubes", "exp"])
def test_without_a_margin_rounding_is_not_covered(name, monkeypatch):
    for module in (taylor, functions):
        monkeypatch.setattr(module, "EPSILON", 0.0)
    assert digits_outside(name) > 0


def applied(function):
    return lambda t, x: (function(x),)


def test_an_operator_without_a_rule_is_named():
    truths = lambda x: ((x > 0) + (x < 1)) * x  # noqa: E731  torch reads 1 + 1 as true there
    for function, named in ((torch.erf, "erf"), (torch.floor, "floor"), (torch.cosh, "cosh"), (truths, "add")):
        with pytest.raises(UsageError, match=f"rule for bounds, got aten.{named}"):
            BoundedFunction(applied(function), unit())
    with pytest.raises(UsageError, match=r"whole exponent.*1\.5"):
        BoundedFunction(lambda t, x: ((x + 2) ** 1.5,), unit())
    with pytest.raises(UsageError, match="control flow that does not depend on values"):
        BoundedFunction(lambda t, x: (x if x[0] > 0 else -x,), unit())


@pytest.mark.parametrize(
    "function", [lambda x: 1 / x, torch.sqrt, torch.log1p, lambda x: torch.exp(1000 * x), lambda x: torch.sin(50 * x)]
)
def test_where_a_function_has_no_bound_none_is_given(function):
    """Results that depend on it have no bounds either."""
    bounded = BoundedFunction(lambda t, x: (0 * function(x) * x + x,), unit())
    ((low, high),) = bounded.bounds(torch.tensor([[0.0, -2.0, 0.5]]), torch.tensor([[1.0, 2.0, 1.0]]))
    assert low[0, 0] == -torch.inf
    assert high[0, 0] == torch.inf


def test_every_rule_has_a_derivation():
    assert all(function.__doc__ or function.__name__ == "<lambda>" for function in RULES.values())
    assert not RULES.keys() & ARRANGEMENTS.keys()


# Whole conditions


def condition(system_name, network, policy="hjb", **options):
    system = SYSTEMS[system_name]()
    cost = QuadraticCost(torch.eye(system.n), system.inverse_mass, torch.eye(system.n))
    V = NETWORKS[network](Scaling([1.0] * system.n, 1.0, 3.0), hidden=(8, 8), **options).requires_grad_(False)
    V = TerminalAnchor(V, cost, 1.0)
    problem = problem_of(system, cost)
    return DecreaseCondition(ClosedLoop(problem, POLICIES[policy](problem, V)), 0.9, 0.01), system.n


CONDITIONS = [
    ("double_integrator", "fcn", {}), ("double_integrator", "anchored", {}), ("double_integrator", "icnn", {}),
    ("cartpole", "fcn", {"embedded_angles": (1,), "activation": "sin"}),
    ("reacher", "fcn", {"activation": "silu"}),
]  # fmt: skip


@pytest.mark.gate
@pytest.mark.parametrize(("system", "network", "options"), sample(CONDITIONS, 3))
def test_whole_conditions_lie_within_bounds(system, network, options):
    c, n = condition(system, network, **options)

    def function(t, x):
        return c(t, x), c.V(t, x)

    bounded = BoundedFunction(function, (torch.zeros(1 + n).double() - 0.5, torch.ones(1 + n).double()))
    for width in (1.0, 0.1, 1e-5):
        lower, upper = box(width, 60, n)
        points = points_in(lower, upper)
        with torch.no_grad():
            values = function(points[..., 0], points[..., 1:])
        for (low, high), value in zip(bounded.bounds(lower, upper), values, strict=True):
            assert ((low[:, None] <= value) & (value <= high[:, None])).all()


def test_a_condition_of_another_alpha_is_caught():
    """The twin: bounds of the condition at α = 0.8 do not hold the one at 0.9."""
    c, n = condition("double_integrator", "fcn")
    bounded = BoundedFunction(several(c), unit())
    c.alpha = 0.8
    lower, upper = box(1e-2, 60, n)
    points = points_in(lower, upper)
    with torch.no_grad():
        value = c(points[..., 0], points[..., 1:])
    ((low, high),) = bounded.bounds(lower, upper)
    assert ((value < low[:, None]) | (high[:, None] < value)).any()


def test_the_excess_of_the_width_is_of_second_order():
    c, n = condition("double_integrator", "fcn")
    bounded = BoundedFunction(several(c), unit())
    center, excess = box(0.0, 20)[0], []
    grid = torch.cartesian_prod(*[torch.linspace(-1, 1, 13)] * (1 + n))
    for half in (0.1, 0.05, 0.025, 0.0125):
        ((low, high),) = bounded.bounds(center - half, center + half)
        points = center[:, None] + half * grid
        with torch.no_grad():
            value = c(points[..., 0], points[..., 1:])
        excess.append(float(((high - low) - (value.amax(1) - value.amin(1))).mean()))
    orders = torch.tensor(excess[:-1]).div(torch.tensor(excess[1:])).log2()
    assert (orders > 1.8).all()
    assert (orders < 2.5).all()


def test_alpha_and_delta_are_checked():
    c, _ = condition("double_integrator", "fcn")
    for alpha, delta, named in ((0.0, 0.1, "alpha"), (1.1, 0.1, "alpha"), (0.9, -1.0, "delta")):
        with pytest.raises(UsageError, match=named):
            DecreaseCondition(c.closed_loop, alpha, delta)


def test_float32_weights_are_taken_as_they_are():
    V = FCN(Scaling([1.0, 1.0], 1.0, 3.0), hidden=(8,)).float().requires_grad_(False).double()
    bounded = BoundedFunction(several(V), unit())
    assert violations(bounded, several(V), *box(0.1)) == 0


@pytest.mark.parametrize(
    "function",
    [functions.log, functions.log1p, functions.sqrt, functions.reciprocal],
    ids=lambda f: f.function.__name__,
)
def test_close_to_where_a_function_ends_nothing_is_lost(function):
    """On [l, u] with u/l ≥ 1e15: the third derivative is bounded on [l, u], not a rounding error outside it."""
    box = taylor.box_form(torch.tensor([[-1.0]]), torch.tensor([[1.0]]), 2)
    offset = 1.0 if function is functions.log1p else 0.0
    known = 0
    for least in torch.logspace(-15.5, -13, 80):
        form = function(taylor.shift(taylor.multiply(box, box), least - offset))
        low, high = form.interval()
        values = function.function(torch.stack([least, 0.25 + least, 1 + least]) - offset)
        assert (low <= values.min()).all()
        assert (values.max() <= high).all()
        known += int(high.isfinite().all())
    assert known > 20


@pytest.mark.filterwarnings("ignore:Sparse CSR tensor support is in beta")
def test_a_sparse_constant_is_bounded_as_a_dense_one():
    dense, box = torch.eye(2).double(), taylor.box_form(torch.zeros(3, 2).double(), torch.ones(3, 2).double())
    sparse, same = (taylor.constant_form(value, box).interval() for value in (dense.to_sparse_csr(), dense))
    assert all(torch.equal(side, other) for side, other in zip(sparse, same, strict=True))
    assert all(torch.allclose(side, dense, rtol=0, atol=1e-12) for side in sparse)
