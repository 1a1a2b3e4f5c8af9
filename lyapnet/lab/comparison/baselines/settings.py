"""The settings of each baseline: that of the paper, and the best that we know."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm


@dataclass(frozen=True)
class Setting:
    """An algorithm of SB3 with its options, and its form of the task."""

    algorithm: type[BaseAlgorithm]
    environments: int  # trajectories in a batch
    observe_time: bool  # the observation is (x, t) instead of x
    normalise: bool  # observations and rewards by running means and deviations (SB3's VecNormalize)
    truncates: bool  # SB3 adds its own estimate of what lies beyond the horizon; see VectorEnvironment
    decays: bool  # the learning rate falls linearly to 0
    options: Mapping[str, Any]  # arguments of the algorithm


SETTINGS: dict[str, Setting] = {
    # What the paper's released code has, the networks of the paper with each task; where it is silent, SB3's defaults,
    # and for PPO one episode of each trajectory between updates. The learning rate of the double integrator is 3e-5.
    "ppo_paper": Setting(
        PPO, environments=90, observe_time=False, normalise=False, truncates=True, decays=False,
        options={
            "learning_rate": 3e-4, "batch_size": 256, "n_epochs": 20, "clip_range": 0.4, "gae_lambda": 0.95,
            "gamma": 0.99, "use_sde": True,
        },
    ),
    "sac_paper": Setting(
        SAC, environments=16, observe_time=False, normalise=False, truncates=True, decays=False,
        options={
            "learning_rate": 3e-4, "batch_size": 256, "tau": 0.02, "gamma": 0.98, "train_freq": 1, "use_sde": True,
        },
    ),
    # What the task is: a finite horizon (time is seen, nothing lies beyond the end, nothing is discounted), in units
    # of its own; a small exploration noise to begin with, since the action box leaves room for all of X₀; and, as the
    # terminal cost is most of the return, long eligibility traces (PPO) and returns of several steps (SAC).
    # PPO: whole episodes between updates, as all trajectories are in step and a part of them forgets the other parts.
    # SAC: one noise matrix for 16 steps, so that exploration moves the state; a new one at each averages out. Pilots
    # of 0.3 M steps came to 1.04 times the double integrator's optimum instead of 2.5, to 1.9 times swing-up's (13).
    "ppo_tuned": Setting(
        PPO, environments=64, observe_time=True, normalise=True, truncates=False, decays=True,
        options={
            "learning_rate": 1e-3, "n_epochs": 10, "clip_range": 0.2, "gae_lambda": 0.98, "gamma": 1.0,
            "policy_kwargs": {"log_std_init": -2.0},
        },
    ),
    "sac_tuned": Setting(
        SAC, environments=16, observe_time=True, normalise=True, truncates=False, decays=True,
        options={
            "learning_rate": 1e-3, "batch_size": 256, "tau": 0.02, "gamma": 1.0, "n_steps": 10, "ent_coef": "auto_0.1",
            "use_sde": True, "train_freq": 16, "gradient_steps": 16,
        },
    ),
}  # fmt: skip
