"""An operator that marks results which another program rounds: values stay, bounds get wider.

A function in real numbers that describes another program marks each rounded result with mark_rounded. Its values and
derivatives stay those of real numbers; its bounds (lyapnet.prover.bounds) hold for every choice of the marked errors.
"""

from contextlib import AbstractContextManager

import torch
from torch import Tensor

from lyapnet.base.operators import BOUNDS, are_operators, as_operators


def rounding(counted: bool) -> AbstractContextManager[None]:
    """A context in which traced graphs contain the errors of mark_rounded if `counted`; else mark_rounded returns y."""
    return as_operators(BOUNDS, counted)


def mark_rounded(y: Tensor, at: Tensor, relative: float, absolute: float, largest: float) -> Tensor:
    """y, whose bounds enclose y (1 + θ) + η for all |θ| ≤ relative and |η| ≤ absolute.

    They are infinite where |y| may exceed `largest`. θ and η may differ at each point and in each use of the result.

    Args:
        y: in float64; it may be constant.
        at: the point (t, x), on which the errors may depend.
    """
    return torch.ops.lyapnet.rounded(y, at, relative, absolute, largest) if are_operators(BOUNDS) else y


@torch.library.custom_op("lyapnet::rounded", mutates_args=())
def _rounded(y: Tensor, at: Tensor, relative: float, absolute: float, largest: float) -> Tensor:
    return y.clone()


@_rounded.register_fake
def _(y: Tensor, at: Tensor, relative: float, absolute: float, largest: float) -> Tensor:
    return torch.empty_like(y)


@_rounded.register_vmap
def _(info, axes, y, at, relative, absolute, largest):
    return y.clone(), axes[0]


_rounded.register_autograd(lambda context, slope: (slope, None, None, None, None))

ROUNDED = torch.ops.lyapnet.rounded.default
