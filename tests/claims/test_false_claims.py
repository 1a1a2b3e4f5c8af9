"""Code that once made something false certified: it reads values past torch, or the other states of a batch.

Each adds to a function of a sound closed loop a term that is zero at most states, and counts near a corner.
"""

import itertools

import numpy as np
import pytest
import torch

from lyapnet.base.errors import UsageError
from lyapnet.claims.funnel import prove_funnel
from lyapnet.loop.rollout import ClosedLoop
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.task.cost import Cost
from lyapnet.task.sets import Box
from lyapnet.task.systems import ControlAffineSystem, Linear
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.policy import HJBPolicy
from tests.marks import sample
from tests.problems import AMPLE, problem_of

TABLE = torch.tensor([0.0, 0.0, 0.0, 40.0])
CORNER = 0.9


def first(x):
    return x.detach()[..., 0]


def counted(x):
    counted.calls += 1
    return (counted.calls % 7 == 0) * torch.ones_like(x[..., 0])


counted.calls = 0

WAYS = {  # x (*batch, n) ↦ (*batch,), zero at most states of the domain
    "interp": lambda x: torch.as_tensor(np.interp(first(x).numpy(), [CORNER, 1.0], [0.0, 40.0])),
    "data": lambda x: torch.as_tensor(40.0 * (x.data[..., 0].numpy() > CORNER)),
    "asarray": lambda x: torch.as_tensor(40.0 * (np.asarray(first(x)) > CORNER)),
    "tolist": lambda x: torch.tensor(40.0 * (np.array(first(x).tolist()) > CORNER)),
    "dlpack": lambda x: torch.as_tensor(40.0 * (np.from_dlpack(first(x)) > CORNER)),
    "branch in NumPy": lambda x: x[..., 0] * (40.0 if (first(x).numpy() > CORNER).any() else 0.0),
    "branch": lambda x: x[..., 0] * (40.0 if (x > CORNER).any() else 0.0),
    "float": lambda x: x[..., 0] * (float(first(x).max()) > CORNER) * 40.0,
    "item": lambda x: x[..., 0] * 40.0 * max(first(x).max().item() - CORNER, 0.0),
    "index": lambda x: x[..., 0] * TABLE[(4 * first(x).max().clamp(0, 0.9)).long()],
    "mask": lambda x: x[..., 0] * x[x > CORNER].sum(),
    "dimension": lambda x: x[..., 0] * (40.0 if x.ndim > 1 else 0.0),
    "size": lambda x: x[..., 0] * (40.0 if x.numel() > 2 else 0.0),
    "batch": lambda x: 40.0 * (x[..., 0] - x[..., 0].mean()) if x.ndim > 1 else 0 * x[..., 0],
    "random": lambda x: 40.0 * torch.rand_like(x[..., 0]),
    "counter": counted,
}


class System(Linear):
    def __init__(self, f=None, g=None):
        super().__init__([[-1.0, 0.3], [0.0, -1.0]], [[0.0], [1.0]])
        self.add_f, self.add_g = f, g

    dynamics = ControlAffineSystem.dynamics

    def f(self, x):
        return super().f(x) if self.add_f is None else super().f(x) + self.add_f(x).to(x)[..., None]

    def g(self, x):
        return super().g(x) if self.add_g is None else super().g(x) + self.add_g(x).to(x)[..., None, None]


class Paid(Cost):
    def __init__(self, q=None, terminal=None):
        super().__init__()
        self.add_q, self.add_terminal = q, terminal

    def state(self, x):
        q = (x**2).sum(-1)
        return q if self.add_q is None else q + self.add_q(x).to(x).abs()

    def R(self, x):
        return torch.eye(1).to(x).expand(*x.shape[:-1], 1, 1)

    def terminal(self, x):
        phi = (x**2).sum(-1)
        return phi if self.add_terminal is None else phi + self.add_terminal(x).to(x).abs()


class Bowl(ValueFunction):
    def __init__(self, V=None):
        super().__init__()
        self.add = V

    def forward(self, t, x):
        value = 2.0 * (x**2).sum(-1) + 0 * t
        return value if self.add is None else value + self.add(x).to(x)


PLACES = {
    "f": lambda way: (System(f=way), Paid(), Bowl()),
    "g": lambda way: (System(g=way), Paid(), Bowl()),
    "q": lambda way: (System(), Paid(q=way), Bowl()),
    "φ": lambda way: (System(), Paid(terminal=way), Bowl()),
    "V": lambda way: (System(), Paid(), Bowl(way)),
}


