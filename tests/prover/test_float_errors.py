"""Bounds of what a program in floating-point numbers is off: against closed forms, and against torch in float32."""

import copy
import math

import pytest
import torch
from torch import nn

from lyapnet.base.errors import ExportError, UsageError
from lyapnet.graphs.tracing import core_trace
from lyapnet.prover.float_errors import FORMATS, FloatLaw
from lyapnet.prover.simplification import with_known_times
from tests.marks import sample

UNIT = FORMATS[torch.float32].unit
POINTS = 20_000
W = torch.randn(12, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
B = torch.randn(12, 12, generator=torch.Generator().manual_seed(1), dtype=torch.float64) / 4
KNOTS = torch.arange(8).double() / 7


def network(t, x):
    y = torch.tanh(B @ torch.tanh(W @ x + 0.3 * t) + 0.1)
    return ((1 - y**2) @ B) @ W[:, :1]


FUNCTIONS = {  # x in [−1, 1]², t in [0, 1]
    "a polynomial": lambda t, x: torch.stack([x[0] ** 3 * x[1] + 0.1 * t, 2 * x[0] - x[1] / 3 + x[1] ** 2]),
    "a network and its derivative": network,
    "functions of the C library": lambda t, x: torch.stack([
        torch.sin(3 * x[0]) * torch.cos(x[1]) + torch.exp(x[0]), torch.sigmoid(8 * x[1]) - torch.log1p(x[0] ** 2),
    ]),
    "a quotient and a root": lambda t, x: (x[:1] / (x[1:] ** 2 + 0.3)) * torch.sqrt(1.7 + x[:1] * x[1:]),
    "limits": lambda t, x: torch.clamp(torch.stack([3 * x[0], x[1] - x[0]]), -0.7, 0.9),
    "kinks": lambda t, x: torch.relu(x - 0.2) + torch.maximum(x, x.flip(0)).abs() - torch.minimum(x[:1], 0.3 * t),
    "means and sums": lambda t, x: torch.cat([x, x * t, x**2 - 0.3]).mean(0, keepdim=True) + (W @ x).sum(0),
    "hats over time": lambda t, x: (
        torch.relu((t - KNOTS) * 7) - torch.relu((t - KNOTS) * 7 - 1)
    ) @ W[:8, :1] * x[0],
    "entries at places": lambda t, x: torch.ops.aten.index_put.default(
        torch.zeros(1, 3).double(), [None, torch.tensor([2, 0, 1])], torch.cat([x, 0.3 * x[:1]])[None], True
    )[0],
    "products that others use too": lambda t, x: ((p := x[:1] * x[1:] * 1.1) + t) - p * (p - 0.2),
}  # fmt: skip


def law_of(function, dtype=torch.float32, latest=1.0):
    graph = core_trace(
        lambda t, x: (function(t, x),), [torch.tensor(0.3).double(), torch.tensor([0.2, 0.7]).double()], "it",
        ExportError,
    )  # fmt: skip
    with torch.no_grad():
        (u,) = graph(torch.tensor(0.3).double(), torch.tensor([0.2, 0.7]).double())
    return FloatLaw(graph, [2], dtype, [0.0] * len(u), latest, "", "")


def bound(function, dtype=torch.float32, box=((-1.0, -1.0), (1.0, 1.0)), boxes=30_000, latest=1.0):
    return law_of(function, dtype, latest).errors(tuple(torch.tensor(side).double() for side in box), boxes)


def in_single(graph):
    """A graph in float32: torch's own arithmetic, which sums in an order of its own."""
    single = copy.deepcopy(graph).float()
    for name, buffer in single.named_buffers():
        setattr(single, name, buffer.float() if buffer.is_floating_point() else buffer)
    for node in single.graph.nodes:
        if node.kwargs.get("dtype") == torch.float64:
            node.kwargs = {**node.kwargs, "dtype": torch.float32}
    single.recompile()
    return single


def seen(function):
    """The largest |ũ − u| at random points, where torch in float32 is the program."""
    graph, generator = law_of(function).graph, torch.Generator().manual_seed(0)
    t = torch.rand(POINTS, generator=generator, dtype=torch.float64)
    x = 2 * torch.rand(POINTS, 2, generator=generator, dtype=torch.float64) - 1
    with torch.no_grad():
        (u,), (found,) = torch.vmap(graph)(t, x), torch.vmap(in_single(graph))(t.float(), x.float())
    return (found.double() - u).abs().amax(0).tolist()


@pytest.mark.parametrize("kind", sample(FUNCTIONS, 3))
def test_no_program_in_float32_is_beyond_the_bound_which_is_not_a_hundred_times_as_large(kind):
    for largest, found in zip(bound(FUNCTIONS[kind]), seen(FUNCTIONS[kind]), strict=True):
        assert found <= largest <= 100 * found


@pytest.mark.gate
def test_bounds_for_float64_are_refuted_by_float32():
    assert seen(network)[0] > bound(network, torch.float64)[0] > 0


def test_the_bound_of_a_square_in_closed_form():
    """fl(fl(x)²) = x²(1 + θ)³ with |θ| ≤ u: 3u at |x| = 1, and no more."""
    (largest,) = bound(lambda t, x: x[:1] ** 2)
    assert 3 * UNIT <= largest <= 1.25 * 3 * UNIT


def test_a_constant_that_float32_has_is_not_rounded_and_a_scale_by_two_neither():
    for factor, units in ((2, 2 * 1), (3, 3 * 2), (0.1, 0.1 * 3)):  # the rounding of x, of the product, of 0.1
        (largest,) = bound(lambda t, x, factor=factor: factor * x[:1])
        assert units * UNIT <= largest <= 1.25 * units * UNIT


def test_a_sum_may_fuse_a_product_that_another_one_has_rounded():
    """(xy + 1) − xy: the sums err by 2u and u; if one is fused, the error of xy does not cancel: 2u more."""
    (largest,) = bound(lambda t, x: (x[:1] * x[1:] + 1) - x[:1] * x[1:])
    assert largest >= 5 * UNIT


@pytest.mark.gate
def test_a_jump_counts_where_it_may_flip_and_a_choice_between_equals_does_not():
    assert bound(lambda t, x: torch.where(x[:1] > 0.3, 1.0, 0.0))[0] >= 1
    assert bound(lambda t, x: (x[:1] > 0.3).double())[0] >= 1
    assert bound(lambda t, x: torch.where(x[:1] > 0.25, x[:1] - 0.25, 0.0))[0] < 0.01


def test_numbers_that_leave_float32_have_no_bound():
    with pytest.raises(UsageError, match=r"Expected errors of the C that have a bound on D, got none; .+\."):
        bound(lambda t, x: torch.exp(100 * x[:1]) * 1e-30, boxes=5000)
    assert bound(lambda t, x: torch.exp(100 * x[:1]) * 1e-30, torch.float64, boxes=5000)[0] < math.inf


@pytest.mark.gate
def test_a_branch_that_is_not_taken_may_overflow():
    """Softplus is where(x > 20, x, log1p(exp(x))), and exp(100) is beyond float32."""
    line = (-1.0, 0.2), (1.0, 0.2)
    (largest,) = bound(lambda t, x: nn.functional.softplus(100 * x[:1]) / 100, box=line, latest=0.0)
    assert 2 * UNIT <= largest <= 20 * UNIT


def test_operations_whose_errors_are_not_known_are_refused_by_name():
    with pytest.raises(UsageError, match=r"Expected operations whose errors in C are known, got aten.round.+; .+\."):
        bound(lambda t, x: torch.round(x[:1]))


@pytest.mark.gate
def test_what_is_found_is_rounded_upwards_to_two_digits():
    law = law_of(network)
    sides = torch.tensor([-1.0, -1.0]).double(), torch.tensor([1.0, 1.0]).double()
    (exact,), (rounded,) = law.errors(sides), law.computed_on(sides).errors
    assert exact <= rounded <= 1.1 * exact
    assert rounded == float(f"{rounded:.1e}")


def test_clamps_and_truths_of_the_time_are_known_up_to_the_latest():
    def clocked(t, x):
        now = t.clamp(min=0).clamp(max=4.0)
        late = now - 4.0 >= -4e-9
        return torch.where(late[None], -x[:1], x[:1] * now) + (t - 2).clamp(max=0.5)

    graph = law_of(clocked).graph
    known = with_known_times(graph, 4 * (1 - 2.0**-20))
    kept = [str(node.target) for node in known.graph.nodes]
    assert not any("where" in name or ".ge" in name for name in kept)
    assert sum("clamp" in name for name in kept) == 1, "that which changes t − 2"
    for t in (0.0, 1.0, 3.9, 4 * (1 - 2.0**-20)):
        x = torch.tensor([0.3, 0.4]).double()
        assert known(torch.tensor(t).double(), x)[0].equal(graph(torch.tensor(t).double(), x)[0])
    too_late = with_known_times(graph, 4 * (1 - 2.0**-23))
    assert any("where" in str(node.target) for node in too_late.graph.nodes), "float32 may take this t for 4"


def test_what_is_traced_stays_as_it_is():
    module = nn.Linear(2, 1).double()
    law, before = law_of(lambda t, x: module(x)), [p.clone() for p in module.parameters()]
    nodes = str(law.graph.graph)
    law.errors((torch.tensor([-1.0, -1.0]).double(), torch.tensor([1.0, 1.0]).double()), 5000)
    assert str(law.graph.graph) == nodes
    assert all(p.equal(q) for p, q in zip(module.parameters(), before, strict=True))
