"""Builds the noise of a config."""

from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly.classes import section
from lyapnet.experiment.assembly.entries import by_state
from lyapnet.experiment.config import Config
from lyapnet.loop.rollout.expectations import MOST_SOURCES
from lyapnet.task.noise import Noise, StateNoise
from lyapnet.task.problem import Problem
from lyapnet.task.systems import ControlSystem


def build_noise(config: Config, system: ControlSystem) -> Noise | None:
    """The noise of a config; None if it lists none, and the system's own applies.

    Raises:
        UsageError: a name or a number does not fit, the system declares noise too, or the task can have none.
    """
    if config.noise and system.noisy:
        raise UsageError(
            f"Expected noise in the config or noise(x) in {type(system).__name__}, got both; leave one of them out."
        )
    if not config.noise and not system.noisy:
        return None
    _require_support(config)
    if system.noisy:
        return None
    strengths = [0.0] * system.n
    for i, strength in by_state(config.noise, "noise", system).items():
        if i in system.constants:
            raise UsageError(
                f"Expected noise of states that move, got {system.state_names[i]}, a parameter of the family; leave it "
                "out."
            )
        strengths[i] = strength
    with section("noise"):
        return StateNoise(strengths)


def check_risk(config: Config, problem: Problem) -> None:
    """Check that a task with risk is random, and that its settings support risk.

    Raises:
        UsageError: there is neither noise nor random plants, too many sources of noise, or a law that ignores
        risk.
    """
    if not config.risk:
        return
    if problem.noise is None and not config.randomise:
        raise UsageError(f"Expected noise or randomise with risk, got neither and risk={config.risk:g}; give one.")
    if problem.noise is not None and problem.noise.sources > MOST_SOURCES:
        raise UsageError(
            f"Expected at most {MOST_SOURCES} sources of noise with risk, got {problem.noise.sources}; the mean of an "
            "exponential over more of them is not computed: leave risk out."
        )
    if config.rollout.policy not in ("sampled", "hjb"):
        raise UsageError(
            f"Expected rollout.policy=sampled or hjb with risk, got {config.rollout.policy}; it ignores risk."
        )


def _require_support(config: Config) -> None:
    """Raise UsageError for settings that do not support noise."""
    if config.horizon.stationary:
        raise UsageError(
            "Expected horizon.stationary: false with noise, got true; the cost of noise over an infinite time is "
            "infinite: give a horizon that ends."
        )
    if config.rollout.gradient != "discrete":
        raise UsageError(
            f"Expected rollout.gradient=discrete with noise, got {config.rollout.gradient}; the other gradients do "
            "not support it."
        )
    if config.network.name in ("icnn", "anchored", "quadratic"):
        raise UsageError(
            f"Expected network.name=expansion or fcn with noise, got {config.network.name}; that V is 0 at the goal, "
            "where V has to be the cost of the noise: take another."
        )
