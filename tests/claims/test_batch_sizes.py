"""Attempts to have code certified that asks how many states are in a batch: below the tried numbers it is sound.

Each adds to a function of a sound closed loop what lets V rise in batches of more than 300 states, or of one, and would
be refused nowhere by trying batches of up to 64.
"""

import itertools

import pytest
import torch
from torch import nn

from lyapnet.base.contracts.batch_sizes import check_batch_sizes
from lyapnet.base.errors import UsageError
from lyapnet.value.policy import HJBPolicy
from tests.claims.test_false_attempts import Bowl, Paid, System, claim
from tests.claims.test_memory import Law
from tests.marks import sample
from tests.problems import problem_of

MANY = 300


def rise(x):
    return 40.0 * torch.relu(x[..., 0] - 0.6)


def never(x):
    return 0.0 * x[..., 0]


WAYS = {
    "len": lambda x: rise(x) if len(x) > MANY else never(x),
    "shape": lambda x: rise(x) if x.shape[0] > MANY else never(x),
    "size": lambda x: rise(x) if x.size(0) > MANY else never(x),
    "all of size": lambda x: rise(x) if max(x.size()) > MANY else never(x),
    "numel": lambda x: rise(x) if x.numel() > 2 * MANY else never(x),
    "number of axes": lambda x: rise(x) if x.ndim > 3 else never(x),
    "dim": lambda x: rise(x) if x.dim() > 3 else never(x),
    "broadcast_shapes": lambda x: rise(x) if torch.broadcast_shapes(x.shape[:-1], (1,))[0] > MANY else never(x),
    "stride": lambda x: rise(x) if x.mT.contiguous().stride(0) > MANY else never(x),
    "enumerate": lambda x: rise(x) if sum(1 for _ in enumerate(x)) > MANY else never(x),
    "iteration": lambda x: rise(x) if sum(1 for _ in x) > MANY else never(x),
    "unbind": lambda x: rise(x) if len(x.unbind(0)) > MANY else never(x),
    "split": lambda x: rise(x) if len(x.split(MANY)) > 1 else never(x),
    "int of a size": lambda x: rise(x) * max(int(x.shape[0]) - MANY, 0),
    "text": lambda x: rise(x) * (int(str(x.shape[0])) > MANY),
    "a batch of one": lambda x: rise(x) if x.shape[0] == 1 else never(x),
    "an index of a list": lambda x: rise(x) * [0, 1][x.shape[0] > MANY],
    "range": lambda x: rise(x) * len(range(0, x.shape[0], MANY)),
    "sym_max": lambda x: rise(x) * torch.sym_max(x.shape[0] - MANY, 0),
    "a quotient": lambda x: rise(x) * (x.shape[0] // (MANY + 1)),
    "arange": lambda x: rise(x) * torch.relu(torch.arange(x.shape[0]) - MANY),
    "arange of len": lambda x: rise(x) * torch.relu(torch.arange(len(x)) - MANY),
    "a sum of ones": lambda x: rise(x) * torch.relu(torch.ones_like(x[..., 0]).sum() - MANY),
    "a cumulative sum": lambda x: rise(x) * torch.relu(torch.ones_like(x[..., 0]).cumsum(0) - MANY),
    "full": lambda x: rise(x) * torch.relu(torch.full(x.shape[:1], x.shape[0]) - MANY),
    "linspace": lambda x: rise(x) * torch.linspace(0, 1, x.shape[0]).to(x),
    "eye": lambda x: rise(x) + torch.relu(torch.eye(x.shape[0]).sum() - MANY),
    "mean over the batch": lambda x: rise(x - x.mean(0)),
    "the first state": lambda x: rise(x) * (torch.relu(x[0, 0] - 0.9)),
    "a product of the batch": lambda x: torch.relu((0 * x @ x.mT + 1).sum(-1) - MANY),
    "norm of the batch": lambda x: rise(x) * torch.relu(torch.ones_like(x).norm() - MANY),
    "roll": lambda x: rise(x.roll(MANY, 0)) - rise(x),
    "flip": lambda x: rise(x.flip(0)) - rise(x),
    "einsum": lambda x: rise(x) * torch.relu(torch.einsum("bi->", torch.ones_like(x)) - 2 * MANY),
    "sort": lambda x: rise(x.sort(0).values),
    "softmax": lambda x: rise(x) * x.softmax(0)[..., 0],
    "a slice": lambda x: torch.cat([0 * x[:MANY, 0], rise(x[MANY:])]),
}

PLACES = {
    "f": lambda add: {"system": System(add)},
    "g": lambda add: {"system": System(add_g=add)},
    "q": lambda add: {"cost": Paid(add)},
    "V": lambda add: {"V": Bowl(lambda t, x: add(x))},
    "u": lambda add: {"law": lambda problem, V: Law(problem, V, add)},
    "R": lambda add: {"cost": Paid(R=add)},
    "φ": lambda add: {"cost": Paid(terminal=add)},
}


def refused(way, function):
    """The error message: one line that names the line of the code."""
    with pytest.raises(UsageError) as error:
        function()
    message = str(error.value)
    assert len(message.splitlines()) == 1, message
    assert "to be a function of each state by itself" in message, message
    assert f'test_batch_sizes.py:{WAYS[way].__code__.co_firstlineno} ("{way}"' in message, message


def guarded(add):
    """What is asked for batches alone: one state has no size to ask for."""
    return lambda x: add(x) if x.shape[:-1] else never(x)


@pytest.mark.parametrize("way", WAYS)
def test_what_asks_for_the_size_of_a_batch_is_refused_at_its_line(way):
    """It is refused before it is called on any state."""
    x = torch.zeros(4, 2)
    refused(way, lambda: check_batch_sizes("f(x)", lambda x: (guarded(WAYS[way])(x),), [x]))


TEN = ("len", "shape", "size", "numel", "number of axes", "broadcast_shapes", "stride", "enumerate", "unbind", "split")


def functions_of(place, add):
    """The changed function of the closed loop, and its arguments."""
    parts = PLACES[place](add)
    x, t = torch.zeros(4, 2), torch.zeros(4)
    if place == "u":
        problem = problem_of(System(), Paid())
        return parts["law"](problem, Bowl()), [t, x]
    part = next(iter(parts.values()))
    return (part, [t, x]) if place == "V" else (getattr(part, {"q": "state"}.get(place, place)), [x])


@pytest.mark.parametrize(("place", "way"), sample([*itertools.product(["f", "g", "q", "V", "u"], TEN)], 5))
def test_it_is_refused_wherever_it_stands(place, way):
    function, given = functions_of(place, guarded(WAYS[way]))
    refused(way, lambda: check_batch_sizes(place, lambda *batches: (function(*batches),), given))


@pytest.mark.parametrize(("place", "way"), [*zip(PLACES, TEN, strict=False)])
def test_certificates_look_at_all_of_these(place, way):
    refused(way, lambda: claim(**PLACES[place](guarded(WAYS[way]))))


def test_before_a_training_too():
    refused("len", lambda: problem_of(System(guarded(WAYS["len"]))).check())
    bowl = Bowl(lambda t, x: guarded(WAYS["shape"])(x))
    refused("shape", lambda: problem_of(System()).check_value_function(bowl))


SMALL = 0.01
MATRIX = torch.tensor([[0.01, 0.0], [0.0, 0.01]], dtype=torch.float64)


def written(x):
    y = torch.zeros_like(x)
    y[..., 0] = SMALL * x[..., 1]
    return y.sum(-1)


HONEST = {
    "expand": lambda x: (MATRIX[0].expand(*x.shape[:-1], 2) * x).sum(-1),
    "zeros": lambda x: torch.zeros(x.shape[:-1]).to(x) + SMALL * x[..., 0],
    "new_zeros": lambda x: x.new_zeros(*x.shape[:-1], 2)[..., 0] + SMALL * x[..., 0],
    "new_tensor": lambda x: (x.new_tensor([SMALL, 0.0]) * x).sum(-1),
    "reshape": lambda x: (x.reshape(-1, 2) @ MATRIX).reshape(x.shape)[..., 0],
    "flatten": lambda x: SMALL * x.reshape(-1).reshape(x.shape)[..., 1],
    "einsum": lambda x: torch.einsum("ij,...j->...i", MATRIX, x)[..., 0],
    "vmap": lambda x: torch.func.vmap(lambda y: SMALL * y[0])(x.reshape(-1, 2)).reshape(x.shape[:-1]),
    "stack": lambda x: torch.stack([x, 2 * x])[1, ..., 0] * SMALL,
    "cat": lambda x: torch.cat([x, x[..., :1]], -1).sum(-1) * SMALL,
    "write": written,
    "linear": lambda x: nn.functional.linear(x, MATRIX)[..., 0],
    "where": lambda x: torch.where(x[..., 0] > 0, SMALL, -SMALL) * x[..., 0],
    "amax": lambda x: SMALL * torch.maximum(x[..., 0], x[..., 1]),
    "softmax": lambda x: SMALL * x.softmax(-1)[..., 0],
    "sort": lambda x: SMALL * x.sort(-1).values[..., 0],
    "cumulative sum": lambda x: SMALL * x.cumsum(-1)[..., 1],
    "solve": lambda x: torch.linalg.solve(torch.eye(2).to(x).expand(*x.shape, 2), x[..., None])[..., 0, 0],
    "cholesky": lambda x: torch.linalg.cholesky(torch.eye(2).to(x) + x[..., None] * x[..., None, :])[..., 0, 0],
    "a table": lambda x: MATRIX[0][(x[..., 0] > 0).long()],
    "gradient": lambda x: torch.func.vmap(torch.func.grad(lambda y: (y**3).sum()))(x.reshape(-1, 2)).reshape(x.shape),
    "layer norm": lambda x: nn.functional.layer_norm(x, (2,)),
    "a check of the state": lambda x: SMALL * x[..., 0] if x.shape[-1] == 2 else x,
}


@pytest.mark.parametrize("way", HONEST)
def test_shapes_are_used_honestly(way):
    """The twins."""
    assert check_batch_sizes("f(x)", lambda x: (HONEST[way](x),), [torch.zeros(4, 2)]) is None


@pytest.mark.gate
def test_what_comes_with_lyapnet_is_of_each_state_by_itself(system, cost, V):
    """Which a problem takes for granted: it holds the user's own code alone against batches of every size."""
    law = HJBPolicy(problem_of(system, cost), V)

    def everything(t, x):
        return system.f(x), system.g(x), cost.state(x), cost.R(x), cost.terminal(x), V(t, x), law(t, x)

    assert check_batch_sizes("all of it", everything, [torch.zeros(4), torch.randn(4, system.n)]) is None


@pytest.mark.gate
def test_and_certified():
    V = Bowl(lambda t, x: HONEST["zeros"](x) * x[..., 0])
    found = claim(System(HONEST["reshape"]), V=V, law=lambda problem, V: Law(problem, V, HONEST["einsum"]))
    assert found.verdict == "certified"
