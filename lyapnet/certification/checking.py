"""A finished proof, checked: what others can do with its file and the checkpoint, without trusting either search."""

import copy
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch

from lyapnet.certification.branch_and_bound import Budget
from lyapnet.certification.condition import DecreaseCondition, bounded_condition
from lyapnet.certification.funnel import sound_claim
from lyapnet.certification.kept_proofs import KeptProof, about, read_content, refusing
from lyapnet.certification.proof import Progress
from lyapnet.certification.sound_certificate import SoundCertificate
from lyapnet.contracts import copied
from lyapnet.controller import Controller
from lyapnet.errors import UsageError
from lyapnet.files import plain
from lyapnet.sets import Box
from lyapnet.types import State

LABELS = {
    **{name: label for name, label in SoundCertificate.labels.items() if name != "guaranteed_cost_ratio"},
    "share_of_search": "seconds for the leaves / for their search",
}
UNLIMITED = 1e9  # seconds: the leaves are an end


def check(
    controller: Controller, path: Path, workers: int = 1, report: Callable[[Progress], None] | None = None
) -> dict[str, Any]:
    """What `lyapnet certify check --json` prints: whether a file proves that a funnel holds all of X₀.

    α, δ and D are read from the file, the condition is built from the controller, and what a SoundClaim is about is
    computed anew: the levels of X₀ and of the boundary of D, the bounds of c and W on every leaf of the cuts, the share
    and κ. The verdict is certified or refused, with the reason.
    """
    started, share = time.monotonic(), None
    numbers: dict[str, Any] = {}
    try:
        kept = kept_funnel(controller, path)
        claim = sound_claim(
            controller.closed_loop, controller.problem, kept.alpha, kept.delta, kept.states,
            Budget(UNLIMITED, workers=workers), torch.Generator().manual_seed(0), report, path, True,
            disturbance=kept.disturbance,
        )  # fmt: skip
        numbers = SoundCertificate(controller, claim, {}).proved()
        verdict = "certified" if claim.verdict == "certified" else "refused"
        numbers["reason"] = None if verdict == "certified" else "a leaf is not proved, or the funnel misses some of X₀"
        share = claim.proof_seconds / kept.seconds
    except UsageError as error:
        verdict, numbers["reason"] = "refused", str(error)
    seconds = time.monotonic() - started
    return plain({"kind": "check", "verdict": verdict, **numbers, "seconds": seconds, "share_of_search": share})


class KeptFunnel(NamedTuple):
    """The funnel {V(t, x) ≤ ρ + δt} within D that a file records as proved."""

    alpha: float
    delta: float  # in cost per second
    states: Box  # D; without width along states that nothing depends on
    disturbance: State | None
    rho: float
    seconds: float  # of the search


def kept_funnel(controller: Controller, path: Path) -> KeptFunnel:
    """What the file of a finished proof says of a controller; no leaf is bounded anew.

    Raises:
        UsageError: it is another file, an unfinished proof, or that of another controller; or as bounded_condition.
    """
    content = read_content(path)
    with refusing(path):
        of = content["of"][0]
        lower, upper = (torch.tensor(of[side], dtype=torch.float64)[1:] for side in ("lower", "upper"))
        w = None if of["disturbance"] is None else torch.tensor(of["disturbance"], dtype=torch.float64)
        kept = KeptFunnel(
            float(of["alpha"]), float(of["delta"]), Box(lower, upper), w, float(content["proved"]), content["seconds"]
        )
    loop, problem = copy.deepcopy(controller.closed_loop).double().requires_grad_(False), copied(controller.problem)
    condition = DecreaseCondition(loop, kept.alpha, kept.delta, problem.constraints, kept.disturbance)
    times = torch.tensor([[0.0], [controller.horizon.duration]], dtype=torch.float64)
    lower, upper = torch.cat([times[0], lower]), torch.cat([times[1], upper])
    if kept.states.dimension == controller.system.n:  # sound_claim says so else
        of = about(bounded_condition(condition, (lower, upper)), condition, lower, upper)
        KeptProof(path, of, math.inf).claim((lower, upper))
    return kept
