"""The Lightning trainer of a run, with its loggers and callbacks."""

from functools import partial

import lightning as L
from rich.console import Console

from lyapnet.experiment.config import configs_of_seeds
from lyapnet.training.best_weights import ReturnToBest
from lyapnet.training.certified_share import CertifiedShare
from lyapnet.training.checkpoint_files import CheckpointFiles
from lyapnet.training.checkpoints import Checkpoints, KeptStart
from lyapnet.training.compilation import Compilation
from lyapnet.training.curves import ScalarLogger, Stopwatch
from lyapnet.training.dashboard import Dashboard
from lyapnet.training.figure_logger import FigureLogger
from lyapnet.training.loggers import loggers_of_run
from lyapnet.training.lost_states import LostStates
from lyapnet.training.plan import Plan
from lyapnet.training.progress import TrainingProgress
from lyapnet.training.settling import Settling
from lyapnet.training.stage_messages import PATIENCE, StageMessages
from lyapnet.training.trainer_options import trainer_options
from lyapnet.training.validation_optimum import ValidationOptimum


def build_trainer(plan: Plan, console: Console) -> L.Trainer:
    """The trainer of a planned run; writes no files."""
    config, resumed_at = plan.config, plan.step if plan.resume_from else None
    loggers = [logger for run in plan.run.members(config) for logger in loggers_of_run(config, run, resumed_at)]
    return L.Trainer(
        max_epochs=config.training.iterations,  # an epoch is one step
        check_val_every_n_epoch=config.training.validate_every,
        log_every_n_steps=1,
        num_sanity_val_steps=0,
        inference_mode=False,  # figures and certificates need V_x after a validation too
        enable_model_summary=False,
        use_distributed_sampler=False,  # each process has its own random stream
        default_root_dir=plan.run.folder,
        logger=loggers,
        callbacks=_callbacks(plan, console),
        plugins=[CheckpointFiles()],
        **trainer_options(config),
    )


def _callbacks(plan: Plan, console: Console) -> list[L.Callback]:
    """All callbacks, in the order in which they are called."""
    config, run, stopwatch = plan.config, plan.run, Stopwatch()
    options, every, members = config.evaluation, config.training.validate_every, plan.module.members
    best = {member.label: one.best for member, one in zip(members, run.members(config), strict=True)}
    certified = CertifiedShare(every * options.certify_every, options.certified_states, options.confidence)
    stages = StageMessages(console, "training", PATIENCE)
    return [
        KeptStart(best),
        *_compilation(plan, stages),
        ValidationOptimum(stages, options.optimum),
        Dashboard(configs_of_seeds(config)),
        stopwatch,
        ScalarLogger(stopwatch),
        FigureLogger(every * options.figures_every, options.animate),
        *([certified] if options.certify_every else []),
        TrainingProgress(stages),
        *([LostStates()] if config.training.lost_share else []),
        ReturnToBest(config.training.least_gain > 0, partial(console.print, soft_wrap=True), run.note_return),
        Settling(config.training.least_gain, config.training.warmup, stages),
        *plan.callbacks,
        Checkpoints(run.last, best, every, partial(run.note, saved=True)),
    ]


def _compilation(plan: Plan, stages: StageMessages) -> list[Compilation]:
    """The callback that compiles the run, if allowed; a resumed run is compiled only if it was before."""
    options = plan.config.rollout
    is_resumed = plan.resume_from is not None
    if options.gradient != "discrete" or options.compile == "off" or (is_resumed and not plan.run.compiled):
        return []
    return [Compilation(stages, plan.config.training.batch_size, plan.run.note)]
