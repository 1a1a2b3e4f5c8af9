"""Every rule for bounds, on random boxes: no point, found at random, in corners or by ascent, lies outside."""

import operator

import mpmath
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.func import vmap
from torch.nn import functional

from lyapnet.experiment.assembly.classes import default_dtype
from lyapnet.prover import elementary_functions, taylor
from lyapnet.prover.bound_rules import ARRANGEMENTS, RULES
from lyapnet.prover.bounds import BoundedFunction
from lyapnet.prover.branches import decisions
from lyapnet.prover.rounding import ROUNDED
from lyapnet.task.cost.control_costs import AbsoluteCost, ControlCosts
from lyapnet.task.cost.minimum import LEAST, register_minimum
from lyapnet.task.sets import ControlBox
from tests.marks import sample

aten = torch.ops.aten
AXES = 3
WIDTHS = (2.0, 0.5, 0.1, 1e-2, 1e-3, 1e-5)
INDEX, TWICE = torch.tensor([2, 0]), torch.tensor([2, 2])

with default_dtype(torch.float64):  # in float32 the limits are 4e-9 off
    COST, LIMITS = ControlCosts([AbsoluteCost(0.3)]), ControlBox(-0.4, 0.2)
    FUEL = register_minimum(COST, LIMITS)


def least_fuel(b):
    """argmin and min of Σ u² + bu + 0.3|u| for −0.4 ≤ u ≤ 0.2."""
    u = (torch.nn.functional.softshrink(b, 0.3) / -2).clamp(-0.4, 0.2)
    return torch.cat([u, (u * u + b * u + 0.3 * u.abs()).sum()[None]])


