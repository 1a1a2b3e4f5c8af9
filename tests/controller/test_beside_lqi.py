"""docs/outputs/beside_lqi.py with few settings: neither a loop with an estimator nor an LQI leaves an offset."""

import runpy

import pytest

import lyapnet
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import config_from_plain
from lyapnet.value.expansions import riccati
from tests.pages import ROOT
from tests.problems import OfExpansion

HELD = {
    "experiment": "held",
    "system": {"name": "pendulum"},
    "cost": {"Q": [1, 0.1], "R": 0.1, "Q_T": [10, 1]},
    "target": [0.7854, 0],
    "controls": {"lower": -15, "upper": 15},
    "initial_states": {"lower": [-0.6, -1], "upper": [2.2, 1]},
    "horizon": {"steps": 20, "dt": 0.02},
}


@pytest.mark.gate
@pytest.mark.parametrize("case", ["load", "mass + 20 %"])
def test_no_offset_is_left_of_a_pendulum_held(case, capsys, tmp_path):
    script = runpy.run_path(str(ROOT / "docs/outputs/beside_lqi.py"))
    names = script["compare_exact"].__globals__
    names |= {"PRICES": (0.1,), "DRIFTS": (100.0,), "STEPS": 350, "LOOPS": 4}
    names["WEIGHTS"] = [10.0**-3], [10.0**5]
    plant, problem = script["plants"]()[0], build_problem(config_from_plain(HELD))
    trained = lyapnet.Controller(problem, OfExpansion(problem, riccati(problem)).to(problem.goal.dtype))
    runs = script["compare_exact"](plant, case, trained)
    assert len(runs) == 3
    for name, (y, u) in runs.items():
        assert y[-1].abs().max() < 0.005 * plant.setpoint, name
        assert y.abs().max() > 1e-4, "the load moves the pendulum"
        assert float(script["settling"](y[:, None], 0.005 * plant.setpoint)[0]) < 2, name
        assert u.abs().max() <= plant.most
    script["compare_noisy"](plant, case, trained)
    assert capsys.readouterr().out.count("\n") == len(runs) + 2
