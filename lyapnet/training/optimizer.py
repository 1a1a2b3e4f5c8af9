"""How the weights move."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

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

    def optimizer(self, parameters: Sequence[nn.Parameter]) -> torch.optim.Optimizer:
        """The optimizer of some parameters."""
        cls = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW}[self.name]
        return cls(parameters, lr=self.learning_rate, betas=self.betas, weight_decay=self.weight_decay)

    def rate(self, step: int, iterations: float) -> float:
        """The learning rate at a step, as a share of the greatest."""
        final = self.final_learning_rate / self.learning_rate
        progress = min(step / iterations, 1.0)
        fallen = final + (1 - final) * (1 + math.cos(math.pi * progress)) / 2
        return fallen * min((step + 1) / (self.warmup + 1), 1.0)