CASES = {
    ROUNDED: lambda y, z, M, N: ROUNDED(y, z, 1e-9, 1e-9, 1e9),
    LEAST: lambda y, z, M, N: LEAST(EYE, y, FUEL),
    aten.relu.default: lambda y, z, M, N: aten.relu(y),
    aten.leaky_relu.default: lambda y, z, M, N: aten.leaky_relu(y, 0.3),
    aten.abs.default: lambda y, z, M, N: aten.abs(y),
    aten.clamp.default: lambda y, z, M, N: aten.clamp(y, -0.4, 0.7),
    aten.clamp_min.default: lambda y, z, M, N: aten.clamp_min(y, 0.2),
    aten.clamp_max.default: lambda y, z, M, N: aten.clamp_max(y, -0.2),
    aten.clamp.Tensor: lambda y, z, M, N: aten.clamp.Tensor(y, z - 0.5, M[0]),
    aten.clamp_min.Tensor: lambda y, z, M, N: aten.clamp_min.Tensor(y, z),
    aten.clamp_max.Tensor: lambda y, z, M, N: aten.clamp_max.Tensor(y, z),
    aten.maximum.default: lambda y, z, M, N: aten.maximum(y, z),
    aten.minimum.default: lambda y, z, M, N: aten.minimum(y, M),
    aten.sign.default: lambda y, z, M, N: aten.sign(y) * z,
    aten.sgn.default: lambda y, z, M, N: aten.sgn(y) + z,
    aten.gt.Scalar: lambda y, z, M, N: aten.gt(y, 0.1) * z,
    aten.gt.Tensor: lambda y, z, M, N: aten.gt(y, z) * z,
    aten.ge.Scalar: lambda y, z, M, N: aten.ge(y, 0.1) * z,
    aten.ge.Tensor: lambda y, z, M, N: aten.ge(y, z) * z,
    aten.lt.Scalar: lambda y, z, M, N: aten.lt(y, 0.1) * z,
    aten.lt.Tensor: lambda y, z, M, N: aten.lt(y, z) * z,
    aten.le.Scalar: lambda y, z, M, N: aten.le(y, 0.1) * z,
    aten.le.Tensor: lambda y, z, M, N: aten.le(y, z) * z,
    aten.eq.Scalar: lambda y, z, M, N: aten.eq(aten.relu(y), 0.0) * z,
    aten.eq.Tensor: lambda y, z, M, N: aten.eq(aten.maximum(y, z), y) * z,
    aten.ne.Scalar: lambda y, z, M, N: aten.ne(aten.relu(y), 0.0) * z,
    aten.ne.Tensor: lambda y, z, M, N: aten.ne(aten.maximum(y, z), y) * z,
    aten.bitwise_and.Tensor: lambda y, z, M, N: aten.bitwise_and(y > -0.5, z > -0.5) * z,
    aten.logical_and.default: lambda y, z, M, N: aten.logical_and(aten.relu(y), aten.relu(z)) * z,
    aten.bitwise_or.Tensor: lambda y, z, M, N: aten.bitwise_or(y > 0, z > 0) * z,
    aten.logical_or.default: lambda y, z, M, N: aten.logical_or(aten.relu(y), z > 0) * z,
    aten.bitwise_not.default: lambda y, z, M, N: aten.bitwise_not(y > 0) * z,
    aten.logical_not.default: lambda y, z, M, N: aten.logical_not(aten.relu(y)) * z,
    aten.threshold_backward.default: lambda y, z, M, N: aten.threshold_backward(z, y, 0.1),
    aten.leaky_relu_backward.default: lambda y, z, M, N: aten.leaky_relu_backward(z, y, 0.3, False),
    aten.where.self: lambda y, z, M, N: aten.where(y > 0, z, M[0] - 2),
    aten.masked_fill.Scalar: lambda y, z, M, N: aten.masked_fill(z, y > 0, 3.0),
    aten.masked_fill.Tensor: lambda y, z, M, N: aten.masked_fill(z, y > 0, M[0, 0]),
    aten._linalg_solve_ex.default: lambda y, z, M, N: torch.linalg.solve_ex(M + 4 * EYE, y)[0],
    aten.linalg_inv_ex.default: lambda y, z, M, N: torch.linalg.inv_ex(M + 4 * EYE)[0],
    aten.add.Tensor: lambda y, z, M, N: aten.add(y, M, alpha=0.3),
    aten.add.Scalar: lambda y, z, M, N: aten.add.Scalar(y, 0.1, 3.0),
    aten.sub.Tensor: lambda y, z, M, N: aten.sub(y, M, alpha=0.3),
    aten.sub.Scalar: lambda y, z, M, N: aten.sub.Scalar(y, 0.1),
    aten.rsub.Scalar: lambda y, z, M, N: aten.rsub(y, 0.1),
    aten.rsub.Tensor: lambda y, z, M, N: aten.rsub(y, z, alpha=0.7),
    aten.mul.Tensor: lambda y, z, M, N: aten.mul(y, M) + aten.mul(z, z),
    aten.mul.Scalar: lambda y, z, M, N: aten.mul.Scalar(y, 0.3),
    aten.div.Tensor: lambda y, z, M, N: aten.div(y, 3 + z) + aten.div(y, 0.3 * INDEX[0]),
    aten.div.Scalar: lambda y, z, M, N: aten.div.Scalar(y, 0.3),
    aten.pow.Tensor_Scalar: lambda y, z, M, N: aten.pow(y, 2) + aten.pow(z, 5) + aten.pow(4 + y, -3) + (z + 4) ** 0.5,
    aten.mm.default: lambda y, z, M, N: aten.mm(M, N) + aten.mm(M, EYE + 0.1) + aten.mm(EYE - 0.2, N),
    aten.bmm.default: lambda y, z, M, N: aten.bmm(M[None].expand(2, 3, 3), N[None] * PAIR),
    aten.mv.default: lambda y, z, M, N: aten.mv(M, y) + aten.mv(EYE + 0.3, z),
    aten.dot.default: lambda y, z, M, N: aten.dot(y, z)[None] + aten.dot(y, y),
    aten._to_copy.default: lambda y, z, M, N: (y > 0).to(torch.float64) + z,
    aten.addmm.default: lambda y, z, M, N: aten.addmm(y, M, N, beta=0.3, alpha=0.7),
    aten.neg.default: lambda y, z, M, N: aten.neg(y),
    aten.sum.default: lambda y, z, M, N: aten.sum(M)[None],
    aten.sum.dim_IntList: lambda y, z, M, N: aten.sum(M, [0], True),
    aten.mean.default: lambda y, z, M, N: aten.mean(M)[None],
    aten.mean.dim: lambda y, z, M, N: aten.mean(M, [-1]),
    aten.exp.default: lambda y, z, M, N: aten.exp(3 * y),
    aten.log.default: lambda y, z, M, N: aten.log(1.5 + y),
    aten.log1p.default: lambda y, z, M, N: aten.log1p(0.5 + y),
    aten.sqrt.default: lambda y, z, M, N: aten.sqrt(1.5 + y),
    aten.reciprocal.default: lambda y, z, M, N: aten.reciprocal(y),
    aten.sigmoid.default: lambda y, z, M, N: aten.sigmoid(6 * y),
    aten.sin.default: lambda y, z, M, N: aten.sin(6 * y),
    aten.cos.default: lambda y, z, M, N: aten.cos(6 * y),
    aten.tan.default: lambda y, z, M, N: aten.tan(3 * y),
    aten.rsqrt.default: lambda y, z, M, N: aten.rsqrt(1.5 + y),
    aten.tanh.default: lambda y, z, M, N: aten.tanh(4 * y),
    aten.softplus.default: lambda y, z, M, N: aten.softplus(30 * y) + aten.softplus(y, 3.0, 1.0),
    aten.softplus_backward.default: lambda y, z, M, N: aten.softplus_backward(z, 30 * y, 1.0, 20.0),
    aten.silu.default: lambda y, z, M, N: aten.silu(4 * y),
    aten.silu_backward.default: lambda y, z, M, N: aten.silu_backward(z, 4 * y),
    aten.sigmoid_backward.default: lambda y, z, M, N: aten.sigmoid_backward(z, y),
    aten.tanh_backward.default: lambda y, z, M, N: aten.tanh_backward(z, y),
    aten.index_add.default: lambda y, z, M, N: aten.index_add(y, 0, INDEX, z[:2]),
    aten.index_put.default: lambda y, z, M, N: aten.index_put(y, [TWICE], M[0, :2] * z[:2], True),
    **{
        operation: lambda y, z, M, N, operation=operation, extra=extra: operation(y, *extra) * z + y
        for operation, extra in {
            aten.zeros_like.default: (), aten.ones_like.default: (), aten.full_like.default: (0.3,),
            aten.new_zeros.default: ([3],), aten.new_ones.default: ([3],), aten.new_full.default: ([3], 0.3),
            aten.fill.Scalar: (0.3,),
        }.items()
    },
    aten.empty_like.default: lambda y, z, M, N: aten.fill(aten.empty_like(y), 0.3) * z,
    aten.expand.default: lambda y, z, M, N: aten.expand(y, [2, 3]),
    aten.permute.default: lambda y, z, M, N: aten.permute(M, [1, 0]) + y,
    aten.t.default: lambda y, z, M, N: aten.t(M) + y,
    aten.transpose.int: lambda y, z, M, N: aten.transpose(M, 0, 1) + y,
    aten.unsqueeze.default: lambda y, z, M, N: aten.unsqueeze(y, -1) + y,
    aten.squeeze.default: lambda y, z, M, N: aten.squeeze(M[:1]) + M,
    aten.squeeze.dim: lambda y, z, M, N: aten.squeeze(M[:1], 0) + M,
    aten.squeeze.dims: lambda y, z, M, N: aten.squeeze.dims(M[:1], [0]) + M,
    aten.select.int: lambda y, z, M, N: aten.select(M, 1, 2),
    aten.slice.Tensor: lambda y, z, M, N: aten.slice(M, 0, 1, 3),
    aten.index.Tensor: lambda y, z, M, N: aten.index(M, [INDEX]),
    aten.select_backward.default: lambda y, z, M, N: aten.select_backward(y, [3, 3], 1, 2) + z,
    aten.unbind.int: lambda y, z, M, N: sum(aten.unbind(M, 1)),
    aten.slice_backward.default: lambda y, z, M, N: aten.slice_backward(y[:2], [3], 0, 1, 3, 1) + z,
    aten.split.Tensor: lambda y, z, M, N: aten.split(M, 2, 0)[1],
    aten.flip.default: lambda y, z, M, N: aten.flip(M, [0]),
    aten.diagonal.default: lambda y, z, M, N: aten.diagonal(M),
    aten.diag_embed.default: lambda y, z, M, N: aten.diag_embed(y),
    aten.view.default: lambda y, z, M, N: aten.view(M, [9]),
    aten._unsafe_view.default: lambda y, z, M, N: aten._unsafe_view(M, [9]),
    aten.cat.default: lambda y, z, M, N: aten.cat([y, torch.ones(1), z]),
    aten.stack.default: lambda y, z, M, N: aten.stack([y, z], 1),
    operator.getitem: lambda y, z, M, N: aten.unbind(M)[1],
}  # fmt: skip
"""Operator ↦ a function of y, z (3,) and M, N (3, 3), which depend on the point and have remainders of their own."""

