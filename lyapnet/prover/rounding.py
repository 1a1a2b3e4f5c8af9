"""Rounding of an arithmetic that is not torch's, as an operator of graphs: the identity, which bounds widen.

Functions that stand for what another program computes mark their results as rounded. Numbers and derivatives are those
of the exact function; the bounds of lyapnet.prover.bounds hold for every function whose results are rounded as marked.
"""

from contextlib import AbstractContextManager

import torch
from torch import Tensor

from lyapnet.base.operators import BOUNDS, are_operators, as_operators


def rounding(counted: bool) -> AbstractContextManager[None]:
    """Whether `rounded` leaves an operator in what is traced within; outside it leaves none."""
    return as_operators(BOUNDS, counted)


def rounded(y: Tensor, at: Tensor, relative: float, absolute: float, largest: float) -> Tensor:
    """y; to bounds any y (1 + θ) + η with |θ| ≤ relative and |η| ≤ absolute, and anything where |y| may exceed
    `largest`.

    θ and η may be others at each point, and in each use of the result.

    Args:
        y: in float64; a constant too.
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
def _(info, axes, y, at, relative, absolute, largest):  # of the states of a batch
    return y.clone(), axes[0]


ROUNDED = torch.ops.lyapnet.rounded.default
