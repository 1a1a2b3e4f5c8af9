"""The discrete costate: its gradient against backpropagation, differences, restarts and the Riccati equation."""

import copy
from functools import partial

import numpy as np
import pytest
import torch
from torch import nn
from torch.autograd.graph import saved_tensors_hooks
from torch.testing import assert_close

from lyapnet.base.errors import UsageError
from lyapnet.evaluation.oracles import discrete_riccati
from lyapnet.graphs.compilation import has_compiler
from lyapnet.graphs.number_kernel.kernel import ScanKernel
from lyapnet.loop.programs import LyapunovProgram, ValueProgram
from lyapnet.loop.rollout import FIXED_STEP_METHODS, Rollout, backwards, discrete_adjoint, routines
from lyapnet.loop.rollout.runge_kutta import Linearise
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.horizon import Horizon
from lyapnet.task.systems import ControlAffineSystem
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.networks import ACTIVATIONS, FCN, NETWORKS, Scaling
from lyapnet.value.networks.anchored import TerminalAnchor
from lyapnet.value.policy import POLICIES, HJBPolicy
from tests.marks import sample
from tests.problems import AFFINE, KINDS, problem_of, with_expansion

EXACT = 1e-10  # relative, of what differs by rounding alone
HORIZON = Horizon(6, 0.05)
OUTPUTS = ("x", "running_cost", "value", "terminal_cost")
double_integrator = pytest.mark.parametrize("system", ["double_integrator"], indirect=True)
methods = pytest.mark.parametrize("method", FIXED_STEP_METHODS)
in_trace = pytest.mark.parametrize("traced", [True], ids=["traced"])
in_both_forms = pytest.mark.parametrize("traced", [False, True], ids=["as written", "traced"])
in_either_form = pytest.mark.parametrize("traced", [None], ids=["in either form"])


def routes(system, cost, policy, method="euler", horizon=HORIZON):
    """The same rollout twice: with the discrete costate, and by backpropagation."""
    problem = problem_of(system, cost, horizon.steps, horizon.dt)
    return [Rollout(problem, policy, method, gradient) for gradient in ("discrete", "backprop")]


def weighted(trajectory, without=None):
    """The sum of all outputs with a gradient, each entry with a random weight that is always the same."""
    generator, total = torch.Generator().manual_seed(1), 0.0
    for name in OUTPUTS:
        output = getattr(trajectory, name)
        if output is not None:
            weight = torch.randn(output.shape, generator=generator, dtype=torch.float64).to(output)
            total = total + (name != without) * (weight * output).sum()
    return total


def slopes(rollout, x0, of=weighted):
    """The gradient in x₀ and in every trained parameter."""
    leaf = x0.clone().requires_grad_()
    leaves = [leaf, *(p for p in rollout.parameters() if p.requires_grad)]
    return torch.autograd.grad(of(rollout(leaf)), leaves, allow_unused=True, materialize_grads=True)


def error(gradient, expected):
    """The largest relative error of the gradient in one tensor."""
    pairs = zip(gradient, expected, strict=True)
    return max(float((a.double() - b).norm() / b.norm().clamp(min=1e-9)) for a, b in pairs)


def is_exact(rollouts, x0, of=weighted):
    discrete, backprop = rollouts
    assert error(slopes(discrete, x0, of), slopes(backprop, x0, of)) < EXACT


# Every output, system, method, program, control law and network


@pytest.mark.parametrize(
    ("system", "method", "traced"),
    sample(
        [
            *((system, "euler", False) for system in AFFINE),
            *(
                pytest.param(system, "euler", True, marks=() if system in KINDS else pytest.mark.gate)
                for system in AFFINE
            ),
            *((system, method, False) for system in KINDS for method in FIXED_STEP_METHODS if method != "euler"),
        ],
        4,
    ),
    indirect=["system"],
)
def test_gradient_of_every_output_is_that_of_backpropagation(system, cost, policy, x0, method):
    discrete, backprop = routes(system, cost, policy, method)
    expected = slopes(backprop, x0)
    assert error(slopes(discrete, x0), expected) < EXACT
    for name in OUTPUTS:
        assert error(slopes(discrete, x0, partial(weighted, without=name)), expected) > 1e-3


