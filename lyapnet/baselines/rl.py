"""PPO and SAC of Stable-Baselines3 on a task: trained in pieces, each followed by a validation and a checkpoint."""

import inspect
import json
import shutil
import tempfile
import textwrap
import time
import warnings
from collections import ChainMap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from omegaconf import OmegaConf
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import configure
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecMonitor, VecNormalize

from lyapnet.baselines.env import Costs, VectorEnvironment, costs_of
from lyapnet.baselines.measurement import Measurement
from lyapnet.baselines.settings import SETTINGS, Setting
from lyapnet.baselines.tasks import BoundedTask
from lyapnet.errors import OracleError, UsageError, did_you_mean
from lyapnet.event_files import drop_events_after
from lyapnet.oracles import optimal_cost, oracle_of
from lyapnet.randomness import VALIDATION, stream
from lyapnet.run import write_json
from lyapnet.types import PerState, State

VALIDATIONS, VALIDATION_STATES = 40, 64  # of a training; the states are those of a lyapnet run of that seed
BUFFER, MINIBATCHES = 1_000_000, 8  # of SAC; of a rollout of PPO, where its options do not say
MODEL, NORMALISATION, REPLAY = "model.zip", "normalisation.pkl", "replay.pkl"
PROGRESS, STREAMS = "progress.json", "streams.pt"


