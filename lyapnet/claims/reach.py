"""The reach claim: closed loops under noise reach a target before they leave a set, with a probability."""

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from lyapnet.base.contracts import copied
from lyapnet.base.errors import UsageError
from lyapnet.base.types import PerState, Points
from lyapnet.claims.funnel import (
    budget_for_level,
    enclosing_box,
    find_setting,
    largest_sample,
    prove_in_time,
    share_of,
)
from lyapnet.claims.noisy_decrease import require_smooth
from lyapnet.claims.noisy_funnel import (
    LEVEL_FACTORS,
    RISKS,
    SAMPLE_MARGIN,
    SAMPLES,
    kept_largest,
    levels_of_constraints,
)
from lyapnet.claims.preconditions import at_time, over_time
from lyapnet.claims.reach_decrease import OutsideBox, ReachDecrease
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.prover.boxes import faces, random_points
from lyapnet.prover.branch_and_bound import Budget, just_above, just_below, minimum
from lyapnet.prover.counterexamples import Counterexample
from lyapnet.prover.proof import Progress, Proof
from lyapnet.prover.verdict import Verdict, time_limit_reason, verdict_on
from lyapnet.task.constraints import names_of
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box

SHARE_OF_RATE = 0.5  # default of ε as a share of the largest ε at samples, since bounds are less tight than values
LEAST_RATE = 1e-3  # default of ε if samples allow none, as a share of max V on X₀ over T


@dataclass(frozen=True, kw_only=True)
class ProvedReach:
    """For dx = (f + g u) dt + σ(x) dW with u = u(0, x) at every time, and V(x) = V(0, x) twice continuously
    differentiable, at each x ∈ D outside of the interior of the target G with V(x) ≤ ρ', for this model and in
    continuous time,

        𝓛V + ½ λ ‖σᵀV_x‖² ≤ −ε,     𝓛V = V_xᵀ(f + g u) + ½ tr(σσᵀV_xx),

    and V > ρ' on the boundary of D, on the boxes to avoid, and wherever a constraint has h_j ≥ 0. Let τ be the time at
    which a closed loop from x₀ first is in G, or leaves {x ∈ D: V(x) ≤ ρ'}. Up to τ, exp(λV) and V + εt are
    supermartingales, so that for each x₀ ∈ D with V(x₀) ≤ ρ'

        P(it reaches G before it leaves D, meets a box to avoid or violates a constraint) ≥ 1 − exp(−λ(ρ' − V(x₀))),
        E τ ≤ (V(x₀) − v)/ε     with v ≤ V on D.

    Nothing is claimed about what happens after τ.

    ρ (`wanted`) is such that closed loops from all of X₀ reach the target with a given `probability`; the verdict is on
    this claim. For every verdict, closed loops from the share `volume_share` of X₀ do so, by the largest proved ρ'
    (`rho`).
    """

    probability: float  # the probability of reaching the target that is to be proved
    risk: float  # λ in 1/cost
    rate: float  # ε in cost per second
    target: Box  # G
    avoided: Sequence[Box]
    states: Box  # D
    rho: float  # the largest proved level; −∞ if none is proved
    wanted: float  # ρ
    largest: float  # an upper bound of max V on X₀
    least: float  # a level such that no sublevel set below it is enough for X₀
    lowest: float  # v, a lower bound of V on D
    rim: float  # a lower bound of V on the boundary of D, on boxes to avoid and where h_j ≥ 0
    volume_share: float  # a lower bound of the share of X₀ from which the target is reached with that probability
    proof: Proof
    seconds: float
    constraints: Sequence[str] = ()
    set_up: float = 0.0  # seconds of the budget before the first box
    assumed: str = ""  # a sentence on what is assumed of u; empty if nothing is
    noise: Mapping[str, float] | None = None  # σ by state, per √s; None: that of the task
    left_out: Sequence[int] = ()  # ignorable states; this claim allows none

    def reach_probability(self, value: PerState) -> PerState:
        """The lower bound of P(reach the target before leaving) as a function of V(0, x₀), (*batch,)."""
        return 1 - torch.exp(-self.risk * (self.rho - value)).clamp(max=1.0)

    def mean_time(self, value: PerState) -> PerState:
        """The upper bound of E τ in s as a function of V(0, x₀), (*batch,); ∞ where V(0, x₀) > ρ'."""
        return torch.where(value <= self.rho, (value - self.lowest) / self.rate, torch.inf)

    @property
    def counterexample(self) -> Counterexample | None:
        """The state of lowest V found at which the condition fails."""
        return self.proof.counterexample

    @property
    def undecided(self) -> Points:
        """Centres (t, x) of undecided boxes; all of them lie above ρ'."""
        return self.proof.undecided

    @property
    def verdict(self) -> Verdict:
        """The verdict on the claim that closed loops from all of X₀ reach the target with the wanted probability."""
        found = self.counterexample
        return verdict_on(self.rho, self.wanted, None if found is None else found.height, self.least)

    @property
    def reason(self) -> str | None:
        """The reason for a verdict that is not certified, and advice."""
        if self.verdict == "certified":
            return None
        if self.counterexample is not None:
            return (
                "V(0, ·) does not fall enough there under this noise outside of the target: ask for less, choose a "
                "larger target, or train V on all of D"
            )
        if self.rim <= self.wanted:
            return (
                "the level that this probability needs meets the boundary of D, a box to avoid or a constraint: ask "
                "for less, choose a larger set, or train V to be higher there"
            )
        return f"{time_limit_reason(self.set_up)}: allow more, or resume a kept proof"


