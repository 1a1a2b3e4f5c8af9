"""The sound claim: a funnel that closed loops do not leave, and the cost that it guarantees."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lyapnet.base.contracts import copied
from lyapnet.base.errors import Interrupted, UsageError, signals_taken
from lyapnet.base.types import Corner, Corners, PerState, Points, State, Value
from lyapnet.claims.control_sets import check_controls
from lyapnet.claims.crossing import Violation, beginning_level, crossing_level, find_violation
from lyapnet.claims.ignorable_states import ignorable_states
from lyapnet.claims.preconditions import (
    at_time,
    check_states,
    domain_around,
    freeze,
    over_time,
    require_continuous,
    without,
)
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.prover.boxes import faces
from lyapnet.prover.branch_and_bound import Budget, just_above, just_below, minimum, share_below
from lyapnet.prover.condition import (
    DecreaseCondition,
    bounded_condition,
    require_own_gradient,
)
from lyapnet.prover.counterexamples import Counterexample, find_counterexample
from lyapnet.prover.proof import Progress, Proof, prove, tell
from lyapnet.prover.verdict import Verdict, time_spent, verdict_on
from lyapnet.task.constraints import names_of
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box

LEVELS = 60.0  # seconds for max V(0, ·) on X₀ and min W on the boundary of D, and at constraints, at the most …
LEAST, SHARE_OF_LEVELS = 1.0, 0.3  # … in seconds at the least, and of the budget
SHARE_OF_FINISH = 0.15  # of what is left, for the share of X₀ and κ
KEPT = "Stopped while certifying: the proof so far is kept in {}, and the same command goes on."
NOT_KEPT = "Stopped while certifying: nothing is kept without --keep FILE."


@dataclass(frozen=True, kw_only=True)
class ProvedFunnel:
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
    disturbance: State | None = None  # w: it is so for ẋ = f + gu + w(t), |w_i(t)| ≤ w_i, then with Ẇ at its worst
    set_up: float = 0.0  # seconds of the budget before the first box
    assumed: str = ""  # of u, beside what is proved

    @property
    def verdict(self) -> Verdict:
        """On the claim that a funnel holds all of X₀, and that no closed loop from there violates a constraint."""
        if self.violation is not None:
            return "falsified"
        found = self.counterexample
        return verdict_on(self.rho, self.wanted, None if found is None else found.height, self.least)

    @property
    def reason(self) -> str | None:
        """Why the verdict is unknown, and what may help."""
        if self.verdict != "unknown":
            return None
        if self.remaining_volume > 0:
            return f"{time_spent(self.set_up)}: allow more, or go on with a kept proof"
        if self.counterexample is not None:
            return "the condition fails close to what X₀ needs"
        if self.crossing <= self.wanted:
            return "closed loops of the funnel that X₀ needs may cross a constraint or begin beyond it, as time allowed"
        return "the funnel meets the boundary of D: choose a larger set"

    def guaranteed_cost(self, value: PerState) -> PerState:
        """The bound of J(x₀) from V(0, x₀), (*batch,); infinite outside the funnel."""
        bound = (value + self.delta * self.duration) / self.alpha + self.terminal_excess
        return torch.where(value <= self.rho, bound, torch.inf)


def prove_funnel(
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
    degree: int = 2,
    disturbance: State | None = None,
) -> ProvedFunnel:
    """The largest funnel that can be proved within a budget; it is not sought beyond what X₀ needs.

    Args:
        closed_loop: with the law of a V; its float64 copy is what the claim is about.
        problem: whose X₀, T and goal are meant.
        states: D; by default a box around where samples of V are low enough.
        report, keep, replay, degree: of prove.
        disturbance: w, (n,): the claim is about every closed loop ẋ = f + gu + w(t) with |w_i(t)| ≤ w_i.

    Raises:
        UsageError: α, δ or D do not fit; or the closed loop has an operator without a rule.
        Interrupted: Ctrl-C or SIGTERM; says what is kept.
    """
    started, budget, problem = time.monotonic(), budget or Budget(), copied(problem)
    if disturbance is not None:
        _require_pushed(disturbance, problem)
    condition = DecreaseCondition(
        copied(closed_loop).requires_grad_(False), alpha, delta, problem.constraints, disturbance
    )
    duration = problem.horizon.duration
    left_out, initial_states, wanted, D, domain, sides, levels, assumed = setting_of(
        condition, problem, duration, states, budget, report
    )
    x_low, x_high = initial_states.lower, initial_states.upper
    needed = just_above(wanted)
    rim = minimum(condition.height, *sides, levels, enough=just_above(needed))
    begin = beginning_level(condition, at_time(0.0, x_low, x_high), for_levels(budget), just_above(needed))
    crossing = min(begin, crossing_level(condition, domain, for_levels(budget), just_above(needed)))
    set_up, spent = time.monotonic() - started, budget.elapsed
    level = min(needed, just_below(min(rim, crossing)))
    proof = proof_within(
        condition, domain, level, budget,
        generator=generator, report=report, keep=keep, replay=replay, degree=degree,
    )  # fmt: skip
    rho = wanted if proof.level >= needed else proof.level
    found = proof.counterexample
    if found is None and rim <= needed and budget.left:  # proved, and so searched, was less than what X₀ needs
        found = find_counterexample(condition, bounded_condition(condition, domain), *domain, needed, generator)
    names, violation = names_of(problem.constraints), find_violation(condition.closed_loop, problem, generator)
    share = 1.0 if rho >= wanted else share_of(condition.V, x_low, x_high, rho, budget)
    excess = _terminal_excess(condition, D, duration, rho, budget)
    return ProvedFunnel(
        alpha=alpha, delta=delta, duration=duration, states=D, rho=rho, wanted=wanted,
        least=largest_seen(condition.V, initial_states), volume_share=share, terminal_excess=excess,
        counterexample=found, boxes=proof.boxes, seconds=set_up + proof.seconds,
        remaining_volume=proof.remaining_volume, undecided=proof.undecided, left_out=left_out,
        fingerprint=proof.fingerprint, proof_seconds=proof.seconds, constraints=names, crossing=crossing,
        violation=violation, disturbance=disturbance, set_up=spent, assumed=assumed,
    )  # fmt: skip


def require_disturbance(w: State, n: int) -> None:
    """Refuse what is no largest push on each of n states."""
    if w.shape != (n,) or not bool(((w >= 0) & w.isfinite()).all()):
        raise UsageError(
            f"Expected disturbances ≥ 0 of {n} states, got {w.tolist()}; give the largest |w| in units of ẋ."
        )


def _require_pushed(w: State, problem: Problem) -> None:
    """Refuse a disturbance that is none, or that nothing is proved about."""
    require_disturbance(w, problem.system.n)
    if problem.constraints is not None:
        raise UsageError("Expected no state constraints beside disturbances, got some; their crossing is not bounded.")
    moved = [problem.system.state_names[i] for i in problem.system.constants if w[i] > 0]
    if moved:
        raise UsageError(f"Expected parameters of a family that stay what they are, got pushes on {', '.join(moved)}.")


class Setting(NamedTuple):
    """Where a claim is about, without the states that nothing depends on."""

    left_out: list[int]
    initial_states: Box  # X₀
    wanted: float  # max W(0, ·) on X₀, or up to 0.1 % more
    states: Box  # D
    domain: tuple[Corner, Corner]  # [0, T] × D
    sides: tuple[Corners, Corners]  # [0, T] × the boundary of D
    levels: Budget  # what is left of the one for levels
    assumed: str  # of u, beside what is proved


def setting_of(
    condition: DecreaseCondition,
    problem: Problem,
    duration: float,
    states: Box | None,
    budget: Budget,
    report: Callable[[Progress], None] | None = None,
) -> Setting:
    """The setting of a claim about a condition, whose V and h are traced for it, once.

    Args:
        duration: T, or 0 for what holds at t = 0 alone.
        states: D; by default a box around where samples of W are low enough.
        budget: of the claim; a share of it is for levels.
        report: is told what is done.

    Raises:
        UsageError: D does not fit; or the condition is none that bounds can speak of.
    """
    tell(report, budget, "calling and tracing f, g, the cost, V and u")
    memory = freeze(condition, over_time(problem.initial_states, duration))
    constants, goal = condition.closed_loop.system.constants, problem.goal.double()
    left_out = ignorable_states(condition.closed_loop, problem.constraints)
    X0 = without(problem.initial_states, left_out)
    require_continuous(condition.V, X0.lower, X0.upper)
    levels = for_levels(budget)
    tell(report, budget, "the largest V on X₀")
    wanted = -minimum(lambda t, x: -condition.height(t, x), *at_time(0.0, X0.lower, X0.upper), levels)
    tell(report, budget, "the set D, and whether the law and the condition are as they should be on it")
    states = without(states or enclosing_box(condition.height, X0, goal, duration, wanted, constants), left_out)
    domain = domain_around(states, X0, duration, left_out, constants)
    require_own_gradient(condition.V, domain)
    check_states(condition, domain)
    assumed = check_controls(condition.closed_loop, domain)
    memory.check()
    tell(report, budget, "the least V on the boundary of D")
    axes = [1 + i for i in range(states.dimension) if i not in (*left_out, *constants)]
    return Setting(left_out, X0, wanted, states, domain, faces(*domain, axes), levels, assumed)


def for_levels(budget: Budget) -> Budget:
    """The share of a budget for levels."""
    return Budget(min(LEVELS, max(LEAST, SHARE_OF_LEVELS * budget.left)), chunk=budget.chunk)


def proof_within(
    condition: DecreaseCondition,
    domain: tuple[Corner, Corner],
    level: float,
    budget: Budget,
    **options: Any,
) -> Proof:
    """What is proved of the condition, in what a budget leaves but for a share of it, unless someone stops it.

    Args:
        options: of prove.
    """
    search = replace(budget, seconds=(1 - SHARE_OF_FINISH) * budget.left, started=time.monotonic())
    tell(options.get("report"), budget, "tracing the condition, and seeking where it fails")
    with signals_taken(search.stop.ask):
        proof = prove(condition, domain, level, search, stop_at_counterexample=False, **options)
    if search.stop.asked:
        keep = options.get("keep")
        raise Interrupted(KEPT.format(keep) if keep else NOT_KEPT, 130)
    tell(options.get("report"), budget, "what follows from the proof")
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
    times = torch.linspace(0, duration, 9, dtype=torch.float64).unique()  # one, where T = 0
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


def largest_seen(V: Value, initial_states: Box) -> float:
    """The largest V(0, ·) among the corners of X₀ and 10 000 of its states."""
    states = torch.cat([initial_states.corners(), initial_states.sample(10_000, torch.Generator().manual_seed(0))])
    with torch.no_grad():
        return float(V(states.new_zeros(len(states)), states).max())


def share_of(V: Value, x_low: State, x_high: State, rho: float, budget: Budget) -> float:
    """A lower bound of the share by volume of a box of states with V(0, ·) ≤ ρ."""
    if rho == -float("inf"):
        return 0.0
    lower, upper = at_time(0.0, x_low, x_high)
    return share_below(V, lower[0], upper[0], rho, Budget(budget.left, chunk=budget.chunk))


def _terminal_excess(condition: DecreaseCondition, states: Box, duration: float, rho: float, budget: Budget) -> float:
    """An upper bound of κ = max φ(x) − V(T, x)/α over x ∈ D with W(T, x) ≤ ρ; infinite where there is no ρ."""
    if rho == -float("inf"):
        return float("inf")
    budget = Budget(budget.left, chunk=budget.chunk)
    V, cost, alpha = condition.V, condition.closed_loop.cost, condition.alpha
    end = at_time(duration, states.lower.double(), states.upper.double())
    return -minimum(lambda t, x: V(t, x) / alpha - cost.terminal(x), *end, budget, condition.height, rho, unit=abs(rho))
