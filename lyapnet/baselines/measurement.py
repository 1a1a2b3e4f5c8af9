"""A point on the curve of a training."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Measurement:
    """One validation during a training."""

    environment_steps: int  # Euler steps of single trajectories so far
    seconds: float  # CPU time of training so far, compilation included; without validations, figures, checkpoints
    cost: float  # mean J_N of the validation states
    cost_ratio: float | None  # to their optimum, where there is an oracle
    constraint_loss: float | None  # of a lyapnet program
