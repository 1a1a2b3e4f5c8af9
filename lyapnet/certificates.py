"""Certificates of a controller, as `lyapnet certify` prints them: one object for each kind of claim."""

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import torch

from lyapnet.certification import (
    Budget,
    SampledClaim,
    SoundClaim,
    StatisticalClaim,
    Tolerances,
    sampled_claim,
    sound_claim,
    statistical_claim,
)
from lyapnet.controller import Controller
from lyapnet.errors import UsageError
from lyapnet.oracles import RiccatiOracle, optimal_cost
from lyapnet.randomness import CERTIFICATION, stream
from lyapnet.sets import Box

KINDS = ("sampled", "statistical", "sound")
COMPARED = 1000  # states of X₀ on which the guaranteed cost is held against the optimum


def default_tolerances(controller: Controller, radius: float | None = None, cost: float = 0.05) -> Tolerances:
    """What success is by default.

    J within 5 % of V(0, x₀); ‖x(T)‖ within a radius, if one is given; and the decrease within 1 % of V(0, x₀), where a
    Lyapunov program promised it.
    """
    return Tolerances(radius, 1e-2 if controller.config.program.name == "lyapunov" else None, cost)


def default_delta(controller: Controller) -> float:
    """0.5 % of the mean running cost on X₀ at t = 0, in cost per second."""
    x0 = controller.initial_states.sample(COMPARED, stream(0, CERTIFICATION))
    return 0.005 * float(controller.cost.running(x0, controller.policy(0.0, x0)).mean())


def sampled(controller: Controller, tolerances: Tolerances, samples: int = 100, seed: int = 0) -> dict[str, Any]:
    """The sampled claim on fresh states of X₀."""
    claim = sampled_claim(
        controller.rollout, controller.initial_states, tolerances, samples, stream(seed, CERTIFICATION)
    )
    return {"kind": "sampled", **_shares(claim), "seed": seed}


def statistical(
    controller: Controller,
    tolerances: Tolerances,
    samples: int = 10_000,
    confidence: float = 1 - 1e-6,
    share: float = 0.99,
    seed: int = 0,
) -> dict[str, Any]:
    """The statistical claim on fresh states of X₀."""
    generator = stream(seed, CERTIFICATION)
    claim = statistical_claim(
        controller.rollout, controller.initial_states, tolerances, samples, confidence, share, generator
    )
    bounds = {f"{e}_lower_bound": bound for e, bound in claim.lower_bounds.items() if e in _asked(claim.tolerances)}
    return {
        "kind": "statistical", **_shares(claim), "confidence": confidence, "required_share": share,
        "probability_lower_bound": claim.probability_lower_bound, **bounds, "seed": seed,
    }  # fmt: skip


def sound(
    controller: Controller, alpha: float = 0.95, delta: float | None = None, states: Box | None = None,
    seconds: float = 60.0,
) -> tuple[dict[str, Any], SoundClaim]:  # fmt: skip
    """The sound claim, as one object and as it is."""
    claim = sound_claim(
        controller.closed_loop, controller.initial_states, controller.horizon.duration, alpha,
        default_delta(controller) if delta is None else delta, states, Budget(seconds), stream(0, CERTIFICATION),
    )  # fmt: skip
    wanted = claim.wanted if math.isfinite(claim.wanted) else None
    return {
        "kind": "sound", "verdict": claim.verdict, "alpha": claim.alpha, "delta": claim.delta,
        "rho": claim.rho if claim.volume_share else None, "rho_wanted": wanted,
        "set": [claim.states.lower.tolist(), claim.states.upper.tolist()], "volume_share": claim.volume_share,
        "guaranteed_cost_ratio": _guaranteed_cost_ratio(controller, claim), "boxes": claim.boxes,
        "seconds": claim.seconds, "remaining_volume": claim.remaining_volume,
        "counterexample": None if claim.counterexample is None else claim.counterexample._asdict(),
    }, claim  # fmt: skip


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


def _asked(tolerances: Tolerances) -> list[str]:
    """The single events that success consists of."""
    limits = {"decrease": tolerances.decrease, "terminal": tolerances.radius, "cost": tolerances.cost}
    return [event for event, limit in limits.items() if limit is not None]


def _shares(claim: SampledClaim | StatisticalClaim) -> dict[str, Any]:
    return {
        "verdict": claim.verdict, "samples": claim.samples,
        **{f"{e}_share": share for e, share in claim.shares.items() if e in (*_asked(claim.tolerances), "all")},
        "tolerances": asdict(claim.tolerances),
        "failure": None if claim.failure is None else claim.failure.tolist(),
    }  # fmt: skip


def _guaranteed_cost_ratio(controller: Controller, claim: SoundClaim) -> float | None:
    """Mean guaranteed cost over the mean optimum of the discretised task, on states of X₀ inside the funnel.

    None where either is not known at once: a search by IPOPT would take longer than the proof.
    """
    oracle = optimal_cost(controller.system, controller.cost, controller.horizon, controller.config.rollout.method)
    x0 = controller.initial_states.sample(COMPARED, stream(1, CERTIFICATION))
    guaranteed = claim.guaranteed_cost(controller.value(0.0, x0).double())
    inside = guaranteed.isfinite()
    if not isinstance(oracle, RiccatiOracle) or not inside.any():
        return None
    return float(guaranteed[inside].mean() / oracle(x0[inside]).mean())
