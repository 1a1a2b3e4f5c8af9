"""Sets of states and of controls."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from lyapnet.linear_algebra import solve
from lyapnet.types import Control, ControlMatrix, State


class Box(nn.Module):
    """The box {x : lower ≤ x ≤ upper}, componentwise; a component with lower = upper is fixed.

    Args:
        lower: (n,) lower bounds, in the units of the state.
        upper: (n,) upper bounds.

    Raises:
        ValueError: bounds of different or no length, not finite, or reversed.
    """

    lower: Float[Tensor, " n"]
    upper: Float[Tensor, " n"]

    def __init__(self, lower: Sequence[float] | Tensor, upper: Sequence[float] | Tensor):
        super().__init__()
        low, high = torch.as_tensor(lower), torch.as_tensor(upper)
        if low.ndim != 1 or low.shape != high.shape or not len(low):
            raise ValueError(
                f"Expected lower and upper of the same shape (n,), got {tuple(low.shape)} and {tuple(high.shape)}; "
                "give one bound for each state."
            )
        dtype = torch.promote_types(torch.promote_types(low.dtype, high.dtype), torch.get_default_dtype())
        low, high = low.to(dtype), high.to(dtype)
        if not (torch.isfinite(low).all() and torch.isfinite(high).all()):
            raise ValueError(
                f"Expected finite bounds, got lower {low.tolist()} and upper {high.tolist()}; choose a bounded set."
            )
        reversed_at = torch.nonzero(low > high).flatten().tolist()
        if reversed_at:
            i = reversed_at[0]
            raise ValueError(f"Expected lower ≤ upper, got {low[i]} > {high[i]} at index {i}; swap the two bounds.")
        self.register_buffer("lower", low, persistent=False)
        self.register_buffer("upper", high, persistent=False)

    @property
    def dimension(self) -> int:
        """n."""
        return len(self.lower)

    @property
    def center(self) -> Float[Tensor, " n"]:
        """The midpoint (lower + upper) / 2."""
        return (self.lower + self.upper) / 2

    @property
    def widths(self) -> Float[Tensor, " n"]:
        """Side lengths upper − lower; zero where a component is fixed."""
        return self.upper - self.lower

    @property
    def magnitude(self) -> Float[Tensor, " n"]:
        """max |x_i| over the box, for each component."""
        return self.reach_from(torch.zeros_like(self.lower))

    def reach_from(self, point: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """max |x_i − point_i| over the box, for each component."""
        return torch.maximum((self.lower - point).abs(), (self.upper - point).abs())

    def sample(self, count: int, generator: torch.Generator | None = None) -> State:
        """`count` states drawn uniformly and independently; on a CPU generator whatever the box's device,
        so that a seed names the same states everywhere."""
        unit = torch.rand(count, self.dimension, generator=generator, dtype=torch.float64)
        x = self.lower + self.widths * unit.to(self.lower)
        return torch.minimum(x, self.upper)  # rounding may pass the upper bound, never the lower one

    def contains(self, x: State) -> Bool[Tensor, "*batch"]:
        """Whether each state lies in the closed box."""
        return ((self.lower <= x) & (x <= self.upper)).all(-1)


class ControlSet(nn.Module, ABC):
    """U ⊂ ℝᵐ, the controls that a problem admits: closed and convex.

    A subclass writes its three methods with torch operations on tensors of any leading shape. What it is made of are
    buffers: they follow the problem's precision and device, and tell its controls apart from those of other problems.
    """

    @property
    def limited(self) -> bool:
        """Whether some control of ℝᵐ is left out."""
        return True

    @abstractmethod
    def minimise(self, R: ControlMatrix, b: Control) -> Control:
        """argmin over u ∈ U of uᵀRu + bᵀu, (*batch, m): the control law, with b = gᵀV_x.

        Args:
            R: (*batch, m, m), symmetric positive definite.
            b: (*batch, m).
        """

    @abstractmethod
    def contains(self, u: Control) -> Bool[Tensor, "*batch"]:
        """Whether each control lies in U."""

    @abstractmethod
    def project(self, u: Control) -> Control:
        """The point of U closest to each control."""


class Unbounded(ControlSet):
    """U = ℝᵐ."""

    @property
    def limited(self) -> bool:
        return type(self) is not Unbounded  # a set derived from it may leave something out

    def minimise(self, R: ControlMatrix, b: Control) -> Control:
        return -0.5 * solve(R, b[..., None])[..., 0]

    def contains(self, u: Control) -> Bool[Tensor, "*batch"]:
        return torch.isfinite(u).all(-1)

    def project(self, u: Control) -> Control:
        return u


CONTROL_SETS: dict[str, type[ControlSet]] = {"unbounded": Unbounded}
