"""A program's condition off the closed loops: at points of [0, T] × D, as a certificate asks for it."""

import torch
from jaxtyping import Float
from torch import Tensor

from lyapnet.base.types import PerState, State, Time
from lyapnet.loop.programs.base import Program
from lyapnet.loop.rollout import ClosedLoop, Rollout
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box
from lyapnet.value.calculus import ValueFunction, time_derivative

FLOOR = 0.01  # of the mean running cost (and of the mean cost, at T): violations below it count as absolute ones
LEAST = 1e-4  # the same of a stationary V, which is right at the goal by construction
NEAREST = 1 / 300  # of the distance from the goal, to which points are drawn towards it where V is stationary
SURPLUS = 4  # candidates drawn for each point that is used
CEILING = 1.2  # times the largest V(0, x₀) of the batch: a funnel of X₀ has no points above


class PointwiseCondition:
    """The condition of a program at points of [0, T] × D, relative to the running cost there:

        Lyapunov: mean of max(V̇ + (1 + margin) ℓ, 0) / (ℓ + ℓ₀)  +  mean of max(φ − V(T, ·), 0) / (φ + φ₀),
        value:    mean of ((V̇ + ℓ) / (ℓ + ℓ₀))²                  +  mean of ((φ − V(T, ·)) / (φ + φ₀))²,

    with V̇ = V_t + V_xᵀ(f + g u), ℓ₀ and φ₀ a share (`floor`) of the batch's mean cost per second and of its mean cost
    (denominators are detached). Points with V above what a funnel of X₀ can hold do not count. Of a stationary V
    there is no end.

    The points of a step are a function of its random stream and of the weights, so that a resumed run sees the same:
    half of them are drawn, half are the worst of four times as many. Three in ten lie in the last tenth of the horizon,
    ever denser towards T, where V moves fastest; another half is drawn towards the goal, by a factor that is uniform,
    or where V is stationary by one whose logarithm is.

    Args:
        rollout: of the law that V defines.
        program: whose condition it is.
        region: D.
        weight: of the term.
        points: drawn and sought in each step.
        further: (k, 1 + n) points (t, x) that join those of every step: counterexamples.
        floor: of ℓ₀ and φ₀; 1 %, or 10⁻⁴ of a stationary V. A certificate allows δ beside (1 − α) ℓ: with
            ℓ₀ ≈ δ/(1 − α) violations weigh as much as they do there.
    """

    closed_loop: ClosedLoop
    V: ValueFunction
    problem: Problem
    program: Program
    region: Box
    duration: float
    stationary: bool
    weight: float
    points: int
    further: Float[Tensor, "k columns"] | None
    floor: float

    def __init__(
        self,
        rollout: Rollout,
        program: Program,
        region: Box,
        weight: float = 1.0,
        points: int = 512,
        further: Float[Tensor, "k columns"] | None = None,
        floor: float | None = None,
    ):
        V = rollout.closed_loop.V
        if V is None:
            raise ValueError("Expected a control law that a V defines, got another one; use a ValuePolicy.")
        self.closed_loop, self.V, self.problem = rollout.closed_loop, V, rollout.problem
        self.duration, self.stationary = rollout.problem.horizon.duration, rollout.problem.horizon.stationary
        self.program, self.region = program, region
        self.weight, self.points, self.further = weight, points, further
        self.floor = (LEAST if self.stationary else FLOOR) if floor is None else floor

    @property
    def goal(self) -> State:
        """x* (n,), on the device and in the precision that the problem has by now."""
        return self.problem.goal

    def __call__(self, generator: torch.Generator, mean_cost: Tensor, largest_value: Tensor) -> Float[Tensor, ""]:
        """The condition at the points of one step.

        Args:
            generator: the step's stream.
            mean_cost: J̄ of the closed loops of the step.
            largest_value: the largest V(0, x₀) among them.
        """
        return self.condition(generator, self.floor * mean_cost.detach(), CEILING * largest_value.detach())

    def condition(self, generator: torch.Generator, floor: Tensor, ceiling: Tensor) -> Float[Tensor, ""]:
        """The condition at the points of one step, of which those with V above a ceiling do not count."""
        t, x = (y.to(floor) for y in self.draw(generator))
        with torch.no_grad():
            worst = self._violation(t, x, floor, ceiling).topk(self.points // 2).indices
        t, x = (torch.cat([y[worst], y[: self.points - len(worst)]]) for y in (t, x))
        if self.further is not None:
            further = self.further.to(floor)
            t, x = torch.cat([t, further[:, 0]]), torch.cat([x, further[:, 1:]])
        violation = self._violation(t, x, floor, ceiling).mean()
        return violation if self.stationary else violation + self._end_violation(x, floor, ceiling).mean()

    def draw(self, generator: torch.Generator) -> tuple[Time, State]:
        """The points of a step before the worst are chosen: SURPLUS times as many as it uses."""
        goal = self.goal
        x = self.region.sample(SURPLUS * self.points, generator).to(goal)
        share, late, near = torch.rand(3, len(x), generator=generator, dtype=torch.float64).to(x.device)
        nearer = NEAREST**near if self.stationary else near
        x = goal + (x - goal) * torch.where(late < 0.5, 1.0, nearer)[:, None].to(x)
        before_end = torch.where(late < 0.3, 0.1 * share**2, share)
        return self.duration * (1 - before_end), x

    def _violation(self, t: Time, x: State, floor: Tensor, ceiling: Tensor) -> PerState:
        u = self.closed_loop.policy(t, x)
        running = self.closed_loop.cost.running(x, u)
        excess = self.program.excess(time_derivative(self.V, self.closed_loop.system, t, x, u), running)
        return self._relative(excess, running + floor / self.duration) * (self.V(t, x) <= ceiling)

    def _end_violation(self, x: State, floor: Tensor, ceiling: Tensor) -> PerState:
        value, cost = self.V(x.new_full(x.shape[:-1], self.duration), x), self.closed_loop.cost.terminal(x)
        return self._relative(cost - value, cost + floor) * (value <= ceiling)

    def _relative(self, excess: PerState, unit: PerState) -> PerState:
        return self.program.penalty(excess / unit.detach())
