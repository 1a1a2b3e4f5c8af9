"""A run: its folder, its trainer, its end; started, resumed, or fine-tuned from another one."""

import difflib
import inspect
import json
import logging
import os
import platform
import shlex
import statistics
import subprocess
import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.plugins.io import TorchCheckpointIO
from rich.console import Console
from torch import nn

import lyapnet
from lyapnet.atomic import write_atomically
from lyapnet.build import resolve
from lyapnet.callbacks import (
    BEST,
    LAST,
    Checkpoints,
    Compilation,
    FigureLogger,
    ScalarLogger,
    Stopwatch,
    TrainingProgress,
    ValidationOptimum,
    optimum_progress,
)
from lyapnet.checkpoint import read_checkpoint, read_plain_data, write_checkpoint
from lyapnet.config import Config, configs_of_seeds, differing_keys, label_of, load_config, to_plain, to_yaml
from lyapnet.controller import config_of, load, load_value_function
from lyapnet.data import EnsembleDataModule, InitialStateDataModule
from lyapnet.errors import CompilationError, DivergenceError, Interrupted, LyapnetError, UsageError
from lyapnet.evaluation import evaluate
from lyapnet.event_files import drop_events_after, event_files
from lyapnet.modules import TrainedModule, build_module
from lyapnet.networks import NETWORKS
from lyapnet.runge_kutta import TABLEAUX

CONFIG = "config.yaml"
PROVENANCE = "run.json"
EVALUATION = "evaluation.json"  # written last: its presence says that the run is finished
TRAINER_OPTIONS = (
    "accelerator", "strategy", "devices", "gradient_clip_val", "gradient_clip_algorithm",
    "deterministic", "benchmark", "detect_anomaly", "profiler",
)  # fmt: skip
CHANGEABLE_ON_RESUME = ("training.iterations", "trainer", "logs", "evaluation.figures_every", "evaluation.optimum")


@dataclass(frozen=True)
class Run:
    """The folder of one run: config.yaml, run.json, evaluation.json, checkpoints/ and TensorBoard's event files."""

    folder: Path

    @property
    def checkpoints(self) -> Path:
        """Where last.ckpt and best.ckpt are."""
        return self.folder / "checkpoints"

    @property
    def last(self) -> Path:
        """The newest checkpoint."""
        return self.checkpoints / f"{LAST}.ckpt"

    @property
    def best(self) -> Path:
        """The checkpoint of the least validation loss."""
        return self.checkpoints / f"{BEST}.ckpt"

    def members(self, config: Config) -> list["Run"]:
        """Where each seed's best checkpoint and event files are: folders of their own, if there are several seeds."""
        labels = [label_of(one) for one in configs_of_seeds(config)]
        return [Run(self.folder / label) for label in labels] if config.seeds > 1 else [self]

    @property
    def finetuned_from(self) -> Path | None:
        """The checkpoint whose weights the run started from."""
        origin = self._provenance()["finetuned_from"]
        return Path(origin) if origin else None

    @property
    def compiled(self) -> bool:
        """Whether the run started compiled, as it then goes on: machine code rounds differently."""
        return self._provenance().get("compiled", False)

    def _provenance(self) -> dict[str, Any]:
        return json.loads((self.folder / PROVENANCE).read_text(encoding="utf-8"))

    @property
    def finished(self) -> bool:
        """Whether the run reached its end."""
        return (self.folder / EVALUATION).is_file()


@dataclass(frozen=True)
class Plan:
    """What to do: which module to train, in which run's folder, and from which checkpoint if any."""

    command: str  # that starts this run again
    config: Config
    module: TrainedModule
    run: Run
    compile: bool = False
    resume_from: Path | None = None
    finetune_from: Path | None = None


