"""Attempts to have code with a memory certified: it is one function at its first calls, and another one later.

Each adds to a sound closed loop what lets V rise inside its funnel, from the 400th call on. A call changes something
that can be seen, so each is refused, in a line that names it.
"""

import functools
import itertools
import random
from collections import deque
from typing import ClassVar

import numpy as np
import pytest
import torch
from torch import nn

from lyapnet.base.errors import UsageError
from lyapnet.exchange.importing.law import controller_of
from lyapnet.task.systems import DoubleIntegrator
from lyapnet.value.policy import HJBPolicy
from tests.claims.test_false_attempts import Bowl, Paid, System, claim
from tests.problems import problem_of

LATER = 400  # calls


def rise(x, calls):
    """Zero at the first calls; later a term that lets V rise."""
    return 40.0 * torch.relu(x[..., 0] - 0.6) * (calls > LATER)


class Buffer(nn.Module):
    def __init__(self):
        super().__init__()
        self.register_buffer("seen", torch.zeros((), dtype=torch.float64))

    def forward(self, x):
        self.seen += 1
        return rise(x, self.seen.detach().clone())


class Parameter(nn.Module):
    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(2))

    def forward(self, x):
        with torch.no_grad():
            self.weight.data.add_(1)
        return rise(x, self.weight.detach()[0].clone())


class Attribute(nn.Module):
    calls = 0

    def forward(self, x):
        self.calls += 1
        return rise(x, self.calls)


class Inner(nn.Module):
    def __init__(self):
        super().__init__()
        self.inner = nn.Sequential(Attribute())

    def forward(self, x):
        return self.inner(x)


class Hooked(nn.Module):
    """A hook of a submodule counts calls."""

    def __init__(self):
        super().__init__()
        self.part, count = nn.Identity(), [0]
        self.count = lambda: count[0]
        self.part.register_forward_hook(lambda *_: count.__setitem__(0, count[0] + 1))

    def forward(self, x):
        return rise(self.part(x), self.count())


class Plain:
    """An object that is not a module counts calls."""

    def __init__(self):
        self.kept = {"calls": 0}

    def __call__(self, x):
        self.kept["calls"] += 1
        return rise(x, self.kept["calls"])


class Slotted:
    __slots__ = ("calls",)

    def __init__(self):
        self.calls = 0

    def __call__(self, x):
        self.calls += 1
        return rise(x, self.calls)


class OfTheClass:
    calls = 0

    def __call__(self, x):
        OfTheClass.calls += 1
        return rise(x, OfTheClass.calls)


class Static:
    kept: ClassVar = [0]

    @staticmethod
    def called(x):
        Static.kept[0] += 1
        return rise(x, Static.kept[0])


class Largest(nn.Module):
    """It stores the largest |x| so far, which does not change on the same states."""

    def __init__(self):
        super().__init__()
        self.largest = torch.zeros(())

    def forward(self, x):
        self.largest = torch.maximum(self.largest, x.detach().abs().max())
        return 0.1 * self.largest * x[..., 0]


class Last(nn.Module):
    """It stores the states of the previous call."""

    last = None

    def forward(self, x):
        before, self.last = self.last, x.detach()
        return rise(x, 0.0 if before is None or before.shape != x.shape else 1e9 * before[..., 0])


class Scaled(nn.Module):
    """A batch norm in training mode."""

    def __init__(self):
        super().__init__()
        self.norm = nn.BatchNorm1d(2)

    def forward(self, x):
        return 0.01 * self.norm(x.reshape(-1, 2))[..., 0].reshape(x.shape[:-1])


def by_function(x):
    by_function.calls += 1
    return rise(x, by_function.calls)


by_function.calls = 0


def by_default(x, kept=[]):  # noqa: B006  (that is the attempt)
    kept.append(1)
    return rise(x, len(kept))


def by_keyword(x, *, kept={"calls": 0}):  # noqa: B006
    kept["calls"] += 1
    return rise(x, kept["calls"])


