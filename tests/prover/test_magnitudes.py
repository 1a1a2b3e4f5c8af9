"""Bounds at every magnitude from 1e-300 to 1e300, against values of 60 digits.

Every value is compared with its bounds in float64, and the values closest to their bounds by mpmath too.
LYAPNET_VALUES=1000000 pytest -n 0 -s tests/prover/test_magnitudes.py draws at least that many values.
"""

import os
import random
from collections import Counter
from functools import cache

import mpmath
import pytest
import torch
from torch.func import vmap

from lyapnet.prover import elementary_functions, taylor
from lyapnet.prover.bound_rules import ARRANGEMENTS, OF_SHAPE, RULES
from lyapnet.prover.bounds import BoundedFunction
from lyapnet.prover.rounding import ROUNDED
from lyapnet.prover.taylor import box_form
from lyapnet.task.cost.minimum import LEAST

aten = torch.ops.aten
VALUES = int(os.environ.get("LYAPNET_VALUES", "1"))
BOXES = 300 if VALUES < 1e5 else 2000
SLOPE = 0.3


def logistic(a):
    return 1 / (1 + mpmath.exp(-a))


def number(truth):
    return mpmath.mpf(bool(truth))


def two_by_two(a, b, c):
    return torch.stack([torch.stack([a, b]), torch.stack([b, c])])


def pair(a, b):
    return torch.stack([a, b])


def softplus(a):
    return mpmath.log1p(mpmath.exp(a))


def silu_slope(a):
    return logistic(a) * (1 + a * logistic(-a))


