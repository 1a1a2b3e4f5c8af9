"""Whether two computations of the same function agree."""

import torch
from torch import Tensor

HALF, THIRD = 1 / 2, 1 / 3  # shares of the digits of a number type in which two results must agree


def are_close(found: Tensor, expected: Tensor, digits: float = HALF) -> bool:
    """Whether two results agree up to a share of their digits, relative to each entry or to the largest finite one.

    So they may differ by the rounding of sums in another order. Both must have nan at the same entries.
    """
    if found.shape != expected.shape or found.dtype != expected.dtype:
        return False
    if not expected.numel():
        return True
    tolerance = torch.finfo(expected.dtype).eps ** digits
    scale = float(expected.nan_to_num(0, 0, 0).abs().max())
    return torch.allclose(found, expected, rtol=tolerance, atol=tolerance * scale, equal_nan=True)
