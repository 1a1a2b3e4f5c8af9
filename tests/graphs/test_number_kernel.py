"""Programs on numbers: each rule against torch, for tensors of any layout; scans; and refusals."""

import re
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import pytest
import torch
from torch import nn
from torch.testing import assert_close

import lyapnet
from lyapnet.base.threads import in_threads
from lyapnet.experiment.config import config_from_plain
from lyapnet.graphs.compilation import has_compiler
from lyapnet.graphs.number_kernel import rules
from lyapnet.graphs.number_kernel.assembly import SOURCE
from lyapnet.graphs.number_kernel.kernel import NumberKernel, ScanKernel
from lyapnet.graphs.number_kernel.program import OPERATIONS
from lyapnet.graphs.number_kernel.rewriting import rewrite
from lyapnet.graphs.scan import Scan
from lyapnet.graphs.tracing import trace
from lyapnet.loop.rollout import Rollout
from lyapnet.task.systems import SYSTEMS, Pendulum
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.networks import FCN, NETWORKS
from tests.configs import objects
from tests.marks import sample

pytestmark = pytest.mark.skipif(not has_compiler(), reason="needs a C++ compiler")

OPERATORS = {
    "sums": lambda x, y: (x + y, x - 2 * y, torch.add(x, y, alpha=3), 1.5 - x, x + 1, x.mT - y.mT),
    "products": lambda x, y: (x * y, x / (2 + y**2), 2 * x, x.reciprocal(), -x),
    "divisions": lambda x, y: (torch.div(x, y, rounding_mode="trunc"), x % y),
    "powers": lambda x, y: (x**2, x**3, x.abs() ** 0.5, (x**2 + 1) ** -0.5, (x**2 + 1) ** y, x**1, x**-1, x**4),
    "exponentials": lambda x, y: (x.exp(), x.expm1(), x.exp2(), (100 * x).exp(), torch.softmax(x, -1)),
    "logarithms": lambda x, y: ((1 + x**2).log(), (x**2).log1p(), (1 + x**2).log2(), (1 + x**2).log10()),
    "waves": lambda x, y: (x.sin(), x.cos(), x.tan(), torch.atan2(x, y), x.atan(), (x / 9).asin(), (x / 9).acos()),
    "hyperbolic": lambda x, y: (x.tanh(), x.sinh(), x.cosh(), x.asinh(), (1 + x**2).acosh(), (x / 9).atanh()),
    "activations": lambda x, y: (
        x.sigmoid(), x.relu(), nn.functional.softplus(x), nn.functional.elu(x), nn.functional.silu(x),
        nn.functional.gelu(x), nn.functional.leaky_relu(x), (50 * x).sigmoid(), (1e-4 * x).tanh(), x.erf(),
    ),
    "roots": lambda x, y: ((x**2).sqrt(), (1 + x**2).rsqrt(), x.abs(), x.sign(), x.sgn()),
    "rounding": lambda x, y: (x.floor(), x.ceil(), x.round(), x.trunc()),
    "limits": lambda x, y: (
        x.clamp(-0.5, 0.7), x.clamp(min=0.1), x.clamp(max=0.1), torch.clamp(x, -y.abs(), y.abs()),
        torch.maximum(x, y), torch.minimum(x, y),
    ),
    "truths": lambda x, y: (
        (x > y).to(x.dtype), (x >= y) * x, (x < 0.3) & (y < 0), (x <= y) | (y > 0), ~(x == y), x != y,
        torch.where(x > y, x, 0.0), x.masked_fill(x > 0, 7.0), (x > 0).any(-1), (x > -1).all(0), x.isnan(),
        torch.logical_not(x > 0), torch.logical_xor(x > 0, y > 0), (x > 0).sum(-1).to(x.dtype),
    ),
    "reductions": lambda x, y: (
        x.sum(), x.sum(0), x.sum(-1, keepdim=True), x.mean(-2), x.amax(-1), x.amin(0), x.max(), x.min(),
        x.mT.sum(-1), x[..., ::2].sum(-1), torch.linalg.vector_norm(x, dim=-1), x.expand(3, *x.shape).sum((0, 2)),
    ),
    "extremes": lambda x, y: (
        x.max(-1).values, x.min(0).values, x.argmax(-1).to(x.dtype), x.min(-1, keepdim=True).indices == 2,
        x.gather(-1, y.argmin(-1, keepdim=True)), x.gather(0, y.argmax(0, keepdim=True)),
        x.scatter(-1, y.argmax(-1, keepdim=True), y[:, :1]), x.scatter(0, y.argmin(0, keepdim=True), 3.0),
    ),
    "matrices": lambda x, y: (
        x @ y.mT, x.mT @ y, x @ y[0], torch.addmm(x[:, :5], x, y[:, :7].mT[:, :5]), x[:1] @ y.mT, x @ y[:1].mT,
        torch.bmm(x.reshape(5, 1, 7), y.reshape(5, 7, 1)), x[:, :3] @ torch.ones(3, 40, dtype=x.dtype),
        torch.baddbmm(x.reshape(5, 1, 7), x[:, :2].reshape(5, 1, 2), y.reshape(5, 7, 1)[:, :2] * y.reshape(5, 1, 7)),
        torch.einsum("bi,bj->bij", x, y), x @ torch.zeros(7, 3, dtype=x.dtype),
    ),
    "shapes": lambda x, y: (
        torch.cat([x, y.mT.mT], -1), torch.stack([x, y], 1), x.reshape(7, 5), x.mT.reshape(35), x.flip(0),
        x[:, [3, 1, 1]], x.roll(2, -1), x.repeat(2, 1), x.tril(), x[::2, 1:4].clone(), x.unsqueeze(1).expand(5, 2, 7),
        x.index_select(0, torch.tensor([4, 0])), x.unfold(-1, 3, 2), x.permute(1, 0)[None],
    ),
    "assignments": lambda x, y: (
        torch.zeros_like(x).index_put((torch.tensor([1, 3]),), y[:2]), x.select_scatter(y[0], 0, 2),
        x.slice_scatter(y[:2], 0, 1, 5, 2), x.index_add(0, torch.tensor([1, 1, 4]), y[:3]),
        x.index_put((torch.tensor([1, 1]),), y[:2], accumulate=True), x.index_fill(-1, torch.tensor([0]), 2.0),
    ),
    "mixed": lambda x, y: ((x @ y.mT).tanh().sum(-1, keepdim=True) * x.mT[:5, :5].mean() + y[:, :1],),
}  # fmt: skip