# Operator ↦ (a function of a, b, c in torch, the same in mpmath)
CASES = {
    aten.relu.default: (lambda a, b, c: aten.relu(a), lambda a, b, c: max(a, 0)),
    aten.leaky_relu.default: (
        lambda a, b, c: aten.leaky_relu(a, SLOPE), lambda a, b, c: a if a > 0 else SLOPE * a),
    aten.abs.default: (lambda a, b, c: aten.abs(a), lambda a, b, c: abs(a)),
    aten.clamp.default: (lambda a, b, c: aten.clamp(a, -0.4, 0.7), lambda a, b, c: min(max(a, -0.4), 0.7)),
    aten.clamp_min.default: (lambda a, b, c: aten.clamp_min(a, 0.2), lambda a, b, c: max(a, 0.2)),
    aten.clamp_max.default: (lambda a, b, c: aten.clamp_max(a, -0.2), lambda a, b, c: min(a, -0.2)),
    aten.clamp.Tensor: (lambda a, b, c: aten.clamp.Tensor(a, b, c), lambda a, b, c: min(max(a, b), c)),
    aten.clamp_min.Tensor: (lambda a, b, c: aten.clamp_min.Tensor(a, b), lambda a, b, c: max(a, b)),
    aten.clamp_max.Tensor: (lambda a, b, c: aten.clamp_max.Tensor(a, b), lambda a, b, c: min(a, b)),
    aten.maximum.default: (lambda a, b, c: aten.maximum(a, b), lambda a, b, c: max(a, b)),
    aten.minimum.default: (lambda a, b, c: aten.minimum(a, b), lambda a, b, c: min(a, b)),
    **dict.fromkeys((aten.sign.default, aten.sgn.default), (
        lambda a, b, c: aten.sign(a) * b + aten.sgn(a), lambda a, b, c: mpmath.sign(a) * (b + 1))),
    aten.gt.Scalar: (lambda a, b, c: aten.gt(a, 0.1) * b, lambda a, b, c: number(a > 0.1) * b),
    aten.gt.Tensor: (lambda a, b, c: aten.gt(a, b) * c, lambda a, b, c: number(a > b) * c),
    aten.ge.Scalar: (lambda a, b, c: aten.ge(a, 0.1) * b, lambda a, b, c: number(a >= 0.1) * b),
    aten.ge.Tensor: (lambda a, b, c: aten.ge(a, b) * c, lambda a, b, c: number(a >= b) * c),
    aten.lt.Scalar: (lambda a, b, c: aten.lt(a, 0.1) * b, lambda a, b, c: number(a < 0.1) * b),
    aten.lt.Tensor: (lambda a, b, c: aten.lt(a, b) * c, lambda a, b, c: number(a < b) * c),
    aten.le.Scalar: (lambda a, b, c: aten.le(a, 0.1) * b, lambda a, b, c: number(a <= 0.1) * b),
    aten.le.Tensor: (lambda a, b, c: aten.le(a, b) * c, lambda a, b, c: number(a <= b) * c),
    aten.eq.Scalar: (lambda a, b, c: aten.eq(a, 0.0) * b, lambda a, b, c: number(a == 0) * b),
    aten.eq.Tensor: (lambda a, b, c: aten.eq(a, b) * c, lambda a, b, c: number(a == b) * c),
    aten.ne.Scalar: (lambda a, b, c: aten.ne(a, 0.0) * b, lambda a, b, c: number(a != 0) * b),
    aten.ne.Tensor: (lambda a, b, c: aten.ne(a, b) * c, lambda a, b, c: number(a != b) * c),
    aten.bitwise_and.Tensor: (lambda a, b, c: ((a > 0) & (b > 0)) * c, lambda a, b, c: number(a > 0 and b > 0) * c),
    aten.logical_and.default: (lambda a, b, c: aten.logical_and(a, b) * c, lambda a, b, c: number(a and b) * c),
    aten.bitwise_or.Tensor: (lambda a, b, c: ((a > 0) | (b > 0)) * c, lambda a, b, c: number(a > 0 or b > 0) * c),
    aten.logical_or.default: (lambda a, b, c: aten.logical_or(a, b) * c, lambda a, b, c: number(a or b) * c),
    aten.bitwise_not.default: (lambda a, b, c: ~(a > 0) * c, lambda a, b, c: number(a <= 0) * c),
    aten.logical_not.default: (lambda a, b, c: aten.logical_not(a * b) * c, lambda a, b, c: number(a * b == 0) * c),
    aten.threshold_backward.default: (
        lambda a, b, c: aten.threshold_backward(b, a, 0.1), lambda a, b, c: b if a > 0.1 else 0),
    aten.leaky_relu_backward.default: (
        lambda a, b, c: aten.leaky_relu_backward(b, a, SLOPE, False), lambda a, b, c: b if a > 0 else SLOPE * b),
    aten.where.self: (lambda a, b, c: torch.where(a > 0, b, c), lambda a, b, c: b if a > 0 else c),
    aten.masked_fill.Scalar: (lambda a, b, c: aten.masked_fill(b, a > 0, 3.0), lambda a, b, c: 3 if a > 0 else b),
    aten.masked_fill.Tensor: (lambda a, b, c: aten.masked_fill(b, a > 0, c), lambda a, b, c: c if a > 0 else b),
    aten._linalg_solve_ex.default: (
        lambda a, b, c: torch.linalg.solve_ex(two_by_two(a, b, c), pair(a, c))[0][0],
        lambda a, b, c: (a * c - b * c) / (a * c - b * b)),
    aten.linalg_inv_ex.default: (
        lambda a, b, c: torch.linalg.inv_ex(two_by_two(a, b, c))[0][0, 1], lambda a, b, c: -b / (a * c - b * b)),
    aten.add.Tensor: (lambda a, b, c: aten.add(a, b, alpha=SLOPE), lambda a, b, c: a + SLOPE * b),
    aten.add.Scalar: (lambda a, b, c: aten.add.Scalar(a, 0.1, 3.0), lambda a, b, c: a + mpmath.mpf(0.1) * 3),
    aten.sub.Tensor: (lambda a, b, c: aten.sub(a, b, alpha=SLOPE), lambda a, b, c: a - SLOPE * b),
    aten.sub.Scalar: (lambda a, b, c: aten.sub.Scalar(a, 0.1), lambda a, b, c: a - 0.1),
    aten.rsub.Scalar: (lambda a, b, c: aten.rsub(a, 0.1), lambda a, b, c: 0.1 - a),
    aten.rsub.Tensor: (lambda a, b, c: aten.rsub(a, b, alpha=0.7), lambda a, b, c: b - 0.7 * a),
    aten.mul.Tensor: (lambda a, b, c: a * b, lambda a, b, c: a * b),
    aten.mul.Scalar: (lambda a, b, c: aten.mul.Scalar(a, 1e-200) * b, lambda a, b, c: a * 1e-200 * b),
    aten.div.Tensor: (lambda a, b, c: a / b, lambda a, b, c: a / b),
    aten.div.Scalar: (lambda a, b, c: aten.div.Scalar(a, 1e250) * b, lambda a, b, c: a / 1e250 * b),
    aten.pow.Tensor_Scalar: (lambda a, b, c: a**2 + b**-3, lambda a, b, c: a**2 + 1 / b**3),
    aten.mm.default: (
        lambda a, b, c: aten.mm(two_by_two(a, b, c), two_by_two(c, b, a))[0, 0], lambda a, b, c: a * c + b * b),
    aten.bmm.default: (
        lambda a, b, c: aten.bmm(two_by_two(a, b, c)[None], two_by_two(c, b, a)[None])[0, 0, 1],
        lambda a, b, c: a * b + b * a),
    aten.mv.default: (
        lambda a, b, c: aten.mv(torch.tensor([[1e-200, 2.0], [0.5, 1e200]]), pair(a, b))[0] * c,
        lambda a, b, c: (a * 1e-200 + 2 * b) * c),
    aten.dot.default: (lambda a, b, c: aten.dot(pair(a, b), pair(b, c)), lambda a, b, c: a * b + b * c),
    aten._to_copy.default: (lambda a, b, c: (a > 0).to(torch.float64) + b, lambda a, b, c: number(a > 0) + b),
    aten.addmm.default: (
        lambda a, b, c: aten.addmm(pair(a, b), two_by_two(a, b, c), two_by_two(c, b, a), beta=0.3, alpha=0.7)[0, 0],
        lambda a, b, c: 0.3 * a + 0.7 * (a * c + b * b)),
    aten.neg.default: (lambda a, b, c: -a, lambda a, b, c: -a),
    aten.sum.default: (lambda a, b, c: pair(a, b).sum(), lambda a, b, c: a + b),
    aten.sum.dim_IntList: (lambda a, b, c: aten.sum(two_by_two(a, b, c), [0])[1], lambda a, b, c: b + c),
    aten.mean.default: (lambda a, b, c: pair(a, b).mean(), lambda a, b, c: (a + b) / 2),
    aten.mean.dim: (lambda a, b, c: aten.mean(two_by_two(a, b, c), [0])[1], lambda a, b, c: (b + c) / 2),
    aten.exp.default: (lambda a, b, c: torch.exp(a), lambda a, b, c: mpmath.exp(a)),
    aten.log.default: (lambda a, b, c: torch.log(a), lambda a, b, c: mpmath.log(a)),
    aten.log1p.default: (lambda a, b, c: torch.log1p(a), lambda a, b, c: mpmath.log1p(a)),
    aten.sqrt.default: (lambda a, b, c: torch.sqrt(a), lambda a, b, c: mpmath.sqrt(a)),
    aten.reciprocal.default: (lambda a, b, c: torch.reciprocal(a), lambda a, b, c: 1 / a),
    aten.sigmoid.default: (lambda a, b, c: torch.sigmoid(a), lambda a, b, c: logistic(a)),
    aten.sin.default: (lambda a, b, c: torch.sin(a), lambda a, b, c: mpmath.sin(a)),
    aten.cos.default: (lambda a, b, c: torch.cos(a), lambda a, b, c: mpmath.cos(a)),
    aten.tan.default: (lambda a, b, c: torch.tan(a), lambda a, b, c: mpmath.tan(a)),
    aten.rsqrt.default: (lambda a, b, c: torch.rsqrt(a), lambda a, b, c: 1 / mpmath.sqrt(a)),
    aten.tanh.default: (lambda a, b, c: torch.tanh(a), lambda a, b, c: mpmath.tanh(a)),
    aten.softplus.default: (lambda a, b, c: aten.softplus(a), lambda a, b, c: softplus(a)),
    aten.softplus_backward.default: (
        lambda a, b, c: aten.softplus_backward(b, a, 1.0, 20.0), lambda a, b, c: b * logistic(a)),
    aten.silu.default: (lambda a, b, c: aten.silu(a), lambda a, b, c: a * logistic(a)),
    aten.silu_backward.default: (lambda a, b, c: aten.silu_backward(b, a), lambda a, b, c: b * silu_slope(a)),
    aten.sigmoid_backward.default: (lambda a, b, c: aten.sigmoid_backward(b, a), lambda a, b, c: b * a * (1 - a)),
    aten.tanh_backward.default: (lambda a, b, c: aten.tanh_backward(b, a), lambda a, b, c: b * (1 - a * a)),
    aten.index_add.default: (
        lambda a, b, c: aten.index_add(pair(a, b), 0, torch.tensor([1]), c[None])[1], lambda a, b, c: b + c),
    aten.index_put.default: (
        lambda a, b, c: aten.index_put(pair(a, b), [torch.tensor([1, 1])], pair(a, c), True)[1],
        lambda a, b, c: a + b + c),
    ROUNDED: (  # the bounds must contain every result within θ of a
        lambda a, b, c: ROUNDED(a, b, 2**-24, 1e-45, 3e38), lambda a, b, c: a * (1 + mpmath.mpf(2)**-24)),
}  # fmt: skip
CHAINED = [
    aten.relu.default, aten.mul.Tensor, aten.div.Tensor, aten.exp.default, aten.log.default, aten.sqrt.default,
    aten.rsqrt.default, aten.sigmoid.default, aten.softplus.default, aten.silu.default, aten.sin.default,
    aten.cos.default, aten.tanh.default, aten.log1p.default, aten.mm.default, aten.where.self, aten.mul.Scalar,
    aten.pow.Tensor_Scalar, aten.reciprocal.default, aten.add.Tensor, aten.abs.default, aten.logical_not.default,
]  # fmt: skip
WITHOUT_MACHINE_CODE = {aten._linalg_solve_ex.default, aten.linalg_inv_ex.default, aten.index_put.default}
UNBATCHED = {aten.masked_fill.Tensor, aten.silu_backward.default}  # which torch does not batch


