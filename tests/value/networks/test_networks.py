"""Value networks and their anchors: gradients by formula against autograd, and the guarantees they are built for."""

from functools import partial

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn
from torch.autograd.functional import hessian
from torch.testing import assert_close

from lyapnet.task.cost import QuadraticCost
from lyapnet.value.calculus import ValueFunction, gradients
from lyapnet.value.networks import (
    ACTIVATIONS,
    FCN,
    ICNN,
    NETWORKS,
    CentredNetwork,
    ExpansionNetwork,
    IgnoringStates,
    PartiallyConvexNetwork,
    QuadraticForm,
    Scaling,
    StationaryNetwork,
    Timeless,
)
from lyapnet.value.networks.anchored import GoalAnchor, TerminalAnchor
from tests.problems import with_expansion

T = 2.0
SCALING = Scaling(state=(1.0, 2.0, 0.5), duration=T, value=30.0)
SMALL = {"scaling": SCALING, "hidden": (8, 6)}
CONVEX = [name for name, activation in ACTIVATIONS.items() if activation.convex]


class WithoutFormula(ValueFunction):
    """A user's network: its gradient is autograd's."""

    def __init__(self, **changes):
        super().__init__()
        self.network = FCN(**SMALL | changes)

    def forward(self, t, x):
        return self.network(t, x)


def cost():
    return QuadraticCost(torch.eye(3), [[1.0]], [[4.0, 1.0, 0.0], [1.0, 5.0, 0.0], [0.0, 0.0, 6.0]])


def terminal(network):
    return TerminalAnchor(network, cost(), T)


KEPT, TWO = (0, 2), Scaling(state=(1.0, 0.5), duration=T, value=30.0)


def of_two(network):
    return network(**SMALL | {"scaling": TWO})


def ignoring():
    """V of the first and the last state, which is φ of them at T."""
    phi = QuadraticCost(torch.eye(2), [[1.0]], [[4.0, 0.5], [0.5, 6.0]])
    return IgnoringStates(TerminalAnchor(GoalAnchor(of_two(PartiallyConvexNetwork)), phi, T), KEPT, 3)


VALUES = {
    **{name: lambda cls=cls: with_expansion(cls(**SMALL)) for name, cls in NETWORKS.items()},
    **{f"fcn, {name}": partial(FCN, SCALING, (8,), activation=name) for name in ACTIVATIONS},
    **{f"icnn, {name}": partial(ICNN, SCALING, (8, 6, 4), activation=name) for name in CONVEX},
    "fcn, angles": partial(FCN, **SMALL, embedded_angles=(2, 0)),
    "user": WithoutFormula,
    "terminal(fcn)": lambda: terminal(FCN(**SMALL, embedded_angles=(1,))),
    "terminal(user)": lambda: terminal(WithoutFormula()),
    "goal(partially convex)": lambda: GoalAnchor(PartiallyConvexNetwork(**SMALL)),
    "goal(terminal(partially convex))": lambda: GoalAnchor(terminal(PartiallyConvexNetwork(**SMALL))),
    "goal(user)": lambda: GoalAnchor(WithoutFormula()),
    "goal(fcn, angles)": lambda: GoalAnchor(FCN(**SMALL, embedded_angles=(0,))),
    "terminal(goal(icnn))": lambda: terminal(GoalAnchor(ICNN(**SMALL))),
    "ignoring(fcn)": lambda: IgnoringStates(of_two(FCN), KEPT, 3),
    "ignoring(terminal(goal(partially convex)))": lambda: ignoring(),
    "centred(fcn)": lambda: CentredNetwork(FCN(**SMALL), torch.tensor([0.3, -0.2, 0.1])),
    "timeless(fcn)": lambda: Timeless(FCN(**SMALL)),
    "ignoring(user)": lambda: IgnoringStates(WithoutFormula(scaling=TWO), KEPT, 3),
}

SHAPES = [
    ((), (3,)),
    ((), (5, 3)),
    ((), (0, 3)),
    ((), (4, 5, 3)),
    ((1,), (1, 3)),
    ((1,), (5, 3)),
    ((5,), (5, 3)),
    ((4, 1), (4, 5, 3)),
    ((4, 5), (4, 5, 3)),
]


@pytest.fixture(params=VALUES)
def network(request):
    return VALUES[request.param]()


def draw(t_shape=(50,), x_shape=(50, 3)):
    return T * torch.rand(t_shape), torch.randn(x_shape)