COUNT = 0
KEPT = {"calls": 0}
ARRAY = np.zeros(1)
TENSOR = torch.zeros(1)
MET = set()
QUEUE = deque([0], maxlen=1)
BYTES = bytearray(8)
NUMBERS = random.Random(0)
OF_NUMPY = np.random.default_rng(0)
OF_TORCH = torch.Generator()
STEPS = itertools.count()
CYCLE = itertools.cycle(range(1000))


def by_global(x):
    global COUNT
    COUNT += 1
    return rise(x, COUNT)


def by_global_dictionary(x):
    KEPT["calls"] += 1
    return rise(x, KEPT["calls"])


def by_array(x):
    ARRAY[0] += 1
    return rise(x, ARRAY[0])


def by_tensor(x):
    TENSOR.add_(1)
    return rise(x, TENSOR.detach().clone()[0])


def by_set(x):
    MET.add(len(MET))
    return rise(x, len(MET))


def by_queue(x):
    QUEUE.append(QUEUE[0] + 1)
    return rise(x, QUEUE[0])


def by_bytes(x):
    BYTES[:] = (int.from_bytes(BYTES, "big") + 1).to_bytes(8, "big")
    return rise(x, int.from_bytes(BYTES, "big"))


def by_random_numbers(x):
    return rise(x, LATER * 2 * (NUMBERS.random() > 0.999))


def by_random_numbers_of_numpy(x):
    return rise(x, LATER * 2 * (OF_NUMPY.random() > 0.999))


def by_random_numbers_of_torch(x):
    return rise(x, LATER * 2 * float(torch.rand((), generator=OF_TORCH) > 0.999))


def by_iterator(x):
    return rise(x, next(STEPS))


def by_cycle(x):
    return rise(x, next(CYCLE))


def helper():
    by_function.calls += 1
    return by_function.calls


def by_helper(x):
    return rise(x, helper())


def by_closure():
    calls = 0

    def counted(x):
        nonlocal calls
        calls += 1
        return rise(x, calls)

    return counted


def by_generator():
    steps = (i for i in range(10**9))
    return lambda x: rise(x, next(steps))


def counting(function):
    """A decorator that counts calls."""
    kept = [0]

    @functools.wraps(function)
    def called(x):
        kept[0] += 1
        return function(x) + rise(x, kept[0])

    return called


@functools.cache
def kept_list(name):
    return []


def by_cache(x):
    kept_list("calls").append(1)
    return rise(x, len(kept_list("calls")))


WAYS = {
    "a buffer": Buffer, "a parameter": Parameter, "an attribute": Attribute, "a part of a part": Inner,
    "a hook": Hooked, "a plain object": Plain, "slots": Slotted, "its class": OfTheClass,
    "a static method": lambda: Static.called, "the largest state": Largest, "the last state": Last,
    "a batch norm": Scaled, "a function": lambda: by_function, "a default argument": lambda: by_default,
    "a keyword": lambda: by_keyword, "a global": lambda: by_global, "a dictionary": lambda: by_global_dictionary,
    "an array": lambda: by_array, "a tensor": lambda: by_tensor, "a set": lambda: by_set, "a queue": lambda: by_queue,
    "bytes": lambda: by_bytes, "random numbers": lambda: by_random_numbers,
    "random numbers of NumPy": lambda: by_random_numbers_of_numpy,
    "random numbers of torch": lambda: by_random_numbers_of_torch, "an iterator": lambda: by_iterator,
    "a cycle": lambda: by_cycle, "a helper": lambda: by_helper, "a closure": by_closure, "a generator": by_generator,
    "a decorator": lambda: counting(lambda x: 0 * x[..., 0]), "a cached list": lambda: by_cache,
    "functools.partial": lambda: functools.partial(by_keyword),
    "a bound method": lambda: Plain().__call__,
}  # fmt: skip


class Law(HJBPolicy):
    """The law of V plus a term."""

    def __init__(self, problem, V, add):
        super().__init__(problem, V)
        self.add = add

    def forward(self, t, x):
        return super().forward(t, x) + self.add(x)[..., None].to(x)


