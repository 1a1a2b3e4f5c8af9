"""Linear algebra in the sizes that mechanics asks for: small matrices, one for each state of a batch.

A library takes such matrices one after the other. Written as multiplications of whole batches, the same work is
faster, and a compiler joins it with its neighbours. Large matrices go to torch.
"""

import torch
from torch import Tensor

SMALL = 16  # products of entries that are cheaper without the library


def multiply(A: Tensor, B: Tensor) -> Tensor:
    """AB for A of shape (*batch, k, d) and B of shape (*batch, d, l)."""
    if A.shape[-2] * A.shape[-1] * B.shape[-1] > SMALL:
        return A @ B
    return (A[..., :, :, None] * B[..., None, :, :]).sum(-2)


def apply(A: Tensor, v: Tensor) -> Tensor:
    """Av for A of shape (*batch, k, d) or (k, d), and v of shape (*batch, d)."""
    if A.ndim == 2 and A.numel() > SMALL:
        return v @ A.mT
    return multiply(A, v[..., None])[..., 0]


def solve(A: Tensor, B: Tensor) -> Tensor:
    """A⁻¹B for A of shape (*batch, d, d) and B of shape (*batch, d, k); for d = 2 by Cramer's rule."""
    d = A.shape[-1]
    if d == 1:
        return B / A
    if d > 2:
        return torch.linalg.solve(A, B)
    a, b, c, e = A[..., :1, :1], A[..., :1, 1:], A[..., 1:, :1], A[..., 1:, 1:]
    first, second = B[..., :1, :], B[..., 1:, :]
    return torch.cat([e * first - b * second, a * second - c * first], -2) / (a * e - b * c)