@dataclass(frozen=True)
class Baseline:
    """A method on a task, from a seed, for a number of environment steps (Euler steps of single trajectories)."""

    bounded: BoundedTask
    method: str  # of SETTINGS
    seed: int
    steps: int
    hidden: Sequence[int]
    options: Mapping[str, Any] = field(default_factory=dict)  # in place of those of the setting
    validations: int = VALIDATIONS  # spread evenly over its steps: the training's pieces

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
        algorithm, horizon = self.setting.algorithm, self.bounded.task.horizon.steps
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
        """Environment steps between validations: whole episodes of PPO, whole updates of SAC, of all trajectories."""
        on_policy = issubclass(self.setting.algorithm, OnPolicyAlgorithm)
        whole = self.setting.environments * (self.bounded.task.horizon.steps if on_policy else self.update)
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
            self.bounded.task, setting.environments, self.bounded.control_scale, setting.observe_time,
            setting.truncates, self.seed,
        )  # fmt: skip

    def wrapped(self, environment: VectorEnvironment, normalisation: Path | None = None) -> VecEnv:
        """The same with returns recorded and, where the setting says so, normalised as kept in a file or afresh."""
        monitored = VecMonitor(environment)
        if not self.setting.normalise:
            return monitored
        if normalisation is not None:
            return VecNormalize.load(str(normalisation), monitored)
        # rewards are scaled and not clipped: the terminal cost of a bad policy is what it has to learn from
        return VecNormalize(monitored, gamma=self.options_of_algorithm["gamma"], clip_obs=100, clip_reward=np.inf)

    @property
    def options_of_algorithm(self) -> dict[str, Any]:
        """The setting's, and what replaces them; those of its network one by one."""
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
            steps = options.setdefault("n_steps", self.bounded.task.horizon.steps)
            options.setdefault("batch_size", max(steps * self.setting.environments // MINIBATCHES, 1))
        else:
            options.setdefault("buffer_size", min(BUFFER, self.steps + self.piece))
        return create("MlpPolicy", environment, seed=self.seed, device="cpu", **options)


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


class BaselineTraining:
    """A training in a folder of its own; it goes on from the last checkpoint in it, if there is one."""

    def __init__(self, baseline: Baseline, folder: Path):
        self.baseline, self.folder = baseline, folder
        task = baseline.bounded.task
        self.states = task.initial_states.sample(VALIDATION_STATES, stream(baseline.seed, VALIDATION))
        self.optima = optima_of(baseline.bounded, self.states)
        self.episodes, self.seconds, self.best = baseline.environment(), 0.0, 0
        self.curve: list[Measurement] = []
        for draft in folder.glob("checkpoints/.new_*"):  # killed while it was written
            shutil.rmtree(draft)
        kept = checkpoints(folder)
        if kept:
            self._resume(kept[-1])
        else:
            self.environment = baseline.wrapped(self.episodes)
            self.model = baseline.model(self.environment)
        self.model.set_logger(configure(str(folder), ["tensorboard"]))

    def run(self, report: Callable[[Measurement], None]) -> None:
        """Train to the end; `report` hears of each validation.

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
        for leftover in self.folder.glob(f"checkpoints/*/{REPLAY}"):  # tens of MB, to go on from
            leftover.unlink()

    @property
    def policy(self) -> BaselinePolicy:
        """The policy as it is."""
        return BaselinePolicy(self.model, self.environment if isinstance(self.environment, VecNormalize) else None)

    def _learn(self) -> None:
        """One piece; the learning rate is constant over it."""
        remaining = 1 - self.model.num_timesteps / self.baseline.steps
        rate = self.baseline.options_of_algorithm["learning_rate"]
        now = rate * remaining if self.baseline.setting.decays else rate
        self.model.lr_schedule = lambda _: now
        started = time.process_time()  # as lyapnet.callbacks.Stopwatch
        never = self.baseline.steps + 1  # what SB3 has to log goes with our own validations
        self.model.learn(self.baseline.piece, reset_num_timesteps=False, log_interval=never)
        self.seconds += time.process_time() - started

    def _validate(self) -> Measurement:
        """The policy on the validation states, logged under the tags of a lyapnet run."""
        setting, model = self.baseline.setting, self.model
        costs = costs_of(self.policy, self.baseline.bounded, setting.observe_time, self.states)
        cost = float(costs.cost.mean())
        ratio = None if self.optima is None else _ratio_of_means(costs.cost, self.optima)
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
        """A checkpoint, all or nothing; the best one and the last one are kept."""
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
        draft.rename(root / f"step_{self.model.num_timesteps}")
        *earlier, _ = checkpoints(self.folder)
        for checkpoint in earlier:
            if checkpoint.step != self.best:
                shutil.rmtree(checkpoint.folder)
            else:
                (checkpoint.folder / REPLAY).unlink(missing_ok=True)

    def _begun(self) -> dict[str, torch.Tensor]:
        """What SB3's wrappers know of the episodes that have begun, and leave out of their files; its own memory."""
        wrapper: Any = self.environment
        known = {}
        if isinstance(wrapper, VecNormalize):
            known, wrapper = {"returns": wrapper.returns}, wrapper.venv
        known |= {name: getattr(wrapper, name) for name in ("episode_returns", "episode_lengths")}
        return {name: torch.from_numpy(values) for name, values in known.items()}

    def _resume(self, checkpoint: Checkpoint) -> None:
        drop_events_after(self.folder, checkpoint.step)
        kept = checkpoint.folder / NORMALISATION
        self.environment = self.baseline.wrapped(self.episodes, kept if kept.is_file() else None)
        self.model = checkpoint.model(self.baseline, self.environment)
        if isinstance(self.model, OffPolicyAlgorithm) and (checkpoint.folder / REPLAY).is_file():  # not at its end
            self.model.load_replay_buffer(checkpoint.folder / REPLAY)
        streams = torch.load(checkpoint.folder / STREAMS, weights_only=True)
        self.episodes.resume(streams)  # after loading, which seeds everything anew
        _restore(streams)
        for name, values in self._begun().items():
            values.copy_(streams[name])
        progress = checkpoint.progress
        self.seconds, self.best = progress["seconds"], progress["best"]
        self.curve = [Measurement(**point) for point in progress["curve"]]


def costs_of_best(baseline: Baseline, folder: Path, x0: State) -> tuple[Path, Costs]:
    """The model file of a training's best checkpoint, and what it costs from each of x₀ (b, n)."""
    checkpoint = best_checkpoint(folder)
    costs = costs_of(checkpoint.policy(baseline), baseline.bounded, baseline.setting.observe_time, x0)
    return checkpoint.folder / MODEL, costs


def optima_of(bounded: BoundedTask, x0: State) -> PerState | None:
    """J* from each of x₀ (b, n), NaN where none was found; None where there is no oracle."""
    system, cost, _, horizon = bounded.task
    oracle = optimal_cost(system, cost, horizon)
    return None if oracle is None else oracle.solve(x0).cost


def why_no_optimum(bounded: BoundedTask) -> str | None:
    """What keeps J* of a task from being known; None if nothing does."""
    system, cost, _, horizon = bounded.task
    try:
        oracle_of(system, cost, horizon)
    except OracleError as error:
        return str(error)
    return None


def _ratio_of_means(cost: PerState, optima: PerState) -> float | None:
    """Over the states whose optimum is known."""
    known = torch.isfinite(optima)
    return float(cost[known].mean() / optima[known].mean()) if known.any() else None


def _mean_return(model: BaseAlgorithm) -> float | None:
    """Mean cost of the last episodes of the training, exploration included."""
    returns = [episode["r"] for episode in model.ep_info_buffer or ()]
    return -float(np.mean(returns)) if returns else None


def _random_streams() -> dict[str, Any]:
    """The state of the generators that SB3 draws from."""
    numpy: Any = np.random.get_state(legacy=False)  # noqa: NPY002
    key = torch.from_numpy(numpy["state"]["key"].astype(np.int64))
    drawn = {"pos": numpy["state"]["pos"], "has_gauss": numpy["has_gauss"], "gauss": numpy["gauss"]}
    return {"torch": torch.get_rng_state(), "numpy_key": key, "numpy": drawn}


def _restore(streams: Mapping[str, Any]) -> None:
    torch.set_rng_state(streams["torch"])
    drawn = streams["numpy"]
    key = streams["numpy_key"].numpy().astype(np.uint32)
    np.random.set_state(("MT19937", key, drawn["pos"], drawn["has_gauss"], drawn["gauss"]))  # noqa: NPY002
