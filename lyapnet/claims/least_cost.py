"""A lower bound of the optimal cost, proved by a V with V̇ ≥ −ℓ under every control."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from lyapnet.base.contracts import copied
from lyapnet.base.errors import UsageError
from lyapnet.base.linear_algebra import apply, solve
from lyapnet.base.types import Control, Corner, PerState, Points, State, Time, Value
from lyapnet.claims.funnel import budget_for_level, find_setting, largest_sample, prove_in_time
from lyapnet.claims.ignorable_states import ignorable_states
from lyapnet.claims.preconditions import at_time, domain_around, require_goal, require_still, slice_at_zero
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.prover.branch_and_bound import Budget, just_above, minimum
from lyapnet.prover.condition import DecreaseCondition
from lyapnet.prover.counterexamples import Counterexample
from lyapnet.prover.proof import Progress
from lyapnet.prover.verdict import Verdict, verdict_on
from lyapnet.task.cost import Cost, is_quadratic_about_target
from lyapnet.task.cost.base import quadratic_form
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box, ControlSet, about_control
from lyapnet.value.calculus import drift_lie_derivative, gradients, input_lie_derivative

EXCESS_TOLERANCE = 5e-5  # largest error of the bound of e, relative to the level
DEGREE = 3  # of the Taylor forms: in V_t plus the Hamiltonian, terms up to third order cancel, such as t·x²


@dataclass(frozen=True, kw_only=True)
class ProvedLowerBound:
    """With W(t, x) = β V(t, x) − δ(T − t) and 0 < β ≤ 1, at every (t, x) in [0, T] × D with W ≤ c, in continuous time,

        β V_t + min over u ∈ U of [ℓ(x, u) + β V_xᵀ(f + g u)] ≥ −δ,

    and min(W, c) ≤ φ + e' at T on D. Under any control, m = min(W, c) then falls along a trajectory in D by at most
    ∫ℓ + e'': where W < c by the condition, and where W ≥ c because m is constant there and ℓ ≥ −e''/T (q is bounded
    from below and R is positive definite on D). Hence, with e = e' + e'',

        J(x₀) = ∫ℓ dt + φ(x(T)) ≥ min(β V(0, x₀) − δT, c) − e

    for every control that keeps the state in D. If also W > c on the boundary of D and φ ≥ c outside of D, then m can
    be set to c outside of D, where ℓ ≥ 0, and the bound holds for every control (`everywhere`). This is checked if q
    and φ are quadratic forms about a target in D, because φ then increases along each ray from it.

    State constraints can only increase the optimum. Along ignorable states D is all of ℝ. The parameters of a family
    are constant.

    Source: the verification theorem of Bellman's equation for subsolutions, e.g. Bardi, Capuzzo-Dolcetta, Optimal
    Control and Viscosity Solutions of Hamilton-Jacobi-Bellman Equations, 1997, § III.3.
    """

    beta: float
    delta: float  # in cost per second
    duration: float  # T in s
    states: Box  # D
    level: float  # c: the largest proved level, at most `wanted`; −∞ if none is proved
    wanted: float  # an upper bound of max W(0, ·) on X₀, at most 0.1 % above it: the c for all of X₀
    least: float  # the largest W(0, ·) among samples of X₀: a lower bound of this c
    excess: float  # an upper bound of e ≥ 0
    everywhere: bool  # whether the bound holds for every control, not only for those that keep the state in D
    counterexample: Counterexample | None
    boxes: int
    seconds: float
    remaining_volume: float  # undecided share of [0, T] × D; all of it lies above c
    undecided: Points
    left_out: list[int]
    fingerprint: str
    proof_seconds: float = 0.0  # for the boxes, without set-up and levels
    set_up: float = 0.0  # seconds of the budget before the first box

    @property
    def verdict(self) -> Verdict:
        """The verdict on the claim that c ≥ W(0, ·) on X₀ and e < c."""
        found = self.counterexample
        verdict = verdict_on(self.level, self.wanted, None if found is None else found.height, self.least)
        return "unknown" if verdict == "certified" and not self.excess < self.wanted < float("inf") else verdict

    def least_cost(self, value: PerState) -> PerState:
        """The lower bound of the optimum as a function of V(0, x₀), (*batch,); −∞ if nothing is proved."""
        return (self.beta * value - self.delta * self.duration).clamp(max=self.level) - self.excess


class RiseCondition(DecreaseCondition):
    """c(t, x) = −(β V_t + min over u ∈ U of [ℓ(x, u) + β V_xᵀ(f + g u)]) − δ; where c ≤ 0, Ẇ ≥ −ℓ under any control.

    The third part is minus the least pivot of R(x), so that the proof also shows that R is positive definite, without
    which there is no minimum.
    """

    proves = "below"

    def __init__(self, closed_loop: ClosedLoop, beta: float, delta: float, problem: Problem):
        super().__init__(closed_loop, beta, delta)
        cost, limits = closed_loop.cost, problem.controls.limits
        if cost.has_methods_of_its_own:
            raise UsageError(
                f"Expected ℓ = q + (u − u*)ᵀR(u − u*), got {type(cost).__name__} with its own `running` or `control`; "
                "leave these methods as they are, and put terms in x into `state`."
            )
        if cost.nonquadratic is not None or not problem.controls.is_box:
            raise UsageError(
                "Expected controls that cost uᵀRu, without limits or between them, for a bound from below, got another "
                "cost or set; measure the cost beside the optimum instead."
            )
        if limits is None or (problem.controls.limited and not all(bool(side.isfinite().all()) for side in limits)):
            raise UsageError(
                "Expected controls without limits, or with two finite limits each, for a bound from below, got "
                f"{type(problem.controls).__name__}{'' if limits is None else ' with ∓∞'}; give both limits."
            )
        self.duration, self.controls = problem.horizon.duration, problem.controls

    def parts(self, t: Time, x: State) -> tuple[PerState, PerState, PerState]:
        loop, (V_t, V_x) = self.closed_loop, gradients(self.V, t, x)
        rise = self.alpha * (V_t + drift_lie_derivative(loop.system, x, V_x)) + loop.cost.state(x)
        b = self.alpha * input_lie_derivative(loop.system, x, V_x)
        R = symmetric(loop.cost.R(x))
        least = least_over_controls(R, b, loop.cost.rest_at(x), self.controls)
        return -(rise + least) - self.delta, self.height(t, x), -least_pivot(R)

    def height(self, t: Time, x: State) -> PerState:
        """W(t, x) = β V(t, x) − δ(T − t)."""
        return self.alpha * self.V(t, x) - self.delta * (self.duration - t)


def least_over_controls(R: Tensor, b: Control, rest: Tensor | None, controls: ControlSet) -> PerState:
    """A lower bound of min over u ∈ U of h(u) = (u − u*)ᵀR(u − u*) + bᵀu for symmetric positive definite R.

    Without limits it is the minimum bᵀu* − ¼ bᵀR⁻¹b. With limits, h lies above its tangent at any û, here that of the
    control law:

        h(u) ≥ h(û) + Σ_i min over lower_i ≤ u_i ≤ upper_i of h_i (u_i − û_i),   h_i = (2R(û − u*) + b)_i,

    which is the minimum if û is the minimiser, and a lower bound for any û.
    """
    u0 = b.new_zeros(()) if rest is None else rest.to(b)
    if not controls.limited:
        return (b * u0).sum(-1) - (b * solve(R, b[..., None])[..., 0]).sum(-1) / 4
    assert controls.limits is not None
    lower, upper = controls.limits
    u = controls.minimise(R, about_control(R, b, u0.expand(b.shape)))
    slope = 2 * apply(R, u - u0) + b
    beyond = torch.minimum(slope * (lower - u), slope * (upper - u)).sum(-1)
    return quadratic_form(R, u - u0) + (b * u).sum(-1) + beyond


def symmetric(R: Tensor) -> Tensor:
    """The symmetric part of R, which determines uᵀRu."""
    return (R + R.mT) / 2


def least_pivot(R: Tensor) -> PerState:
    """The least pivot of symmetric R, (*batch, m, m), in Gaussian elimination; R is positive definite if it is > 0."""
    least = R[..., 0, 0]
    for _ in range(R.shape[-1] - 1):
        R = R[..., 1:, 1:] - R[..., 1:, :1] * R[..., :1, 1:] / R[..., :1, :1]
        least = torch.minimum(least, R[..., 0, 0])
    return least


def prove_lower_bound(
    closed_loop: ClosedLoop,
    problem: Problem,
    beta: float = 0.95,
    delta: float = 1e-2,
    states: Box | None = None,
    budget: Budget | None = None,
    generator: torch.Generator | None = None,
    report: Callable[[Progress], None] | None = None,
    keep: Path | None = None,
    replay: bool = False,
) -> ProvedLowerBound:
    """Prove a lower bound of the optimal cost by V, for as much of X₀ as the budget allows.

    Args:
        closed_loop: gives V, the system and the cost; its control law is not used.
        problem: gives X₀, U, T and the goal.
        states: D; by default a box around {W ≤ max W(0, ·) on X₀}, estimated from samples.
        report, keep, replay: as in prove.

    Raises:
        UsageError: β, δ or D are unsuitable, ℓ is not quadratic in u, or V, f, g, q or R have an operator without a
            bound.
        Interrupted: Ctrl-C or SIGTERM.
    """
    require_goal(problem, "two-sided")
    started, budget, problem = time.monotonic(), budget or Budget(), copied(problem)
    condition = RiseCondition(copied(closed_loop).requires_grad_(False), beta, delta, problem)
    cost, duration = condition.closed_loop.cost, condition.duration
    left_out, X0, wanted, D, domain, sides, *_ = find_setting(condition, problem, duration, states, budget, report)
    _require_still(condition, domain)
    needed = just_above(wanted)
    excess = _excess(condition, D, needed, budget)
    everywhere, levels = False, budget_for_level(budget)
    if rises_along_rays(cost, problem.goal.double(), D, left_out):
        outside = minimum(lambda t, x: cost.terminal(x), *sides, levels, enough=just_above(needed))
        rim = minimum(condition.height, *sides, levels, enough=just_above(needed))
        everywhere = min(outside, rim) >= needed
    set_up = budget.elapsed
    proof = prove_in_time(
        condition, domain, needed, budget,
        generator=generator, report=report, keep=keep, replay=replay, degree=DEGREE,
    )  # fmt: skip
    level = wanted if proof.level >= needed else proof.level
    seen = beta * largest_sample(condition.V, X0) - delta * duration
    return ProvedLowerBound(
        beta=beta, delta=delta, duration=duration, states=D, level=level, wanted=wanted, least=seen, excess=excess,
        everywhere=everywhere, counterexample=proof.counterexample, boxes=proof.boxes,
        seconds=time.monotonic() - started, remaining_volume=proof.remaining_volume, undecided=proof.undecided,
        left_out=left_out, fingerprint=proof.fingerprint, proof_seconds=proof.seconds, set_up=set_up,
    )  # fmt: skip


def require_bound_from_below(closed_loop: ClosedLoop, problem: Problem, beta: float, states: Box | None) -> None:
    """Refuse a cost, limits or a set D that prove_lower_bound refuses."""
    condition = RiseCondition(copied(closed_loop).requires_grad_(False), beta, 0.0, copied(problem))
    if states is not None:
        left_out = ignorable_states(condition.closed_loop, problem.constraints)
        X0, constants = slice_at_zero(problem.initial_states, left_out), condition.closed_loop.system.constants
        domain_around(slice_at_zero(states, left_out), X0, condition.duration, left_out, list(constants))


def _excess(condition: RiseCondition, states: Box, level: float, budget: Budget) -> float:
    """An upper bound of e; ∞ if R is not proved to be positive definite on D.

    If q is a quadratic form about a target, q ≥ 0 and e'' = 0.
    """
    cost, T, beta = condition.closed_loop.cost, condition.duration, condition.alpha
    end, unit = at_time(T, states.lower, states.upper), max(abs(level), 1e-12)

    def least(function: Value) -> float:
        return minimum(function, *end, budget_for_level(budget), unit=unit, tolerance=EXCESS_TOLERANCE, enough=0.0)

    excess = -least(lambda t, x: cost.terminal(x) - (beta * condition.V(t, x)).clamp(max=level))
    below = 0.0 if is_quadratic_about_target(cost) else -least(lambda t, x: T * cost.state(x))
    definite = minimum(lambda t, x: least_pivot(symmetric(cost.R(x))), *end, budget_for_level(budget), enough=0.0) >= 0
    return max(0.0, excess) + max(0.0, below) if definite else float("inf")


def _require_still(condition: RiseCondition, domain: tuple[Corner, Corner]) -> None:
    """Refuse constants that some control changes."""
    system = condition.closed_loop.system
    constants = list(system.constants)
    if constants:
        require_still(lambda t, x: (system.f(x)[constants], system.g(x)[constants]), domain, " under any control")


def rises_along_rays(cost: Cost, goal: State, states: Box, left_out: list[int]) -> bool:
    """Whether φ is a quadratic form about a target in D, so that it increases along each ray from there."""
    inside = ((states.lower < goal) & (goal < states.upper)).index_fill(
        0, torch.tensor(left_out, dtype=torch.long), True
    )
    return is_quadratic_about_target(cost) and bool(inside.all())