WRITTEN_OUT = {
    aten.masked_fill.Tensor: lambda y, z, M, N: torch.where(y > 0, M[0, 0], z),
    aten.fill.Scalar: lambda y, z, M, N: 0.3 * z + y,
    aten.empty_like.default: lambda y, z, M, N: 0.3 * z,
    ROUNDED: lambda y, z, M, N: y,
    LEAST: lambda y, z, M, N: least_fuel(y),
    aten.silu_backward.default: lambda y, z, M, N: z * torch.sigmoid(4 * y) * (1 + 4 * y * torch.sigmoid(-4 * y)),
}
"""The same, for operators that torch does not batch or differentiate."""

EYE = torch.eye(3, dtype=torch.float64)
PAIR = torch.tensor([0.5, -1.5], dtype=torch.float64)[:, None, None]


def test_every_rule_has_a_case():
    assert (RULES.keys() | ARRANGEMENTS.keys()) == CASES.keys()


def graph_of(case, seed):
    """The case on arguments that are random functions of the point, linear and bilinear."""
    generator = torch.Generator().manual_seed(seed)
    offset, linear, bilinear = (torch.randn(24, k, generator=generator) for k in (1, AXES, AXES))

    def function(t, x):
        p = torch.cat([t[None], x])
        values = 0.4 * (offset[:, 0] + linear @ p) + 0.2 * (bilinear @ (p * p.flip(0)))
        return (case(values[:3], values[3:6], values[6:15].reshape(3, 3), values[15:].reshape(3, 3)),)

    return function


