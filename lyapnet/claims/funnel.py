"""The sound claim: a funnel that no closed loop leaves, and the cost that it guarantees."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from lyapnet.base.contracts import copied
from lyapnet.base.errors import Interrupted, UsageError, signals_taken
from lyapnet.base.types import Corner, Corners, PerState, Points, State, Value
from lyapnet.claims.computed_laws import add_program_errors
from lyapnet.claims.control_sets import check_controls, check_minimum
from lyapnet.claims.crossing import Violation, crossing_level, find_violation, initial_violation_level
from lyapnet.claims.ignorable_states import ignorable_states
from lyapnet.claims.preconditions import (
    at_time,
    check_states,
    domain_around,
    freeze,
    over_time,
    require_continuous,
    slice_at_zero,
)
from lyapnet.claims.stepped_decrease import SteppedPayment
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.prover.boxes import faces
from lyapnet.prover.branch_and_bound import Budget, just_above, just_below, minimum, share_below
from lyapnet.prover.condition import (
    DecreaseCondition,
    bounded_condition,
    require_own_gradient,
)
from lyapnet.prover.counterexamples import Counterexample, find_counterexample
from lyapnet.prover.float_errors import FloatLaw
from lyapnet.prover.proof import Progress, Proof, prove, report_stage
from lyapnet.prover.readings import Readings
from lyapnet.prover.verdict import Verdict, time_limit_reason, verdict_on
from lyapnet.task.constraints import names_of
from lyapnet.task.horizon import Horizon
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box

# time for each level, such as max V(0, ·) on X₀, or min W on the boundary of D
SHARE_OF_LEVELS = 0.3  # of the remaining budget, between these limits:
MIN_LEVEL_SECONDS, MAX_LEVEL_SECONDS = 1.0, 60.0
SHARE_OF_FINISH = 0.15  # of the remaining budget, for what is computed after the proof: the share of X₀ and κ
RAYS, RAY_TIMES, RAY_RADII = 400, 9, 71  # numbers of rays, times and radii at which W is evaluated to find a set D
LONGEST_RAY = 30.0  # relative to the largest distance of X₀ from the goal along an axis
SET_MARGIN = 1.15  # factor by which D is larger than what these rays find
SAMPLES = 10_000  # random states of X₀, beside its corners, among which the largest V is found
KEPT = "Stopped while certifying: the proof so far is kept in {}, and the same command resumes it."
NOT_KEPT = "Stopped while certifying: the proof is lost; the option keep writes it to a file."


@dataclass(frozen=True, kw_only=True)
class ProvedFunnel:
    """With W(t, x) = V(t, x) − δt, at every (t, x) in [0, T] × D with W ≤ ρ, in continuous time and for this model,

        V_t + V_xᵀ(f + g u) + α ℓ(x, u) ≤ δ,     that is Ẇ ≤ −αℓ,

    and W > ρ on the boundary of D. With constraints the inequality holds where h(x) ≤ 0, and W > ρ wherever h_j(x) = 0
    and ∇h_jᵀ(f + gu) ≥ 0, so that no closed loop with W ≤ ρ begins to violate one. Hence each closed loop that starts
    in D with h(x₀) ≤ 0 and V(0, x₀) ≤ ρ keeps h(x(t)) ≤ 0 and V(t, x(t)) ≤ ρ + δt, stays in D up to T, and has

        α ∫ℓ dt ≤ V(0, x₀) − V(T, x(T)) + δT,
        J(x₀) = ∫ℓ dt + φ(x(T)) ≤ (V(0, x₀) + δT)/α + κ,   κ = max of φ(x) − V(T, x)/α where W(T, x) ≤ ρ.

    States on which none of f, g, ℓ, φ, V and u depends are ignorable: D is all of ℝ along them. {W ≤ ρ} is then a
    cylinder along these states, a closed loop can leave it only through its side, and a proof on the slice where they
    are 0 holds on every slice. (Such a state cannot go to infinity in finite time: its derivative is bounded.)
    The parameters of a family are constant: along them D is their range, and no closed loop leaves it there.

    With `readings`, u is held between readings. The inequality then holds at t = t̂ + a and x = x(t̂ + a) for the control
    u of each reading at (t̂, x̂) with W(t̂, x̂) ≤ ρ, for every a at which it may be in use (see Readings). By induction
    over the readings the same follows, whatever their times are.

    With `steps`, the claim is about the steps x_{n+1} = F(x_n, u) of the horizon's method, with u = policy(t_n, x_n)
    held, and not about the time between them. At each t ∈ [0, T − Δt] and x ∈ D with W ≤ ρ

        (V(t + Δt, F(x, u)) − V(t, x))/Δt + α ℓ̄(x, u) ≤ δ     and     F(x, u) ∈ D,

    where ℓ̄ is the mean of ℓ over the step; the times t_n are among these t. By induction x_n ∈ D and V(t_n, x_n) ≤
    ρ + δt_n, and J is the cost of the steps. {W ≤ ρ} may touch the boundary of D.

    The verdict is on the funnel of ρ = `wanted`, which contains all of X₀. For every verdict, `rho` is the largest
    proved level, and {V(0, ·) ≤ rho} contains at least the share `volume_share` of X₀.
    """

    alpha: float
    delta: float  # in cost per second
    duration: float  # T in s
    states: Box  # D
    rho: float  # the largest proved level; −∞ if none is proved
    wanted: float  # an upper bound of max V(0, ·) on X₀, at most 0.1 % above it: the ρ of a funnel with all of X₀
    least: float  # the largest V(0, ·) among samples of X₀: a lower bound of this ρ
    volume_share: float  # a lower bound of the share of X₀ with V(0, ·) ≤ ρ
    terminal_excess: float  # an upper bound of κ
    counterexample: Counterexample | None
    boxes: int
    seconds: float
    remaining_volume: float  # undecided share of [0, T] × D; all of it lies above the funnel
    undecided: Points  # centres (t, x) of undecided boxes
    left_out: list[int]  # the ignorable states; D has no bounds along them
    fingerprint: str = ""  # of the traced operations and numbers of (V̇ + αℓ − δ, W)
    proof_seconds: float = 0.0  # of the search, without set-up and levels
    constraints: Sequence[str] = ()  # the constraints h(x) ≤ 0 in words
    crossing: float = float("inf")  # a lower bound of W where a closed loop could begin to violate a constraint
    violation: Violation | None = None  # a closed loop from X₀ that violates a constraint, if one was found
    disturbance: State | None = None  # w: the claim holds for all ẋ = f + gu + w(t) with |w_i(t)| ≤ w_i
    set_up: float = 0.0  # seconds of the budget before the first box
    assumed: str = ""  # a sentence on what is assumed of u; empty if nothing is
    readings: Readings | None = None  # when u is read; None: at every t
    steps: Horizon | None = None  # Δt and method of the steps; None: continuous time
    formula: ClassVar[str] = "ρ + δt"  # of `level`, for figures

    def level(self, t: float) -> float:
        """The level of V(t, ·) that bounds the funnel at t."""
        return self.rho + self.delta * t

    @property
    def verdict(self) -> Verdict:
        """The verdict on the claim that a funnel contains X₀ and that no closed loop from X₀ violates a constraint."""
        if self.violation is not None:
            return "falsified"
        found = self.counterexample
        return verdict_on(self.rho, self.wanted, None if found is None else found.height, self.least)

    @property
    def reason(self) -> str | None:
        """The reason for the verdict unknown, and advice."""
        if self.verdict != "unknown":
            return None
        if self.remaining_volume > 0:
            return f"{time_limit_reason(self.set_up)}: allow more, or resume a kept proof"
        if self.counterexample is not None:
            return "the condition fails close to the level that X₀ needs"
        if self.crossing <= self.wanted:
            return "it is not proved in time that closed loops of the funnel around X₀ satisfy the constraints"
        return "the funnel meets the boundary of D: choose a larger set"

    def guaranteed_cost(self, value: PerState) -> PerState:
        """The upper bound of J(x₀) as a function of V(0, x₀), (*batch,); ∞ outside of the funnel."""
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
    readings: Readings | None = None,
    law: FloatLaw | None = None,
    steps: bool = False,
) -> ProvedFunnel:
    """Prove the largest funnel that a budget allows, up to the one that contains X₀.

    Args:
        closed_loop: a closed loop with a V; the claim is about its float64 copy.
        problem: gives X₀, T, the goal and the constraints.
        states: D; by default a box around {W ≤ max V(0, ·) on X₀}, estimated from samples.
        report, keep, replay, degree: as in prove.
        disturbance: w, (n,): the claim is about every closed loop ẋ = f + gu + w(t) with |w_i(t)| ≤ w_i.
        readings: when u is read; None: at every t.
        law: a program that computes u in floating-point numbers, whose errors count; None: u is exact.
        steps: whether the claim is about the steps of the horizon's method; not with disturbance, readings or law.

    Raises:
        UsageError: α, δ or D are unsuitable; readings are of another program; an operator has no bound.
        Interrupted: Ctrl-C or SIGTERM; the message says whether the proof was kept.
    """
    started, budget, problem = time.monotonic(), budget or Budget(), copied(problem)
    if disturbance is not None:
        _require_usable_disturbance(disturbance, problem)
    loop, duration = copied(closed_loop).requires_grad_(False), problem.horizon.duration
    if steps:
        if problem.constraints is not None:
            raise UsageError("Expected no state constraints with --time steps, got some; take --time continuous.")
        condition = SteppedPayment(loop, alpha, delta, problem)
    else:
        condition = DecreaseCondition(loop, alpha, delta, problem.constraints, disturbance, readings)
    left_out, initial_states, wanted, D, domain, sides, levels, assumed = find_setting(
        condition, problem, duration, states, budget, report
    )
    if law is not None:
        report_stage(report, budget, "errors of the C on D")
    condition.readings = readings = add_program_errors(law, readings, D, left_out)
    levels = levels if law is None else budget_for_level(budget)  # a new one, since its seconds have begun to run
    x_low, x_high = initial_states.lower, initial_states.upper
    needed = just_above(wanted)
    rim = float("inf") if steps else minimum(condition.height, *sides, levels, enough=just_above(needed))
    if isinstance(condition, SteppedPayment):
        domain = condition.domain_of(D, left_out)
    begin = initial_violation_level(
        condition, at_time(0.0, x_low, x_high), budget_for_level(budget), just_above(needed)
    )
    crossing = min(begin, crossing_level(condition, domain, budget_for_level(budget), just_above(needed)))
    set_up, spent = time.monotonic() - started, budget.elapsed
    level = min(needed, just_below(min(rim, crossing)))
    proof = prove_in_time(
        condition, domain, level, budget,
        generator=generator, report=report, keep=keep, replay=replay, degree=degree,
    )  # fmt: skip
    rho = wanted if proof.level >= needed else proof.level
    found = proof.counterexample
    if found is None and rim <= needed and budget.left:  # look for one between the level of the proof and that of X₀
        bounded = bounded_condition(condition, domain, level=needed)
        found = find_counterexample(condition, bounded, *condition.search_box(domain), needed, generator)
    names, violation = names_of(problem.constraints), find_violation(condition.closed_loop, problem, generator)
    share = 1.0 if rho >= wanted else share_of(condition.V, x_low, x_high, rho, budget)
    excess = terminal_excess(condition, D, duration, rho, budget)
    return ProvedFunnel(
        alpha=alpha, delta=delta, duration=duration, states=D, rho=rho, wanted=wanted,
        least=largest_sample(condition.V, initial_states), volume_share=share, terminal_excess=excess,
        counterexample=found, boxes=proof.boxes, seconds=set_up + proof.seconds,
        remaining_volume=proof.remaining_volume, undecided=proof.undecided, left_out=left_out,
        fingerprint=proof.fingerprint, proof_seconds=proof.seconds, constraints=names, crossing=crossing,
        violation=violation, disturbance=disturbance, set_up=spent, assumed=assumed,
        readings=readings, steps=problem.horizon if steps else None,
    )  # fmt: skip


def require_disturbance(w: State, n: int) -> None:
    """Refuse a w that is not n finite numbers ≥ 0."""
    if w.shape != (n,) or not bool(((w >= 0) & w.isfinite()).all()):
        raise UsageError(
            f"Expected disturbances ≥ 0 of {n} states, got {w.tolist()}; give the largest |w| in units of ẋ."
        )


def _require_usable_disturbance(w: State, problem: Problem) -> None:
    """Refuse a disturbance that is malformed, or for which no funnel can be proved."""
    require_disturbance(w, problem.system.n)
    if problem.constraints is not None:
        raise UsageError("Expected no state constraints with disturbances, got some; leave one of the two out.")
    moved = [problem.system.state_names[i] for i in problem.system.constants if w[i] > 0]
    if moved:
        raise UsageError(
            f"Expected no disturbance of the parameters of a family, got {', '.join(moved)}; leave them out."
        )


class Setting(NamedTuple):
    """The sets and levels of a claim, with ignorable states fixed at 0."""

    left_out: list[int]
    initial_states: Box  # X₀
    wanted: float  # an upper bound of max W(0, ·) on X₀, at most 0.1 % above it
    states: Box  # D
    domain: tuple[Corner, Corner]  # [0, T] × D
    sides: tuple[Corners, Corners]  # [0, T] × the boundary of D
    levels: Budget  # for one level
    assumed: str  # a sentence on what is assumed of u; empty if nothing is


def find_setting(
    condition: DecreaseCondition,
    problem: Problem,
    duration: float,
    states: Box | None,
    budget: Budget,
    report: Callable[[Progress], None] | None = None,
    level_of: Callable[[float, Box], float] | None = None,
) -> Setting:
    """Trace V and h of a condition once, check the condition, and find the sets and levels of a claim about it.

    Args:
        duration: T; or 0 for a claim about t = 0 only.
        states: D; by default a box around {W ≤ level}, estimated from samples.
        budget: the budget of the claim; a share of it is for levels.
        report: called with the name of each stage.
        level_of: (max W(0, ·) on X₀, X₀) ↦ the level of W that D must enclose; by default this maximum.

    Raises:
        UsageError: D is unsuitable; or the condition cannot be bounded.
    """
    report_stage(report, budget, "calling and tracing f, g, the cost, V and u")
    memory = freeze(condition, over_time(problem.initial_states, duration))
    constants, goal = condition.closed_loop.system.constants, problem.goal.double()
    left_out = ignorable_states(condition.closed_loop, problem.constraints)
    X0 = slice_at_zero(problem.initial_states, left_out)
    require_continuous(condition.V, X0.lower, X0.upper)
    levels = budget_for_level(budget)
    report_stage(report, budget, "the largest V on X₀")
    wanted = -minimum(lambda t, x: -condition.height(t, x), *at_time(0.0, X0.lower, X0.upper), levels)
    report_stage(report, budget, "the set D; checks of the law and the condition on it")
    level = wanted if level_of is None else level_of(wanted, X0)
    states = slice_at_zero(states or enclosing_box(condition.height, X0, goal, duration, level, constants), left_out)
    domain = domain_around(states, X0, duration, left_out, constants)
    require_own_gradient(condition.V, domain)
    check_states(condition, domain)
    tested = check_controls(condition.closed_loop, domain), check_minimum(condition.closed_loop, domain)
    memory.check()
    report_stage(report, budget, "the least V on the boundary of D")
    axes = [1 + i for i in range(states.dimension) if i not in (*left_out, *constants)]
    return Setting(left_out, X0, wanted, states, domain, faces(*domain, axes), levels, " ".join(filter(None, tested)))


def budget_for_level(budget: Budget) -> Budget:
    """The budget for one level: a share of what is left, between limits."""
    return Budget(min(MAX_LEVEL_SECONDS, max(MIN_LEVEL_SECONDS, SHARE_OF_LEVELS * budget.left)), chunk=budget.chunk)


def prove_in_time(
    condition: DecreaseCondition,
    domain: tuple[Corner, Corner],
    level: float,
    budget: Budget,
    **options: Any,
) -> Proof:
    """Prove the condition within the remaining budget, except the share that is reserved for what follows the proof.

    Args:
        options: of prove.

    Raises:
        Interrupted: Ctrl-C or SIGTERM.
    """
    search = replace(budget, seconds=(1 - SHARE_OF_FINISH) * budget.left, started=time.monotonic())
    report_stage(options.get("report"), budget, "tracing the condition, and searching for a counterexample")
    with signals_taken(search.stop.ask):
        proof = prove(condition, domain, level, search, stop_at_counterexample=False, **options)
    if search.stop.asked:
        keep = options.get("keep")
        raise Interrupted(KEPT.format(keep) if keep else NOT_KEPT, 130)
    report_stage(options.get("report"), budget, "volumes and bounds that follow from the proof")
    return proof


def enclosing_box(
    W: Value, initial_states: Box, goal: State, duration: float, level: float, constants: Sequence[int] = ()
) -> Box:
    """A box around X₀ and {W(t, ·) ≤ level}, estimated along rays from the goal; the proof checks it later.

    Along each random ray and at each of several times, the first radius with W > level is found. This is done twice: in
    the second pass each axis is scaled by the result of the first one. Along the constants the box is that of X₀.
    """
    generator = torch.Generator().manual_seed(0)
    lower, upper = initial_states.lower.double(), initial_states.upper.double()
    constant = torch.tensor([i in constants for i in range(len(goal))])
    least, greatest = torch.where(constant, lower, -torch.inf), torch.where(constant, upper, torch.inf)
    inner = initial_states.reach_from(goal).double()
    largest = inner.max() if inner.max() > 0 else torch.ones(())
    reach = torch.full_like(inner, float(largest))
    times = torch.linspace(0, duration, RAY_TIMES, dtype=torch.float64).unique()  # one time if T = 0
    radii = torch.logspace(-2, 1.5, RAY_RADII, dtype=torch.float64)
    for _ in range(2):
        rays = torch.randn(RAYS, len(reach), generator=generator, dtype=torch.float64)
        rays = reach * rays / torch.linalg.vector_norm(rays, dim=-1, keepdim=True)
        points = (radii[:, None, None] * rays).clamp(-LONGEST_RAY * largest, LONGEST_RAY * largest)
        points = (goal + points).clamp(least, greatest) - goal
        reach = torch.stack([_reach_below(W, t, goal, points, level) for t in times]).amax(0)
        reach = reach.clamp_min(1e-6 * float(largest))
    reach = SET_MARGIN * torch.maximum(reach, inner)
    return Box(torch.where(constant, lower, goal - reach), torch.where(constant, upper, goal + reach))


def _reach_below(W: Value, t: Tensor, goal: State, points: Tensor, level: float) -> State:
    """The largest distance from the goal along each axis on rays of points, (radii, rays, n), until W(t, ·) > level."""
    reach, below = torch.zeros_like(goal), torch.arange(points.shape[1])
    for some in points.split(8):
        if not len(below):
            break
        with torch.no_grad():
            above = W(t.expand(len(some), len(below)), goal + some[:, below]) > level
        inside = above.cumsum(0) == 0
        reach = torch.maximum(reach, torch.where(inside[..., None], some[:, below].abs(), 0.0).amax((0, 1)))
        below = below[inside[-1]]
    return reach


def largest_sample(V: Value, initial_states: Box) -> float:
    """The largest V(0, ·) among the corners and SAMPLES random states of X₀."""
    states = torch.cat([initial_states.corners(), initial_states.sample(SAMPLES, torch.Generator().manual_seed(0))])
    with torch.no_grad():
        return float(V(states.new_zeros(len(states)), states).max())


def share_of(V: Value, x_low: State, x_high: State, rho: float, budget: Budget) -> float:
    """A lower bound of the share of a box of states, by volume, in which V(0, ·) ≤ ρ."""
    if rho == -float("inf"):
        return 0.0
    lower, upper = at_time(0.0, x_low, x_high)
    return share_below(V, lower[0], upper[0], rho, Budget(budget.left, chunk=budget.chunk))


def terminal_excess(condition: DecreaseCondition, states: Box, duration: float, rho: float, budget: Budget) -> float:
    """An upper bound of κ = max φ(x) − V(T, x)/α over x ∈ D with W(T, x) ≤ ρ; ∞ if ρ = −∞."""
    if rho == -float("inf"):
        return float("inf")
    budget = Budget(budget.left, chunk=budget.chunk)
    V, cost, alpha = condition.V, condition.closed_loop.cost, condition.alpha
    end = at_time(duration, states.lower.double(), states.upper.double())
    return -minimum(lambda t, x: V(t, x) / alpha - cost.terminal(x), *end, budget, condition.height, rho, unit=abs(rho))
