"""Trains on counterexamples until a claim is certified: `lyapnet certify sound | region --refine`."""

import csv
import io
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from rich.console import Console
from torch import Tensor

from lyapnet.base.errors import UsageError
from lyapnet.base.files import read_file, write_atomically
from lyapnet.base.random_streams import CERTIFICATION, stream
from lyapnet.claims.region_certificate import RegionCertificate
from lyapnet.claims.sound_certificate import SoundCertificate
from lyapnet.controller.loading import require_parts
from lyapnet.experiment.assembly import Parts, build_program, without_unread_settings
from lyapnet.experiment.config import Config, config_from_plain, load_config, to_plain, to_yaml
from lyapnet.prover.counterexamples import violations
from lyapnet.training.experiment import train
from lyapnet.training.runs import CONFIG, LAST, TrainingRun, runs_of

POINTS_FILE = "points.csv"
CALLBACKS_PREFIX = "callbacks="  # prefix of an override that names callbacks
Refinable = SoundCertificate | RegionCertificate
POINTS_PER_ROUND = 256  # counterexamples added in each round, and the same number of undecided points


def refine(
    checkpoint: Path,
    certified: Callable[[Path], Refinable],
    rounds: int,
    overrides: Sequence[str],
    console: Console,
    parts: Parts | None = None,
) -> tuple[Path, Refinable]:
    """Alternate certification and training on the failing points; return the last checkpoint and certificate.

    Round k uses the folder refine_k/ in the run's folder. It holds the points of this and all earlier rounds, a config,
    and a run that starts from the previous weights. The config is that of the checkpoint with
    `pointwise.counterexamples`, a fifth of the learning rate, a weight and a region if it had none, and then
    `overrides`. Existing files are used as they are, so the same command continues an interrupted refinement.

    Args:
        certified: computes the certificate of a checkpoint's controller, a funnel or a region.
        parts: the user's objects of the controller; nothing else that a checkpoint names is imported.

    Raises:
        UsageError: a checkpoint names an object that `parts` lacks, or callbacks that the overrides do not name.
        Interrupted: Ctrl-C or SIGTERM during training.
    """
    home, parts = checkpoint.resolve().parent.parent, parts or Parts()
    for k in range(1, rounds + 1):
        folder = home / f"refine_{k}"
        run = _finished_run(folder)
        if run is None:
            certificate = certified(checkpoint)
            if certificate.is_complete:
                return checkpoint, certificate
            if not (folder / CONFIG).exists():
                _prepare(folder, certificate, overrides, parts)
            run = _train(folder, checkpoint, overrides, console, parts)
        checkpoint = run.best
    return checkpoint, certified(checkpoint)


def failing_points(certificate: Refinable) -> Tensor:
    """Points (t, x) of the claimed set at which a condition fails or is undecided, (k, 1 + n)."""
    claim, generator = certificate.claim, stream(certificate.controller.config.seed, CERTIFICATION, 1)
    failing = violations(*certificate.searched_condition(), POINTS_PER_ROUND, generator)
    chosen = torch.randperm(len(claim.undecided), generator=generator)[:POINTS_PER_ROUND]
    return torch.cat([failing, claim.undecided[chosen]])


def _extent(certificate: Refinable) -> list[float]:
    """A bound of each |x_i − x*_i| in D; 1 for states that do not occur in the claim."""
    states = certificate.claim.states
    reach = states.reach_from(certificate.controller.problem.goal.to(states.lower))
    return [bound if bound > 0 else 1.0 for bound in reach.tolist()]


def _finished_run(folder: Path) -> TrainingRun | None:
    """The run of a round if it is finished, else None."""
    runs = runs_of(load_config(folder / CONFIG)) if (folder / CONFIG).exists() else []
    return runs[-1] if runs and runs[-1].finished else None


def _prepare(folder: Path, certificate: Refinable, overrides: Sequence[str], parts: Parts) -> None:
    """Write the points of a round, and then its config."""
    controller = certificate.controller
    require_parts(controller.config, parts, folder.parent)
    _require_named_callbacks(controller.config, overrides)
    folder.mkdir(parents=True, exist_ok=True)
    config = to_plain(controller.config)
    for part, own in vars(parts).items():
        if own is not None:  # replaces the name in the checkpoint; checkpoints of the round need this object too
            cls = own if isinstance(own, type) else type(own)
            config[part]["name"] = f"{cls.__module__}:{cls.__qualname__}"
            if part == "controls":
                config[part]["lower"] = config[part]["upper"] = None
    pointwise, earlier = config["pointwise"], config["pointwise"]["counterexamples"]
    rows = [["t", *controller.system.state_names], *failing_points(certificate).tolist()]
    if earlier is not None:
        rows += list(csv.reader(io.StringIO(read_file(Path(earlier)).decode(), newline="")))[1:]
    text = io.StringIO()
    csv.writer(text).writerows(rows)
    write_atomically(folder / POINTS_FILE, text.getvalue().encode())
    config["logs"], config["experiment"] = str(folder.parent), folder.name
    pointwise["counterexamples"] = str(folder / POINTS_FILE)
    program = parts.program or build_program(controller.config)
    pointwise["weight"] = pointwise["weight"] or program.pointwise or config["program"]["constraint"]
    pointwise["region"] = pointwise["region"] or _extent(certificate)
    config["training"]["learning_rate"] /= 5
    resolved = without_unread_settings(config_from_plain(config, overrides))
    write_atomically(folder / CONFIG, to_yaml(resolved).encode())


def _train(folder: Path, checkpoint: Path, overrides: Sequence[str], console: Console, parts: Parts) -> TrainingRun:
    """Start or continue the training of a round."""
    named, config = (
        [change for change in overrides if change.startswith(CALLBACKS_PREFIX)],
        load_config(folder / CONFIG),
    )
    _require_named_callbacks(config, named)
    resume, finetune = (LAST, None) if runs_of(config) else (None, checkpoint)
    return train(folder / CONFIG, named, resume=resume, finetune=finetune, console=console, parts=parts)


def _require_named_callbacks(config: Config, overrides: Sequence[str]) -> None:
    """Refuse callbacks that only the config file names, because they would be imported."""
    if config.callbacks and not any(change.startswith(CALLBACKS_PREFIX) for change in overrides):
        listed = ",".join(config.callbacks)
        raise UsageError(
            f"Expected callbacks named by the command, got {listed} from a checkpoint's config; append "
            f"callbacks=[{listed}] to continue with them, or callbacks=[] to continue without."
        )
