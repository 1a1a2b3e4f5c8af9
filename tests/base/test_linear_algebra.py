"""Small matrices by formula against torch's library, derivatives included."""

import math

import pytest
import torch
from torch.testing import assert_close

from lyapnet.base.linear_algebra import LARGE, SMALL, UNROLLED, apply, is_positive_definite, multiply, solve

batches = pytest.mark.parametrize("batch", [(), (4,), (2, 3)], ids=str)


def agree(function, reference, *arguments, tolerance=1e-12):
    """In value, and in the gradient of a weighted sum."""
    leaves = [a.clone().requires_grad_() for a in arguments]
    value, expected = function(*leaves), reference(*leaves)
    assert_close(value, expected, rtol=tolerance, atol=tolerance)
    weight = torch.randn_like(expected)
    slopes = (torch.autograd.grad((weight * y).sum(), leaves) for y in (value, expected))
    for slope, wanted in zip(*slopes, strict=True):
        assert_close(slope, wanted, rtol=tolerance, atol=tolerance)


@batches
@pytest.mark.parametrize("columns", [1, 2])
@pytest.mark.parametrize("d", [1, 2, 3, UNROLLED, UNROLLED + 1])
def test_solve(d, columns, batch):
    half, B = torch.randn(*batch, d, d), torch.randn(*batch, d, columns)
    A = half @ half.mT + torch.eye(d)
    agree(solve, torch.linalg.solve, A, B, tolerance=1e-10)
    with pytest.raises(AssertionError):
        agree(lambda A, B: solve(A.mT + 1e-6, B), torch.linalg.solve, A, B, tolerance=1e-10)


@batches
@pytest.mark.parametrize("d", [1, 2, 3, UNROLLED, UNROLLED + 1])
def test_is_positive_definite(d, batch):
    half = torch.randn(100, *batch, d, d)
    A = half + half.mT + 2 * torch.rand(100, *[1] * len(batch), 1, 1) * math.sqrt(d) * torch.eye(d)
    expected = (torch.linalg.eigvalsh(A) > 0).all(-1)
    assert torch.equal(is_positive_definite(A), expected)
    assert 0 < expected.double().mean() < 1, "some are, and some are not"


def test_solve_pivots_where_the_first_entry_is_zero():
    A = torch.tensor([[0.0, 2.0], [4.0, 1.0]])
    assert solve(A, torch.eye(2)).tolist() == [[-0.125, 0.25], [0.5, 0.0]]


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("condition", [1e2, 1e6, 1e10])
@pytest.mark.parametrize("d", [3, 4, UNROLLED])
def test_small_definite_systems_are_solved_as_well_as_their_condition_allows(d, condition, scale):
    """Within a few roundings times the condition number, as the library does; some digits fewer are noticed."""
    basis = torch.linalg.qr(torch.randn(100, d, d)).Q
    A = scale * basis @ torch.diag(torch.logspace(0, -math.log10(condition), d)) @ basis.mT
    A, x = (A + A.mT) / 2, torch.randn(100, d, 1)
    B = A @ x

    def largest_error(y):
        return float(((y - x).norm(dim=-2) / x.norm(dim=-2)).max())

    rounding = torch.finfo(A.dtype).eps * condition
    assert largest_error(solve(A, B)) < 20 * rounding
    assert largest_error(torch.linalg.solve(A, B)) < 20 * rounding
    assert not largest_error(solve(A.float(), B.float()).double()) < 20 * rounding


SIZES = [(1, 1, 1), (2, 2, 2), (1, 4, 2), (3, 3, 3), (4, 4, 4), (2, 3, SMALL)]  # on both sides of SMALL


@batches
@pytest.mark.parametrize(("k", "d", "columns"), SIZES)
def test_multiply(k, d, columns, batch):
    A, B = torch.randn(*batch, k, d), torch.randn(*batch, d, columns)
    agree(multiply, torch.matmul, A, B)
    with pytest.raises(AssertionError):
        agree(lambda A, B: multiply(A, B) + 1e-6 * A.sum(), torch.matmul, A, B)


@batches
@pytest.mark.parametrize(("k", "d"), [(1, 1), (2, 4), (4, 4), (5, 4)])
def test_apply(k, d, batch):
    """One matrix for each vector, or one for all."""
    v = torch.randn(*batch, d)
    for A in (torch.randn(*batch, k, d), torch.randn(k, d)):
        agree(apply, lambda A, v: torch.einsum("...kd,...d->...k", A, v), A, v)
        with pytest.raises(AssertionError):
            agree(apply, lambda A, v: torch.einsum("...kd,...d->...k", 1.001 * A, v), A, v)


@pytest.mark.parametrize("leading", [(), (3,)], ids=str)
def test_apply_of_one_large_matrix_to_many_vectors(leading):
    """As with a matrix for each vector, but without copies of it."""
    d = math.isqrt(LARGE) + 1
    A, v = torch.randn(*leading, 1, d, d), torch.randn(*leading, 7, d)
    agree(apply, lambda A, v: torch.einsum("...kd,...d->...k", A.expand(*leading, 7, d, d), v), A, v)
    with pytest.raises(AssertionError):
        agree(lambda A, v: apply(A.mT, v), lambda A, v: torch.einsum("...kd,...d->...k", A, v), A, v)
    with torch.profiler.profile(profile_memory=True) as profile:
        apply(A.expand(*leading, 1, d, d), torch.randn(*leading, 1000, d))
    assert max(event.self_cpu_memory_usage for event in profile.key_averages()) < 100 * A.nbytes
