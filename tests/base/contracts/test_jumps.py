"""Jumps are found where they are, and nothing else is taken for one."""

import math

import pytest
import torch

import lyapnet
from lyapnet.base.contracts import jumps
from lyapnet.base.interpolation import Table
from lyapnet.experiment.config import config_from_plain
from lyapnet.task.systems import SYSTEMS
from lyapnet.training.experiment import train
from lyapnet.training.task_facts import jump_facts
from tests.fits import shorten_fits
from tests.problems import problem_of

LOW, HIGH = torch.tensor([-1.0, -1.0]).double(), torch.tensor([1.0, 1.5]).double()


def table(x):
    return Table([[-1.0, 0.0, 2.0]], [3.0, 1.0, 5.0], method="linear")(x[..., :1])


@pytest.mark.parametrize(
    ("function", "place", "size"),
    [
        (lambda x: torch.stack([x[..., 1], -5 * torch.sign(x[..., 1])], -1), "v = 0 at", 10),
        (lambda x: (x[..., 0] > 0.5) * 1.0, "p = 0.5 at", 1),
        (lambda x: torch.where(x[..., 0] + x[..., 1] > 0.3, x[..., 0], 2 + x[..., 0]), "as at x = (", 2),
        (lambda x: torch.round(10 * x[..., 0]) / 10, "as at x = (", 0.1),
        (lambda x: torch.floor(x[..., 0]), "p = 0 at", 1),
        (lambda x: torch.remainder(x[..., 0] + 0.5, 1.2), "as at x = (", 1.2),
        (lambda x: torch.atan2(x[..., 1], x[..., 0]), "v = 0 at", 2 * math.pi),
        (lambda x: (3 * x[..., 0]).int() * 1.0, "as at x = (", 1),
        (lambda x: x[..., 0].heaviside(x[..., 0].new_tensor(0.5))[..., None] * 1e-3, "p = 0 at", 1e-3),
    ],
)
def test_jumps_are_found_with_line_state_and_size(function, place, size):
    (jump,) = jumps(function, LOW, HIGH)
    words = jump.described("f", ["p", "v"])
    assert place in words
    assert "test_jumps.py:" in words
    assert jump.size == pytest.approx(size, rel=1e-4)


@pytest.mark.parametrize(
    "function",
    [
        table,
        lambda x: torch.where(x[..., 0] > 0, x[..., 0], 0.0) * 3,
        lambda x: torch.where(x[..., 0] > 0, torch.sqrt(x[..., 0].clamp_min(0)), 0.0),
        lambda x: torch.where(x[..., 0] > 0, torch.sqrt(x[..., 0]), math.nan),
        lambda x: torch.relu(x[..., 0]) + x.abs().sum(-1) + lyapnet.norm(x) + x.amax(-1),
        lambda x: torch.tanh(x[..., 0] / 1e-6),
        lambda x: torch.sin(torch.remainder(x[..., 0], 2 * math.pi)),
        lambda x: torch.sign(x[..., 0]) * x[..., 0] ** 2,
        lambda x: torch.where((x == 0).all(-1), 1.0, torch.cos(x[..., 0])),
        lambda x: x[..., 0] / 0,
        lambda x: x.no_such_method(),
    ],
)
def test_what_does_not_jump_is_not_noted(function):
    assert not jumps(function, LOW, HIGH)


@pytest.mark.parametrize("name", sorted(set(SYSTEMS) - {"linear"}))
def test_no_registered_system_jumps(name):
    assert not jump_facts(problem_of(SYSTEMS[name]()))


class Block(lyapnet.ControlAffineSystem):
    """A block on a rough table."""

    state_names, state_units = ("position", "speed"), ("m", "m/s")
    control_names, control_units = ("force",), ("N",)

    def f(self, x):
        return torch.stack([x[..., 1], -5.9 * torch.sign(x[..., 1])], -1)

    def g(self, x):
        return x.new_tensor([[0.0], [1.0]]).expand(*x.shape[:-1], 2, 1)


def test_training_begins_with_a_note(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("lyapnet.training.start.MAX_OPTIMA", 12)
    shorten_fits(monkeypatch, 130, 70)
    monkeypatch.setattr("lyapnet.training.pretraining.BRIEF_STEPS", 10)
    config = {
        "experiment": "block", "logs": str(tmp_path), "loggers": ["csv"], "rollout": {"compile": "off"},
        "system": {"name": f"{__name__}:Block"}, "cost": {"Q": [1, 1], "R": 1, "Q_T": [1, 1]},
        "initial_states": {"lower": [-1, 0], "upper": [1, 0]}, "horizon": {"steps": 4, "dt": 0.1},
        "training": {"iterations": 1}, "evaluation": {"validation_states": 2, "test_states": 2, "optimum": False},
        "network": {"name": "fcn", "hidden": [4]}, "program": {"name": "value"},
    }  # fmt: skip
    train(config_from_plain(config))
    notes = [line for line in capsys.readouterr().out.splitlines() if line.startswith("note: ")]
    (note,) = notes
    assert "Block.f(x) jumps by 11.8 where speed = 0 at test_jumps.py:" in note
    assert "tanh" in note
