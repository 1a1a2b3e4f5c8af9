"""A finished proof, checked: what others can do with its file and the checkpoint, without trusting either search."""

import copy
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

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
        content = read_content(path)
        with refusing(path):
            of = content["of"][0]
            lower, upper = (torch.tensor(of[side], dtype=torch.float64)[1:] for side in ("lower", "upper"))
            alpha, delta, states = float(of["alpha"]), float(of["delta"]), Box(lower, upper)
        _require_claim(controller, path, alpha, delta, states)
        claim = sound_claim(
            controller.closed_loop, controller.problem, alpha, delta, states, Budget(UNLIMITED, workers=workers),
            torch.Generator().manual_seed(0), report, path, True,
        )  # fmt: skip
        numbers = SoundCertificate(controller, claim, {}).proved()
        verdict = "certified" if claim.verdict == "certified" else "refused"
        numbers["reason"] = None if verdict == "certified" else "a leaf is not proved, or the funnel misses some of X₀"
        share = claim.proof_seconds / content["seconds"]
    except UsageError as error:
        verdict, numbers["reason"] = "refused", str(error)
    seconds = time.monotonic() - started
    return plain({"kind": "check", "verdict": verdict, **numbers, "seconds": seconds, "share_of_search": share})


def _require_claim(controller: Controller, path: Path, alpha: float, delta: float, states: Box) -> None:
    """Refuse an unfinished proof, or that of another controller, before anything is computed.

    Raises:
        UsageError: it is one; or as bounded_condition.
    """
    loop, problem = copy.deepcopy(controller.closed_loop).double().requires_grad_(False), copied(controller.problem)
    condition = DecreaseCondition(loop, alpha, delta, problem.constraints)
    times = torch.tensor([[0.0], [controller.horizon.duration]], dtype=torch.float64)
    lower, upper = torch.cat([times[0], states.lower]), torch.cat([times[1], states.upper])
    if states.dimension == controller.system.n:  # sound_claim says so else
        of = about(bounded_condition(condition, (lower, upper)), condition, lower, upper)
        KeptProof(path, of, math.inf).claim((lower, upper))