def chain(*operators):
    """The composition of some cases: each takes the value before it in place of a."""

    def composed(which):
        def function(a, b, c):
            for operation in operators:
                a = CASES[operation][which](a, b, c)
            return a

        return function

    return composed(0), composed(1)


@cache
def cases():
    """Name ↦ case: every operator, and chains of two or three."""
    generator = random.Random(0)
    chains = [generator.choices(CHAINED, k=generator.choice((2, 3))) for _ in range(40)]
    squares = [(operation, aten.pow.Tensor_Scalar) for operation in (aten.sigmoid.default, aten.mul.Tensor)]
    return {
        **{str(operation): case for operation, case in CASES.items()},
        **{" > ".join(map(str, each)): chain(*each) for each in (*chains, *squares)},
    }


def boxes_of_every_magnitude(boxes, seed):
    """Boxes (boxes, 3), some of them points, some with a corner at a kink or at the end of the domain of a function."""
    generator = random.Random(seed)

    def magnitude():
        return 10 ** generator.uniform(-300, 300)

    def side(common):
        size = generator.choice((common, magnitude(), 10 ** generator.uniform(-3, 3)))
        special = generator.choice((0.0, 0.0, 5e-324, 1e-310, 1.0, 0.1, -0.4, 0.7, torch.pi / 2, 709.0, -745.0))
        start = generator.choice((size, size, size, special)) * generator.choice((-1, 1))
        relative = 10 ** generator.uniform(-16, 0.5) * abs(start)
        width = generator.choice((0.0, relative, relative, relative, magnitude(), 5e-324))
        return sorted((start, min(max(start + generator.choice((-1, 1)) * width, -1e308), 1e308)))

    lower, upper = torch.empty(boxes, 3), torch.empty(boxes, 3)
    for i in range(boxes):
        common = magnitude()
        for k in range(3):
            lower[i, k], upper[i, k] = side(common)
    return lower, upper


