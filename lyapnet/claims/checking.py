"""Checks a kept proof with its file and the checkpoint, without trusting the search that made it."""

import copy
import math
import shlex
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch

from lyapnet.base.contracts import copied
from lyapnet.base.errors import UsageError
from lyapnet.base.files import plain
from lyapnet.base.types import State
from lyapnet.claims.arguments import with_noise
from lyapnet.claims.from_below import LowerBoundCertificate
from lyapnet.claims.funnel import prove_funnel
from lyapnet.claims.kept_regions import kept_region
from lyapnet.claims.least_cost import DEGREE, RiseCondition, prove_lower_bound
from lyapnet.claims.noisy_certificate import NoisyCertificate
from lyapnet.claims.noisy_funnel import prove_noisy_funnel
from lyapnet.claims.plants import plants_of
from lyapnet.claims.preconditions import over_time, require_no_noise
from lyapnet.claims.reach import prove_reach
from lyapnet.claims.reach_certificate import ReachCertificate
from lyapnet.claims.region import prove_region
from lyapnet.claims.region_certificate import RegionCertificate
from lyapnet.claims.sound_certificate import SoundCertificate
from lyapnet.claims.stepped_decrease import SteppedPayment
from lyapnet.claims.two_sided import TwoSidedCertificate, labels_of_both
from lyapnet.controller.controller import Controller
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.prover.condition import DecreaseCondition, bounded_condition
from lyapnet.prover.float_errors import FloatLaw
from lyapnet.prover.kept_proofs import KeptProof, describe_condition, read_proofs, refuse_bad_file, select_proof
from lyapnet.prover.proof import Progress
from lyapnet.prover.readings import Readings, readings_from
from lyapnet.task.sets import Box

UNLIMITED = 1e9  # seconds; a check ends when all leaves are bounded, and needs no other limit
NOT_PROVED = "a leaf is not proved"
Report = Callable[[Progress], None] | None


def check(
    controller: Controller, path: Path, workers: int = 1, report: Report = None, law: FloatLaw | None = None
) -> dict[str, Any]:
    """Check whether a file proves its claim; return the object that `lyapnet certify check --json` prints.

    The parameters of the claim (such as α, δ and D of a funnel; λ, B, Y and c of a region) are read from the file, and
    the condition is built from the controller. Everything else is computed again: the levels on X₀ and on the boundary
    of D, the bounds of the condition and of W on every leaf of the cuts, contraction on B, shares, volumes, κ and e.
    The verdict is certified or refused, with the reason. A funnel or a bound from below must hold on all of X₀. A
    region is certified up to the ρ of the file, and the result has the share of X₀ in it.

    Args:
        law: the program that computes u, if the claim is about one; its errors are bounded again, and if its file
            states a claim, that must be this one.
    """
    started, kind, numbers, share = time.monotonic(), None, {}, None
    try:
        kind, reprove = kind_of(path)
        if kind not in (NoisyCertificate.kind, ReachCertificate.kind):
            require_no_noise(controller.problem, kind)
        if law is not None and reprove not in (_reprove_funnel, _reprove_two_sides):
            raise UsageError(f"Expected no --file for a {kind} certificate, got one; leave it out.")
        with_law = {} if law is None else {"law": law}
        found = reprove(controller, path, Budget(UNLIMITED, workers=workers), report, **with_law)
        numbers, reason = found.numbers, found.reason
        if law is not None and law.claimed not in ("", claim_text(found.numbers)):
            reason = "the header states another claim than this proof"
        share = found.seconds / found.searched if found.searched > 0 else None
    except UsageError as error:
        reason = str(error)
    verdict = "certified" if reason is None else "refused"
    numbers = {**numbers, "reason": reason, "seconds": time.monotonic() - started, "share_of_search": share}
    return plain({"kind": "check", "of": kind, "verdict": verdict, **numbers})


def labels_of(result: Mapping[str, Any]) -> dict[str, str]:
    """The labels of the numbers of a check in a table."""
    kinds = {
        "region": RegionCertificate.labels,
        "noisy": NoisyCertificate.labels,
        "reach": ReachCertificate.labels,
        "two-sided": labels_of_both(SoundCertificate),
    }
    labels = kinds.get(result["of"], SoundCertificate.labels)
    return {"of": "of", **labels, "share_of_search": "seconds for the leaves / for their search"}


class Checked(NamedTuple):
    """A claim that was proved again from a file, without a search."""

    numbers: dict[str, Any]
    reason: str | None  # why it is refused; None if it is certified
    seconds: float  # time to bound the leaves
    searched: float  # seconds of the original search, as recorded in the file


Reprove = Callable[..., Checked]
"""(controller, file, budget, report[, law]) ↦ what is proved again."""


