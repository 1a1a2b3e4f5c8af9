"""Which cases of a test run when: a sample by default, all of them at the gate."""

from collections.abc import Iterable
from typing import Any

import pytest


def sample(cases: Iterable[Any], of: int) -> list[Any]:
    """The cases of a parameter: the first, and every `of`-th after it, by default; the others at the gate."""
    return [at_the_gate(case) if k % of else case for k, case in enumerate(cases)]


def at_the_gate(case: Any) -> Any:
    """A case, or a tuple of several parameters' values, which the default leaves out."""
    if isinstance(case, type(pytest.param())):
        return pytest.param(*case.values, id=case.id, marks=(*case.marks, pytest.mark.gate))
    return pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.gate)
