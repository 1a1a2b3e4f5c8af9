"""Certificates by proof: a funnel, and the cost that it guarantees."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from lyapnet.base.contracts import copied
from lyapnet.base.errors import OracleError, UsageError
from lyapnet.base.random_streams import CERTIFICATION, stream
from lyapnet.base.types import Corner, PerState, State
from lyapnet.claims import figures
from lyapnet.claims.certificates import FROZEN, NOT_PROVED, Certificate
from lyapnet.claims.funnel import SoundClaim, sound_claim
from lyapnet.claims.preconditions import over_time, require_goal
from lyapnet.claims.tables import floored
from lyapnet.controller.controller import Controller
from lyapnet.evaluation.optimality import ratio_of_means
from lyapnet.evaluation.oracles import RiccatiOracle, oracle_of
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.prover.condition import DecreaseCondition
from lyapnet.prover.proof import Progress
from lyapnet.task.sets import Box

COMPARED = 1000  # states of X₀ on which the guaranteed cost is held against the optimum
SEARCHED = 64  # of them, where each optimum is a search


class SoundCertificate(Certificate):
    """A funnel that no closed loop leaves, and its cost."""

    kind: ClassVar[str] = "sound"
    picture: ClassVar[str] = "funnel.png"
    labels: ClassVar[Mapping[str, str]] = {
        "reason": "why",
        "alpha": "α",
        "delta": "δ, cost per second",
        "disturbance": "disturbances, at most",
        "set": "D",
        "states_left_out": "states that nothing depends on",
        "rho_wanted": "ρ for all of X₀",
        "rho": "largest ρ proved",
        "volume_share": "share of X₀ in that funnel, at least",
        "constraints": "constraints that no closed loop of the funnel violates",
        "crossing_level": "V − δt where one could be violated, at least",
        "violation": "a closed loop from X₀ that violates one",
        "terminal_excess": "κ, cost at T beyond V(T, ·)/α, at most",
        "guaranteed_cost_ratio": "guaranteed cost there / optimum, ratio of the means",
        "counterexample": "counterexample of lowest V − δt",
        "remaining_volume": "share of [0, T] × D undecided",
        "boxes": "boxes",
        "seconds": "seconds",
        "fingerprint": "fingerprint of what was bounded",
    }
    claim: SoundClaim

    @property
    def complete(self) -> bool:
        """Whether there is nothing more to prove: a funnel holds all of X₀."""
        return self.verdict == "certified"

    def sought(self) -> tuple[DecreaseCondition, tuple[Corner, Corner], float]:
        """The condition in plain arithmetic, [0, T] × D, and the level up to which it was to hold."""
        claim = self.claim
        loop = copied(self.controller.closed_loop)
        condition = DecreaseCondition(loop, claim.alpha, claim.delta, disturbance=claim.disturbance)
        return condition, over_time(claim.states, claim.duration), claim.wanted

    def numbers(self) -> dict[str, Any]:
        return {**self.proved(), "guaranteed_cost_ratio": self.compared.ratio}

    @cached_property
    def compared(self) -> "Compared":
        """The guaranteed cost against the optimum, which is beside the claim."""
        return compared_to_optima(self.controller, self.claim, max(1.0, 0.1 * self.options["seconds"]))

    def proved(self) -> dict[str, Any]:
        """The numbers of the claim, without the optimum, which takes an oracle."""
        claim, names = self.claim, self.controller.system.state_names
        kept = {
            "constraints": list(claim.constraints) if claim.volume_share else [], "crossing_level": claim.crossing,
            "violation": None if claim.violation is None else claim.violation._asdict(),
        } if claim.constraints else {}  # fmt: skip
        return {
            "alpha": claim.alpha, "delta": claim.delta, "disturbance": self.pushes, "duration": claim.duration,
            "rho": claim.rho if claim.volume_share else None, "rho_wanted": claim.wanted,
            "set": [claim.states.lower.tolist(), claim.states.upper.tolist()],
            "states_left_out": [names[i] for i in claim.left_out], "volume_share": claim.volume_share,
            "terminal_excess": claim.terminal_excess if claim.volume_share else None, "reason": claim.reason,
            "boxes": claim.boxes, "seconds": claim.seconds, "remaining_volume": claim.remaining_volume,
            "counterexample": None if claim.counterexample is None else claim.counterexample._asdict(),
            "fingerprint": claim.fingerprint, **kept,
        }  # fmt: skip

    @property
    def pushes(self) -> dict[str, float]:
        """The disturbed states and how much their derivatives are pushed at most."""
        return named_pushes(self.claim.disturbance, self.controller.system.state_names)

    def in_words(self) -> str:
        claim = self.claim
        if not claim.volume_share:
            return NOT_PROVED
        return (
            f"{{V(0, ·) ≤ ρ}} with ρ = {claim.rho!r} is the mouth of a funnel, proved in continuous time for this "
            f"model: no closed loop that starts in it leaves the funnel, or D,{self._or_violates} up to "
            f"T = {claim.duration:g} s, {self._however_pushed}and its cost is bounded as below. It holds at least "
            f"{floored(claim.volume_share)} of X₀ by volume. It is about the operations that f, g, ℓ, V and u were "
            f"traced to, of this fingerprint; {FROZEN}{self.of_parameters}"
            f"{' ' * bool(claim.assumed)}{claim.assumed}"
        )

    @property
    def _however_pushed(self) -> str:
        """What the claim adds about disturbances."""
        return f"{however_pushed(self.pushes)}, " if self.pushes else ""

    @property
    def _or_violates(self) -> str:
        """What else no closed loop of the funnel does."""
        return f" or violates a constraint ({'; '.join(self.claim.constraints)})," if self.claim.constraints else ""

    def in_formulas(self) -> list[str]:
        claim = self.claim
        # unrounded, as proved
        alpha, delta, T = (f"{value!r}".removesuffix(".0") for value in (claim.alpha, claim.delta, claim.duration))
        rho, kappa = (repr(claim.rho), repr(claim.terminal_excess)) if claim.volume_share else ("ρ", "κ")
        kept = ("  and  h(x) ≤ 0", "  and  h(x(t)) ≤ 0", "  and  h(x₀) ≤ 0") if self.claim.constraints else [""] * 3
        return [
            f"V_t + V_xᵀ(f + g u){' + Σ w_i |∂V/∂x_i|' if self.pushes else ''} + {alpha} ℓ(x, u) ≤ {delta}  "
            f"at each (t, x) ∈ [0, {T}] × D with V(t, x) ≤ {rho} + {delta} t{kept[0]}",
            f"V(t, x(t)) ≤ {rho} + {delta} t{kept[1]}  and  x(t) ∈ D  from each x₀ ∈ D with V(0, x₀) ≤ {rho}{kept[2]}",
            f"J(x₀) ≤ (V(0, x₀) + {delta} · {T}) / {alpha} + {kappa}  from the same x₀",
        ]

    def of_the_verdict(self) -> str:
        found, violation = self.claim.counterexample, self.claim.violation
        if violation is not None:
            return (
                "The verdict is on the claim that no closed loop from X₀ violates a constraint: the one from "
                f"x₀ = {listed(violation.x0)} does at t = {violation.t:.6g} s, {violation.constraint}, by h = "
                f"{violation.h:.3g} (Runge-Kutta steps of a quarter of Δt)."
            )
        why = {
            "certified": "it does",
            "falsified": "the condition fails inside the funnel that this would take",
            "unknown": "undecided within the budget",
        }[self.verdict]
        where = ""
        if found is not None:
            where = f" At t = {found.t:.6g} s, x = {listed(found.x)} it fails by {found.condition:.3g}."
        return f"The verdict is on the claim that a funnel holds all of X₀: {why}.{where}"

    def figure(self) -> figures.Figure:
        controller, problem = self.controller, self.controller.problem
        labels = controller.system.state_labels
        return figures.funnel(
            self.claim, controller.V, problem.initial_states, problem.goal, labels, problem.constraints
        )


def named_pushes(w: State | None, names: Sequence[str]) -> dict[str, float]:
    """The disturbed states and how much their derivatives are pushed at most."""
    return {} if w is None else {names[i]: float(w[i]) for i in range(len(w)) if w[i] > 0}


def however_pushed(pushes: Mapping[str, float]) -> str:
    """What a claim says of disturbances."""
    each = ", ".join(f"of at most {w!r} on d({name})/dt" for name, w in pushes.items())
    return f"whatever pushes there are, {each}"


def listed(x: Sequence[float]) -> str:
    """A state in a sentence."""
    return f"({', '.join(f'{entry:.6g}' for entry in x)})"


def sound_certificate(
    controller: Controller,
    alpha: float = 0.95,
    delta: float | None = None,
    set: str | None = None,
    seconds: float = 60.0,
    workers: int = 1,
    device: str = "cpu",
    disturbance: Sequence[str] | None = None,
    keep: str | None = None,
    seed: int = 0,
    report: Callable[[Progress], None] | None = None,
    *,
    ray: str | None = None,
    started: float | None = None,
) -> SoundCertificate:
    """The sound claim about a controller.

    Args:
        alpha: the share of ℓ that V pays for.
        delta: slack in cost per second; default_delta if None.
        set: D, as parse_set reads it; found if None.
        seconds: when to stop undecided, set-up and what follows the proof included.
        workers, device: of Budget.
        disturbance: STATE=w for each ẋ_i that is pushed by at most w.
        keep: a file in which an unfinished proof is kept.
        report: is told how far the proof is.
        ray: of Budget.
        started: time.monotonic() from which the seconds count; now if None.
    """
    require_goal(controller.problem, "sound")
    begun = time.monotonic() if started is None else started
    budget = Budget(seconds, workers=workers, device=device, ray=ray, started=begun)
    claim = sound_claim(
        controller.closed_loop, controller.problem, alpha,
        default_delta(controller) if delta is None else delta, None if set is None else parse_set(set),
        budget, stream(seed, CERTIFICATION), report, None if keep is None else Path(keep),
        disturbance=parse_disturbance(disturbance or (), controller),
    )  # fmt: skip
    options = {
        "alpha": alpha, "delta": delta, "set": set, "seconds": seconds, "workers": workers, "device": device,
        "ray": ray, "disturbance": list(disturbance or ()) or None, "keep": keep, "seed": seed,
    }  # fmt: skip
    return SoundCertificate(controller, claim, options)


def default_delta(controller: Controller) -> float:
    """0.5 % of the mean running cost on X₀ at t = 0, in cost per second."""
    x0 = controller.initial_states.sample(COMPARED, stream(0, CERTIFICATION))
    return 0.005 * float(controller.cost.running(x0, controller.policy(0.0, x0)).mean())


def parse_set(text: str) -> Box:
    """The box that "-1:1,-0.7:0.7" names: bounds of each state, in the order of the system.

    Raises:
        UsageError: it names none.
    """
    try:
        lower, upper = zip(*((float(low), float(high)) for low, high in _pairs(text)), strict=True)
        return Box(torch.tensor(lower, dtype=torch.float64), torch.tensor(upper, dtype=torch.float64))
    except ValueError as error:
        raise UsageError(
            f"Expected --set as lower:upper for each state, got {text!r}; for example --set=-1.6:1.6,-2.6:2.6."
        ) from error


def parse_disturbance(named: Sequence[str], controller: Controller) -> State | None:
    """w from "velocity=0.1" for each state that is pushed; None where none is.

    Raises:
        UsageError: a name that is no state, or no number.
    """
    names, w = controller.system.state_names, torch.zeros(controller.system.n, dtype=torch.float64)
    for text in named:
        name, _, value = text.partition("=")
        if name not in names:
            raise UsageError(f"Expected --disturbance STATE=W of {', '.join(names)}, got {text!r}; name one of them.")
        try:
            w[names.index(name)] = float(value)
        except ValueError as error:
            raise UsageError(
                f"Expected --disturbance STATE=W with a number, got {text!r}; for example {name}=0.1."
            ) from error
    return w if named else None


def _pairs(text: str) -> Sequence[Sequence[str]]:
    return [part.split(":") for part in text.split(",")]


class Inside(NamedTuple):
    """States of X₀ inside a funnel, with V(0, x₀) and the guaranteed cost."""

    x0: State
    value: PerState
    guaranteed: PerState


def states_inside(controller: Controller, claim: SoundClaim) -> Inside:
    """As many of some states of X₀ as a funnel holds."""
    x0 = controller.initial_states.sample(COMPARED, stream(1, CERTIFICATION))
    value = controller.value(0.0, x0).double()
    guaranteed = claim.guaranteed_cost(value)
    return Inside(*(y[guaranteed.isfinite()] for y in (x0, value, guaranteed)))


class Compared(NamedTuple):
    """States of X₀ inside a funnel: V(0, x₀), the guaranteed cost, and the optimum of the first of them."""

    value: PerState
    guaranteed: PerState
    optimum: PerState | None  # of the discretised task; None where there is no oracle, or it takes longer

    @property
    def ratio(self) -> float | None:
        """Mean guaranteed cost over the mean optimum."""
        if self.optimum is None:
            return None
        return ratio_of_means(self.guaranteed[: len(self.optimum)], self.optimum)


def compared_to_optima(controller: Controller, claim: SoundClaim, seconds: float = math.inf) -> Compared:
    """The guaranteed cost of states of X₀ inside a funnel, held against their optima."""
    x0, value, guaranteed = states_inside(controller, claim)
    return Compared(value, guaranteed, optima_of(controller, x0, seconds))


def optima_of(controller: Controller, x0: State, seconds: float = math.inf) -> Tensor | None:
    """The optimum of the first of some states; None where there are no states or no oracle, or it takes longer.

    A search by IPOPT takes fewer states, and the controller's help.
    """
    end = time.monotonic() + seconds

    def in_time(done: int, total: int) -> None:
        if done < total and time.monotonic() > end:
            raise OracleError("Expected the optimum within the budget, got none; allow more seconds.")

    if not len(x0):
        return None
    try:
        oracle = oracle_of(controller.problem, controller.method)
        some = x0 if isinstance(oracle, RiccatiOracle) else x0[:SEARCHED]
        return oracle.solve(some, controller.rollout(some).u, in_time).cost.double()
    except OracleError:
        return None
