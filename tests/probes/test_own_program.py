"""A third program, from a user's module: through YAML and through Python, with what it promises."""

import json

import pytest
import torch

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.cli import main
from lyapnet.experiment.assembly import build_program
from lyapnet.experiment.config import config_from_plain
from tests.probes.own_parts import AbsoluteProgram
from tests.runs import SMALL

NAME = "tests.probes.own_parts:AbsoluteProgram"
CONFIG = {
    **SMALL,
    "program": {"name": NAME, "trajectory_cost": 1, "parameters": {"promise": 0.4}},
    "pointwise": {"weight": 0.1, "points": 8},
    "training": {"iterations": 3, "batch_size": 6},
    "loggers": ["csv"],
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return lyapnet.train(CONFIG, [f"logs={tmp_path_factory.mktemp('own_program')}"])


@pytest.mark.gate
def test_it_trains_and_its_terms_are_logged(run):
    header = (run.folder / "metrics.csv").read_text().splitlines()[0].split(",")
    assert {"term/constraint", "term/terminal", "term/trajectory_cost", "term/pointwise"} <= set(header)
    assert run.finished


def test_its_controller_knows_it(run):
    with pytest.raises(UsageError, match=f"Expected program=.*{NAME}"):
        lyapnet.load(run.best)
    program = AbsoluteProgram(promise=0.4)
    assert lyapnet.load(run.best, program=program).program is program


def test_certificates_ask_for_what_it_promises(run, capsys):
    arguments = [str(run.best), "--samples", "20", "--json", "--program", NAME]
    for kind in ("sampled", "statistical"):
        assert main(["certify", kind, *arguments]) in (0, 1)
        claim = json.loads(capsys.readouterr().out)
        assert claim["tolerances"] == {"radius": None, "decrease": None, "cost": 0.4}
        assert "decrease_share" not in claim


def test_its_terms_are_its_formula():
    config = config_from_plain(CONFIG)
    program = build_program(config)
    assert program == AbsoluteProgram(trajectory_cost=1, promise=0.4)
    values, step_cost, terminal = torch.rand(4, 2), torch.rand(3, 2), torch.rand(2)
    zero = torch.zeros(0)
    trajectory = lyapnet.Trajectory(
        zero, zero, zero, torch.cat([torch.zeros(1, 2), step_cost.cumsum(0)]), terminal, values
    )
    expected = sum((values[k + 1] - values[k] + step_cost[k]).abs() for k in range(3))
    torch.testing.assert_close(program.constraint_loss(values, trajectory), expected)


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("program.margin=0.1", "program.margin"),
        ("program.parameters.promisse=1", "program.parameters.promise?"),
        ("program.name=tests.probes.own_parts:Pendulum", "Program"),
    ],
)
def test_options_that_it_does_not_have_are_refused(override, named):
    with pytest.raises(UsageError) as raised:
        build_program(config_from_plain(CONFIG, [override]))
    assert named in str(raised.value)
