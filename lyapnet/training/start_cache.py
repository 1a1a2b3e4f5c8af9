"""A disk cache of initial networks: the same task, network and law need no second search."""

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
from lyapnet.training.initial_networks import states_of_value
from lyapnet.training.learner import Learner
from lyapnet.training.stage_messages import StageReport, silent
from lyapnet.training.start import choose_start, has_place_for_start
from lyapnet.value.expansions import in_float64
from lyapnet.value.linearisation import Missing

VERSION = 19  # of the search; increase it when the search changes


class StartCache:
    """A cache (task, random initial networks, law) ↦ the chosen start and the initialised weights.

    The task is identified by the traced operations and constants of its step, φ and h, and by X₀ and U. A task that
    cannot be traced is not cached; an unreadable file is ignored.

    Args:
        learners: the learners before the search.
        may_look_ahead: as for choose_start.
    """

    def __init__(self, learners: Sequence[Learner], may_look_ahead: bool = False):
        self.learners = learners
        self.file = _cache_file(learners, may_look_ahead)

    def read(self) -> Start | None:
        """Initialise the learners from the cache; None if it has no entry."""
        if self.file is None:
            return None
        drawn = [copy.deepcopy(learner.V.state_dict()) for learner in self.learners]
        try:
            content = torch.load(io.BytesIO(self.file.read_bytes()), weights_only=True)
            start = _from_plain(content["start"])
            for learner, state in zip(self.learners, content["weights"], strict=True):
                learner.V.load_state_dict(state)
        except Exception:  # search again, whatever is wrong with the file
            for learner, state in zip(self.learners, drawn, strict=True):
                learner.V.load_state_dict(state)
            return None
        return start

    def write(self, start: Start) -> None:
        """Store a start and the learners' weights."""
        if self.file is None:
            return
        content, weights = io.BytesIO(), [learner.V.state_dict() for learner in self.learners]
        torch.save({"start": _to_plain(start), "weights": weights}, content)
        with contextlib.suppress(OSError):
            self.file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            # no other process uses this folder
            with tempfile.TemporaryDirectory(dir=self.file.parent, prefix=".new_") as draft:
                path = Path(draft) / "start"
                write_atomically(path, content.getvalue())
                path.replace(self.file)


def _cache_file(learners: Sequence[Learner], may_look_ahead: bool) -> Path | None:
    problem, policy = learners[0].problem, learners[0].rollout.closed_loop.policy
    exact = in_float64(problem)
    x = exact.initial_states.sample(2, torch.Generator().manual_seed(0))
    u = exact.controls.project(torch.zeros(2, exact.system.m, dtype=torch.float64))
    functions = [(lambda x, u: exact.step(x, u), (x, u)), (lambda x: (exact.cost.terminal(x),), (x,))]
    if exact.constraints is not None:
        functions.append((lambda x: (exact.constraints(x),), (x,)))  # pyright: ignore[reportOptionalCall]
    if exact.noise is not None:
        functions.append((lambda x: (exact.noise(x),), (x,)))  # pyright: ignore[reportOptionalCall]
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
        type(policy).__qualname__, may_look_ahead, problem.risk, states_of_value(learners[0]), search.MAX_OPTIMA,
        optima.MAX_OPTIMA_OF_DIMENSION, pretraining.method_for(problem).steps,
        [(learner.seed, type(learner.V).__qualname__, str(learner.V), _digest(learner)) for learner in learners],
    ]  # fmt: skip
    return cache_folder() / "starts" / f"{hashlib.sha256(repr(parts).encode()).hexdigest()[:32]}.pt"


def _digest(learner: Learner) -> str:
    digest = hashlib.sha256()
    for name, tensor in learner.V.state_dict().items():
        digest.update(name.encode() + tensor.detach().cpu().numpy().tobytes())
    return digest.hexdigest()


def _to_plain(start: Start) -> dict[str, Any]:
    rows = [[*each[:4], None if each.missing is None else [*each.missing], each.note] for each in start.candidates]
    chosen = [*start.candidates].index(start.chosen)
    return {"chosen": chosen, "candidates": rows, "rest": [start.held_cost, start.gain_ahead]}


def _from_plain(plain: dict[str, Any]) -> Start:
    candidates = [
        Candidate(name, cost, finite, seconds, missing and Missing(*missing), note, kept=True)
        for name, cost, finite, seconds, missing, note in plain["candidates"]
    ]
    return Start(candidates[plain["chosen"]], candidates, *plain["rest"])


def load_or_choose_start(
    learners: Sequence[Learner],
    report: StageReport = silent,
    known: Callable[[Candidate], None] = lambda candidate: None,
    may_look_ahead: bool = False,
) -> Start | None:
    """The result of `choose_start`, from the cache if it is there."""
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