def random_boxes(boxes, seed):
    """Boxes of all the WIDTHS, and flatter along some axes."""
    generator = torch.Generator().manual_seed(seed)
    center = 2 * torch.rand(boxes, AXES, generator=generator) - 1
    widest = torch.tensor(WIDTHS)[torch.arange(boxes) % len(WIDTHS)]
    half = widest[:, None] / 2 * torch.rand(boxes, AXES, generator=generator)
    return center - half, center + half


def values_at(function, points):
    """(points, *shape)."""
    return vmap(lambda p: function(p[0], p[1:])[0])(points)


def values_on(function, lower, upper, starts=4, steps=8):
    """Values in each box, (boxes, values, *shape): at corners, random points, and on ascents or descents."""
    unit = torch.rand(starts, *lower.shape)
    unit[::2] = unit[::2].round()
    points, seen, directions = (lower + (upper - lower) * unit).flatten(0, 1), [], None
    low, high = (side.repeat(starts, 1) for side in (lower, upper))
    for step in range(steps + 1):
        leaf = points.requires_grad_()
        values = values_at(function, leaf).flatten(1)
        seen.append(values.detach().unflatten(0, (starts, len(lower))))
        if directions is None:
            chosen = torch.nn.functional.one_hot(torch.randint(values.shape[1], (len(values),)), values.shape[1])
            directions = chosen * torch.randn(len(values), 1).sign()
        if step == steps:
            break
        (slope,) = torch.autograd.grad((directions * values).nan_to_num().sum(), leaf)
        length = (0.5 if step % 2 else 0.1) * 0.8**step * (high - low)
        points = (points.detach() + length * slope.sign().nan_to_num()).clamp(low, high)
    return torch.cat(seen).transpose(0, 1)


