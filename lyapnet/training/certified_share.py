"""How much of X₀ is certified, as a curve over the training."""

from lightning.pytorch import LightningModule, Trainer

from lyapnet.base.random_streams import CERTIFICATION, stream
from lyapnet.claims.statistical import BoundedShare, bound_share
from lyapnet.training.curves import log_scalars, with_loggers
from lyapnet.training.learner import Learner
from lyapnet.training.recurring import Recurring


class CertifiedShare(Recurring):
    """Logs the statistical bound of each member: a share of X₀ that succeeds, at a confidence, and one for each event.

    Its states are drawn by a stream of (seed, step) of their own: nothing was trained, validated or chosen on them, and
    a resumed run draws what it would have drawn. Each bound holds at its confidence by itself. Not all of K at once
    (that at 1 − K(1 − confidence)), and not the best of them, nor that of a checkpoint chosen because of it: what
    training leaves behind is certified by `lyapnet certify`, on states that it has not seen.

    Args:
        every: steps between bounds; the last validation always has one.
        states: drawn for each.
        confidence: of each.
    """

    def __init__(self, every: int, states: int, confidence: float):
        super().__init__(every)
        self.states, self.confidence = states, confidence

    def act(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not trainer.is_global_zero:
            return
        for member, loggers in with_loggers(trainer, pl_module):
            bounds = self.claim_of(member, trainer.global_step).named_bounds
            log_scalars(trainer, loggers, {f"{name}/val": bound for name, bound in bounds.items()})

    def claim_of(self, member: Learner, step: int) -> BoundedShare:
        """The claim about a member as it is at a step; without a radius, as `lyapnet certify` by default."""
        return bound_share(
            member.rollout, member.problem, member.program.tolerances(), self.states, self.confidence,
            generator=stream(member.seed, CERTIFICATION, step),
        )  # fmt: skip
