"""lyapnet.certify: proves or samples claims about a controller."""

import math
from collections.abc import Callable
from pathlib import Path

from lyapnet.base.errors import Interrupted, UsageError
from lyapnet.claims.certificates import Certificate
from lyapnet.claims.claim import Claim, Run
from lyapnet.claims.costs import CostCertificate
from lyapnet.claims.kinds import LowerBound
from lyapnet.claims.preconditions import require_no_noise
from lyapnet.claims.two_sided import TwoSidedCertificate
from lyapnet.controller.controller import Controller
from lyapnet.controller.loading import load
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.prover.proof import Progress

NOTHING_KEPT = "Stopped while certifying: the proof of a {} cannot be kept."


def certify(
    controller: Controller | str | Path,
    *claims: Claim,
    budget: float | Budget = 60.0,
    seed: int = 0,
    keep: str | Path | None = None,
    report: Callable[[Progress], None] | None = None,
) -> Certificate:
    """Certify a claim about a controller within a budget; the verdict is certified, falsified or unknown.

        certificate = lyapnet.certify(controller, lyapnet.Funnel(alpha=0.9), lyapnet.LowerBound())
        print(certificate, certificate.verdict)

    Args:
        controller: a controller, or the path of its checkpoint.
        claims: one claim; or two: a claim that bounds the cost from above, and LowerBound().
        budget: seconds, set-up included; or a Budget, whose time runs from its construction.
        seed: of all random numbers.
        keep: a file for the proof; the same call resumes from it.
        report: called with the progress of the proof.

    Raises:
        UsageError: the claims do not fit the controller, each other or the budget.
        Interrupted: Ctrl-C or SIGTERM; the message says whether the proof was kept.
    """
    for claim in claims:
        if not isinstance(claim, Claim):
            raise UsageError(
                f"Expected claims such as lyapnet.Funnel(alpha=0.9), got {claim!r}; create one from its class."
            )
    if not isinstance(controller, Controller | str | Path):
        raise UsageError(f"Expected a controller or the path of its checkpoint, got {controller!r}; see lyapnet.load.")
    if not isinstance(budget, Budget):
        if isinstance(budget, bool) or not isinstance(budget, int | float) or not 0 < budget < math.inf:
            raise UsageError(f"Expected budget as seconds > 0 or a lyapnet.Budget, got {budget!r}; for example 60.")
        budget = Budget(budget)
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise UsageError(f"Expected seed as a whole number ≥ 0, got {seed!r}; for example 0.")
    run = Run(budget=budget, seed=seed, keep=None if keep is None else Path(keep), report=report)
    controller = controller if isinstance(controller, Controller) else load(controller)
    below = [claim for claim in claims if isinstance(claim, LowerBound)]
    above = [claim for claim in claims if not isinstance(claim, LowerBound)]
    for claim in claims:
        run.require_used_by(claim)
        if not claim.allows_noise:
            require_no_noise(controller.problem, claim.kind)
        system = controller.problem.system
        if not system.affine and not claim.allows_any_dynamics:
            raise UsageError(
                f"Expected a control-affine system for a {claim.kind} certificate, got {system.title}; sampled and "
                "statistical certificates take any."
            )
        claim.require_law(controller)
        if controller.problem.follows_reference and not claim.allows_reference:
            raise UsageError(
                f"Expected a goal that stays for a {claim.kind} certificate, got a reference; sampled and statistical "
                "certificates take one."
            )
    if len(claims) == 1:
        certificate = claims[0].establish(controller, run)
    elif len(above) == len(below) == 1 and above[0].share_of_two is not None:
        certificate = _certify_two_sides(controller, above[0], below[0], run)
    else:
        got = " and ".join(claim.kind for claim in claims) or "none"
        raise UsageError(
            f"Expected one claim, or a funnel or a tube and a LowerBound, got {got}; call certify for each of them."
        )
    certificate.claims = claims
    return certificate


def _certify_two_sides(controller: Controller, above: Claim, given: LowerBound, run: Run) -> Certificate:
    """Bound the cost of the controller from above, then the cost of any control from below."""
    below, options = given.beside(above), run.options(above, **{"two-sided": True}, **given.options_beside(above))
    below.require_fitting(controller)
    upper = above.establish(controller, run.share(above.share_of_two or 1.0))
    if not isinstance(upper, CostCertificate):
        raise TypeError(
            f"Expected a CostCertificate from {type(above).__name__}.establish, got {type(upper).__name__}."
        )
    try:
        lower = below.establish(controller, run)
    except Interrupted as error:
        if "keep" in above.means:
            raise
        raise Interrupted(NOTHING_KEPT.format(above.kind), error.exit_status) from error
    return TwoSidedCertificate(upper, lower, options)
