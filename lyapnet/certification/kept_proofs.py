"""Unfinished proofs in files, from which they go on."""

import hashlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch

from lyapnet.certification.boxes import Boxes
from lyapnet.certification.branch_and_bound import Search
from lyapnet.certification.counterexamples import Counterexample
from lyapnet.errors import UsageError
from lyapnet.files import write_atomically
from lyapnet.types import Corner

PACKAGE = Path(__file__).parents[1]
SOURCES = (PACKAGE / "certification", PACKAGE / "graphs")
"""The folders of what a proof is made by: the search, the bounds, the trace and its simplification.

f, g, ℓ, V, u and the calculus that assembles c from them need no place here: they are in the fingerprint of the traced
function, operation by operation and number by number.
"""


def hash_of_sources(folders: Sequence[Path] = SOURCES) -> str:
    """A hash of every source file in some folders, with their names."""
    found = hashlib.sha256()
    for folder in folders:
        for path in sorted(folder.rglob("*.py")):
            content = path.read_bytes()
            found.update(f"{folder.name}/{path.relative_to(folder)} {len(content)}\n".encode())
            found.update(content)
    return found.hexdigest()


class Unfinished(NamedTuple):
    """A proof on the way."""

    search: Search
    level: float  # under which the rest is proved
    worst: Counterexample | None  # what has lowered the level
    seconds: float = 0.0


@dataclass(frozen=True)
class KeptProof:
    """The file of a proof of one function on one box up to one level, by the rules of this version.

    Args:
        fingerprint: of the bounded function.
        lower, upper: the box.
        wanted: the level.
    """

    path: Path
    fingerprint: str
    lower: Corner
    upper: Corner
    wanted: float

    @property
    def identity(self) -> list[Any]:
        """What the proof is about, and the rules that it was made by: others might not have dropped what it dropped."""
        return [self.fingerprint, hash_of_sources(), self.lower.tolist(), self.upper.tolist(), self.wanted]

    def write(self, proof: Unfinished) -> None:
        """Keep a proof, all or nothing."""
        search, worst = proof.search, proof.worst
        content = {
            "of": self.identity, "frontier": list(search.frontier), "boxes": search.boxes,
            "given_up": search.given_up, "level": proof.level, "worst": None if worst is None else worst._asdict(),
            "seconds": proof.seconds,
        }  # fmt: skip
        buffer = io.BytesIO()
        torch.save(content, buffer)
        write_atomically(self.path, buffer.getbuffer())

    def read(self) -> Unfinished | None:
        """The proof that the file keeps; None where there is no file.

        Raises:
            UsageError: the file holds something else.
        """
        if not self.path.exists():
            return None
        name = str(self.path)
        try:
            content = torch.load(self.path, weights_only=True)
            same = content["of"] == self.identity
            found, search = content["worst"], Search(Boxes(*content["frontier"]), content["boxes"], content["given_up"])
            kept = Unfinished(
                search, content["level"], None if found is None else Counterexample(**found), content["seconds"]
            )
        except Exception as error:
            raise UsageError(f"Expected a proof in {name!r}, got another file; name a new one.") from error
        if not same:
            raise UsageError(
                f"Expected the proof of this V, α, δ, set and version in {name!r}, got another; take a new file."
            )
        return kept