def claim(system, cost, V):
    problem = problem_of(system, cost, steps=20, initial_states=Box([-0.5, -0.5], [0.5, 0.5]))
    closed_loop = ClosedLoop(problem, HJBPolicy(problem, V)).double()
    domain = Box(torch.tensor([-1.0, -1.0]).double(), torch.tensor([1.0, 1.0]).double())
    return prove_funnel(closed_loop, problem, 0.5, 0.02, domain, Budget(AMPLE, boxes=5000))


@pytest.mark.gate
def test_what_nothing_is_added_to_is_certified():
    """The counterpart of all tests below, with the terms written in torch."""
    assert claim(System(), Paid(), Bowl()).verdict == "certified"
    rising = PLACES["q"](lambda x: 0.01 * torch.relu(x[..., 0] - CORNER))
    assert claim(*rising).verdict == "certified"


def refused(place, way):
    with pytest.raises(UsageError) as error:
        claim(*PLACES[place](WAYS[way]))
    message = str(error.value)
    assert len(message.splitlines()) == 1, message
    assert "pytorch" not in message, message
    return message


EACH = list(zip(itertools.cycle(PLACES), WAYS, strict=False))


@pytest.mark.parametrize(("place", "way"), sample(EACH, 4))
def test_what_reads_more_than_its_state_is_refused(place, way):
    message = refused(place, way)
    assert any(reason in message for reason in ("reads", "each state", "random numbers", "each time")), message


@pytest.mark.parametrize(("place", "way"), sample(sorted({*itertools.product(PLACES, WAYS)} - {*EACH}), 9))
def test_it_is_refused_wherever_else_it_stands(place, way):
    refused(place, way)


STEPS = {
    "data",
    "asarray",
    "tolist",
    "dlpack",
    "counter",
}  # constant nearly everywhere, so that no change of a state shows it


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("way", sample((way for way in WAYS if way not in STEPS), 4))
def test_before_a_training_most_of_it_is_refused_too(place, way):
    """The check uses states of X₀; a certificate does not rely on it."""
    with pytest.raises(UsageError):
        check(*PLACES[place](WAYS[way]))


def check(system, cost, V):
    problem = problem_of(system, cost, steps=20)
    problem.check()
    problem.check_value_function(V)


def test_dynamics_that_are_not_those_of_f_and_g_are_refused():
    class Other(Linear):
        def f(self, x):
            return super().f(x) + 1e-3

    matrices = [[-1.0, 0.3], [0.0, -1.0]], [[0.0], [1.0]]
    problem_of(Linear(*matrices)).check()
    with pytest.raises(UsageError, match=r"Expected Other\.dynamics\(x, u\) = f\(x\) \+ g\(x\)u"):
        problem_of(Other(*matrices)).check()


class Square(torch.autograd.Function):
    """x² with a wrong derivative."""

    @staticmethod
    def forward(ctx, x):
        ctx.save_for_backward(x)
        return x**2

    @staticmethod
    def backward(ctx, grad):
        return 1.5 * ctx.saved_tensors[0] * grad


class Custom(Bowl):
    def forward(self, t, x):
        return 2.0 * Square.apply(x).sum(-1) + 0 * t


class Hooked(Bowl):
    def forward(self, t, x):
        y = x * 1.0
        if y.requires_grad:
            y.register_hook(lambda grad: 0.5 * grad)
        return 2.0 * (y**2).sum(-1) + 0 * t


class HalfDetached(Bowl):
    def forward(self, t, x):
        return super().forward(t, x) + 0.5 * (x.detach() ** 2).sum(-1)


class OfTime(Bowl):
    def forward(self, t, x):
        return super().forward(t, x) + 0.5 * t.detach() * (x**2).sum(-1)


class Declared(Bowl):
    def value_and_state_gradient(self, t, x):
        return self(t, x), 6.0 * x


@pytest.mark.parametrize(
    "V", sample([Custom(), Hooked(), HalfDetached(), OfTime(), Declared()], 3), ids=lambda V: type(V).__name__
)
def test_a_derivative_that_is_not_that_of_V_is_refused(V):
    with pytest.raises(UsageError):
        claim(System(), Paid(), V)
    with pytest.raises(UsageError):
        problem_of(System(), Paid()).check_value_function(V)
