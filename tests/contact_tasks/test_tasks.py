"""The tasks with contact are what their pages say."""

import torch
from torch.testing import assert_close

from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import load_config
from lyapnet.value.expansions import in_float64
from tests.configs import CONF


def problem_of(name):
    return in_float64(build_problem(load_config(CONF / f"{name}.yaml")))


def published_step(x, u):
    """A step of Suh et al.'s block on a body, with sharp contact."""
    mass, h, friction, creep, reach = 0.1, 0.005, 1.8, 0.1, 0.1
    body, block, body_rate, block_rate = x.unbind(-1)
    slip = block_rate - body_rate
    drag = -((block - body).abs() < reach).double() * friction * slip.clamp(-creep, creep)
    body_rate, block_rate = body_rate + h / mass * (u[:, 0] - drag), block_rate + h / mass * drag
    return torch.stack([body + h * body_rate, block + h * block_rate, body_rate, block_rate], -1)


def test_dragging_is_the_published_task_where_it_slides_or_is_apart():
    task = problem_of("dragging")
    x = task.initial_states.sample(1000, torch.Generator().manual_seed(0)) * torch.tensor([5.0, 5.0, 8.0, 8.0])
    u = torch.randn(1000, 1)
    found, expected = task.step(x, u)[0], published_step(x, u)
    slip, away = (x[:, 3] - x[:, 2]).abs(), ((x[:, 1] - x[:, 0]).abs() - 0.1).abs()
    exact = (slip > 0.1) & (away > 0.01)
    assert 300 < int(exact.sum()) < 900
    assert_close(found[exact], expected[exact])
    assert (found - expected)[~exact].abs().max() > 1e-3
    error = x - torch.tensor([2.0, 2.0, 0.0, 0.0])
    weights = torch.tensor([0.1, 10.0, 0.1, 0.1])
    assert_close(task.step(x, u)[1], (weights * error**2).sum(-1) + u[:, 0] ** 2)
    assert_close(task.cost.terminal(x), (weights * error**2).sum(-1))
