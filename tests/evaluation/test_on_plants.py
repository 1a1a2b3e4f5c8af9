"""What evaluations report of plants that differ from the model; and what must fail."""

import math

import pytest
import torch
import yaml
from torch.testing import assert_close

import lyapnet
from lyapnet.cli import main
from lyapnet.evaluation.on_plants import measure_on_plants
from lyapnet.evaluation.oracles import oracle_of
from lyapnet.evaluation.plants_figure import cost_against_parameters
from lyapnet.evaluation.tables import evaluation_table
from lyapnet.loop.random_plants import NominalLaw
from tests.loop.test_random_plants import TASK, plants_of, seeded


def measured(states: int = 8, **changes):
    rollout, plants = plants_of(**changes)
    x0 = rollout.problem.initial_states.sample(states, seeded())
    return rollout, x0, measure_on_plants(plants, x0)


@pytest.mark.gate
def test_the_optimum_is_that_of_each_plant():
    """No closed loop is cheaper; and the law of the model costs as much as by its own rollout."""
    rollout, x0, found = measured()
    assert found.optimal_cost is not None
    assert (found.ratio > 1 - 1e-9).all()
    assert_close(found.cost, found.plants(found.z0).cost)
    one = found.z0[:1]
    member = found.plants.problem.system.member(one[0, 2:])
    alone = oracle_of(rollout.problem.replaced(system=member))(x0[:1])
    assert_close(found.optimal_cost[:1], alone, rtol=1e-6, atol=0)
    of_model = oracle_of(rollout.problem)(x0[:1])
    assert (alone - of_model).abs() > 1e-3 * of_model


@pytest.mark.gate
def test_plants_that_equal_the_model_cost_as_much_as_the_model():
    rollout, x0, found = measured(randomise={"mass": [1.0, 1.0]})
    assert_close(found.cost, rollout(x0).cost)
    assert_close(found.optimal_cost, oracle_of(rollout.problem)(x0), rtol=1e-6, atol=0)


def test_a_closed_loop_that_is_not_finite_is_counted_and_not_averaged_away(monkeypatch):
    def diverging(self, t, x):
        return torch.where(x[..., 2:3] > 1.0, 1e200 * (1 + x[..., :1] ** 2), self.policy(t, x[..., :2]))

    monkeypatch.setattr(NominalLaw, "forward", diverging)
    _, _, found = measured()
    share = float((found.z0[:, 2] <= 1.0).double().mean())
    assert 0 < share < 1
    summary = found.summary()
    assert summary["finite_fraction"] == share
    assert summary["cost_mean"] == math.inf
    assert summary["largest_ratio"] == math.inf
    assert cost_against_parameters(found).axes[0].get_legend() is not None


def test_the_figure_has_a_panel_for_each_parameter():
    figure = cost_against_parameters(measured()[2])
    assert [axes.get_xlabel() for axes in figure.axes] == ["length", "mass"]
    assert figure.axes[0].get_ylabel() == "cost / optimum of the same plant"


@pytest.mark.nightly
def test_training_on_plants_lowers_their_cost(tmp_path, capsys):
    """With lengths ±40 % a law that saw the plants is cheaper on them, and dearer with the model."""
    short = {"iterations": 40, "least_gain": 0}
    content = {
        **TASK,
        "cost": {"Q": [0.5, 0.05], "R": 0.05, "Q_T": [50, 5]},
        "initial_states": {"lower": [2.8, -0.5], "upper": [3.4, 0.5]},
        "horizon": {"steps": 50, "dt": 0.06},
        "training": short,
        "evaluation": {"test_states": 2, "validation_states": 8, "animate": False},
        "loggers": ["csv"],
        "logs": str(tmp_path),
    }
    results = {}
    wide = {"length": [0.6, 1.4]}
    for name, training in (("told_nothing", wide), ("model", {"length": [1.0, 1.0]})):
        path = tmp_path / f"{name}.yaml"
        path.write_text(yaml.safe_dump({**content, "experiment": name, "randomise": training}))
        assert main(["train", "--config", str(path)]) == 0
        checkpoint = f"{tmp_path}/{name}/version_0/checkpoints/last.ckpt"
        controller = lyapnet.load(checkpoint)
        _, plants = plants_of(**{**content, "randomise": wide})
        own = type(plants)(plants.problem, controller._rollout)
        x0 = controller.initial_states.sample(64, seeded(3))
        results[name] = measure_on_plants(own, x0, optimum=False).cost.mean(), controller.rollout(x0).cost.mean()
    assert results["told_nothing"][0] < (1 - 3e-4) * results["model"][0]
    assert results["told_nothing"][1] > results["model"][1]
    result = lyapnet.evaluate(lyapnet.load(f"{tmp_path}/told_nothing/version_0/checkpoints/best.ckpt"), samples=16)
    assert result["plants"]["finite_fraction"] == 1
    assert result["plants"]["cost_ratio"] > 1
    labels = [str(cell) for cell in evaluation_table("title", result).columns[0]._cells]
    assert any("random plants" in label for label in labels)
    capsys.readouterr()


@pytest.mark.gate
def test_a_run_on_plants_resumes_exactly(tmp_path, capsys):
    base = {
        **TASK,
        "training": {
            "learning_rate": 1e-3,
            "final_learning_rate": 1e-3,
            "warmup": 0,
            "validate_every": 3,
            "least_gain": 0,
        },
        "evaluation": {"test_states": 4, "validation_states": 4, "animate": False},
        "loggers": ["csv"],
        "logs": str(tmp_path),
    }
    weights = {}
    for name, steps in (("whole", [6]), ("parts", [3, 6])):
        path = tmp_path / f"{name}.yaml"
        path.write_text(yaml.safe_dump({**base, "experiment": name}))
        for k, count in enumerate(steps):
            again = ["--resume", "last"] if k else []
            assert main(["train", "--config", str(path), f"training.iterations={count}", *again]) == 0
        V = lyapnet.load(f"{tmp_path}/{name}/version_0/checkpoints/last.ckpt").V
        weights[name] = torch.cat([p.flatten() for p in V.parameters()])
    assert torch.equal(weights["whole"], weights["parts"])
    capsys.readouterr()
