"""The C files of an export, read for claims about them: compared with a new export, and traced for proofs."""

import copy
import hashlib
import re
from pathlib import Path
from typing import Any

import torch
from torch.fx import Graph, Node

from lyapnet.base.errors import ExportError, UsageError
from lyapnet.base.files import digest_of_file, read_file, write_atomically
from lyapnet.controller.controller import Controller
from lyapnet.exchange.export.c import Style, limits_of
from lyapnet.exchange.export.facts import facts_of
from lyapnet.exchange.export.law import Law
from lyapnet.exchange.export.writing import DTYPES, Written
from lyapnet.prover.float_errors import FloatLaw
from lyapnet.prover.simplification import with_known_times, without_copies
from lyapnet.task.sets import ControlBox

FILES = ("policy.h", "policy.c")
LATEST = 1 - 2.0**-20
"""Share of T up to which readings are covered; closer to T, float32 may round t to T, where another law begins."""


class CertifiedFiles:
    """policy.h and policy.c of an export, which must be equal to those that `export` writes for the controller.

    Args:
        place: their folder, or the path of one of them.
        checkpoint: the checkpoint of the controller.

    Raises:
        UsageError: they differ, with the first line that does; or there are none.
    """

    def __init__(self, controller: Controller, place: str | Path, checkpoint: Path | None = None):
        self._folder = Path(place) if Path(place).is_dir() else Path(place).parent
        self._texts = {name: _read(self._folder / name) for name in FILES}
        header = self._texts["policy.h"]
        style = re.search(r"typedef (float|double) (\w+)_real;", header)
        beyond = re.search(r"; after that (\w+):", header)
        if style is None or beyond is None or "_loop;" in header:
            got = "one with an estimator" if "_loop;" in header else "others"
            raise UsageError(
                f"Expected files of lyapnet export --to c in {str(self._folder)!r}, got {got}; name its folder."
            )
        self._controller = controller.continued(beyond[1])
        self._style = Style(style[2], DTYPES["float32" if style[1] == "float" else "float64"])
        self._checkpoint = checkpoint
        self.claimed = " ".join(_between(header, "certified: ", " */").split())
        for name, text in self._sources(self.claimed).items():
            if text != self._texts[name]:
                lines = zip([*text.splitlines(), ""], [*self._texts[name].splitlines(), ""], strict=False)
                line = next((k for k, (own, other) in enumerate(lines, 1) if own != other), 1)
                raise UsageError(
                    f"Expected {name} as lyapnet export writes it for this checkpoint, got another from line {line} on "
                    f"in {str(self._folder)!r}; export it again, or name its own checkpoint."
                )

    @property
    def sha256(self) -> str:
        """The digest of both files without the comments at their top, which may state a claim with this digest."""
        code = "".join(self._texts[name].partition("*/\n")[2] for name in FILES)
        return hashlib.sha256(code.encode()).hexdigest()

    def law(self) -> FloatLaw:
        """The law that the files compute, for proofs about the controller's closed loop.

        Raises:
            UsageError: the controller is in float32, or has limits that are not fixed for each control.
        """
        controller, dtype, policy = self._controller, self._controller.initial_states.lower.dtype, None
        limits, controls = limits_of(controller, self._style), controller.controls
        if dtype != torch.float64 or (controls.limited and limits is None):
            got = "one in float32" if dtype != torch.float64 else str(controls)
            raise UsageError(
                f"Expected a controller in float64 with a fixed limit for each control, or none, got {got}."
            )
        moved = [0.0] * controller.system.m
        if limits is not None and self._style.single and isinstance(controls, ControlBox):
            own = (side.double().expand(controller.system.m) for side in (controls.lower, controls.upper))
            apart = torch.stack([(a - b).abs().nan_to_num(nan=0.0) for a, b in zip(limits, own, strict=True)])
            moved = apart.amax(0).tolist()
        law, latest = Law(controller), LATEST * controller.horizon.duration
        policy = controller.closed_loop.policy
        graph = with_known_times(law.control_beside(policy), latest)
        if not _is_same(*_output(without_copies(copy.deepcopy(graph).graph)).args[0]):  # pyright: ignore
            raise UsageError(
                "Expected a law that is written as it is certified, got one that differs in the operations of its "
                "trace; certify it without --file."
            )
        _output(graph.graph).args = (_output(graph.graph).args[0][:1],)  # pyright: ignore
        graph.graph.eliminate_dead_code()
        graph.recompile()
        sizes = [len(part) for name, part in law.arguments.items() if name != "t"]
        return FloatLaw(graph, sizes, self._style.dtype, moved, latest, self.sha256, str(self._folder), self.claimed)

    def write_claim(self, claim: str) -> Path:
        """Write a claim about the files into the comment of the header."""
        write_atomically(self._folder / "policy.h", self._sources(claim)["policy.h"].encode())
        return self._folder / "policy.h"

    def _sources(self, claim: str) -> dict[str, str]:
        """Both files as `export` writes them for the controller, with the measured differences of the files read."""
        facts, header = facts_of(self._controller, self._checkpoint), self._texts["policy.h"]
        known = _between(header, "   checkpoint: ", "\n")
        if self._checkpoint is not None and known.endswith(f", SHA-256 {digest_of_file(self._checkpoint)}"):
            facts["checkpoint"] = known  # named from another folder
        law = Law(self._controller, self._style.dtype)
        written = Written(self._controller, law, facts, self._style, None)
        made = written.sources(claim, verified=_between(header, "   verified: ", "\n"))
        return {name: made[name] for name in FILES}


def _read(path: Path) -> str:
    try:
        return read_file(path).decode()
    except (OSError, UnicodeDecodeError, ExportError) as error:
        raise UsageError(
            f"Expected policy.h and policy.c of lyapnet export in {str(path.parent)!r}, got none; name its folder."
        ) from error


def _output(graph: Graph) -> Node:
    return next(iter(graph.find_nodes(op="output")))


def _is_same(one: Any, other: Any) -> bool:
    """Whether two values of a graph are the same operations of the same values."""
    if isinstance(one, Node) and isinstance(other, Node):
        alike = one.op == other.op == "call_function" and one.target is other.target and one.kwargs == other.kwargs
        return one is other or (alike and _is_same(one.args, other.args))
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(map(_is_same, one, other))
    return type(one) is type(other) and one == other


def _between(text: str, start: str, end: str) -> str:
    """The text between the first `start` and the next `end`; empty if there is none."""
    return text.partition(start)[2].partition(end)[0]
