"""The rule of lyapnet.prover.minima for machine code: closed forms only; other minima are left to the interpreter."""

from typing import Any

import torch

from lyapnet.prover.bound_kernel.program import Entry, Forms, Program
from lyapnet.prover.bound_kernel.rules import Rule
from lyapnet.prover.closed_minima import closed_minimum
from lyapnet.task.cost.minimum import LEAST, find_registered


def _least(program: Program, W: Any, b: Any, named: str) -> Forms:
    """(u, h)."""
    if isinstance(W, Forms) or not isinstance(b, Forms):
        raise NotImplementedError("W depends on the point, or b does not")
    u, h = closed_minimum(
        program, find_registered(named, torch.device("cpu")), W, [Entry(k) for k in b.entries.tolist()]
    )
    return Forms(torch.tensor([*u, h], dtype=torch.int64))


RULES: dict[Any, Rule] = {LEAST: _least}