def formula_equals_autograd(V, t, x):
    _, expected = gradients(V, t, x)
    value, formula = V.value_and_state_gradient(t, x)
    assert formula.shape == x.shape
    assert_close(formula, expected, rtol=0, atol=1e-12 * max(expected.detach().abs().flatten().tolist(), default=0.0))
    assert_close(value, V(t, x), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("t_shape", "x_shape"), SHAPES, ids=str)
def test_gradient_formula_equals_autograd(network, t_shape, x_shape):
    formula_equals_autograd(network, *draw(t_shape, x_shape))


@pytest.mark.parametrize(("value_factor", "slope_factor"), [(1, 1 + 1e-11), (1 + 1e-11, 1)])
def test_a_formula_with_an_error_is_noticed(monkeypatch, value_factor, slope_factor):
    def wrong(self, t, x):
        return self(t, x) * value_factor, gradients(self, t, x)[1] * slope_factor

    monkeypatch.setattr(FCN, "value_and_state_gradient", wrong)
    with pytest.raises(AssertionError):
        formula_equals_autograd(FCN(**SMALL), *draw())


@pytest.mark.parametrize(("t_shape", "x_shape"), SHAPES, ids=str)
def test_one_time_for_many_states_is_that_time_for_each(network, t_shape, x_shape):
    t, x = draw(t_shape, x_shape)
    assert network(t, x).shape == x_shape[:-1]
    assert_close(network(t, x), network(t.expand(x_shape[:-1]), x))


def differences(function, at, step=1e-5):
    """Central differences of a function that acts on each entry alone."""
    return (function(at + step) - function(at - step)) / (2 * step)


def test_time_derivative_against_finite_differences(network):
    t, x = draw()
    V_t, _ = gradients(network, t, x)
    assert_close(V_t, differences(lambda t: network(t, x), t), rtol=1e-6, atol=1e-6)
    moves = not torch.allclose(V_t, differences(lambda t: network(t, x), t + 0.1), rtol=1e-6, atol=1e-6)
    assert moves != isinstance(network, StationaryNetwork | Timeless)


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_activation_derivative_against_finite_differences(name):
    a = torch.linspace(-30, 30, 301)
    assert_close(ACTIVATIONS[name].derivative(a), differences(ACTIVATIONS[name].function, a), rtol=0, atol=1e-8)


def test_convex_activations_are_convex_and_nondecreasing():
    a = torch.linspace(-20, 20, 401)
    for activation in ACTIVATIONS.values():
        slope = activation.derivative(a)
        assert activation.convex == bool((slope >= 0).all() and (slope.diff() >= 0).all())


def test_gradients_under_no_grad_are_the_same_and_leave_no_graph(network):
    t, x = draw()
    recorded = (*gradients(network, t, x), network.value_and_state_gradient(t, x)[1])
    assert recorded[1].requires_grad
    with torch.no_grad():
        plain = (*gradients(network, t, x), network.value_and_state_gradient(t, x)[1])
    for value, expected in zip(plain, recorded, strict=True):
        assert not value.requires_grad
        assert_close(value, expected.detach())


def test_gradients_join_the_callers_graph(network):
    """V_x is differentiable in x, t and the parameters: its product with a vector has the Hessian's columns."""
    t, x = draw((), (3,))
    x.requires_grad_()
    direction = torch.randn(3)
    H = hessian(lambda x: network(t, x), x)
    for gradient in (network.value_and_state_gradient(t, x)[1], gradients(network, t, x)[1]):
        (column,) = torch.autograd.grad(gradient @ direction, x, retain_graph=True)
        assert_close(column, H @ direction)
        slopes = torch.autograd.grad(gradient @ direction, list(network.parameters()), allow_unused=True)
        assert any(slope is not None and slope.abs().max() > 0 for slope in slopes)


def test_single_precision_stays(network):
    t, x = (v.float() for v in draw())
    network = network.float()
    assert network(t, x).dtype == network.value_and_state_gradient(t, x)[1].dtype == torch.float32


# Convexity


def is_convex(function, points):
    """Midpoint convexity on pairs of points, and no negative eigenvalue of the Hessian at any of them."""
    a, b = points.chunk(2)
    values = function(torch.stack([a, b, (a + b) / 2]))
    assert (values[2] <= (values[0] + values[1]) / 2 + 1e-12 * values.abs().max()).all()
    for point in points[:20]:
        eigenvalues = torch.linalg.eigvalsh(hessian(function, point))
        assert eigenvalues[0] >= -1e-12 * eigenvalues.abs().max()


