"""The checkpoints of a baseline's training, and the policy that one holds."""

import json
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from lyapnet.comparison.baselines.baseline import Baseline

MODEL, NORMALISATION, REPLAY = "model.zip", "normalisation.pkl", "replay.pkl"
PROGRESS, STREAMS = "progress.json", "streams.pt"


class BaselinePolicy(NamedTuple):
    """A trained model together with the normalisation of its observations, if it has one."""

    model: BaseAlgorithm
    normalisation: VecNormalize | None

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, Any]:
        """The action for raw observations, as SB3's own predict."""
        if self.normalisation is not None:
            observation = self.normalisation.normalize_obs(observation)
        return self.model.predict(observation, state, episode_start, deterministic)


class Checkpoint(NamedTuple):
    """A folder step_<environment steps> with all that a training needs to go on as if it had never stopped."""

    folder: Path

    @property
    def step(self) -> int:
        """Environment steps."""
        return int(self.folder.name.removeprefix("step_"))

    @property
    def progress(self) -> dict[str, Any]:
        """Seconds, validations, and the step of the best one, so far."""
        return json.loads((self.folder / PROGRESS).read_text(encoding="utf-8"))

    def policy(self, baseline: Baseline) -> BaselinePolicy:
        """The policy as it was then."""
        kept = self.folder / NORMALISATION
        environment = baseline.wrapped(baseline.environment(), kept if kept.is_file() else None)
        return BaselinePolicy(self.model(baseline), environment if isinstance(environment, VecNormalize) else None)

    def model(self, baseline: Baseline, environment: VecEnv | None = None) -> BaseAlgorithm:
        """The model as it was then."""
        with warnings.catch_warnings():  # SB3 takes its own buffer of returns of several steps for the user's
            warnings.filterwarnings("ignore", ".*n_steps=.* is ignored because a custom.*")
            return baseline.setting.algorithm.load(self.folder / MODEL, environment, device="cpu", force_reset=False)


def checkpoints(folder: Path) -> list[Checkpoint]:
    """Those of a training, oldest first."""
    found = [Checkpoint(path) for path in (folder / "checkpoints").glob("step_*")]
    return sorted(found, key=lambda checkpoint: checkpoint.step)


def best_checkpoint(folder: Path) -> Checkpoint:
    """That of the least validation cost."""
    *_, last = checkpoints(folder)
    return Checkpoint(last.folder.with_name(f"step_{last.progress['best']}"))
