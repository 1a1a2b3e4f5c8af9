"""From a config to what Lightning trains: modules, data, and the user's own callbacks."""

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
    """What trains a config: one V, or an ensemble of seeds.

    Args:
        parts: taken instead of those that the config names.

    Raises:
        UsageError: as build_problem and its like.
    """
    parts = parts_of(config) if parts is None else parts
    problem, options = build_problem_to_train(config, parts), _optimizer_options(config.training)
    if config.seeds == 1:
        one = build_learner(config, problem, parts)
        module = ValueModule(problem, one.V, one.program, one.rollout, one.pointwise, options, config.seed)
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
    """The batches that a config trains and validates on."""
    training = config.training
    options = (problem, training.batch_size, config.evaluation.validation_states, config.seed)
    if config.seeds > 1:
        return EnsembleDataModule(*options, config.seeds, training.lost_share)
    return InitialStateDataModule(*options, lost_share=training.lost_share)


def build_callbacks(config: Config) -> list[L.Callback]:
    """The user's own callbacks.

    Raises:
        UsageError: one that cannot be imported, is no Lightning callback, or needs arguments.
    """
    found = []
    for name in config.callbacks:
        cls = resolve(name, {}, "callbacks", L.Callback)
        try:
            found.append(cls())
        except TypeError as error:
            raise UsageError(
                f"Expected callbacks without arguments, got {name} ({error}); give its arguments defaults."
            ) from error
    return found
