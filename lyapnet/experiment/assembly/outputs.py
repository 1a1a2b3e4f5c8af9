"""Builds the outputs of a config."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly.classes import section
from lyapnet.experiment.assembly.entries import by_state, index_among, index_of, repeated, require_length
from lyapnet.experiment.config import OutputsConfig
from lyapnet.loop.estimation.kalman import initial_deviation, least_drift
from lyapnet.task.input_disturbances import with_input_disturbances
from lyapnet.task.outputs import MeasuredStates, Outputs, SystemOutput
from lyapnet.task.problem import TEST_STATES, Problem
from lyapnet.task.systems import moving_states

ASSUMED, DISTURBANCES = "outputs.process_noise", "outputs.input_disturbances"
WALKING = "name states, or parameters of a family or of randomise."


def build_outputs(config: OutputsConfig, problem: Problem) -> Outputs | None:
    """The outputs of a config for a problem in float64; None if it has none.

    Raises:
        UsageError: a name, a length or a number does not fit, or h breaks its contract.
    """
    if config.noise is None:
        if config != OutputsConfig():
            raise UsageError(
                "Expected outputs.noise, the standard deviation of each reading, got none; give one for each."
            )
        return None
    system, name = problem.system, type(problem.system).__name__
    with section("outputs"):
        if config.measure:
            states = [index_of(each, "outputs.measure", system) for each in config.measure]
            if repeated_states := [i for k, i in enumerate(states) if i in states[:k]]:
                twice = system.state_names[repeated_states[0]]
                raise UsageError(f"Expected outputs.measure with each state once, got {twice} twice.")
            noise = repeated(config.noise, len(states))
            require_length("outputs.noise", len(noise), config.measure)
            return MeasuredStates(system, states, noise)
        if not system.has_output:
            raise UsageError(
                f"Expected outputs.measure, or a method output(x) of {name}, got neither; name the states that are "
                f"measured, of {', '.join(system.state_names)}."
            )
        x = problem.initial_states.sample(TEST_STATES, torch.Generator().manual_seed(0))
        return SystemOutput(system, config.noise, x)


def problem_of_estimator(config: OutputsConfig, problem: Problem) -> Problem:
    """The problem whose states are estimated: (x, d) if the config names disturbances d of controls.

    Their initial standard deviation is σ√T, that of their drift over the horizon.

    Raises:
        UsageError: a name is no control.
    """
    if not config.input_disturbances:
        return problem
    names = problem.system.control_names
    controls = [index_among(name, DISTURBANCES, names, "name controls.") for name in config.input_disturbances]
    root = math.sqrt(problem.horizon.duration)
    return with_input_disturbances(problem, controls, [root * drift for drift in config.input_disturbances.values()])


def drift_of(config: OutputsConfig, problem: Problem) -> Tensor:
    """The random walk (n,) that an estimator assumes of each of its states besides the noise of the problem.

    If neither a walk of x nor noise of the problem is given, it is `least_drift`.

    Args:
        problem: the problem of the estimator.

    Raises:
        UsageError: a name is no state.
    """
    least = least_drift(problem)
    drift = torch.zeros_like(least) if config.process_noise or problem.noise is not None else least
    for i, strength in by_state(config.process_noise, ASSUMED, problem.system, WALKING).items():
        drift[i] = strength
    if config.input_disturbances:
        drift[-len(config.input_disturbances) :] = drift.new_tensor([*config.input_disturbances.values()])
    return drift


def deviation_of(config: OutputsConfig, problem: Problem) -> Tensor:
    """The standard deviation (n,) of the first estimate of each state; for parameters that of their range.

    Raises:
        UsageError: the length does not fit.
    """
    deviation, system = initial_deviation(problem), problem.system
    if config.initial_deviation is not None:
        moving = [system.state_names[i] for i in moving_states(system)]
        given = repeated(config.initial_deviation, len(moving))
        require_length("outputs.initial_deviation", len(given), moving)
        deviation[: len(moving)] = deviation.new_tensor(given)
    return deviation


class EstimatorParts(NamedTuple):
    """The parts of an estimator, in float64."""

    problem: Problem  # the problem whose states are estimated
    outputs: Outputs  # the readings of these states
    drift: Tensor  # see drift_of
    deviation: Tensor  # see deviation_of


def estimator_parts(config: OutputsConfig, problem: Problem) -> EstimatorParts | None:
    """The parts of an estimator for a problem in float64; None if the config has no outputs.

    Raises:
        UsageError: as the functions above, or there are more disturbances than readings.
    """
    if (outputs := build_outputs(config, problem)) is None:
        return None
    estimated = problem_of_estimator(config, problem)
    if isinstance(outputs, SystemOutput) and estimated is not problem:
        outputs = build_outputs(config, estimated)  # output(x) of (x, d)
        assert outputs is not None
    parts = EstimatorParts(estimated, outputs, drift_of(config, estimated), deviation_of(config, estimated))
    if len(config.input_disturbances) > outputs.count:
        raise UsageError(
            f"Expected at most as many {DISTURBANCES} as readings, {outputs.count}, got "
            f"{len(config.input_disturbances)}; leave some out: the readings do not determine more."
        )
    return parts