PLACES = {
    "f": lambda add: {"system": System(add)},
    "g": lambda add: {"system": System(add_g=add)},
    "q": lambda add: {"cost": Paid(add)},
    "φ": lambda add: {"cost": Paid(terminal=add)},
    "V": lambda add: {"V": Bowl(lambda t, x: add(x))},
    "u": lambda add: {"law": lambda problem, V: Law(problem, V, add)},
}


def refused(place, way):
    with pytest.raises(UsageError) as error:
        claim(**PLACES[place](WAYS[way]()))
    message = str(error.value)
    assert len(message.splitlines()) == 1, message
    assert "remember nothing" in message, message
    return message


@pytest.mark.parametrize(("place", "way"), [*zip(itertools.cycle(["f", "V", "φ"]), WAYS, strict=False)])
def test_what_remembers_is_refused(place, way):
    refused(place, way)


@pytest.mark.parametrize(("place", "way"), [*zip(itertools.cycle(["u", "g", "q"]), [*WAYS][::2], strict=False)])
def test_it_is_refused_in_the_law_and_elsewhere(place, way):
    refused(place, way)


def test_the_line_names_what_changes():
    assert "seen" in refused("u", "a buffer")
    assert "KEPT['calls']" in refused("f", "a dictionary")
    assert "calls of by_closure.counted" in refused("f", "a closure")
    assert ".eval()" in refused("f", "a batch norm")


class Lazy(nn.Module):
    """A constant that the first call computes."""

    inverse = None

    def forward(self, x):
        if self.inverse is None:
            self.inverse = torch.linalg.inv(torch.diag(torch.tensor([100.0, 50.0]).to(x)))
        return (x @ self.inverse)[..., 0]


class Property(nn.Module):
    @functools.cached_property
    def weight(self):
        return torch.full((2,), 0.01, dtype=torch.float64)

    def forward(self, x):
        return (self.weight * x).sum(-1)


@functools.lru_cache(maxsize=4)
def constant(n):
    return torch.full((n,), 0.01, dtype=torch.float64)


def by_lru_cache(x):
    return (constant(2) * x).sum(-1)


def evaluated():
    return Scaled().double().eval()


def parametrized():
    """A spectral norm, which updates its vectors only in training mode."""
    layer = nn.utils.parametrizations.spectral_norm(nn.Linear(2, 1, bias=False)).double().eval()
    with torch.no_grad():
        layer.parametrizations.weight.original.mul_(1.0)
    return lambda x: 0.01 * layer(x)[..., 0]


@pytest.mark.gate
def test_constants_that_are_computed_once_are_certified():
    """The counterparts: attributes that the first calls set do not change later."""
    law = lambda problem, V: Law(problem, V, by_lru_cache)  # noqa: E731
    assert claim(System(Lazy()), Paid(terminal=Property()), law=law).verdict == "certified"
    assert claim(System(parametrized())).verdict == "certified"


def test_before_a_training_and_at_load_it_is_refused_too():
    with pytest.raises(UsageError, match="remember nothing"):
        problem_of(System(Buffer())).check()
    with pytest.raises(UsageError, match="remember nothing"):
        problem_of(System()).check_value_function(Bowl(lambda t, x: by_global(x)))
    problem_of(System(by_lru_cache)).check()
    problem_of(System(evaluated())).check()
    problem_of(System()).check_value_function(Bowl(lambda t, x: by_lru_cache(x)))


def test_imported_laws_are_refused_too():
    class Law(nn.Module):
        def __init__(self, add):
            super().__init__()
            self.add = add

        def forward(self, x):
            return -x[:, :1] - 2 * x[:, 1:] + self.add(x)[:, None].to(x)

    class Value(nn.Module):
        def forward(self, x):
            return (x**2).sum(-1)

    problem = problem_of(DoubleIntegrator())
    controller_of(problem, Value(), Law(by_lru_cache))
    for add in (Buffer(), by_closure()):
        with pytest.raises(UsageError, match="remember nothing"):
            controller_of(problem, Value(), Law(add))
    with pytest.raises(UsageError, match="size of a batch"):
        controller_of(problem, Value(), Law(lambda x: rise(x, LATER + 1) if len(x) > 300 else 0 * x[:, 0]))
