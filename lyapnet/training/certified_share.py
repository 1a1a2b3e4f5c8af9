"""The curve of the certified share of X₀ during training."""

from lightning.pytorch import LightningModule, Trainer

from lyapnet.base.random_streams import CERTIFICATION, stream
from lyapnet.claims.statistical import BoundedShare, bound_share
from lyapnet.training.curves import log_scalars, with_loggers
from lyapnet.training.learner import Learner
from lyapnet.training.recurring import Recurring


class CertifiedShare(Recurring):
    """Logs for each member a lower bound of the share of X₀ that succeeds, and one for each event, at a confidence.

    The states come from a separate random stream of (seed, step): training, validation and the choice of the best
    checkpoint never use them, and a resumed run draws the same ones. Each bound holds at its confidence by itself. The
    confidence does not cover all K bounds at once (that needs 1 − K(1 − confidence)), nor the largest of them, nor a
    checkpoint that was chosen by its bound. Certify the final controller with `lyapnet certify`, on new states.

    Args:
        every: steps between bounds; the last validation always has one.
        states: number of states drawn for each bound.
        confidence: confidence of each bound.
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
        """The claim about a member at a step, with the defaults of `lyapnet certify statistical`: no radius."""
        return bound_share(
            member.rollout, member.problem, member.program.tolerances(), self.states, self.confidence,
            generator=stream(member.seed, CERTIFICATION, step),
        )  # fmt: skip
