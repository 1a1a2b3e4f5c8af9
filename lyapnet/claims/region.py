"""The region of attraction of the receding law u(0, x): a sublevel set of V(0, ·) that is never left."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from lyapnet.base.contracts import copied
from lyapnet.base.errors import UsageError
from lyapnet.base.types import Corner, Corners, Points, State, Value
from lyapnet.claims.contraction import Contraction, contraction_around, distance_left
from lyapnet.claims.funnel import (
    LEVELS,
    Setting,
    for_levels,
    largest_seen,
    proof_within,
    require_disturbance,
    setting_of,
    share_of,
)
from lyapnet.claims.kept_regions import KeptRegion, kept_region
from lyapnet.claims.plants import Plants
from lyapnet.claims.preconditions import at_centre, first_of
from lyapnet.claims.receding_decrease import RecedingDecrease
from lyapnet.claims.ultimate_bound import extent_of, ultimate_level
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.prover.branch_and_bound import Budget, just_above, just_below, minimum
from lyapnet.prover.condition import own_constraints
from lyapnet.prover.counterexamples import Counterexample
from lyapnet.prover.proof import Progress, Proof
from lyapnet.prover.verdict import Verdict, time_spent, verdict_on
from lyapnet.task.constraints import Constraints, names_of
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box
from lyapnet.value.policy import ValuePolicy

PER_HORIZON = 0.01  # λT, unless it is given


@dataclass(frozen=True, kw_only=True)
class ProvedRegion:
    """Of the receding law u(0, x), read at every t, with V(x) = V(0, x), F = f + g u(0, ·) and levels ρ ≥ c > 0:

    at each x ∈ D with V(x) ≤ ρ, outside the hole {x ∈ B: V(x) < c},

        V̇ = V_xᵀF(x) ≤ −λ max(V(x), c) < 0,

    V > ρ on the boundary of D and wherever a constraint has h_j ≥ 0, V > c on the boundary of a box B around the goal,
    and F contracts on B (Contraction). Hence {x ∈ D: V(x) ≤ ρ} is a region of attraction: no closed loop that starts in
    it leaves it or violates a constraint, V falls until the hole is reached, none leaves the hole, and there all go to
    one equilibrium exponentially, at the rate κ, for ever. It is within `contraction.offset` of the goal: rounding,
    where the goal is an equilibrium of u(0, ·) itself.

    Where u is computed in a `precision` that rounds, V̇ ≤ … holds of every value that rounding may leave of u; F is that
    of u in real numbers. Closed loops then go to no equilibrium, but all come, at the rate κ, within `distance_left` of
    the goal, as t → ∞.

    With a disturbance, w_i > 0 for some i, the claim is about ẋ = F(x) + w(t), whatever w(t) is, with |w_i(t)| ≤ w_i.
    Pushes do not fade at the goal, where V̇ does: V need not fall in the hole {x ∈ D: V(x) < c}, nothing contracts, and

        V̇ ≤ V_xᵀF(x) + Σ_i w_i |∂V/∂x_i| ≤ −λ max(V(x), c) < 0   at each x ∈ D with c ≤ V(x) ≤ ρ.

    Hence no closed loop that starts in {x ∈ D: V(x) ≤ ρ} leaves it or violates a constraint, each enters
    {x ∈ D: V(x) ≤ c} within ln(ρ/c)/λ, and stays there: practical stability, with c as the ultimate bound. No
    equilibrium is claimed, nor that any closed loop goes to the goal. {x ∈ D: V(x) ≤ c} lies in the box `extent`.

    With plants, all of that holds for ẋ = F(x; p) with every constant p of a box P, where u and V see x alone: one set
    and one V for all p at once, and one equilibrium for each p, in the hole, within `contraction.offset` of the goal.

    Outside B, F may jump: V̇ ≤ … holds of every value between, so that it is about Filippov's solutions.

    States that neither f, g, nor V and u depend on are left out: D is all of ℝ along them, and nothing is said of where
    they go.

    The verdict is about X₀: whether such a region holds all of it. Whatever it is, `rho` is the largest level proved.
    """

    decay: float  # λ in 1/s
    states: Box  # D
    rho: float  # the largest level proved; −∞ where there is none
    rim: float  # a lower bound of V on the boundary of D and where a constraint is violated: no ρ is higher
    wanted: float  # max V on X₀, or up to 0.1 % more
    least: float  # the largest V that was seen on X₀
    hole: float  # c; 0 where there is none
    contraction: Contraction | None  # none is sought with a disturbance
    slowest: float  # the largest real part among the eigenvalues of the linearised law, in 1/s; nan with a disturbance
    volume_share: float  # of X₀ in the region; a lower bound
    region_share: float  # of D in it; a lower bound
    proof: Proof | None  # that V falls; none is tried where nothing contracts
    seconds: float
    left_out: list[int]  # ignorable states
    constraints: Sequence[str] = ()
    disturbance: State | None = None  # w in units of ẋ, (n,); None where nothing is pushed
    extent: Box | None = None  # around {x ∈ D: V(x) ≤ c}, with a disturbance and where ρ ≥ c; 0 along states left out
    ultimate_share: float = math.nan  # of D in {x ∈ D: V(x) ≤ c}; an upper bound
    plants: Plants | None = None  # P; None where it is about one plant
    set_up: float = 0.0  # seconds of the budget before the first box
    precision: str | None = None  # in which u is computed; None in real numbers
    distance_left: float = math.nan  # of closed loops from the goal in the end, where u is rounded and none is pushed

    @property
    def entered_within(self) -> float:
        """Seconds after which each closed loop of the region has V ≤ c, at most; ∞ where there is no region."""
        if not self.rho >= self.hole > 0:
            return math.inf
        return just_above(math.log(self.rho / self.hole) / self.decay)

    @property
    def counterexample(self) -> Counterexample | None:
        """Where V does not fall, of lowest V."""
        found = self._failure
        return None if found is None else found._replace(x=found.x[: self.states.dimension])

    @property
    def failing_plant(self) -> dict[str, float]:
        """The parameters with which it does not."""
        if self._failure is None or self.plants is None:
            return {}
        return dict(zip(self.plants.nominal, self._failure.x[self.states.dimension :], strict=True))

    @property
    def _failure(self) -> Counterexample | None:
        """The counterexample in (x, p)."""
        return None if self.proof is None else self.proof.counterexample

    @property
    def undecided(self) -> Points:
        """Centres (t, x), or (t, x, p), of boxes that remain; all of them lie above ρ."""
        return torch.zeros(0, 1 + self.states.dimension) if self.proof is None else self.proof.undecided

    @property
    def verdict(self) -> Verdict:
        """On the claim that a sublevel set in D on which V falls so holds all of X₀; not on whether X₀ is attracted."""
        found = self.counterexample
        return verdict_on(self.rho, self.wanted, None if found is None else found.height, self.least)

    @property
    def reason(self) -> str | None:
        """Why the verdict is not certified, and what may help."""
        if self.verdict == "certified":
            return None
        return self._why_it_does_not_hold_the_goal or self._why_it_is_small

    @property
    def _why_it_does_not_hold_the_goal(self) -> str | None:
        """Why there is no hole, where there is none."""
        if self.disturbance is not None:
            return None if self.hole > 0 else (
                "no levels c < ρ were found between which V(0, ·) falls whatever the pushes, so that nothing is left: "
                f"allow a smaller --disturbance, or a smaller --decay{self._or_narrow}"
            )  # fmt: skip
        plants = "" if self.plants is None else " of all plants"
        if self.contraction is None and not self.slowest < 0:
            return (
                f"u(0, x) does not hold the goal{plants}: linearised, an eigenvalue has the real part "
                f"{self.slowest:.3g} 1/s; weigh every state, train on a longer horizon, or from states all around the "
                f"goal{self._or_narrow}"
            )
        if self.contraction is None:
            return (
                f"no box around the goal was found on which u(0, x){plants} is seen to contract, in the time for it"
                f"{self._or_narrow}"
            )
        if not self.hole > 0:
            return "V(0, ·) is not above 0 around the goal, or not seen to be in the time for it"
        return None

    @property
    def _why_it_is_small(self) -> str:
        """Why it does not hold all of X₀."""
        if self.verdict == "falsified" and self.disturbance is not None:
            return (
                "V(0, ·) does not fall at the rate λ there, at a level above c, under the worst push: allow a smaller "
                f"--disturbance, or a smaller --decay{self._or_narrow}"
            )
        if self.verdict == "falsified":
            return (
                "V(0, ·) does not fall at the rate λ there under u(0, ·): train on a longer horizon, or from states "
                f"all around it, or allow a smaller --decay{self._or_narrow}"
            )
        if self.proof is not None and self.proof.remaining_volume > 0:
            return f"{time_spent(self.set_up)}: allow more; beside another equilibrium some boxes always stay undecided"
        if self.rim <= self.wanted:
            return "the region meets the boundary of D or a constraint, as far as bounds tell: choose a larger set"
        return "V(0, ·) does not fall close to what X₀ needs"

    @property
    def _or_narrow(self) -> str:
        """What else may help, where it is about a box of parameters."""
        return "" if self.plants is None else ", or narrow --parameter"

    @property
    def volume(self) -> float:
        """That of the region, without the states that are left out; a lower bound."""
        return self.region_share * self._volume_of_set

    @property
    def ultimate_volume(self) -> float:
        """That of {x ∈ D: V(x) ≤ c}, without the states that are left out; an upper bound, nan where there is none."""
        return self.ultimate_share * self._volume_of_set

    @property
    def _volume_of_set(self) -> float:
        return math.prod(w for i, w in enumerate(self.states.widths.tolist()) if i not in self.left_out)


def _kept(file: Path | None, decay: float, w: State | None, n: int, names: Sequence[str]) -> KeptRegion | None:
    """What a file keeps of the same question; None where there is none yet."""
    if file is None or not file.exists():
        return None
    kept = kept_region(file)
    kept.require(decay, w, n, names)
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
) -> ProvedRegion:
    """The largest region of attraction of the receding law that is a sublevel set of V(0, ·), as the budget allows.

    Args:
        closed_loop: with the law of a V; its float64 copy is what the claim is about.
        problem: whose X₀, constraints and goal are meant.
        decay: λ > 0 in 1/s; 1 % of 1/T if None.
        states: D, around X₀; by default a box around {V(0, ·) ≤ max over X₀}.
        report, keep, replay: of prove. B, Y, c and ρ are those of the file that goes on, proved anew by bounds.
        disturbance: w, (n,): the claim is about every ẋ = F + w(t) with |w_i(t)| ≤ w_i; with w = 0 it is as without.
        plants: P: the claim is about each of these plants under the law and V of the one plant.

    Raises:
        UsageError: λ, w or D do not fit, it is a family, an operator has no rule, or the file keeps another proof.
        Interrupted: Ctrl-C or SIGTERM; says what is kept.
    """
    started, budget, problem = time.monotonic(), budget or Budget(), copied(problem)
    if problem.system.constants:
        raise UsageError("Expected one system, got a family; choose a member with --at NAME=VALUE.")
    n, names = problem.system.n, [] if plants is None else list(plants.nominal)
    decay = PER_HORIZON / problem.horizon.duration if decay is None else decay
    w, loop = _pushes(disturbance, problem), copied(closed_loop).requires_grad_(False)
    if plants is not None:
        loop, problem = plants.all_of(loop, problem)
        states, w = states and plants.around(states), None if w is None else plants.pushed(w)
    condition = RecedingDecrease(loop, decay, w, names)
    goal, kept = problem.goal.double(), _kept(keep, decay, w, n, names)
    setting = setting_of(condition, problem, 0.0, states, budget, report)
    left_out, X0, wanted, D, domain, sides, *_ = setting
    _require_inside(D, goal, seen := [i for i in range(n) if i not in left_out], left_out, n)
    if kept is not None:
        kept.require_set(D, names)
    rim = _rim(condition.V, problem.constraints, domain, sides, for_levels(budget))
    contraction, slowest, level = _open(condition, goal, setting, seen, rim, budget, kept)
    proof, rho, set_up = None, -math.inf, budget.elapsed
    if condition.hole > 0:
        options = {"generator": generator, "report": report, "keep": keep, "replay": replay}
        proof = proof_within(condition, domain, level, budget, **options)
        rho = proof.level if proof.level >= condition.hole else rho
    extent, ultimate = (None, math.nan) if w is None or rho == -math.inf else _end(condition, D, n, budget)
    precision, distance = _rounding(loop, closed_loop, contraction if rho > -math.inf else None, goal, D, seen)
    share = 1.0 if rho >= wanted else share_of(condition.V, X0.lower, X0.upper, rho, _half(budget))
    return ProvedRegion(
        decay=decay, states=first_of(D, n), rho=rho, rim=rim, wanted=wanted, least=largest_seen(condition.V, X0),
        hole=condition.hole, contraction=contraction, slowest=slowest, volume_share=share,
        region_share=share_of(condition.V, D.lower, D.upper, rho, budget), proof=proof,
        seconds=time.monotonic() - started, left_out=left_out, constraints=names_of(problem.constraints),
        disturbance=None if w is None else w[:n], extent=extent, ultimate_share=ultimate, plants=plants, set_up=set_up,
        precision=precision, distance_left=distance,
    )  # fmt: skip


def _rounding(
    loop: ClosedLoop, one: ClosedLoop, around: Contraction | None, goal: State, states: Box, seen: Sequence[int]
) -> tuple[str | None, float]:
    """(the precision of u, the distance from the goal that it leaves), as of ProvedRegion; `one` is of one plant."""
    precision = one.policy.precision if isinstance(one.policy, ValuePolicy) else None
    if precision is None or around is None:
        return precision, math.nan
    return precision, distance_left(loop, around, goal, states, seen)


def _end(condition: RecedingDecrease, states: Box, n: int, budget: Budget) -> tuple[Box, float]:
    """(a box around {x ∈ D: V ≤ c}, the share of D in it, at most)."""
    one = at_centre(states, range(n, states.dimension))  # V is the same for all plants
    extent = extent_of(condition.V, one, condition.hole, _half(budget))
    return first_of(extent, n), 1 - share_of(
        lambda t, x: -condition.V(t, x), one.lower, one.upper, -condition.hole, _half(budget)
    )


def _pushes(disturbance: State | None, problem: Problem) -> State | None:
    """w in float64; None where it is 0."""
    if disturbance is None:
        return None
    require_disturbance(disturbance, problem.system.n)
    return disturbance.double() if bool((disturbance > 0).any()) else None


def _open(
    condition: RecedingDecrease,
    goal: State,
    setting: Setting,
    seen: Sequence[int],
    rim: float,
    budget: Budget,
    kept: KeptRegion | None,
) -> tuple[Contraction | None, float, float]:
    """Open the hole: around the goal where the law contracts, or as wide as pushes ask for; that of a file, if any.

    Returns:
        (the contraction, the largest real part of the linearised law's eigenvalues, the level to be tried); None and
        nan with a disturbance.
    """
    levels = for_levels(budget)
    if condition.disturbance is not None:
        level = just_below(rim) if kept is None else kept.level(True, rim)
        found = ultimate_level(condition, setting.domain, goal, level, levels) if kept is None else kept.hole
        condition.open_everywhere(found)
        return None, math.nan, level
    seconds, proposed = (levels.seconds, None) if kept is None else (LEVELS, kept.contracting)
    contraction, slowest = contraction_around(condition.closed_loop, goal, setting.states, seen, seconds, proposed)
    level = just_below(rim) if kept is None else kept.level(contraction is not None, rim)
    if contraction is not None:
        condition.open_hole(contraction, setting.states, seen, level, for_levels(budget), kept and kept.hole)
    return contraction, slowest, level


def _half(budget: Budget) -> Budget:
    """Half of what is left."""
    return Budget(budget.left / 2, chunk=budget.chunk)


def _require_inside(states: Box, goal: State, seen: Sequence[int], left_out: Sequence[int], n: int) -> None:
    """Refuse a D that has not the goal in its interior, and parameters, which follow n states, that are left out."""
    if any(i >= n for i in left_out):
        raise UsageError("Expected parameters that f or g depends on, got one that hides it; leave it out.")
    for i in seen:
        if not states.lower[i] < goal[i] < states.upper[i]:
            raise UsageError(
                f"Expected a set around the goal, got [{states.lower[i]:g}, {states.upper[i]:g}] around {goal[i]:g} at "
                f"index {i}; choose a larger one."
            )


def _rim(
    V: Value,
    constraints: Constraints | None,
    domain: tuple[Corner, Corner],
    sides: tuple[Corners, Corners],
    budget: Budget,
) -> float:
    """A lower bound of V on the boundary of D, and where some h_j ≥ 0 in it."""
    rim = minimum(V, *sides, budget)
    if constraints is None:
        return rim
    h, (lower, upper) = own_constraints(constraints, domain), (side[None] for side in domain)
    each = range(len(names_of(constraints)))
    return min(rim, *(minimum(V, lower, upper, budget, lambda t, x, j=j: -h(x)[..., j], 0.0) for j in each))
