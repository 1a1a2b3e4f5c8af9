"""A program's condition at points of [0, T] × D off the closed loops, as certificates require it."""

import torch
from jaxtyping import Float
from torch import Tensor

from lyapnet.base.linear_algebra import apply
from lyapnet.base.types import Control, PerState, State, Time
from lyapnet.loop.programs.base import Program
from lyapnet.loop.rollout import ClosedLoop, Rollout
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box
from lyapnet.value.calculus import ValueFunction, noise_derivative, time_derivative

FLOOR = 0.01  # ℓ₀ and φ₀ relative to the mean running cost and the mean cost: floor of the denominators
STATIONARY_FLOOR = 1e-4  # the same for a stationary V, which is exact at the goal by construction
NEAREST_SHARE = 1 / 300  # smallest factor by which points are moved towards the goal for a stationary V
CANDIDATES_PER_POINT = 4  # random candidates for each point that is used
CEILING = 1.2  # points with V above this multiple of the batch's largest V(0, x₀) are outside any noiseless funnel


class PointwiseCondition:
    """The condition of a program at points of [0, T] × D, relative to the running cost there:

        Lyapunov: mean of max(V̇ + (1 + margin) ℓ, 0) / (ℓ + ℓ₀)  +  mean of max(φ − V(T, ·), 0) / (φ + φ₀),
        value:    mean of ((V̇ + ℓ) / (ℓ + ℓ₀))²                  +  mean of ((φ − V(T, ·)) / (φ + φ₀))²,

    with V̇ = V_t + V_xᵀ(f + g u); under noise V̇ is the mean rate, with ½ tr(σσᵀV_xx) added, and with risk also
    (θ/2) |σᵀV_x|². ℓ₀ and φ₀ are a share (`floor`) of the batch's mean cost per second and of its mean cost;
    denominators are detached. Points whose V is too large for a funnel of X₀ do not count. The terms at T are omitted
    for a stationary V.

    The points of a step depend only on its random stream and the weights, so that a resumed run uses the same ones.
    Half of the points are random, the other half are the worst of four times as many. 30 % lie in the last tenth of the
    horizon, increasingly dense towards T, where V changes fastest. Independently, half of the points are moved towards
    the goal, by a uniform factor, or by a log-uniform factor for a stationary V.

    Args:
        rollout: closed loop of the law that V defines.
        program: the program with the condition.
        region: D.
        weight: weight of the term.
        points: number of points in each step.
        further: (k, 1 + n) points (t, x) that are added in every step, such as counterexamples.
        floor: share for ℓ₀ and φ₀; by default 1 %, or 10⁻⁴ for a stationary V. A certificate tolerates δ in addition to
            (1 − α) ℓ; with ℓ₀ ≈ δ/(1 − α) violations have the same weight as there.
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
        self.floor = (STATIONARY_FLOOR if self.stationary else FLOOR) if floor is None else floor

    @property
    def goal(self) -> State:
        """x* (n,), on the current device and in the current precision of the problem."""
        return self.problem.goal

    def __call__(self, generator: torch.Generator, mean_cost: Tensor, largest_value: Tensor) -> Float[Tensor, ""]:
        """The condition at the points of one step.

        Args:
            generator: the random stream of the step.
            mean_cost: J̄ of the closed loops of the step.
            largest_value: the largest V(0, x₀) among them.
        """
        return self.condition(generator, self.floor * mean_cost.detach(), CEILING * largest_value.detach())

    def condition(self, generator: torch.Generator, floor: Tensor, ceiling: Tensor) -> Float[Tensor, ""]:
        """The condition at the points of one step; points with V above a ceiling do not count."""
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
        """The candidates of a step, CANDIDATES_PER_POINT times as many as it uses."""
        goal = self.goal
        x = self.region.sample(CANDIDATES_PER_POINT * self.points, generator).to(goal)
        share, late, near = torch.rand(3, len(x), generator=generator, dtype=torch.float64).to(x.device)
        nearer = NEAREST_SHARE**near if self.stationary else near
        if self.stationary and self.problem.system.constants:  # those of the members
            goal = x - self.problem.cost.from_goal(x)
        x = goal + (x - goal) * torch.where(late < 0.5, 1.0, nearer)[:, None].to(x)
        before_end = torch.where(late < 0.3, 0.1 * share**2, share)
        return self.duration * (1 - before_end), x

    def _violation(self, t: Time, x: State, floor: Tensor, ceiling: Tensor) -> PerState:
        u = self.closed_loop.policy(t, x)
        running = self.closed_loop.cost.running(x, u)
        rate = self.rate(t, x, u)
        if self.closed_loop.noise is not None:
            rate = rate + noise_derivative(self.V, self.closed_loop.noise(x), t, x)
            if self.problem.risk:
                slope = apply(self.closed_loop.noise(x).mT, self.V.value_and_state_gradient(t, x)[1])
                rate = rate + self.problem.risk / 2 * slope.square().sum(-1)
        excess = self.program.excess(rate, running)
        return self._relative(excess, running + floor / self.duration) * (self.V(t, x) <= ceiling)

    def rate(self, t: Time, x: State, u: Control) -> PerState:
        """V̇ without noise."""
        return time_derivative(self.V, self.closed_loop.system, t, x, u)

    def _end_violation(self, x: State, floor: Tensor, ceiling: Tensor) -> PerState:
        value, cost = self.V(x.new_full(x.shape[:-1], self.duration), x), self.closed_loop.cost.terminal(x)
        return self._relative(cost - value, cost + floor) * (value <= ceiling)

    def _relative(self, excess: PerState, unit: PerState) -> PerState:
        return self.program.penalty(excess / unit.detach())