def pair(dtype=torch.float64):
    generator = torch.Generator().manual_seed(0)
    x, y = (torch.randn(5, 7, generator=generator, dtype=torch.float64).to(dtype) for _ in range(2))
    return x, y


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("name", OPERATORS)
def test_operators_compute_what_torch_computes(name, dtype):
    def function(x, y):
        results = OPERATORS[name](x, y)
        return tuple(r.to(x.dtype) for r in results)

    graph = trace(function, pair(dtype))
    kernel = NumberKernel(graph, pair(dtype))
    others = [
        torch.linspace(-3, 2, 35, dtype=dtype).reshape(5, 7),
        torch.linspace(1, -1, 35, dtype=dtype).reshape(5, 7),
    ]
    for given in (pair(dtype), [1 + each for each in others], [each.mT.contiguous().mT for each in others]):
        rough = dtype == torch.float32
        for found, expected in zip(kernel(*given), function(*given), strict=True):
            assert_close(found, expected, rtol=2e-5 if rough else 1e-12, atol=1e-5 if rough else 1e-12, equal_nan=True)


def test_not_a_number_is_passed_on():
    x = torch.tensor([[torch.nan, 1.0, -torch.inf, torch.inf, -1.0, 0.0, 2.0]] * 5, dtype=torch.float64)
    for name in ("sums", "limits", "activations", "exponentials", "reductions", "rounding"):
        graph = trace(OPERATORS[name], pair())
        for found, expected in zip(NumberKernel(graph, pair())(x, pair()[1]), graph(x, pair()[1]), strict=True):
            assert_close(found, expected, rtol=1e-9, atol=1e-12, equal_nan=True, msg=name)


