"""A network from a user's module, the example of docs/own_system.md: built by YAML, differentiated, trained, loaded."""

import importlib

import pytest
import torch
from torch.testing import assert_close

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly import build_problem, build_value_function
from lyapnet.experiment.config import config_from_plain
from tests.pages import ROOT, blocks
from tests.runs import SMALL

(MODULE,) = [block for block in blocks("python", ROOT / "docs" / "own_system.md") if "class Waves(" in block]
CONFIG = {
    **SMALL,
    "program": {"name": "value", "constraint": 0, "cost_to_go": 1, "trajectory_cost": 1},
    "network": {"name": "waves:Waves", "hidden": [16]},
    "training": {"iterations": 2, "batch_size": 6},
    "loggers": ["csv"],
}


@pytest.fixture
def module(tmp_path, monkeypatch):
    (tmp_path / "waves.py").write_text(MODULE, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    yield importlib.import_module("waves")
    del __import__("sys").modules["waves"]


def test_it_is_built_by_the_config(module):
    config = config_from_plain(CONFIG)
    problem = build_problem(config)
    V = build_value_function(config, problem)
    assert isinstance(V, module.Waves)
    assert V.waves.out_features == 16
    t, x = torch.tensor(0.3), problem.initial_states.sample(4)
    value, slope = V.value_and_state_gradient(t, x)
    h = 1e-6 * torch.eye(2).to(x)
    differences = (V(t, x[:, None] + h) - V(t, x[:, None] - h)) / 2e-6
    assert value.shape == (4,)
    assert_close(slope, differences, rtol=1e-6, atol=1e-6)


@pytest.mark.usefixtures("module")
def test_an_option_that_it_lacks_is_refused():
    config = config_from_plain({**CONFIG, "network": {**CONFIG["network"], "activation": "tanh"}})
    with pytest.raises(UsageError, match=r"network\.activation"):
        build_value_function(config, build_problem(config))


@pytest.mark.gate
def test_it_is_trained_and_loaded(module, tmp_path):
    run = lyapnet.train(CONFIG, [f"logs={tmp_path}"])
    controller = lyapnet.load(run.best, network=module.Waves)
    assert controller.rollout([[0.5, 0.1]]).cost.shape == (1,)
    with pytest.raises(UsageError, match="network"):
        lyapnet.load(run.best)
