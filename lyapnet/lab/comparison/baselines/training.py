"""Trains a baseline in pieces, each followed by a validation and a checkpoint."""

import shutil
import tempfile
import textwrap
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecNormalize
from torch.utils.tensorboard.writer import SummaryWriter

from lyapnet.base.files import write_json
from lyapnet.base.random_streams import VALIDATION, stream
from lyapnet.evaluation.optimality import ratio_of_means
from lyapnet.experiment.checkpoint import read_plain_data
from lyapnet.lab.comparison.baselines.baseline import Baseline
from lyapnet.lab.comparison.baselines.checkpoints import (
    MODEL,
    NORMALISATION,
    PROGRESS,
    REPLAY,
    STREAMS,
    BaselinePolicy,
    Checkpoint,
    best_checkpoint,
    checkpoints,
)
from lyapnet.lab.comparison.results import Measurement
from lyapnet.lab.comparison.scoring import costs_of, increments_of, optima_of

VALIDATION_STATES = 64  # number of states; they are those of a lyapnet run with the same seed
VALIDATION_PATHS = 4  # number of paths of noise from each state


class BaselineTraining:
    """A training in its own folder; it continues from the last checkpoint there, if there is one."""

    def __init__(self, baseline: Baseline, folder: Path):
        self.baseline, self.folder = baseline, folder
        initial_states = baseline.bounded.problem.initial_states
        self.states = initial_states.sample(VALIDATION_STATES, stream(baseline.seed, VALIDATION))
        self.increments = increments_of(baseline.bounded, self.states, VALIDATION_PATHS, baseline.seed, VALIDATION)
        self.optima = optima_of(baseline.bounded, self.states)
        self.episodes, self.seconds, self.best = baseline.environment(), 0.0, 0
        self.curve: list[Measurement] = []
        for draft in folder.glob("checkpoints/.new_*"):  # incomplete: the process was killed while it wrote
            shutil.rmtree(draft)
        kept = checkpoints(folder)
        if kept:
            self._resume(kept[-1])
        else:
            self.environment = baseline.wrapped(self.episodes)
            self.model = baseline.model(self.environment)
        self.model.set_logger(_logger(folder, kept[-1].step if kept else None))

    def run(self, report: Callable[[Measurement], None]) -> None:
        """Train to the end; `report` is called with each validation.

        Raises:
            DivergenceError: a trajectory left the finite numbers.
        """
        if not self.curve:
            self.model.logger.record("config", textwrap.indent(self.baseline.text, "    "))
            report(self._validate())
            self._save()
        while self.model.num_timesteps < self.baseline.steps:
            self._learn()
            report(self._validate())
            self._save()
        for leftover in self.folder.glob(f"checkpoints/*/{REPLAY}"):  # tens of MB, needed only to continue
            leftover.unlink()

    @property
    def policy(self) -> BaselinePolicy:
        """The present policy."""
        return BaselinePolicy(self.model, self.environment if isinstance(self.environment, VecNormalize) else None)

    def _learn(self) -> None:
        """Train one piece, with a constant learning rate."""
        remaining = 1 - self.model.num_timesteps / self.baseline.steps
        rate = self.baseline.options_of_algorithm["learning_rate"]
        now = rate * remaining if self.baseline.setting.decays else rate
        self.model.lr_schedule = lambda _: now
        started = time.process_time()  # as lyapnet.training.curves.Stopwatch
        never = self.baseline.steps + 1  # SB3's log is written with our validations instead
        self.model.learn(self.baseline.piece, reset_num_timesteps=False, log_interval=never)
        self.seconds += time.process_time() - started

    def _validate(self) -> Measurement:
        """Evaluate the policy on the validation states, and log the result under the tags of a lyapnet run."""
        setting, model = self.baseline.setting, self.model
        costs = costs_of(self.policy, self.baseline.bounded, setting.observe_time, self.states, self.increments)
        cost = float(costs.cost.mean())
        ratio = None if self.optima is None else ratio_of_means(costs.cost, self.optima)
        scalars = {
            "trajectory_cost/val": cost,
            "optimality_gap/val": None if ratio is None else ratio - 1,
            "clipped_fraction/val": costs.clipped_fraction,
            "clipped_fraction/train": self.episodes.episodes.clipped_fraction,
            "trajectory_cost/train": _mean_return(model),
            "training_seconds": self.seconds,
            "learning_rate": model.lr_schedule(1.0),
            "rollout_steps_per_second": model.num_timesteps / self.seconds if self.seconds else None,
        }
        for name, value in scalars.items():
            if value is not None:
                model.logger.record(name, value)
        model.logger.dump(model.num_timesteps)
        self.curve.append(Measurement(model.num_timesteps, self.seconds, cost, ratio, None))
        if cost <= min(point.cost for point in self.curve):
            self.best = model.num_timesteps
        return self.curve[-1]

    def _save(self) -> None:
        """Write a checkpoint completely or not at all; keep the best and the last one."""
        root = self.folder / "checkpoints"
        root.mkdir(parents=True, exist_ok=True)
        draft = Path(tempfile.mkdtemp(prefix=".new_", dir=root))
        self.model.save(draft / MODEL)
        if isinstance(self.environment, VecNormalize):
            self.environment.save(str(draft / NORMALISATION))
        if isinstance(self.model, OffPolicyAlgorithm):
            self.model.save_replay_buffer(draft / REPLAY)
        torch.save({**self.episodes.position(), **_random_streams(), **self._begun()}, draft / STREAMS)
        progress = {"seconds": self.seconds, "best": self.best, "curve": [asdict(point) for point in self.curve]}
        write_json(draft / PROGRESS, progress)
        Checkpoint(draft).seal()
        draft.rename(root / f"step_{self.model.num_timesteps}")
        *earlier, _ = checkpoints(self.folder)
        for checkpoint in earlier:
            if checkpoint.step != self.best:
                shutil.rmtree(checkpoint.folder)
            else:
                (checkpoint.folder / REPLAY).unlink(missing_ok=True)

    def _begun(self) -> dict[str, torch.Tensor]:
        """The part of the state of SB3's wrappers for unfinished episodes that their own files lack."""
        wrapper: Any = self.environment
        known = {}
        if isinstance(wrapper, VecNormalize):
            known, wrapper = {"returns": wrapper.returns}, wrapper.venv
        known |= {name: getattr(wrapper, name) for name in ("episode_returns", "episode_lengths")}
        return {name: torch.from_numpy(values) for name, values in known.items()}

    def _resume(self, checkpoint: Checkpoint) -> None:
        self.environment = self.baseline.wrapped(self.episodes, checkpoint.file(NORMALISATION))
        self.model = checkpoint.model(self.baseline, self.environment)
        if isinstance(self.model, OffPolicyAlgorithm) and (replay := checkpoint.file(REPLAY)):  # not at its end
            self.model.load_replay_buffer(replay)
        streams = read_plain_data(checkpoint.file(STREAMS) or STREAMS)
        self.episodes.resume(streams)  # after loading, which seeds everything anew
        _restore(streams)
        for name, values in self._begun().items():
            values.copy_(streams[name])
        progress = checkpoint.progress
        self.seconds, self.best = progress["seconds"], progress["best"]
        self.curve = [Measurement(**point) for point in progress["curve"]]


