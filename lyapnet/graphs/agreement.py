"""Whether two computations of the same function agree."""

import torch
from torch import Tensor

HALF, THIRD = 1 / 2, 1 / 3  # of the digits of a type


def are_close(found: Tensor, expected: Tensor, digits: float = HALF) -> bool:
    """Whether two results agree in a share of their digits, each or relative to the largest finite one.

    They may add in another order. Where one is not a number, the other is none either.
    """
    if found.shape != expected.shape or found.dtype != expected.dtype:
        return False
    if not expected.numel():
        return True
    tolerance = torch.finfo(expected.dtype).eps ** digits
    scale = float(expected.nan_to_num(0, 0, 0).abs().max())
    return torch.allclose(found, expected, rtol=tolerance, atol=tolerance * scale, equal_nan=True)
