"""Certificates of a controller, as `lyapnet certify` prints them: one object for each kind of claim."""

import math
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch

from lyapnet.certification import (
    Budget,
    Progress,
    SampledClaim,
    SoundClaim,
    StatisticalClaim,
    Tolerances,
    sampled_claim,
    sound_claim,
    statistical_claim,
)
from lyapnet.controller import Controller
from lyapnet.errors import OracleError, UsageError
from lyapnet.oracles import RiccatiOracle, oracle_of
from lyapnet.randomness import CERTIFICATION, stream
from lyapnet.sets import Box

OPTIONS: dict[str, dict[str, Any]] = {  # of each kind, with their defaults
    "sampled": {"samples": 100, "radius": None, "seed": 0},
    "statistical": {"samples": 10_000, "confidence": 1 - 1e-6, "share": 0.99, "radius": None, "seed": 0},
    "sound": {"alpha": 0.95, "delta": None, "set": None, "seconds": 60.0, "workers": 1, "keep": None, "seed": 0},
}
KINDS = tuple(OPTIONS)
COMPARED = 1000  # states of X₀ on which the guaranteed cost is held against the optimum
SEARCHED = 64  # of them, where each optimum is a search


class Rule(NamedTuple):
    """What an option may be, and what to do about one that is not."""

    holds: Callable[[float], bool]
    expected: str
    remedy: str


RULES = {
    "confidence": Rule(lambda c: 0 < c < 1, "strictly between 0 and 1", "for example 0.999999"),
    "share": Rule(lambda p: 0 < p <= 1, "in (0, 1]", "for example 0.99"),
    "radius": Rule(lambda r: 0 <= r < math.inf, "≥ 0", "give it in the norm of x"),
    "alpha": Rule(lambda a: 0 < a <= 1, "in (0, 1]", "V can pay for no more than the whole running cost"),
    "delta": Rule(lambda d: 0 <= d < math.inf, "≥ 0", "give it in cost per second"),
    "seconds": Rule(lambda s: 0 < s < math.inf, "> 0", "a proof needs some"),
}


@dataclass(frozen=True)
class Certificate:
    """A claim about a controller."""

    controller: Controller
    kind: str
    options: Mapping[str, Any]  # all of its kind, as options_of has them
    claim: SampledClaim | SoundClaim
    result: dict[str, Any]  # what `lyapnet certify --json` prints: plain data, None where there is no finite number


