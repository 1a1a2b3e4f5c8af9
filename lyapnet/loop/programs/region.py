"""The region program: V(x) decreases along the closed loop on a sublevel set in a box that is as large as possible."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lyapnet.base.types import Control, PerState, State, Time, ValuePath
from lyapnet.loop.programs.base import Program
from lyapnet.loop.programs.pointwise import PointwiseCondition
from lyapnet.loop.programs.terms import hinge, terminal_hinge
from lyapnet.loop.rollout import Trajectory
from lyapnet.value.networks import kept_states

CEILING = 1.15  # points with V above this multiple of the least V on the boundary of D do not count
STEP_SHARPNESS = 8.0  # slope of the smooth step at V = ρ, in log V
MINIMUM_SHARPNESS = 30.0  # exponent of the smooth minimum over the boundary
BOUNDARY_POINTS = 1024  # random points for ρ: on the boundary of D, or from which a step leaves D
VOLUME_SAMPLES = 20_000  # random points of D that measure the region


@dataclass(frozen=True)
class RegionProgram(Program):
    """V̇ + share · ℓ ≤ 0 on {x ∈ D: V(x) ≤ ρ}, ρ = least V on the boundary of D, with this set as large as possible.

    The condition is imposed at points, see RegionCondition. C = Σ_n max(V_{n+1} − V_n + share Δt ℓ_n, 0) along closed
    loops and their cost J_N are further terms. V is not the cost-to-go but a Lyapunov function of its law; with share <
    1 it may be steeper than the cost-to-go where that enlarges the region.

    With `steps` it is about the steps x⁺ = F(x) of the horizon's method, with u held, for a claim about these: V̇ is
    (V(x⁺) − V(x))/Δt, and ρ the least V from which a step leaves D. The region may then touch the boundary of D.

    Args:
        share: smallest decrease of V relative to the running cost; positive as a reserve for a proof.
        growth: weight of the share of D outside the region, relative to the condition.
        steps: whether V is to fall in steps of Δt.
    """

    degree: ClassVar[int] = 1
    needs_goal: ClassVar[bool] = True
    pointwise: ClassVar[float] = 5.0
    recommended: ClassVar[Mapping[str, float | bool]] = MappingProxyType(
        {"constraint": 0, "trajectory_cost": 1, "share": 0.4, "growth": 0.06}
    )

    share: float = 0.4
    growth: float = 0.06
    steps: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.share <= 1:
            raise ValueError(f"Expected share in (0, 1], got {self.share}; V cannot decrease by more than the cost.")
        if not self.growth >= 0:
            raise ValueError(f"Expected growth ≥ 0, got {self.growth}; a negative weight would shrink the region.")

    def excess(self, rate: Tensor, running: Tensor) -> Tensor:
        return rate + self.share * running

    def penalty(self, excess: Tensor) -> Tensor:
        return torch.relu(excess)

    def constraint_loss(self, values: ValuePath, trajectory: Trajectory) -> PerState:
        return hinge(values, self.share * trajectory.step_cost)

    def terminal_term(self, values: ValuePath, trajectory: Trajectory) -> PerState:
        return terminal_hinge(values, trajectory.terminal_cost)


class RegionCondition(PointwiseCondition):
    """The mean of max(V̇ + share ℓ, 0) / (ℓ + ℓ₀) at points of {x ∈ D: V ≤ 1.15 ρ}, plus growth times

        mean over x ∈ D of σ(8 log(V(x)/ρ)),     ρ = (Σ V⁻³⁰)^(−1/30) over points of the boundary of D,

    a smooth measure of the share of D outside {V ≤ ρ}. The points are chosen as in PointwiseCondition.
    """

    program: RegionProgram

    def __call__(self, generator: torch.Generator, mean_cost: Tensor, largest_value: Tensor) -> Float[Tensor, ""]:
        """The condition at the points of one step; `largest_value` is not used."""
        x, leaving = self._leaving(generator)
        heights = torch.where(leaving, -MINIMUM_SHARPNESS * self._log_value(x), -torch.inf)
        level = -torch.logsumexp(heights, 0) / MINIMUM_SHARPNESS
        failing = self.condition(generator, self.floor * mean_cost.detach(), CEILING * level.detach().exp())
        inside = self.region.sample(2 * self.points, generator).to(mean_cost)
        return failing + self.program.growth * torch.sigmoid(STEP_SHARPNESS * (self._log_value(inside) - level)).mean()

    @torch.no_grad()
    def sampled_share(self, generator: torch.Generator) -> Float[Tensor, ""]:
        """The share of D in the largest {V ≤ ρ} on which V decreases, estimated from samples."""
        x, now = self.region.sample(VOLUME_SAMPLES, generator).to(self.goal), self.goal.new_zeros(())
        value = self.V(now, x)
        if self.program.steps:
            after = self._step(x)
            failing = (self.V(now, after) >= value) | self._outside(after)
        else:
            failing = self.rate(now, x, self.closed_loop.policy(now, x)) >= 0
        edge, leaving = self._leaving(generator)
        boundary = self.V(now, edge).where(leaving, torch.inf)
        level = torch.minimum(value.where(failing, torch.inf).min(), boundary.min())
        return (value < level).to(x).mean()

    def rate(self, t: Time, x: State, u: Control) -> PerState:
        """V̇; with steps (V(F(x, u)) − V(x))/Δt."""
        if not self.program.steps:
            return super().rate(t, x, u)
        return (self.V(t, self.problem.step(x, u)[0]) - self.V(t, x)) / self.problem.horizon.dt

    @torch.no_grad()
    def _leaving(self, generator: torch.Generator) -> tuple[State, Bool[Tensor, " points"]]:
        """Points over which ρ is the least V, and whether each counts: on the boundary of D all of them; with steps,
        points within a step of it, of which those count whose next state is outside D.
        """
        x = self._boundary(generator)
        if not self.program.steps:
            return x, torch.ones(len(x), dtype=torch.bool, device=x.device)
        back = torch.rand(len(x), 1, generator=generator, dtype=torch.float64).to(x)
        before = x + back * (x - self._step(x))
        before = torch.minimum(torch.maximum(before, self.region.lower.to(x)), self.region.upper.to(x))
        return before, self._outside(self._step(before))

    def _step(self, x: State) -> State:
        """F(x), the state one step later."""
        return self.problem.step(x, self.closed_loop.policy(x.new_zeros(()), x))[0]

    def _outside(self, x: State) -> Bool[Tensor, " points"]:
        """Whether states lie outside D, along the states on which V depends."""
        outside = (x < self.region.lower.to(x)) | (x > self.region.upper.to(x))
        return outside[..., self.axes].any(-1)

    def _log_value(self, x: State) -> PerState:
        return self.V(x.new_zeros(()), x).clamp_min(torch.finfo(x.dtype).tiny).log()

    def _boundary(self, generator: torch.Generator) -> State:
        """Random points on the boundary of D, the same number on each side along which V changes."""
        x = self.region.sample(BOUNDARY_POINTS, generator).to(self.goal)
        sides = [(i, side) for i in self.axes for side in (self.region.lower[i], self.region.upper[i])]
        for k, (i, side) in enumerate(sides):
            x[k :: len(sides), i] = side
        return x

    @property
    def axes(self) -> list[int]:
        """The states on which V depends; along the others D is unbounded."""
        return kept_states(self.V, self.region.dimension)
