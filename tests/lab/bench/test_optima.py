"""The seconds for the optima of a training, and their costs beside the oracle's."""

import json
import math

import pytest
import torch

from lyapnet.cli import main
from lyapnet.lab.bench import load_case
from lyapnet.lab.bench import optima as bench
from lyapnet.lab.bench.optima import time_optima

SMALL = ["horizon.steps=20"]


@pytest.mark.gate
def test_optima_of_a_linear_task_cost_what_riccati_says():
    row = time_optima(load_case("double_integrator", SMALL), 16)
    assert (row.task, row.states, row.controls, row.steps) == ("double_integrator", 2, 1, 20)
    assert row.found == row.asked == 512
    assert row.compared == 16
    assert -1e-9 <= row.largest_excess < 1e-9
    assert row.as_low == 1
    assert row.seconds > 0


def test_optima_that_are_none_show_an_excess(monkeypatch):
    """The twin: half of the optima cost a tenth more."""

    def spoiled(*arguments):
        found = optima_for(*arguments)
        cost = found.path.cost * torch.where(torch.arange(len(found.path.cost)) % 2 == 0, 1.1, 1.0)
        return found._replace(path=found.path._replace(cost=cost))

    optima_for = bench.optima_for
    monkeypatch.setattr(bench, "optima_for", spoiled)
    row = time_optima(load_case("double_integrator", SMALL), 16)
    assert row.largest_excess == pytest.approx(0.1)
    assert row.as_low == 0.5


@pytest.mark.gate
def test_the_command_prints_a_row_for_each_task(capsys):
    tasks = ["--task", "double_integrator", "--task", "pendulum_swingup"]
    assert main(["bench", "optima", *tasks, "--compared", "0", *SMALL]) == 0
    printed = capsys.readouterr().out
    assert "pendulum_swingup" in printed
    assert "–" in printed
    assert main(["bench", "optima", "--compared", "4", "--json", *SMALL]) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert row["compared"] == 4
    assert math.isfinite(row["largest_excess"])
    assert main(["bench", "optima", "--compared", "0", "--json", *SMALL]) == 0
    assert json.loads(capsys.readouterr().out)[0]["largest_excess"] is None
