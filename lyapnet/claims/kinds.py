"""The kinds of claim that lyapnet makes: their options, and what establishes them, which is imported when it is asked.

A kind of your own is a class like these, with its certificate beside it; nothing else has to know it.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar

from lyapnet.base.errors import UsageError
from lyapnet.claims.claim import Claim, Run, flag_of, is_same, option

if TYPE_CHECKING:  # as in claim.py
    from lyapnet.claims.certificates import Certificate
    from lyapnet.claims.from_below import LowerBoundCertificate
    from lyapnet.controller.controller import Controller
    from lyapnet.task.sets import Box


RADIUS = "Success at T needs ‖x(T) − goal‖ within it; not asked for if none."
SLACK = "Slack in cost per second; 0.5 % of the mean ℓ on X₀ if none."
SET = "The set D, as lower:upper,…; found if none."
PUSH = "The largest push on the derivative of a state; may be given again."
NORM, RATE = "give it in the norm of x", "give it in cost per second"  # what to do about another number


@dataclass(frozen=True, kw_only=True)
class Sampled(Claim):
    """The share of some states of X₀ whose closed loop succeeds. It proves no more."""

    kind: ClassVar[str] = "sampled"
    means: ClassVar[Sequence[str]] = ()

    samples: int = option(100, "Initial states to draw.", at_least=1, remedy="choose how many")
    radius: float | None = option(None, RADIUS, at_least=0, remedy=NORM)

    def establish(self, controller: "Controller", run: Run) -> "Certificate":
        from lyapnet.claims.preconditions import require_goal
        from lyapnet.claims.sampling_certificates import SampledCertificate
        from lyapnet.claims.statistical import count_successes

        require_goal(controller.problem, self.kind)
        tolerances = controller.program.tolerances(self.radius)
        found = count_successes(controller.rollout, controller.problem, tolerances, self.samples, run.generator)
        return SampledCertificate(controller, found, run.options(self))


@dataclass(frozen=True, kw_only=True)
class Statistical(Claim):
    """A share of X₀ whose closed loops succeed, with a confidence."""

    kind: ClassVar[str] = "statistical"
    means: ClassVar[Sequence[str]] = ()

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
            controller.rollout, controller.problem, tolerances, self.samples, self.confidence, self.share,
            run.generator, draws=self.draws,
        )  # fmt: skip
        return StatisticalCertificate(controller, found, run.options(self))


@dataclass(frozen=True, kw_only=True)
class Funnel(Claim):
    """A funnel that no closed loop leaves up to T, and a bound of the cost of each that starts in it: proved.

    The conditions are those of lyapnet.claims.funnel.ProvedFunnel.
    """

    kind: ClassVar[str] = "sound"
    share_of_two: ClassVar[float] = 0.55

    alpha: float = option(
        0.95, "Share of ℓ that V pays for.", above=0, at_most=1,
        remedy="V can pay for no more than the whole running cost",
    )  # fmt: skip
    delta: float | None = option(None, SLACK, at_least=0, remedy=RATE)
    states: "Box | Sequence[Sequence[float]] | None" = option(None, SET, flag="set", metavar="BOX")
    disturbance: Mapping[str, float] | None = option(None, PUSH, metavar="STATE=W")

    def establish(self, controller: "Controller", run: Run) -> "Certificate":
        from lyapnet.claims.arguments import box_of, pushes_of, slack_of
        from lyapnet.claims.funnel import prove_funnel
        from lyapnet.claims.least_cost import DEGREE
        from lyapnet.claims.preconditions import require_goal
        from lyapnet.claims.sound_certificate import SoundCertificate

        require_goal(controller.problem, self.kind)
        found = prove_funnel(
            controller.closed_loop, controller.problem, self.alpha, slack_of(self.delta, controller),
            box_of(self.states), run.budget, run.generator, run.report, run.keep, degree=DEGREE if run.two_sided else 2,
            disturbance=pushes_of(self.disturbance, controller),
        )  # fmt: skip
        return SoundCertificate(controller, found, run.options(self))


@dataclass(frozen=True, kw_only=True)
class Region(Claim):
    """A region of attraction of the receding law u(0, x), for ever: proved.

    With a disturbance it is a set that no closed loop leaves, and a smaller one that each comes to; with parameters it
    is so for every plant whose constant parameters lie between these ends. The conditions are those of
    lyapnet.claims.region.ProvedRegion.
    """

    kind: ClassVar[str] = "region"

    decay: float | None = option(
        None, "λ, at which V(0, ·) has to fall, in 1/s; 1 % of 1/T if none.", above=0, remedy="give it in 1/s"
    )  # fmt: skip
    states: "Box | Sequence[Sequence[float]] | None" = option(None, SET, flag="set", metavar="BOX")
    disturbance: Mapping[str, float] | None = option(None, PUSH, metavar="STATE=W")
    parameters: Mapping[str, Sequence[float]] | None = option(
        None, "A parameter of the plant that may lie anywhere between; u and V stay. May be given again.",
        flag="parameter", metavar="NAME=LOWER:UPPER",
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, ends in (self.parameters or {}).items():
            if len(ends) != 2 or not -math.inf < ends[0] <= ends[1] < math.inf:
                raise UsageError(
                    f"Expected --parameter {name}=LOWER:UPPER, LOWER ≤ UPPER and finite, got {ends}; correct it."
                )

    def establish(self, controller: "Controller", run: Run) -> "Certificate":
        from lyapnet.claims.arguments import box_of, pushes_of
        from lyapnet.claims.plants import plants_of
        from lyapnet.claims.region import prove_region
        from lyapnet.claims.region_certificate import RegionCertificate

        found = prove_region(
            controller.closed_loop, controller.problem, self.decay, box_of(self.states), run.budget, run.generator,
            run.report, run.keep, disturbance=pushes_of(self.disturbance, controller),
            plants=plants_of(controller, self.parameters) if self.parameters else None,
        )  # fmt: skip
        return RegionCertificate(controller, found, run.options(self))


@dataclass(frozen=True, kw_only=True)
class Tube(Claim):
    """Where all closed loops from X₀ go up to T, and what they cost: proved.

    The conditions are those of lyapnet.claims.tubes.tube.ProvedTube.
    """

    kind: ClassVar[str] = "tube"
    means: ClassVar[Sequence[str]] = ("seconds", "workers")
    share_of_two: ClassVar[float] = 0.5

    radius: float | None = option(None, RADIUS, at_least=0, remedy=NORM)

    def establish(self, controller: "Controller", run: Run) -> "Certificate":
        from lyapnet.claims.tubes.certificate import TubeCertificate
        from lyapnet.claims.tubes.tube import prove_tube

        return TubeCertificate(
            controller, prove_tube(controller, run.budget, self.radius, run.report), run.options(self)
        )  # fmt: skip


SHARED = {"beta": "alpha", "delta": "delta", "states": "states"}
"""A field of a bound from below ↦ the same of a claim from above, where that has it."""


@dataclass(frozen=True, kw_only=True)
class LowerBound(Claim):
    """What any control costs at least, from each state of X₀: proved by V.

    Beside a funnel or a tube it makes a certificate from two sides; there β, δ and D are those of the funnel where none
    are given. The conditions are those of lyapnet.claims.least_cost.ProvedLowerBound.
    """

    kind: ClassVar[str] = "lower"

    beta: float | None = option(
        None, "With --two-sided: the share of V that bounds the optimum from below; 0.95 if none.", above=0, at_most=1,
        remedy="more than V is no bound from below",
    )  # fmt: skip
    delta: float | None = option(None, SLACK, at_least=0, remedy=RATE)
    states: "Box | Sequence[Sequence[float]] | None" = option(None, SET, flag="set", metavar="BOX")

    def beside(self, above: Claim) -> "LowerBound":
        """The same with the share, the slack and the set of a claim from above that has them.

        Raises:
            UsageError: it was given others than that claim, or some where that claim finds its own.
        """
        taken = {mine: getattr(above, its) for mine, its in self._shared_with(above).items()}
        for name, value in taken.items():
            own = getattr(self, name)
            if own is not None and not is_same(own, value):
                raise UsageError(f"Expected the {name} of the {above.kind} claim beside it, got another; leave it out.")
        return replace(self, **taken)

    def options_beside(self, above: Claim) -> dict[str, Any]:
        """Its options that the claim from above has not."""
        shared = {flag_of(f) for f in fields(self) if f.name in self._shared_with(above)}
        return {flag: value for flag, value in self.options.items() if flag not in shared}

    def _shared_with(self, above: Claim) -> dict[str, str]:
        return {mine: its for mine, its in SHARED.items() if hasattr(above, its)}

    def require_fitting(self, controller: "Controller") -> None:
        """Refuse at once a cost, limits or a set D that do not fit.

        Raises:
            UsageError: they do not.
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
