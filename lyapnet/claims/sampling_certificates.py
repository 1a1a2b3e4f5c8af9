"""Certificates from sampled closed loops: the share of successes, or a bound of the share of X₀ that succeeds."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, ClassVar

from lyapnet.claims import figures
from lyapnet.claims.certificates import Certificate
from lyapnet.claims.statistical import BoundedShare, CountedSuccesses
from lyapnet.claims.tables import floored
from lyapnet.loop.programs import ValueProgram
from lyapnet.task.constraints import names_of


class SampledCertificate(Certificate):
    """The share of sampled states whose closed loop succeeds."""

    kind: str = "sampled"
    picture: str = "states.png"
    labels: ClassVar[Mapping[str, str]] = {
        "samples": "states",
        "tolerances": "tolerances",
        "decrease_share": "condition holds along the closed loop",
        "terminal_share": "‖x(T)‖ within the radius",
        "cost_share": "cost ≤ V(0, x₀), up to the tolerance",
        "constraints_share": "constraints kept",
        "all_share": "all conditions hold",
        "confidence": "confidence",
        "draws": "draws of this checkpoint, other seeds included",
        "confidence_over_draws": "confidence over all of them",
        "decrease_lower_bound": "condition holds on at least",
        "terminal_lower_bound": "‖x(T)‖ within the radius on at least",
        "cost_lower_bound": "cost ≤ V(0, x₀), up to the tolerance, on at least",
        "constraints_lower_bound": "constraints kept on at least",
        "probability_lower_bound": "all conditions hold on at least",
        "required_share": "share of X₀ that the verdict is about",
        "failure": "a state that fails",
        "caveat": "this draw",
        "advice": "what to do",
    }
    claim: CountedSuccesses

    def numbers(self) -> dict[str, Any]:
        claim = self.claim
        events = (*claim.tolerances.asked, "all")
        return {
            "samples": claim.samples,
            **{f"{event}_share": share for event, share in claim.shares.items() if event in events},
            "tolerances": {name: value for name, value in asdict(claim.tolerances).items() if name != "constraints"},
            "failure": claim.failures[0].tolist() if len(claim.failures) else None,
        }

    def in_words(self) -> str:
        return (
            f"Of {self._sample}, {self.claim.successes['all']} succeed: their closed loops satisfy the conditions "
            f"below at the nodes of the horizon. This proves nothing about other states of X₀.{self.parameters_text}"
        )

    @property
    def _sample(self) -> str:
        """The sample, in words."""
        paths = ", each with one path of the noise" if self._noisy else ""
        return f"{self.claim.samples} states drawn uniformly from X₀ (seed {self.options['seed']}){paths}"

    @property
    def _noisy(self) -> bool:
        return self.controller.problem.noise is not None

    def in_formulas(self) -> list[str]:
        limits = asdict(self.claim.tolerances)
        lines = {
            "decrease": "Σₙ max(Vₙ₊₁ − Vₙ + Δt ℓₙ, 0) ≤ {:g} V(0, x₀)",
            "radius": "‖x(T)‖ ≤ {:g}",
            "cost": "J(x₀) ≤ {:g} V(0, x₀)",
        }
        numbers, constraints = {**limits, "cost": 1 + limits["cost"]}, names_of(self.controller.problem.constraints)
        formulas = [line.format(numbers[name]) for name, line in lines.items() if limits[name] is not None]
        return [*formulas, *([f"h(xₙ) ≤ 0: {'; '.join(constraints)}"] if constraints else [])]

    def verdict_text(self) -> str:
        why = "one that fails was found" if self.verdict == "falsified" else "no sample fails, which is no proof"
        return f"The verdict is on the claim that every state of X₀ succeeds: {why}."

    def figure(self) -> figures.Figure:
        controller = self.controller
        return figures.sampled_states(
            self.claim, controller.initial_states, controller.system.state_labels, self.headline
        )

    @property
    def headline(self) -> str:
        """The claim as the title of its figure."""
        return f"sampled, {self.verdict}: {self.claim.successes['all']} of {self.claim.samples} states succeed"


class StatisticalCertificate(SampledCertificate):
    """A lower bound of the share of X₀ that succeeds, with a confidence."""

    kind: str = "statistical"
    claim: BoundedShare
    caveat: str | None = None  # the reason if the draw could not be recorded

    def numbers(self) -> dict[str, Any]:
        claim = self.claim
        bounds = {
            "confidence": claim.confidence, "draws": claim.draws,
            "confidence_over_draws": claim.confidence_over_draws, "required_share": claim.share, **claim.named_bounds,
        }  # fmt: skip
        notes = {"caveat": self.caveat, "advice": self._advice}
        return {**super().numbers(), **bounds, **{key: text for key, text in notes.items() if text}}

    @property
    def _advice(self) -> str | None:
        """Advice if the cost exceeds V too often, and V was trained by the value program, which allows this."""
        estimate, share = isinstance(self.controller.program, ValueProgram), self.claim.shares["cost"]
        if self.verdict == "certified" or not estimate or share >= self.claim.share:
            return None
        return (
            "V of the value program estimates the cost and need not be an upper bound; for a bound, train on (option "
            "finetune) with program.name=lyapunov"
        )

    def in_words(self) -> str:
        bound, successes = floored(self.claim.probability_lower_bound), self.claim.successes["all"]
        return (
            f"With confidence {self._confidence}, {self._share_in_words(bound)}: the closed loop satisfies "
            "the conditions below at the nodes of the horizon. It is the exact one-sided Clopper-Pearson bound for "
            f"{successes} successes in {self._sample}. The confidence is over the draw{self._other_draws}. Like the "
            f"rollouts, the claim is about this model, this Δt and this integrator.{self.parameters_text}"
        )

    def _share_in_words(self, share: str) -> str:
        if self._noisy:
            return f"a random state of X₀ under random noise succeeds with probability at least {share}"
        return f"at least {share} of X₀ by volume succeeds"

    @property
    def _other_draws(self) -> str:
        """Words on further draws of this checkpoint."""
        chosen = f", which may have been chosen among {self.claim.draws} draws of this checkpoint"
        return (chosen if self.claim.draws > 1 else "") + (f"; {self.caveat}" if self.caveat else "")

    @property
    def _confidence(self) -> str:
        return f"1 − {1 - self.claim.confidence_over_draws:.2g}"

    def in_formulas(self) -> list[str]:
        bound = floored(self.claim.probability_lower_bound)
        noise = " and the noise" if self._noisy else ""
        return [*super().in_formulas(), f"P(x₀ succeeds) ≥ {bound}  for x₀ uniform on X₀{noise}"]

    def verdict_text(self) -> str:
        why = {
            "certified": "the lower bound is at least that",
            "falsified": "the share is smaller, at the same confidence",
            "unknown": "these samples do not decide it",
        }[self.verdict]
        return f"The verdict is on the claim that {self._share_in_words(f'{self.claim.share:.6g}')}: {why}."

    @property
    def headline(self) -> str:
        share = f"{floored(self.claim.probability_lower_bound)} of X₀" + " and the noise" * self._noisy
        bound = f"at least {share}, confidence {self._confidence}"
        counted = f"{self.claim.successes['all']} of {self.claim.samples} states succeed"
        return f"statistical, {self.verdict}: {bound}\n{counted}"
