"""An independent check of whole conditions: V̇ + αℓ − δ of a network, written by hand for mpmath.

It shares only the weights with lyapnet: neither the graph, nor autograd, nor the arithmetic.
"""

import mpmath
import pytest
import torch
from mpmath import iv, mpf

from lyapnet.prover import elementary_functions, taylor
from lyapnet.prover.bound_rules import RULES
from lyapnet.prover.bounds import BoundedFunction
from lyapnet.prover.condition import DecreaseCondition
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.systems import DoubleIntegrator
from lyapnet.value.networks import FCN, Scaling
from tests.marks import at_the_gate
from tests.problems import hjb_loop

Q, R, ALPHA, DELTA = ((10.0, 0.3), (0.3, 0.1)), 0.5, 0.9, 0.01
SCALE, DURATION, VALUE = (1.25, 2.0), 4.0, 3.0
LOWER, UPPER = torch.tensor([0.0, -1.5, -2.0]).double(), torch.tensor([DURATION, 1.5, 2.0]).double()


def network():
    torch.manual_seed(3)
    return FCN(Scaling(SCALE, DURATION, VALUE), hidden=(8, 8)).double().requires_grad_(False)


def condition(V, alpha=ALPHA):
    system, cost = DoubleIntegrator(), QuadraticCost([list(row) for row in Q], [[R]], [list(row) for row in Q])
    return DecreaseCondition(hjb_loop(system, cost, V), alpha, DELTA)


def bounded(V, alpha=ALPHA):
    c = condition(V, alpha)
    return BoundedFunction(lambda t, x: (c(t, x),), (LOWER, UPPER))


def tanh(a, exp):
    return 1 - 2 / (1 + exp(2 * a))


def by_hand(V, t, q, v, number, exp):
    """V_t + V_q v + V_v u + α ℓ − δ with u = −V_v/(2R), by the chain rule for two layers of tanh."""

    def product(W, z):
        return [sum((w * y for w, y in zip(row, z, strict=True)), number(0)) for row in W]

    def exact(tensor):
        return [[number(w) for w in row] for row in tensor.tolist()]

    W, b = zip(*((exact(layer.weight), exact(layer.bias[None])[0]) for layer in (*V.hidden, V.output)), strict=True)
    z = [2 * t / number(DURATION) - 1, q / number(SCALE[0]), v / number(SCALE[1])]
    first = [tanh(a + c, exp) for a, c in zip(product(W[0], z), b[0], strict=True)]
    second = [tanh(a + c, exp) for a, c in zip(product(W[1], first), b[1], strict=True)]
    inner = [w * (1 - h**2) for w, h in zip(W[2][0], second, strict=True)]
    outer = [g * (1 - h**2) for g, h in zip(product(zip(*W[1], strict=True), inner), first, strict=True)]
    slopes = product(zip(*W[0], strict=True), outer)
    units = (number(2) / number(DURATION), 1 / number(SCALE[0]), 1 / number(SCALE[1]))
    V_t, V_q, V_v = (number(VALUE) * g * unit for g, unit in zip(slopes, units, strict=True))
    u = -V_v / (2 * number(R))
    cost = number(Q[0][0]) * q**2 + 2 * number(Q[0][1]) * q * v + number(Q[1][1]) * v**2 + number(R) * u**2
    return V_t + V_q * v + V_v * u + number(ALPHA) * cost - number(DELTA)


def at_point(V, point):
    return by_hand(V, *(mpf(p) for p in point.tolist()), mpf, mpmath.exp)


def on_box(V, lower, upper):
    sides = (iv.mpf(pair) for pair in zip(lower.tolist(), upper.tolist(), strict=True))
    return by_hand(V, *sides, iv.mpf, iv.exp)


def boxes(width, count):
    half = width / 2 * torch.rand(count, 3)
    center = LOWER + (UPPER - LOWER) * torch.rand(count, 3)
    return center - half, center + half


def points_outside(count=100):
    """(How many values in 50 digits lie outside the bounds at points, the widest of these bounds)."""
    V, (point, _) = network(), boxes(0.0, count)
    ((low, high),) = bounded(V).bounds(point, point)
    with mpmath.workdps(50):
        values = [at_point(V, p) for p in point]
        inside = [mpf(a) <= value <= mpf(b) for a, b, value in zip(low.tolist(), high.tolist(), values, strict=True)]
    return inside.count(False), float((high - low).max())


def boxes_outside(width, count=20, inner=10):
    """(Boxes on which the two enclosures are disjoint, values in 50 digits at points that lie outside the bounds)."""
    V, (lower, upper) = network(), boxes(width, count)
    ((low, high),) = bounded(V).bounds(lower, upper)
    disjoint = outside = 0
    with mpmath.workdps(50):
        for i in range(count):
            a, b = mpf(float(low[i])), mpf(float(high[i]))
            other = on_box(V, lower[i], upper[i])
            disjoint += b < mpf(other.a) or mpf(other.b) < a
            corners = torch.rand(inner, 3)
            corners[::2] = corners[::2].round()
            points = torch.minimum(lower[i] + (upper[i] - lower[i]) * corners, upper[i])  # rounding may leave the box
            outside += sum(not a <= at_point(V, p) <= b for p in points)
    return disjoint, outside


def test_bounds_at_points_hold_the_value_in_fifty_digits():
    outside, widest = points_outside()
    assert outside == 0
    assert widest < 1e-10


@pytest.mark.gate
@pytest.mark.parametrize("count", [20, at_the_gate(300)])
@pytest.mark.parametrize("width", [0.3, 0.1, 1e-2, 1e-3, 1e-5])
def test_both_enclosures_of_many_boxes_agree(width, count):
    assert boxes_outside(width, count) == (0, 0)


def mutilated(rule, change):
    def wrong(*arguments, **keywords):
        form = rule(*arguments, **keywords)
        return form.with_parts(change(form.terms), form.radius)

    return wrong


def test_a_mutilated_rule_is_caught_at_points(monkeypatch):
    """The error is one part in 10¹²."""
    sigmoid = torch.ops.aten.sigmoid.default
    monkeypatch.setitem(RULES, sigmoid, mutilated(elementary_functions.sigmoid, lambda terms: terms * (1 + 1e-12)))
    assert points_outside(20)[0] > 0


def test_a_forgotten_remainder_is_caught_on_boxes(monkeypatch):
    monkeypatch.setattr(elementary_functions, "linearised", without_remainder(elementary_functions.linearised))
    monkeypatch.setattr(taylor, "multiply", without_remainder(taylor.multiply))
    assert boxes_outside(0.3)[1] > 0


def without_remainder(rule):
    def wrong(*arguments, **keywords):
        form = rule(*arguments, **keywords)
        return form.with_parts(form.terms, torch.zeros_like(form.radius))

    return wrong


def test_another_condition_is_caught():
    V, (lower, upper) = network(), boxes(1e-3, 20)
    ((low, high),) = bounded(V, 0.91).bounds(lower, upper)
    assert any(
        mpf(other.b) < mpf(a) or mpf(b) < mpf(other.a)
        for a, b, other in zip(
            low.tolist(), high.tolist(), (on_box(V, *pair) for pair in zip(lower, upper, strict=True)), strict=True
        )
    )