def violated(bounds, values, share=1.0):
    """Which boxes have a value outside that share of their bounds, (boxes,); nan lies within no bounds but infinite."""
    low, high = (side.flatten(1)[:, None] for side in bounds)
    if share < 1:
        low, high = (low + high) / 2 - share * (high - low) / 2, (low + high) / 2 + share * (high - low) / 2
    unknown = (low == -torch.inf) & (high == torch.inf)
    return (~((low <= values) & (values <= high)) & ~unknown).any(-1).any(-1)


def examine(operation, boxes, seed=0):
    """(boxes with a violation, boxes with one of bounds made 20 % narrower, boxes with bounds) of an operator."""
    function, (lower, upper) = graph_of(CASES[operation], seed), random_boxes(boxes, seed)
    torch.manual_seed(seed)
    bounded = BoundedFunction(function, (lower.amin(0), upper.amax(0)))
    assert operation in bounded.operators, "the trace wrote it with other operators"
    (bounds,) = bounded.bounds(lower, upper)
    values = values_on(graph_of(WRITTEN_OUT.get(operation, CASES[operation]), seed), lower, upper)
    known = (bounds[1] - bounds[0]).flatten(1).isfinite().all(1)
    return tuple(int(count.sum()) for count in (violated(bounds, values), violated(bounds, values, 0.8), known))


@pytest.mark.parametrize("operation", sample(CASES, 2), ids=str)
def test_no_value_lies_outside(operation):
    """The twin: bounds made 20 % narrower are caught."""
    outside, outside_narrower, known = examine(operation, 300)
    assert outside == 0
    assert outside_narrower > 0
    assert known > 100


@pytest.mark.parametrize("operation", sample(CASES, 25), ids=str)
def test_no_value_of_other_functions_lies_outside(operation):
    """test_rules_at_length.py has ten thousand boxes of each."""
    counts = [examine(operation, 600, seed) for seed in (1, 2)]
    assert sum(outside for outside, _, _ in counts) == 0


# Compositions

UNARY = {
    "sin": torch.sin, "cos": torch.cos, "tan": torch.tan, "tanh": torch.tanh, "sigmoid": torch.sigmoid,
    "relu": torch.relu, "abs": torch.abs, "square": torch.square, "cube": lambda a: a**3, "silu": functional.silu,
    "softplus": functional.softplus, "exp": lambda a: torch.exp(0.3 * a), "log1p": lambda a: torch.log1p(a * a),
    "log": lambda a: torch.log(a + 1), "sqrt": lambda a: torch.sqrt(1 + a * a), "scaled": lambda a: 0.7 * a - 0.1,
    "reciprocal": lambda a: 1 / (2 + torch.tanh(a)), "clamp": lambda a: a.clamp(-0.5, 0.8),
}  # fmt: skip
BINARY = {
    "+": torch.add, "-": torch.sub, "*": torch.mul, "/": lambda a, b: a / (1.5 + b * b), "max": torch.maximum,
    "min": torch.minimum, "where": lambda a, b: torch.where(a > b, a * b, b - a),
    "guarded": lambda a, b: torch.where(a > 0.1, b / torch.where(a > 0.1, a, 1.0), b),
    "mask": lambda a, b: ((a <= b) | (a > 0.3)) * a,
}  # fmt: skip

EXPRESSIONS = st.recursive(
    st.integers(0, AXES - 1),
    lambda inner: st.one_of(
        st.tuples(st.sampled_from(sorted(UNARY)), inner), st.tuples(st.sampled_from(sorted(BINARY)), inner, inner)
    ),
    max_leaves=8,
)


def evaluated(expression, p):
    if isinstance(expression, int):
        return p[expression]
    name, *operands = expression
    return (UNARY.get(name) or BINARY[name])(*(evaluated(operand, p) for operand in operands))