@cache
def bounded_function(names, degree):
    """Some cases as the results of one function, which is traced once."""

    def function(t, x):
        return tuple(cases()[name][0](t, x[0], x[1]) for name in names)

    return BoundedFunction(function, (torch.full((3,), 1.2), torch.full((3,), 1.4)), degree)


def bounds_of_all(names, lower, upper):
    """Bounds (ways, names, 2, boxes) in each degree by the interpreter, and by machine code where there is some."""
    found = []
    for degree in (1, 2, 3):
        bounded = bounded_function(tuple(names), degree)
        kernel = bounded.kernel(lower, upper)
        for forms in (bounded.image(box_form(lower, upper, degree)), kernel and kernel.forms(lower, upper)):
            if forms:
                found.append(torch.stack([torch.stack(form.interval()) for form in forms]))
    return torch.stack(found)


def points_in(lower, upper, seed, points=4):
    """Corners, and points between them; (points, boxes, 3)."""
    share = torch.rand(points, *lower.shape, generator=torch.Generator().manual_seed(seed))
    share[: points // 2] = share[: points // 2].round()
    between = torch.where(share == 0, lower, torch.where(share == 1, upper, lower + (upper - lower) * share))
    return between.clamp(lower, upper)


def outside(names, seed, most=30):
    """For each case, numbers of values: those outside their bounds, all compared ones, those compared in 60 digits.

    A value that does not exist, such as log −1, counts as outside unless the bounds are infinite. In a chain, a
    comparison may turn such a value into a truth value; then torch's value is compared.
    """
    lower, upper = boxes_of_every_magnitude(BOXES, seed)
    points = points_in(lower, upper, seed)
    found, compared, exact, generator = Counter(), Counter(), Counter(), random.Random(seed)
    for name, ways in zip(names, bounds_of_all(names, lower, upper).movedim(0, 1), strict=True):
        torch_function, true = cases()[name]
        low, high = ways[:, 0].amax(0), ways[:, 1].amin(0)  # the tightest of all ways
        known = (low > -torch.inf) | (high < torch.inf)
        compared[name] = int(known.sum()) * len(points)
        if any(str(operation) in name for operation in UNBATCHED):
            margin = torch.rand(points.shape[:2], generator=torch.Generator().manual_seed(seed))
        else:
            values = vmap(vmap(lambda p, f=torch_function: f(p[0], p[1], p[2])))(points).double()
            margin = torch.minimum(values - low, high - values) / (values.abs() + 1e-290)
        closest = margin.nan_to_num(-1.0).where(known, torch.inf).flatten().argsort()[:most].tolist()
        anywhere = generator.sample(range(margin.numel()), most // 3)
        for at in {*closest, *anywhere}:
            point, box = divmod(at, len(lower))
            if known[box]:
                exact[name] += 1
                value = value_of(true, points[point, box].tolist())
                if value is None and " > " in name:
                    value = float(torch_function(*points[point, box]))
                found[name] += value is None or not float(low[box]) <= value <= float(high[box])
    return found, compared, exact


def value_of(function, point):
    """A value of 60 digits; None where there is none."""
    with mpmath.workdps(60):
        try:
            value = function(*map(mpmath.mpf, point))
        except (ZeroDivisionError, ValueError, TypeError):  # TypeError: a comparison of complex numbers
            return None
        return None if isinstance(value, mpmath.mpc) else value


def test_every_rule_has_a_case():
    """Except for operators that move entries or depend on shapes alone, and for minima, which test_minima.py has."""
    assert RULES.keys() - ARRANGEMENTS.keys() - OF_SHAPE - {LEAST} == CASES.keys()


def groups():
    """(names of cases with machine code, names of cases without)."""
    lacking = {str(operation) for operation in WITHOUT_MACHINE_CODE}
    return [[name for name in cases() if (name in lacking) == missing] for missing in (False, True)]


@pytest.mark.gate
def test_no_value_lies_outside():
    found, compared, exact, seed = Counter(), Counter(), Counter(), 0
    while sum(compared.values()) < VALUES:
        for names in groups():
            for total, counts in zip((found, compared, exact), outside(names, seed), strict=True):
                total.update(counts)
        seed += 1
    print(f"{sum(found.values())} of {sum(compared.values())} values outside, {sum(exact.values())} by mpmath")
    assert not +found
    assert min(exact[name] for name in map(str, CASES)) > 10


def test_without_room_for_underflow_values_lie_outside(monkeypatch):
    """The twin."""
    for module in (taylor, elementary_functions):
        monkeypatch.setattr(module, "TINY", 0.0)
        monkeypatch.setattr(module, "FLOOR", 0.0)
    names = [str(aten.mul.Tensor), str(aten.mv.default), str(aten.rsqrt.default)]
    found, _, _ = outside(names, 0)
    assert sum(found.values()) > 0
