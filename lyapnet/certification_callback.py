"""How much of X₀ is certified, as a curve over the training."""

from lightning.pytorch import Callback, LightningModule, Trainer

from lyapnet.callbacks import log_scalars, trained_module, with_writers
from lyapnet.certificates import default_tolerances, lower_bounds
from lyapnet.certification import StatisticalClaim, statistical_claim
from lyapnet.modules import ProgramModule
from lyapnet.randomness import CERTIFICATION, stream


class CertifiedShare(Callback):
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
        self.every, self.states, self.confidence = every, states, confidence

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.global_step == 0:
            self._certify(trainer, pl_module)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        step = trainer.global_step
        if step % self.every == 0 or step == trainer.max_epochs:
            self._certify(trainer, pl_module)

    def _certify(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not trainer.is_global_zero:
            return
        for member, curves in with_writers(trainer, trained_module(pl_module)):
            bounds = lower_bounds(self.claim_of(member, trainer.global_step))
            log_scalars(trainer, curves, {f"{name}/val": bound for name, bound in bounds.items()})

    def claim_of(self, member: ProgramModule, step: int) -> StatisticalClaim:
        """The claim about a member as it is at a step; without a radius, as `lyapnet certify` by default."""
        config = member.config
        return statistical_claim(
            member.closed_loop, member.task.initial_states, default_tolerances(config.program.name), self.states,
            self.confidence, generator=stream(config.seed, CERTIFICATION, step),
        )  # fmt: skip
