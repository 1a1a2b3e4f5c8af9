"""Small linear systems and minima in a box, each one instruction of the kernel."""

import contextlib
import math

import pytest
import torch
from torch.testing import assert_close

from lyapnet.base.linear_algebra import MOST_UNKNOWNS, solve
from lyapnet.base.operators import are_operators, as_operators, operator
from lyapnet.graphs.compilation import has_compiler
from lyapnet.graphs.number_kernel.kernel import NumberKernel
from lyapnet.graphs.tracing import name_of, trace
from lyapnet.task.sets import ControlBox
from tests.marks import sample

pytestmark = pytest.mark.skipif(not has_compiler(), reason="needs a C++ compiler")


def convex(*batch, m):
    """Random (R, b) whose minimum without limits is often outside of the limits."""
    factor = torch.randn(*batch, m, m)
    return factor @ factor.mT + 0.05 * torch.eye(m), 4 * torch.randn(*batch, m)


def operators_of(graph):
    return [name_of(node.target) for node in graph.graph.nodes if "lyapnet" in str(node.target)]


@pytest.mark.parametrize("batch", [(), (1,), (13,), (2, 3, 5)])
@pytest.mark.parametrize("m", sample([3, 4, 6, 9, 32], 3))
def test_the_minimum_within_limits_is_that_of_rounds(m, batch):
    low, high = -torch.rand(m), torch.rand(m)
    low[0], high[1] = -math.inf, math.inf
    controls, (R, b) = ControlBox(low, high), convex(*batch, m=m)
    graph = trace(lambda R, b: (controls.minimise(R, b),), [R, b], whole=True)
    assert operators_of(graph) == ["active_set", "symmetric_inverse"]
    (u,) = NumberKernel(graph, [R, b])(R, b)
    assert_close(u, controls.minimise(R, b), rtol=0, atol=1e-10)
    assert controls.contains(u).all()
    if u.numel() > 10:
        held = ((u == low) | (u == high)).double().mean()
        assert 0.1 < held < 0.9, "some are at a limit, some at none"


def test_all_or_none_may_be_held():
    controls, (R, b) = ControlBox(-1.0, 1.0), convex(7, m=3)
    kernel = NumberKernel(trace(lambda R, b: (controls.minimise(R, b),), [R, b], whole=True), [R, b])
    far = 1e4 * torch.ones(7, 3)
    assert_close(kernel(torch.eye(3).expand(7, 3, 3).clone(), far)[0], -torch.ones(7, 3), rtol=0, atol=0)
    assert_close(kernel(R, 1e-4 * b)[0], solve(R, -5e-5 * b[..., None])[..., 0])
    b[2, 1], R[4, 0, 0] = math.nan, math.inf
    u = kernel(R, b)[0]
    assert u.isnan().any(-1).nonzero().flatten().tolist() == [2, 4]


