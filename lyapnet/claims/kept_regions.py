"""Reads the file of a region's proof: the numbers that a check proves again."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lyapnet.base.errors import UsageError
from lyapnet.base.types import State
from lyapnet.prover.kept_proofs import read_proofs, refuse_bad_file, select_proof
from lyapnet.prover.readings import Readings, readings_from
from lyapnet.task.sets import Box

NEW_FILE = "choose another file"
REMEDY = f"allow more seconds, or {NEW_FILE}"


class KeptRegion(NamedTuple):
    """The numbers in the file of a region's proof: those that define the claim, and the recorded result."""

    path: Path
    decay: float  # λ in 1/s
    states: Box  # D; of width 0 along ignorable states
    parameters: dict[str, list[float]]  # the bounds of P by name; empty for one plant
    contracting: tuple[Box, Tensor] | None  # (B, Y); None for a claim of practical stability
    disturbance: State | None  # w
    readings: Readings | None  # when u is read; None: at every t
    steps: dict[str, Any] | None  # Δt and method of the steps; None: continuous time
    hole: float  # c
    wanted: float  # the level up to which the proof searched
    rho: float  # the proved level, as recorded
    seconds: float  # of the search

    @property
    def is_practical(self) -> bool:
        """Whether the claim is practical stability."""
        return self.contracting is None

    def require(
        self,
        decay: float,
        disturbance: State | None,
        n: int,
        parameters: Sequence[str],
        readings: Readings | None,
        steps: dict[str, Any] | None,
        practical: bool,
    ) -> None:
        """Refuse λ, w, readings, steps, what is claimed or names of parameters that differ from those of the file.

        Args:
            disturbance: w of n states, followed by zeros for parameters.
            parameters: their names.
        """
        if self.parameters.keys() != {*parameters}:
            raise UsageError(f"Expected the parameters of {str(self.path)!r}, got others; {NEW_FILE}.")
        if self.decay != decay:
            raise UsageError(f"Expected the λ and D of {str(self.path)!r}, got others; {NEW_FILE}.")
        kept, given = (None if w is None else w.tolist() for w in (self.disturbance, disturbance))
        if kept != (given and given[:n]):
            raise UsageError(f"Expected the disturbance of {str(self.path)!r}, got another; {NEW_FILE}.")
        if self.readings != (readings and replace(readings, errors=readings.errors[:n])):
            raise UsageError(f"Expected the readings of {str(self.path)!r}, got others; {NEW_FILE}.")
        if self.steps != steps:
            raise UsageError(f"Expected the steps of {str(self.path)!r}, or none, got others; {NEW_FILE}.")
        if self.is_practical != practical:
            ends = ("convergence", "practical stability")
            raise UsageError(
                f"Expected {ends[self.is_practical]} as in {str(self.path)!r}, got {ends[practical]}; {NEW_FILE}."
            )

    def require_set(self, states: Box, parameters: Sequence[str] = ()) -> None:
        """Refuse D or P that differ from those of the file.

        Args:
            states: D × P.
            parameters: their names, in order.
        """
        n = states.dimension - len(parameters)
        D, P = ([side.tolist() for side in (states.lower[part], states.upper[part])]
                for part in (slice(None, n), slice(n, None)))  # fmt: skip
        if self.parameters != dict(zip(parameters, map(list, zip(*P, strict=True)), strict=True)):
            raise UsageError(f"Expected the parameters of {str(self.path)!r}, got others; {NEW_FILE}.")
        if [self.states.lower.tolist(), self.states.upper.tolist()] != D:
            raise UsageError(f"Expected the λ and D of {str(self.path)!r}, got others; {NEW_FILE}.")

    def level(self, contracts: bool, rim: float) -> float:
        """The level up to which the proof searched; refused unless V is above it on the boundary of D.

        Args:
            contracts: whether contraction on B was proved again, or is not needed.
            rim: a lower bound of V on the boundary of D.

        Raises:
            UsageError: contraction is not proved again, or the level is not below rim.
        """
        fact = f"V > ρ = {self.wanted!r} on the boundary of D" if contracts else "F that contracts on B"
        if not contracts or not self.wanted < rim:
            raise UsageError(f"Expected {fact} of {str(self.path)!r}, got bounds that do not prove it; {REMEDY}.")
        return self.wanted


def kept_region(path: Path) -> KeptRegion:
    """Read the file of a region's proof, without checking it.

    Raises:
        UsageError: the file is not one of a region's proof.
    """
    content = select_proof(read_proofs(path), "region", path, NEW_FILE)
    with refuse_bad_file(path):
        of, wanted, _ = content["of"]
        lower, upper = (torch.tensor(of[side], dtype=torch.float64) for side in ("lower", "upper"))
        readings = readings_from(of.get("readings"), None)
        if readings is not None:  # the last axis is the age of a reading
            lower, upper = lower[:-1], upper[:-1]
        n = len(lower) - 1 - len(of.get("parameters", []))
        readings = readings and replace(readings, errors=readings.errors[:n])
        ranges = _ranges(of.get("parameters", []), lower[1 + n :].tolist(), upper[1 + n :].tolist())
        numbers = of["decay"], of["hole"], wanted, content["proved"], content["seconds"]
        decay, hole, wanted, rho, seconds = (float(number) for number in numbers)
        w, contracting = None, None
        if "disturbance" in of:
            w = torch.tensor(of["disturbance"], dtype=torch.float64)[:n]
            if not bool((w > 0).any()):
                raise ValueError("a disturbance of zeros")
        practical = of.get("practical", False)
        if not isinstance(practical, bool) or (practical and ("disturbance" in of or readings is not None)):
            raise ValueError("practical stability twice")
        if "disturbance" not in of and readings is None and not practical:
            lowest, highest, Y = (torch.tensor(side, dtype=torch.float64) for side in (*of["box"], of["Y"]))
            contracting = Box(lowest, highest), Y
        D = Box(lower[1 : 1 + n], upper[1 : 1 + n])
        steps = of.get("steps")
        if steps is not None:
            steps = {"dt": float(steps["dt"]), "method": str(steps["method"])}
        return KeptRegion(
            path, decay, D, ranges, contracting, w, readings, steps, hole, wanted, rho, seconds
        )  # fmt: skip


def _ranges(names: object, lower: list[float], upper: list[float]) -> dict[str, list[float]]:
    """The bounds of P by name.

    Raises:
        ValueError: names or bounds are invalid.
    """
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError("invalid names of parameters")
    ranges = {name: [low, high] for name, low, high in zip(names, lower, upper, strict=True)}
    if len(ranges) < len(names) or not all(-math.inf < low <= high < math.inf for low, high in ranges.values()):
        raise ValueError("invalid bounds of parameters")
    return ranges
