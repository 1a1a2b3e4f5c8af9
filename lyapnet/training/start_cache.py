"""Where a training started from, kept on disk: the same task, network and law start there again at once."""

import contextlib
import copy
import hashlib
import io
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from lyapnet.base.errors import LyapnetError
from lyapnet.base.files import write_atomically
from lyapnet.graphs.compilation import cache_folder, constants_of
from lyapnet.graphs.tracing import trace
from lyapnet.training import optima, pretraining
from lyapnet.training import start as search
from lyapnet.training.candidates import Candidate, Start
from lyapnet.training.initial_networks import kept_of
from lyapnet.training.learner import Learner
from lyapnet.training.stages import Report, silent
from lyapnet.training.start import choose_start, has_place_for_start
from lyapnet.value.expansions import in_float64
from lyapnet.value.linearisation import Missing

VERSION = 9  # of what a start is: to be raised where the search for one changes


class StartCache:
    """(task, networks as they are drawn, law) ↦ the start that was chosen and the weights it left.

    A task is what its traces say, X₀ and U: the operations and constants of its step, φ and h. Of what cannot be traced
    nothing is kept; what cannot be read is not there.

    Args:
        learners: as they are before a start is put into them.
        may_look_ahead: as the search is told.
    """

    def __init__(self, learners: Sequence[Learner], may_look_ahead: bool = False):
        self.learners = learners
        self.file = _file(learners, may_look_ahead)

    def read(self) -> Start | None:
        """Put the start that is kept into the learners; None where there is none."""
        if self.file is None:
            return None
        drawn = [copy.deepcopy(learner.V.state_dict()) for learner in self.learners]
        try:
            content = torch.load(io.BytesIO(self.file.read_bytes()), weights_only=True)
            start = _start_from(content["start"])
            for learner, state in zip(self.learners, content["weights"], strict=True):
                learner.V.load_state_dict(state)
        except Exception:  # whatever is wrong with a file of the cache, a start is sought anew
            for learner, state in zip(self.learners, drawn, strict=True):
                learner.V.load_state_dict(state)
            return None
        return start

    def write(self, start: Start) -> None:
        """Keep a start, and the weights of the learners that have it."""
        if self.file is None:
            return
        content, weights = io.BytesIO(), [learner.V.state_dict() for learner in self.learners]
        torch.save({"start": _plain(start), "weights": weights}, content)
        with contextlib.suppress(OSError):
            self.file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            with tempfile.TemporaryDirectory(dir=self.file.parent, prefix=".new_") as draft:  # of this process alone
                path = Path(draft) / "start"
                write_atomically(path, content.getvalue())
                path.replace(self.file)


def _file(learners: Sequence[Learner], may_look_ahead: bool) -> Path | None:
    problem, policy = learners[0].problem, learners[0].rollout.closed_loop.policy
    exact = in_float64(problem)
    x = exact.initial_states.sample(2, torch.Generator().manual_seed(0))
    u = exact.controls.project(torch.zeros(2, exact.system.m, dtype=torch.float64))
    functions = [(lambda x, u: exact.step(x, u), (x, u)), (lambda x: (exact.cost.terminal(x),), (x,))]
    if exact.constraints is not None:
        functions.append((lambda x: (exact.constraints(x),), (x,)))  # pyright: ignore[reportOptionalCall]
    try:
        with torch.no_grad():
            graphs = [trace(function, arguments) for function, arguments in functions]
    except (LyapnetError, RuntimeError):
        return None
    box, controls = exact.initial_states, exact.controls
    parts: list[Any] = [
        VERSION, torch.__version__, [(graph.code, constants_of(graph)) for graph in graphs], problem.goal.tolist(),
        box.lower.tolist(), box.upper.tolist(), type(controls).__qualname__,
        [(name, buffer.tolist()) for name, buffer in controls.named_buffers()], vars(problem.horizon),
        type(policy).__qualname__, may_look_ahead, kept_of(learners[0]), search.OPTIMA, optima.SMALL,
        pretraining.method_for(problem).steps,
        [(learner.seed, type(learner.V).__qualname__, str(learner.V), _digest(learner)) for learner in learners],
    ]  # fmt: skip
    return cache_folder() / "starts" / f"{hashlib.sha256(repr(parts).encode()).hexdigest()[:32]}.pt"


def _digest(learner: Learner) -> str:
    digest = hashlib.sha256()
    for name, tensor in learner.V.state_dict().items():
        digest.update(name.encode() + tensor.detach().cpu().numpy().tobytes())
    return digest.hexdigest()


def _plain(start: Start) -> dict[str, Any]:
    rows = [[*each[:4], None if each.missing is None else [*each.missing], each.note] for each in start.candidates]
    chosen = [*start.candidates].index(start.chosen)
    return {"chosen": chosen, "candidates": rows, "rest": [start.held_cost, start.gain_ahead]}


def _start_from(plain: dict[str, Any]) -> Start:
    candidates = [
        Candidate(name, cost, finite, seconds, missing and Missing(*missing), note, kept=True)
        for name, cost, finite, seconds, missing, note in plain["candidates"]
    ]
    return Start(candidates[plain["chosen"]], candidates, *plain["rest"])


def kept_or_chosen(
    learners: Sequence[Learner],
    report: Report = silent,
    known: Callable[[Candidate], None] = lambda candidate: None,
    may_look_ahead: bool = False,
) -> Start | None:
    """`choose_start`, or what it chose before for the same task, networks and law."""
    if not has_place_for_start(learners):
        return None
    report("looking for the start of an earlier search")
    cache = StartCache(learners, may_look_ahead)
    start = cache.read()
    if start is not None:
        for candidate in start.candidates:
            known(candidate)
        return start
    start = choose_start(learners, report, known, may_look_ahead)
    if start is not None:
        cache.write(start)
    return start
