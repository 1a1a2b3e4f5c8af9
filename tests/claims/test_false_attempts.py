"""Attempts to have something false certified: by code that torch does not see, by torch itself, by classes, by numbers.

Each adds to a sound closed loop what lets V rise near x₁ = 0.7, inside the funnel {2‖x‖² ≤ 1}, or makes its claim false
in another way. Every outcome but a certificate will do, and every refusal is one line; each group has a twin that is
certified. The attempts of 2026 that were certified once are in CAUGHT, and in CLASSES.
"""

import ctypes
import functools
import io
import math
import os
import pickle
import re
import time
import warnings
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from lyapnet.base.errors import LyapnetError
from lyapnet.claims import funnel, preconditions
from lyapnet.claims.funnel import prove_funnel
from lyapnet.loop.rollout import ClosedLoop
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.task.cost import Cost, QuadraticCost
from lyapnet.task.horizon import Horizon
from lyapnet.task.sets import Box, ControlSet
from lyapnet.task.systems import ControlAffineSystem, Linear
from lyapnet.value.calculus import ValueFunction, gradients
from lyapnet.value.policy import HJBPolicy
from tests.marks import sample
from tests.problems import AMPLE, problem_of

AT, HALF = 0.7002, 1e-4  # where, and how wide: no sample need meet it
ALPHA, DELTA = 0.5, 0.02
BRIEF = 20.0  # seconds of an attempt; those of its honest twin are AMPLE
LEVELS = 2.0  # seconds for the levels of an attempt, as those of a V that has none are sought as long as there is time
BOXES = 400  # of an attempt and of its twin, of which none needs more than 63


@pytest.fixture
def without_batch_sizes(monkeypatch):
    """Functions that are the same at each call are not held against batches of every size: that only refuses more."""
    monkeypatch.setattr(preconditions, "check_batch_sizes", lambda *_: None)


def is_there(v):
    return abs(v - AT) < HALF


def spike(x):
    """40 at x₁ = AT, in torch."""
    return 40.0 / HALF * torch.relu(HALF - (x[..., 0] - AT).abs())


def nothing(x):
    return 0 * x[..., 0]


def of_array(x, v):
    """40 where an array of states has x₁ = AT."""
    return torch.as_tensor(40.0 * is_there(np.asarray(v).reshape(x.shape)[..., 0]))


class System(Linear):
    """ẋ = Ax + (0, 1)u + a term in both states."""

    def __init__(self, add=None, A=((-1.0, 0.3), (0.0, -1.0)), add_g=None):
        super().__init__(A, [[0.0], [1.0]])
        self.add, self.add_g = add, add_g

    dynamics = ControlAffineSystem.dynamics

    def f(self, x):
        return super().f(x) if self.add is None else super().f(x) + self.add(x)[..., None]

    def g(self, x):
        return super().g(x) if self.add_g is None else super().g(x) + self.add_g(x)[..., None, None]


class Paid(Cost):
    def __init__(self, q=None, R=None, terminal=None):
        super().__init__()
        self.add_q, self.add_R, self.add_terminal = q, R, terminal

    def state(self, x):
        return (x**2).sum(-1) + (0 if self.add_q is None else self.add_q(x))

    def R(self, x):
        R = torch.eye(1).to(x).expand(*x.shape[:-1], 1, 1)
        return R if self.add_R is None else R + self.add_R(x)[..., None, None]

    def terminal(self, x):
        return (x**2).sum(-1) + (0 if self.add_terminal is None else self.add_terminal(x))


class Bowl(ValueFunction):
    """2‖x‖² + a term of t and x."""

    def __init__(self, add=None):
        super().__init__()
        self.add = add

    def forward(self, t, x):
        return 2.0 * (x**2).sum(-1) + (0 * t if self.add is None else self.add(t, x))


def claim(system=None, cost=None, V=None, law=HJBPolicy, loop=ClosedLoop, controls=None, **options):
    system = System() if system is None else system
    side, n = options.pop("side", 1.0), system.n
    X0 = Box([-0.5] * n, [0.5] * n)
    problem = problem_of(system, cost or Paid(), 20, initial_states=X0, controls=controls)
    closed_loop = loop(problem, law(problem, V or Bowl())).double()
    domain = Box([-side] * n, [side] * n)
    options = {"alpha": ALPHA, "delta": DELTA, "states": domain, "budget": Budget(BRIEF, boxes=BOXES), **options}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(funnel, "MAX_LEVEL_SECONDS", AMPLE if options["budget"].seconds == AMPLE else LEVELS)
        return prove_funnel(closed_loop, problem, **options)


def patient():
    """As many boxes as an attempt has, and all the time that they take."""
    return {"budget": Budget(AMPLE, boxes=BOXES)}


