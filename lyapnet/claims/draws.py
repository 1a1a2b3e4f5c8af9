"""The draws that were made of one checkpoint, in its run's folder: who draws until a claim pleases has to say so."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from lyapnet.base.files import appending, digest_of_file, read_file
from lyapnet.base.provenance import RUN_RECORD

DRAWS = "draws.jsonl"  # a line for each claim from sampled states


class Draws(NamedTuple):
    """The draws of a checkpoint by claims that ask for the same, which choose between seeds or numbers of states.

    Args:
        file: where they are recorded; None where there is no run's folder.
        about: what they are draws of.
    """

    file: Path | None
    about: Mapping[str, Any]

    def others(self, seed: int, samples: int) -> int:
        """How many other draws there were; a line that cannot be read counts as one."""
        made = {self._draw(line, i) for i, line in enumerate(self._lines())} - {None, (seed, samples)}
        # a draw for a sampled claim shows the states of the same seed, and no others
        return len(made - {("sampled", seed)})

    def record(self, kind: str, seed: int, samples: int, verdict: str) -> str | None:
        """Add a draw, unless it is there already; why it could not be recorded."""
        entry = {**self.about, "kind": kind, "seed": seed, "samples": samples, "verdict": verdict}
        if self.file is None:
            return "not recorded: the checkpoint lies outside a run's folder; other draws are not accounted for"
        line = json.dumps(entry, sort_keys=True)
        try:
            if line not in self._lines():
                with appending(self.file) as file:
                    file.write(f"{line}\n")
        except OSError as error:
            return f"not recorded: {error.strerror} ({self.file.name}); other draws may not be accounted for"
        return None

    def _lines(self) -> list[str]:
        try:
            return [] if self.file is None else read_file(self.file).decode(errors="replace").splitlines()
        except OSError:  # none yet, or none that can be read: then none can be added
            return []

    def _draw(self, line: str, number: int) -> tuple[Any, Any] | None:
        """What tells a recorded draw apart; None if it is of something else."""
        try:
            entry = json.loads(line)
            if any(entry[key] != value for key, value in self.about.items()):
                return None
            return ("sampled", entry["seed"]) if entry["kind"] == "sampled" else (entry["seed"], entry["samples"])
        except (ValueError, LookupError, TypeError):
            return ("unreadable", number)


def draws_of(checkpoint: Path, at: Sequence[str] | None = None, **about: Any) -> Draws:
    """The draws of a checkpoint's content, or of one member of its family, for claims with these further facts."""
    digest = " ".join([digest_of_file(checkpoint), *sorted(_plain(each) for each in at or [])])
    folders = _folders(checkpoint.resolve())
    return Draws(next((folder / DRAWS for folder in folders), None), {"checkpoint": digest, **about})


def _plain(at: str) -> str:
    """NAME=VALUE with the value as Python writes it: 0.90 is 0.9."""
    name, _, value = at.partition("=")
    return f"{name}={float(value)!r}"


def _folders(checkpoint: Path) -> Iterator[Path]:
    """The run's folder: above checkpoints/, or above that of a seed."""
    return (folder for folder in checkpoint.parents[1:3] if (folder / RUN_RECORD).is_file())
