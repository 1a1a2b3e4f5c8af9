"""How the weights move."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn


@dataclass(frozen=True)
class OptimizerOptions:
    """Adam, or AdamW with decoupled weight decay; the learning rate rises, if asked to, and falls along half a cosine.

    Adam's first steps have the full length along every weight, however small the gradient: from a good start they lead
    away, unless they are short.
    """

    name: str = "adam"  # or adamw
    learning_rate: float = 1e-2  # the greatest
    final_learning_rate: float = 1e-4  # at the last step, and after it
    betas: tuple[float, float] = (0.9, 0.99)
    weight_decay: float = 0.0
    warmup: int = 0  # steps in which it rises to that first
    iterations: int | None = None  # steps of the schedule; None: those of the trainer

    def optimizer(self, parameters: Sequence[nn.Parameter | dict[str, Any]]) -> torch.optim.Optimizer:
        """The optimizer of some parameters, or groups of them."""
        cls = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW}[self.name]
        return cls(parameters, lr=self.learning_rate, betas=self.betas, weight_decay=self.weight_decay)

    def rate(self, step: int, iterations: float, cooling: tuple[int, int] | None = None) -> float:
        """The learning rate at a step, as a share of the greatest.

        Args:
            iterations: of the whole schedule.
            cooling: steps between which it falls to its end, and then is zero; None: there are none.
        """
        final = self.final_learning_rate / self.learning_rate
        if cooling is not None and step > cooling[0]:
            share = (step - cooling[0]) / (cooling[1] - cooling[0])
            return _half_cosine(self.rate(cooling[0], iterations), final, share) if share < 1 else 0.0
        return _half_cosine(1.0, final, step / iterations) * min((step + 1) / (self.warmup + 1), 1.0)


def _half_cosine(first: float, last: float, share: float) -> float:
    return last + (first - last) * (1 + math.cos(math.pi * min(share, 1.0))) / 2
