"""Linear algebra for batches of small matrices, one for each state, as in mechanics.

Libraries process such matrices one by one. Elementwise operations on whole batches are faster, and a compiler can fuse
them with neighbouring operations. Large matrices use torch.
"""

from typing import Any

import torch
from torch import Tensor
from torch.overrides import handle_torch_function, has_torch_function_unary

from lyapnet.base.operators import are_operators, is_transformed, operator

SMALL = 16  # largest number of scalar products for which elementwise operations are faster
CONVEX = 0.1  # smallest curvature in u relative to that of the control cost
LARGE = 1024  # entries from which one matrix for many vectors is not copied for each of them
UNROLLED = 6  # largest number of unknowns of linear systems that are solved by elementwise operations
MOST_UNKNOWNS = 32  # largest number of unknowns of the kernel's instruction for linear systems, as in program.cpp


def norm(v: Tensor, dim: int = -1) -> Tensor:
    """‖v‖ = √(Σ v²) along an axis, exactly, with slope 0 at v = 0 and finite higher derivatives there.

    The slope of the root is infinite at 0, and autograd then gives NaN: at rest, v‖v‖ has no derivative with
    torch.sqrt, and no second derivative with torch.linalg.vector_norm.

    Args:
        v: (…, k, …), in any unit.
        dim: the axis of the sum.
    """
    if has_torch_function_unary(v):  # a TorchFunctionMode, as for smoothed costs, sees the norm as one function
        return handle_torch_function(norm, (v,), v, dim=dim)
    squared = (v * v).sum(dim)
    away = squared > 0
    # the root of 1 replaces the root of 0, so that no infinite slope is computed
    return torch.where(away, torch.sqrt(torch.where(away, squared, 1.0)), 0.0)


def multiply(A: Tensor, B: Tensor) -> Tensor:
    """AB for A of shape (*batch, k, d) and B of shape (*batch, d, l)."""
    if A.shape[-2] * A.shape[-1] * B.shape[-1] > SMALL:
        return A @ B
    return (A[..., :, :, None] * B[..., None, :, :]).sum(-2)


def apply(A: Tensor, v: Tensor) -> Tensor:
    """Av for A of shape (*batch, k, d) or (k, d), and v of shape (*batch, d)."""
    if A.ndim == 2 and A.numel() > SMALL:
        return v @ A.mT
    if A.ndim > 2 and A.shape[-3] == 1 and v.ndim > 1 and A.shape[-2] * A.shape[-1] >= LARGE:
        return v @ A[..., 0, :, :].mT
    return multiply(A, v[..., None])[..., 0]


def solve(A: Tensor, B: Tensor) -> Tensor:
    """A⁻¹B for A (*batch, d, d) and B (*batch, d, k); A has to be symmetric positive definite for d > 2."""
    d = A.shape[-1]
    if d == 1:
        return B / A
    if d > (MOST_UNKNOWNS if are_operators() else UNROLLED):
        return torch.linalg.solve(A, B)
    if d > 2:
        return multiply(_Inverse.apply(A), B)  # pyright: ignore[reportArgumentType]
    a, b, c, e = A[..., :1, :1], A[..., :1, 1:], A[..., 1:, :1], A[..., 1:, 1:]  # Cramer's rule
    first, second = B[..., :1, :], B[..., 1:, :]
    return torch.cat([e * first - b * second, a * second - c * first], -2) / (a * e - b * c)


def is_positive_definite(A: Tensor) -> Tensor:
    """Whether each symmetric A (*batch, d, d) has positive pivots; Booleans of shape (*batch,)."""
    d, definite = A.shape[-1], A[..., 0, 0] > 0
    if d > UNROLLED:
        return torch.linalg.cholesky_ex(A).info == 0
    for _ in range(d - 1):
        pivot = A[..., :1, :1]
        A = A[..., 1:, 1:] - A[..., 1:, :1] * A[..., :1, 1:] / torch.where(pivot > 0, pivot, 1.0)
        definite = definite & (A[..., 0, 0] > 0)
    return definite


def convex_or(A: Tensor, floor: Tensor, otherwise: Tensor) -> Tensor:
    """A where the symmetric A (*batch, d, d) exceeds CONVEX times a positive definite floor, else another matrix."""
    return torch.where(is_positive_definite(A - CONVEX * floor)[..., None, None], A, otherwise)


@operator
def symmetric_inverse(A: Tensor) -> Tensor:
    """A⁻¹ of symmetric positive definite A (*batch, d, d) from its lower triangle, by the sweep operator.

    For each pivot p: a_pp becomes −1/a_pp, a_ip becomes a_ip/a_pp, and a_ij becomes a_ij − a_ip a_jp/a_pp. After the
    last pivot the matrix is −A⁻¹. Pivoting is not necessary for such matrices.

    Source: Goodnight, "A tutorial on the SWEEP operator", The American Statistician 1979.
    """
    d = A.shape[-1]
    a = {(i, j): A[..., i, j] for i in range(d) for j in range(i + 1)}
    for p in range(d):
        reciprocal = 1 / a[p, p]
        column = [a[max(i, p), min(i, p)] for i in range(d)]
        scaled = [entry * reciprocal for entry in column]
        for i, j in a:
            if p in (i, j):
                a[i, j] = -reciprocal if i == j else scaled[i + j - p]
            else:
                a[i, j] = a[i, j] - scaled[i] * column[j]
    rows = [torch.stack([-a[max(i, j), min(i, j)] for j in range(d)], -1) for i in range(d)]
    return torch.stack(rows, -2)


class _Inverse(torch.autograd.Function):
    """symmetric_inverse with its derivative −A⁻ᵀ Ā A⁻ᵀ."""

    generate_vmap_rule = True

    @staticmethod
    def forward(A: Tensor) -> Tensor:
        return symmetric_inverse(A)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.save_for_backward(output)

    @staticmethod
    def backward(ctx: Any, bar: Tensor) -> Tensor:
        (inverse,) = ctx.saved_tensors
        return -multiply(inverse.mT, multiply(bar, inverse.mT))


def has_values(x: Tensor) -> bool:
    """Whether a tensor has values that can be read; in a trace and under vmap it has none."""
    return type(x) is Tensor and not is_transformed(x)
