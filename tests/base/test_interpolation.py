"""Tables: SciPy's interpolations, their derivatives and bounds, in torch and in CasADi; and curves in time."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline, RegularGridInterpolator
from torch.testing import assert_close

import lyapnet
from lyapnet.base.interpolation import (
    ChebyshevProducts,
    Curve,
    FourierSeries,
    Interpolant,
    SmoothCurve,
    fewest_products,
)
from lyapnet.graphs.casadi_functions import casadi_function, require_equal, trace_for_casadi
from lyapnet.prover.bounds import BoundedFunction
from lyapnet.value.calculus import gradients
from tests.functions import box, points_in
from tests.problems import problem_of

NODES, VALUES = [-2.0, 0.0, 1.0, 2.5], [-0.4, 0.0, 0.3, 0.35]
OTHER = [-1.0, 0.2, 3.0]


@pytest.fixture
def surface():
    return np.random.default_rng(0).normal(size=(4, 3))


def test_one_axis_is_that_of_scipy():
    x = torch.linspace(-3, 3.5, 200)
    spline = CubicSpline(NODES, VALUES, bc_type="natural")
    inside = x.clamp(NODES[0], NODES[-1]).numpy()
    assert_close(lyapnet.Table([NODES], VALUES)(x[:, None]), torch.as_tensor(np.interp(x.numpy(), NODES, VALUES)))
    assert_close(lyapnet.Table([NODES], VALUES, "cubic")(x[:, None]), torch.as_tensor(spline(inside)))


def test_two_axes_are_those_of_scipy(surface):
    x = torch.rand(200, 2) * torch.tensor([4.5, 4.0]) + torch.tensor([-2.0, -1.0])
    bilinear = RegularGridInterpolator((NODES, OTHER), surface)
    assert_close(lyapnet.Table([NODES, OTHER], surface)(x), torch.as_tensor(bilinear(x.numpy())))
    along = CubicSpline(NODES, surface, axis=0, bc_type="natural")(x[:, 0].numpy())
    bicubic = [CubicSpline(OTHER, row, bc_type="natural")(float(y)) for row, y in zip(along, x[:, 1], strict=True)]
    assert_close(lyapnet.Table([NODES, OTHER], surface, "cubic")(x), torch.tensor(np.array(bicubic)))


def slope(table, x):
    leaf = torch.tensor([[float(x)]], requires_grad=True)
    return float(torch.autograd.grad(table(leaf).sum(), leaf)[0])


def test_derivatives_at_the_nodes():
    """One interval's slope at a kink, and not the sum of both; the spline's own in a spline."""
    linear, cubic = lyapnet.Table([NODES], VALUES), lyapnet.Table([NODES], VALUES, "cubic")
    spline = CubicSpline(NODES, VALUES, bc_type="natural")
    assert [slope(linear, x) for x in NODES] == pytest.approx([0, 0.2, 0.3, 0.05 / 1.5])
    assert [slope(cubic, x) for x in NODES[1:]] == pytest.approx([float(spline(x, 1)) for x in NODES[1:]])
    assert [slope(linear, x) for x in (-3, -1, 0.5, 3)] == pytest.approx([0, 0.2, 0.3, 0])


@pytest.mark.parametrize("method", ["linear", "cubic"])
def test_values_and_derivatives_lie_within_bounds(method, surface):
    table = lyapnet.Table([NODES, OTHER], surface, method)

    def function(t, x):
        with torch.enable_grad():
            leaf = x.detach().requires_grad_()
            y = table(leaf)
            (gradient,) = torch.autograd.grad(y.sum(), leaf)
        return y.detach(), gradient

    scale, shift = torch.tensor([1.0, 3.0, 2.5]), torch.tensor([0.0, 0.3, 1.0])
    bounded = BoundedFunction(function, (torch.tensor([0.0, -2.7, -1.5]), torch.tensor([1.0, 3.3, 3.5])))
    tight = 0
    for width in (1.0, 0.1, 1e-3):
        lower, upper = (side * scale + shift for side in box(width))
        points = points_in(lower, upper)
        values = function(points[..., 0], points[..., 1:])
        (low, high), (slope_low, slope_high) = bounded.bounds(lower, upper)
        assert bool(((low[:, None] <= values[0]) & (values[0] <= high[:, None])).all())
        assert bool(((slope_low[:, None] <= values[1]) & (values[1] <= slope_high[:, None])).all())
        tight += int((values[0] > (low + 0.5 * (high - low))[:, None]).sum())
    assert tight, "the twin: bounds of half the width do not hold"


@pytest.mark.parametrize("method", ["linear", "cubic"])
def test_casadi_knows_it(method, surface):
    table = lyapnet.Table([NODES, OTHER], surface, method)
    arguments = (torch.zeros(2),)
    translated = casadi_function(trace_for_casadi(lambda x: (table(x),), arguments), arguments)
    require_equal(translated, lambda x: (table(x),), arguments)


class Friction(lyapnet.SYSTEMS["double_integrator"]):
    """Measured friction."""

    def __init__(self):
        super().__init__()
        self.friction = lyapnet.Table([NODES], VALUES)

    dynamics = lyapnet.ControlAffineSystem.dynamics

    def f(self, x):
        return super().f(x) - torch.stack([torch.zeros_like(x[..., 0]), self.friction(x[..., 1:])], -1)


def test_a_system_may_have_one():
    problem = problem_of(Friction())
    problem.check()
    assert problem.float().system.f(torch.tensor([0.0, 1.0])).tolist() == pytest.approx([1.0, -0.3])


@pytest.mark.parametrize(
    ("grid", "values", "named"),
    [
        ([[0.0, 0.0, 1.0]], [1.0, 2.0, 3.0], "rising nodes on axis 0"),
        ([[0.0, 1.0], [2.0, 1.0]], [[1.0, 2.0], [3.0, 4.0]], "rising nodes on axis 1"),
        ([[0.0, float("inf")]], [1.0, 2.0], "rising nodes"),
        ([0.0, 1.0], [1.0, 2.0], "one list for each axis"),
        ([[0.0, 1.0]], [1.0, 2.0, 3.0], r"values of shape \(2,\), got \(3,\)"),
        ([[0.0, 1.0]], [1.0, float("nan")], "finite values"),
    ],
)
def test_what_is_no_table_is_refused(grid, values, named):
    with pytest.raises(ValueError, match=named):
        lyapnet.Table(grid, values)


def test_other_coordinates_and_methods_are_refused():
    with pytest.raises(ValueError, match=r"coordinates \(\*batch, 1\), got \(3, 2\)"):
        lyapnet.Table([NODES], VALUES)(torch.zeros(3, 2))
    with pytest.raises(ValueError, match="linear or cubic"):
        lyapnet.Table([NODES], VALUES, "quintic")


def riccati_path(steps):
    """(t, P(t)) of the double integrator with the cost of conf/double_integrator.yaml, by an integrator of SciPy."""
    Q, A, B = np.diag([10.0, 0.1]), np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])

    def backward(s, p):
        P = p.reshape(2, 2)
        return (Q + P @ A + A.T @ P - P @ B @ B.T @ P).ravel()

    t = np.linspace(0, 4, steps + 1)
    P = solve_ivp(backward, (0, 4), Q.ravel(), t_eval=t, rtol=1e-11, atol=1e-12).y.T[::-1].reshape(-1, 2, 2)
    return torch.tensor(t), torch.tensor(P.copy()), torch.tensor(np.array([-backward(0, p.ravel()) for p in P]))


def test_a_smooth_curve_follows_a_solution_of_riccatis_equation_and_its_slope():
    """From the nodes of 400 steps; the slope, which V_t is made of, too. A piecewise linear curve has 50 times more."""
    t, P, slope = riccati_path(400)
    errors = []
    for curve in (SmoothCurve(4.0, [2, 2]), Curve(torch.linspace(0, 4, 65), torch.zeros(65, 2, 2))):
        curve.fit(t, P)
        at = t.clone().requires_grad_()
        y = curve(at)
        assert_close(y[-1], P[-1], rtol=0, atol=1e-12)
        slopes = [torch.autograd.grad(y[:, i, j].sum(), at, retain_graph=True)[0] for i in (0, 1) for j in (0, 1)]
        apart = (y - P).abs().max(), (torch.stack(slopes, -1) - slope.flatten(1)).abs().max()
        errors.append([float(error.detach()) for error in apart])
    (value, rate), (_, coarse) = errors
    assert value < 1e-4
    assert rate < 0.02
    assert coarse > 50 * rate


def test_the_slope_at_the_end_is_right_where_y_settles_there_within_few_nodes():
    """A damped rate is forgotten within 0.05 s, five of the nodes; also between them, where no value was given."""

    def y(t):
        return torch.exp(20 * (t - 0.8)) + torch.cos(2 * t)

    curve, t = SmoothCurve(0.8, [1]), torch.linspace(0, 0.8, 81)
    curve.fit(t, y(t)[:, None])
    at = torch.linspace(0, 0.8, 1000).requires_grad_()
    (slope,) = torch.autograd.grad(curve(at).sum(), at)
    expected = 20 * torch.exp(20 * (at.detach() - 0.8)) - 2 * torch.sin(2 * at.detach())
    assert_close(slope, expected, rtol=0, atol=0.03)


def test_a_smooth_curve_takes_constants_as_they_are_and_few_nodes():
    curve = SmoothCurve(2.0, [3])
    curve.fit(torch.linspace(0, 2, 5), torch.tensor([[0.0, -3.0, 1e-30]]).expand(5, 3))
    assert_close(curve(torch.linspace(0, 2, 50)), torch.tensor([[0.0, -3.0, 1e-30]]).expand(50, 3), rtol=0, atol=0)


def test_bounds_of_a_smooth_curve_have_no_kinks():
    """Of its slope, on boxes across its time: a tenth of the width, a tenth of the range."""
    t, P, _ = riccati_path(400)
    curve = SmoothCurve(4.0, [2, 2])
    curve.fit(t, P)

    def slope(t, x):
        (V_t, _) = gradients(lambda t, x: ((curve(t) @ x[..., None])[..., 0] * x).sum(-1), t, x)
        return (V_t,)

    def widest(width):
        lower = torch.cat([torch.linspace(0, 4 - width, 40)[:, None], torch.ones(40, 2)], 1)
        upper = lower + torch.tensor([width, 0.0, 0.0])
        ((low, high),) = BoundedFunction(slope, (lower[0], upper[-1])).bounds(lower, upper)
        return float((high - low).max())

    assert widest(0.001) < 0.2 * widest(0.01) < 1.0


BASES = {
    "products": ChebyshevProducts(torch.tensor([-1.0, 2.0]).double(), torch.tensor([3.0, 2.5]).double(), [4, 3]),
    "one of no extent": ChebyshevProducts(torch.tensor([1.0, 2.0]).double(), torch.tensor([1.0, 2.5]).double(), [1, 5]),
    "series": FourierSeries(1.7, 7),
}


@pytest.mark.parametrize("basis", BASES.values(), ids=BASES)
def test_the_gradient_of_a_basis_is_autograds(basis):
    nodes = basis.nodes().double()
    low, high = nodes.amin(0), nodes.amax(0)
    p = (low + (high - low) * torch.rand(20, nodes.shape[-1]).double()).requires_grad_()
    c = torch.randn(20, len(nodes)).double()
    (expected,) = torch.autograd.grad((basis(p) * c).sum(), p)
    assert_close(basis.gradient(p.detach(), c), expected)


def test_the_fewest_products_that_are_accurate_are_found():
    low, high = torch.tensor([0.0, -1.0, 2.0]).double(), torch.tensor([1.0, 1.0, 2.0]).double()

    def function(p):
        return (1 / (1.5 + p[..., 0]) + p[..., 1] ** 2)[..., None]

    def is_accurate(basis, tested):
        return bool((Interpolant(basis, function(basis.nodes()))(tested) - function(tested)).abs().max() < 1e-5)

    tested = low + (high - low) * torch.rand(50, 3).double()
    found = fewest_products(low, high, is_accurate, tested, most=100)
    assert found is not None
    assert found.counts == [9, 3, 1]
    assert not is_accurate(ChebyshevProducts(low, high, [5, 3, 1]), tested)
    assert not is_accurate(ChebyshevProducts(low, high, [9, 2, 1]), tested)
    assert fewest_products(low, high, is_accurate, tested, most=27) is None
