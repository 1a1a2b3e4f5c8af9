"""Builds the LightningModule, the data module and the user's callbacks from a config."""

import lightning as L

from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly import Parts, parts_of, resolve
from lyapnet.experiment.config import Config, TrainingConfig, configs_of_seeds, label_of, to_plain
from lyapnet.task.problem import Problem
from lyapnet.training.build_learner import build_learner, build_problem_to_train
from lyapnet.training.data import EnsembleDataModule, InitialStateDataModule
from lyapnet.training.modules import EnsembleModule, TrainingModule, ValueModule
from lyapnet.training.optimizer import OptimizerOptions


def build_module(config: Config, parts: Parts | None = None) -> TrainingModule:
    """The LightningModule of a config: for one V, or for an ensemble of seeds.

    Args:
        parts: objects that replace those named in the config.

    Raises:
        UsageError: as build_problem, build_value_function and build_program.
    """
    parts = parts_of(config) if parts is None else parts
    problem, options = build_problem_to_train(config, parts), _optimizer_options(config.training)
    if config.seeds == 1:
        learner = build_learner(config, problem, parts)
        module = ValueModule(
            problem, learner.V, learner.program, learner.rollout, learner.pointwise, options, config.seed,
            learner.plants,
        )  # fmt: skip
    else:
        members = [build_learner(each, problem, parts, label_of(each)) for each in configs_of_seeds(config)]
        module = EnsembleModule(members, options)
    module.metadata = {"config": to_plain(config), "problem": problem.record()}
    return module


def _optimizer_options(training: TrainingConfig) -> OptimizerOptions:
    return OptimizerOptions(
        training.optimizer, training.learning_rate, training.final_learning_rate, (training.beta1, training.beta2),
        training.weight_decay, training.warmup, training.iterations,
    )  # fmt: skip


def build_data(config: Config, problem: Problem) -> InitialStateDataModule:
    """The data module with the training and validation batches of a config."""
    training = config.training
    options = (problem, training.batch_size, config.evaluation.validation_states, config.seed)
    if config.seeds > 1:
        return EnsembleDataModule(*options, config.seeds, training.lost_share)
    return InitialStateDataModule(*options, lost_share=training.lost_share)


def build_callbacks(config: Config) -> list[L.Callback]:
    """The user's callbacks.

    Raises:
        UsageError: a callback cannot be imported, is no Lightning callback, or needs arguments.
    """
    callbacks = []
    for name in config.callbacks:
        cls = resolve(name, {}, "callbacks", L.Callback)
        try:
            callbacks.append(cls())
        except TypeError as error:
            raise UsageError(
                f"Expected callbacks without arguments, got {name} ({error}); give its arguments defaults."
            ) from error
    return callbacks