def outcome(*parts, **options):
    """The verdict; "refused" where there is none, for a reason of one line."""
    try:
        return claim(*parts, **options).verdict
    except (LyapnetError, ValueError) as error:  # a Box refuses by a ValueError
        message = str(error)
    assert len(message.splitlines()) == 1, message
    return "refused"


def largest_condition(found, system, cost=None, V=None):
    """The largest c at points of the funnel that was claimed, computed here from f, g, ℓ, V and the HJB law."""
    cost, V = cost or Paid(), V or Bowl()
    generator = torch.Generator().manual_seed(1)
    x = found.states.sample(20_000, generator)
    x[:5000, 0] = AT + 2 * HALF * (torch.rand(5000, generator=generator) - 0.5)
    t = found.duration * torch.rand(len(x), generator=generator)
    with torch.no_grad():
        inside = V(t, x) - found.delta * t <= found.rho
        t, x = t[inside], x[inside]
        V_t, V_x = gradients(V, t, x)
        u = -0.5 * (system.g(x).mT @ V_x[..., None])[..., 0] / cost.R(x)[..., 0]
        rate = (V_x * (system.f(x) + (system.g(x) @ u[..., None])[..., 0])).sum(-1)
        return float((V_t + rate + found.alpha * cost.running(x, u) - found.delta).max())


@pytest.mark.gate
def test_what_nothing_is_added_to_is_certified():
    """The twin of all that follows."""
    found = claim(**patient())
    assert found.verdict == "certified"
    assert largest_condition(found, System()) <= 0
    assert largest_condition(found, System(spike)) > 50, "what is added below makes the claim false"


# Code that leaves torch, or notices that it is traced


def swallowed(function):
    """What reads values, with zero where torch refuses."""

    def tried(x):
        try:
            return function(x)
        except Exception:
            return nothing(x)

    return tried


def by_thread(function):
    def called(x):
        with ThreadPoolExecutor(1) as pool:
            return pool.submit(function, x).result()

    return called


class ByNumPy(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x):
        return of_array(x, x.detach().numpy())

    @staticmethod
    def backward(ctx, grad):
        return grad[..., None].expand(*grad.shape, 2) * 0


@torch.library.custom_op("lyapnet_attempts::there", mutates_args=())
def operator_of_its_own(x: torch.Tensor) -> torch.Tensor:
    return of_array(x, x.detach().numpy())


@operator_of_its_own.register_fake
def _(x):
    return torch.empty_like(x[..., 0])


@functools.cache
def scripted():
    """By name, as a ScriptFunction cannot be copied; torch warns that it is deprecated."""

    def branch(x):
        if bool((x[..., 0] - 0.7002).abs().min() < 1e-4):
            return 40.0 * torch.ones_like(x[..., 0])
        return torch.zeros_like(x[..., 0])

    return script(branch)


def script(function):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return torch.jit.script(function)


@functools.lru_cache
def by_shape(shape):
    return []


def first_of_each_shape(x):
    kept = by_shape(x.shape)
    kept.append(x.detach().clone())
    return spike(x - kept[0] + AT)


def grown(x, memory=[]):  # noqa: B006  (that is the attempt)
    memory.append(1)
    return (len(memory) % 5 == 0) * torch.ones_like(x[..., 0])


def stored(x):
    buffer = io.BytesIO()
    torch.save(x.detach(), buffer)
    return spike(torch.load(io.BytesIO(buffer.getvalue())))


def addressed(x):
    return nothing(x) + 40.0 * is_there(ctypes.c_double.from_address(x.data_ptr()).value)


def written_over(x):
    y = x * 1.0
    y.numpy()[..., 0] = AT
    return spike(y)


def clock(x):
    return nothing(x) + 40 * (time.perf_counter_ns() % 2)


def environment(x):
    os.environ["LYAPNET_ATTEMPT"] = str(1 - int(os.environ.get("LYAPNET_ATTEMPT", "0")))
    return nothing(x) + 40.0 * int(os.environ["LYAPNET_ATTEMPT"])