@pytest.mark.gate
@in_trace
@pytest.mark.parametrize("method", sample(FIXED_STEP_METHODS, 3))
@pytest.mark.parametrize("system", ["cartpole"], indirect=True)
def test_many_states_are_pulled_back_step_by_step(system, cost, policy, x0, method, traced, monkeypatch):
    """Jacobians of a block have n + m products each; above MOST_STATES_OF_BLOCKS none is computed."""
    discrete, backprop = routes(system, cost, policy, method)
    monkeypatch.setattr(routines, "MOST_STATES_OF_BLOCKS", system.n - 1)
    monkeypatch.setattr(Linearise, "linearise", None)
    assert error(slopes(discrete, x0), slopes(backprop, x0)) < EXACT
    monkeypatch.setattr(routines, "MOST_STATES_OF_BLOCKS", system.n)
    with pytest.raises(pytest.fail.Exception, match="NoneType"):  # the counterpart
        Rollout(discrete.problem, policy, method, "discrete").discrete._work(x0).traced()


WRONG = {  # the linearised loop, with one of its pieces changed
    "transition": lambda y: y.mT,
    "source": torch.zeros_like,
    "f_x": lambda y: 1.01 * y,
    "cost_x": lambda y: 1.01 * y,
    "f_u": lambda y: 1.01 * y,
    "cost_u": lambda y: 1.01 * y,
}


@double_integrator
@pytest.mark.parametrize("piece", WRONG)
def test_every_piece_of_the_linearisation_counts(piece, monkeypatch, system, cost, policy, x0):
    discrete, backprop = routes(system, cost, policy, "midpoint")
    linearise = Linearise.linearise

    def wrong(*arguments):
        linearisation = linearise(*arguments)
        return linearisation._replace(**{piece: WRONG[piece](getattr(linearisation, piece))})

    monkeypatch.setattr(Linearise, "linearise", wrong)
    assert error(slopes(discrete, x0), slopes(backprop, x0)) > 1e-6


@double_integrator
def test_gradient_against_finite_differences(system, cost):
    V = FCN(Scaling([1.0] * system.n, duration=1.0, value=3.0), hidden=(2,))
    x0, problem = (0.5 * torch.randn(system.n)).requires_grad_(), problem_of(system, cost, 2, 0.1)

    def is_right(gradient):
        rollout = Rollout(problem, HJBPolicy(problem, V), "midpoint", gradient)

        def outputs(leaf, *parameters):  # which are V's own, changed in place
            return [getattr(rollout(leaf), name) for name in OUTPUTS]

        return torch.autograd.gradcheck(outputs, (x0, *V.parameters()), raise_exception=False)

    assert is_right("discrete")
    assert not is_right("adjoint")


PROGRAMS = [
    program(2.0, 3.0, 5.0, normalise)
    for program in (
        ValueProgram,
        partial(ValueProgram, cost_to_go=7.0),
        LyapunovProgram,
        partial(LyapunovProgram, margin=0.5, bound=1.0),
    )
    for normalise in (True, False)
]


def test_gradient_of_every_program_is_that_of_backpropagation(system, cost, policy, x0):
    losses = [lambda trajectory, p=program: p(trajectory).loss for program in PROGRAMS]
    discrete, backprop = ([slopes(route, x0, loss) for loss in losses] for route in routes(system, cost, policy))
    for gradient, expected, other in zip(discrete, backprop, backprop[1:] + backprop[:1], strict=True):
        assert error(gradient, expected) < EXACT
        assert error(gradient, other) > 1e-4


SCALING = Scaling((1.0, 2.0), HORIZON.duration, 3.0)


class WithoutFormula(ValueFunction):
    """A network as a user writes it: V alone, differentiated by autograd."""

    def __init__(self, network):
        super().__init__()
        self.network = network

    def forward(self, t, x):
        return self.network(t, x)


