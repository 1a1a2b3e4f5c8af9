"""A baseline: a method of Stable-Baselines3 on a task, from a seed, for a number of environment steps."""

import inspect
from collections import ChainMap
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecMonitor, VecNormalize

from lyapnet.base.errors import UsageError, did_you_mean
from lyapnet.lab.comparison.baselines.settings import SETTINGS, Setting
from lyapnet.lab.comparison.baselines.vector_environment import VectorEnvironment
from lyapnet.lab.comparison.reference_problems import BoundedProblem

VALIDATIONS = 40  # default number of validations in a training
BUFFER = 1_000_000  # largest number of transitions in the replay buffer of SAC
MINIBATCHES = 8  # default number of minibatches of a rollout of PPO


@dataclass(frozen=True)
class Baseline:
    """A method on a task, from a seed, for a number of environment steps (Euler steps of single trajectories)."""

    bounded: BoundedProblem
    method: str  # a key of SETTINGS
    seed: int
    steps: int
    hidden: Sequence[int]
    options: Mapping[str, Any] = field(default_factory=dict)  # replace those of the setting
    validations: int = VALIDATIONS  # number of pieces of its training, each followed by a validation

    @property
    def setting(self) -> Setting:
        """How it is trained.

        Raises:
            UsageError: no such method.
        """
        if self.method not in SETTINGS:
            raise UsageError(f"Expected a baseline among {', '.join(SETTINGS)}, got {self.method!r}.")
        return SETTINGS[self.method]

    def check(self) -> None:
        """Refuse options that its algorithm does not have, rollouts that cut episodes, and updates after no step.

        Raises:
            UsageError: naming them.
        """
        algorithm, horizon = self.setting.algorithm, self.bounded.problem.horizon.steps
        known = inspect.signature(algorithm).parameters
        for name in self.options:
            if name not in known:
                hint = did_you_mean(name, known, f"choose among {', '.join(known)}.")
                raise UsageError(f"Expected options of {algorithm.__name__}, got {name!r} for {self.method}; {hint}")
        steps = self.options_of_algorithm.get("n_steps", horizon)
        if issubclass(algorithm, OnPolicyAlgorithm) and horizon % steps and steps % horizon:
            raise UsageError(f"Expected n_steps of {self.method} to divide {horizon}, the horizon, got {steps}.")
        _ = self.update

    @property
    def piece(self) -> int:
        """Environment steps of all trajectories between validations: whole episodes of PPO, whole updates of SAC."""
        on_policy = issubclass(self.setting.algorithm, OnPolicyAlgorithm)
        whole = self.setting.environments * (self.bounded.problem.horizon.steps if on_policy else self.update)
        return whole * max(1, round(self.steps / self.validations / whole))

    @property
    def update(self) -> int:
        """Steps of every trajectory between updates of SAC.

        Raises:
            UsageError: it is not a number of steps.
        """
        steps = self.options_of_algorithm.get("train_freq", 1)
        if not isinstance(steps, int) or steps < 1:
            raise UsageError(f"Expected train_freq of {self.method} as a number of steps ≥ 1, got {steps!r}.")
        return steps

    def environment(self) -> VectorEnvironment:
        """The trajectories that it learns from."""
        setting = self.setting
        return VectorEnvironment(
            self.bounded.problem, setting.environments, self.bounded.control_scale, setting.observe_time,
            setting.truncates, self.seed,
        )  # fmt: skip

    def wrapped(self, environment: VectorEnvironment, normalisation: Path | None = None) -> VecEnv:
        """The environments with a record of returns, and with normalisation, restored or new, if the setting has it."""
        monitored = VecMonitor(environment)
        if not self.setting.normalise:
            return monitored
        if normalisation is not None:
            return VecNormalize.load(str(normalisation), monitored)
        # rewards are scaled but not clipped, because the large terminal cost of a bad policy has to be learned
        return VecNormalize(monitored, gamma=self.options_of_algorithm["gamma"], clip_obs=100, clip_reward=np.inf)

    @property
    def options_of_algorithm(self) -> dict[str, Any]:
        """The options of the setting with replacements, also of single options of the network."""
        merged = {**self.setting.options, **self.options}
        policies = (options.get("policy_kwargs", {}) for options in (self.setting.options, self.options))
        return {**merged, "policy_kwargs": dict(ChainMap(*reversed([*policies]), {"net_arch": list(self.hidden)}))}

    @property
    def description(self) -> dict[str, Any]:
        """How it is trained, as plain values."""
        setting = {**asdict(self.setting), "algorithm": self.setting.algorithm.__name__}
        return {
            "setting": setting, "options": dict(self.options), "hidden": list(self.hidden), "steps": self.steps,
            "validations": self.validations,
        }  # fmt: skip

    @property
    def text(self) -> str:
        """The same as YAML, with its name and seed."""
        return OmegaConf.to_yaml(OmegaConf.create({"method": self.method, "seed": self.seed, **self.description}))

    def model(self, environment: VecEnv) -> BaseAlgorithm:
        """The untrained model."""
        create: Any = self.setting.algorithm
        options = self.options_of_algorithm
        if issubclass(create, OnPolicyAlgorithm):
            steps = options.setdefault("n_steps", self.bounded.problem.horizon.steps)
            options.setdefault("batch_size", max(steps * self.setting.environments // MINIBATCHES, 1))
        else:
            options.setdefault("buffer_size", min(BUFFER, self.steps + self.piece))
        return create("MlpPolicy", environment, seed=self.seed, device="cpu", **options)
