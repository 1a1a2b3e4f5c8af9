"""The limit of the costates: what it cuts, and what it leaves alone to the last bit."""

import pytest
import torch
from torch.testing import assert_close

from lyapnet.experiment.config import load_config
from lyapnet.loop.rollout import Rollout
from lyapnet.loop.rollout.backwards import limit_costates
from lyapnet.value.policy import HJBPolicy
from tests.problems import CONF, untrained


@pytest.fixture
def pendulum():
    """limit ↦ the closed loop of a pendulum whose V has random weights."""
    controller = untrained("pendulum_swingup", "horizon.steps=30", "network.hidden=[8, 8]", "network.name=fcn")
    policy = HJBPolicy(controller.problem, controller.V.requires_grad_())
    return lambda limit: Rollout(controller.problem, policy, "euler", "discrete", costate_limit=limit)


def slopes(rollout, x0):
    """∂ mean J / ∂ x₀, and by the weights of V."""
    leaf = x0.clone().requires_grad_()
    leaves = [leaf, *(p for p in rollout.parameters() if p.requires_grad)]
    of_x0, *rest = torch.autograd.grad(rollout(leaf).cost.mean(), leaves, allow_unused=True, materialize_grads=True)
    return of_x0, rest


def test_by_hand():
    costate = torch.tensor([[1.0, 0.0], [0.0, -2.0], [3.0, 0.0], [30.0, 40.0]])
    cut = limit_costates(costate, 5.0)
    assert_close(cut[:3], costate[:3], rtol=0, atol=0)
    assert_close(cut[3], torch.tensor([6.0, 8.0]))  # the lower median is 2
    assert_close(limit_costates(costate, 25.0), costate, rtol=0, atol=0)
    both = torch.stack([costate, 100 * costate])
    assert_close(limit_costates(both, 5.0), torch.stack([cut, 100 * cut]))
    resting = torch.tensor([[0.0, 0.0], [0.0, 0.0], [7.0, 0.0]])
    assert_close(limit_costates(resting, 5.0), resting, rtol=0, atol=0)


def test_costates_of_one_size_are_left_as_they_are(pendulum):
    x0 = torch.tensor([[0.3, 0.1], [0.31, 0.1], [0.3, 0.11], [0.29, 0.1]])
    (exact, weights), (cut, same) = (slopes(pendulum(limit), x0) for limit in (None, 5.0))
    assert_close(cut, exact, rtol=0, atol=0)
    assert all(torch.equal(one, other) for one, other in zip(weights, same, strict=True))


def test_long_ones_are_cut_to_a_multiple_of_the_median(pendulum):
    x0 = torch.tensor([[2.9, 0.0], [3.1, 0.1], [3.0, 0.0], [0.01, 0.0]])
    (exact, weights), (cut, _), (_, less) = (slopes(pendulum(limit), x0) for limit in (None, 1.2, 1.0))
    length, shorter = exact.norm(dim=1), cut.norm(dim=1)
    assert length.max() > 2 * length.median(), "else there is nothing to cut"
    assert shorter.max() <= 1.2 * shorter.median() * (1 + 1e-12)
    assert sum(p.norm() for p in less) < sum(p.norm() for p in weights)


@pytest.mark.parametrize(("gradient", "limit"), [("adjoint", 5.0), ("backprop", 5.0), ("discrete", 0.9)])
def test_a_limit_without_meaning_is_refused(gradient, limit, pendulum):
    rollout = pendulum(None)
    with pytest.raises(ValueError, match="costate_limit ≥ 1 of gradient discrete"):
        Rollout(rollout.problem, rollout.closed_loop.policy, "euler", gradient, costate_limit=limit)


@pytest.mark.parametrize(
    ("name", "overrides", "expected"),
    [
        ("pendulum_limited", [], 5.0),
        ("pendulum_limited", ["rollout.gradient=adjoint"], None),
        ("pendulum_limited", ["program.name=lyapunov"], None),
        ("pendulum_limited", ["rollout.costate_limit=7"], 7.0),
        ("pendulum_limited", ["rollout.costate_limit=null"], None),
        ("pendulum_swingup", [], None),
        ("pendulum_swingup", ["controls.lower=0"], 5.0),
        ("pendulum_swingup", ["controls={lower: -8, upper: 8}"], 5.0),
        ("pendulum_swingup", ["constraints.upper.velocity=9"], None),
    ],
)
def test_the_recipe_has_one_for_the_value_program_between_limits(name, overrides, expected):
    config = load_config(CONF / f"{name}.yaml", overrides)
    assert config.rollout.costate_limit == expected
