"""Lists in a config: one number for each state or control, or one for all."""

from collections.abc import Sequence
from typing import Any

import torch

from lyapnet.base.errors import UsageError
from lyapnet.task.systems import ControlAffineSystem


def rows(name: str, matrix: Any) -> Any:
    """Convert a flat list of numbers to a diagonal matrix; rows remain unchanged."""
    if not isinstance(matrix, list | tuple):
        raise ValueError(f"Expected {name} as a number, the diagonal's numbers or a list of rows, got {matrix!r}.")
    if all(type(entry) in (int, float) for entry in matrix):
        return torch.diag(torch.tensor(matrix, dtype=torch.get_default_dtype()))
    return matrix


def entry_per_state(key: str, entries: list[float] | None, system: ControlAffineSystem) -> list[float] | None:
    """A list with one entry for each state, from such a list or a single number; None if there is none.

    Raises:
        UsageError: the length is wrong; names the key.
    """
    every = repeated(entries, system.n)
    if every is not None:
        require_length(key, len(every), system.state_names)
    return every


def repeated(entries: Any, n: int) -> Any:
    """Repeat a number, or a list of one number, n times; anything else remains unchanged."""
    listed = [entries] if type(entries) in (int, float) else entries
    alone = isinstance(listed, list | tuple) and len(listed) == 1 and isinstance(listed[0], int | float)
    return [*listed] * n if alone else entries


def require_length(key: str, length: int, names: Sequence[str]) -> None:
    """Raise UsageError unless a list has one entry for each of some states or controls."""
    if length != len(names):
        entries = "one entry" if len(names) == 1 else f"{len(names)} entries"
        raise UsageError(f"Expected {key} with {entries} ({', '.join(names)}), got {length}; give one for each.")


def index_of(name: str, key: str, system: ControlAffineSystem) -> int:
    """The index of the state with a name.

    Raises:
        UsageError: there is no such state; names the key.
    """
    if name not in system.state_names:
        names = ", ".join(system.state_names)
        raise UsageError(f"Expected {key} among {names}, got {name!r}; name states of the system.")
    return list(system.state_names).index(name)