VALUES = {
    **{name: lambda cost, cls=cls: with_expansion(cls(SCALING, hidden=(5, 4))) for name, cls in NETWORKS.items()},
    **{f"fcn, {name}": lambda cost, name=name: FCN(SCALING, (5,), activation=name) for name in ACTIVATIONS},
    "angles": lambda cost: FCN(SCALING, (5,), embedded_angles=(0,)),
    "terminal": lambda cost: TerminalAnchor(FCN(SCALING, (5,)), cost, HORIZON.duration),
    "user": lambda cost: WithoutFormula(FCN(SCALING, (5, 4))),
}
IN_TRACE = {"anchored": "hjb", "fcn": "sontag", "expansion": "sampled", "angles": "lookahead"}


@double_integrator
@pytest.mark.parametrize(
    ("value", "law", "traced"),
    sample(
        [*((value, law, False) for value in VALUES for law in POLICIES), *((*pair, True) for pair in IN_TRACE.items())],
        7,
    ),
)
def test_every_network_under_every_control_law(value, law, system, cost, x0):
    V = VALUES[value](cost)
    by_law = {name: routes(system, cost, policy(problem_of(system, cost), V)) for name, policy in POLICIES.items()}
    is_exact(by_law[law], x0)
    slopes_of = {name: slopes(backprop, x0) for name, (_, backprop) in by_law.items()}
    for name, other in slopes_of.items():
        apart = 1e-4 if "lookahead" in (law, name) else 1e-3  # it is close to others where V is nearly quadratic
        assert name == law or error(slopes_of[law], other) > apart


def test_gradient_by_formula_and_by_autograd_are_the_same(system, cost, V, x0):
    problem = problem_of(system, cost)
    (formula, _), (autograd, _) = (routes(system, cost, HJBPolicy(problem, v)) for v in (V, WithoutFormula(V)))
    assert error(slopes(formula, x0), slopes(autograd, x0)) < EXACT


def test_quadratic_value_function(system, cost, quadratic, x0):
    P = torch.eye(system.n) + torch.rand(HORIZON.steps + 1, 1, 1)
    is_exact(routes(system, cost, HJBPolicy(problem_of(system, cost), quadratic(P, HORIZON.dt))), x0)


class Saturated(HJBPolicy):
    """A law of a user's, made from another."""

    def forward(self, t, x):
        return torch.tanh(super().forward(t, x))


@double_integrator
def test_a_law_that_changes_another_is_followed(system, cost, V, policy, x0):
    saturated = Saturated(problem_of(system, cost), V)
    assert error(slopes(routes(system, cost, saturated)[1], x0), slopes(routes(system, cost, policy)[1], x0)) > 1e-6
    is_exact(routes(system, cost, saturated), x0)


# Laws that no V defines


class Feedback(nn.Module):
    """u = −Kx, with K (m, n) or, at the nodes t = nΔt, K (N, m, n)."""

    def __init__(self, K, dt=1.0):
        super().__init__()
        self.K, self.dt = nn.Parameter(K if K.ndim == 3 else K[None]), dt

    def forward(self, t, x):
        K = self.K[(t / self.dt).round().long().clamp(0, len(self.K) - 1)]
        return -(K @ x[..., None])[..., 0]


class Push(nn.Module):
    """u = p, wherever the state is."""

    def __init__(self, m):
        super().__init__()
        self.p = nn.Parameter(torch.linspace(1, 2, m))

    def forward(self, t, x):
        return self.p.expand(*x.shape[:-1], len(self.p))


class Sweep(nn.Module):
    """A sine of time alone, without parameters."""

    def __init__(self, m):
        super().__init__()
        self.m = m

    def forward(self, t, x):
        return torch.sin(20 * t)[..., None].expand(*x.shape[:-1], self.m)