def plan_run(path: Path | None, overrides: list[str], resume: str | None = None, finetune: Path | None = None) -> Plan:
    """Build everything that a config names, and last of all, for a new run, its folder.

    Raises:
        UsageError: config and checkpoint contradict each other, or there is nothing to resume.
        CheckpointError: a checkpoint cannot be read, or its weights do not fit.
        LyapnetError: the folder of a new run cannot be made.
    """
    if resume and finetune:
        raise UsageError("Expected --resume or --finetune, got both; resume goes on, finetune starts a new run.")
    if path is None:
        raise UsageError("Expected --config PATH, got none; for example --config conf/double_integrator.yaml.")
    config = load_config(path, overrides)
    command = shlex.join(["python", "train.py", "--config", str(path), *overrides])
    _check_trainer_options(config)
    torch.set_num_threads(config.training.threads)  # compiled functions are kept for a number of threads
    module = build_module(config)
    if not resume:
        compile = _earns_compilation(config, module)
        module = _start_from(module, finetune)
        return Plan(command, config, module, _new_run(config, finetune, compile), compile, finetune_from=finetune)
    run = _last_run(config) if resume == LAST else Run(Path(resume).resolve().parent.parent)
    checkpoint = run.last if resume == LAST else Path(resume)
    if resume == LAST and not checkpoint.exists():  # stopped before its first checkpoint: it stands where it began
        written = run.folder / CONFIG
        if written.exists():
            _require_same_experiment(config, load_config(written), written)
        origin = run.finetuned_from
        return Plan(command, config, _start_from(module, origin), run, run.compiled, finetune_from=origin)
    stored = config_of(read_checkpoint(checkpoint), checkpoint)
    if not (run.folder / PROVENANCE).is_file():
        raise UsageError(f"Expected a checkpoint in its run's folder, got {resume!r}; start a new run with --finetune.")
    _require_same_experiment(config, stored, checkpoint)
    return Plan(command, config, module, run, run.compiled, resume_from=checkpoint)


def fit(plan: Plan, console: Console) -> dict[str, Any]:
    """Train to the end of the config's iterations; the evaluation of the best checkpoint.

    Raises:
        Interrupted: Ctrl-C or SIGTERM, after saving.
        DivergenceError: a rollout, term or gradient is not finite; names the checkpoint that is kept.
        LyapnetError: a checkpoint or event file cannot be read or written.
    """
    config, run, module = plan.config, plan.run, plan.module
    trainer = _trainer(config, run, console, plan.compile)
    if trainer.is_global_zero:
        _prepare_folder(plan)
        console.print(f"[bold]{config.experiment}[/]  {run.folder}", soft_wrap=True)
    try:
        torch.manual_seed(config.seed)  # lyapnet's own draws have their streams; a user's network may use this one
        trainer.fit(module, _data(module), ckpt_path=plan.resume_from, weights_only=True)
    except Interrupted as stop:
        hint = f" Continue with: {plan.command} --resume last" if stop.exit_status == 0 else ""
        raise Interrupted(f"{stop}{hint}", stop.exit_status) from None
    except DivergenceError as error:
        kept = f" Kept: {run.last}." if run.last.exists() else ""
        raise DivergenceError(f"{error}{kept}") from error
    if not trainer.is_global_zero:
        return {}
    return _finish(trainer, plan, console)


def _start_from(module: TrainedModule, checkpoint: Path | None) -> TrainedModule:
    """The module with the weights of a checkpoint, if there is one to fine-tune from."""
    if checkpoint is not None:
        content = read_checkpoint(checkpoint)
        for member in module.members:
            load_value_function(member.V, content, checkpoint)
    return module


def _data(module: TrainedModule) -> InitialStateDataModule:
    config, initial_states = module.config, module.members[0].task.initial_states
    options = (initial_states, config.training.batch_size, config.evaluation.validation_states, config.seed)
    return EnsembleDataModule(*options, config.seeds) if config.seeds > 1 else InitialStateDataModule(*options)


