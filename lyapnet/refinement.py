"""Counterexamples back into training, until a sound claim is certified: `lyapnet certify --refine`."""

import csv
import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from rich.console import Console
from torch import Tensor

from lyapnet.atomic import write_atomically
from lyapnet.certification import DecreaseCondition, SoundClaim, violations
from lyapnet.config import config_from_plain, load_config, to_plain, to_yaml
from lyapnet.controller import Controller
from lyapnet.experiment import fit, plan_run
from lyapnet.randomness import CERTIFICATION, stream
from lyapnet.run import CONFIG, LAST, Run, runs_of

POINTS_FILE = "points.csv"
FURTHER = 256  # counterexamples, and as many undecided points, of each round


class Round(NamedTuple):
    """One claim on the way."""

    checkpoint: Path
    result: dict[str, Any]
    claim: SoundClaim


def refine(
    checkpoint: Path,
    load: Callable[[Path], Controller],
    certify: Callable[[Controller], tuple[dict[str, Any], SoundClaim]],
    rounds: int,
    overrides: Sequence[str],
    console: Console,
    show: Callable[[Round], None],
) -> Round:
    """Certify; where that fails, train on with the points at which it failed, and certify again; the last round.

    Round k lives in refine_k/ beside the checkpoint's folder: the points (with those of the rounds before), the config
    (that of the checkpoint with `pointwise.counterexamples`, a fifth of its learning rate, then `overrides`) and a run
    that starts from the weights before. What is there already is taken as it is, so the same command goes on after
    whatever stopped it.

    Args:
        load, certify: make a controller of a checkpoint, and a sound claim of a controller.
        show: hears of each claim.
    """
    home = checkpoint.resolve().parent.parent
    for k in range(1, rounds + 1):
        folder = home / f"refine_{k}"
        run = _finished_run(folder)
        if run is None:
            controller = load(checkpoint)
            found = Round(checkpoint, *certify(controller))
            show(found)
            if found.claim.verdict == "certified":
                return found
            if not (folder / CONFIG).exists():
                _prepare(folder, controller, failing_points(controller, found.claim), overrides)
            run = _train(folder, checkpoint, console)
        checkpoint = run.best
    last = Round(checkpoint, *certify(load(checkpoint)))
    show(last)
    return last


def failing_points(controller: Controller, claim: SoundClaim) -> Tensor:
    """Points (t, x) at which the condition of a claim fails or is undecided inside the funnel of X₀, (k, 1 + n)."""
    condition = DecreaseCondition(controller.closed_loop, claim.alpha, claim.delta)
    lower, upper = (
        torch.cat([side.new_tensor([time]), side])
        for time, side in ((0.0, claim.states.lower), (claim.duration, claim.states.upper))
    )
    generator = stream(controller.config.seed, CERTIFICATION, 1)
    failing = violations(condition, (lower, upper), claim.wanted, FURTHER, generator)
    chosen = torch.randperm(len(claim.undecided), generator=generator)[:FURTHER]
    return torch.cat([failing, claim.undecided[chosen]])


def _finished_run(folder: Path) -> Run | None:
    """The training of a round, if it came to its end."""
    runs = runs_of(load_config(folder / CONFIG)) if (folder / CONFIG).exists() else []
    return runs[-1] if runs and runs[-1].finished else None


def _prepare(folder: Path, controller: Controller, points: Tensor, overrides: Sequence[str]) -> None:
    """Write what a round trains on, and its config last."""
    folder.mkdir(parents=True, exist_ok=True)
    config = to_plain(controller.config)
    earlier = config["pointwise"]["counterexamples"]
    rows = [["t", *controller.system.state_names], *points.tolist()]
    if earlier is not None:
        with Path(earlier).open(encoding="utf-8", newline="") as file:
            rows += list(csv.reader(file))[1:]
    text = io.StringIO()
    csv.writer(text).writerows(rows)
    write_atomically(folder / POINTS_FILE, text.getvalue().encode())
    config["logs"], config["experiment"] = str(folder.parent), folder.name
    config["pointwise"]["counterexamples"] = str(folder / POINTS_FILE)
    config["pointwise"]["weight"] = config["pointwise"]["weight"] or config["program"]["constraint"]
    config["training"]["learning_rate"] /= 5
    write_atomically(folder / CONFIG, to_yaml(config_from_plain(config, overrides)).encode())


def _train(folder: Path, checkpoint: Path, console: Console) -> Run:
    """Train a round to its end, from where it stands."""
    begun = runs_of(load_config(folder / CONFIG))
    plan = plan_run(folder / CONFIG, [], *((LAST, None) if begun else (None, checkpoint)))
    fit(plan, console)
    return plan.run
