"""The sound claim: a funnel that closed loops do not leave, and the cost that it guarantees."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lyapnet.certification.boxes import faces
from lyapnet.certification.branch_and_bound import Budget, just_above, just_below, minimum, share_below
from lyapnet.certification.condition import (
    DecreaseCondition,
    OwnOperations,
    bounded_condition,
    own_constraints,
    require_own_gradient,
)
from lyapnet.certification.counterexamples import Counterexample, find_counterexample
from lyapnet.certification.crossing import Violation, beginning_level, crossing_level, find_violation
from lyapnet.certification.ignorable_states import ignorable_states
from lyapnet.certification.proof import Progress, Proof, prove
from lyapnet.certification.verdict import Verdict
from lyapnet.constraints import names_of
from lyapnet.contracts import check_function, copied
from lyapnet.errors import Interrupted, UsageError, signals_taken
from lyapnet.graphs.bounds import BoundedFunction
from lyapnet.graphs.branches import JUMPS
from lyapnet.linear_algebra import apply
from lyapnet.problem import TRIED, Problem
from lyapnet.rollout.closed_loop import ClosedLoop
from lyapnet.sets import Box
from lyapnet.types import Corner, Corners, PerState, Points, State, Value

LEVELS = 60.0  # seconds for max V(0, ·) on X₀ and min W on the boundary of D, and at constraints, at the most …
LEAST, SHARE_OF_LEVELS = 1.0, 0.3  # … in seconds at the least, and of the budget
NOTHING = 1e-200  # bounds of zero have the least room for rounding
SHARE_OF_FINISH = 0.15  # of what is left, for the share of X₀ and κ
KEPT = "Stopped while certifying: the proof so far is kept in {}, and the same command goes on."
NOT_KEPT = "Stopped while certifying: nothing is kept without --keep FILE."


@dataclass(frozen=True)
class SoundClaim:
    """With W(t, x) = V(t, x) − δt: at every (t, x) in [0, T] × D with W ≤ ρ, in continuous time and for this model,

        V_t + V_xᵀ(f + g u) + α ℓ(x, u) ≤ δ,     that is Ẇ ≤ −αℓ,

    and W > ρ on the boundary of D. With constraints that is so where h(x) ≤ 0, and W > ρ wherever h_j(x) = 0 and
    ∇h_jᵀ(f + gu) ≥ 0, so that no closed loop with W ≤ ρ comes to violate one. Hence each closed loop that starts in D
    with h(x₀) ≤ 0 and V(0, x₀) ≤ ρ keeps h(x(t)) ≤ 0 and V(t, x(t)) ≤ ρ + δt, stays in D up to T, and has

        α ∫ℓ dt ≤ V(0, x₀) − V(T, x(T)) + δT,
        J(x₀) = ∫ℓ dt + φ(x(T)) ≤ (V(0, x₀) + δT)/α + κ,   κ = max of φ(x) − V(T, x)/α where W(T, x) ≤ ρ.

    States that neither f, g, ℓ, φ nor V and u depend on are left out: D is all of ℝ along them. There {W ≤ ρ} is a
    cylinder whose points are all alike, a closed loop can leave it through its side only, and what is proved on the
    slice at 0 holds on every slice. (Such a state does not escape: its derivative is bounded along with the others.)
    The parameters of a family stay what they are: along them D is their range, and no closed loop leaves it there.

    The verdict is about the funnel of ρ = `wanted`, which holds all of X₀. Whatever the verdict, `rho` is the largest
    level that was proved, a funnel of its own, and `volume_share` how much of X₀ it holds.
    """

    alpha: float
    delta: float  # in cost per second
    duration: float  # T in s
    states: Box  # D
    rho: float  # the largest level proved; −∞ where there is none
    wanted: float  # max V(0, ·) on X₀, or up to 0.1 % more: the ρ that does for all of it
    least: float  # the largest V(0, ·) that was seen on X₀: no lower ρ does
    volume_share: float  # of X₀ with V(0, ·) ≤ ρ; a lower bound
    terminal_excess: float  # κ; an upper bound
    counterexample: Counterexample | None
    boxes: int
    seconds: float
    remaining_volume: float  # share of [0, T] × D left undecided; all of it lies above the funnel
    undecided: Points  # centres (t, x) of boxes that remain
    left_out: list[int]  # ignorable states, on which nothing depends: D has no bounds for them, and is drawn at 0
    fingerprint: str = ""  # of (V̇ + αℓ − δ, W) as it was traced: the operations and numbers that the claim is about
    proof_seconds: float = 0.0  # those of the boxes alone
    constraints: Sequence[str] = ()  # what h(x) ≤ 0 asks for
    crossing: float = float("inf")  # a lower bound of W where a closed loop could come to violate one
    violation: Violation | None = None  # of a closed loop from X₀

    @property
    def verdict(self) -> Verdict:
        """On the claim that a funnel holds all of X₀, and that no closed loop from there violates a constraint."""
        if self.violation is not None:
            return "falsified"
        if self.rho >= self.wanted:
            return "certified"
        found = self.counterexample
        return "falsified" if found is not None and found.height <= self.least else "unknown"

    @property
    def reason(self) -> str | None:
        """Why the verdict is unknown, and what may help."""
        if self.verdict != "unknown":
            return None
        if self.remaining_volume > 0:
            return "seconds spent: allow more, or go on with a kept proof"
        if self.counterexample is not None:
            return "the condition fails close to what X₀ needs"
        if self.crossing <= self.wanted:
            return "closed loops of the funnel that X₀ needs may cross a constraint or begin beyond it, as time allowed"
        return "the funnel meets the boundary of D: choose a larger set"

    def guaranteed_cost(self, value: PerState) -> PerState:
        """The bound of J(x₀) from V(0, x₀), (*batch,); infinite outside the funnel."""
        bound = (value + self.delta * self.duration) / self.alpha + self.terminal_excess
        return torch.where(value <= self.rho, bound, torch.inf)


def sound_claim(
    closed_loop: ClosedLoop,
    problem: Problem,
    alpha: float = 0.95,
    delta: float = 1e-2,
    states: Box | None = None,
    budget: Budget | None = None,
    generator: torch.Generator | None = None,
    report: Callable[[Progress], None] | None = None,
    keep: Path | None = None,
    replay: bool = False,
) -> SoundClaim:
    """The largest funnel that can be proved within a budget; it is not sought beyond what X₀ needs.

    Args:
        closed_loop: with the law of a V; its float64 copy is what the claim is about.
        problem: whose X₀, T and goal are meant.
        states: D; by default a box around where samples of V are low enough.
        report, keep, replay: of prove.

    Raises:
        UsageError: α, δ or D do not fit; or the closed loop has an operator without a rule.
        Interrupted: Ctrl-C or SIGTERM; says what is kept.
    """
    started, budget, problem = time.monotonic(), budget or Budget(), copied(problem)
    condition = DecreaseCondition(copied(closed_loop).requires_grad_(False), alpha, delta, problem.constraints)
    duration, goal = problem.horizon.duration, problem.goal.double()
    _freeze(condition, _over_time(problem.initial_states, duration))
    left_out = ignorable_states(condition.closed_loop, problem.constraints)
    initial_states = _without(problem.initial_states, left_out)
    x_low, x_high = initial_states.lower, initial_states.upper
    _require_continuous(condition.V, x_low, x_high)
    levels = _for_levels(budget)
    wanted = -minimum(lambda t, x: -condition.V(t, x), *_at(0.0, x_low, x_high), levels)
    constants = condition.closed_loop.system.constants
    states = states or enclosing_box(condition.height, initial_states, goal, duration, wanted, constants)
    states = _without(states, left_out)
    domain = _domain(states, initial_states, duration, left_out, constants)
    require_own_gradient(condition.V, domain)
    _check_states(condition, domain)
    needed = just_above(wanted)
    axes = [1 + i for i in range(states.dimension) if i not in (*left_out, *constants)]
    rim = minimum(condition.height, *faces(*domain, axes), levels, enough=just_above(needed))
    begin = beginning_level(condition, _at(0.0, x_low, x_high), _for_levels(budget), just_above(needed))
    crossing = min(begin, crossing_level(condition, domain, _for_levels(budget), just_above(needed)))
    set_up = time.monotonic() - started
    level = min(needed, just_below(min(rim, crossing)))
    proof = _proof(condition, domain, level, budget, generator=generator, report=report, keep=keep, replay=replay)
    rho = wanted if proof.level >= needed else proof.level
    found = proof.counterexample
    if found is None and rim <= needed and budget.left:  # proved, and so searched, was less than what X₀ needs
        found = find_counterexample(condition, bounded_condition(condition, domain), *domain, needed, generator)
    names, violation = names_of(problem.constraints), find_violation(condition.closed_loop, problem, generator)
    share = 1.0 if rho >= wanted else _share(condition.V, x_low, x_high, rho, budget)
    excess = _terminal_excess(condition, states, duration, rho, budget)
    return SoundClaim(
        alpha, delta, duration, states, rho, wanted, _largest_seen(condition.V, initial_states), share, excess,
        found, proof.boxes, set_up + proof.seconds, proof.remaining_volume, proof.undecided, left_out,
        proof.fingerprint, proof.seconds, names, crossing, violation,
    )  # fmt: skip


def _for_levels(budget: Budget) -> Budget:
    """The share of a budget for levels."""
    return Budget(min(LEVELS, max(LEAST, SHARE_OF_LEVELS * budget.left)), chunk=budget.chunk)


def _proof(
    condition: DecreaseCondition, domain: tuple[Corner, Corner], level: float, budget: Budget, **options: Any
) -> Proof:
    """What is proved of the condition, in what a budget leaves but for a share of it, unless someone stops it."""
    search = replace(budget, seconds=(1 - SHARE_OF_FINISH) * budget.left, started=time.monotonic())
    with signals_taken(search.stop.ask):
        proof = prove(condition, domain, level, search, stop_at_counterexample=False, **options)
    if search.stop.asked:
        keep = options["keep"]
        raise Interrupted(KEPT.format(keep) if keep else NOT_KEPT, 130)
    return proof


def enclosing_box(
    W: Value, initial_states: Box, goal: State, duration: float, level: float, constants: Sequence[int] = ()
) -> Box:
    """A box around X₀ and around {W(t, ·) ≤ level}, as far as rays from the goal show it; a guess, checked afterwards.

    Along 400 rays at 9 times the first radius is sought at which W exceeds the level; twice, the second time in units
    of what the first gave. No ray is followed further than 30 times the largest component of X₀. Along the constants
    the box is X₀.
    """
    generator = torch.Generator().manual_seed(0)
    lower, upper = initial_states.lower.double(), initial_states.upper.double()
    constant = torch.tensor([i in constants for i in range(len(goal))])
    least, greatest = torch.where(constant, lower, -torch.inf), torch.where(constant, upper, torch.inf)
    inner = initial_states.reach_from(goal).double()
    largest = inner.max() if inner.max() > 0 else torch.ones(())
    reach = torch.full_like(inner, float(largest))
    times = torch.linspace(0, duration, 9, dtype=torch.float64)
    radii = torch.logspace(-2, 1.5, 71, dtype=torch.float64)
    for _ in range(2):
        rays = torch.randn(400, len(reach), generator=generator, dtype=torch.float64)
        rays = reach * rays / torch.linalg.vector_norm(rays, dim=-1, keepdim=True)
        points = (radii[:, None, None] * rays).clamp(-30 * largest, 30 * largest)
        points = (goal + points).clamp(least, greatest) - goal
        reach = torch.stack([_reach_below(W, t, goal, points, level) for t in times]).amax(0)
        reach = reach.clamp_min(1e-6 * float(largest))
    reach = 1.15 * torch.maximum(reach, inner)
    return Box(torch.where(constant, lower, goal - reach), torch.where(constant, upper, goal + reach))


def _reach_below(W: Value, t: Tensor, goal: State, points: Tensor, level: float) -> State:
    """How far rays of points (radii, rays, n) go from the goal, component by component, before W(t, ·) > level."""
    reach, below = torch.zeros_like(goal), torch.arange(points.shape[1])
    for some in points.split(8):
        if not len(below):
            break
        with torch.no_grad():
            above = W(t.expand(len(some), len(below)), goal + some[:, below]) > level
        still = above.cumsum(0) == 0
        reach = torch.maximum(reach, torch.where(still[..., None], some[:, below].abs(), 0.0).amax((0, 1)))
        below = below[still[-1]]
    return reach


def _largest_seen(V: Value, initial_states: Box) -> float:
    """The largest V(0, ·) among the corners of X₀ and 10 000 of its states."""
    states = torch.cat([initial_states.corners(), initial_states.sample(10_000, torch.Generator().manual_seed(0))])
    with torch.no_grad():
        return float(V(states.new_zeros(len(states)), states).max())


def _share(V: Value, x_low: State, x_high: State, rho: float, budget: Budget) -> float:
    """A lower bound of the share by volume of X₀ with V(0, ·) ≤ ρ."""
    if rho == -float("inf"):
        return 0.0
    lower, upper = _at(0.0, x_low, x_high)
    return share_below(V, lower[0], upper[0], rho, Budget(budget.left, chunk=budget.chunk))


def _terminal_excess(condition: DecreaseCondition, states: Box, duration: float, rho: float, budget: Budget) -> float:
    """An upper bound of κ = max φ(x) − V(T, x)/α over x ∈ D with W(T, x) ≤ ρ; infinite where there is no ρ."""
    if rho == -float("inf"):
        return float("inf")
    budget = Budget(budget.left, chunk=budget.chunk)
    V, cost, alpha = condition.V, condition.closed_loop.cost, condition.alpha
    end = _at(duration, states.lower.double(), states.upper.double())
    return -minimum(lambda t, x: V(t, x) / alpha - cost.terminal(x), *end, budget, condition.height, rho, unit=abs(rho))


def _freeze(condition: DecreaseCondition, sample: tuple[Corner, Corner]) -> None:
    """Trace V and h once, for every question that is asked of them, after a look at what they are."""
    own = OwnOperations(condition.V, sample)
    if condition.constraints is not None:
        condition.constraints = own_constraints(condition.constraints, sample)
    _check_states(condition, sample)
    condition.V = own


def _check_states(condition: DecreaseCondition, domain: tuple[Corner, Corner]) -> None:
    """Refuse a condition of which the graph at one point says nothing about batches: closed loops are run in these."""
    lower, upper = domain
    _require_constant(condition.closed_loop, domain)
    share = torch.rand(TRIED, len(lower), generator=torch.Generator().manual_seed(0), dtype=lower.dtype)
    points = lower + (upper - lower) * share

    def all_three(t: Tensor, x: Tensor) -> Tensor:
        return torch.stack([condition(t, x), condition.height(t, x), condition.closed_loop.cost.terminal(x)], -1)

    t, x = points[:, 0], points[:, 1:]
    check_function("the condition, V and φ", all_three, [t, x], (3,), differentiable=False)
    if condition.constraints is not None:
        k = len(condition.constraints.names)
        check_function("h(x) with a number for each name", condition.constraints, [x], (k,), differentiable=False)
    with torch.no_grad():
        own = torch.stack([condition.V(*point) for point in zip(t, x, strict=True)])
        if not _close(own, condition.V(t, x)):
            raise UsageError(
                "Expected V to be one function of (t, x), got another one than at first; read nothing else."
            )
        _check_parts(condition.closed_loop, t, x)


def _check_parts(loop: ClosedLoop, t: Tensor, x: Tensor) -> None:
    """Refuse a closed loop that runs as another one than its parts say, and a cost below 0, at some states."""
    system, u = loop.system, loop.policy(t, x)
    parts = torch.cat([system.f(x) + apply(system.g(x), u), loop.cost.running(x, u)[..., None]], -1)
    if not _close(loop.slope(x, u), parts) or not _close(loop.control(t, x).u, u):
        raise UsageError(
            f"Expected a closed loop that runs by ẋ = f(x) + g(x)u, ℓ and u = policy(t, x), got another one; make "
            f"{type(system).__name__}.dynamics, {type(loop.policy).__name__}.with_value and "
            f"{type(loop).__name__}.slope agree with these each time."
        )
    cost = parts[..., -1]
    least = int(cost.argmin())
    if cost[least] < -1e-9 * cost.abs().max():
        raise UsageError(
            f"Expected ℓ(x, u) ≥ 0, got {float(cost[least]):.6g} at x = {x[least].tolist()}; V need not fall there: "
            "correct the cost, or choose a smaller set."
        )


def _close(one: Tensor, other: Tensor) -> bool:
    return one.shape == other.shape and torch.allclose(one, other, rtol=1e-6, atol=1e-6 * float(other.abs().max()))


def _require_continuous(V: Value, x_low: State, x_high: State) -> None:
    """Refuse a V that may jump: its gradient would not tell, and W could rise along closed loops where c ≤ 0."""
    lower, upper = _at(0.0, x_low, x_high)
    jumps = BoundedFunction(lambda t, x: (V(t, x),), (lower[0], upper[0])).operators & JUMPS.keys()
    if jumps:
        raise UsageError(
            f"Expected a continuous V, got {' and '.join(sorted(map(str, jumps)))}, which may jump; write it with "
            "relu, abs, maximum, minimum or clamp."
        )


def _at(t: float, lower: State, upper: State) -> tuple[Corners, Corners]:
    """The box {t} × [lower, upper] as one of (t, x)."""
    time = torch.tensor([t], dtype=lower.dtype)
    return torch.cat([time, lower])[None], torch.cat([time, upper])[None]


def _without(states: Box, left_out: Sequence[int]) -> Box:
    """The slice of a box at 0 of the states that are left out, in float64."""
    lower, upper = states.lower.double(), states.upper.double()
    seen = torch.tensor([i not in left_out for i in range(states.dimension)])
    return Box(torch.where(seen, lower, 0.0), torch.where(seen, upper, 0.0))


def _require_constant(loop: ClosedLoop, domain: tuple[Corner, Corner]) -> None:
    """Refuse constants that move: D has no faces along them."""
    constants = list(loop.system.constants)
    if constants:
        moved = BoundedFunction(lambda t, x: (loop.system.dynamics(x, loop.policy(t, x))[constants],), domain)
        ((low, high),) = moved.bounds(*(end[None] for end in domain))
        if not bool(torch.maximum(-low, high).max() <= NOTHING):
            raise UsageError("Expected ẋ = 0 for the constants of a system, got others; leave them out.")


def _domain(
    states: Box, initial_states: Box, duration: float, left_out: Sequence[int], constants: Sequence[int]
) -> tuple[Corner, Corner]:
    """[0, T] × D as (lower, upper), or a UsageError that says what is wrong with D."""
    if states.dimension != initial_states.dimension:
        raise UsageError(
            f"Expected a set of {initial_states.dimension} states, got {states.dimension}; give bounds for each state."
        )
    outside = (states.lower >= initial_states.lower) | (states.upper <= initial_states.upper)
    for i in constants:
        outside[i] = states.lower[i] > initial_states.lower[i] or states.upper[i] < initial_states.upper[i]
    outside[left_out] = False
    if outside.any():
        i = int(torch.nonzero(outside)[0])
        raise UsageError(
            f"Expected a set around X₀, got [{states.lower[i]:g}, {states.upper[i]:g}] around "
            f"[{initial_states.lower[i]:g}, {initial_states.upper[i]:g}] at index {i}; choose a larger one."
        )
    return _over_time(states, duration)


def _over_time(states: Box, duration: float) -> tuple[Corner, Corner]:
    """[0, T] × a box as (lower, upper)."""
    time = torch.tensor([0.0, duration], dtype=torch.float64)
    return torch.cat([time[:1], states.lower.double()]), torch.cat([time[1:], states.upper.double()])
