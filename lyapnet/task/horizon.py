"""The time grid of the horizon, and the explicit Runge–Kutta methods of its steps."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.base.types import Times


class ButcherTableau(NamedTuple):
    """An explicit Runge–Kutta method: X_i = x + Δt Σ_{j<i} a_ij k_j at t + c_i Δt, and x' = x + Δt Σ_i b_i k_i."""

    a: tuple[tuple[float, ...], ...]
    b: tuple[float, ...]
    c: tuple[float, ...]


TABLEAUX = {
    "euler": ButcherTableau(((),), (1.0,), (0.0,)),
    "midpoint": ButcherTableau(((), (1 / 2,)), (0.0, 1.0), (0.0, 1 / 2)),
    "rk4": ButcherTableau(  # the 3/8 rule, as in torchdiffeq
        ((), (1 / 3,), (-1 / 3, 1.0), (1.0, -1.0, 1.0)), (1 / 8, 3 / 8, 3 / 8, 1 / 8), (0.0, 1 / 3, 2 / 3, 1.0)
    ),
}


@dataclass(frozen=True)
class Horizon:
    """N steps of Δt seconds; T = NΔt.

    Args:
        method: integrator of a step with u held, a key of TABLEAUX.
        stationary: whether the task has an infinite horizon: V is a function of the state alone, and φ is the cost
            after T.

    Raises:
        ValueError: no step, Δt not positive, or an unknown method.
    """

    steps: int
    dt: float
    method: str = "euler"
    stationary: bool = False

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise ValueError(f"Expected steps ≥ 1, got {self.steps}; a horizon needs at least one step.")
        if not 0 < self.dt < float("inf"):
            raise ValueError(f"Expected dt > 0, got {self.dt}; give the step length in seconds.")
        if self.method not in TABLEAUX:
            raise ValueError(f"Expected method as one of {', '.join(TABLEAUX)}, got {self.method!r}; choose one.")

    @property
    def duration(self) -> float:
        """T in s."""
        return self.steps * self.dt

    def times(self, like: Tensor) -> Times:
        """The nodes t_n = nΔt, n = 0 … N, in the dtype and on the device of a tensor."""
        return torch.arange(self.steps + 1, dtype=like.dtype, device=like.device) * self.dt


def weighted_sum(weights: Sequence[float], tensors: Sequence[Tensor]) -> Tensor:
    """Σ w_i y_i over the nonzero weights."""
    terms = [y if w == 1 else w * y for w, y in zip(weights, tensors, strict=True) if w]
    return sum(terms[1:], start=terms[0])
