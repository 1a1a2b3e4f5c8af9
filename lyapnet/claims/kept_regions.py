"""What the file of a region's proof proposes to prove again."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.base.errors import UsageError
from lyapnet.base.types import State
from lyapnet.prover.kept_proofs import part_of, read_proofs, refusing
from lyapnet.task.sets import Box

NEW_FILE = "take another file"
REMEDY = f"allow more seconds, or {NEW_FILE}"


class KeptRegion(NamedTuple):
    """What a file proposes to prove again of a region, and what it says is proved."""

    path: Path
    decay: float  # λ in 1/s
    states: Box  # D; without width along states that nothing depends on
    parameters: dict[str, list[float]]  # the ends of P by name; empty where it is about one plant
    contracting: tuple[Box, Tensor] | None  # (B, Y); none with a disturbance
    disturbance: State | None  # w
    hole: float  # c
    wanted: float  # the level that was tried
    rho: float  # the level that is proved, as it says
    seconds: float  # of the search

    def require(self, decay: float, disturbance: State | None, n: int, parameters: Sequence[str] = ()) -> None:
        """Refuse another λ, w or other parameters than those of the file: before anything is traced.

        Args:
            disturbance: of n states, beside zeros.
            parameters: their names.
        """
        if self.parameters.keys() != {*parameters}:
            raise UsageError(f"Expected the parameters of {str(self.path)!r}, got others; {NEW_FILE}.")
        if self.decay != decay:
            raise UsageError(f"Expected the λ and D of {str(self.path)!r}, got others; {NEW_FILE}.")
        kept, given = (None if w is None else w.tolist() for w in (self.disturbance, disturbance))
        if kept != (given and given[:n]):
            raise UsageError(f"Expected the disturbance of {str(self.path)!r}, got another; {NEW_FILE}.")

    def require_set(self, states: Box, parameters: Sequence[str] = ()) -> None:
        """Refuse another D or P than those of the file.

        Args:
            states: beside the ends of P.
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
        """The level that was tried, where V is above it on the boundary of D.

        Args:
            contracts: whether the law is seen to contract on B, where it has to.
        """
        where = f"V > ρ = {self.wanted!r} on the boundary of D" if contracts else "F that contracts on B"
        if not contracts or not self.wanted < rim:
            raise UsageError(f"Expected {where} of {str(self.path)!r}, got no bounds that say so; {REMEDY}.")
        return self.wanted


def kept_region(path: Path) -> KeptRegion:
    """What the file of a region's proof says; nothing is bounded.

    Raises:
        UsageError: it is another file.
    """
    content = part_of(read_proofs(path), "region", path, NEW_FILE)
    with refusing(path):
        of, wanted, _ = content["of"]
        lower, upper = (torch.tensor(of[side], dtype=torch.float64) for side in ("lower", "upper"))
        n = len(lower) - 1 - len(of.get("parameters", []))
        ranges = _ranges(of.get("parameters", []), lower[1 + n :].tolist(), upper[1 + n :].tolist())
        numbers = of["decay"], of["hole"], wanted, content["proved"], content["seconds"]
        decay, hole, wanted, rho, seconds = (float(number) for number in numbers)
        w, contracting = None, None
        if "disturbance" in of:
            w = torch.tensor(of["disturbance"], dtype=torch.float64)[:n]
            if not bool((w > 0).any()):
                raise ValueError("a disturbance that is none")
        else:
            lowest, highest, Y = (torch.tensor(side, dtype=torch.float64) for side in (*of["box"], of["Y"]))
            contracting = Box(lowest, highest), Y
        D = Box(lower[1 : 1 + n], upper[1 : 1 + n])
        return KeptRegion(path, decay, D, ranges, contracting, w, hole, wanted, rho, seconds)


def _ranges(names: object, lower: list[float], upper: list[float]) -> dict[str, list[float]]:
    """The ends of P by name.

    Raises:
        ValueError: they are none.
    """
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError("names that are none")
    ranges = {name: [low, high] for name, low, high in zip(names, lower, upper, strict=True)}
    if len(ranges) < len(names) or not all(-math.inf < low <= high < math.inf for low, high in ranges.values()):
        raise ValueError("parameters that are none")
    return ranges