LAWS = {
    "feedback": lambda s: Feedback(torch.ones(s.m, s.n)),
    "push": lambda s: Push(s.m),
    "sweep": lambda s: Sweep(s.m),
}


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_a_law_without_V(law, system, cost, x0):
    discrete, backprop = routes(system, cost, law(system))
    assert discrete(x0).value is backprop(x0).value is None
    is_exact((discrete, backprop), x0)
    gradient = slopes(discrete, x0)
    assert all(g.abs().max() > 0 for g in gradient)
    assert error(gradient, slopes(discrete, x0 + 1e-3)) > 1e-6


# Batches, blocks, precision


@double_integrator
@pytest.mark.parametrize("batch", [(), (1,), (3,), (2, 3)], ids=str)
def test_any_batch(batch, system, cost, policy):
    x0 = torch.randn(*batch, system.n)
    rollouts = routes(system, cost, policy, "rk4")
    is_exact(rollouts, x0)
    last = slopes(rollouts[1], x0.reshape(-1, system.n)[-1:], lambda trajectory: trajectory.cost.sum())
    every = slopes(rollouts[0], x0, lambda trajectory: trajectory.cost.sum())
    assert error([every[0].reshape(-1, system.n)[-1:]], last[:1]) < EXACT
    assert (error(every[1:], last[1:]) < EXACT) is (x0.numel() == system.n)


@double_integrator
@pytest.mark.parametrize("batch", [(0,), (0, 3)], ids=str)
def test_an_empty_batch_has_no_gradient(batch, system, cost, policy):
    rollouts = routes(system, cost, policy)
    for rollout in rollouts:
        assert rollout(torch.zeros(*batch, system.n)).cost.shape == batch
        assert not any(slope.any() for slope in slopes(rollout, torch.zeros(*batch, system.n)))
    is_exact(rollouts, torch.zeros(1, system.n))


@double_integrator
@in_both_forms
def test_batches_of_two_sizes_in_turn(system, cost, policy):
    rollouts = routes(system, cost, policy)
    for size in (3, 2, 3):
        is_exact(rollouts, torch.randn(size, system.n))


@in_trace
@double_integrator
@pytest.mark.skipif(not has_compiler(), reason="no C++ compiler")
def test_a_compiled_batch_in_parts_has_the_same_gradient_on_any_number_of_threads(system, cost, policy, monkeypatch):
    rollouts, x0 = routes(system, cost, policy), torch.randn(32, system.n)
    rollouts[0].discrete.compile(x0)
    kept = rollouts[0].discrete.routines(x0)
    sizes, integrate = set(), ScanKernel.__call__
    monkeypatch.setattr(ScanKernel, "__call__", lambda *a: sizes.add(len(a[-1])) or integrate(*a))
    found = []
    for threads in (1, 2):
        monkeypatch.setattr("lyapnet.base.threads._of_programs", threads)
        is_exact(rollouts, x0)
        found.append([*slopes(rollouts[0], x0), rollouts[0](x0).cost.detach()])
    assert sizes == {16}
    assert all(map(torch.equal, *found))
    assert rollouts[0].discrete.routines(x0) is kept


@in_trace
@double_integrator
@pytest.mark.skipif(not has_compiler(), reason="no C++ compiler")
def test_a_batch_whose_costates_are_limited_is_one_part(system, cost, policy, monkeypatch):
    """The limit is relative to the median of the whole batch."""
    x0, found = torch.randn(32, system.n), []
    problem = problem_of(system, cost, HORIZON.steps, HORIZON.dt)
    for compiled in (True, False):
        rollout = Rollout(problem, policy, "euler", "discrete", costate_limit=1.1)
        if compiled:
            rollout.discrete.compile(x0)
        found.append(slopes(rollout, x0))
    assert error(*found) < EXACT
    divided = Rollout(problem, policy, "euler", "discrete", costate_limit=1.1)
    parts = routines.in_parts(divided.discrete._work(x0[:16]).compiled(), 16)
    monkeypatch.setattr(divided.discrete, "routines", lambda _: parts)
    assert error(slopes(divided, x0), found[1]) > 1e-6


