"""Boxes and seconds to a proof of c ≤ 0: by the certifier, and by plain bisection with each enclosure."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch

from lyapnet.lab.bench.conditions import Bounded, condition_of_chain
from lyapnet.lab.bench.enclosures import ENCLOSURES, Enclosure, enclosure
from lyapnet.prover.boxes import root_box
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.prover.proof import prove

CERTIFIER = "certifier"
METHODS = (CERTIFIER, *ENCLOSURES)


@dataclass(frozen=True)
class Attempt:
    """One proof or refutation, a row of `lyapnet bench certify --json`."""

    case: str
    states: int  # n
    holds: bool  # the truth
    method: str
    verdict: str
    boxes: int
    seconds: float  # includes tracing c, and its gradient if the method needs it


def growth(dimensions: Sequence[int], seconds: float, delta: float = 0.5) -> Iterator[Attempt]:
    """Rows for chains of integrators: c ≤ 0 that holds, for each method up to its first unknown; and one that fails."""
    lost: set[str] = set()
    for n in sorted(dimensions):
        for method in METHODS:
            if method not in lost:
                proof = attempt(condition_of_chain(n, delta), method, seconds)
                lost |= {method} if proof.verdict == "unknown" else set()
                yield proof
        yield attempt(condition_of_chain(n, delta, holds=False), CERTIFIER, seconds, holds=False)


def attempt(case: Bounded, method: str, seconds: float, holds: bool = True) -> Attempt:
    """The row of a method for a condition.

    Raises:
        UsageError: there is no such method.
    """
    sample, budget = (case.lower, case.upper), Budget(seconds)
    if method == CERTIFIER:
        proof = prove(case.condition, sample, budget=budget)
        verdict, boxes = proof.verdict, proof.boxes
    else:
        verdict, boxes = bisect(case, enclosure(method, case.condition, sample), budget)
    return Attempt(case.name, len(case.lower) - 1, holds, method, verdict, boxes, budget.elapsed)


def bisect(case: Bounded, enclose: Enclosure, budget: Budget) -> tuple[str, int]:
    """(verdict on c ≤ 0, boxes) by bisection across the widest axis, depth first, of boxes on which c ≤ 0 is open.

    It lacks the certifier's search for counterexamples off the middles of boxes, and its choice of the axis.
    """
    sides = torch.where(case.upper > case.lower, case.upper - case.lower, 1.0)
    frontier = root_box(case.lower, case.upper, 0.0)
    boxes = 0
    while len(frontier.key):
        if budget.spent(boxes):
            return "unknown", boxes
        chunk, frontier = frontier.first(budget.chunk)
        boxes += len(chunk.key)
        chunk = chunk[~(enclose(chunk.lower, chunk.upper)[1] <= 0)]
        center = chunk.center
        if (case.condition(center[:, 0], center[:, 1:]) > 0).any():
            return "falsified", boxes
        widths = (chunk.upper - chunk.lower) / sides
        deeper = chunk._replace(key=widths.amax(-1))  # `first` takes smallest keys: depth first
        frontier = frontier.joined(deeper.halves(widths.argmax(-1)))
    return "certified", boxes
