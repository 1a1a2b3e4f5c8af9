"""The checkpoints of a baseline's training, and the policy that one holds."""

import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from lyapnet.base.errors import CheckpointError
from lyapnet.base.files import digest_of_file, read_json, write_json
from lyapnet.lab.comparison.baselines.baseline import Baseline

MODEL, NORMALISATION, REPLAY = "model.zip", "normalisation.pkl", "replay.pkl"
PROGRESS, STREAMS, DIGESTS = "progress.json", "streams.pt", "digests.json"


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
    """A folder step_<environment steps> from which a training continues as if it had not been stopped."""

    folder: Path

    @property
    def step(self) -> int:
        """The number of environment steps before it."""
        return int(self.folder.name.removeprefix("step_"))

    @property
    def progress(self) -> dict[str, Any]:
        """Seconds and validations so far, and the step of the best validation."""
        return read_json(self.folder / PROGRESS, self._remedy)

    @property
    def _remedy(self) -> str:
        return f"remove {str(self.folder.parent)!r}, and the same command trains it again"

    def seal(self) -> None:
        """Write a digest of every file, with which `file` checks that it is unchanged."""
        write_json(self.folder / DIGESTS, {path.name: digest_of_file(path) for path in self.folder.iterdir()})

    def file(self, name: str) -> Path | None:
        """One of its files as it was written; None if it has none of that name. SB3 unpickles some: that runs code.

        Raises:
            CheckpointError: it was changed since, or has no digest, as under version 0.1.
        """
        path = self.folder / name
        if not path.is_file():
            return None
        if read_json(self.folder / DIGESTS, self._remedy).get(name) != digest_of_file(path):
            raise CheckpointError(f"Expected {str(path)!r} as it was written, got another file; {self._remedy}.")
        return path

    def policy(self, baseline: Baseline) -> BaselinePolicy:
        """The policy at this step, from weights alone."""
        environment = baseline.wrapped(baseline.environment(), self.file(NORMALISATION))
        model = baseline.model(environment)
        model.set_parameters(str(self.file(MODEL)), device="cpu")
        return BaselinePolicy(model, environment if isinstance(environment, VecNormalize) else None)

    def model(self, baseline: Baseline, environment: VecEnv) -> BaseAlgorithm:
        """The model at this step, with everything that its training continues from."""
        with warnings.catch_warnings():  # SB3 takes its own buffer of returns of several steps for the user's
            warnings.filterwarnings("ignore", ".*n_steps=.* is ignored because a custom.*")
            path = str(self.file(MODEL))
            return baseline.setting.algorithm.load(path, environment, device="cpu", force_reset=False)


def checkpoints(folder: Path) -> list[Checkpoint]:
    """The checkpoints of a training, oldest first."""
    found = [Checkpoint(path) for path in (folder / "checkpoints").glob("step_*")]
    return sorted(found, key=lambda checkpoint: checkpoint.step)


def best_checkpoint(folder: Path) -> Checkpoint:
    """The checkpoint with the least validation cost."""
    *_, last = checkpoints(folder)
    return Checkpoint(last.folder.with_name(f"step_{last.progress['best']}"))