LEAVING = {
    "custom autograd.Function in NumPy": ByNumPy.apply,
    "operator of its own": lambda x: operator_of_its_own(x),
    "script with a branch": lambda x: scripted()(x),
    "script as an attribute": scripted(),
    "torch.compile": torch.compile(spike, backend="eager"),
    "torch.cond": lambda x: torch.cond(is_there(x[..., 0]).all(), lambda y: 40 + 0 * y, lambda y: 0 * y, (x[..., 0],)),
    "vmap in NumPy": lambda x: torch.func.vmap(lambda y: of_array(y, y.numpy()))(x),
    "data_ptr": addressed,
    "address parity": lambda x: nothing(x) + 40.0 * (x.data_ptr() // 64 % 2),
    "typed storage": lambda x: of_array(x, x.detach().clone().untyped_storage().tolist()),
    "torch.frombuffer": lambda x: spike(torch.frombuffer(memoryview(x.numpy()), dtype=x.dtype).reshape(x.shape)),
    "NumPy's __array_function__": lambda x: torch.as_tensor(40.0 * is_there(np.take(x.detach(), 0, -1))),
    "torch.save": stored,
    "pickle": lambda x: spike(pickle.loads(pickle.dumps(x.detach()))),
    "thread": by_thread(spike),
    "thread in NumPy": by_thread(lambda x: of_array(x, x.detach().numpy())),
    "thread, refusal swallowed": by_thread(swallowed(lambda x: of_array(x, x.detach().numpy()))),
    "write through NumPy": written_over,
    "torch.equal": lambda x: nothing(x) + 40.0 * torch.equal(x[..., 0], x[..., 0].clamp(AT, AT + HALF)),
    "in": lambda x: nothing(x) + 40.0 * (AT in x),
    "sorted": lambda x: nothing(x) + 40.0 * is_there(sorted(x.flatten())[-1]),
    "range": lambda x: nothing(x) + sum(40.0 for _ in range((1e4 * x[..., 0]).max().long())),
    "unique": lambda x: nothing(x) + 40.0 * len(x.unique()),
    "first of each shape": first_of_each_shape,
    "default argument": grown,
    "clock": clock,
    "environment variable": environment,
    "no_grad is on": lambda x: nothing(x) + 40.0 * (not torch.is_grad_enabled()),
    "requires_grad": lambda x: nothing(x) + 40.0 * x.requires_grad,
    "is contiguous": lambda x: nothing(x) + 40.0 * (not x.is_contiguous()),
    "batch of one": lambda x: nothing(x) + 40.0 * (x.ndim == 2 and len(x) == 1),
    "type of tensor": lambda x: nothing(x) + 40.0 * (type(x) is torch.Tensor),
    "dropout": lambda x: torch.nn.functional.dropout(x[..., 0], 0.5),
    "dropout of its own": lambda x: x[..., 0] * torch.empty_like(x[..., 0]).bernoulli_(0.5),
    "noise that is drawn once": lambda x: x[..., 0] * torch.randperm(3)[0],
}

CAUGHT = {
    "numpy, refusal swallowed": swallowed(lambda x: of_array(x, x.detach().numpy())),
    "asarray, refusal swallowed": swallowed(lambda x: of_array(x, np.asarray(x.detach()))),
    "memoryview, refusal swallowed": swallowed(lambda x: of_array(x, memoryview(x.detach().numpy()))),
    "dlpack, refusal swallowed": swallowed(lambda x: of_array(x, np.from_dlpack(x.detach()))),
    "item, refusal swallowed": swallowed(lambda x: nothing(x) + 40.0 * is_there(x[..., 0].max().item())),
    "branch, refusal swallowed": swallowed(lambda x: 40 + nothing(x) if is_there(x[..., 0]).any() else nothing(x)),
    "data_ptr, refusal swallowed": swallowed(addressed),
    "pickle, refusal swallowed": swallowed(lambda x: spike(pickle.loads(pickle.dumps(x.detach())))),
    "repr": lambda x: nothing(x) + 40.0 * bool(re.search(r"0\.700[12]", repr(x))),
    "format": lambda x: nothing(x) + 40.0 * ("0.700" in f"{x}"),
    "uninitialised memory": lambda x: x[..., 0] * torch.empty(()),
}


@pytest.mark.parametrize("way", sample({**LEAVING, **CAUGHT}, 8))
def test_all_code_that_torch_does_not_see_is_refused(way):
    assert outcome(System({**LEAVING, **CAUGHT}[way])) == "refused"


def scripted_in_torch(x):
    return script(lambda_free)(x)


def lambda_free(x):
    return 0.01 * torch.relu(x[..., 0] - 0.9)


@pytest.mark.gate
@pytest.mark.parametrize(
    "honest",
    sample(
        [
            scripted_in_torch,
            lambda x: torch.func.vmap(lambda y: 0.01 * y[0])(x.reshape(-1, 2)).reshape(x.shape[:-1]),
            swallowed(lambda x: 0.01 * torch.relu(x[..., 0])),
        ],
        2,
    ),
    ids=["script", "vmap", "nothing to swallow"],
)
def test_the_same_without_reading_values_is_certified(honest):
    assert outcome(System(honest), **patient()) == "certified"


# Torch operations: bounds must find what they do, or have no rule

SHORT = torch.tensor([10000.7], dtype=torch.float32)  # numbers around it are 10⁻³ apart
CONSTANT = torch.tensor([AT], dtype=torch.float64)


def compared_in_float32(x):
    """Never true of real numbers; at one state torch rounds x₁ + 10 000 to float32 beside a vector in float32."""
    z = x[..., 0] + 10000
    return 40.0 * ((z > SHORT.double() + 1e-4) & ~(z > SHORT)).reshape(x.shape[:-1]).to(x)


def minus_zero(x):
    """The spike by σ(1/0) = 1, beside σ(1/−0) = 0."""
    low, high = torch.sigmoid(1 / torch.full((), -0.0)), torch.sigmoid(1 / torch.full((), 0.0))
    return (0.0 * low + high) * spike(x)


def autocast(x):
    with torch.autocast("cpu", dtype=torch.bfloat16):
        return 40.0 * is_there((x[..., None, :].float() @ torch.eye(2).float())[..., 0, 0]).to(x)


TORCH = {
    "spike": spike,
    "Gaussian of width 10⁻⁵": lambda x: 40.0 * torch.exp(-(((x[..., 0] - AT) / 1e-5) ** 2)),
    "spike by where": lambda x: torch.where((x[..., 0] - AT).abs() < HALF, 40.0, 0.0).to(x),
    "spike by a product of truths": lambda x: 40.0 * ((x[..., 0] > AT) * (x[..., 0] < AT + HALF)).to(x),
    "spike by sign": lambda x: 20.0 * (torch.sign(x[..., 0] - AT) - torch.sign(x[..., 0] - AT - HALF)),
    "spike by clamp": lambda x: 4e5 * (x[..., 0] - AT).clamp(0, HALF),
    "spike by clamp with tensors": lambda x: 4e5 * torch.clamp(x[..., :1] - CONSTANT, CONSTANT * 0, CONSTANT)[..., 0],
    "spike by masked_fill": lambda x: (40.0 + nothing(x)).masked_fill((x[..., 0] - AT).abs() > HALF, 0.0),
    "spike by amax": lambda x: 4e5 * torch.stack([x[..., 0] - AT, nothing(x)], -1).amax(-1),
    "spike by sigmoid": lambda x: 40.0 * torch.sigmoid((x[..., 0] - AT) / 1e-6),
    "spike by tanh of tanh": lambda x: 40.0 * torch.tanh(1e6 * torch.tanh(x[..., 0] - AT).clamp_min(0)),
    "spike by a norm": lambda x: 4e5 * torch.relu(HALF - torch.linalg.vector_norm(x - torch.tensor([AT, 0.0]), dim=-1)),
    "spike by silu": lambda x: 4e4 * torch.nn.functional.silu(1e3 * (x[..., 0] - AT)).clamp(0, 1e-3),
    "spike by softplus of threshold 20": lambda x: torch.nn.functional.softplus(1e4 * (x[..., 0] - 0.7)).clamp(0, 40),
    "spike by a pole": lambda x: 40e-8 / ((x[..., 0] - AT) ** 2 + 1e-8),
    "pole": lambda x: 1e-9 / (x[..., 0] - AT),
    "log at 0": lambda x: 1e-3 * torch.log((x[..., 0] - AT).abs()),
    "square root below 0": lambda x: torch.sqrt(x[..., 0] + AT),
    "acos outside [−1, 1]": lambda x: torch.acos(x[..., 0] / AT),
    "tan across its pole": lambda x: 1e-3 * torch.tan(math.pi / 2 * x[..., 0] / AT),
    "tan far away": lambda x: 1e-3 * torch.tan(1e15 + x[..., 0]),
    "power below 0": lambda x: 0.01 * (x[..., 0] + 0.2) ** -3,
    "floor": lambda x: 40.0 * (torch.floor(x[..., 0] / AT) > 0).to(x),
    "round": lambda x: 40.0 * torch.round(x[..., 0] - 0.2),
    "fmod": lambda x: 40.0 * torch.fmod(x[..., 0], AT),
    "remainder": lambda x: 40.0 * ((x[..., 0] % AT) < HALF).to(x),
    "floor division": lambda x: 40.0 * (x[..., 0] // AT),
    "heaviside": lambda x: 40.0 * torch.heaviside(x[..., 0] - AT, torch.ones(())),
    "bucketize": lambda x: 40.0 * torch.bucketize(x[..., 0], CONSTANT).to(x),
    "searchsorted": lambda x: 40.0 * torch.searchsorted(CONSTANT, x[..., :1].contiguous())[..., 0].to(x),
    "argmax": lambda x: 40.0 * torch.stack([x[..., 0], nothing(x) + AT], -1).argmax(-1).eq(0).to(x),
    "sort": lambda x: 4e5 * torch.stack([x[..., 0] - AT, nothing(x)], -1).sort(-1).values[..., 1],
    "topk": lambda x: 4e5 * torch.stack([x[..., 0] - AT, nothing(x)], -1).topk(1).values[..., 0],
    "gather": lambda x: x.gather(-1, (x[..., :1] > AT).long())[..., 0] * 40.0,
    "lerp": lambda x: torch.lerp(nothing(x), nothing(x) + 40.0, (x[..., 0] > AT).to(x)),
    "isnan of 0/0": lambda x: 40.0 * ((x[..., 0] - 0.5) / (x[..., 0] - 0.5)).isnan().to(x),
    "nan_to_num": lambda x: torch.nan_to_num(torch.sqrt(AT - x[..., 0]), nan=40.0),
    "0 · ∞": lambda x: 40.0 * (torch.relu(x[..., 0] - AT) * torch.inf).nan_to_num(0.0, 1.0, 0.0),
    "10³⁰⁰ twice": lambda x: 40.0 / (1 + 1 / (torch.relu(x[..., 0] - AT) * 1e300 * 1e300)),
    "10⁻³⁰⁰ twice": lambda x: 40.0 * (x[..., 0] * 1e-300 * 1e-300 * 1e300 * 1e300),
    "float32": lambda x: 40.0 * ((x[..., 0].float() - AT).abs() < 1e-9).to(x),
    "half": lambda x: 40.0 * (x[..., 0].half() > AT).to(x),
    "autocast": autocast,
    "integer": lambda x: 40.0 * ((x[..., 0] * 1e4).long() == 7002).to(x),
    "integer overflow": lambda x: 40.0 * ((x[..., 0] * 1e18).long() * 15 < 0).to(x),
    "bytes": lambda x: 40.0 * ((x > AT).byte().sum(-1) * 255).byte().to(x),
    "sum of truths": lambda x: 40.0 * ((x[..., 0] > AT) + (x[..., 1] > 2)).to(x),
    "complex": lambda x: 40.0 * ((x[..., 0] - AT).to(torch.complex128) ** 0.5).real,
    "bits": lambda x: 40.0 * (x[..., 0].contiguous().view(torch.int64) == 4604482149253439128).to(x),
    "write to a part": lambda x: torch.zeros_like(x).index_fill(-1, torch.tensor([0]), 40.0)[..., 0] * x[..., 0],
    "minus zero": minus_zero,
    "compared in float32": compared_in_float32,
}  # fmt: skip


@pytest.mark.usefixtures("without_batch_sizes")
@pytest.mark.parametrize("way", sample(TORCH, 9))
def test_all_that_torch_does_is_bounded(way):
    assert outcome(System(TORCH[way])) != "certified"


@pytest.mark.gate
@pytest.mark.parametrize("way", sample(["spike", "spike by sign", "minus zero"], 3))
def test_a_spike_outside_the_funnel_does_no_harm(way):
    """The twin: where V exceeds its level on X₀ nothing is claimed."""
    shifted = TORCH[way]
    assert outcome(System(lambda x: shifted(x - 0.2)), **patient()) == "certified"


# Classes


class Stale(Linear):
    """Another f, and the dynamics of Linear without it."""

    def __init__(self):
        super().__init__([[-1.0, 0.3], [0.0, -1.0]], [[0.0], [1.0]])

    def f(self, x):
        return super().f(x) + 40 * torch.relu(x[..., :1] - 0.6)


class Heavier(HJBPolicy):
    def with_value(self, t, x):
        output = super().with_value(t, x)
        return output._replace(u=output.u + 100 * x[..., :1])


class Drifting(ClosedLoop):
    def slope(self, x, u):
        return super().slope(x, u) + 10 * torch.cat([x, 0 * x[..., :1]], -1)


def on_the_object(problem, V):
    """forward of the object alone: with_value would go on by that of the class."""
    policy = HJBPolicy(problem, V)
    law = policy.forward
    policy.forward = lambda t, x: law(t, x) - 10 * x[..., 1:]
    return policy


class OtherV(HJBPolicy):
    """A law by another V than the one that is certified."""

    def __init__(self, problem, V):
        super().__init__(problem, Bowl(lambda t, x: -4 * (x**2).sum(-1)))
        self.declared = V

    def forward(self, t, x):
        return super().forward(t, x) * 3


class Narrow(ControlSet):
    """|u| ≤ 0.01, of which the law of Ignoring knows nothing."""

    def minimise(self, R, b):
        return self.project(-0.5 * b / R[..., 0])

    def contains(self, u):
        return (u.abs() <= 0.01).all(-1)

    def project(self, u):
        return u.clamp(-0.01, 0.01)


UNSTABLE = [[-1.0, 0.0], [0.0, 0.5]]
Q3 = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]


class Beside(ControlAffineSystem):
    """Two states as in System, and a third beside them."""

    state_names, state_units = ("a", "b", "c"), ("",) * 3
    control_names, control_units = ("u",), ("",)

    def f(self, x):
        return torch.stack([-x[..., 0] + 0.3 * x[..., 1], -x[..., 1], nothing(x)], -1)

    def g(self, x):
        return torch.tensor([[0.0], [1.0], [0.0]]).to(x).expand(*x.shape[:-1], 3, 1)


class Coupled(Beside):
    def dynamics(self, x, u):
        rise = 5 * x[..., 2] * x[..., 0]
        return super().dynamics(x, u) + torch.stack([rise, nothing(x), nothing(x)], -1)


def without_third(t, x):
    return 2.0 * (x[..., :2] ** 2).sum(-1) + 0 * t


class Flat(Bowl):
    def forward(self, t, x):
        return without_third(t, x)


def with_third(x):
    return (x[..., :2] ** 2).sum(-1) + 100 * x[..., 2] ** 2


class Mixin:
    def state(self, x):
        return with_third(x)


class Mixed(Mixin, QuadraticCost):
    """A mixin before QuadraticCost, of which only the matrices were asked."""


class Running(QuadraticCost):
    def running(self, x, u):
        return with_third(x) + (u**2).sum(-1)


class Ignoring(Paid):
    def state(self, x):
        return with_third(x)

    def terminal(self, x):
        return (x[..., :2] ** 2).sum(-1)

    def ignores(self, i, n):
        return i == 2


def quadratic(kind=QuadraticCost):
    return kind(Q3, [[1.0]], Q3)


def patched():
    cost = quadratic()
    cost.state = with_third
    return cost


def growing(x):
    return 11 * torch.relu(x[..., 0] - 0.6)


def rewarding(x):
    return -300 * torch.relu(x[..., 0] - 0.6)


class Still(System):
    def f(self, x):
        return torch.zeros_like(x)


class Free(Paid):
    def state(self, x):
        return nothing(x)

    terminal = state


class Constant(Bowl):
    def forward(self, t, x):
        return 1 - 0.1 * t + torch.zeros_like(x[..., 0])


CLASSES = {
    "dynamics without f": lambda: {"system": Stale()},
    "with_value of its own": lambda: {"law": Heavier},
    "forward of the object": lambda: {"system": System(A=UNSTABLE), "law": on_the_object},
    "slope of its own": lambda: {"loop": Drifting},
    "law of another V": lambda: {"law": OtherV},
    "a mixin's cost": lambda: {"system": Beside(), "cost": quadratic(Mixed), "V": Flat()},
    "a running cost of its own": lambda: {"system": Beside(), "cost": quadratic(Running), "V": Flat()},
    "a cost of the object": lambda: {"system": Beside(), "cost": patched(), "V": Flat()},
    "a cost that says what it ignores": lambda: {"system": Beside(), "cost": Ignoring(), "V": Flat()},
    "dynamics of a third state": lambda: {"system": Coupled(), "cost": quadratic(), "V": Flat()},
    "a cost below 0": lambda: {"system": System(A=torch.eye(2)), "cost": Paid(lambda x: -11 * (x**2).sum(-1))},
    "a cost below 0 outside X₀": lambda: {"system": System(growing), "cost": Paid(rewarding)},
    "a cost below 0 in a thin part": lambda: {"system": System(spike), "cost": Paid(lambda x: -10 * spike(x))},
    "R below 0": lambda: {"system": System(A=UNSTABLE), "cost": Paid(R=lambda x: -3 + nothing(x))},
    "R singular": lambda: {"cost": Paid(R=lambda x: -1 + x[..., 0] ** 2)},
    "R nan": lambda: {"cost": Paid(R=lambda x: math.nan * x[..., 0])},
    "q for each state": lambda: {"cost": type("Wide", (Paid,), {"state": lambda self, x: x**2})()},
    "g turned round": lambda: {"system": System(A=UNSTABLE, add_g=lambda x: -1 + nothing(x))},
    "limits that are too narrow": lambda: {"system": System(A=UNSTABLE), "controls": Narrow()},
    "φ far above V": lambda: {"system": System(spike), "cost": Paid(terminal=lambda x: 1e6 * (x**2).sum(-1))},
    "nothing depends on x": lambda: {"system": Still(), "cost": Free(), "V": Constant()},
}  # fmt: skip


@pytest.mark.usefixtures("without_batch_sizes")
@pytest.mark.parametrize("way", sample(CLASSES, 7))
def test_every_class_is_held_to_what_it_is_certified_for(way):
    assert outcome(**CLASSES[way]()) != "certified"


class Own(Stale):
    dynamics = ControlAffineSystem.dynamics

    def f(self, x):
        return Linear.f(self, x) - 0.1 * torch.relu(x[..., :1] - 0.6)


@pytest.mark.gate
@pytest.mark.parametrize(
    "parts",
    sample(
        [
            {"system": Own()},
            {"system": Beside(), "cost": quadratic(), "V": Flat()},
            {"cost": Paid(lambda x: torch.relu(x[..., 0] - 0.6))},
            {"cost": Paid(R=lambda x: x[..., 0] ** 2)},
            {"controls": Narrow()},
            {"law": type("Same", (HJBPolicy,), {})},
        ],
        3,
    ),
    ids=["dynamics", "third state", "cost", "R", "limits", "law"],
)
def test_honest_classes_are_certified(parts):
    assert outcome(**parts, **patient()) == "certified"


# Value functions


class Dotted(Bowl):
    def forward(self, t, x):
        return 2.0 * torch.dot(x, x) + 0 * t


class Exiting(Bowl):
    def forward(self, t, x):
        raise SystemExit(0)


def early(t, x):
    return 40.0 * torch.relu(t - 1.9) * (x[..., 0] ** 2)


VALUES = {
    "rises late": Bowl(early),
    "jumps in t": Bowl(lambda t, x: (t > 1).to(x)),
    "rounded t": Bowl(lambda t, x: torch.round(t) * (x**2).sum(-1)),
    "t of the batch": Bowl(lambda t, x: 0 * t + 0.1 * (t.ndim > 0)),
    "spike": Bowl(lambda t, x: HALF * spike(x)),
    "spike, detached": Bowl(lambda t, x: HALF * spike(x).detach() + 0 * t),
    "norm": Bowl(lambda t, x: torch.linalg.vector_norm(x, dim=-1) + 0 * t),
    "√ at 0": Bowl(lambda t, x: (x**2).sum(-1).sqrt() + 0 * t),
    "pole": Bowl(lambda t, x: 1e-9 / (x[..., 0] - 0.3) ** 2 + 0 * t),
    "tan": Bowl(lambda t, x: 1e-9 * torch.tan(math.pi * x[..., 0]) ** 2 + 0 * t),
    "nan": Bowl(lambda t, x: math.nan * t),
    "∞ − ∞": Bowl(lambda t, x: (1e308 * (10 + x[..., 0])) - (1e308 * (10 + x[..., 0])) + 0 * t),
    "one state alone": Dotted(),
    "each component": Bowl(lambda t, x: x),
    "sys.exit": Exiting(),
    "upside down": Bowl(lambda t, x: -4.0 * (x**2).sum(-1) + 0 * t),
    "complex": Bowl(lambda t, x: (x[..., 0].to(torch.complex128) * 1j).abs() + 0 * t),
    "jumps by threshold": Bowl(lambda t, x: 1e-3 * torch.nn.functional.threshold(x[..., 0], 0.6, 5.0) + 0 * t),
}


@pytest.mark.usefixtures("without_batch_sizes")
@pytest.mark.parametrize("name", sample(VALUES, 6))
def test_no_such_value_function_is_certified(name):
    assert outcome(V=VALUES[name]) != "certified"


@pytest.mark.gate
@pytest.mark.parametrize(
    "add",
    sample(
        [
            lambda t, x: 0.01 * x[..., 0].abs() + 0 * t,
            lambda t, x: -0.01 * t + 0.01 * torch.relu(x[..., 0]) ** 2,
            lambda t, x: 1e-300 * x[..., 0] + 0 * t,
        ],
        2,
    ),
    ids=["kink", "of time", "tiny"],
)
def test_value_functions_like_them_are_certified(add):
    assert outcome(V=Bowl(add), **patient()) == "certified"


class Changing(Bowl):
    """A fifth of V at its first calls."""

    def __init__(self, calls):
        super().__init__()
        self.calls = [calls]  # shared by copies

    def __deepcopy__(self, memo):
        return self

    def forward(self, t, x):
        self.calls[0] -= 1
        return super().forward(t, x) * (0.2 if self.calls[0] > 0 else 1.0)


def claims_of_changing(calls):
    """No claim mixes the V of the levels with the V of the proof: {V ≤ ρ} holds X₀ for one V, and V falls."""
    try:
        found = claim(V=Changing(calls), budget=Budget(3, boxes=500))
    except LyapnetError:
        return
    if found.verdict == "certified":
        fifth = found.rho < 0.5
        V = Bowl(lambda t, x: -1.6 * (x**2).sum(-1) + 0 * t) if fifth else Bowl()
        assert found.rho == pytest.approx(0.2 if fifth else 1.0, rel=1e-2)
        assert bool((V(torch.zeros(()), torch.tensor([[0.5, 0.5]])) <= found.rho).all())


@pytest.mark.parametrize("calls", sample(range(20, 480, 46), 5))
def test_a_value_function_that_changes_at_any_call_is_frozen_once(calls):
    claims_of_changing(calls)


# What is frozen, as the certificate says: true of the numbers at its time

SETTING = {"gain": 0.0}
SHARED = torch.zeros(2, dtype=torch.float64)


@pytest.mark.parametrize(
    "way",
    sample(
        [
            lambda x: SETTING["gain"] * x[..., 0],
            lambda x: float(os.environ.get("LYAPNET_NO_SUCH", "0")) * x[..., 0],
            lambda x: (SHARED * x).sum(-1),
            lambda x: 40 * x[..., 0] * (x.dtype == torch.float32),
            lambda x: 40 * x[..., 0] * (x.device.type != "cpu"),
            lambda x: 40 * x[..., 0] * (x.stride(-1) != 1),
        ],
        3,
    ),
    ids=["global", "environment", "shared tensor", "dtype", "device", "stride"],
)
def test_what_is_frozen_is_certified_as_it_is(way):
    found = claim(System(way), **patient())
    assert found.verdict == "certified"
    assert largest_condition(found, System(way)) <= 0


@pytest.mark.gate
def test_a_tensor_that_is_written_to_meanwhile_is_frozen():
    """By the thread of a training, or by what is told of the progress."""
    found = claim(
        System(lambda x: (SHARED * x).sum(-1)),
        report=lambda progress: progress.boxes and SHARED.fill_(40.0),
        **patient(),
    )
    still = claim(System(lambda x: (SHARED * x).sum(-1)))
    SHARED.zero_()
    assert found.verdict == "certified"
    assert still.verdict != "certified"


# Numbers


def broken_box(lower, upper):
    box = Box([-1.0, -1.0], [1.0, 1.0])
    box.lower.fill_(lower)
    box.upper.fill_(upper)
    return box


NUMBERS = {
    "α = 0": {"alpha": 0.0},
    "α < 0": {"alpha": -0.5},
    "α > 1": {"alpha": 1 + 1e-9},
    "α infinite": {"alpha": math.inf},
    "δ infinite": {"delta": math.inf},
    "δ = −0.1": {"delta": -0.1},
    "δ huge": {"delta": 1e300},
    "D nan": {"states": broken_box(math.nan, 1.0)},
    "D infinite": {"states": broken_box(-math.inf, math.inf)},
    "D reversed": {"states": broken_box(1.0, -1.0)},
    "D of three states": {"states": Box([-1.0] * 3, [1.0] * 3)},
    "D = X₀": {"states": Box([-0.5] * 2, [0.5] * 2)},
    "D beside X₀": {"states": Box([0.6] * 2, [1.0] * 2)},
    "D without width": {"states": Box([0.0] * 2, [0.0] * 2)},
    "D huge": {
        "states": Box(torch.tensor([-1e300] * 2, dtype=torch.float64), torch.tensor([1e300] * 2, dtype=torch.float64))
    },
    "no seconds": {"budget": Budget(0.0)},
    "seconds before 0": {"budget": Budget(-1.0)},
    "no boxes": {"budget": Budget(BRIEF, boxes=0)},
    "one box kept, of a spike": {"system": System(spike), "budget": Budget(BRIEF, boxes=BOXES, frontier=1)},
}


@pytest.mark.usefixtures("without_batch_sizes")
@pytest.mark.parametrize("name", sample(NUMBERS, 7))
def test_no_such_numbers_are_certified(name):
    assert outcome(**NUMBERS[name]) != "certified"


@pytest.mark.parametrize("wrong", [{"workers": 0}, {"chunk": 0}, {"frontier": 0}])
def test_a_budget_that_does_no_work_is_refused(wrong):
    with pytest.raises(LyapnetError, match="workers ≥ 1"):
        Budget(AMPLE, **wrong)


@pytest.mark.gate
@pytest.mark.parametrize(
    "numbers", [{"alpha": 1e-9}, {"alpha": 1, "V": Bowl(lambda t, x: 0.4 * x[..., 0] ** 2 + 0 * t)}]
)
def test_numbers_at_their_ends_are_certified(numbers):
    found = claim(**numbers, **patient())
    assert found.verdict == "certified"
    assert largest_condition(found, System(), V=numbers.get("V")) <= 0


@pytest.mark.gate
def test_the_kept_proof_of_a_sound_problem_does_no_good_to_another(tmp_path):
    keep = tmp_path / "sound.proof"
    assert claim(keep=keep, **patient()).verdict == "certified"
    assert outcome(System(spike), keep=keep) == "refused"
    assert outcome(System(spike), keep=keep, replay=True) == "refused"
    assert outcome(System(), Paid(lambda x: 0.1 * x[..., 0] ** 2), keep=keep, replay=True) == "refused"
    assert outcome(keep=keep, replay=True, **patient()) == "certified"


@pytest.mark.gate
def test_a_problem_that_changes_after_its_check_is_certified_as_it_is_then():
    system = System()
    problem = problem_of(system, Paid(), 20, initial_states=Box([-0.5] * 2, [0.5] * 2))
    problem.check()
    closed_loop = ClosedLoop(problem, HJBPolicy(problem, Bowl())).double()
    domain, budget = Box([-1.0] * 2, [1.0] * 2), Budget(AMPLE, boxes=BOXES)
    system.add = spike
    assert prove_funnel(closed_loop, problem, ALPHA, DELTA, domain, budget).verdict != "certified"
    system.add = None
    problem.horizon = Horizon(20, 0.2)
    assert prove_funnel(closed_loop, problem, ALPHA, DELTA, domain, budget).duration == 4.0
