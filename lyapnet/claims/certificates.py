"""A certificate: what was found for a claim about one controller, as a table, a figure and a report."""

import shlex
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

from lyapnet.base.files import plain
from lyapnet.base.types import State
from lyapnet.claims import figures
from lyapnet.claims.report import require_writable, write_outputs
from lyapnet.claims.tables import rows_of, table_of, text_of
from lyapnet.controller.controller import Controller
from lyapnet.prover.verdict import Verdict

NOT_PROVED = "No level ρ was proved: nothing is claimed. The conditions below were not proved."
FROZEN = "everything else that their code reads (globals, counters, files) is frozen at its value then."


class Certificate(ABC):
    """The result of a claim about a controller; each kind of claim has its own subclass.

    Args:
        claim: the result: the numbers that were proved or sampled.
        options: the options of the claim and of the run as plain data, with the key `seed`.
    """

    kind: str
    controller: Controller
    options: Mapping[str, Any]  # the options of the claim and of the run, by their names on the command line
    picture: str = "claim.png"  # file name of the figure in a report
    labels: ClassVar[Mapping[str, str]]  # key of `result` ↦ its label in a table, in the table's order
    claim: Any
    claims: Sequence[Any] = ()  # as passed to lyapnet.certify

    def __init__(self, controller: Controller, claim: Any, options: Mapping[str, Any]):
        self.controller, self.claim, self.options = controller, claim, options

    @property
    def verdict(self) -> Verdict:
        """Certified, falsified or unknown."""
        return self.claim.verdict

    @cached_property
    def result(self) -> dict[str, Any]:
        """The object that `lyapnet certify --json` prints: plain data, with None for numbers that are not finite."""
        return plain({"kind": self.kind, "verdict": self.verdict, **self.numbers(), "seed": self.options["seed"]})

    @property
    def rows(self) -> list[tuple[str, str]]:
        """(label, number as text) for each row of a table."""
        return rows_of(self.result, self.labels)

    def table(self, title: str) -> Any:
        """A table with title, kind, verdict and numbers, for a terminal."""
        return table_of(f"{title}\n{self.kind}: {self.verdict}", self.rows)

    def write(self, folder: str | Path, checkpoint: str | Path | None = None) -> list[Path]:
        """Write report.md, report.json and the figure into a folder; return their paths.

        Args:
            checkpoint: the checkpoint of the controller, for its hash in the report; None if there is none.
        """
        require_writable(None, Path(folder))
        controller = repr(str(checkpoint)) if checkpoint else "controller"
        call = f"lyapnet.certify({', '.join([controller, *map(repr, self.claims)])}, seed={self.options['seed']})"
        return list(write_outputs(self, Path(checkpoint) if checkpoint else None, call, None, Path(folder)))

    def __str__(self) -> str:
        return text_of(self.table(repr(self.controller)))

    @abstractmethod
    def numbers(self) -> dict[str, Any]:
        """The numbers of the claim, by their keys in `result`."""

    @abstractmethod
    def in_words(self) -> str:
        """The claim as a paragraph, with its numbers."""

    @property
    def parameters_text(self) -> str:
        """A sentence on the parameters of a family; empty if the system is no family."""
        system = self.controller.system
        names = ", ".join(system.state_names[i] for i in system.constants)
        return f" The states include the parameters of a family, which are constant: {names}." * bool(names)

    @abstractmethod
    def in_formulas(self) -> list[str]:
        """The conditions of the claim with their numbers, one formula for each line."""

    @abstractmethod
    def verdict_text(self) -> str:
        """The claim that the verdict is about, and the reason for the verdict."""

    @abstractmethod
    def figure(self) -> figures.Figure:
        """A figure of the claim."""

    def command(self, checkpoint: str, at: Sequence[str] = (), **user: str | None) -> str:
        """The command line that repeats the certificate, with all defaults written out.

        Args:
            at: NAME=VALUE for each parameter, if the certificate is about one member of a family.
            user: `system`, `network` and so on, if the user wrote them.
        """
        written = {**self.options, **user}
        given = {name: value for name, value in written.items() if value is not None and value is not False}
        pairs = [
            (name, one) for name, value in given.items() for one in (value if isinstance(value, list) else [value])
        ]
        options = [f"--{name}" if value is True else f"--{name}={value}" for name, value in pairs]
        options += [f"--at={assignment}" for assignment in at]
        return shlex.join(["lyapnet", "certify", self.kind, checkpoint, *options])


def named_disturbance(w: State | None, names: Sequence[str]) -> dict[str, float]:
    """The bound w_i of each disturbed state, by its name."""
    return {} if w is None else {names[i]: float(w[i]) for i in range(len(w)) if w[i] > 0}


def disturbance_text(w: Mapping[str, float]) -> str:
    """The disturbances of a claim, in words."""
    bounds = ", ".join(f"of at most {bound!r} on d({name})/dt" for name, bound in w.items())
    return f"under all disturbances {bounds}"


def format_state(x: Sequence[float]) -> str:
    """A state as text, such as (0.5, 1)."""
    return f"({', '.join(f'{entry:.6g}' for entry in x)})"