def kind_of(path: Path) -> tuple[str, Reprove]:
    """(the kind of claim that the proofs in a file establish, the function that proves it again).

    Raises:
        UsageError: there is no such file, or it holds no proofs.
    """
    proofs = read_proofs(path)
    with refuse_bad_file(path):
        return KINDS[tuple(sorted(proofs))]


class KeptSide(NamedTuple):
    """The funnel {V(t, x) ≤ ρ + δt} in D that a file records as proved; for a bound from below, {W ≤ c} with ρ = c."""

    alpha: float
    delta: float  # in cost per second
    states: Box  # D; of width 0 along ignorable states
    disturbance: State | None
    readings: Readings | None
    steps: bool  # whether the claim is about the steps of the model
    degree: int  # of the Taylor forms
    rho: float
    seconds: float  # duration of the original search


def kept_funnel(controller: Controller, path: Path) -> KeptSide:
    """Read the funnel that a finished proof records for a controller; no leaf is bounded again.

    Raises:
        UsageError: the file has no such proof, or one that is unfinished or of another controller; or as
            bounded_condition.
    """
    return _kept_side(controller, path, "above")


def _kept_side(controller: Controller, path: Path, name: str) -> KeptSide:
    """As kept_funnel, for the proof of this name."""
    content = select_proof(read_proofs(path), name, path)
    with refuse_bad_file(path):
        of = content["of"][0]
        readings = readings_from(of.get("readings"), controller.horizon.duration)
        last = None if readings is None else -1  # the last axis is the age of a reading
        lower, upper = (torch.tensor(of[side], dtype=torch.float64)[1:last] for side in ("lower", "upper"))
        w = None if of["disturbance"] is None else torch.tensor(of["disturbance"], dtype=torch.float64)
        if of["degree"] not in (2, DEGREE):
            raise ValueError("forms of unknown degree")
        kept = KeptSide(
            float(of["alpha"]), float(of["delta"]), Box(lower, upper), w, readings, "steps" in of, int(of["degree"]),
            float(content["proved"]), float(content["seconds"]),
        )  # fmt: skip
    loop, problem = copy.deepcopy(controller.closed_loop).double().requires_grad_(False), copied(controller.problem)
    if name == "below":
        condition = RiseCondition(loop, kept.alpha, kept.delta, problem)
    elif kept.steps:
        condition = SteppedPayment(loop, kept.alpha, kept.delta, problem)
    else:
        condition = DecreaseCondition(
            loop, kept.alpha, kept.delta, problem.constraints, kept.disturbance, kept.readings
        )
    if kept.states.dimension == controller.system.n:  # otherwise the claim raises the error
        domain = over_time(kept.states, controller.horizon.duration)
        if isinstance(condition, SteppedPayment):
            domain = condition.domain_of(kept.states, torch.nonzero(kept.states.widths == 0).flatten().tolist())
        box = condition.search_box(domain)
        KeptProof(
            path, describe_condition(bounded_condition(condition, domain, kept.degree), condition, *box), math.inf
        ).read_claim(box)
    return kept


def _reprove_funnel(
    controller: Controller, path: Path, budget: Budget, report: Report, law: FloatLaw | None = None
) -> Checked:
    kept = kept_funnel(controller, path)
    claim = prove_funnel(
        controller.closed_loop, controller.problem, kept.alpha, kept.delta, kept.states, budget, _generator(), report,
        path, True, kept.degree, kept.disturbance, kept.readings, law, kept.steps,
    )  # fmt: skip
    reason = None if claim.verdict == "certified" else f"{NOT_PROVED}, or the funnel misses some of X₀"
    return Checked(_stated(SoundCertificate(controller, claim, {})), reason, claim.proof_seconds, kept.seconds)


def _stated(certificate: SoundCertificate) -> dict[str, Any]:
    """The numbers that are proved again, with the claim in words and formulas."""
    claim = {"words": certificate.in_words(), "formula": certificate.in_formulas()}
    return {**certificate.proved(), "claim": claim}


def claim_text(result: Mapping[str, Any]) -> str:
    """The claim of a checked funnel in one line."""
    lower, upper = result["set"]
    D = " × ".join(f"[{low!r}, {high!r}]" for low, high in zip(lower, upper, strict=True))
    stated = f"{result['claim']['words']} {'; '.join(result['claim']['formula'])}. D = {D}, "
    return " ".join(f"{stated}fingerprint {result['fingerprint']}.".split())