def _finish(trainer: L.Trainer, plan: Plan, console: Console) -> dict[str, Any]:
    """Evaluate each best checkpoint, log it as its run's final metrics, and mark the run as finished."""
    config, members, options = plan.config, plan.module.members, plan.config.evaluation
    network = resolve(config.network.name, NETWORKS, "network.name", nn.Module)
    results = []
    for member, run, logger in zip(members, plan.run.members(config), trainer.loggers, strict=True):
        controller = load(run.best, system=member.task.system, network=network)
        with optimum_progress(console) as progress:
            results.append(evaluate(controller, options.test_states, member.config.seed, options.optimum, progress))
        metrics = {f"hp/{key}": value for key, value in results[-1].items() if isinstance(value, float)}
        assert isinstance(logger, TensorBoardLogger)
        logger.log_hyperparams(to_plain(member.config), metrics, step=trainer.global_step)
        logger.finalize("success")
    result = results[0] if config.seeds == 1 else over_seeds(results)
    _write_json(plan.run.folder / EVALUATION, result)
    return result


def over_seeds(results: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The evaluations of several seeds, and mean and standard deviation of each measure that all of them have."""
    measures = [key for key in results[0] if all(isinstance(result[key], float) for result in results)]
    columns = {key: [result[key] for result in results] for key in measures}
    return {
        "mean": {key: statistics.fmean(values) for key, values in columns.items()},
        "spread": {key: statistics.stdev(values) for key, values in columns.items()},
        "seeds": list(results),
    }


class AtomicCheckpointIO(TorchCheckpointIO):
    """Lightning's door to checkpoint files: all or nothing on writing, nothing executed on reading."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        write_checkpoint(checkpoint, path)

    def load_checkpoint(self, path: Any, map_location: Any = None, weights_only: bool | None = None) -> dict[str, Any]:
        return read_plain_data(path, map_location or "cpu")


def _trainer(config: Config, run: Run, console: Console, compile: bool) -> L.Trainer:
    training, runs = config.training, run.members(config)
    loggers = [
        TensorBoardLogger(r.folder.parent, name="", version=r.folder.name, default_hp_metric=False) for r in runs
    ]
    labels = [label_of(c) for c in configs_of_seeds(config)] if config.seeds > 1 else [""]
    return L.Trainer(
        max_epochs=training.iterations,  # an epoch is one step
        check_val_every_n_epoch=training.validate_every,
        log_every_n_steps=1,
        num_sanity_val_steps=0,
        inference_mode=False,  # V_x needs gradients in validation too
        enable_model_summary=False,
        use_distributed_sampler=False,  # each process has a stream of its own
        default_root_dir=run.folder,
        logger=loggers,
        callbacks=[
            *([Compilation(console, training.batch_size)] if compile else []),
            ValidationOptimum(console),
            Stopwatch(),
            ScalarLogger(),
            FigureLogger(training.validate_every * config.evaluation.figures_every),
            TrainingProgress(console),
            Checkpoints(
                run.last, {label: r.best for label, r in zip(labels, runs, strict=True)}, training.validate_every
            ),
        ],
        plugins=[AtomicCheckpointIO()],
        **_trainer_options(config),
    )


def _prepare_folder(plan: Plan) -> None:
    """Write what the run is; take back what it logged after the point from which it goes on."""
    folder = plan.run.folder
    (folder / EVALUATION).unlink(missing_ok=True)
    write_atomically(folder / CONFIG, to_yaml(plan.config).encode())
    step = int(read_checkpoint(plan.resume_from)["global_step"]) if plan.resume_from else None
    for run in plan.run.members(plan.config):
        if step is not None:
            drop_events_after(run.folder, step)
            continue
        for path in event_files(run.folder):
            path.unlink()


def _earns_compilation(config: Config, module: TrainedModule) -> bool:
    """Whether a new run is compiled: because it must, because it was before, or because it is long.

    By measurement on a 3-64-64-1 network and one CPU core, compiling takes 45 s and then saves 0.3 ms at each stage of
    each step, and 4 µs more for each state.
    """
    if config.rollout.gradient != "discrete" or config.rollout.compile == "off":
        return False
    batch, stages = config.training.batch_size, len(TABLEAUX[config.rollout.method].b)
    states = batch * config.seeds
    saved = config.training.iterations * config.horizon.steps * stages * (3e-4 + 4e-6 * states)
    try:
        return config.rollout.compile == "on" or saved > 45 or module.compiled_before(batch)
    except CompilationError:  # what cannot be traced is not on disk
        return False


def _provenance(config: Config, finetuned_from: Path | None, compile: bool) -> dict[str, Any]:
    return {
        "seed": config.seed,
        "compiled": compile,
        "finetuned_from": str(finetuned_from.resolve()) if finetuned_from else None,
        "lyapnet": lyapnet.__version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "lightning": L.__version__,
        "commit": _commit(),
    }


def _commit() -> str | None:
    """The commit of lyapnet's own source tree, where it is one."""
    try:
        here = Path(__file__).parent
        git = subprocess.run(["git", "rev-parse", "HEAD"], cwd=here, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return git.stdout.strip()


def _new_run(config: Config, finetuned_from: Path | None, compile: bool) -> Run:
    """A folder of its own that says what it is from its first moment on, so that a stopped run can always go on."""
    if int(os.environ.get("LOCAL_RANK", "0")) > 0:  # a further process of a run whose folder the first one made
        return _last_run(config)
    root = Path(config.logs) / config.experiment
    try:
        root.mkdir(parents=True, exist_ok=True)
        draft = Path(tempfile.mkdtemp(prefix=".new_", dir=root))
        draft.chmod(0o755)
        _write_json(draft / PROVENANCE, _provenance(config, finetuned_from, compile))
        version = max((number for number, _ in _versions(root)), default=-1) + 1
        return Run(draft.rename(root / f"version_{version}"))
    except OSError as error:
        raise LyapnetError(
            f"Expected a writable folder for runs, got {str(root)!r} ({error.strerror}); choose another with logs=PATH."
        ) from error


def _write_json(path: Path, content: dict[str, Any]) -> None:
    write_atomically(path, (json.dumps(content, indent=2) + "\n").encode())


def _last_run(config: Config) -> Run:
    root = Path(config.logs) / config.experiment
    runs = sorted(_versions(root))
    if not runs:
        raise UsageError(f"Expected a run to resume in {str(root)!r}, got none; start one without --resume.")
    return Run(runs[-1][1])


def _versions(root: Path) -> list[tuple[int, Path]]:
    numbered = [(path.name.removeprefix("version_"), path) for path in root.glob("version_*")]
    return [(int(number), path) for number, path in numbered if number.isdigit()]


def _require_same_experiment(config: Config, stored: Config, checkpoint: Path) -> None:
    changed = [key for key in differing_keys(config, stored) if not key.startswith(CHANGEABLE_ON_RESUME)]
    if changed:
        raise UsageError(
            f"Expected the config of {str(checkpoint)!r}, got another {', '.join(changed)}; resuming continues the "
            "same run: undo the change, or start a new run with --finetune."
        )


def _check_trainer_options(config: Config) -> None:
    for key in config.trainer:
        if key not in TRAINER_OPTIONS:
            near = difflib.get_close_matches(key, TRAINER_OPTIONS, n=1)
            owned = key in inspect.signature(L.Trainer).parameters
            hint = (
                "lyapnet sets that one itself" if owned else f"did you mean trainer.{near[0]}?" if near else "remove it"
            )
            raise UsageError(f"Expected trainer options among {', '.join(TRAINER_OPTIONS)}, got trainer.{key}; {hint}")
    _quiet()
    try:  # Lightning refuses values only when it is built: now, before there is a folder
        trainer = L.Trainer(logger=False, enable_checkpointing=False, **_trainer_options(config))
    except (MisconfigurationException, ValueError, TypeError, RuntimeError) as error:
        raise UsageError(
            f"Expected trainer options that Lightning accepts, got: {' '.join(str(error).split())}"
        ) from error
    if config.seeds > 1 and trainer.num_devices > 1:
        raise UsageError(
            f"Expected trainer.devices=1 for seeds={config.seeds}, got {trainer.num_devices} devices; one batch holds "
            "all seeds, so train on one device, or the seeds one by one."
        )


def _trainer_options(config: Config) -> dict[str, Any]:
    return {"accelerator": "cpu", "devices": 1, **config.trainer}


def _quiet() -> None:
    """Lightning's notes that are wrong here: one epoch is one step, and drawing states needs no workers."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    for message in (".*LeafSpec.*", ".*does not have many workers.*"):
        warnings.filterwarnings("ignore", message)
