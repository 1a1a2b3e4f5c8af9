"""Network inputs for the distance of states to the borders of their domain."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from lyapnet.base.types import State
from lyapnet.task.domain import Border

MIN_DISTANCE = 1e-9  # smallest resolved distance to a border, relative to the largest distance
SPREAD = 0.35  # share of a quantity's standard deviation along optima that a network input counts as 1


class NearBorders(nn.Module):
    """λ = (log d − m)/s for the distances d = ±(x_i − b) of some states from borders b: (*batch, n) ↦ (*batch, k).

    V often depends on the order of magnitude of a distance. For example, a volume that falls from 10⁴ to 10⁻² towards
    its border 0 would be almost 0 in units of X₀. m and s come from states on trajectories of the task.

    Args:
        borders: borders with the indices of their states.
    """

    states: Int[Tensor, " k"]
    borders: Float[Tensor, " k"]
    sides: Float[Tensor, " k"]
    least: Float[Tensor, " k"]
    mean: Float[Tensor, " k"]
    spread: Float[Tensor, " k"]

    def __init__(self, borders: Sequence[tuple[int, Border]]):
        super().__init__()
        sides = [1.0 if border.side == "lower" else -1.0 for _, border in borders]
        self.register_buffer("states", torch.tensor([i for i, _ in borders], dtype=torch.long), persistent=False)
        self.register_buffer("borders", torch.tensor([border.value for _, border in borders]), persistent=False)
        self.register_buffer("sides", torch.tensor(sides), persistent=False)
        for name, value in (("least", MIN_DISTANCE), ("mean", 0.0), ("spread", 1.0)):
            self.register_buffer(name, torch.full((len(borders),), value))

    def forward(self, x: State) -> Float[Tensor, "*batch k"]:
        return (self._distances(x).log() - self.mean) / self.spread

    def pull_back(self, x: State, gradient: Float[Tensor, "*batch k"]) -> State:
        """Convert a gradient in λ to one in x; zero beyond the borders."""
        distances = self._distances(x)
        slope = self.sides * gradient / (self.spread * distances)
        return torch.zeros_like(x).index_add(-1, self.states, slope.where(distances > self.least, 0))

    @torch.no_grad()
    def fit(self, x: State) -> None:
        """Set m and s from states (b, n) on trajectories of the task."""
        distances = (self.sides * (x.to(self.mean)[:, self.states] - self.borders)).clamp_min(0)
        size = distances.amax(0)
        self.least.copy_(MIN_DISTANCE * size.where(size > 0, 1))
        logarithms = distances.maximum(self.least).log()
        self.mean.copy_(logarithms.mean(0))
        deviation = SPREAD * logarithms.std(0, correction=0)
        self.spread.copy_(deviation.where(deviation > 0, 1))

    def _distances(self, x: State) -> Float[Tensor, "*batch k"]:
        return (self.sides * (x[..., self.states] - self.borders)).maximum(self.least)
