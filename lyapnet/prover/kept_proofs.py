"""Files of proofs, finished or not: a search can continue from them, and other people can check them.

A file holds one proof, or the two proofs of a two-sided claim, under their names (`DecreaseCondition.proves`). A proof
consists of plain data: what it is about, how the domain was cut (5 bytes a cut), which leaves are closed (decided),
which are waiting (undecided), and the counterexample that lowered the level. A SHA-256 digest precedes the data. A
reader verifies them as follows:

* The digest and the first line detect changed bits, truncated files and files of an earlier format.
* The leaves are computed from the cuts, so they cover the domain exactly; each must be either closed or waiting.
* The level is computed from the counterexample, at which the condition is evaluated again.
* The leaves of a finished proof are bounded again.

Someone who edits an unfinished proof and its digest can still list a waiting leaf as closed, and a search that
continues from it would believe that. `lyapnet certify check` does not: it bounds every leaf.
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

from lyapnet.base import linear_algebra
from lyapnet.base.errors import UsageError
from lyapnet.base.files import read_file, write_atomically
from lyapnet.base.plain_data import plain_data_of
from lyapnet.base.types import Corner
from lyapnet.graphs import c_functions, operators, tracing
from lyapnet.graphs.compilation import FLAGS
from lyapnet.prover.bounds import Bounds
from lyapnet.prover.boxes import CutTree
from lyapnet.prover.branch_and_bound import Search, just_below
from lyapnet.prover.condition import DecreaseCondition
from lyapnet.prover.counterexamples import Counterexample
from lyapnet.prover.operators import files
from lyapnet.task import ball, sets
from lyapnet.task.cost import control_costs, minimum

SOURCES = (Path(__file__).parent,)
"""The folder whose code a proof depends on: the search, the bounds and their kernel.