def prove_reach(
    closed_loop: ClosedLoop,
    problem: Problem,
    target: Box,
    avoided: Sequence[Box] = (),
    probability: float = 0.99,
    risk: float | None = None,
    rate: float | None = None,
    states: Box | None = None,
    budget: Budget | None = None,
    generator: torch.Generator | None = None,
    report: Callable[[Progress], None] | None = None,
    keep: Path | None = None,
    replay: bool = False,
    named: Mapping[str, float] | None = None,
) -> ProvedReach:
    """Prove that closed loops of the receding law u(0, x) from X₀ reach a target with a probability.

    Args:
        closed_loop: a closed loop with a V and noise; the claim is about its float64 copy.
        problem: gives X₀, the constraints and the goal.
        target: G, with an interior.
        avoided: boxes that closed loops must not meet before they are in G.
        risk, rate: λ and ε; by default chosen from samples of D.
        states: D; by default a box around a sublevel set, estimated from samples.
        report, keep, replay: as in prove.
        named: σ by state, if it is not the noise of the task, for the kept proof.

    Raises:
        UsageError: the task has no noise, V is not smooth, the sets, λ or ε are unsuitable, the system is a family or
            has ignorable states, or the closed loop has an operator without a bound.
        Interrupted: Ctrl-C or SIGTERM; the message says whether the proof was kept.
    """
    started, budget, problem = time.monotonic(), budget or Budget(), copied(problem)
    if problem.system.constants:
        raise UsageError("Expected one system, got a family; choose one member of it (option at).")
    n = problem.system.n
    target, avoided = _of_states(target, n), [_of_states(box, n) for box in avoided]
    _require_interior(target)
    _require_away_from(problem.initial_states, target, avoided)
    condition = ReachDecrease(copied(closed_loop).requires_grad_(False), target, avoided, probability, named)
    require_smooth(condition, over_time(problem.initial_states, 0.0))
    goal, duration = problem.goal.double(), problem.horizon.duration
    kept = kept_largest(keep, condition)

    def level_of(found: float, X0: Box) -> float:
        largest = found if kept is None else max(found, kept)  # a bound that is a little higher is a bound too
        box = partial(enclosing_box, condition.height, X0, goal, 0.0)
        boxes = [states] if states is not None else (box(level=each * largest) for each in LEVEL_FACTORS)
        choose_risk_and_rate(condition, boxes, risk, rate, largest, duration)
        return condition.level

    left_out, X0, _, D, domain, faces_of_D, levels, assumed = find_setting(
        condition, problem, 0.0, states, budget, report, level_of
    )
    if left_out:
        names = ", ".join(problem.system.state_names[i] for i in left_out)
        raise UsageError(f"Expected a system that depends on each state for a target, got one without {names}.")
    wanted, needed = condition.level, just_above(condition.level)
    enough, unit = just_above(needed), abs(needed)
    rim = minimum(condition.V, *faces_of_D, levels, enough=enough, unit=unit)
    rim = min([rim, *(_level_on(condition, box, D, budget, enough, unit) for box in avoided)])
    if problem.constraints is not None:
        rim = min(rim, *levels_of_constraints(condition, problem, domain, budget, enough))
    lowest = minimum(condition.V, *at_time(0.0, D.lower, D.upper), budget_for_level(budget), unit=unit)
    condition.constraints = OutsideBox(target)
    set_up = budget.elapsed
    proof = prove_in_time(
        condition, domain, min(needed, just_below(rim)), budget,
        generator=generator, report=report, keep=keep, replay=replay,
    )  # fmt: skip
    rho = wanted if proof.level >= needed else proof.level
    share = 1.0 if rho >= wanted else share_of(condition.V, X0.lower, X0.upper, rho - condition.gap, budget)
    return ProvedReach(
        probability=probability, risk=condition.risk, rate=condition.rate, target=target, avoided=avoided, states=D,
        rho=rho, wanted=wanted, largest=condition.largest, least=largest_sample(condition.V, X0) + condition.gap,
        lowest=lowest, rim=rim, volume_share=share, proof=proof, seconds=time.monotonic() - started,
        constraints=names_of(problem.constraints), set_up=set_up, assumed=assumed,
        noise=None if named is None else dict(named),
    )  # fmt: skip


