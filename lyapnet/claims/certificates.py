"""A certificate: a claim about one controller, with all that a table, a figure and a report show of it."""

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

NOT_PROVED = "No level ρ was proved: nothing is claimed. The conditions below were sought."
FROZEN = "whatever else their code reads (globals, counters, files) is frozen as it was then."


class Certificate(ABC):
    """A claim about a controller. Each kind is a class of its own, the only place that knows it.

    Args:
        claim: what was found, of the kind.
        options: as plain data; `seed` among them.
    """

    kind: str
    controller: Controller
    options: Mapping[str, Any]  # all that the claim was made with, by the names of the command line
    picture: str = "claim.png"  # what a report calls the file of its figure
    labels: ClassVar[Mapping[str, str]]  # key of `result` ↦ what a table calls it, in the table's order
    claim: Any
    claims: Sequence[Any] = ()  # those that lyapnet.certify was asked for

    def __init__(self, controller: Controller, claim: Any, options: Mapping[str, Any]):
        self.controller, self.claim, self.options = controller, claim, options

    @property
    def verdict(self) -> Verdict:
        """The claim's."""
        return self.claim.verdict

    @cached_property
    def result(self) -> dict[str, Any]:
        """What `lyapnet certify --json` prints: plain data, None where there is no finite number."""
        return plain({"kind": self.kind, "verdict": self.verdict, **self.numbers(), "seed": self.options["seed"]})

    @property
    def rows(self) -> list[tuple[str, str]]:
        """Its numbers, and what a table calls them."""
        return rows_of(self.result, self.labels)

    def table(self, title: str) -> Any:
        """Title, kind, verdict and numbers, for a terminal."""
        return table_of(f"{title}\n{self.kind}: {self.verdict}", self.rows)

    def write(self, folder: str | Path, checkpoint: str | Path | None = None) -> list[Path]:
        """Write report.md, report.json and the figure into a folder; their paths.

        Args:
            checkpoint: of the controller, whose hash and config the report has; None: it was made from parts.
        """
        require_writable(None, Path(folder))
        given = repr(str(checkpoint)) if checkpoint else "controller"
        call = f"lyapnet.certify({', '.join([given, *map(repr, self.claims)])}, seed={self.options['seed']})"
        return list(write_outputs(self, Path(checkpoint) if checkpoint else None, call, None, Path(folder)))

    def __str__(self) -> str:
        return text_of(self.table(repr(self.controller)))

    @abstractmethod
    def numbers(self) -> dict[str, Any]:
        """What is known of the claim, by the names it is printed under."""

    @abstractmethod
    def in_words(self) -> str:
        """What is claimed, with its numbers."""

    @property
    def of_parameters(self) -> str:
        """What there is to say of the parameters of a family."""
        system = self.controller.system
        names = ", ".join(system.state_names[i] for i in system.constants)
        return f" The states include the parameters of a family, which stay what they are: {names}." * bool(names)

    @abstractmethod
    def in_formulas(self) -> list[str]:
        """The conditions of the claim, one a line, with their numbers."""

    @abstractmethod
    def of_the_verdict(self) -> str:
        """What the verdict is about, and why it is what it is."""

    @abstractmethod
    def figure(self) -> figures.Figure:
        """The claim, drawn."""

    def command(self, checkpoint: str, at: Sequence[str] = (), **user: str | None) -> str:
        """The command line that makes the certificate again, defaults written out.

        Args:
            at: NAME=VALUE of each parameter, where it is about one member of a family.
            user: `system`, `network` and so on, where they are the user's own.
        """
        named = {name: value for name, value in {**self.options, **user}.items() if value is not None}
        each = [(name, one) for name, value in named.items() for one in (value if isinstance(value, list) else [value])]
        options = [f"--{name}" if value is True else f"--{name}={value}" for name, value in each]
        options += [f"--at={each}" for each in at]
        return shlex.join(["lyapnet", "certify", self.kind, checkpoint, *options])


def named_pushes(w: State | None, names: Sequence[str]) -> dict[str, float]:
    """The disturbed states and how much their derivatives are pushed at most."""
    return {} if w is None else {names[i]: float(w[i]) for i in range(len(w)) if w[i] > 0}


def however_pushed(pushes: Mapping[str, float]) -> str:
    """What a claim says of disturbances."""
    each = ", ".join(f"of at most {w!r} on d({name})/dt" for name, w in pushes.items())
    return f"whatever pushes there are, {each}"


def listed(x: Sequence[float]) -> str:
    """A state in a sentence."""
    return f"({', '.join(f'{entry:.6g}' for entry in x)})"
