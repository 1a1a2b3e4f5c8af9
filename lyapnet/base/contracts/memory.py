"""What code of others remembers: all that can be reached from an object, as it is before calls and after them.

Buffers, attributes, containers, closures, default arguments, and the globals that its code names are followed, and
tensors compared by value. What lies elsewhere, in C, in files, in the time or the environment, is not seen.
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

MOST = 200_000  # objects that are looked at
PLAIN = (
    bool, int, float, complex, str, bytes, bytearray, range, slice, Enum, type(None), type(...), torch.dtype,
    torch.device, torch.Size, np.generic, np.dtype,
)  # fmt: skip
CONTAINERS = (Mapping, list, tuple, set, frozenset, deque)
CACHED = " in the cache of "  # in the name of what a functools.cache holds: it may come and go


def check_memory(parts: Mapping[str, Any], first: Callable[[], Any], second: Callable[[], Any]) -> "Memory":
    """Refuse objects that calls change, but for what the first ones fill in and later ones leave as it is.

    Args:
        parts: what messages call them ↦ the objects.
        first, second: calls of all that they do, on different states.

    Returns:
        What they hold, to be held against it again later.

    Raises:
        UsageError: a call changes one; names the attribute.
    """
    first()
    first()
    memory = Memory(parts)
    first()
    second()
    memory.check()
    return memory


class Memory:
    """All that is reachable from some objects, as it is now.

    Args:
        parts: what messages call them ↦ the objects.
    """

    def __init__(self, parts: Mapping[str, Any]):
        self.parts, self.before = dict(parts), state_of(parts)

    def check(self) -> None:
        """Refuse objects that have changed since.

        Raises:
            UsageError: one has; names the attribute.
        """
        if changed := differences(self.before, state_of(self.parts)):
            raise UsageError(
                f"Expected f, g, the cost, U, V and u to be functions that remember nothing, got {changed[0]}, which "
                "changes each time that they are called; fill constants in __init__, keep counters and logs outside, "
                "and call .eval() where there is a BatchNorm or a dropout."
            )


def differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """The names under which two states differ, the plainest first; what a cache holds may come and go."""
    both = [name for name in one if name in other and one[name] != other[name]]
    found = both + [name for name in one.keys() ^ other.keys() if CACHED not in name]
    return sorted(found, key=lambda name: (name not in one, len(name), name))


def state_of(parts: Mapping[str, Any]) -> dict[str, Any]:
    """Name ↦ value of every plain thing that is reachable; of tensors and arrays, a digest."""
    found: dict[str, Any] = {"the state of torch's random numbers": _digest(torch.get_rng_state().numpy())}
    for name, value in _reachable(parts):
        if isinstance(value, PLAIN):
            found[name] = value if isinstance(value, str | bytes) else (type(value).__name__, repr(value))
        elif isinstance(value, Tensor):
            found[name] = _of_tensor(value)
        elif isinstance(value, np.ndarray) and value.dtype != object:
            found[name] = value.shape, str(value.dtype), _digest(value)
    return found


def reaches_own_code(thing: Any) -> bool:
    """Whether an object, or anything that it holds, is a function or an object of a class of the user's own."""
    kinds = types.FunctionType, type
    return any(isinstance(each, kinds) and _is_own(each) for _, each in _reachable({"": thing}))


def _reachable(parts: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """What is reachable from some objects, with its name; each object once."""
    seen, waiting = dict[int, Any](), [*parts.items()]
    while waiting and len(seen) < MOST:
        name, value = waiting.pop()
        if isinstance(value, (*PLAIN, Tensor)) or (isinstance(value, np.ndarray) and value.dtype != object):
            yield name, value
        elif id(value) not in seen:
            seen[id(value)] = value  # held, so that no other object takes its id
            yield name, value
            waiting += _parts_of(name, value)


def _digest(array: np.ndarray) -> bytes:
    return hashlib.blake2b(np.ascontiguousarray(array).tobytes()).digest()


def _of_tensor(value: Tensor) -> Any:
    kind = type(value).__name__ if type(value) not in (Tensor, nn.Parameter, nn.Buffer) else ""
    facts = kind, tuple(value.shape), str(value.dtype), str(value.device)
    try:
        with torch.no_grad():
            flat = torch.Tensor.detach(value).cpu().reshape(-1).contiguous()
            return *facts, _digest(flat.view(torch.uint8).numpy() if flat.numel() else np.zeros(0))
    except Exception:  # one without values, or of a kind that NumPy has not
        return facts


def _parts_of(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """What an object holds, by name."""
    if isinstance(value, types.ModuleType):
        return
    if isinstance(value, type):
        if _is_own(value):
            for key, each in vars(value).items():
                yield from [(f"{value.__qualname__}.{key}", each)] * (key not in OF_CLASSES)
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
        yield from ((f"what is{CACHED}{name}: {key}", each) for key, each in _cached(value))
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


OF_CLASSES = ("__dict__", "__weakref__", "__doc__", "__module__", "__abstractmethods__", "_abc_impl", "__annotations__")


def _parts_of_object(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """The attributes of an object, and of its class where that is the user's own; else what it would be pickled as."""
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
        except Exception:  # what has no such form is not seen
            return


def _as_tuple(slots: Any) -> tuple[str, ...]:
    return (slots,) if isinstance(slots, str) else tuple(slots)


def _parts_of_function(function: types.FunctionType) -> Iterator[tuple[str, Any]]:
    """The attributes, default arguments, closure and globals of a function; what one of a library wraps."""
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
    """The names of globals and attributes in a function, and in those that are written in it."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _names_in(constant)


def _cached(wrapper: Any) -> Iterator[tuple[str, Any]]:
    """(key, result) of what a functools.cache holds; what a bounded one holds is not seen."""
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
    return known or ("" if module.__name__ == "__main__" else "<frozen")  # one without a file is built in
