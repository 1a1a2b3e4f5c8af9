"""A repeated step as one function of tensors."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor


class Scan:
    """(*state, *columns, x₀) ↦ the outputs of x_{n+1}, *outputs = step(*state, *columns[n], x_n, *prepare(*state)).

    Args:
        prepare: computes what all steps share.
        step: returns the next x, the outputs to stack over time, and the outputs to sum over time.
        tensors: number of tensors in `state`.
        sums: number of outputs to sum.
    """

    def __init__(
        self,
        prepare: Callable[..., Sequence[Tensor]],
        step: Callable[..., Sequence[Tensor]],
        tensors: int,
        sums: int = 0,
    ):
        self.prepare, self.step, self.tensors, self.sums = prepare, step, tensors, sums

    def loop(self, *arguments: Tensor) -> list[Tensor]:
        """The scan as a Python loop, for any step."""
        state, (*columns, x) = arguments[: self.tensors], arguments[self.tensors :]
        shared, kept = self.prepare(*state), []
        for now in zip(*columns, strict=True):
            x, *node = self.step(*state, *now, x, *shared)
            kept.append(node)
        columns = [torch.stack(column) for column in zip(*kept, strict=True)]
        first = len(columns) - self.sums
        return [*columns[:first], *(column.sum(0) for column in columns[first:])]
