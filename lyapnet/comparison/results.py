"""What one job of a comparison leaves behind: a method trained on a task with a seed, and what it then costs."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lyapnet.run import write_json


@dataclass(frozen=True)
class Measurement:
    """One validation during a training."""

    environment_steps: int  # Euler steps of single trajectories so far
    seconds: float  # of training so far; validations, figures and checkpoints are left out
    cost: float  # mean J_N of the validation states
    cost_ratio: float | None  # to their optimum, where there is an oracle
    constraint_loss: float | None  # of a lyapnet program


@dataclass(frozen=True)
class Result:
    """A finished job. `costs`, `sums` and `optima` belong to the same evaluation states, in the same order."""

    task: str
    method: str
    seed: int
    environment_steps: int
    seconds: float  # of training, as in Measurement
    compilation_seconds: float  # which `seconds` holds
    costs: Sequence[float]  # J_N = Δt Σℓ_n + φ, of the best checkpoint
    sums: Sequence[float]  # Σℓ_n + φ, as the paper's tables have it
    optima: Sequence[float] | None  # J*, where there is an oracle; NaN where it found none
    constraint_loss: float | None  # mean over the evaluation states, of a lyapnet program
    clipped_fraction: float | None  # share of controls at the bounds of the action box, of a baseline
    horizon_steps: int
    checkpoint: str
    curve: Sequence[Measurement]

    def write(self, path: Path) -> None:
        """As JSON, all or nothing: its presence says that the job is finished."""
        write_json(path, asdict(self))

    @staticmethod
    def read(path: Path) -> "Result":
        """The result that `write` left."""
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return Result(**{**content, "curve": [Measurement(**point) for point in content["curve"]]})
