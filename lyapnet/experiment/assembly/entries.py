"""Lists in a config: one number for each state or control, or one for all."""

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import torch

from lyapnet.base.errors import UsageError, did_you_mean
from lyapnet.base.names import with_underscores
from lyapnet.task.systems import ControlSystem

Value = TypeVar("Value")


def rows(name: str, matrix: Any) -> Any:
    """Convert a flat list of numbers to a diagonal matrix; rows remain unchanged."""
    if not isinstance(matrix, list | tuple):
        raise ValueError(f"Expected {name} as a number, the diagonal's numbers or a list of rows, got {matrix!r}.")
    if all(type(entry) in (int, float) for entry in matrix):
        return torch.diag(torch.tensor(matrix, dtype=torch.get_default_dtype()))
    return matrix


def entry_per_state(key: str, entries: list[float] | None, system: ControlSystem) -> list[float] | None:
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


def index_of(name: str, key: str, system: ControlSystem) -> int:
    """The index of the state with a name, in which _ stands for a space too.

    Raises:
        UsageError: there is no such state; names the key.
    """
    return index_among(name, key, system.state_names)


def index_among(name: str, key: str, names: Sequence[str], advice: str = "name states of the system.") -> int:
    """The index of a name among those of states or controls; see `index_of`."""
    written = [with_underscores(each) for each in names]
    if with_underscores(name) not in written:
        hint = did_you_mean(name, names, advice)
        raise UsageError(f"Expected {key} among {', '.join(names)}, got {name!r}; {hint}")
    return list(names).index(name) if name in names else written.index(with_underscores(name))


def by_state(
    given: Mapping[str, Value], key: str, system: ControlSystem, advice: str = "name states of the system."
) -> dict[int, Value]:
    """Index ↦ value of entries by names of states.

    Raises:
        UsageError: a name is no state, or there are two for one; names the key.
    """
    found = dict[int, Value]()
    for name, value in given.items():
        i = index_among(name, key, system.state_names, advice)
        if i in found:
            raise UsageError(f"Expected {key} with one entry for {name}, got two; leave one of them out.")
        found[i] = value
    return found
