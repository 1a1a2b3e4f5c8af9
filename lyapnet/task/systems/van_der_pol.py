"""The van der Pol oscillator."""

import torch

from lyapnet.base.types import InputMatrix, State
from lyapnet.task.systems.base import ControlAffineSystem


class VanDerPol(ControlAffineSystem):
    """The van der Pol oscillator ẋ₁ = x₂, ẋ₂ = −x₁ + μ (1 − x₁²) x₂ + u: small oscillations grow, large ones decay.

    Without control the origin is unstable, and every other state converges to a limit cycle around it.

    Args:
        damping: μ.
    """

    state_names, state_units = ("x1", "x2"), ("1", "1/s")
    control_names, control_units = ("input",), ("1/s²",)

    def __init__(self, damping: float = 1.0):
        super().__init__()
        self.damping = damping

    def f(self, x: State) -> State:
        x1, x2 = x.unbind(-1)
        return torch.stack([x2, self.damping * (1 - x1**2) * x2 - x1], -1)

    def g(self, x: State) -> InputMatrix:
        return torch.tensor([[0.0], [1.0]]).to(x).expand(*x.shape[:-1], 2, 1)
