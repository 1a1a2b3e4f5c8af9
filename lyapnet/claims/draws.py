"""Records the draws for one checkpoint in its run's folder, since choosing the best of them lowers the confidence."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from lyapnet.base.files import digest_of_file, open_for_appending, read_file
from lyapnet.base.provenance import RUN_RECORD

DRAWS = "draws.jsonl"  # file with one line for each claim from sampled states


class Draws(NamedTuple):
    """The recorded draws of a checkpoint, for claims that differ only in the seed or the number of states.

    Args:
        file: the record; None if the checkpoint is not in a run's folder.
        about: the checkpoint and the options of the claim.
    """

    file: Path | None
    about: Mapping[str, Any]

    def others(self, seed: int, samples: int) -> int:
        """The number of draws with another seed or number of samples; a line that cannot be read counts as one."""
        recorded = {self._draw(line, i) for i, line in enumerate(self._lines())} - {None, (seed, samples)}
        # a sampled claim with the same seed draws the same states
        return len(recorded - {("sampled", seed)})

    def record(self, kind: str, seed: int, samples: int, verdict: str) -> str | None:
        """Record a draw unless it is recorded already; return the reason if this is impossible, else None."""
        entry = {**self.about, "kind": kind, "seed": seed, "samples": samples, "verdict": verdict}
        if self.file is None:
            return "not recorded: the checkpoint lies outside a run's folder; other draws are not accounted for"
        line = json.dumps(entry, sort_keys=True)
        try:
            if line not in self._lines():
                with open_for_appending(self.file) as file:
                    file.write(f"{line}\n")
        except OSError as error:
            return f"not recorded: {error.strerror} ({self.file.name}); other draws may not be accounted for"
        return None

    def _lines(self) -> list[str]:
        try:
            return [] if self.file is None else read_file(self.file).decode(errors="replace").splitlines()
        except OSError:  # no record yet; or it cannot be read, and then `record` fails too
            return []

    def _draw(self, line: str, number: int) -> tuple[Any, Any] | None:
        """The identity of a recorded draw; None if it is about another checkpoint or other options."""
        try:
            entry = json.loads(line)
            if any(entry[key] != value for key, value in self.about.items()):
                return None
            return ("sampled", entry["seed"]) if entry["kind"] == "sampled" else (entry["seed"], entry["samples"])
        except (ValueError, LookupError, TypeError):
            return ("unreadable", number)


def draws_of(checkpoint: Path, at: Sequence[str] | None = None, **about: Any) -> Draws:
    """The draws of a checkpoint, or of one member of its family, for claims with these options."""
    digest = " ".join([digest_of_file(checkpoint), *sorted(_normalise(each) for each in at or [])])
    folders = _folders(checkpoint.resolve())
    return Draws(next((folder / DRAWS for folder in folders), None), {"checkpoint": digest, **about})


def _normalise(at: str) -> str:
    """NAME=VALUE with the value in Python's notation: 0.90 becomes 0.9."""
    name, _, value = at.partition("=")
    return f"{name}={float(value)!r}"


def _folders(checkpoint: Path) -> Iterator[Path]:
    """The run's folder: the parent of checkpoints/, or the parent of a seed's folder."""
    return (folder for folder in checkpoint.parents[1:3] if (folder / RUN_RECORD).is_file())
