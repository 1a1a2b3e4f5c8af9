"""Builds the learner of one seed from a config. Does not import Lightning, which takes two seconds."""

import csv
import io
from pathlib import Path

import torch
from torch import Tensor

from lyapnet.base.errors import UsageError
from lyapnet.base.files import read_file
from lyapnet.experiment.assembly import (
    Parts,
    build_plants,
    build_problem,
    build_program,
    build_rollout,
    build_value_function,
    entry_per_state,
)
from lyapnet.experiment.config import Config, to_plain
from lyapnet.loop.programs import PointwiseCondition, Program, RegionCondition, RegionProgram
from lyapnet.loop.rollout import Rollout
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box
from lyapnet.training.learner import Learner
from lyapnet.value.linearisation import smooth_kinks


def build_problem_to_train(config: Config, parts: Parts) -> Problem:
    """The problem that is trained: kinks of the cost at the goal are smoothed, constraints become a penalty.

    Raises:
        UsageError: as build_problem.
    """
    return smooth_kinks(build_problem(config, parts)).relaxed()


def build_learner(config: Config, problem: Problem, parts: Parts | None = None, label: str = "") -> Learner:
    """The learner of one seed of a config."""
    parts = parts or Parts()
    V = build_value_function(config, problem, parts.network)
    rollout, program = build_rollout(config, problem, V), parts.program or build_program(config)
    pointwise, plants = build_pointwise(config, rollout, program), build_plants(config, rollout)
    learner = Learner(problem, V, rollout, program, pointwise, config.seed, label, plants)
    learner.metadata = {"config": to_plain(config), "problem": problem.record()}
    return learner


def build_pointwise(config: Config, rollout: Rollout, program: Program) -> PointwiseCondition | None:
    """The program's condition at points off the closed loops; None if its weight is zero.

    Raises:
        UsageError: the region or the file of counterexamples does not fit the system.
    """
    options, problem = config.pointwise, rollout.problem
    weight = program.pointwise if options.weight is None else options.weight
    cls = RegionCondition if isinstance(program, RegionProgram) else PointwiseCondition
    if cls is RegionCondition and not (problem.horizon.stationary and weight):
        raise UsageError(
            "Expected horizon.stationary: true and pointwise.weight > 0 with the region program, got one or none of "
            "them; its V has no time, and points of D are what it is about."
        )
    if cls is RegionCondition and problem.system.constants:
        raise UsageError(
            "Expected one system with the region program, got a family; the region is that of one member: leave family "
            "out, or take program.name=lyapunov."
        )
    if not weight:
        return None
    n, goal, initial_states = problem.system.n, problem.goal, problem.initial_states
    default = 1.5 * initial_states.reach_from(goal)
    extent = entry_per_state("pointwise.region", options.region, problem.system) or default.tolist()
    if min(extent) <= 0:
        raise UsageError("Expected pointwise.region, got none, and X₀ is thin; give a bound of each |x_i|.")
    reach = torch.tensor(extent, dtype=torch.float64).to(goal)
    region = Box(goal - reach, goal + reach)
    further = None if options.counterexamples is None else _read_points(Path(options.counterexamples), n).to(goal)
    return cls(rollout, program, region, weight, options.points, further, options.floor)


def _read_points(path: Path, n: int) -> Tensor:
    """Read the points (t, x) of a CSV file with a header line; shape (k, 1 + n)."""
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
