"""One floating-point type for all that a command computes: constants of a user's own code among it."""

import json

import pytest
import torch
import yaml

import lyapnet
from lyapnet.cli import main
from lyapnet.evaluation.oracles import oracle_of
from lyapnet.training.experiment import train
from tests.problems import untrained

SEEN = set()


class Charger(lyapnet.ControlAffineSystem):
    """With constants that take the default type, as 1/L in float32 is another number by 5e-8."""

    state_names, state_units = ("current",), ("A",)
    control_names, control_units = ("voltage",), ("V",)
    L = 3e-4

    def f(self, x):
        SEEN.add(torch.get_default_dtype())
        return torch.tensor([0.3 / self.L]).to(x) * (0.1 - x)

    def g(self, x):
        return torch.tensor([[1 / self.L]]).to(x).expand(*x.shape[:-1], 1, 1)


TASK = {
    "experiment": "charger", "system": {"name": f"{__name__}:Charger"}, "cost": {"Q": 1, "R": 1, "Q_T": 1},
    "target": 0.37, "initial_states": {"lower": 0, "upper": 0.5}, "horizon": {"steps": 4, "dt": 1e-4},
    "network": {"name": "fcn", "hidden": [4]}, "program": {"name": "value"}, "loggers": ["csv"],
    "training": {"iterations": 1, "batch_size": 2}, "rollout": {"compile": "off"},
    "evaluation": {"validation_states": 2, "test_states": 2, "optimum": False, "animate": False},
}  # fmt: skip


@pytest.fixture
def plain_default():
    """As outside of the tests, where the default is float32."""
    torch.set_default_dtype(torch.float32)
    yield
    torch.set_default_dtype(torch.float64)


@pytest.mark.gate
@pytest.mark.parametrize(("precision", "also"), [("float64", set()), ("float32", {torch.float32})])
def test_commands_have_the_type_of_their_precision(tmp_path, capsys, plain_default, precision, also):
    task = tmp_path / "charger.yaml"
    task.write_text(
        yaml.safe_dump({**TASK, "logs": str(tmp_path), "training": {**TASK["training"], "precision": precision}})
    )
    SEEN.clear()
    run = train(task)
    assert SEEN - also == {torch.float64}, "the build and its checks are in float64"
    for command in (["train", "--config", str(task)], ["check", str(task), "--json"], ["trim", str(task), "--json"],
                    ["evaluate", str(run.best), "--system", TASK["system"]["name"], "--json"]):  # fmt: skip
        SEEN.clear()
        assert main(command) == 0
        assert not SEEN - also - {torch.float64}
        assert torch.get_default_dtype() == torch.float32, "as it was before"
    told = capsys.readouterr().out
    facts = {fact["fact"]: fact["found"] for line in told.splitlines() if line.startswith('{"experiment"')
             for fact in json.loads(line).get("facts", [])}  # fmt: skip
    assert facts["goal"].startswith("(0.37), an equilibrium at u = (0.081")


def test_optima_of_many_free_controls_need_no_default(plain_default):
    pytest.importorskip("casadi")
    problem = untrained("quadrotor", "horizon.steps=4").problem
    optima = oracle_of(problem).solve(problem.initial_states.sample(1))
    assert optima.cost.isfinite().all()
