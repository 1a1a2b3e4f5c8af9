"""Proofs in files, finished or not: how the domain was cut, from which they go on, and which others can check.

A file holds a proof by the name of what it proves (`DecreaseCondition.proves`), or the two of a two-sided claim: what
it is about, as plain data, how the domain was cut (5 bytes a cut), which leaves are closed and which wait, and what has
lowered the level; before all that stands its SHA-256. What is read is believed only as far as this goes:

* A flipped bit, a truncated file or one of an earlier format fails the digest or the first line.
* The leaves are made from the cuts, so that they cover the domain exactly; closed and waiting ones must be all of them.
* The level is computed from the counterexample, which is evaluated again.
* A finished proof is not believed: its leaves are bounded again.

Someone who edits a file and its digest can still call closed what waits in an unfinished proof. Resuming trusts the
digest there; `lyapnet certify check` does not, since it bounds every leaf and believes neither of the two lists.
"""

import hashlib
import io
import shlex
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch

from lyapnet.base.errors import UsageError
from lyapnet.base.files import read_file, write_atomically
from lyapnet.base.plain_data import plain_data_of
from lyapnet.base.types import Corner
from lyapnet.graphs import tracing
from lyapnet.graphs.compilation import FLAGS
from lyapnet.prover.bounds import BoundedFunction
from lyapnet.prover.boxes import CutTree
from lyapnet.prover.branch_and_bound import Search, just_below
from lyapnet.prover.condition import DecreaseCondition
from lyapnet.prover.counterexamples import Counterexample
from lyapnet.prover.operators import files

SOURCES = (Path(__file__).parent,)
"""The folder of what a proof is made by: the search, the bounds and their kernel.

f, g, ℓ, V, u and the calculus that assembles c from them need no place here: their outcome is in the fingerprint of the
traced function, operation by operation and number by number. The file of the tracing is hashed beside the folder: it
joins equal operations of what is bounded.
"""


def hash_of_sources(folders: Sequence[Path] = SOURCES) -> str:
    """A hash of every source file in some folders, with their names, the compilation, torch and own operators."""
    found = hashlib.sha256(repr((FLAGS, str(torch.__version__), *files())).encode())
    found.update(Path(tracing.__file__).read_bytes())
    for folder in folders:
        for path in sorted(path for path in folder.rglob("*") if path.suffix in (".py", ".cpp", ".h")):
            content = path.read_bytes()
            found.update(f"{folder.name}/{path.relative_to(folder)} {len(content)}\n".encode())
            found.update(content)
    return found.hexdigest()


class Standing(NamedTuple):
    """Where a proof stands."""

    search: Search
    level: float  # under which the rest is proved
    worst: Counterexample | None  # what has lowered the level
    seconds: float = 0.0

    @property
    def proved(self) -> float:
        """The level up to which c ≤ 0 is known."""
        return min(self.level, just_below(self.search.least))


def about(bounded: BoundedFunction, condition: DecreaseCondition, lower: Corner, upper: Corner) -> dict[str, Any]:
    """What a proof is about, as plain data."""
    box = {"lower": lower.tolist(), "upper": upper.tolist(), "degree": bounded.degree}
    return {"proves": condition.proves, "fingerprint": bounded.fingerprint, **box, **condition.facts}


FORMAT = b"lyapnet proof 3\n"
PROVED = {"above": "a funnel", "below": "a bound from below", "region": "a region"}
TOGETHER = {"above", "below"}
"""What stands in one file where it is proved of the same V: the two sides of a two-sided claim."""