@double_integrator
@pytest.mark.parametrize(
    ("method", "block", "traced"),
    [*((method, block, False) for method in FIXED_STEP_METHODS for block in (1, 7, 64)), ("rk4", 64, True)],
)
def test_blocks_and_their_padding_change_no_number(block, method, monkeypatch, system, cost, policy):
    horizon, x0 = Horizon(12, 0.05), torch.randn(2, system.n)
    monkeypatch.setattr(discrete_adjoint, "STATES_PER_BLOCK", block)
    is_exact(routes(system, cost, policy, method, horizon), x0)


@double_integrator
def test_padding_with_anything_but_zeros_would(monkeypatch, system, cost, policy):
    """The twin: thirteen nodes in blocks of seven states, three or four nodes each, leave something to pad."""
    discrete, backprop = routes(system, cost, policy, horizon=Horizon(12, 0.05))
    x0 = torch.randn(2, system.n)
    monkeypatch.setattr(discrete_adjoint, "STATES_PER_BLOCK", 7)
    monkeypatch.setattr(
        backwards, "padded", lambda y, length: torch.cat([y, y.new_ones(length - len(y), *y.shape[1:])])
    )
    assert error(slopes(discrete, x0), slopes(backprop, x0)) > 1e-3


@pytest.mark.parametrize(
    ("system", "traced"), [*((s, False) for s in AFFINE), ("double_integrator", True)], indirect=["system"]
)
def test_single_precision_stays_and_agrees(system, cost, policy, x0):
    discrete, backprop = routes(system, cost, policy)
    expected = slopes(backprop, x0)
    gradient = slopes(discrete.float(), x0.float())
    assert {g.dtype for g in gradient} == {torch.float32}
    assert 1e-9 < error(gradient, expected) < 1e-4


# Systems of users


class Pendulum(ControlAffineSystem):
    """The README's."""

    state_names, state_units = ("angle", "rate"), ("rad", "rad/s")
    control_names, control_units = ("torque",), ("N·m",)
    calls = 0  # of f, in Python

    def f(self, x):
        self.calls += 1
        return torch.stack([x[..., 1], 9.81 * torch.sin(x[..., 0])], -1)

    def g(self, x):
        return torch.tensor([[0.0], [4.0]]).to(x).expand(*x.shape[:-1], 2, 1)


class Branching(Pendulum):
    """Control flow that depends on tensor values: a spring that yields, looked at where a state is to see it."""

    def f(self, x):
        stretch = x[..., :1]
        if float(stretch.detach().abs().max()) > 0.5:
            stretch = 0.5 * torch.tanh(2 * stretch)
            return super().f(x) - torch.where(x[..., :1].abs() > 0.5, stretch, x[..., :1])
        return super().f(x) - stretch


class InPlace(Pendulum):
    """Arrays that are filled entry by entry."""

    def f(self, x):
        drift, friction = torch.zeros_like(x), torch.zeros_like(x)
        drift[..., 0] = x[..., 1]
        drift[..., 1] = 9.81 * torch.sin(x[..., 0])
        friction[..., 1] = x[..., 1] ** 2
        return super().f(x) + drift - 2 * friction

    def g(self, x):
        g = torch.zeros(*x.shape, 1).to(x)
        g[..., 1, 0] = 4.0 + x[..., 0] ** 2
        return g


class Adjustable(Pendulum):
    """A physical parameter that is trained too."""

    def __init__(self):
        super().__init__()
        self.stiffness = nn.Parameter(torch.tensor(2.0))

    def f(self, x):
        return super().f(x) - self.stiffness * torch.stack([torch.zeros_like(x[..., 0]), x[..., 0] ** 3], -1)


class OwnNetwork(ValueFunction):
    """A user's V, with a buffer."""

    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.eye(2) + 0.5)
        self.register_buffer("shift", torch.ones(2))

    def forward(self, t, x):
        return torch.log1p(((x @ self.weight) ** 2).sum(-1)) + torch.cos(t) * torch.tanh(x @ self.shift)


