"""The region of attraction of the receding law u(0, x): a sublevel set of V(0, ·) that no closed loop leaves."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from lyapnet.base.contracts import copied
from lyapnet.base.errors import UsageError
from lyapnet.base.types import Corner, Corners, Points, State, Value
from lyapnet.claims.contraction import Contraction, contraction_around, final_distance
from lyapnet.claims.funnel import (
    MAX_LEVEL_SECONDS,
    Setting,
    budget_for_level,
    find_setting,
    largest_sample,
    prove_in_time,
    require_disturbance,
    share_of,
)
from lyapnet.claims.kept_regions import KeptRegion, kept_region
from lyapnet.claims.plants import Plants
from lyapnet.claims.preconditions import at_centre, first_states
from lyapnet.claims.receding_decrease import RecedingDecrease
from lyapnet.claims.stepped_decrease import SteppedDecrease
from lyapnet.claims.ultimate_bound import extent_of, ultimate_level
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.prover.branch_and_bound import Budget, just_above, just_below, minimum
from lyapnet.prover.condition import own_constraints
from lyapnet.prover.counterexamples import Counterexample
from lyapnet.prover.proof import Progress, Proof
from lyapnet.prover.readings import Readings
from lyapnet.prover.verdict import Verdict, time_limit_reason, verdict_on
from lyapnet.task.constraints import Constraints, names_of
from lyapnet.task.horizon import Horizon
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box
from lyapnet.value.policy import ValuePolicy

PER_HORIZON = 0.01  # default of λT
LEVEL_TOLERANCE = 0.1  # relative accuracy of an upper bound of V on D, used as a level that excludes nothing


@dataclass(frozen=True, kw_only=True)
class ProvedRegion:
    """Let V(x) = V(0, x), let u(0, x) be applied at every time t, and let F = f + g u(0, ·) and ρ ≥ c > 0. It is proved
    that

        V̇ = V_xᵀF(x) ≤ −λ max(V(x), c) < 0   at each x ∈ D with V(x) ≤ ρ, outside the hole {x ∈ B: V(x) < c},

    V > ρ on the boundary of D and wherever some constraint has h_j ≥ 0, V > c on the boundary of a box B around the
    goal, and F contracts on B (see Contraction). Hence {x ∈ D: V(x) ≤ ρ} is a region of attraction: no closed loop that
    starts in it leaves it or violates a constraint. V falls until the state enters the hole, which it never leaves.
    There all closed loops converge to one equilibrium, exponentially at the rate κ. Its distance from the goal is at
    most `contraction.offset`, which is of the size of rounding if the goal is an equilibrium of u(0, ·).

    If u is computed in a `precision` that rounds, the inequality for V̇ holds for every value of u within its rounding,
    and F is computed with u in real numbers. Closed loops then converge not to an equilibrium but, as t → ∞ at the rate
    κ, into the ball of radius `distance_left` around the goal.

    With a disturbance (w_i > 0 for some i) the claim is about ẋ = F(x) + w(t) for every w(t) with |w_i(t)| ≤ w_i. V̇
    vanishes at the goal, but the disturbance does not: V need not fall in the hole {x ∈ D: V(x) < c}, there is no
    contraction, and

        V̇ ≤ V_xᵀF(x) + Σ_i w_i |∂V/∂x_i| ≤ −λ max(V(x), c) < 0   at each x ∈ D with c ≤ V(x) ≤ ρ.

    Hence no closed loop that starts in {x ∈ D: V(x) ≤ ρ} leaves it or violates a constraint, each enters
    {x ∈ D: V(x) ≤ c} within ln(ρ/c)/λ, and stays there: practical stability, with c as the ultimate bound. Convergence
    to the goal or to an equilibrium is not claimed. {x ∈ D: V(x) ≤ c} lies in the box `extent`.

    With readings, u is held in between, and the inequality holds for the control of each reading at x̂ ∈ D with
    V(x̂) ≤ ρ, at all times at which it may be in use (see Readings). Near the goal V need not fall under a held control,
    so the hole and the conclusions are those with a disturbance, which may be 0.

    A `practical` claim has these conclusions without a disturbance and with u read at every t, for a law that does not
    contract around the goal, or where this is not to be proved.

    With steps, the claim is about x_{k+1} = F(x_k), one step of the horizon's method with u(0, x_k) held, and not about
    the time between the steps. At each x ∈ D with V(x) ≤ ρ

        V(F(x)) ≤ (1 − λΔt) max(V(x), c)     and     F(x) ∈ D,

    V > ρ wherever some constraint has h_j ≥ 0, V > c on D without B, and F contracts on B. {V ≤ ρ} may touch the
    boundary of D. By induction V(x_k) ≤ max((1 − λΔt)^k V(x_0), c): no sequence of steps that starts in {x ∈ D: V ≤ ρ}
    leaves it, and each enters the closed set {x ∈ D: V ≤ c} ⊂ B and stays there. In this set all sequences converge to
    one fixed point of F by Banach's theorem, at the rate 1 − κΔt. A practical claim about steps needs no B, and says no
    more than that each sequence enters {x ∈ D: V ≤ c} and stays there.

    With plants, all of this holds for ẋ = F(x; p) with every constant p in a box P, where u and V depend on x alone.
    The region is the same for all p; each p has its own equilibrium, in the hole.

    Outside B, F may jump: the inequality holds for every value between the two sides of a jump, and so for Filippov's
    solutions.

    States on which none of f, g, V and u depends are ignorable: D is all of ℝ along them, and the claim does not bound
    them.

    The verdict is on the claim that the region contains X₀. For every verdict, `rho` is the largest proved level.
    """

    decay: float  # λ in 1/s
    states: Box  # D
    rho: float  # the largest proved level; −∞ if none is proved
    rim: float  # a lower bound of V on the boundary of D and where a constraint is violated; ρ < rim; ∞ if ρ may be any
    wanted: float  # an upper bound of max V on X₀, at most 0.1 % above it
    least: float  # the largest V among samples of X₀
    hole: float  # c; 0 without a hole
    contraction: Contraction | None  # None if none is proved, and for a practical claim
    slowest: float  # as contraction_around gives it, in 1/s; nan for a practical claim
    volume_share: float  # a lower bound of the share of X₀ in the region
    region_share: float  # a lower bound of the share of D in the region
    proof: Proof | None  # of the inequality for V̇; None without a hole
    seconds: float
    left_out: list[int]  # ignorable states
    constraints: Sequence[str] = ()
    disturbance: State | None = None  # w in units of ẋ, (n,); None without a disturbance
    extent: Box | None = None  # a box around {x ∈ D: V(x) ≤ c}, for a practical claim and a proved region
    ultimate_share: float = math.nan  # an upper bound of the share of D in {x ∈ D: V(x) ≤ c}
    plants: Plants | None = None  # None for a claim about one plant
    set_up: float = 0.0  # seconds of the budget before the first box
    precision: str | None = None  # the number type in which u is computed; None for real numbers
    distance_left: float = math.nan  # a bound of the distance from the goal as t → ∞, if u is rounded
    readings: Readings | None = None  # when u is read; None: at every t
    steps: Horizon | None = None  # Δt and method of the steps; None: continuous time
    is_practical: bool = False  # whether it is practical stability: closed loops enter {V ≤ c}, and stay there

    @property
    def entered_within(self) -> float:
        """An upper bound of the time in s until V ≤ c on each closed loop of the region; ∞ without a region.

        Of steps, (1 − λΔt)^k ≤ e^(−λkΔt) ≤ c/ρ for the first k with kΔt ≥ ln(ρ/c)/λ.
        """
        if not self.rho >= self.hole > 0:
            return math.inf
        within = math.log(self.rho / self.hole) / self.decay
        return just_above(within if self.steps is None else within + self.steps.dt)

    @property
    def counterexample(self) -> Counterexample | None:
        """The state of lowest V found at which V does not fall."""
        found = self._failure
        return None if found is None else found._replace(x=found.x[: self.states.dimension])

    @property
    def failing_plant(self) -> dict[str, float]:
        """The parameters of the counterexample."""
        if self._failure is None or self.plants is None:
            return {}
        return dict(zip(self.plants.nominal, self._failure.x[self.states.dimension :], strict=True))

    @property
    def _failure(self) -> Counterexample | None:
        """The counterexample in (x, p)."""
        return None if self.proof is None else self.proof.counterexample

    @property
    def undecided(self) -> Points:
        """Centres (t, x) or (t, x, p) of undecided boxes; all of them lie above ρ."""
        return torch.zeros(0, 1 + self.states.dimension) if self.proof is None else self.proof.undecided

    @property
    def verdict(self) -> Verdict:
        """The verdict on the claim that a sublevel set in D on which V falls contains X₀."""
        found = self.counterexample
        return verdict_on(self.rho, self.wanted, None if found is None else found.height, self.least)

    @property
    def reason(self) -> str | None:
        """The reason why the verdict is not certified, and advice."""
        if self.verdict == "certified":
            return None
        return self._reason_without_hole or self._reason_of_size

    @property
    def _reason_without_hole(self) -> str | None:
        """The reason why there is no hole; None if there is one."""
        if self.is_practical:
            return None if self.hole > 0 else (
                f"no levels c < ρ were found between which V(0, ·) falls{self._under_cause}: choose "
                f"{self._smaller}a smaller decay{self._parameter_advice}"
            )  # fmt: skip
        plants = "" if self.plants is None else " of all plants"
        if self.contraction is None and not self.slowest < 0:
            grows = f"an eigenvalue with real part {self.slowest:.3g} 1/s"
            if self.steps is not None:
                grows = f"a step with an eigenvalue of size {math.sqrt(1 + 2 * self.steps.dt * self.slowest):.3g}"
            return (
                f"u(0, x) does not stabilise the goal{plants}: its linearisation has {grows}; weigh every state in the "
                f"cost, train on a longer horizon, or from states all around the goal{self._parameter_advice}"
            )
        if self.contraction is None:
            return (
                f"no box around the goal was found in time on which u(0, x){plants} is proved to contract: claim "
                f"practical stability alone (--practical){self._parameter_advice}"
            )
        if not self.hole > 0:
            return "V(0, ·) is not positive around the goal, or this was not proved in time"
        return None

    @property
    def _reason_of_size(self) -> str:
        """The reason why the region does not contain X₀."""
        if self.verdict == "falsified" and self.is_practical:
            return (
                f"V(0, ·) does not fall at the rate λ there, at a level above c{self._under_cause}: choose "
                f"{self._smaller}a smaller decay{self._parameter_advice}"
            )
        if self.verdict == "falsified":
            leaves = "" if self.steps is None else ", or the step from there leaves D (then choose a larger set)"
            return (
                f"V(0, ·) does not fall at the rate λ there under u(0, ·){leaves}: train on a longer horizon, or from "
                f"states all around it, or choose a smaller decay{self._parameter_advice}"
            )
        if self.proof is not None and self.proof.remaining_volume > 0:
            return (
                f"{time_limit_reason(self.set_up)}: allow more; boxes next to another equilibrium always stay undecided"
            )
        if self.rim <= self.wanted:
            return "the bounds do not separate the region from the boundary of D or a constraint: choose a larger set"
        return "V(0, ·) does not fall close to the level that X₀ needs"

    @property
    def _under_cause(self) -> str:
        """What makes V rise, in words; empty without a disturbance and readings."""
        if self.readings is not None:
            return " under every age and error of a reading"
        return "" if self.disturbance is None else " under every disturbance"

    @property
    def _smaller(self) -> str:
        """Advice to reduce what makes V rise."""
        return "a smaller one, or " if self._under_cause else ""

    @property
    def _parameter_advice(self) -> str:
        """Further advice for a box of parameters."""
        return "" if self.plants is None else ", or narrower parameters"

    @property
    def volume(self) -> float:
        """A lower bound of the volume of the region, without ignorable states."""
        return self.region_share * self._volume_of_set

    @property
    def ultimate_volume(self) -> float:
        """An upper bound of the volume of {x ∈ D: V(x) ≤ c}, without ignorable states; nan without a disturbance."""
        return self.ultimate_share * self._volume_of_set

    @property
    def _volume_of_set(self) -> float:
        return math.prod(w for i, w in enumerate(self.states.widths.tolist()) if i not in self.left_out)


def _read_kept(file: Path | None, condition: RecedingDecrease, n: int) -> KeptRegion | None:
    """The numbers in the file of the same claim about n states; None if the file does not exist yet."""
    if file is None or not file.exists():
        return None
    kept = kept_region(file)
    kept.require(
        condition.decay, condition.disturbance, n, condition.parameter_names, condition.readings,
        condition.facts.get("steps"), condition.is_practical,
    )  # fmt: skip
    return kept


def prove_region(
    closed_loop: ClosedLoop,
    problem: Problem,
    decay: float | None = None,
    states: Box | None = None,
    budget: Budget | None = None,
    generator: torch.Generator | None = None,
    report: Callable[[Progress], None] | None = None,
    keep: Path | None = None,
    replay: bool = False,
    disturbance: State | None = None,
    plants: Plants | None = None,
    readings: Readings | None = None,
    steps: bool = False,
    practical: bool = False,
) -> ProvedRegion:
    """Prove the largest sublevel set of V(0, ·) that a budget allows as a region of attraction of the receding law.

    Args:
        closed_loop: a closed loop with a V; the claim is about its float64 copy.
        problem: gives X₀, the constraints and the goal.
        decay: λ > 0 in 1/s; 0.01/T if None.
        states: D, around X₀; by default a box around {V(0, ·) ≤ max V(0, ·) on X₀}.
        report, keep, replay: as in prove. If the file exists, B, Y, c and ρ are read from it and proved again.
        disturbance: w, (n,): the claim is about every ẋ = F + w(t) with |w_i(t)| ≤ w_i; w = 0 is no disturbance.
        plants: the claim is about each of these plants under the law and V of the nominal plant.
        readings: when u is read; None: at every t.
        steps: whether the claim is about the steps of the horizon's method, without disturbance and readings.
        practical: whether to claim that closed loops enter {V ≤ c} and stay there, and not that they converge; a claim
            with a disturbance or readings says no more anyway.

    Raises:
        UsageError: λ, w or D are unsuitable, the system is a family, an operator has no bound, or the file has another
            proof.
        Interrupted: Ctrl-C or SIGTERM; the message says whether the proof was kept.
    """
    started, budget, problem = time.monotonic(), budget or Budget(), copied(problem)
    if problem.system.constants:
        raise UsageError("Expected one system, got a family; choose one member of it (option at).")
    if steps and (disturbance is not None or readings is not None):
        raise UsageError("Expected steps alone, got a disturbance or readings, of continuous time; leave one out.")
    n, names = problem.system.n, [] if plants is None else list(plants.nominal)
    decay = PER_HORIZON / problem.horizon.duration if decay is None else decay
    w, loop = _nonzero_disturbance(disturbance, problem), copied(closed_loop).requires_grad_(False)
    if plants is not None:
        loop, problem = plants.all_of(loop, problem)
        states, w = states and plants.around(states), None if w is None else plants.disturbance_of_all(w)
        readings = readings and plants.readings_of_all(readings)
    stepped = problem if steps else None
    condition = (
        SteppedDecrease(loop, decay, problem, names, practical) if steps
        else RecedingDecrease(loop, decay, w, names, readings, practical)
    )  # fmt: skip
    goal, kept = problem.goal.double(), _read_kept(keep, condition, n)
    setting = find_setting(condition, problem, 0.0, states, budget, report)
    left_out, X0, wanted, D, domain, sides, *_ = setting
    _require_inside(D, goal, seen := [i for i in range(n) if i not in left_out], left_out, n)
    if kept is not None:
        kept.require_set(D, names)
    if isinstance(condition, SteppedDecrease):
        condition.keep_within(D, seen)
    rim = _level_of_boundary(
        condition.V, problem.constraints, domain, None if steps else sides, budget_for_level(budget)
    )
    contraction, slowest, level = _open_hole(condition, goal, setting, seen, rim, budget, kept)
    proof, rho, set_up = None, -math.inf, budget.elapsed
    if condition.hole > 0:
        options = {"generator": generator, "report": report, "keep": keep, "replay": replay}
        proof = prove_in_time(condition, domain, level, budget, **options)
        rho = proof.level if proof.level >= condition.hole else rho
    extent, ultimate = None, math.nan
    if condition.is_practical and rho > -math.inf:
        extent, ultimate = _ultimate_set(condition, D, n, budget)
    precision, distance = _rounding_effect(
        loop, closed_loop, contraction if rho > -math.inf else None, goal, D, seen, stepped
    )  # fmt: skip
    share = 1.0 if rho >= wanted else share_of(condition.V, X0.lower, X0.upper, rho, _half_of(budget))
    return ProvedRegion(
        decay=decay, states=first_states(D, n), rho=rho, rim=rim, wanted=wanted, least=largest_sample(condition.V, X0),
        hole=condition.hole, contraction=contraction, slowest=slowest, volume_share=share,
        region_share=share_of(condition.V, D.lower, D.upper, rho, budget), proof=proof,
        seconds=time.monotonic() - started, left_out=left_out, constraints=names_of(problem.constraints),
        disturbance=None if w is None else w[:n], extent=extent, ultimate_share=ultimate, plants=plants, set_up=set_up,
        precision=precision, distance_left=distance,
        readings=readings and replace(readings, errors=readings.errors[:n]), steps=problem.horizon if steps else None,
        is_practical=condition.is_practical,
    )  # fmt: skip


def _rounding_effect(
    loop: ClosedLoop,
    nominal: ClosedLoop,
    around: Contraction | None,
    goal: State,
    states: Box,
    seen: Sequence[int],
    stepped: Problem | None,
) -> tuple[str | None, float]:
    """`precision` and `distance_left` of ProvedRegion; `nominal` is the closed loop of the nominal plant."""
    precision = nominal.policy.precision if isinstance(nominal.policy, ValuePolicy) else None
    if precision is None or around is None:
        return precision, math.nan
    return precision, final_distance(loop, around, goal, states, seen, stepped)


def _ultimate_set(condition: RecedingDecrease, states: Box, n: int, budget: Budget) -> tuple[Box, float]:
    """(a box around {x ∈ D: V ≤ c}, an upper bound of the share of D in this set)."""
    D = at_centre(states, range(n, states.dimension))  # V is the same for all plants
    extent = extent_of(condition.V, D, condition.hole, _half_of(budget))
    return first_states(extent, n), 1 - share_of(
        lambda t, x: -condition.V(t, x), D.lower, D.upper, -condition.hole, _half_of(budget)
    )


def _nonzero_disturbance(disturbance: State | None, problem: Problem) -> State | None:
    """w in float64; None if it is 0."""
    if disturbance is None:
        return None
    require_disturbance(disturbance, problem.system.n)
    return disturbance.double() if bool((disturbance > 0).any()) else None


def _open_hole(
    condition: RecedingDecrease,
    goal: State,
    setting: Setting,
    seen: Sequence[int],
    rim: float,
    budget: Budget,
    kept: KeptRegion | None,
) -> tuple[Contraction | None, float, float]:
    """Open the hole: on a set where the law contracts; of a practical claim as large as required; or as in a file.

    Returns:
        (the contraction, `slowest` as in contraction_around, the level up to which to prove). For a practical claim the
        first two are None and nan.
    """
    levels = budget_for_level(budget)
    if condition.is_practical:
        level = _highest_level(condition, setting, rim, levels) if kept is None else kept.level(True, rim)
        hole = ultimate_level(condition, setting.domain, goal, level, levels) if kept is None else kept.hole
        condition.open_everywhere(hole)
        return None, math.nan, level
    seconds, proposed = (levels.seconds, None) if kept is None else (MAX_LEVEL_SECONDS, kept.contracting)
    stepped = condition.problem if isinstance(condition, SteppedDecrease) else None
    contraction, slowest = contraction_around(
        condition.closed_loop, goal, setting.states, seen, seconds, proposed, stepped
    )  # fmt: skip
    if kept is not None:
        level = kept.level(contraction is not None, rim)
    else:
        level = _highest_level(condition, setting, rim, budget_for_level(budget))
    if contraction is not None:
        condition.open_hole(contraction, setting.states, seen, level, budget_for_level(budget), kept and kept.hole)
    return contraction, slowest, level


def _highest_level(condition: RecedingDecrease, setting: Setting, rim: float, budget: Budget) -> float:
    """The level up to which to prove: just below rim; if any level is possible, one that V does not exceed on D."""
    if rim < math.inf:
        return just_below(rim)
    lower, upper = (side[None] for side in setting.domain)
    return -minimum(lambda t, x: -condition.V(t, x), lower, upper, budget, tolerance=LEVEL_TOLERANCE)


def _half_of(budget: Budget) -> Budget:
    """Half of the remaining budget."""
    return Budget(budget.left / 2, chunk=budget.chunk)


def _require_inside(states: Box, goal: State, seen: Sequence[int], left_out: Sequence[int], n: int) -> None:
    """Refuse a D without the goal in its interior, and ignorable parameters (the indices from n on)."""
    if any(i >= n for i in left_out):
        raise UsageError(
            "Expected parameters that change f or g, got one on which neither seems to depend; leave it out."
        )
    for i in seen:
        if not states.lower[i] < goal[i] < states.upper[i]:
            raise UsageError(
                f"Expected a set around the goal, got [{states.lower[i]:g}, {states.upper[i]:g}] around {goal[i]:g} at "
                f"index {i}; choose a larger one."
            )


def _level_of_boundary(
    V: Value,
    constraints: Constraints | None,
    domain: tuple[Corner, Corner],
    sides: tuple[Corners, Corners] | None,
    budget: Budget,
) -> float:
    """A lower bound of V on the boundary of D, if its sides are given, and on {x ∈ D: some h_j(x) ≥ 0}."""
    rim = math.inf if sides is None else minimum(V, *sides, budget)
    if constraints is None:
        return rim
    h, (lower, upper) = own_constraints(constraints, domain), (side[None] for side in domain)
    each = range(len(names_of(constraints)))
    return min(rim, *(minimum(V, lower, upper, budget, lambda t, x, j=j: -h(x)[..., j], 0.0) for j in each))