def test_slopes_compute_what_torch_computes():
    def function(x, y):
        with torch.enable_grad():
            z = x.detach().requires_grad_()
            value = (z.tanh() @ y.mT).sigmoid().sum(-1) + z.relu().max(-1).values + z[:, 2] * z[:, [0, 1]].sum(-1)
            (slope,) = torch.autograd.grad(value.sum(), z, create_graph=True)
            (bend,) = torch.autograd.grad((slope * y).sum(), z)
        return value.detach(), slope.detach(), bend

    kernel = NumberKernel(trace(function, pair()), pair())
    x, y = 0.3 - pair()[0], 2 * pair()[1]
    for found, expected in zip(kernel(x, y), function(x, y), strict=True):
        assert_close(found, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_tanh_is_right_to_its_last_digits(dtype):
    sizes = torch.cat([torch.logspace(-300 if dtype == torch.float64 else -30, 2, 3000), torch.linspace(0, 1, 3001)])
    x = torch.cat([sizes, -sizes]).to(dtype)
    (found,) = NumberKernel(trace(lambda x: (x.tanh(),), (x,)), (x,))(x)
    assert_close(found, x.double().tanh().to(dtype), rtol=4 * torch.finfo(dtype).eps, atol=0)
    assert found[len(sizes) + 3000].signbit(), "of −0"


def tanh_for_torch(a):
    return 2 * torch.sigmoid(2 * a) - 1


@pytest.mark.parametrize(
    ("function", "known"),
    [
        (tanh_for_torch, True),
        (lambda a: torch.sigmoid(2 * a) * 2 - 1, True),
        (lambda a: 2 * torch.sigmoid(2 * a) - 1.5, True),  # its derivative is that of tanh
        (lambda a: 2 * torch.sigmoid(3 * a) - 1, False),
        (lambda a: 1 - 2 * torch.sigmoid(2 * a), True),
        (lambda a: torch.sigmoid(a), False),
        (lambda a: tanh_for_torch(a) + torch.sigmoid(2 * a), True),
        (lambda a: torch.sub(2 * torch.sigmoid(2 * a), 1, alpha=3), True),
        (lambda a: tanh_for_torch(a) ** 1 * tanh_for_torch(2 * a), True),
    ],
)
def test_what_networks_have_for_tanh_is_one_operation(function, known):
    def with_slopes(a):
        with torch.enable_grad():
            a = a.detach().requires_grad_()
            value = function(a)
            (slope,) = torch.autograd.grad(value.sum(), a, create_graph=True)
            (bend,) = torch.autograd.grad((slope**2).sum(), a)
        return value.detach(), slope.detach(), bend

    a = torch.linspace(-4, 4, 101, dtype=torch.float64)
    graph = trace(with_slopes, (a,))
    written = rewrite(graph)
    names = {node.target for node in written.graph.nodes}
    assert (torch.ops.aten.tanh.default in names) is known
    assert len(written.graph.nodes) < len(graph.graph.nodes) or not known
    for found, of_rewritten, expected in zip(NumberKernel(graph, (a,))(a), written(a), with_slopes(a), strict=True):
        assert_close(of_rewritten, expected, rtol=1e-12, atol=1e-13)
        assert_close(found, expected, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("columns", [1, 2, 3, 4, 5, 17])
@pytest.mark.parametrize(("rows", "inner"), [(3, 5), (9, 21), (19, 300)])
def test_products_of_any_shape_and_layout(rows, inner, columns):
    A, B = torch.randn(rows, inner).double(), torch.randn(inner, columns).double()

    def function(A, B, A_turned, B_turned):
        return *(a @ b for a in (A, A_turned.mT) for b in (B, B_turned.mT)), (B_turned @ A_turned).mT

    given = [A, B, A.mT.contiguous(), B.mT.contiguous()]
    for found in NumberKernel(trace(function, given), given)(*given):
        assert_close(found, A @ B, rtol=1e-12, atol=1e-12)


def test_each_operation_has_its_place_in_the_kernel():
    listed = re.search(r"INSTRUCTIONS\[\] = \{(.*?)\n\};", SOURCE.read_text(), re.S)
    assert listed is not None
    names = [line.strip().rstrip(",") for line in listed[1].strip().splitlines()]
    assert names.pop() == "ELEMENTWISE"
    assert len(names) == len(OPERATIONS)
    spoken = {"reduce_maximum": "Of_maximum", "product_with_packed": "product_with_packed", "active_set": "active_set"}
    for name, in_c in spoken.items():
        assert in_c in names[OPERATIONS.index(name)]


def test_a_rule_that_is_wrong_is_found(monkeypatch):
    monkeypatch.setitem(rules.RULES, "add", rules.RULES["mul"])
    with pytest.raises(NotImplementedError, match="another result than torch's"):
        NumberKernel(trace(lambda x, y: (x + y,), pair()), pair())


def test_what_has_no_rule_is_named():
    with pytest.raises(NotImplementedError, match=r"aten\.sort"):
        NumberKernel(trace(lambda x, y: (x.sort(-1).values,), pair()), pair())


def test_indices_that_depend_on_arguments_are_refused():
    with pytest.raises(NotImplementedError, match="indices that depend on arguments"):
        NumberKernel(trace(lambda x, y: (x.mT[y.argmax(-1)],), pair()), pair())


def test_products_with_parts_of_one_matrix_have_panels_of_their_own():
    W = torch.randn(7, 40, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    x, _ = pair()

    def function(x, W):
        return x @ W[:, :16], x @ W, x[:, :3] @ W[:3]

    kernel = NumberKernel(trace(function, (0 * x, W)), (0 * x, W))
    for found, expected in zip(kernel(x, W), function(x, W), strict=True):
        assert_close(found, expected, rtol=1e-12, atol=1e-12)


def test_assignments_in_place_compute_what_torch_computes():
    def function(x, y):
        z = torch.zeros_like(x)
        z[..., 0] = x[..., 1]
        z[..., 1:3] = y[..., 1:3] ** 3
        return z, (-0.3 * x.sign()).long().to(x.dtype).reciprocal(), torch.atan2(-0.0 * x.abs(), -1 - y**2)

    for found, expected in zip(NumberKernel(trace(function, pair()), pair())(*pair()), function(*pair()), strict=True):
        assert_close(found, expected)


@pytest.mark.parametrize(
    "function",
    [
        lambda x, y: ((((x > 0).long() & 3) * x),),
        lambda x, y: (x.round(decimals=1),),
        lambda x, y: (torch.div(x, y, rounding_mode="floor"),),
    ],
)
def test_what_would_be_another_number_is_refused(function):
    with pytest.raises(NotImplementedError):
        NumberKernel(trace(function, pair()), pair())


def test_an_empty_batch_is_no_scan():
    prepare, _, (W, t, dt, x0) = scan_of()
    empty = trace(
        lambda W, t, dt, x, double, total: (x + dt * x @ double, x * total), (W, t[0], dt[0], x0[:0], *prepare(W))
    )
    with pytest.raises(NotImplementedError, match="empty batch"):
        ScanKernel(prepare, empty, (W, t, dt, x0[:0]))


def test_integers_are_held_to_what_they_were():
    places = torch.tensor([2, 0])
    kernel = NumberKernel(trace(lambda i, x, y: (x[:, i] * y[:, :2],), (places, *pair())), (places, *pair()))
    x, y = pair()
    assert_close(kernel(places, x, y)[0], x[:, places] * y[:, :2])
    with pytest.raises(ValueError, match="int64 values of the examples"):
        kernel(places + 1, x, y)


def test_arguments_of_other_shapes_are_refused():
    x, y = pair()
    with pytest.raises(ValueError, match=r"Expected arguments \[\(5, 7\), \(5, 7\)\], got \[\(3, 7\)"):
        NumberKernel(trace(lambda x, y: (x + y,), (x, y)), (x, y))(x[:3], y)
    prepare, step, (W, t, dt, x0) = scan_of()
    with pytest.raises(ValueError, match=r"Expected arguments .* got"):
        ScanKernel(prepare, step, (W, t, dt, x0))(W, t, dt[:5], x0)


def test_kernels_may_run_in_several_threads():
    kernel = NumberKernel(trace(OPERATORS["mixed"], pair()), pair())
    inputs = [(pair()[0] + k, pair()[1]) for k in range(200)]
    with ThreadPoolExecutor(4) as pool:
        for given, found in zip(inputs, pool.map(lambda given: kernel(*given), inputs), strict=True):
            assert_close(found[0], OPERATORS["mixed"](*given)[0])


def test_parts_run_at_once_on_as_many_threads_as_torch_has(monkeypatch):
    monkeypatch.setattr("lyapnet.base.threads._of_programs", 3)
    at_once = Barrier(3, timeout=60)

    def run(k):
        if k < 3:
            at_once.wait()  # would fail if one thread ran them in turn
        return kernel(pair()[0] + k, pair()[1])[0]

    kernel = NumberKernel(trace(OPERATORS["mixed"], pair()), pair())
    for k, found in enumerate(in_threads(run, range(50))):
        assert_close(found, OPERATORS["mixed"](pair()[0] + k, pair()[1])[0])


def test_memory_is_shared_by_what_is_not_alive_at_once():
    def function(x, y):
        for k in range(40):
            x = torch.sin(x + k) @ y.mT @ y / 50
        return (x,)

    graph = trace(function, pair())
    kernel = NumberKernel(graph, pair())
    assert len(kernel._program._idle[0].arena) < 40 * 35
    assert_close(kernel(*pair())[0], function(*pair())[0], rtol=1e-9, atol=1e-9)


def scan_of(steps=6):
    """W, x ↦ x + Δt tanh(2W x) step by step, with what all steps share: the graphs, and arguments."""
    generator = torch.Generator().manual_seed(1)
    W, x0 = (torch.randn(*shape, generator=generator, dtype=torch.float64) for shape in ((3, 3), (4, 3)))
    t, dt = torch.arange(steps).double(), torch.linspace(0.1, 0.3, steps).double()
    prepare = trace(lambda W: ((2 * W).mT, W.sum()), (W,))

    def step(W, t, dt, x, double, total):
        return x + dt * torch.tanh(x @ double), x * total, torch.stack([x.sum(-1) * t, x[:, 0]], -1)

    return prepare, trace(step, (W, t[0], dt[0], x0, *prepare(W))), [W, t, dt, x0]


def test_a_scan_computes_what_its_loop_does():
    prepare, step, arguments = scan_of()
    kernel = ScanKernel(prepare, step, arguments)
    W, t, dt, x0 = arguments
    for given in (arguments, [W / 3, t + 1, dt / 2, 1 - x0]):
        for found, expected in zip(kernel(*given), Scan(prepare, step, 1).loop(*given), strict=True):
            assert_close(found, expected, rtol=1e-12, atol=1e-12)
    assert len(kernel._program.shared) > 0, "what all steps share is computed once"
    one = ScanKernel(*scan_of(1))
    assert_close(one(*scan_of(1)[2])[0], Scan(*scan_of(1)[:2], 1).loop(*scan_of(1)[2])[0])
    for found, expected in zip(one(*arguments), kernel(*arguments), strict=True):
        assert_close(found, expected, rtol=0, atol=0)  # more steps than in the examples


def test_sums_over_the_steps_are_those_of_what_is_kept():
    prepare, step, arguments = scan_of()
    kept, expected = ScanKernel(prepare, step, arguments)(*arguments)
    summing = ScanKernel(prepare, step, arguments, sums=1)
    for _ in range(2):  # from zero at each call
        again, total = summing(*arguments)
        assert_close(again, kept, rtol=0, atol=0)
        assert_close(total, expected.sum(0), rtol=1e-12, atol=1e-12)


TASK = {
    "experiment": "closed_loop",
    "system": {"name": "pendulum"},
    "cost": {"Q": [1, 0.1], "R": [0.1], "Q_T": [5, 1]},
    "controls": {"lower": -2, "upper": 2},
    "initial_states": {"lower": [-1, -1], "upper": [1, 1]},
    "horizon": {"steps": 30, "dt": 0.05},
    "program": {"name": "value"},
    "network": {"name": "fcn", "hidden": [8, 8]},
    "rollout": {"gradient": "discrete"},
    "training": {"iterations": 1, "batch_size": 3},
    "evaluation": {"validation_states": 2, "test_states": 2, "animate": False},
}


def rollout_of(*overrides):
    problem, _, _, rollout = objects(config_from_plain(TASK, overrides))
    return rollout, problem


def gradient_of(rollout, x0):
    rollout.zero_grad()
    trajectory = rollout(x0)
    (trajectory.cost.mean() + trajectory.value[0].mean()).backward()
    return [p.grad.clone() for p in rollout.parameters() if p.grad is not None]


@pytest.mark.gate
@pytest.mark.parametrize(
    ("law", "changed"),
    [
        ("sampled", []),
        ("hjb", []),
        ("lookahead", []),
        ("hjb", ["rollout.method=rk4"]),
        *(("sampled", ["rollout.costate_limit=1.01", f"horizon.steps={steps}"]) for steps in (28, 30, 31)),
    ],
)
def test_closed_loops_and_their_gradient(law, changed):
    rollout, problem = rollout_of(f"rollout.policy={law}", *changed)
    x0 = problem.initial_states.sample(12)
    others = problem.initial_states.sample(31)
    written, plain = gradient_of(rollout, x0), rollout(others)
    assert rollout.discrete is not None
    rollout.discrete.compile(x0)
    again = gradient_of(rollout, x0)
    scale = max(float(g.abs().max()) for g in written)
    assert max(float((a - b).abs().max()) for a, b in zip(again, written, strict=True)) < 1e-8 * scale
    if rollout.discrete.costate_limit is not None:
        without, _ = rollout_of(f"rollout.policy={law}", *changed, "rollout.costate_limit=null")
        without.load_state_dict(rollout.state_dict())
        exact = gradient_of(without, x0)
        assert max(float((a - b).abs().max()) for a, b in zip(again, exact, strict=True)) > 1e-3 * scale, (
            "some were cut"
        )
    with torch.no_grad():
        assert_close(rollout(others).x, plain.x, rtol=1e-9, atol=1e-9)
        for parameter in rollout.parameters():
            parameter.mul_(1.1)
        assert float((rollout(others).x - plain.x).abs().max()) > 1e-6, "the counterpart: weights are read at each call"


def freeze(*parameters):
    for parameter in parameters:
        parameter.requires_grad_(False)


@pytest.mark.parametrize(
    ("overrides", "change", "shared"),
    sample(
        [
            ([], lambda loop: None, True),
            ([], lambda loop: freeze(*loop.parameters()), True),
            ([], lambda loop: freeze(next(loop.parameters())), False),
            (["cost.R=[0.2]"], lambda loop: None, True),
            (["system.parameters.length=0.8"], lambda loop: None, False),
            (["rollout.policy=sampled"], lambda loop: None, False),
            (["network.hidden=[8]"], lambda loop: None, False),
            (["rollout.method=rk4"], lambda loop: None, False),
            (["rollout.costate_limit=5"], lambda loop: None, False),
        ],
        3,
    ),
)
def test_a_loop_takes_the_code_of_one_that_differs_in_tensors_alone(overrides, change, shared):
    (rollout, problem), (other, _) = rollout_of(), rollout_of(*overrides)
    x0 = problem.initial_states.sample(12)
    rollout.discrete.compile(x0)
    with torch.no_grad():
        for parameter in other.parameters():
            parameter.mul_(1.1)
    change(other.discrete.loop)
    assert other.discrete.share_code(rollout.discrete, problem.initial_states.sample(12)) is shared
    written = Rollout(other.problem, other.closed_loop.policy, gradient="backprop")
    with torch.no_grad():
        for start in (x0, 0.5 * x0[:5]):
            assert_close(other(start).x, written(start).x, rtol=1e-9, atol=1e-9)
        assert float((rollout(x0).x - other(x0).x).abs().max()) > 1e-6, "the counterpart: they are two loops"


class Walled(Pendulum):
    """A system with a spring that acts only far from the centre, and a wind; both are plain numbers."""

    stiffness, wind = 0.0, 0.0

    def forces(self, q, qdot):
        return super().forces(q, qdot) + self.stiffness * (q.abs() - 0.7).clamp(min=0) + self.wind


class Timed(FCN):
    """A function with a number that matters only late."""

    late = 0.0

    def forward(self, t, x):
        return super().forward(t, x) + self.late * (t - 1.2).clamp(min=0) * x.sum(-1)

    value_and_state_gradient = ValueFunction.value_and_state_gradient


@pytest.mark.parametrize("change", sample(["nothing", "stiffness", "wind", "late"], 2))
def test_code_is_held_against_a_loop_far_from_the_centre_and_late(change, monkeypatch):
    monkeypatch.setitem(SYSTEMS, "pendulum", Walled)
    monkeypatch.setitem(NETWORKS, "fcn", Timed)
    (rollout, problem), (other, _) = rollout_of(), rollout_of()
    rollout.discrete.compile(problem.initial_states.center.expand(12, -1).contiguous())
    if change == "late":
        other.closed_loop.V.late = 3.0
    elif change != "nothing":
        setattr(other.problem.system, change, 3.0)
    x0 = problem.initial_states.sample(12, torch.Generator().manual_seed(0))
    assert other.discrete.share_code(rollout.discrete, x0) is (change == "nothing")


def test_of_shared_code_what_is_trained_here_has_a_gradient():
    (rollout, problem), (other, _) = rollout_of(), rollout_of()
    x0 = problem.initial_states.sample(12)
    rollout.discrete.compile(x0)
    freeze(*other.parameters())
    assert other.discrete.share_code(rollout.discrete, x0)
    written = Rollout(other.problem, other.closed_loop.policy, gradient="backprop")
    slopes = []
    for each in (other, written):
        leaf = x0.clone().requires_grad_()
        slopes += torch.autograd.grad(each(leaf).cost.sum(), leaf)
    assert_close(*slopes, rtol=1e-9, atol=1e-9)


class Sorting(FCN):
    """A network with an operation that the kernel does not have."""

    def forward(self, t, x):
        return super().forward(t, x.sort(-1).values)

    value_and_state_gradient = ValueFunction.value_and_state_gradient


@pytest.mark.gate
def test_a_run_whose_loop_has_an_operation_without_a_rule_says_which_and_goes_on(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(NETWORKS, "fcn", Sorting)
    monkeypatch.setattr("lyapnet.training.figure_logger.figures_of", lambda learner: {})
    run = lyapnet.train({**TASK, "logs": str(tmp_path)})
    said = capsys.readouterr().out
    assert said.count("Expected operations that the kernel has, got aten.sort.default; running without") == 1
    assert run.best.is_file()
    assert run.compiled is False