def convexity_jointly(V):
    is_convex(lambda tx: V(tx[..., 0], tx[..., 1:]), 2 * torch.randn(400, 4))


def convexity_in_x(V):
    for t in torch.linspace(0, T, 4):
        is_convex(partial(V, t), 3 * torch.randn(200, 3))


def steep(network):
    """With weights large enough to bend."""
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.mul_(4)
    return network


@pytest.mark.parametrize("activation", CONVEX)
@pytest.mark.parametrize("seed", range(3))
def test_convex_networks_are_convex(activation, seed):
    torch.manual_seed(seed)
    convexity_jointly(steep(ICNN(**SMALL, activation=activation)))
    partially_convex = steep(PartiallyConvexNetwork(**SMALL, activation=activation))
    for V in (partially_convex, terminal(partially_convex), GoalAnchor(terminal(partially_convex))):
        convexity_in_x(V)


def test_other_networks_are_not_convex():
    for check, V in (
        (convexity_in_x, FCN(**SMALL)),
        (convexity_jointly, FCN(**SMALL)),
        (convexity_jointly, PartiallyConvexNetwork(**SMALL)),
        (convexity_in_x, lambda t, x: -ICNN(**SMALL)(t, x)),
    ):
        with pytest.raises(AssertionError):
            check(steep(V) if isinstance(V, nn.Module) else V)


@pytest.mark.parametrize("network", [ICNN, PartiallyConvexNetwork])
@pytest.mark.parametrize("activation", sorted(set(ACTIVATIONS) - set(CONVEX)))
def test_an_activation_that_breaks_convexity_is_refused(network, activation):
    with pytest.raises(ValueError, match=f"Expected a convex activation, got '{activation}'"):
        network(SCALING, activation=activation)


# Anchors

ANY_TIME = st.floats(0, T)
ANY_STATE = st.lists(st.floats(-5, 5), min_size=3, max_size=3).map(torch.tensor)
ANY_SEED = st.integers(0, 1000)


def vanishes_at_the_goal(V, t):
    """To rounding, measured by the values of the network at order one."""
    goal = torch.zeros(3)
    assert abs(V(t, goal)) <= 1e-13 * SCALING.value
    for slope in (V.value_and_state_gradient(t, goal)[1], gradients(V, t, goal)[1]):
        assert slope.abs().max() <= 1e-12 * SCALING.value


def anchored(seed, epsilon=1e-3):
    """An anchored network with steep weights."""
    torch.manual_seed(seed)
    return GoalAnchor(steep(PartiallyConvexNetwork(**SMALL)), epsilon)


@given(ANY_TIME, ANY_SEED)
def test_anchored_network_vanishes_at_the_goal_with_its_slope(t, seed):
    vanishes_at_the_goal(anchored(seed), torch.tensor(t))
    vanishes_at_the_goal(GoalAnchor(terminal(anchored(seed).network)), torch.tensor(t))


@pytest.mark.parametrize("network", [ICNN, FCN, PartiallyConvexNetwork])
def test_plain_networks_do_not_vanish_at_the_goal(network):
    with pytest.raises(AssertionError):
        vanishes_at_the_goal(network(**SMALL), torch.tensor(0.5))


@given(ANY_TIME, ANY_STATE, ANY_SEED, st.sampled_from([1e-3, 0.5]))
def test_anchored_network_bounds_the_squared_distance_and_the_terminal_cost(t, x, seed, epsilon):
    V = anchored(seed, epsilon)
    least = epsilon * (x @ x) - 1e-11 * SCALING.value
    assert V(torch.tensor(t), x) >= least
    assert GoalAnchor(terminal(V.network), epsilon)(torch.tensor(t), x) >= cost().terminal(x) + least


def test_an_anchored_network_that_is_not_convex_falls_below():
    t, x = draw()
    assert (GoalAnchor(steep(FCN(**SMALL)))(t, x) < 0).any()


@pytest.mark.parametrize("inner", [FCN, ICNN, PartiallyConvexNetwork])
def test_terminal_anchor_ends_as_the_terminal_cost(inner):
    V, phi = terminal(inner(**SMALL)), cost().terminal
    _, x = draw()
    end = torch.tensor(T)
    assert_close(V(end, x), phi(x))
    assert_close(V.value_and_state_gradient(end, x)[1], gradients(lambda t, x: phi(x), end, x)[1])
    assert not torch.allclose(V(0.9 * end, x), phi(x), rtol=1e-3)


# States that are ignored


