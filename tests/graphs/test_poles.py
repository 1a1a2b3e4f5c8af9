"""Poles that a step jumps over: found where a function is unbounded, not where it is guarded or bounded."""

import copy

import pytest
import torch

import lyapnet
from lyapnet.graphs.poles import poles_of
from lyapnet.value.expansions import path_under

ONE = torch.tensor([1.0], dtype=torch.float64)
ACROSS = torch.tensor([[1.0], [0.4], [-0.3], [-1.0]], dtype=torch.float64)  # a path over x = 0


@pytest.mark.parametrize(
    ("function", "is_crossed"),
    [
        (lambda x: 1 / x, True),
        (lambda x: x**-3, True),
        (lambda x: torch.reciprocal(x), True),
        (lambda x: torch.exp(x) / torch.sin(x), True),
        (lambda x: 1 - 2.7 / (x + 0.1), True),
        (lambda x: 1 / (x - 5), False),  # the zero is elsewhere
        (lambda x: torch.sin(x) / x, False),  # the function is 1 there
        (lambda x: torch.where(x.abs() < 1e-3, 1 - x**2 / 6, torch.sin(x) / x), False),
        (lambda x: x / torch.where(x.abs() < 0.1, 0.1, x), False),
        (lambda x: x / (1 + x**2), False),
    ],
)
def test_a_pole_is_crossed_where_the_function_grows_beyond_bounds(function, is_crossed):
    poles = poles_of(lambda x: (function(x),), ONE)
    assert poles is not None
    assert bool(poles.crossed(ACROSS)) == is_crossed
    assert not bool(poles.crossed(ACROSS[:2]))


def test_each_path_of_a_batch_is_asked_by_itself():
    poles = poles_of(lambda x: (1 / x,), ONE)
    assert poles is not None
    x = torch.stack([ACROSS, ACROSS.abs(), -ACROSS], 1)[:, None]
    assert poles.crossed(x).tolist() == [[True, False, True]]


def test_no_path_crosses_none():
    assert poles_of(lambda x: 1 / x, ONE).crossed(ACROSS[:, None][:, :0]).shape == (0,)


def test_a_function_that_divides_by_no_state_has_none():
    assert poles_of(lambda x: (x / 3 + torch.log(x) + x**2,), ONE) is None
    assert poles_of(lambda x: (x / float(x),), ONE) is None  # refused by another check


class Stock(lyapnet.ControlAffineSystem):
    """A stock of fish and what its catch earns: the price less what it costs, which rises as the stock falls."""

    state_names, state_units = ("stock", "profit"), ("kt", "M")
    control_names, control_units = ("effort",), ("",)

    def f(self, x):
        return torch.stack([0.7 * x[..., 0] * (1 - x[..., 0] / 80), torch.zeros_like(x[..., 0])], -1)

    def g(self, x):
        return torch.stack([torch.full_like(x[..., 0], -20.0), 20 * (1 - 17.5 / x[..., 0])], -1)[..., None]


class Profit(lyapnet.Cost):
    def state(self, x):
        return torch.zeros_like(x[..., 0])

    def R(self, x):
        return torch.full_like(x[..., 0], 0.01)[..., None, None]

    def terminal(self, x):
        return -x[..., 1]


def test_a_path_that_jumps_over_a_pole_has_no_finite_cost():
    box, horizon = lyapnet.Box([20.0, 0.0], [75.0, 0.0]), lyapnet.Horizon(steps=40, dt=0.1)
    problem = lyapnet.Problem(Stock(), Profit(), lyapnet.ControlBox([0.0], [1.0]), box, horizon).double()
    x0 = torch.tensor([[25.0, 0.0], [70.0, 0.0]], dtype=torch.float64)

    def cost(problem, effort):
        return path_under(problem, lambda n, x: torch.full_like(x[..., :1], effort), x0).cost

    assert cost(problem, 1.0).isfinite().tolist() == [
        False,
        True,
    ]  # the first path is fished out, and catches from a negative stock
    assert cost(problem, 0.2).isfinite().all()
    blind = copy.deepcopy(problem)
    blind.findings = type(problem.findings)(poles=None)
    assert cost(blind, 1.0).isfinite().all()  # the stock is below zero