def _of_states(box: Box, n: int) -> Box:
    """A box in float64; refused unless it has n states."""
    if box.dimension != n:
        raise UsageError(f"Expected boxes of {n} states, got {box.dimension}; give bounds for each state.")
    return Box(box.lower.double(), box.upper.double())


def _require_interior(target: Box) -> None:
    if not bool((target.widths > 0).all()):
        raise UsageError("Expected a target with an interior, got lower = upper; noise never meets a point.")


def _require_away_from(initial_states: Box, target: Box, avoided: Sequence[Box]) -> None:
    """Refuse a box to avoid that contains states of X₀ outside of the target."""
    for box in avoided:
        lower = torch.maximum(box.lower, initial_states.lower.double())
        upper = torch.minimum(box.upper, initial_states.upper.double())
        if (lower <= upper).all() and not ((target.lower <= lower) & (upper <= target.upper)).all():
            raise UsageError(
                f"Expected boxes to avoid outside X₀, got one that meets X₀ from {lower.tolist()} to {upper.tolist()}; "
                "closed loops that begin there do not avoid it: make one of both smaller."
            )


def _level_on(condition: ReachDecrease, avoided: Box, states: Box, budget: Budget, enough: float, unit: float) -> float:
    """A lower bound of V on the part of a box that lies in D; ∞ if none does.

    Args:
        enough, unit: as in minimum.
    """
    lower, upper = torch.maximum(avoided.lower, states.lower), torch.minimum(avoided.upper, states.upper)
    if bool((lower > upper).any()):
        return math.inf
    return minimum(condition.V, *at_time(0.0, lower, upper), budget_for_level(budget), enough=enough, unit=unit)


def choose_risk_and_rate(
    condition: ReachDecrease,
    boxes: Iterable[Box],
    risk: float | None,
    rate: float | None,
    largest: float,
    duration: float,
) -> None:
    """Set λ and ε, or the one that is not given, by samples of {V ≤ ρ} outside of the target.

    λ is the middle one of those for which the condition holds at all samples: a larger λ makes the set smaller and the
    condition harder. ε is half of what samples allow with it. If there is none, λ is the one with the lowest share of
    failures.

    Args:
        boxes: sets of states that are sampled in turn until a λ is found whose sublevel set they contain.
        largest: max V(0, ·) on X₀.
        duration: T in s, for an ε if samples allow none.
    """
    least_rate = LEAST_RATE * max(abs(largest), 1e-6) / duration
    risks = [risk] if risk is not None else (RISKS / max(abs(largest), 1e-6)).tolist()
    best = (math.inf, risks[len(risks) // 2], least_rate if rate is None else rate)
    for box in boxes:
        V, mean, variance, rim = _sample_rates(condition, box)
        possible = list[tuple[float, float, float]]()
        for each in risks:
            condition.aim(each, least_rate if rate is None else rate, largest)
            inside = condition.level >= V
            if not bool(inside.any()):
                continue
            falls = -(mean + (1 + SAMPLE_MARGIN) * each / 2 * variance)[inside]
            failing = float((falls < condition.rate).double().mean())
            allowed = max(SHARE_OF_RATE * float(falls.min()), least_rate)
            found = (failing, each, allowed if rate is None else rate)
            if not failing and condition.level < rim:
                possible.append(found)
            best = min(best, found, key=lambda one: one[0])
        if possible:
            best = possible[len(possible) // 2]
            break
    condition.aim(*best[1:], largest)


def _sample_rates(condition: ReachDecrease, box: Box) -> tuple[Tensor, Tensor, Tensor, float]:
    """(V, 𝓛V, ‖σᵀV_x‖²) at random points of D outside of the target; the least V at points of its boundary and of the
    boxes to avoid.
    """
    generator = torch.Generator().manual_seed(0)
    lower, upper = (side.double() for side in (box.lower, box.upper))
    x = random_points(lower, upper, SAMPLES, generator)
    x = x[OutsideBox(condition.target).worst(x) <= 0]
    sides = zip(*faces(lower, upper, range(box.dimension)), strict=True)
    parts = [*sides, *((torch.maximum(b.lower, lower), torch.minimum(b.upper, upper)) for b in condition.avoided)]
    edge = [random_points(low, high, SAMPLES // 10, generator) for low, high in parts if bool((low <= high).all())]
    rim = torch.cat(edge)
    with torch.no_grad():
        now = x.new_zeros(len(x))
        V_rim = condition.V(x.new_zeros(len(rim)), rim)
        return condition.V(now, x), *condition.rates(now, x), float(V_rim.min())