def best_policy(baseline: Baseline, folder: Path) -> tuple[Path, BaselinePolicy]:
    """(model file, policy) of a training's best checkpoint."""
    checkpoint = best_checkpoint(folder)
    return checkpoint.folder / MODEL, checkpoint.policy(baseline)


def _logger(folder: Path, resumed_at: int | None) -> Logger:
    """SB3's logger for TensorBoard, which hides entries after the step from which training continues."""
    if resumed_at is not None:
        _wait_for_another_second(folder)
    output = TensorBoardOutputFormat(str(folder))
    if resumed_at is not None:
        assert output.writer is not None
        output.writer.close()
        output.writer = SummaryWriter(str(folder), purge_step=resumed_at + 1)
    return Logger(str(folder), [output])


def _wait_for_another_second(folder: Path) -> None:
    """Wait for the next full second, so that a new event file has a later name than those in the folder.

    Files are read in the order of their names, which contain the time in seconds. Names of the same second are not in
    the order of time.
    """
    seconds = [int(path.name.split(".")[3]) for path in folder.glob("events.out.tfevents.*")]
    while seconds and time.time() < max(seconds) + 1:
        time.sleep(0.05)


def _mean_return(model: BaseAlgorithm) -> float | None:
    """Mean cost of the last episodes in training, with exploration."""
    returns = [episode["r"] for episode in model.ep_info_buffer or ()]
    return -float(np.mean(returns)) if returns else None


def _random_streams() -> dict[str, Any]:
    """The state of the random generators of SB3."""
    numpy: Any = np.random.get_state(legacy=False)  # noqa: NPY002
    key = torch.from_numpy(numpy["state"]["key"].astype(np.int64))
    drawn = {"pos": numpy["state"]["pos"], "has_gauss": numpy["has_gauss"], "gauss": numpy["gauss"]}
    return {"torch": torch.get_rng_state(), "numpy_key": key, "numpy": drawn}


def _restore(streams: Mapping[str, Any]) -> None:
    torch.set_rng_state(streams["torch"])
    drawn = streams["numpy"]
    key = streams["numpy_key"].numpy().astype(np.uint32)
    np.random.set_state(("MT19937", key, drawn["pos"], drawn["has_gauss"], drawn["gauss"]))  # noqa: NPY002