@pytest.fixture
def pendulum_routes():
    def build(system):
        cost = QuadraticCost(torch.eye(2), [[1.0]], torch.eye(2))
        return routes(system, cost, HJBPolicy(problem_of(system, cost), OwnNetwork()), "midpoint")

    return build


class LeavesTorch(Pendulum):
    """A drag that NumPy computes, and that backpropagation therefore takes for a constant."""

    def f(self, x):
        drag = 0.3 * np.tanh(x.detach().numpy()[..., 1])
        return super().f(x) - torch.stack([torch.zeros_like(x[..., 0]), torch.from_numpy(drag)], -1)


class Masked(Pendulum):
    """A stop that is set where a mask says."""

    def f(self, x):
        drift = super().f(x)
        beyond = x[..., 0] > 0.5
        drift[..., 1][beyond] = drift[..., 1][beyond] - 5 * (x[..., 0][beyond] - 0.5)
        return drift


USERS = [Pendulum, Branching, InPlace, Adjustable, LeavesTorch, Masked]


@pytest.mark.parametrize(
    ("system", "traced"),
    [*((system, False) for system in USERS), (InPlace, True), *((s, None) for s in (Branching, LeavesTorch, Masked))],
)
def test_systems_of_users(system, pendulum_routes):
    x0 = torch.tensor([[0.1, 0.2], [0.6, -0.3], [-1.0, 1.0]])
    rollouts = pendulum_routes(system())
    is_exact(rollouts, x0)
    if system is not Pendulum:
        plain = pendulum_routes(Pendulum())[1]
        assert error(slopes(rollouts[0], x0)[:1], slopes(plain, x0)[:1]) > 1e-3


@in_either_form
@pytest.mark.parametrize(("build", "once"), [(Pendulum, True), (Branching, False)])
def test_python_runs_once_unless_the_course_depends_on_values(build, once, pendulum_routes):
    system, x0 = build(), torch.randn(3, 2)
    rollouts = pendulum_routes(system)
    is_exact(rollouts, x0)
    calls = system.calls
    slopes(rollouts[0], x0)
    assert (system.calls == calls) is once


@in_either_form
@pytest.mark.parametrize(
    ("build", "named"), [(Pendulum, None), (LeavesTorch, "reads the values"), (Branching, "reads the values")]
)
def test_why_a_loop_runs_as_it_is_written_is_logged_once(build, named, pendulum_routes, caplog):
    discrete, _ = pendulum_routes(build())
    for batch in (3, 3, 5):
        discrete(torch.randn(batch, 2)).cost.sum().backward()
    messages = [record.getMessage() for record in caplog.records if record.name.startswith("lyapnet")]
    assert len(messages) == (named is not None)
    assert all(named in message and "runs without being traced" in message for message in messages)


@in_either_form
def test_dropout_in_v_is_refused(pendulum_routes):
    discrete, backprop = pendulum_routes(Pendulum())
    for rollout in (discrete, backprop):
        V = rollout.closed_loop.policy.V
        rollout.closed_loop.policy.V = Dropping(V)
    backprop(torch.randn(3, 2)).cost.sum().backward()
    with pytest.raises(UsageError, match="without random numbers"):
        discrete(torch.randn(3, 2))
    discrete.eval()
    is_exact([discrete, backprop.eval()], torch.randn(3, 2))


class Dropping(ValueFunction):
    """A V of which units are left out at random."""

    def __init__(self, V):
        super().__init__()
        self.V, self.dropout = V, nn.Dropout(0.2)

    def forward(self, t, x):
        return self.dropout(self.V(t, x)[..., None])[..., 0]


@in_either_form
@pytest.mark.parametrize("build", [Pendulum, Branching])
def test_grad_mode_is_left_as_it_was(build, pendulum_routes):
    discrete, _ = pendulum_routes(build())
    x0 = torch.randn(3, 2)
    for recording in (False, True, False):
        with torch.set_grad_enabled(recording):
            trajectory = discrete(x0)
            assert torch.is_grad_enabled() is recording
            assert trajectory.cost.requires_grad is trajectory.value.requires_grad is recording
            if recording:
                trajectory.cost.sum().backward()
                assert torch.is_grad_enabled()
        assert torch.is_grad_enabled()
        assert not trajectory.u.requires_grad


