"""Detects memory in users' code: compares everything that is reachable from an object before and after calls.

It follows buffers, attributes, containers, closures, default arguments and the globals that code uses, and compares
tensors by value. State in C code, files, the time or the environment is not detected.
"""

import functools
import gc
import hashlib
import random
import sys
import types
from collections import UserList, deque
from collections.abc import Callable, Iterator, Mapping
from enum import Enum
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lyapnet.base.errors import UsageError, is_own_file

MAX_OBJECTS = 200_000  # largest number of visited objects
PLAIN = (
    bool, int, float, complex, str, bytes, bytearray, range, slice, Enum, type(None), type(...), torch.dtype,
    torch.device, torch.Size, np.generic, np.dtype,
)  # fmt: skip
CONTAINERS = (Mapping, list, tuple, set, frozenset, deque)
CACHE_MARK = " in the cache of "  # part of the names of entries of a functools.cache, which may appear and disappear


def check_memory(parts: Mapping[str, Any], first: Callable[[], Any], second: Callable[[], Any]) -> "Memory":
    """Check that calls do not change objects; lazy initialisation in the first calls is allowed.

    Args:
        parts: name in messages ↦ object.
        first, second: functions that call all methods of the objects, on different states.

    Returns:
        The memory of the objects, for later checks.

    Raises:
        UsageError: a call changes an object; names the attribute.
    """
    first()
    first()
    memory = Memory(parts)
    first()
    second()
    memory.check()
    return memory


class Memory:
    """A snapshot of everything that is reachable from some objects.

    Args:
        parts: name in messages ↦ object.
    """

    def __init__(self, parts: Mapping[str, Any]):
        self.parts, self.before = dict(parts), state_of(parts)

    def check(self) -> None:
        """Check that the objects have not changed since the snapshot.

        Raises:
            UsageError: an object has changed; names the attribute.
        """
        if changed := differences(self.before, state_of(self.parts)):
            raise UsageError(
                f"Expected f, g, the cost, U, V and u to be functions that remember nothing, got {changed[0]}, which "
                "changes each time that they are called; fill constants in __init__, keep counters and logs outside, "
                "and call .eval() where there is a BatchNorm or a dropout."
            )


def differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """The names of entries in which two snapshots differ, shortest first; new or lost cache entries do not count."""
    both = [name for name in one if name in other and one[name] != other[name]]
    found = both + [name for name in one.keys() ^ other.keys() if CACHE_MARK not in name]
    return sorted(found, key=lambda name: (name not in one, len(name), name))


def state_of(parts: Mapping[str, Any]) -> dict[str, Any]:
    """Name ↦ value of every reachable plain object, or a digest for tensors and arrays."""
    found: dict[str, Any] = {"the state of torch's random numbers": _digest(torch.get_rng_state().numpy())}
    for name, value in _reachable(parts):
        if isinstance(value, PLAIN):
            found[name] = value if isinstance(value, str | bytes) else (type(value).__name__, repr(value))
        elif isinstance(value, Tensor):
            found[name] = _summarise_tensor(value)
        elif isinstance(value, np.ndarray) and value.dtype != object:
            found[name] = value.shape, str(value.dtype), _digest(value)
    return found


def reaches_own_code(thing: Any) -> bool:
    """Whether a user's function or class is reachable from an object."""
    kinds = types.FunctionType, type
    return any(isinstance(each, kinds) and _is_own(each) for _, each in _reachable({"": thing}))


