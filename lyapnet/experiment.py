"""A run: its folder, its trainer, its end; started, resumed, or fine-tuned from another one."""

import inspect
import logging
import resource
import shlex
import statistics
import time
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

from lyapnet.atomic import write_atomically
from lyapnet.build import resolve
from lyapnet.callbacks import (
    Checkpoints,
    Compilation,
    FigureLogger,
    ScalarLogger,
    Stopwatch,
    TrainingProgress,
    ValidationOptimum,
    optimum_progress,
)
from lyapnet.certification_callback import CertifiedShare
from lyapnet.checkpoint import read_checkpoint, read_plain_data, write_checkpoint
from lyapnet.config import Config, configs_of_seeds, differing_keys, label_of, load_config, to_plain, to_yaml
from lyapnet.controller import config_of, load, load_value_function
from lyapnet.data import EnsembleDataModule, InitialStateDataModule
from lyapnet.errors import DivergenceError, Interrupted, UsageError, did_you_mean
from lyapnet.evaluation import evaluate
from lyapnet.event_files import drop_events_after, event_files
from lyapnet.modules import TrainedModule, build_module
from lyapnet.networks import NETWORKS
from lyapnet.run import CONFIG, EVALUATION, LAST, PROVENANCE, Run, last_run, new_run, write_json
from lyapnet.runge_kutta import TABLEAUX

TRAINER_OPTIONS = (
    "accelerator", "strategy", "devices", "gradient_clip_val", "gradient_clip_algorithm",
    "deterministic", "benchmark", "detect_anomaly", "profiler",
)  # fmt: skip
CHANGEABLE_ON_RESUME = (
    "training.iterations", "trainer", "logs", "evaluation.figures_every", "evaluation.optimum",
    "evaluation.certify_every", "evaluation.certified_states", "evaluation.confidence",
)  # fmt: skip


@dataclass(frozen=True)
class Plan:
    """What to do: which module to train, in which run's folder, and from which checkpoint if any."""

    command: str  # that starts this run again
    config: Config
    module: TrainedModule
    run: Run
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
        module = _start_from(module, finetune)
        return Plan(command, config, module, new_run(config, finetune), finetune_from=finetune)
    run = last_run(config) if resume == LAST else Run(Path(resume).resolve().parent.parent)
    checkpoint = run.last if resume == LAST else Path(resume)
    if resume == LAST and not checkpoint.exists():  # stopped before its first checkpoint: it stands where it began
        written = run.folder / CONFIG
        if written.exists():
            _require_same_experiment(config, load_config(written), written)
        origin = run.finetuned_from
        return Plan(command, config, _start_from(module, origin), run, finetune_from=origin)
    stored = config_of(read_checkpoint(checkpoint), checkpoint)
    if not (run.folder / PROVENANCE).is_file():
        raise UsageError(f"Expected a checkpoint in its run's folder, got {resume!r}; start a new run with --finetune.")
    _require_same_experiment(config, stored, checkpoint)
    return Plan(command, config, module, run, resume_from=checkpoint)


def fit(plan: Plan, console: Console) -> dict[str, Any]:
    """Train to the end of the config's iterations; the evaluation of the best checkpoint.

    Raises:
        Interrupted: Ctrl-C or SIGTERM, after saving.
        DivergenceError: a rollout, term or gradient is not finite; names the checkpoint that is kept.
        LyapnetError: a checkpoint or event file cannot be read or written.
    """
    config, run, module = plan.config, plan.run, plan.module
    trainer = _trainer(plan, console)
    if trainer.is_global_zero:
        _prepare_folder(plan)
        console.print(f"[bold]{config.experiment}[/]  {run.folder}", soft_wrap=True)
    started = time.perf_counter()
    try:
        torch.manual_seed(config.seed)  # lyapnet's own draws have their streams; a user's network may use this one
        trainer.fit(module, _data(module), ckpt_path=plan.resume_from, weights_only=True)
    except Interrupted as stop:
        hint = f" Continue with: {plan.command} --resume last" if stop.exit_status == 0 else ""
        raise Interrupted(f"{stop}{hint}", stop.exit_status) from None
    except DivergenceError as error:
        kept = f" Kept: {run.last}." if run.last.exists() else ""
        raise DivergenceError(f"{error}{kept}") from error
    finally:
        if trainer.is_global_zero:
            _note_what_it_took(run, time.perf_counter() - started)
    if not trainer.is_global_zero:
        return {}
    return _finish(trainer, plan, console)


def _note_what_it_took(run: Run, seconds: float) -> None:
    """Add this process's share to the run's record."""
    record, peak = run.record(), 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # Linux counts in KiB
    total = record.get("training_seconds", 0.0) + seconds
    run.note(training_seconds=round(total, 2), peak_bytes=max(record.get("peak_bytes", 0), peak))


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
    write_json(plan.run.folder / EVALUATION, result)
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


def _trainer(plan: Plan, console: Console) -> L.Trainer:
    config, run = plan.config, plan.run
    training, runs = config.training, run.members(config)
    loggers = [
        TensorBoardLogger(r.folder.parent, name="", version=r.folder.name, default_hp_metric=False) for r in runs
    ]
    labels = [label_of(c) for c in configs_of_seeds(config)] if config.seeds > 1 else [""]
    stopwatch = Stopwatch()
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
            *_compilation(plan, console),
            ValidationOptimum(console),
            stopwatch,
            ScalarLogger(stopwatch),
            FigureLogger(training.validate_every * config.evaluation.figures_every),
            *_certified_share(config),
            TrainingProgress(console),
            Checkpoints(
                run.last, {label: r.best for label, r in zip(labels, runs, strict=True)}, training.validate_every
            ),
        ],
        plugins=[AtomicCheckpointIO()],
        **_trainer_options(config),
    )


def _certified_share(config: Config) -> list[CertifiedShare]:
    options, every = config.evaluation, config.training.validate_every * config.evaluation.certify_every
    return [CertifiedShare(every, options.certified_states, options.confidence)] if every else []


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


def _compilation(plan: Plan, console: Console) -> list[Compilation]:
    """What compiles the run, if anything may; a resumed run goes on as it was."""
    options = plan.config.rollout
    goes_on = plan.resume_from is not None
    if options.gradient != "discrete" or options.compile == "off" or (goes_on and not plan.run.compiled):
        return []
    wanted = goes_on or options.compile == "on" or _earns_compilation(plan.config)
    return [Compilation(console, plan.config.training.batch_size, wanted, plan.run.note)]


def _earns_compilation(config: Config) -> bool:
    """Whether a run is long enough to earn its compilation back.

    By measurement on a 3-64-64-1 network and one CPU core, compiling takes about 45 s and then saves 0.3 ms at each
    stage of each step, and 4 µs more for each state.
    """
    states, stages = config.training.batch_size * config.seeds, len(TABLEAUX[config.rollout.method].b)
    return config.training.iterations * config.horizon.steps * stages * (3e-4 + 4e-6 * states) > 45


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
            owned = key in inspect.signature(L.Trainer).parameters
            nearest = did_you_mean(key, TRAINER_OPTIONS, "remove it", "trainer.")
            hint = "lyapnet sets that one itself" if owned else nearest
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
