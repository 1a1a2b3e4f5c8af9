"""Rounding in another program's arithmetic, as an operator of graphs: the identity for values, an error for bounds.

A function that imitates another program marks its results by mark_rounded. Values and derivatives are those of the
exact function; the bounds of lyapnet.prover.bounds hold for every function whose results have the marked errors.
"""

from contextlib import AbstractContextManager

import torch
from torch import Tensor

from lyapnet.base.operators import BOUNDS, are_operators, as_operators


def rounding(counted: bool) -> AbstractContextManager[None]:
    """A context in which mark_rounded leaves an operator in traced graphs if `counted`; else it returns y."""
    return as_operators(BOUNDS, counted)


def mark_rounded(y: Tensor, at: Tensor, relative: float, absolute: float, largest: float) -> Tensor:
    """y; for bounds, any y (1 + θ) + η with |θ| ≤ relative and |η| ≤ absolute; any number if |y| may exceed `largest`.

    θ and η may differ at each point and in each use of the result.

    Args:
        y: in float64; it may be constant.
        at: the point, on which the errors may depend.
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