# What changes between two rollouts, and what may not change in between


def changes(rollouts, x0, change):
    """The gradient is exact before and after the change, and another one."""
    is_exact(rollouts, x0)
    before = slopes(rollouts[0], x0)
    change()
    is_exact(rollouts, x0)
    assert error(slopes(rollouts[0], x0)[:1], before[:1]) > 1e-6


@double_integrator
@in_both_forms
def test_parameters_and_buffers_are_read_at_every_rollout(system, cost, policy, x0):
    rollouts = routes(system, cost, policy)
    optimiser = torch.optim.Adam(policy.parameters(), 0.1)

    def step():
        rollouts[0](x0).cost.mean().backward()
        optimiser.step()

    changes(rollouts, x0, step)
    changes(rollouts, x0, lambda: system.A.mul_(1.5))
    changes(rollouts, x0, lambda: setattr(system, "B", 2 * system.B))


@pytest.mark.gate
@double_integrator
@in_both_forms
def test_frozen_parameters_get_no_gradient(system, cost, V, policy, x0):
    """All of V, none of it or one layer, frozen before the first rollout and changed between two."""
    rollouts = routes(system, cost, policy)
    for frozen in (V, nn.ModuleList(), V.hidden[0]):
        V.requires_grad_(True)
        frozen.requires_grad_(False)
        is_exact(rollouts, x0)
        assert rollouts[0](x0).cost.requires_grad is (frozen is not V)
        assert len(slopes(rollouts[0], x0)) == 1 + sum(p.requires_grad for p in V.parameters())


@double_integrator
@pytest.mark.parametrize("change", [lambda V, system: V.output.weight.mul_(1.1), lambda V, system: system.A.mul_(1.1)])
def test_what_changes_between_forward_and_backward_is_refused(change, system, cost, V, policy, x0):
    discrete, _ = routes(system, cost, policy)
    total = discrete(x0).cost.sum()
    total.backward(retain_graph=True)
    with torch.no_grad():
        change(V, system)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        total.backward()


@double_integrator
@in_both_forms
def test_a_buffer_that_is_replaced_after_the_rollout_gives_no_wrong_gradient(system, cost, policy, x0):
    """The gradient is that of the loop that was rolled out, or there is none."""
    rollouts, parameters = routes(system, cost, policy), list(policy.parameters())
    total, expected = (weighted(rollout(x0)) for rollout in rollouts)
    system.B = 2 * system.B
    expected = torch.autograd.grad(expected, parameters)
    assert error(slopes(rollouts[0], x0)[1:], expected) > 1e-3
    try:
        gradient = torch.autograd.grad(total, parameters)
    except RuntimeError:
        return
    assert error(gradient, expected) < EXACT


@double_integrator
def test_a_copy_is_a_closed_loop_of_its_own(system, cost, policy, x0):
    discrete, _ = routes(system, cost, policy)
    expected = slopes(discrete, x0)
    twin = copy.deepcopy(discrete)
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.mul_(1.1)
    assert error(slopes(twin, x0), expected) == 0
    assert error(slopes(discrete, x0), expected) > 1e-3


@double_integrator
def test_a_second_derivative_is_refused(system, cost, policy, x0):
    def curvature(rollout):
        leaf = x0.clone().requires_grad_()
        (slope,) = torch.autograd.grad(rollout(leaf).cost.sum(), leaf, create_graph=True)
        (slope**2).sum().backward()
        return leaf.grad

    discrete, backprop = routes(system, cost, policy)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        curvature(discrete)
    assert curvature(backprop).abs().max() > 0


# The costate is what the theory says


class Later(nn.Module):
    """A law, its clock set forward."""

    def __init__(self, policy, start):
        super().__init__()
        self.policy, self.start = policy, start

    def forward(self, t, x):
        return self.policy(t + self.start, x)