@pytest.mark.parametrize("m", [3, 7])
def test_its_slope_is_that_of_the_free_controls(m):
    """The derivative is 0 for controls at a limit, and that of the remaining linear system for the others."""
    controls, (R, b) = ControlBox(-0.5, 0.5), convex(20, m=m)

    def slope(R, b, bar):
        with torch.enable_grad():
            b = b.detach().requires_grad_()
            return torch.autograd.grad(controls.minimise(R, b), b, bar)

    bar = torch.randn(20, m)
    graph = trace(slope, [R, b, bar], whole=True)
    (got,) = NumberKernel(graph, [R, b, bar])(R, b, bar)
    h, differences = 1e-6, torch.empty(20, m)
    for j in range(m):
        step = h * torch.eye(m)[j]
        difference = (controls.minimise(R, b + step) - controls.minimise(R, b - step)) / (2 * h)
        differences[:, j] = (bar * difference).sum(-1)
    assert_close(got, differences, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("d", [3, 5, 8, 32])
def test_inverses_and_their_slopes_are_torchs(d):
    A, B = convex(11, m=d)[0] + torch.eye(d), torch.randn(11, d, 2)

    def both(A, B):
        with torch.enable_grad():
            A = A.detach().requires_grad_()
            X = solve(A, B)
            return X.detach(), torch.autograd.grad(X.square().sum(), A)[0]

    graph = trace(both, [A, B], whole=True)
    assert operators_of(graph) == ["symmetric_inverse"]
    X, slope = NumberKernel(graph, [A, B])(A, B)
    assert_close(X, torch.linalg.solve(A, B))
    assert_close(slope, -2 * torch.linalg.solve(A.mT, X) @ X.mT)


def test_a_large_system_is_torchs_own():
    A, B = convex(3, m=MOST_UNKNOWNS + 1)[0] + torch.eye(MOST_UNKNOWNS + 1), torch.randn(3, MOST_UNKNOWNS + 1, 2)
    graph = trace(lambda A, B: (solve(A, B),), [A, B], whole=True)
    assert operators_of(graph) == []
    assert_close(graph(A, B)[0], torch.linalg.solve(A, B))


@pytest.mark.parametrize("shapes", [[(4, 4), (5, 4)], [(2, 4, 4), (3, 2, 4)], [(0, 4, 4), (0, 4)]])
def test_what_is_repeated_lies_once_in_memory(shapes):
    controls, R, b = ControlBox(-0.5, 0.5), convex(m=4)[0].expand(shapes[0]), 4 * torch.randn(shapes[1])
    graph = trace(lambda R, b: (controls.minimise(R.mT, b),), [R, b], whole=True)
    assert_close(NumberKernel(graph, [R, b])(R, b)[0], controls.minimise(R, b), rtol=0, atol=1e-10)


def test_a_matrix_that_is_not_symmetric_is_no_small_system():
    """Up to six unknowns the upper triangle is not read; for more, torch reads it and the instruction does not."""
    A, B = torch.randn(5, 8, 8) + 8 * torch.eye(8), torch.randn(5, 8, 1)
    with pytest.raises(ValueError, match="computes something else"):
        trace(lambda A, B: (solve(A, B),), [A, B], whole=True)
    A = A + A.mT
    assert operators_of(trace(lambda A, B: (solve(A, B),), [A, B], whole=True)) == ["symmetric_inverse"]


@pytest.mark.gate
def test_under_vmap_functions_are_what_they_are_written_as():
    controls, (R, b) = ControlBox(-1.0, 1.0), convex(5, m=3)
    graph = trace(lambda R, b: (torch.func.vmap(controls.minimise)(R, b),), [R, b], whole=True)
    assert not operators_of(graph)
    assert_close(graph(R, b)[0], controls.minimise(R, b))


def test_larger_systems_are_no_instruction():
    controls, (R, b) = ControlBox(-1.0, 1.0), convex(3, m=MOST_UNKNOWNS + 1)
    graph = trace(lambda R, b: (controls.minimise(R, b),), [R, b], whole=True)
    with pytest.raises(NotImplementedError, match="more than 32 unknowns"):
        NumberKernel(graph, [R, b])


def test_elsewhere_functions_are_what_they_are_written_as():
    controls, (R, b) = ControlBox(-1.0, 1.0), convex(5, m=3)
    assert not operators_of(trace(lambda R, b: (controls.minimise(R, b),), [R, b])), "other readers have no such rule"
    with contextlib.suppress(ZeroDivisionError), as_operators():
        assert are_operators()
        raise ZeroDivisionError
    assert not are_operators()


def test_an_operator_computes_what_its_function_does():
    @operator
    def twice_and_one_more(x: torch.Tensor, one: torch.Tensor) -> torch.Tensor:
        return 2 * x + one

    x = torch.randn(4)
    with as_operators():
        assert_close(twice_and_one_more(x, torch.ones(4)), 2 * x + 1)
    assert_close(twice_and_one_more(x, torch.ones(4)), 2 * x + 1)
    graph = trace(lambda x: (twice_and_one_more(x, x),), [x], whole=True)
    assert operators_of(graph) == ["twice_and_one_more"]
    with pytest.raises(NotImplementedError, match="twice_and_one_more"):
        NumberKernel(graph, [x])
