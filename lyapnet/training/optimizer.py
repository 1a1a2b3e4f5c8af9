"""How the weights move."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

MOMENTUM = 0.95  # of Muon
QUINTIC = (3.4445, -4.7750, 2.0315)  # takes singular values in (0, 1] to about 1 in five rounds


class Muon(torch.optim.AdamW):
    """Muon for the matrices of a network, AdamW for its other parameters, such as biases and the last layer.

    With M the momentum of a gradient, a step along a matrix W is −0.2 √max(rows, columns) η U, where U is about the
    orthogonal matrix closest to M: all singular directions move by as much, and the entries by as much as by Adam. It
    is computed in the precision of W: torch.optim.Muon rounds M to 16 bits, after which two computations of one seed
    that differ by rounding drift apart.

    Source: Jordan et al., "Muon: An optimizer for hidden layers in neural networks", 2024; the length of a step: Liu et
    al., "Muon is scalable for LLM training", arXiv 2502.16982.
    """

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        gradients = dict[nn.Parameter, Tensor]()
        for group in self.param_groups:
            for p in group["params"]:
                if p.grad is not None and p.ndim == 2 and min(p.shape) > 1:
                    gradients[p] = p.grad
                    self._step_along(p, p.grad, group)
                    p.grad = None  # which has AdamW pass it over
        super().step()
        for p, gradient in gradients.items():
            p.grad = gradient
        return loss

    def _step_along(self, p: nn.Parameter, gradient: Tensor, group: dict[str, Any]) -> None:
        state = self.state[p]
        if not state:
            state.update(step=torch.tensor(0.0), momentum=torch.zeros_like(p))  # AdamW counts every parameter's steps
        state["step"] += 1
        momentum = state["momentum"]
        momentum.lerp_(gradient, 1 - MOMENTUM)
        p.mul_(1 - group["lr"] * group["weight_decay"])
        direction = orthogonal(gradient.lerp(momentum, MOMENTUM))
        p.add_(direction, alpha=-0.2 * math.sqrt(max(p.shape)) * group["lr"])


def orthogonal(M: Tensor) -> Tensor:
    """A matrix with the singular vectors of M, whose singular values are between 0.6 and 1.25 where those of M are not
    small: UVᵀ of M = USVᵀ, by five rounds of X ↦ aX + bXXᵀX + c(XXᵀ)²X.

    Source: Jordan et al., 2024, for a, b, c.
    """
    X = M / M.norm().clamp_min(torch.finfo(M.dtype).tiny)
    X = X.mT if len(M) > M.shape[1] else X
    a, b, c = QUINTIC
    for _ in range(5):
        A = X @ X.mT
        X = torch.addmm(X, torch.addmm(A, A, A, beta=b, alpha=c), X, beta=a)
    return X.mT if len(M) > M.shape[1] else X


OPTIMIZERS: dict[str, Callable[..., torch.optim.Optimizer]] = {
    "adam": torch.optim.Adam,
    "adamw": torch.optim.AdamW,
    "muon": Muon,
}


@dataclass(frozen=True)
class OptimizerOptions:
    """How weights move; the learning rate rises, if asked to, and falls along half a cosine.

    The first steps have the full length along every weight, however small the gradient: from a good start they lead
    away, unless they are short.
    """

    name: str = "adam"  # a key of OPTIMIZERS
    learning_rate: float = 1e-2  # the greatest
    final_learning_rate: float = 1e-4  # at the last step, and after it
    betas: tuple[float, float] = (0.9, 0.99)
    weight_decay: float = 0.0
    warmup: int = 0  # steps in which it rises to that first
    iterations: int | None = None  # steps of the schedule; None: those of the trainer

    def optimizer(self, parameters: Sequence[nn.Parameter | dict[str, Any]]) -> torch.optim.Optimizer:
        """The optimizer of some parameters, or groups of them."""
        cls = OPTIMIZERS[self.name]
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