def options_of(kind: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """The options of a kind: what is given, None aside, and the defaults of the others.

    Raises:
        UsageError: an unknown kind; an option of another kind; a value out of range.
    """
    if kind not in OPTIONS:
        raise UsageError(f"Expected --kind as one of {', '.join(KINDS)}, got {kind!r}; choose one.")
    chosen = {name: value for name, value in given.items() if value is not None}
    for name, value in chosen.items():
        if name not in OPTIONS[kind]:
            kinds = " or ".join(k for k in KINDS if name in OPTIONS[k])
            raise UsageError(f"Expected --{name} with --kind {kinds}, got --kind {kind}; leave it out.")
        rule = RULES.get(name)
        if rule is not None and not rule.holds(value):
            raise UsageError(f"Expected --{name} {rule.expected}, got {value:g}; {rule.remedy}.")
    if "set" in chosen:
        parse_set(chosen["set"])
    return {**OPTIONS[kind], **chosen}


def command(checkpoint: str, kind: str, options: Mapping[str, Any], **user: str | None) -> str:
    """The command line that makes a certificate again, defaults written out.

    Args:
        user: `system` and `network`, where they are the user's own.
    """
    named = {name: value for name, value in {**options, **user}.items() if value is not None}
    return shlex.join(["lyapnet", "certify", checkpoint, f"--kind={kind}", *(f"--{n}={v}" for n, v in named.items())])


def certify(
    controller: Controller, kind: str, options: Mapping[str, Any], report: Callable[[Progress], None] | None = None
) -> Certificate:
    """The claim of a kind.

    Args:
        options: as options_of has them.
        report: hears how far a proof is.
    """
    if kind == "sound":
        claim, result = _sound(controller, **options, report=report)
    else:
        claim, result = {"sampled": _sampled, "statistical": _statistical}[kind](controller, **options)
    return Certificate(controller, kind, options, claim, _plain({"kind": kind, **result, "seed": options["seed"]}))


def default_tolerances(program: str, radius: float | None = None, cost: float = 0.05) -> Tolerances:
    """What success is by default.

    J within 5 % of V(0, x₀); ‖x(T)‖ within a radius, if one is given; and the decrease within 1 % of V(0, x₀), where
    the program is the Lyapunov program, which promises it.
    """
    return Tolerances(radius, 1e-2 if program == "lyapunov" else None, cost)


def default_delta(controller: Controller) -> float:
    """0.5 % of the mean running cost on X₀ at t = 0, in cost per second."""
    x0 = controller.initial_states.sample(COMPARED, stream(0, CERTIFICATION))
    return 0.005 * float(controller.cost.running(x0, controller.policy(0.0, x0)).mean())


def asked(tolerances: Tolerances) -> list[str]:
    """The single events that success consists of."""
    limits = {"decrease": tolerances.decrease, "terminal": tolerances.radius, "cost": tolerances.cost}
    return [event for event, limit in limits.items() if limit is not None]


def lower_bounds(claim: StatisticalClaim) -> dict[str, float]:
    """The bounds of a claim by the names they are printed under: of success, and of each event that is asked for."""
    bounds = claim.lower_bounds
    single = {f"{event}_lower_bound": bounds[event] for event in asked(claim.tolerances)}
    return {"probability_lower_bound": bounds["all"], **single}


def _sampled(
    controller: Controller, samples: int, radius: float | None, seed: int
) -> tuple[SampledClaim, dict[str, Any]]:
    tolerances, generator = default_tolerances(controller.config.program.name, radius), stream(seed, CERTIFICATION)
    claim = sampled_claim(controller.rollout, controller.initial_states, tolerances, samples, generator)
    return claim, _shares(claim)


def _statistical(
    controller: Controller, samples: int, confidence: float, share: float, radius: float | None, seed: int
) -> tuple[StatisticalClaim, dict[str, Any]]:
    tolerances, generator = default_tolerances(controller.config.program.name, radius), stream(seed, CERTIFICATION)
    claim = statistical_claim(
        controller.rollout, controller.initial_states, tolerances, samples, confidence, share, generator
    )
    return claim, {**_shares(claim), "confidence": confidence, "required_share": share, **lower_bounds(claim)}


def _sound(
    controller: Controller, alpha: float, delta: float | None, set: str | None, seconds: float, workers: int,
    keep: str | None, seed: int, report: Callable[[Progress], None] | None,
) -> tuple[SoundClaim, dict[str, Any]]:  # fmt: skip
    claim = sound_claim(
        controller.closed_loop, controller.initial_states, controller.horizon.duration, alpha,
        default_delta(controller) if delta is None else delta, None if set is None else parse_set(set),
        Budget(seconds, workers=workers), stream(seed, CERTIFICATION), report, None if keep is None else Path(keep),
    )  # fmt: skip
    names = controller.system.state_names
    return claim, {
        "verdict": claim.verdict, "alpha": claim.alpha, "delta": claim.delta, "duration": claim.duration,
        "rho": claim.rho if claim.volume_share else None, "rho_wanted": claim.wanted,
        "set": [claim.states.lower.tolist(), claim.states.upper.tolist()],
        "states_left_out": [names[i] for i in claim.left_out], "volume_share": claim.volume_share,
        "terminal_excess": claim.terminal_excess if claim.volume_share else None, "reason": claim.reason,
        "guaranteed_cost_ratio": _guaranteed_cost_ratio(controller, claim), "boxes": claim.boxes,
        "seconds": claim.seconds, "remaining_volume": claim.remaining_volume,
        "counterexample": None if claim.counterexample is None else claim.counterexample._asdict(),
    }  # fmt: skip


def _plain(value: Any) -> Any:
    """The value with None for every number that JSON does not have: NaN and the infinities."""
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


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


def _pairs(text: str) -> Sequence[Sequence[str]]:
    return [part.split(":") for part in text.split(",")]


def _shares(claim: SampledClaim) -> dict[str, Any]:
    return {
        "verdict": claim.verdict, "samples": claim.samples,
        **{f"{e}_share": share for e, share in claim.shares.items() if e in (*asked(claim.tolerances), "all")},
        "tolerances": asdict(claim.tolerances),
        "failure": claim.failures[0].tolist() if len(claim.failures) else None,
    }  # fmt: skip


def _guaranteed_cost_ratio(controller: Controller, claim: SoundClaim) -> float | None:
    """Mean guaranteed cost over the mean optimum of the discretised task, on states of X₀ inside the funnel.

    None where there is no funnel or no oracle. A search by IPOPT takes fewer states, and the controller's help.
    """
    x0 = controller.initial_states.sample(COMPARED, stream(1, CERTIFICATION))
    guaranteed = claim.guaranteed_cost(controller.value(0.0, x0).double())
    x0, guaranteed = x0[guaranteed.isfinite()], guaranteed[guaranteed.isfinite()]
    if not len(x0):
        return None
    try:
        oracle = oracle_of(controller.system, controller.cost, controller.horizon, controller.config.rollout.method)
        if not isinstance(oracle, RiccatiOracle):
            x0, guaranteed = x0[:SEARCHED], guaranteed[:SEARCHED]
        optima = oracle.solve(x0, controller.rollout(x0).u)
    except OracleError:
        return None
    found = optima.cost.isfinite()
    return float(guaranteed[found].mean() / optima.cost[found].mean()) if found.any() else None