def test_V_is_the_same_whatever_an_ignored_state_is():
    (t, x), V = draw(), ignoring()
    elsewhere = x + torch.tensor([0.0, 5.0, 0.0])
    assert torch.equal(V(t, elsewhere), V(t, x))
    for slope in (V.value_and_state_gradient(t, x)[1], gradients(V, t, x)[1]):
        assert (slope[:, 1] == 0).all()
        assert (slope[:, [0, 2]] != 0).all()
    assert_close(V(t, x), V.network(t, x[:, [0, 2]]))
    assert not torch.allclose(terminal(FCN(**SMALL))(t, elsewhere), terminal(FCN(**SMALL))(t, x)), "one that is not"
    assert not torch.allclose(V(t, x + torch.tensor([0.0, 0.0, 5.0])), V(t, x)), "one that is kept"


def test_terminal_cost_of_the_kept_states_is_met():
    (_, x), end = draw(), torch.tensor(T)
    Q_T = torch.tensor([[4.0, 0.5], [0.5, 6.0]])
    kept = x[:, [0, 2]]
    assert_close(ignoring()(end, x), ((kept @ Q_T) * kept).sum(-1))
    assert not torch.allclose(ignoring()(0.9 * end, x), ((kept @ Q_T) * kept).sum(-1), rtol=1e-3)


# Scaling


@pytest.mark.parametrize("build", [FCN, partial(ICNN, epsilon=0.0), PartiallyConvexNetwork])
def test_weights_keep_their_meaning_in_relative_time_state_and_value(build):
    one, other = build(**SMALL), build(**SMALL | {"scaling": Scaling((10.0, 1.0, 2.0), 3 * T, 60.0)})
    t, x = draw()
    x_other = x / torch.tensor(SCALING.state) * torch.tensor([10.0, 1.0, 2.0])
    assert not torch.allclose(other(3 * t, x_other), 2 * one(t, x), rtol=1e-3)
    other.load_state_dict(one.state_dict())
    assert_close(other(3 * t, x_other), 2 * one(t, x))


def test_embedded_angles_keep_a_turn_apart():
    """θ and θ + 2π share their sine and cosine; the raw angle tells them apart."""
    t, x = draw()
    V = FCN(**SMALL, embedded_angles=(1,))
    turned = x + torch.tensor([0.0, 2 * torch.pi, 0.0])
    assert not torch.allclose(V(t, turned), V(t, x), rtol=1e-3)
    with torch.no_grad():
        V.hidden[0].weight[:, 1 + 1] = 0  # the column of the raw angle, after that of time
    assert_close(V(t, turned), V(t, x))


# The quadratic form


def quadratic_form(epsilon=1e-3):
    return QuadraticForm(SCALING, (8,), epsilon=epsilon)


def test_a_quadratic_form_is_a_lyapunov_candidate_for_any_weights():
    V, t, x = quadratic_form(), T * torch.rand(50), 3 * torch.randn(50, 3)
    for p in V.parameters():
        p.data.normal_()
    value, slope = V.value_and_state_gradient(t, torch.zeros(50, 3))
    assert value.abs().max() == slope.abs().max() == 0
    assert (V(t, x) >= 1e-3 * (x**2).sum(-1)).all()
    assert_close(V(t, 2 * x), 4 * V(t, x))
    assert not torch.allclose(FCN(**SMALL)(t, 2 * x), 4 * FCN(**SMALL)(t, x)), "a network that is no quadratic form"


def test_a_quadratic_form_starts_near_a_multiple_of_the_scaled_norm():
    V, x = quadratic_form(epsilon=1e-9), torch.randn(20, 3)
    ratio = V(torch.tensor(0.5), x) / (SCALING.value / 3 * ((x / torch.tensor(SCALING.state)) ** 2).sum(-1))
    assert (ratio > 0.3).all()
    assert (ratio < 3).all()


@pytest.mark.parametrize("cost_at_goal", [0.0, 1.0])
def test_around_a_goal_that_costs_nothing_V_and_its_gradient_stay_zero_whatever_the_network_learns(cost_at_goal):
    V, t, x = with_expansion(ExpansionNetwork(SCALING, hidden=(8, 6))), torch.linspace(0, T, 5), torch.zeros(5, 3)
    V.start_from_expansion(
        t, x, torch.full((5,), cost_at_goal), x, *[torch.eye(3).expand(5, 3, 3)] * 2, torch.randn(1, 20, 3)
    )
    value, gradient = (part.detach() for part in V.value_and_state_gradient(t, x))
    stays = (value == cost_at_goal).all() & (gradient == 0).all()
    assert bool(stays) == (cost_at_goal == 0)
