"""The layout of TensorBoard's curves, and the config as text."""

import textwrap
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import TensorBoardLogger

from lyapnet.experiment.config import Config, abridge_texts, to_plain, to_yaml
from lyapnet.training.curves import loggers_of_each, members_of

# A panel for each measure with a chart for each curve: TensorBoard draws all curves of a run in one colour.
PANELS = {
    "constraint loss": ("constraint_loss/train", "constraint_loss/val"),
    "trajectory cost": ("trajectory_cost/train", "trajectory_cost/val"),
    "optimality": ("optimality_gap/val", "value_error/val"),
    "condition": ("satisfied_fraction/val", "falling_fraction/val"),
}
WITHOUT_GOAL = {**PANELS, "optimality": ("regret/val", "value_error/val")}
del WITHOUT_GOAL["condition"]


def layout(has_goal: bool) -> dict[str, dict[str, list[Any]]]:
    """TensorBoard's panels of curves for a task with or without a goal."""
    panels = PANELS if has_goal else WITHOUT_GOAL
    return {panel: {curve: ["Multiline", [curve]] for curve in curves} for panel, curves in panels.items()}


class Dashboard(Callback):
    """Logs each member's config before the first step; in TensorBoard also the layout of the curves.

    Args:
        configs: one config for each member.
    """

    def __init__(self, configs: list[Config]):
        self.configs = configs

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not trainer.is_global_zero:
            return
        for loggers, config in zip(loggers_of_each(trainer, pl_module), self.configs, strict=True):
            for logger in loggers:
                if not isinstance(logger, TensorBoardLogger):
                    logger.log_hyperparams(to_plain(abridge_texts(config)))
                elif trainer.global_step == 0:
                    logger.experiment.add_custom_scalars(layout(members_of(pl_module)[0].problem.has_goal))
                    logger.experiment.add_text("config", textwrap.indent(to_yaml(abridge_texts(config)), "    "))