def test_costate_obeys_its_equation(system, cost, policy):
    """λ_n = λ_{n+1} + Δt dH(x, u(t, x), λ_{n+1})/dx with H = ℓ + λᵀ(f + gu).

    λ_n is the gradient of the cost-to-go: restart from each x_n.
    """
    x = Rollout(problem_of(system, cost, HORIZON.steps, HORIZON.dt), policy)(0.5 * torch.randn(3, system.n)).x.detach()
    times = HORIZON.times(x)

    def costate(n):
        if n == HORIZON.steps:
            return 2 * x[n] @ cost.Q_T
        rest = Horizon(HORIZON.steps - n, HORIZON.dt)
        (discrete, _) = routes(system, cost, Later(policy, times[n]), horizon=rest)
        return slopes(discrete, x[n], lambda trajectory: trajectory.cost.sum())[0]

    def slope(n, after, law):
        leaf = x[n].clone().requires_grad_()
        u = law(times[n], leaf)
        H = cost.running(leaf, u) + (after * system.dynamics(leaf, u)).sum(-1)
        return torch.autograd.grad(H.sum(), leaf)[0]

    for n in (0, 3, HORIZON.steps - 1):
        before, after = costate(n), costate(n + 1)
        assert_close(before, after + HORIZON.dt * slope(n, after, policy), rtol=1e-10, atol=1e-12)
        open_loop = HORIZON.dt * slope(n, after, lambda t, x: policy(t, x).detach())
        assert not torch.allclose(before, after + open_loop, rtol=1e-6)


@pytest.mark.parametrize("system", ["double_integrator", "linear"], indirect=True)
def test_optimal_costate_is_that_of_the_riccati_equation(system):
    """λ_0 = 2P_0x_0 under the optimal gains, which no change improves; neither holds of other gains."""
    cost = QuadraticCost(torch.eye(system.n) + 0.1, torch.eye(system.m) + 0.1, 2 * torch.eye(system.n))
    horizon, x0 = Horizon(20, 0.05), torch.randn(8, system.n)
    problem = problem_of(system, cost, horizon.steps, horizon.dt)
    P, K = vars(discrete_riccati(system, cost, horizon)).values()
    expected = 2 * x0 @ P[0]

    def gradient(K):
        return slopes(Rollout(problem, Feedback(K, horizon.dt), gradient="discrete"), x0, of_cost)

    def of_cost(trajectory):
        return trajectory.cost.sum()

    costate, gains = gradient(K)
    assert error([costate], [expected]) < 1e-8
    assert error([costate], [2 * x0 @ P[1]]) > 1e-3
    assert gains.norm() < 1e-8 * expected.norm()
    costate, gains = gradient(1.05 * K)
    assert error([costate], [expected]) > 1e-4
    assert gains.norm() > 1e-3 * expected.norm()


# Memory


def saved_bytes(rollout, x0):
    """What the graph keeps between forward and backward."""
    rollout(x0)  # the trace comes once
    sizes = []
    with saved_tensors_hooks(lambda y: sizes.append(y.numel() * y.element_size()) or y, lambda y: y):
        rollout(x0)
    return sum(sizes)


@double_integrator
def test_no_network_is_kept_for_each_step(system, cost, x0):
    """What two more layers cost in memory depends on the number of steps with backpropagation alone."""

    problem = problem_of(system, cost)

    def cost_of_layers(route, steps):
        shallow, deep = (
            routes(system, cost, HJBPolicy(problem, FCN(scaling, hidden)), horizon=Horizon(steps, 0.05))[route]
            for scaling in [Scaling([1.0] * system.n, 1.0, 3.0)]
            for hidden in [(8,), (8, 8, 8)]
        )
        return saved_bytes(deep, x0) - saved_bytes(shallow, x0)

    discrete, backprop = ([cost_of_layers(route, steps) for steps in (5, 20)] for route in range(2))
    assert discrete[0] == discrete[1]
    assert backprop[1] > 3 * backprop[0]
