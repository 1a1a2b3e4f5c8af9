"""Claims about a law that a program computes in floating-point numbers: the errors of the program."""

from collections.abc import Sequence
from dataclasses import replace

import torch

from lyapnet.base.errors import UsageError
from lyapnet.prover.float_errors import UNBOUNDED_STATE_LIMIT, FloatLaw
from lyapnet.prover.readings import Readings
from lyapnet.task.sets import Box


def add_program_errors(
    law: FloatLaw | None, readings: Readings | None, states: Box, left_out: Sequence[int]
) -> Readings | None:
    """The readings with the program's errors, for all measured states of D, added to the errors of the controls.

    Readings of a kept proof contain these errors already; the program is bounded again, and must not exceed them.

    Args:
        law: the program; None for a law in real numbers.
        states: D.
        left_out: states on which nothing depends; D does not bound them, and |x_i| ≤ UNBOUNDED_STATE_LIMIT is assumed.

    Raises:
        UsageError: the proof is about another program, or with smaller errors; or as FloatLaw.errors.
    """
    kept = None if readings is None else readings.computed
    if readings is None or (law is None and kept is None):
        return readings
    if law is None or (kept is not None and law.sha256 != kept.sha256):
        assert kept is not None
        got = "none" if law is None else law.sha256
        raise UsageError(
            f"Expected --file with the C of this proof, of SHA-256 {kept.sha256}, got {got}; name the folder of its "
            "export."
        )
    e = torch.tensor(readings.errors, dtype=torch.float64)
    e[list(left_out)] = UNBOUNDED_STATE_LIMIT
    found = law.computed_on((states.lower - e, states.upper + e))
    if kept is None:
        more = tuple(a + b for a, b in zip(readings.control_errors, found.errors, strict=True))
        return replace(readings, computed=found, control_errors=more)
    within = all(a <= min(b, c) for a, b, c in zip(found.errors, kept.errors, readings.control_errors, strict=True))
    if not within or found.precision != kept.precision or found.latest < kept.latest:
        raise UsageError(
            f"Expected errors of the C of at most {list(kept.errors)}, as in this proof, got {list(found.errors)}; "
            "prove it again with --file."
        )
    return readings
