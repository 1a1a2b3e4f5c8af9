"""Optimizers and the learning rate schedule."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

MOMENTUM = 0.95  # momentum coefficient of Muon
QUINTIC = (3.4445, -4.7750, 2.0315)  # a, b, c of the iteration in `orthogonal`


class Muon(torch.optim.AdamW):
    """Muon for the weight matrices of a network, AdamW for its other parameters, such as biases and the last layer.

    With M the momentum of the gradient and η the learning rate, the step of a matrix W is −0.2 √max(rows, columns) η U,
    where U approximates the orthogonal matrix closest to M. All singular directions then move by the same amount, and
    the entries of W by as much as with Adam. U is computed in the precision of W, because torch.optim.Muon rounds M to
    16 bits, which amplifies rounding differences between two runs of the same seed.

    Source: Jordan et al., "Muon: An optimizer for hidden layers in neural networks", 2024; for the step length: Liu et
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
                    p.grad = None  # AdamW skips parameters without gradient
        super().step()
        for p, gradient in gradients.items():
            p.grad = gradient
        return loss

    def _step_along(self, p: nn.Parameter, gradient: Tensor, group: dict[str, Any]) -> None:
        state = self.state[p]
        if not state:
            state.update(step=torch.tensor(0.0), momentum=torch.zeros_like(p))  # AdamW expects `step`
        state["step"] += 1
        momentum = state["momentum"]
        momentum.lerp_(gradient, 1 - MOMENTUM)
        p.mul_(1 - group["lr"] * group["weight_decay"])
        direction = orthogonal(gradient.lerp(momentum, MOMENTUM))
        p.add_(direction, alpha=-0.2 * math.sqrt(max(p.shape)) * group["lr"])


def orthogonal(M: Tensor) -> Tensor:
    """Approximately UVᵀ for M = USVᵀ, by five iterations X ↦ aX + bXXᵀX + c(XXᵀ)²X.

    Singular values of M that are not small become values between 0.6 and 1.25.

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
    """The optimizer and its learning rate: a linear warmup, then half a cosine.

    The warmup protects a good initial V: the first steps of Adam have full length even if the gradient is small.
    """

    name: str = "adam"  # a key of OPTIMIZERS
    learning_rate: float = 1e-2  # largest rate, at the end of the warmup
    final_learning_rate: float = 1e-4  # rate at the last step and after it
    betas: tuple[float, float] = (0.9, 0.99)
    weight_decay: float = 0.0
    warmup: int = 0  # steps of the warmup
    iterations: int | None = None  # steps of the schedule; None: as many as the trainer makes

    def optimizer(self, parameters: Sequence[nn.Parameter | dict[str, Any]]) -> torch.optim.Optimizer:
        """The optimizer for some parameters or parameter groups."""
        cls = OPTIMIZERS[self.name]
        return cls(parameters, lr=self.learning_rate, betas=self.betas, weight_decay=self.weight_decay)

    def rate(self, step: int, iterations: float, cooling: tuple[int, int] | None = None) -> float:
        """The learning rate at a step, relative to the largest.

        Args:
            iterations: steps of the whole schedule.
            cooling: first and last step of the final decay, after which the rate is zero; None: no such decay.
        """
        final = self.final_learning_rate / self.learning_rate
        if cooling is not None and step > cooling[0]:
            share = (step - cooling[0]) / (cooling[1] - cooling[0])
            return _half_cosine(self.rate(cooling[0], iterations), final, share) if share < 1 else 0.0
        return _half_cosine(1.0, final, step / iterations) * min((step + 1) / (self.warmup + 1), 1.0)


def _half_cosine(first: float, last: float, share: float) -> float:
    return last + (first - last) * (1 + math.cos(math.pi * min(share, 1.0))) / 2
