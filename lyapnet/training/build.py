"""From a config to what trains: modules, data, and the user's own callbacks."""

import csv
import io
from pathlib import Path

import lightning as L
import torch
from torch import Tensor

from lyapnet.build import (
    Parts,
    build_problem,
    build_program,
    build_rollout,
    build_value_function,
    entry_per_state,
    parts_of,
    resolve,
)
from lyapnet.config import Config, TrainingConfig, configs_of_seeds, label_of, to_plain
from lyapnet.errors import UsageError
from lyapnet.files import read_file
from lyapnet.problem import Problem
from lyapnet.programs import PointwiseCondition, Program, RegionCondition, RegionProgram
from lyapnet.rollout import Rollout
from lyapnet.sets import Box
from lyapnet.training.data import EnsembleDataModule, InitialStateDataModule
from lyapnet.training.learner import Learner
from lyapnet.training.modules import EnsembleModule, TrainingModule, ValueModule
from lyapnet.training.optimizer import OptimizerOptions


def build_module(config: Config, parts: Parts | None = None) -> TrainingModule:
    """What trains a config: one V, or an ensemble of seeds.

    Args:
        parts: taken instead of those that the config names.

    Raises:
        UsageError: as build_problem and its like; or the seeds cannot train as one batch.
    """
    parts = parts_of(config) if parts is None else parts
    problem, options = build_problem(config, parts).relaxed(), _optimizer_options(config.training)
    if config.seeds == 1:
        one = build_learner(config, problem, parts)
        module = ValueModule(problem, one.V, one.program, one.rollout, one.pointwise, options, config.seed)
    else:
        members = [build_learner(each, problem, parts, label_of(each)) for each in configs_of_seeds(config)]
        module = EnsembleModule(members, config.training.batch_size, options)
    module.metadata = {"config": to_plain(config), "problem": problem.record()}
    return module


def build_learner(config: Config, problem: Problem, parts: Parts | None = None, label: str = "") -> Learner:
    """What one seed of a config trains."""
    parts = parts or Parts()
    V = build_value_function(config, problem, parts.network)
    rollout, program = build_rollout(config, problem, V), parts.program or build_program(config)
    learner = Learner(problem, V, rollout, program, build_pointwise(config, rollout, program), config.seed, label)
    learner.metadata = {"config": to_plain(config), "problem": problem.record()}
    return learner


def _optimizer_options(training: TrainingConfig) -> OptimizerOptions:
    return OptimizerOptions(
        training.optimizer, training.learning_rate, training.final_learning_rate, (training.beta1, training.beta2),
        training.weight_decay, training.warmup, training.iterations,
    )  # fmt: skip


def build_pointwise(config: Config, rollout: Rollout, program: Program) -> PointwiseCondition | None:
    """The program's condition off the closed loops; None without weight.

    Raises:
        UsageError: a region or a file of counterexamples that does not fit the system.
    """
    options, problem = config.pointwise, rollout.problem
    weight = program.pointwise if options.weight is None else options.weight
    made = RegionCondition if isinstance(program, RegionProgram) else PointwiseCondition
    if made is RegionCondition and not (problem.horizon.stationary and weight):
        raise UsageError(
            "Expected horizon.stationary: true and pointwise.weight > 0 with the region program, got none; its V has "
            "no time, and points of D are what it is about."
        )
    if not weight:
        return None
    n, goal, initial_states = problem.system.n, problem.goal, problem.initial_states
    furthest = initial_states.reach_from(goal)
    extent = entry_per_state("pointwise.region", options.region, problem.system) or (1.5 * furthest).tolist()
    if min(extent) <= 0:
        raise UsageError("Expected pointwise.region, got none, and X₀ is thin; give a bound of each |x_i|.")
    reach = torch.tensor(extent, dtype=torch.float64).to(goal)
    region = Box(goal - reach, goal + reach)
    further = None if options.counterexamples is None else _points_of(Path(options.counterexamples), n).to(goal)
    return made(rollout, program, region, weight, options.points, further, options.floor)


def _points_of(path: Path, n: int) -> Tensor:
    """The points (t, x) of a CSV file with a header, (k, 1 + n)."""
    try:
        heading, *lines = csv.reader(io.StringIO(read_file(path).decode(), newline=""))
        if heading[:1] != ["t"]:
            raise ValueError("no heading t, …")
        rows = [[float(entry) for entry in row] for row in lines]
        points = torch.tensor(rows, dtype=torch.float64) if rows else torch.empty(0, 1 + n)
        if points.shape[-1:] != (1 + n,) or not points.isfinite().all():
            raise ValueError(f"{len(rows)} rows of {points.shape[-1]}, or not finite")
    except (OSError, ValueError, csv.Error) as error:
        raise UsageError(
            f"Expected pointwise.counterexamples as a CSV of rows t, x_1, …, x_{n}, got {str(path)!r} ({error}); "
            "see lyapnet certify --refine."
        ) from error
    return points


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
