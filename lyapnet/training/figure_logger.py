"""Figures during a training, for all loggers that accept images."""

import warnings
from collections.abc import Sequence

import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.loggers import Logger, MLFlowLogger, TensorBoardLogger
from matplotlib.figure import Figure
from tensorboard.compat.proto.summary_pb2 import Summary  # pyright: ignore[reportAttributeAccessIssue]

from lyapnet.base.drawing import pixels
from lyapnet.base.errors import DivergenceError
from lyapnet.base.random_streams import FIGURES, stream
from lyapnet.evaluation import figures
from lyapnet.evaluation.animation import Film
from lyapnet.evaluation.noise_figure import bands, states_to_draw
from lyapnet.evaluation.path_figure import has_plane, paths
from lyapnet.training.curves import with_loggers
from lyapnet.training.learner import Learner
from lyapnet.training.recurring import Recurring


class FigureLogger(Recurring):
    """Draws the certified region, some trajectories and slices of V of the first member during training.

    Args:
        every: steps between figures; the last validation always draws.
        animate: whether the last validation also logs an animation of closed loops.
    """

    def __init__(self, every: int, animate: bool = True):
        super().__init__(every)
        self.animate = animate

    def act(self, trainer: Trainer, pl_module: LightningModule) -> None:
        member, loggers = next(with_loggers(trainer, pl_module))
        if not trainer.is_global_zero or not any(map(_accepts_figures, loggers)):
            return
        last = self.animate and trainer.global_step == trainer.max_epochs
        in_motion = [logger for logger in loggers if last and isinstance(logger, TensorBoardLogger)]
        try:
            drawn = figures_of(member)
            film = film_of(member).gif() if in_motion else b""
        except DivergenceError as error:  # a rare state of X₀ diverges: no reason to stop training
            warnings.warn(f"No figures at step {trainer.global_step}: {error}", stacklevel=1)
            return
        for name, figure in drawn.items():
            log_figure(loggers, name, figure, trainer.global_step)
        for logger in in_motion:
            image = Summary.Image(encoded_image_string=film)
            summary = Summary(value=[Summary.Value(tag="closed_loop", image=image)])
            logger.experiment.file_writer.add_summary(summary, trainer.global_step)


def figures_of(learner: Learner) -> dict[str, Figure]:
    """Name ↦ figure of a learner's closed loops and V."""
    problem = learner.problem
    x0 = problem.initial_states.sample(12, stream(learner.seed, FIGURES))
    with torch.no_grad():
        sample = learner.roll_out(x0, FIGURES).applied(problem.controls)
        noisy = None
        if problem.noise is not None:
            noisy = learner.roll_out(states_to_draw(x0), FIGURES).applied(problem.controls)
    drawn = {
        "trajectories": figures.trajectories(sample, problem),
        "value_slices": figures.value_slices(learner.V, problem),
    }
    if problem.has_goal and problem.noise is None:
        drawn["certified_region"] = figures.certified_region(learner.rollout, problem)
    if has_plane(problem):
        drawn["paths"] = paths(sample, problem)
    if noisy is not None:
        drawn["noise"] = bands(noisy, problem)
    return drawn


def film_of(learner: Learner) -> Film:
    """The animation of closed loops from five states of X₀."""
    x0 = learner.problem.initial_states.sample(5, stream(learner.seed, FIGURES))
    with torch.no_grad():
        return Film(learner.roll_out(x0, FIGURES), learner.problem, learner.V, rate=10)


def log_figure(loggers: Sequence[Logger], name: str, figure: Figure, step: int) -> None:
    """Log a figure to TensorBoard, MLflow, and every logger with a method `log_image` like Lightning's WandbLogger."""
    image = pixels(figure)
    for logger in loggers:
        if isinstance(logger, TensorBoardLogger):
            logger.experiment.add_image(name, image, step, dataformats="HWC")
        elif isinstance(logger, MLFlowLogger):
            logger.experiment.log_figure(logger.run_id, figure, f"{name}/{step:06d}.png")
        elif _accepts_figures(logger):
            logger.log_image(key=name, images=[image], step=step)  # pyright: ignore[reportAttributeAccessIssue]


def _accepts_figures(logger: Logger) -> bool:
    return isinstance(logger, TensorBoardLogger | MLFlowLogger) or hasattr(logger, "log_image")