f, g, ℓ, V, u and the code that assembles c from them are not in it: the fingerprint of the traced function contains all
their operations and numbers. hash_of_sources adds SINGLE_FILES.
"""
SINGLE_FILES = (tracing, operators, c_functions, linear_algebra, ball, sets, control_costs, minimum)
"""The other modules that bounds use: of the tracing, which merges equal operations, of operators and exported programs,
and of costs and sets of controls, whose minimum is a single operation in a trace.
"""


def hash_of_sources(folders: Sequence[Path] = SOURCES) -> str:
    """A hash of the code in the folders and of the tracing, compiler flags, torch's version and users' operators."""
    found = hashlib.sha256(repr((FLAGS, str(torch.__version__), *files())).encode())
    for module in SINGLE_FILES:
        found.update(Path(str(module.__file__)).read_bytes())
    for folder in folders:
        for path in sorted(path for path in folder.rglob("*") if path.suffix in (".py", ".cpp", ".h")):
            content = path.read_bytes()
            found.update(f"{folder.name}/{path.relative_to(folder)} {len(content)}\n".encode())
            found.update(content)
    return found.hexdigest()


class ProofState(NamedTuple):
    """The state of a proof."""

    search: Search
    level: float  # the level up to which it is being proved
    worst: Counterexample | None  # the one that lowered the level
    seconds: float = 0.0

    @property
    def proved(self) -> float:
        """The level up to which c ≤ 0 is proved: on all undecided boxes W ≥ search.least."""
        return min(self.level, just_below(self.search.least))


def describe_condition(bounded: Bounds, condition: DecreaseCondition, lower: Corner, upper: Corner) -> dict[str, Any]:
    """What a proof is about, as plain data."""
    box = {"lower": lower.tolist(), "upper": upper.tolist(), "degree": bounded.degree}
    return {"proves": condition.proves, "fingerprint": bounded.fingerprint, **box, **condition.facts}


FORMAT = b"lyapnet proof 3\n"
DESCRIPTIONS = {
    "above": "a funnel", "below": "a bound from below", "region": "a region", "noisy": "a funnel under noise",
    "reach": "a target reached under noise",
}  # fmt: skip
"""Name of a proof ↦ what it proves, in words."""
TWO_SIDED = {"above", "below"}
"""The two proofs of a two-sided claim, which share a file."""


@dataclass
class KeptProof:
    """The file of the proof of one condition on one box up to one level, by the code of this version.

    Args:
        about: what is proved, as plain data, from describe_condition.
        wanted: the level up to which the condition is to be proved.
    """

    path: Path
    about: dict[str, Any]
    wanted: float

    def __post_init__(self) -> None:
        self._proofs = read_proofs(self.path) if self.path.exists() else {}

    @property
    def identity(self) -> list[Any]:
        """The condition, the wanted level and a hash of the code, since other code might not prove the closed boxes."""
        return [self.about, self.wanted, hash_of_sources()]

    def write(self, proof: ProofState) -> None:
        """Write the state of a proof; the file is replaced as a whole or not at all."""
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

    def read(self, domain: tuple[Corner, Corner], level: Callable[[Counterexample | None], float]) -> ProofState | None:
        """The state of the proof in the file; None if there is none yet.

        Args:
            level: counterexample or None ↦ level of the proof; raises ValueError if the condition holds at that point.

        Raises:
            UsageError: the file holds something else.
        """
        name = self.about["proves"]
        if name not in self._proofs and {name, *self._proofs} <= {name} | TWO_SIDED:
            return None
        content = select_proof(self._proofs, name, self.path, "take a new file")
        with refuse_bad_file(self.path):
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
                raise ValueError("closed and waiting leaves are not all leaves")
            found = content["worst"]
            worst = None if found is None else Counterexample(**found)
            reached = level(worst)
            waiting = leaves[place[frontier]]._replace(key=key.double())
            if len(key) != len(frontier) or not bool((key <= reached).all()):
                raise ValueError("a waiting leaf has a key above the level")
            finished = not len(frontier)
            given_up = float("inf") if finished else content["given_up"]  # given-up boxes are leaves, bounded again
            search = Search(leaves if finished else waiting, content["boxes"], given_up, tree)
            return ProofState(search, reached, worst, content["seconds"])

    def read_claim(self, domain: tuple[Corner, Corner], partial: bool = False) -> ProofState:
        """What a kept proof claims, to be checked: all its leaves as undecided boxes, and the level that it states.

        Args:
            partial: accept an unfinished proof too, with the level that it has reached.

        Raises:
            UsageError: the file holds another proof, an unfinished one, or none.
        """
        name = self.about["proves"]
        content, kind = select_proof(self._proofs, name, self.path), name if name in ("noisy", "reach") else "sound"
        with refuse_bad_file(self.path):
            if content["of"][:1] != [self.about]:
                raise UsageError(
                    f"Expected the proof of this V, by the options that it names, in {str(self.path)!r}, got another; "
                    "name its checkpoint."
                )
            leaves, waiting = CutTree(content["node"], content["axis"]).leaves(*domain), len(content["frontier"])
            claimed = ProofState(Search(leaves), float(content["proved"]), None)
        if waiting and not partial:
            raise UsageError(
                f"Expected a finished proof in {str(self.path)!r}, got an unfinished one (undecided boxes: {waiting}); "
                f"go on with lyapnet certify {kind} CKPT --keep {shlex.quote(str(self.path))} and the same options."
            )
        return claimed


def select_proof(proofs: dict[str, Any], name: str, path: Path, remedy: str = "name another") -> dict[str, Any]:
    """The proof of this name among the proofs of a file.

    Raises:
        UsageError: there is none; the message lists the existing ones.
    """
    with refuse_bad_file(path):
        if name not in proofs:
            raise UsageError(
                f"Expected the proof of {DESCRIPTIONS[name]} in {str(path)!r}, got that of "
                f"{' and of '.join(DESCRIPTIONS[each] for each in sorted(proofs))}; {remedy}."
            )
        return proofs[name]


def write_proofs(path: Path, proofs: dict[str, Any]) -> None:
    """Write proofs by their names; the file is replaced as a whole or not at all."""
    buffer = io.BytesIO()
    torch.save(proofs, buffer)
    payload = buffer.getvalue()
    write_atomically(path, FORMAT + hashlib.sha256(payload).digest() + payload)


def read_proofs(path: Path) -> dict[str, Any]:
    """The proofs in a file by their names; the digest is verified.

    Raises:
        UsageError: there is no such file, it has another format, or it was changed since it was written.
    """
    with refuse_bad_file(path):
        content = read_file(path)
        start = len(FORMAT) + hashlib.sha256().digest_size
        head, payload = content[:start], content[start:]
        if head != FORMAT + hashlib.sha256(payload).digest():
            if not content.startswith(FORMAT):
                raise ValueError("the first line is not that of this format")
            raise UsageError(
                f"Expected the proof that was written, got {str(path)!r}, which was changed or damaged since; name a "
                "copy of it, or another."
            )
        proofs = plain_data_of(io.BytesIO(payload))
        if not proofs or not proofs.keys() <= DESCRIPTIONS.keys():
            raise ValueError("the file holds no proofs by their names")
        return proofs


@contextmanager
def refuse_bad_file(path: Path) -> Iterator[None]:
    """A context that turns every exception into a UsageError that names the file; a UsageError passes unchanged."""
    try:
        yield
    except UsageError:
        raise
    except Exception as error:
        raise UsageError(
            f"Expected a proof in this version's format in {str(path)!r}, got "
            f"{'no' if isinstance(error, OSError) else 'another'} file; name another."
        ) from error
