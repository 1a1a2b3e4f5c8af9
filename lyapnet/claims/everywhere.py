"""Claims that a function of (t, x) is at most 0 on a whole box: the base class for your own claims."""

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch

from lyapnet.base.contracts import copied
from lyapnet.base.random_streams import CERTIFICATION, stream
from lyapnet.base.types import PerState, State, Time
from lyapnet.claims import figures
from lyapnet.claims.arguments import box_of
from lyapnet.claims.certificates import FROZEN, Certificate, format_state
from lyapnet.claims.claim import Claim, Run, option, sides_of
from lyapnet.claims.funnel import prove_in_time
from lyapnet.claims.preconditions import check_states, freeze, over_time, require_dimension
from lyapnet.controller.controller import Controller
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.prover.condition import DecreaseCondition, require_own_gradient
from lyapnet.prover.proof import Proof
from lyapnet.prover.verdict import Verdict, time_limit_reason
from lyapnet.task.sets import Box

DRAWN = 2000  # number of random points in the figure


class PointwiseCondition(DecreaseCondition):
    """c(t, x) ≤ 0 on a whole box, as a DecreaseCondition with W = 1 and Ẇ = −1; a constant W does not order boxes.

    In a file its proof has the same name as that of a funnel; the fingerprints differ.
    """

    def __init__(self, closed_loop: ClosedLoop, margin: Callable[[ClosedLoop, Time, State], PerState]):
        super().__init__(closed_loop, 1.0, 0.0)
        self.margin = margin

    def parts(self, t: Time, x: State) -> tuple[PerState, PerState, PerState]:
        W = self.height(t, x)
        return self.margin(self.closed_loop, t, x), W, -W

    def height(self, t: Time, x: State) -> PerState:
        return 0 * t + 1


@dataclass(frozen=True, kw_only=True)
class Everywhere(Claim):
    """c(t, x) ≤ 0 for all t ∈ [0, T] and all x in a set of states D: proved on boxes, or refuted by a point.

    A subclass defines c and says what it means. It inherits the search, the counterexample, the kept proof, the table,
    the report and the figure.
    """

    states: Box | Sequence[Sequence[float]] | None = option(
        None, "The set D; X₀ if none.", flag="set", check=sides_of
    )  # fmt: skip

    @abstractmethod
    def margin(self, loop: ClosedLoop, t: Time, x: State) -> PerState:
        """c(t, x) in torch, for one state (n,) and for batches, from loop.system, loop.cost, loop.policy and loop.V."""

    @abstractmethod
    def in_words(self) -> str:
        """The meaning of c ≤ 0, as a sentence."""

    @abstractmethod
    def in_formulas(self) -> list[str]:
        """c ≤ 0 as formulas, one for each line."""

    def establish(self, controller: Controller, run: Run) -> "EverywhereCertificate":
        states = box_of(self.states) or box_of(controller.initial_states)
        assert states is not None
        require_dimension(states, controller.initial_states)
        domain = over_time(states, controller.horizon.duration)
        condition = PointwiseCondition(copied(controller.closed_loop).requires_grad_(False), self.margin)
        require_own_gradient(condition.V, domain)
        memory = freeze(condition, domain)
        check_states(condition, domain)
        memory.check()
        set_up = run.budget.elapsed
        proof = prove_in_time(
            condition, domain, float("inf"), run.budget, generator=run.generator, report=run.report, keep=run.keep
        )
        found = Margins(claim=self, proof=proof, states=states, set_up=set_up)
        return EverywhereCertificate(controller, found, run.options(self))


@dataclass(frozen=True, kw_only=True)
class Margins:
    """The result of a proof that c ≤ 0 on [0, T] × D."""

    claim: Everywhere
    proof: Proof
    states: Box  # D
    set_up: float  # seconds of the budget before the first box

    @property
    def verdict(self) -> Verdict:
        """Whether c ≤ 0 at every point."""
        return self.proof.verdict


class EverywhereCertificate(Certificate):
    """A proof of c ≤ 0 on [0, T] × D, or a point where it fails."""

    labels: ClassVar[Mapping[str, str]] = {
        "reason": "why",
        "set": "D",
        "counterexample": "counterexample",
        "remaining_volume": "share of [0, T] × D undecided",
        "boxes": "boxes",
        "seconds": "seconds",
        "fingerprint": "fingerprint of what was bounded",
    }
    claim: Margins

    def __init__(self, controller: Controller, claim: Margins, options: Mapping[str, Any]):
        super().__init__(controller, claim, options)
        self.kind: str = claim.claim.kind

    def numbers(self) -> dict[str, Any]:
        proof, D, found = self.claim.proof, self.claim.states, self.claim.proof.counterexample
        why = (
            f"{time_limit_reason(self.claim.set_up)}: allow more, or claim less" if self.verdict == "unknown" else None
        )
        return {
            "set": [D.lower.tolist(), D.upper.tolist()], "duration": self.controller.horizon.duration, "reason": why,
            "counterexample": found and {"t": found.t, "x": found.x, "condition": found.condition},
            "remaining_volume": proof.remaining_volume, "boxes": proof.boxes, "seconds": proof.seconds,
            "fingerprint": proof.fingerprint,
        }  # fmt: skip

    def in_words(self) -> str:
        if self.verdict != "certified":
            return f"Nothing is proved. The claim was: {self.claim.claim.in_words()}"
        return (
            f"{self.claim.claim.in_words()} It is proved for every t up to T = {self.controller.horizon.duration:g} s "
            f"and every x ∈ D, for the traced operations of these functions, which have this fingerprint; {FROZEN}"
        )

    def in_formulas(self) -> list[str]:
        return self.claim.claim.in_formulas()

    def verdict_text(self) -> str:
        found = self.claim.proof.counterexample
        if found is not None:
            return f"At t = {found.t:.6g} s, x = {format_state(found.x)} it fails by {found.condition:.3g}."
        return (
            "Bounds prove it on boxes that cover [0, T] × D."
            if self.verdict == "certified"
            else "Some boxes are undecided."
        )

    def figure(self) -> figures.Figure:
        D, T = self.claim.states, self.controller.horizon.duration
        generator = stream(0, CERTIFICATION)
        x, t = D.sample(DRAWN, generator).double(), T * torch.rand(DRAWN, generator=generator, dtype=torch.float64)
        with torch.no_grad():
            c = self.claim.claim.margin(copied(self.controller.closed_loop), t, x)
        return figures.margins(t, c, self.claim.proof.counterexample, f"{self.kind}: {self.verdict}")
