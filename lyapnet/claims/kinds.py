"""The kinds of claims: their options, and `establish`, which imports torch and the proof only when it is called.

A new kind is a class like these with its own certificate; no other code needs to change.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar

from lyapnet.base.errors import UsageError
from lyapnet.claims.claim import (
    Claim,
    ReadAtTimes,
    Run,
    check_boxes,
    check_disturbance,
    check_noise,
    check_parameters,
    flag_of,
    is_same,
    option,
    sides_of,
)

if TYPE_CHECKING:  # as in claim.py
    from lyapnet.claims.certificates import Certificate
    from lyapnet.claims.from_below import LowerBoundCertificate
    from lyapnet.controller.controller import Controller
    from lyapnet.prover.float_errors import FloatLaw
    from lyapnet.task.sets import Box


RADIUS = "Success at T needs ‖x(T) − goal‖ within it; not asked for if none."
SLACK = "Slack in cost per second; 0.5 % of the mean ℓ on X₀ if none."
SET = "The set D, as lower:upper,…; found if none."
DISTURBANCE = "The largest disturbance of the rate of a state; may be repeated."
NORM, RATE = "give it in the norm of x", "give it in cost per second"  # remedies in error messages


@dataclass(frozen=True, kw_only=True)
class Sampled(Claim):
    """The share of sampled states of X₀ whose closed loop succeeds; nothing is said of other states."""

    kind: ClassVar[str] = "sampled"
    means: ClassVar[Sequence[str]] = ()
    allows_noise: ClassVar[bool] = True
    allows_reference: ClassVar[bool] = True
    allows_any_dynamics: ClassVar[bool] = True

    samples: int = option(100, "Initial states to draw.", at_least=1, remedy="choose how many")
    radius: float | None = option(None, RADIUS, at_least=0, remedy=NORM)

    def establish(self, controller: "Controller", run: Run) -> "Certificate":
        from lyapnet.claims.preconditions import require_goal
        from lyapnet.claims.sampling_certificates import SampledCertificate
        from lyapnet.claims.statistical import count_successes

        require_goal(controller.problem, self.kind)
        tolerances = controller.program.tolerances(self.radius)
        found = count_successes(controller.closed_loops, controller.problem, tolerances, self.samples, run.generator)
        return SampledCertificate(controller, found, run.options(self))


@dataclass(frozen=True, kw_only=True)
class Statistical(Claim):
    """A lower bound of the share of X₀ whose closed loops succeed, with a confidence."""

    kind: ClassVar[str] = "statistical"
    means: ClassVar[Sequence[str]] = ()
    allows_noise: ClassVar[bool] = True
    allows_reference: ClassVar[bool] = True
    allows_any_dynamics: ClassVar[bool] = True

    samples: int = option(10_000, "Initial states to draw.", at_least=1, remedy="choose how many")
    confidence: float = option(1 - 1e-6, "Confidence of the bound.", above=0, below=1, remedy="for example 0.999999")
    share: float = option(
        0.99, "Share of X₀ that the verdict is about.", above=0, at_most=1, remedy="for example 0.99"
    )  # fmt: skip
    radius: float | None = option(None, RADIUS, at_least=0, remedy=NORM)
    draws: int = option(1, "Draws of this controller from which this one may be chosen.", at_least=1, flag=None)

    def establish(self, controller: "Controller", run: Run) -> "Certificate":
        from lyapnet.claims.preconditions import require_goal
        from lyapnet.claims.sampling_certificates import StatisticalCertificate
        from lyapnet.claims.statistical import bound_share

        require_goal(controller.problem, self.kind)
        tolerances = controller.program.tolerances(self.radius)
        found = bound_share(
            controller.closed_loops, controller.problem, tolerances, self.samples, self.confidence, self.share,
            run.generator, draws=self.draws,
        )  # fmt: skip
        return StatisticalCertificate(controller, found, run.options(self))


@dataclass(frozen=True, kw_only=True)
class Funnel(ReadAtTimes):
    """A funnel that no closed loop leaves up to T, and a bound of the cost from each state in it: proved.

    Without `time` it is about a held law if the law is made to be held, and there are neither state constraints nor
    limits that depend on the state.
    lyapnet.claims.funnel.ProvedFunnel states the conditions.
    """

    kind: ClassVar[str] = "sound"
    share_of_two: ClassVar[float] = 0.55

    alpha: float = option(
        0.95, "Share of ℓ that V pays for.", above=0, at_most=1,
        remedy="V can pay for no more than the whole running cost",
    )  # fmt: skip
    delta: float | None = option(None, SLACK, at_least=0, remedy=RATE)
    states: "Box | Sequence[Sequence[float]] | None" = option(None, SET, flag="set", metavar="BOX", check=sides_of)
    disturbance: Mapping[str, float] | None = option(None, DISTURBANCE, metavar="STATE=W", check=check_disturbance)
    file: "FloatLaw | None" = option(
        None, "The folder of an export in C: the claim is about its u, in its numbers.", metavar="FOLDER"
    )  # fmt: skip

    def require_law(self, controller: "Controller") -> None:
        from lyapnet.claims.control_sets import require_known_minimum

        require_known_minimum(controller.closed_loop, self.kind)

    def establish(self, controller: "Controller", run: Run) -> "Certificate":
        from lyapnet.claims.arguments import box_of, disturbance_of, slack_of
        from lyapnet.claims.funnel import prove_funnel
        from lyapnet.claims.held_laws import readings_of
        from lyapnet.claims.least_cost import DEGREE
        from lyapnet.claims.preconditions import require_goal
        from lyapnet.claims.sound_certificate import SoundCertificate
        from lyapnet.prover.float_errors import FloatLaw

        require_goal(controller.problem, self.kind)
        if self.time == "steps" and (self.disturbance or run.two_sided):
            got = "--disturbance" if self.disturbance else "--two-sided"
            raise UsageError(
                f"Expected --time steps alone, got {got}, which is about continuous time; leave one of the two out."
            )
        if not isinstance(self.file, FloatLaw | None):
            raise UsageError(
                f"Expected file as the law that it computes, got {self.file!r}; take "
                "lyapnet.exchange.export.CertifiedFiles(controller, folder).law()."
            )
        made_for = "held" if getattr(controller.closed_loop.policy, "held", False) else "continuous"
        found = prove_funnel(
            controller.closed_loop, controller.problem, self.alpha, slack_of(self.delta, controller),
            box_of(self.states), run.budget, run.generator, run.report, run.keep, degree=DEGREE if run.two_sided else 2,
            disturbance=disturbance_of(self.disturbance, controller),
            readings=readings_of(self, controller, made_for), law=self.file, steps=self.time == "steps",
        )  # fmt: skip
        return SoundCertificate(controller, found, run.options(self))


@dataclass(frozen=True, kw_only=True)
class NoisyFunnel(Claim):
    """A funnel that closed loops under noise leave with a small probability, and their expected cost: proved.

    lyapnet.claims.noisy_funnel.ProvedNoisyFunnel states the conditions.
    """

    kind: ClassVar[str] = "noisy"
    allows_noise: ClassVar[bool] = True

    probability: float = option(
        0.99, "Probability of staying in the funnel up to T, from each state of X₀.", above=0, below=1,
        remedy="for example 0.99",
    )  # fmt: skip
    alpha: float = option(
        0.95, "Share of ℓ that V pays for.", above=0, at_most=1,
        remedy="V can pay for no more than the whole running cost",
    )  # fmt: skip
    delta: float | None = option(None, SLACK, at_least=0, remedy=RATE)
    risk: float | None = option(
        None, "λ of exp(λV), in 1/cost; found if none. A larger one needs a lower funnel.", above=0,
        remedy="give it in 1/cost",
    )  # fmt: skip
    decay: float = option(
        0.0, "a, at which the funnel {V ≤ ρe^(−at)} narrows, in 1/s.", at_least=0, remedy="give it in 1/s"
    )  # fmt: skip
    states: "Box | Sequence[Sequence[float]] | None" = option(None, SET, flag="set", metavar="BOX", check=sides_of)

    def require_law(self, controller: "Controller") -> None:
        from lyapnet.claims.control_sets import require_written_law

        require_written_law(controller.closed_loop, self.kind)

    def establish(self, controller: "Controller", run: Run) -> "Certificate":
        from lyapnet.claims.arguments import box_of, slack_of
        from lyapnet.claims.noisy_certificate import NoisyCertificate
        from lyapnet.claims.noisy_funnel import prove_noisy_funnel
        from lyapnet.claims.preconditions import require_goal

        require_goal(controller.problem, self.kind)
        found = prove_noisy_funnel(
            controller.closed_loop, controller.problem, self.probability, self.alpha, slack_of(self.delta, controller),
            self.risk, self.decay, box_of(self.states), run.budget, run.generator, run.report, run.keep,
        )  # fmt: skip
        return NoisyCertificate(controller, found, run.options(self))


@dataclass(frozen=True, kw_only=True)
class Reach(Claim):
    """Closed loops of the receding law u(0, x) under noise from X₀ reach a target, before they leave D or meet what is
    to be avoided, with a probability: proved, for all times.

    lyapnet.claims.reach.ProvedReach states the conditions.
    """

    kind: ClassVar[str] = "reach"
    allows_noise: ClassVar[bool] = True

    target: "Box | Sequence[Sequence[float]] | None" = option(
        None, "The set to reach, as lower:upper,…; it is needed.", metavar="BOX", check=sides_of
    )  # fmt: skip
    avoid: "Sequence[Box | Sequence[Sequence[float]]] | None" = option(
        None, "A set not to be met before, as lower:upper,…; may be repeated.", metavar="BOX", check=check_boxes
    )  # fmt: skip
    noise: Mapping[str, float] | None = option(
        None, "σ of a state's noise, in its unit per √s; that of the task if none. May be given again.",
        metavar="STATE=SIGMA", check=check_noise,
    )  # fmt: skip
    probability: float = option(
        0.99, "Probability of reaching the target, from each state of X₀.", above=0, below=1,
        remedy="for example 0.99",
    )  # fmt: skip
    risk: float | None = option(None, "λ of exp(λV), in 1/cost; found if none.", above=0, remedy="give it in 1/cost")
    rate: float | None = option(
        None, "ε, at which V(0, ·) has to fall, in cost per second; found if none.", above=0, remedy=RATE
    )  # fmt: skip
    states: "Box | Sequence[Sequence[float]] | None" = option(None, SET, flag="set", metavar="BOX", check=sides_of)

    def require_law(self, controller: "Controller") -> None:
        from lyapnet.claims.control_sets import require_written_law

        require_written_law(controller.closed_loop, self.kind)

    def establish(self, controller: "Controller", run: Run) -> "Certificate":
        from lyapnet.claims.arguments import box_of, with_noise
        from lyapnet.claims.reach import prove_reach
        from lyapnet.claims.reach_certificate import ReachCertificate

        target, *avoided = (box_of(each) for each in (self.target, *(self.avoid or ())))
        if target is None:
            raise UsageError("Expected a target to reach, got none; give its bounds, as --target=-0.5:0.5,-1:1.")
        loop, problem = with_noise(self.noise, controller)
        found = prove_reach(
            loop, problem, target, [each for each in avoided if each is not None], self.probability, self.risk,
            self.rate, box_of(self.states), run.budget, run.generator, run.report, run.keep, named=self.noise,
        )  # fmt: skip
        return ReachCertificate(controller, found, run.options(self), loop)


@dataclass(frozen=True, kw_only=True)
class Region(ReadAtTimes):
    """A region of attraction of the receding law u(0, x), for all times: proved.

    With a disturbance or a held u, or if it is `practical`, it is a set that no closed loop leaves, and a smaller set
    that each closed loop enters and never leaves. With parameters, it holds for every plant whose constant parameters
    lie in the given intervals.
    Without `time` it is about steps if V was trained for these and no option is about continuous time; otherwise u is
    read at every t.
    lyapnet.claims.region.ProvedRegion states the conditions.
    """

    kind: ClassVar[str] = "region"

    decay: float | None = option(
        None, "λ, at which V(0, ·) has to fall, in 1/s; 1 % of 1/T if none.", above=0, remedy="give it in 1/s"
    )  # fmt: skip
    states: "Box | Sequence[Sequence[float]] | None" = option(None, SET, flag="set", metavar="BOX", check=sides_of)
    disturbance: Mapping[str, float] | None = option(None, DISTURBANCE, metavar="STATE=W", check=check_disturbance)
    parameters: Mapping[str, Sequence[float]] | None = option(
        None, "A parameter of the plant that may lie anywhere between; u and V stay. May be given again.",
        flag="parameter", metavar="NAME=LOWER:UPPER", check=check_parameters,
    )  # fmt: skip
    practical: bool = option(
        False, "Claim that closed loops enter a set {V ≤ c} and stay in it, not that they converge."
    )  # fmt: skip

    def require_law(self, controller: "Controller") -> None:
        from lyapnet.claims.control_sets import require_written_law

        require_written_law(controller.closed_loop, self.kind)

    def establish(self, controller: "Controller", run: Run) -> "Certificate":
        from lyapnet.claims.arguments import box_of, disturbance_of
        from lyapnet.claims.held_laws import readings_of
        from lyapnet.claims.plants import plants_of
        from lyapnet.claims.region import prove_region
        from lyapnet.claims.region_certificate import RegionCertificate

        steps = self.about_steps(controller)
        found = prove_region(
            controller.closed_loop, controller.problem, self.decay, box_of(self.states), run.budget, run.generator,
            run.report, run.keep, disturbance=disturbance_of(self.disturbance, controller),
            plants=plants_of(controller, self.parameters) if self.parameters else None,
            readings=readings_of(self, controller, "continuous", forever=True), steps=steps, practical=self.practical,
        )  # fmt: skip
        return RegionCertificate(controller, found, run.options(self))

    def about_steps(self, controller: "Controller") -> bool:
        """Whether the claim is about the steps of the model.

        Raises:
            UsageError: it is, with a disturbance.
        """
        from lyapnet.claims.held_laws import held_options
        from lyapnet.loop.programs import RegionProgram

        made_for = isinstance(controller.program, RegionProgram) and controller.program.steps
        continuous = self.disturbance or held_options(self)
        steps = self.time == "steps" or (self.time is None and made_for and not continuous)
        if steps and self.disturbance:
            raise UsageError(
                "Expected --time steps alone, got --disturbance, which is about continuous time; leave one of them out."
            )
        return steps


@dataclass(frozen=True, kw_only=True)
class Tube(Claim):
    """A tube around all closed loops from X₀ up to T, and bounds of their costs: proved.

    lyapnet.claims.tubes.tube.ProvedTube states the conditions.
    """

    kind: ClassVar[str] = "tube"
    means: ClassVar[Sequence[str]] = ("seconds", "workers")
    share_of_two: ClassVar[float] = 0.5

    radius: float | None = option(None, RADIUS, at_least=0, remedy=NORM)

    def require_law(self, controller: "Controller") -> None:
        from lyapnet.claims.control_sets import require_written_law

        require_written_law(controller.closed_loop, self.kind)

    def establish(self, controller: "Controller", run: Run) -> "Certificate":
        from lyapnet.claims.tubes.certificate import TubeCertificate
        from lyapnet.claims.tubes.tube import prove_tube

        return TubeCertificate(
            controller, prove_tube(controller, run.budget, self.radius, run.report), run.options(self)
        )  # fmt: skip


SHARED = {"beta": "alpha", "delta": "delta", "states": "states"}
"""Field of LowerBound ↦ the matching field of the claim from above, if it has one."""


@dataclass(frozen=True, kw_only=True)
class LowerBound(Claim):
    """A lower bound of the cost of any control from each state of X₀: proved by V.

    Together with a funnel or a tube it gives a two-sided certificate; there β, δ and D are those of the funnel, unless
    they are given. lyapnet.claims.least_cost.ProvedLowerBound states the conditions.
    """

    kind: ClassVar[str] = "lower"

    beta: float | None = option(
        None, "With --two-sided: the share of V that bounds the optimum from below; 0.95 if none.", above=0, at_most=1,
        remedy="more than V is no bound from below",
    )  # fmt: skip
    delta: float | None = option(None, SLACK, at_least=0, remedy=RATE)
    states: "Box | Sequence[Sequence[float]] | None" = option(None, SET, flag="set", metavar="BOX", check=sides_of)

    def beside(self, above: Claim) -> "LowerBound":
        """A copy with β, δ and D of a claim from above, if that claim has them.

        Raises:
            UsageError: this claim has other values than the claim from above.
        """
        shared = {own: getattr(above, other) for own, other in self._shared_with(above).items()}
        for name, value in shared.items():
            own = getattr(self, name)
            if own is not None and not is_same(own, value):
                raise UsageError(f"Expected the {name} of the {above.kind} claim beside it, got another; leave it out.")
        return replace(self, **shared)

    def options_beside(self, above: Claim) -> dict[str, Any]:
        """The options that the claim from above does not have."""
        shared = {flag_of(f) for f in fields(self) if f.name in self._shared_with(above)}
        return {flag: value for flag, value in self.options.items() if flag not in shared}

    def _shared_with(self, above: Claim) -> dict[str, str]:
        return {own: other for own, other in SHARED.items() if hasattr(above, other)}

    def require_fitting(self, controller: "Controller") -> None:
        """Check the cost, the control limits and D before the claim from above is proved.

        Raises:
            UsageError: they do not suit a bound from below.
        """
        from lyapnet.claims.arguments import box_of
        from lyapnet.claims.least_cost import require_bound_from_below

        require_bound_from_below(controller.closed_loop, controller.problem, self._beta, box_of(self.states))

    @property
    def _beta(self) -> float:
        return 0.95 if self.beta is None else self.beta

    def establish(self, controller: "Controller", run: Run) -> "LowerBoundCertificate":
        from lyapnet.claims.arguments import box_of, slack_of
        from lyapnet.claims.from_below import LowerBoundCertificate
        from lyapnet.claims.least_cost import prove_lower_bound

        found = prove_lower_bound(
            controller.closed_loop, controller.problem, self._beta, slack_of(self.delta, controller),
            box_of(self.states), run.budget, run.generator, run.report, run.keep,
        )  # fmt: skip
        return LowerBoundCertificate(controller, found, run.options(self))
