"""The LightningModules: each wraps one program. What they compute stands in programs/; what is logged, in callbacks."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import lightning as L
import torch
from torch import Tensor

from lyapnet import __version__
from lyapnet.build import Task, build_program, build_rollout, build_value_function
from lyapnet.checkpoint import KEY
from lyapnet.config import Config, TrainingConfig, to_plain
from lyapnet.errors import DivergenceError
from lyapnet.evaluation import StateTable, measure
from lyapnet.oracles import optimal_cost
from lyapnet.rollout import ADAPTIVE_METHODS
from lyapnet.types import PerState, State


class ProgramModule(L.LightningModule):
    """Minimises a program over the weights of V, through the closed loop of V's own policy."""

    def __init__(self, config: Config, task: Task):
        super().__init__()
        self.config, self.task = config, task
        self.initial_states = task.initial_states  # registered, so that X₀ follows the module from device to device
        self.V = build_value_function(config, task)
        self.closed_loop = build_rollout(config, task, self.V)
        self.program = build_program(config)
        self.oracle: Callable[[State], PerState] | None = optimal_cost(
            task.system, task.cost, task.horizon, config.rollout.method
        )
        self.gradient_norm = self.steps_per_second = math.nan  # of the last training step, for whoever shows them
        self.validation: StateTable | None = None

    def training_step(self, x0: State, batch_idx: int) -> dict[str, Any]:
        """One evaluation of the program on a batch (b, n) of initial states."""
        with self._naming_iteration():
            output = self.program(self.V, self.closed_loop(x0))
        return {
            "loss": output.loss,
            "terms": {name: term.detach() for name, term in output.terms.items()},
            "constraint_loss": output.constraint_loss.detach(),
            "trajectory_cost": output.trajectory_cost.detach(),
        }

    def backward(self, loss: Tensor, *args: Any, **kwargs: Any) -> None:
        """Lightning's, which also meets an adaptive adjoint that gives up."""
        try:
            super().backward(loss, *args, **kwargs)
        except AssertionError as error:
            if self.config.rollout.method not in ADAPTIVE_METHODS:
                raise
            raise DivergenceError(
                f"Iteration {self.global_step}: Expected the adjoint to reach t = 0, got {error}; lower "
                "training.learning_rate, or take rollout.gradient=backprop."
            ) from error

    def validation_step(self, x0: State, batch_idx: int) -> None:
        """The table of the fixed validation states, and the loss that picks the best checkpoint."""
        self.log("loss/val", self.validate_on(x0), logger=False, sync_dist=True)

    def validate_on(self, x0: State) -> Tensor:
        """Fill `validation` with the table of these states; the program's loss on them."""
        with self._naming_iteration():
            trajectory = self.closed_loop(x0)
            self.validation = measure(self.V, trajectory, self.program, self.oracle)
            return self.program(self.V, trajectory).loss

    @contextmanager
    def _naming_iteration(self) -> Iterator[None]:
        try:
            yield
        except DivergenceError as error:
            raise DivergenceError(f"Iteration {self.global_step}: {error}") from error

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Record the gradient's norm; refuse to step along one that is not finite."""
        norms = [p.grad.norm() for p in self.V.parameters() if p.grad is not None]
        self.gradient_norm = float(torch.stack(norms).norm())
        if not math.isfinite(self.gradient_norm):
            raise DivergenceError(
                f"Iteration {self.global_step}: Expected a finite gradient, got norm {self.gradient_norm}; lower "
                "training.learning_rate or set trainer.gradient_clip_val."
            )

    def configure_optimizers(self) -> dict[str, Any]:
        options = self.config.training
        classes = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW}
        optimizer = classes[options.optimizer](
            self.V.parameters(),
            lr=options.learning_rate,
            betas=(options.beta1, options.beta2),
            weight_decay=options.weight_decay,
        )
        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: cosine_decay(step, options))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add what `lyapnet.load` needs, as plain data."""
        checkpoint[KEY] = {"config": to_plain(self.config), "version": __version__}


class ValueModule(ProgramModule):
    """The value program: V becomes the cost-to-go of its greedy policy."""


class LyapunovModule(ProgramModule):
    """The Lyapunov program: V falls along the closed loop at least as fast as the cost accrues."""


MODULES: dict[str, type[ProgramModule]] = {"value": ValueModule, "lyapunov": LyapunovModule}


def cosine_decay(step: int, options: TrainingConfig) -> float:
    """The learning rate at a step, as a share of the first: half a cosine down to `final_learning_rate`."""
    final = options.final_learning_rate / options.learning_rate
    progress = min(step / options.iterations, 1.0)
    return final + (1 - final) * (1 + math.cos(math.pi * progress)) / 2