def _reachable(parts: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """(name, object) for everything reachable from some objects, each object once."""
    seen, waiting = dict[int, Any](), [*parts.items()]
    while waiting and len(seen) < MAX_OBJECTS:
        name, value = waiting.pop()
        if isinstance(value, (*PLAIN, Tensor)) or (isinstance(value, np.ndarray) and value.dtype != object):
            yield name, value
        elif id(value) not in seen:
            seen[id(value)] = value  # kept alive, so that its id is not reused
            yield name, value
            waiting += _parts_of(name, value)


def _digest(array: np.ndarray) -> bytes:
    return hashlib.blake2b(np.ascontiguousarray(array).tobytes()).digest()


def _summarise_tensor(value: Tensor) -> Any:
    kind = type(value).__name__ if type(value) not in (Tensor, nn.Parameter, nn.Buffer) else ""
    facts = kind, tuple(value.shape), str(value.dtype), str(value.device)
    try:
        with torch.no_grad():
            flat = torch.Tensor.detach(value).cpu().reshape(-1).contiguous()
            return *facts, _digest(flat.view(torch.uint8).numpy() if flat.numel() else np.zeros(0))
    except Exception:  # a tensor without values, or of a dtype that NumPy lacks
        return facts


def _parts_of(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """(name, part) for the direct parts of an object."""
    if isinstance(value, types.ModuleType):
        return
    if isinstance(value, type):
        if _is_own(value):
            for key, each in vars(value).items():
                yield from [(f"{value.__qualname__}.{key}", each)] * (key not in SKIPPED_CLASS_ATTRIBUTES)
        return
    if isinstance(value, CONTAINERS):
        yield f"the number of entries of {name}", len(value)
    if isinstance(value, Mapping):
        for i, (key, each) in enumerate(list(value.items())):
            yield f"{name}[{key!r}]" if isinstance(key, str | int) else f"{name}[{i}]", each
    elif isinstance(value, set | frozenset):
        yield name, sorted(map(repr, value))
    elif isinstance(value, list | tuple | deque | UserList):
        yield from ((f"{name}[{i}]", each) for i, each in enumerate(value))
    if isinstance(value, types.FunctionType):
        yield from _parts_of_function(value)
    elif isinstance(value, types.MethodType):
        yield from ((name, value.__self__), (name, value.__func__))
    elif isinstance(value, functools.partial):
        yield from ((name, value.func), (name, value.args), (name, value.keywords))
    elif isinstance(value, staticmethod | classmethod):
        yield name, value.__func__
    elif isinstance(value, property):
        yield from ((name, each) for each in (value.fget, value.fset))
    elif isinstance(value, functools._lru_cache_wrapper):
        yield name, value.__wrapped__
        yield from ((f"what is{CACHE_MARK}{name}: {key}", each) for key, each in _cached(value))
    elif isinstance(value, types.BuiltinMethodType):
        yield name, value.__self__
    elif isinstance(value, types.GeneratorType):
        if value.gi_frame is not None:
            yield name, (value.gi_frame.f_lasti, dict(value.gi_frame.f_locals))
    elif isinstance(value, torch.Generator):
        yield name, value.get_state()
    elif isinstance(value, random.Random):
        yield name, value.getstate()
    else:
        yield from _parts_of_object(name, value)


SKIPPED_CLASS_ATTRIBUTES = (
    "__dict__",
    "__weakref__",
    "__doc__",
    "__module__",
    "__abstractmethods__",
    "_abc_impl",
    "__annotations__",
)


def _parts_of_object(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """The attributes of an object, and its class if that is the user's; for other objects their pickled state."""
    attributes = getattr(value, "__dict__", None)
    slots = [slot for cls in type(value).__mro__ for slot in _as_tuple(vars(cls).get("__slots__", ()))]
    for key, each in list((attributes or {}).items()):
        if isinstance(value, nn.Module) and key in ("_parameters", "_buffers", "_modules"):
            yield from ((f"{name}.{part}", held) for part, held in each.items())
        else:
            yield f"{name}.{key}", each
    yield from ((f"{name}.{slot}", getattr(value, slot)) for slot in slots if hasattr(value, slot))
    yield from ((cls.__qualname__, cls) for cls in type(value).__mro__ if _is_own(cls))
    if attributes is None and not slots and not callable(value) and not isinstance(value, CONTAINERS):
        try:
            yield name, [each for each in value.__reduce_ex__(2) if not callable(each)]
        except Exception:  # an object that cannot be pickled is skipped
            return


def _as_tuple(slots: Any) -> tuple[str, ...]:
    return (slots,) if isinstance(slots, str) else tuple(slots)


def _parts_of_function(function: types.FunctionType) -> Iterator[tuple[str, Any]]:
    """The attributes, defaults, closure and globals of a user's function; for a library's, the functions it wraps."""
    name, cells = function.__qualname__.replace(".<locals>", ""), dict[str, Any]()
    for key, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=False):
        try:
            cells[key] = cell.cell_contents
        except ValueError:  # not assigned yet
            continue
    if not is_own_file(function.__code__.co_filename):
        yield from ((f"{key} of {name}", each) for key, each in cells.items() if callable(each))
        return
    yield from ((f"{key} of {name}", each) for key, each in cells.items())
    yield from ((f"{name}.{key}", each) for key, each in vars(function).items())
    names = function.__code__.co_varnames[: function.__code__.co_argcount]
    defaults = function.__defaults__ or ()
    yield from ((f"{name}({key}=…)", each) for key, each in zip(names[::-1], defaults[::-1], strict=False))
    yield from ((f"{name}({key}=…)", each) for key, each in (function.__kwdefaults__ or {}).items())
    named = set(_names_in(function.__code__))
    for key in named & function.__globals__.keys():
        each = function.__globals__[key]
        if each is random or each is np:
            drawn = random.getstate() if each is random else np.random.get_state()  # noqa: NPY002
            yield f"the state of the random numbers of {key}", drawn
        elif isinstance(each, types.ModuleType):
            if is_own_file(getattr(each, "__file__", None) or "<frozen"):
                yield from ((f"{key}.{inner}", vars(each)[inner]) for inner in named & vars(each).keys())
        elif not isinstance(each, types.FunctionType | type) or _is_own(each):
            yield key, each


def _names_in(code: types.CodeType) -> Iterator[str]:
    """The names of globals and attributes in a function's code, including nested functions."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _names_in(constant)


def _cached(wrapper: Any) -> Iterator[tuple[str, Any]]:
    """(key, result) for the entries of a functools.cache; those of a bounded cache are not visible."""
    for held in gc.get_referents(wrapper):
        if isinstance(held, dict):
            for key, each in held.items():
                yield from [(repr(key)[:200], each)] * (type(each).__name__ != "_lru_list_elem")


def _is_own(thing: Any) -> bool:
    """Whether a class or function is the user's own."""
    if isinstance(thing, types.FunctionType):
        return is_own_file(thing.__code__.co_filename)
    module = sys.modules.get(getattr(thing, "__module__", None) or "")
    return module is not None and module.__name__ != "builtins" and is_own_file(_file_of(module))


def _file_of(module: types.ModuleType) -> str:
    known = getattr(module, "__file__", None)
    return known or ("" if module.__name__ == "__main__" else "<frozen")  # a module without a file is built in
