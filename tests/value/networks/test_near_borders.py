"""Inputs that tell how close a state is to the border of its domain."""

import torch
from torch.testing import assert_close

from lyapnet.task.domain import Border
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.networks import ExpansionNetwork, Scaling
from lyapnet.value.networks.near_borders import NearBorders

LOWER, UPPER = Border("volume", "lower", 0.5, ""), Border("share", "upper", 1.0, "")
TIMES = torch.linspace(0, 2, 3, dtype=torch.float64)


def network_of(x, borders=((0, LOWER), (2, UPPER))):
    """One that begins from nothing known, about states x (b, 3)."""
    torch.manual_seed(0)
    V = ExpansionNetwork(Scaling([1.0] * 3, 2.0, 1.0), [16], borders=borders).double()
    V.start_from_zero(TIMES, x.mean(0), torch.zeros(3, 3, 3).double(), x.std(0), 1.0)
    if V.near_borders is not None:
        V.near_borders.fit(x)
    return V


def states(b=64):
    """Volumes over four decades above 0.5, and shares as close to 1."""
    torch.manual_seed(1)
    decades = 10 ** (4 * torch.rand(b, 2) - 4)
    return torch.stack([0.5 + decades[:, 0], torch.randn(b), 1 - decades[:, 1]], -1).double()


def test_its_inputs_by_hand():
    """Distances 1, 10 and 100: logarithms 0, l and 2l of mean l and standard deviation l √(2/3)."""
    below = torch.tensor([[0.5 + 1, 0.0], [0.5 + 10, 0.0], [0.5 + 100, 0.0]]).double()
    inputs = NearBorders([(0, LOWER)]).double()
    inputs.fit(below)
    expected = torch.tensor([-1.0, 0.0, 1.0, -0.5]).double() / (0.35 * (2 / 3) ** 0.5)
    between = torch.tensor([[0.5 + 10**0.5, 7.0]]).double()
    assert_close(inputs(torch.cat([below, between]))[:, 0], expected, atol=1e-9, rtol=1e-9)
    upper = NearBorders([(1, UPPER)]).double()
    upper.fit((0.5 - below.flip(-1)) + torch.tensor([0.5, 1.0]).double())  # as far from 1, on the other side
    assert_close(upper(torch.tensor([[0.0, 1 - 10.0], [0.0, 1 - 100.0]]).double())[:, 0], expected[1:3])


def test_the_slope_is_that_of_the_value():
    x = states()
    V = network_of(x)
    torch.nn.init.normal_(V.network.output.weight)
    t = torch.linspace(0, 2, 64, dtype=torch.float64)
    value, slope = V.value_and_state_gradient(t, x)
    expected = ValueFunction.value_and_state_gradient(V, t, x)  # by autograd
    assert_close((value, slope), expected)
    assert not torch.allclose(network_of(x, ())(t, x), value, atol=0.1)


def test_beyond_a_border_all_is_finite_and_flat():
    x = states()
    V = network_of(x)
    torch.nn.init.normal_(V.network.output.weight)
    beyond = torch.tensor([[0.4, 0.0, 0.5], [0.2, 0.0, 0.5]]).double()
    near, slope = V.near_borders(beyond), V.near_borders.pull_back(beyond, torch.ones(2, 2).double())
    assert near.isfinite().all()
    assert near[0, 0] == near[1, 0]
    assert slope[:, 0].tolist() == [0, 0]
    assert bool((slope[:, 2] < 0).all()), "the upper border is far"
    assert all(part.isfinite().all() for part in V.value_and_state_gradient(torch.zeros(2).double(), beyond))


def test_it_sees_orders_of_magnitude():
    """V = ln(x₀ − 0.5): with the logarithms and without."""
    x = states(512)
    V = (x[:, 0] - 0.5).log()
    V = (V - V.mean()) / V.std()

    def misfit(borders):
        network = network_of(x, borders)
        optimizer = torch.optim.Adam(network.parameters(), 0.01)
        for _ in range(150):
            loss = (network(torch.zeros(512).double(), x) - V).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        return float(loss.detach())

    assert misfit(((0, LOWER),)) < 0.02
    assert misfit(()) > 0.1