@dataclass
class KeptProof:
    """The file of a proof of one function on one box up to one level, by the rules of this version.

    Args:
        about: what is proved; plain data.
        wanted: the level up to which it is tried.
    """

    path: Path
    about: dict[str, Any]
    wanted: float

    def __post_init__(self) -> None:
        self._proofs = read_proofs(self.path) if self.path.exists() else {}

    @property
    def identity(self) -> list[Any]:
        """The condition, the level, and the prover's sources: another version might not prove its closed boxes."""
        return [self.about, self.wanted, hash_of_sources()]

    def write(self, proof: Standing) -> None:
        """Keep a proof, all or nothing."""
        search, worst = proof.search, proof.worst
        node, axis = search.tree.cuts
        closed = torch.ones(2 * len(node) + 1, dtype=torch.bool)
        closed[torch.cat([node, search.frontier.node])] = False
        content = {
            "of": self.identity, "node": node.int(), "axis": axis.byte(), "closed": closed.nonzero().flatten().int(),
            "frontier": search.frontier.node.int(), "key": search.frontier.key, "given_up": search.given_up,
            "boxes": search.boxes, "proved": proof.proved, "worst": None if worst is None else worst._asdict(),
            "seconds": proof.seconds,
        }  # fmt: skip
        self._proofs[self.about["proves"]] = content
        write_proofs(self.path, self._proofs)

    def read(self, domain: tuple[Corner, Corner], level: Callable[[Counterexample | None], float]) -> Standing | None:
        """The proof that the file keeps; None where there is none yet.

        Args:
            level: of a proof with this counterexample; it may refuse it by a ValueError.

        Raises:
            UsageError: the file holds something else.
        """
        name = self.about["proves"]
        if name not in self._proofs and {name, *self._proofs} <= {name} | TOGETHER:
            return None
        content = part_of(self._proofs, name, self.path, "take a new file")
        with refusing(self.path):
            if content["of"] != self.identity:
                raise UsageError(
                    f"Expected the proof of this V, set and version by the same options in {str(self.path)!r}, got "
                    "another; take a new file."
                )
            tree, key = CutTree(content["node"], content["axis"]), content["key"]
            leaves, frontier = tree.leaves(*domain), content["frontier"].long()
            named = torch.cat([content["closed"].long(), frontier])
            place = torch.full((2 * tree.size + 1,), -1)
            place[leaves.node] = torch.arange(len(leaves.key))
            if len(named) != len(leaves.key) or not named.sort().values.equal(leaves.node.sort().values):
                raise ValueError("closed boxes and waiting ones are not all")
            found = content["worst"]
            worst = None if found is None else Counterexample(**found)
            reached = level(worst)
            waiting = leaves[place[frontier]]._replace(key=key.double())
            if len(key) != len(frontier) or not bool((key <= reached).all()):
                raise ValueError("a waiting box has no place in the order")
            finished = not len(frontier)  # then all is bounded once more
            given_up = float("inf") if finished else content["given_up"]
            search = Search(leaves if finished else waiting, content["boxes"], given_up, tree)
            return Standing(search, reached, worst, content["seconds"])

    def claim(self, domain: tuple[Corner, Corner], partial: bool = False) -> Standing:
        """The leaves of a proof of the same, none of them decided, and the level that it claims.

        Args:
            partial: whether what an unfinished proof has reached is a claim, too.

        Raises:
            UsageError: the file holds another proof, an unfinished one, or none.
        """
        content = part_of(self._proofs, self.about["proves"], self.path)
        with refusing(self.path):
            if content["of"][:1] != [self.about]:
                raise UsageError(
                    f"Expected the proof of this V, by the options that it names, in {str(self.path)!r}, got another; "
                    "name its checkpoint."
                )
            leaves, waiting = CutTree(content["node"], content["axis"]).leaves(*domain), len(content["frontier"])
            claimed = Standing(Search(leaves), float(content["proved"]), None)
        if waiting and not partial:
            raise UsageError(
                f"Expected a finished proof in {str(self.path)!r}, got an unfinished one (undecided boxes: {waiting}); "
                f"go on with lyapnet certify sound CKPT --keep {shlex.quote(str(self.path))} and the same options."
            )
        return claimed


def part_of(proofs: dict[str, Any], name: str, path: Path, remedy: str = "name another") -> dict[str, Any]:
    """The proof of that name among those of a file.

    Raises:
        UsageError: there is none; says what there is.
    """
    with refusing(path):
        if name not in proofs:
            raise UsageError(
                f"Expected the proof of {PROVED[name]} in {str(path)!r}, got that of "
                f"{' and of '.join(PROVED[each] for each in sorted(proofs))}; {remedy}."
            )
        return proofs[name]


def write_proofs(path: Path, proofs: dict[str, Any]) -> None:
    """Write proofs by their names, all or nothing."""
    buffer = io.BytesIO()
    torch.save(proofs, buffer)
    payload = buffer.getvalue()
    write_atomically(path, FORMAT + hashlib.sha256(payload).digest() + payload)


def read_proofs(path: Path) -> dict[str, Any]:
    """The proofs that a file holds, by their names, as they were written.

    Raises:
        UsageError: there is no such file; or it is another, of an earlier version, or changed since.
    """
    with refusing(path):
        content = read_file(path)
        start = len(FORMAT) + hashlib.sha256().digest_size
        head, payload = content[:start], content[start:]
        if head != FORMAT + hashlib.sha256(payload).digest():
            if not content.startswith(FORMAT):
                raise ValueError("another first line")
            raise UsageError(
                f"Expected the proof that was written, got {str(path)!r}, which was changed or damaged since; name a "
                "copy of it, or another."
            )
        proofs = plain_data_of(io.BytesIO(payload))
        if not proofs or not proofs.keys() <= PROVED.keys():
            raise ValueError("no proofs by their names")
        return proofs


@contextmanager
def refusing(path: Path) -> Iterator[None]:
    """Whatever fails while a file is read is a UsageError that names the file; a UsageError says so itself."""
    try:
        yield
    except UsageError:
        raise
    except Exception as error:
        raise UsageError(
            f"Expected a proof in this version's format in {str(path)!r}, got "
            f"{'no' if isinstance(error, OSError) else 'another'} file; name another."
        ) from error
