"""Sets of states: X₀, and bounds of controls."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from lyapnet.types import State


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
        return torch.maximum(self.lower.abs(), self.upper.abs())

    def sample(self, count: int, generator: torch.Generator | None = None) -> State:
        """`count` states drawn uniformly and independently; on a CPU generator whatever the box's device,
        so that a seed names the same states everywhere."""
        unit = torch.rand(count, self.dimension, generator=generator, dtype=torch.float64)
        x = self.lower + self.widths * unit.to(self.lower)
        return torch.minimum(x, self.upper)  # rounding may pass the upper bound, never the lower one

    def contains(self, x: State) -> Bool[Tensor, "*batch"]:
        """Whether each state lies in the closed box."""
        return ((self.lower <= x) & (x <= self.upper)).all(-1)

    def extreme_point(self, direction: State) -> State:
        """argmax over the box of directionᵀx: a corner for each direction (the upper bound where it is zero)."""
        return torch.where(direction >= 0, self.upper, self.lower)
