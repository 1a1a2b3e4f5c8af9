"""A step that is taken over and over, as one function of tensors."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor


class Scan:
    """(*state, *columns, x₀) ↦ what step(*state, *columns at n, x_n, *prepare(*state)) keeps at each step, over time.

    Args:
        prepare: what all steps share.
        step: returns the next x and, after it, what is kept, and at last what is summed over the steps.
        tensors: number of tensors in `state`.
        sums: number of results that are summed.
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
        """The scan as a loop, for a step of any kind."""
        state, (*columns, x) = arguments[: self.tensors], arguments[self.tensors :]
        shared, kept = self.prepare(*state), []
        for now in zip(*columns, strict=True):
            x, *node = self.step(*state, *now, x, *shared)
            kept.append(node)
        columns = [torch.stack(column) for column in zip(*kept, strict=True)]
        first = len(columns) - self.sums
        return [*columns[:first], *(column.sum(0) for column in columns[first:])]