def outside_of_composition(expression, boxes=60):
    def function(t, x):
        return (evaluated(expression, torch.cat([t[None], x]))[None],)

    lower, upper = random_boxes(boxes, 0)
    (bounds,) = BoundedFunction(function, (lower.amin(0), upper.amax(0))).bounds(lower, upper)
    return int(violated(bounds, values_on(function, lower, upper)).sum())


@pytest.mark.gate
@settings(max_examples=100)
@given(EXPRESSIONS)
def test_no_value_of_many_compositions_lies_outside(expression):
    assert outside_of_composition(expression) == 0


def test_a_wrong_rule_shows_in_compositions(monkeypatch):
    """The twin: the rule of products without their remainder."""

    def wrong(x, y):
        form = RIGHT(x, y)
        return form.with_parts(form.terms, 0 * form.radius)

    monkeypatch.setitem(RULES, aten.mul.Tensor, wrong)
    assert outside_of_composition(("sin", ("*", 0, ("*", 1, 2)))) > 0


RIGHT = RULES[aten.mul.Tensor]


# The assumption about torch's elementary functions

ELEMENTARY = {
    "exp": (torch.exp, mpmath.exp, -700, 700),
    "log": (torch.log, mpmath.log, 0, 1e6),
    "log1p": (torch.log1p, mpmath.log1p, -1, 1e3),
    "sqrt": (torch.sqrt, mpmath.sqrt, 0, 1e6),
    "reciprocal": (torch.reciprocal, lambda v: 1 / v, -1e3, 1e3),
    "sigmoid": (torch.sigmoid, lambda v: 1 / (1 + mpmath.exp(-v)), -300, 300),
    "softplus": (elementary_functions.softplus_of, lambda v: mpmath.log1p(mpmath.exp(v)), -300, 300),
    "sin": (torch.sin, mpmath.sin, -100, 100),
    "cos": (torch.cos, mpmath.cos, -100, 100),
    "tan": (torch.tan, mpmath.tan, -100, 100),
}


def points_of(low, high, count):
    """Half of them spread evenly, half in magnitude, down to 1e-9."""
    even = low + (high - low) * torch.rand(count // 2)
    small = torch.rand(count // 2).sub(0.5).sign() * 10 ** (10 * torch.rand(count // 2) - 9)
    points = torch.cat([even, small])
    return points[(points > low) & (points < high)]


def largest_error(name, count):
    """In units of ε|f|; 400 bits leave 50 digits after the cancellation in 1 + 1e-9 or sin 100π."""
    function, exact, low, high = ELEMENTARY[name]
    points = points_of(low, high, count)
    with mpmath.workprec(400):
        true = [exact(mpmath.mpf(p)) for p in points.tolist()]
        errors = [abs((mpmath.mpf(f) - y) / y) for f, y in zip(function(points).tolist(), true, strict=True)]
        return float(max(errors)) / taylor.EPSILON


@pytest.mark.gate
@pytest.mark.parametrize("name", ELEMENTARY)
def test_elementary_functions_err_by_less_at_many_points(name):
    assert largest_error(name, 4000) < 2


def test_a_function_in_single_precision_errs_by_more(monkeypatch):
    monkeypatch.setitem(ELEMENTARY, "exp", (lambda v: torch.exp(v.float()).double(), mpmath.exp, -80, 80))
    assert largest_error("exp", 200) > 8


def test_a_slope_that_jumps_decides_where_it_jumps():
    """At its own threshold, not at 0; a graph without a truth decides nothing."""
    box = torch.tensor([0.0, -2.0]), torch.tensor([1.0, 2.0])
    slope = BoundedFunction(lambda t, x: (aten.threshold_backward(3 * x, x, 0.5),), box).graph
    decided = decisions(slope)
    for at in (-1.0, 0.2, 0.6):
        assert decided(torch.zeros(()), torch.tensor([at]))[0].tolist() == [float(at > 0.5)]
    assert decisions(BoundedFunction(lambda t, x: (3 * x,), box).graph) is None