def _reprove_two_sides(
    controller: Controller, path: Path, budget: Budget, report: Report, law: FloatLaw | None = None
) -> Checked:
    above, below = (_kept_side(controller, path, name) for name in ("above", "below"))
    if (above.alpha, above.delta) != (below.alpha, below.delta) or above.disturbance is not None:
        raise UsageError(
            f"Expected two proofs with the same α and δ and without disturbances in {str(path)!r}, got others; choose "
            "another file."
        )
    loop, problem, numbers = controller.closed_loop, controller.problem, (above.alpha, above.delta)
    upper = prove_funnel(
        loop, problem, *numbers, above.states, budget, _generator(), report, path, True, above.degree,
        readings=above.readings, law=law,
    )  # fmt: skip
    lower = prove_lower_bound(loop, problem, *numbers, below.states, budget, _generator(), report, path, True)
    bound = SoundCertificate(controller, upper, {})
    certificate = TwoSidedCertificate(bound, LowerBoundCertificate(controller, lower, {}), {})
    reason = None if certificate.verdict == "certified" else f"{NOT_PROVED}, or one side misses some of X₀"
    seconds = upper.proof_seconds + lower.proof_seconds
    numbers = {**certificate.proved(), "claim": _stated(bound)["claim"]}
    return Checked(numbers, reason, seconds, above.seconds + below.seconds)


def _reprove_region(controller: Controller, path: Path, budget: Budget, report: Report) -> Checked:
    kept = kept_region(path)
    if not kept.rho >= kept.hole > 0:
        raise UsageError(
            f"Expected the proof of a region in {str(path)!r}, got one without a region yet; resume it with lyapnet "
            f"certify region CKPT --keep {shlex.quote(str(path))} and the same options."
        )
    plants = plants_of(controller, kept.parameters) if kept.parameters else None
    claim = prove_region(
        controller.closed_loop, controller.problem, kept.decay, kept.states, budget, _generator(), report, path, True,
        kept.disturbance, plants, kept.readings, kept.steps is not None, kept.is_practical,
    )  # fmt: skip
    reason = None if claim.rho >= kept.rho else f"{NOT_PROVED}, or ρ is above the level of the proof"
    seconds = 0.0 if claim.proof is None else claim.proof.seconds
    return Checked(RegionCertificate(controller, claim, {}).numbers(), reason, seconds, kept.seconds)


def _reprove_noisy(controller: Controller, path: Path, budget: Budget, report: Report) -> Checked:
    content = select_proof(read_proofs(path), "noisy", path)
    with refuse_bad_file(path):
        of, seconds = content["of"][0], float(content["seconds"])
        states = Box(*(torch.tensor(of[side], dtype=torch.float64)[1:] for side in ("lower", "upper")))
        probability, alpha, delta = float(of["probability"]), float(of["alpha"]), float(of["delta"])
        risk, decay = float(of["risk"]), float(of["decay"])
        if of["degree"] != 2 or not 0 < probability < 1:
            raise ValueError("forms of unknown degree, or no probability")
    claim = prove_noisy_funnel(
        controller.closed_loop, controller.problem, probability, alpha, delta, risk, decay, states, budget,
        _generator(), report, path, True,
    )  # fmt: skip
    reason = None if claim.verdict == "certified" else f"{NOT_PROVED}, or some of X₀ leaves with a higher probability"
    return Checked(NoisyCertificate(controller, claim, {}).proved(), reason, claim.proof_seconds, seconds)


def _reprove_reach(controller: Controller, path: Path, budget: Budget, report: Report) -> Checked:
    content = select_proof(read_proofs(path), "reach", path)
    with refuse_bad_file(path):
        of, seconds = content["of"][0], float(content["seconds"])
        states = Box(*(torch.tensor(of[side], dtype=torch.float64)[1:] for side in ("lower", "upper")))
        target, *avoided = (
            Box(*(torch.tensor(side, dtype=torch.float64) for side in each)) for each in (of["target"], *of["avoided"])
        )
        probability, risk, rate = float(of["probability"]), float(of["risk"]), float(of["rate"])
        noise = None if of["noise"] is None else {str(name): float(sigma) for name, sigma in of["noise"].items()}
        if of["degree"] != 2 or not 0 < probability < 1:
            raise ValueError("forms of unknown degree, or no probability")
    loop, problem = with_noise(noise, controller)
    claim = prove_reach(
        loop, problem, target, avoided, probability, risk, rate, states, budget, _generator(), report, path, True,
        noise,
    )  # fmt: skip
    reason = (
        None
        if claim.verdict == "certified"
        else f"{NOT_PROVED}, or some of X₀ misses the target with a higher probability"
    )
    return Checked(ReachCertificate(controller, claim, {}, loop).numbers(), reason, claim.proof.seconds, seconds)


KINDS: dict[tuple[str, ...], tuple[str, Reprove]] = {
    ("above",): ("sound", _reprove_funnel),
    ("above", "below"): ("two-sided", _reprove_two_sides),
    ("region",): ("region", _reprove_region),
    ("noisy",): ("noisy", _reprove_noisy),
    ("reach",): ("reach", _reprove_reach),
}
"""Names of the proofs in a file ↦ (kind of the claim, the function that proves it again)."""


def _generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)
