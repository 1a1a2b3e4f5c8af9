"""lyapnet check: facts of a task before training, against systems whose facts are known."""

import json
import shlex

import pytest
import torch
import yaml

from lyapnet.cli import main
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import config_from_plain
from lyapnet.task.systems import Linear
from lyapnet.training.build_learner import build_learner
from lyapnet.training.start import Candidate, Start
from lyapnet.training.task_facts import facts_of, unreached_modes
from tests.fits import shorten_fits

TASK = {
    "system": {"name": "pendulum"},
    "cost": {"Q": [1, 0.1], "R": [0.1], "Q_T": [10, 1]},
    "initial_states": {"lower": [-0.5, -0.5], "upper": [0.5, 0.5]},
    "horizon": {"steps": 20, "dt": 0.05},
}


@pytest.fixture(autouse=True)
def _few_optima(monkeypatch):
    monkeypatch.setattr("lyapnet.training.start.MAX_OPTIMA", 12)
    shorten_fits(monkeypatch, 130, 70)
    monkeypatch.setattr("lyapnet.training.pretraining.BRIEF_STEPS", 10)


@pytest.fixture
def without_start(monkeypatch):
    """The start of a training, which is sought last and takes longest, is not sought."""
    monkeypatch.setattr("lyapnet.training.task_facts.load_or_choose_start", lambda *_, **__: None)


def linear(A, B, **changes):
    n = len(A)
    ones = {"Q": [1] * n, "R": [1] * len(B[0]), "Q_T": [1] * n}
    box = {"lower": [-1] * n, "upper": [1] * n}
    return {"experiment": "x", "system": {"name": "linear", "parameters": {"A": A, "B": B}}, "cost": ones,
            "initial_states": box, "horizon": {"steps": 10, "dt": 0.1}, **changes}  # fmt: skip


def facts(content, problem=None):
    config = config_from_plain(content)
    return {fact.name: fact for fact in found_of(config, problem)}


def found_of(config, problem=None, **options):
    return facts_of(build_learner(config, problem or build_problem(config)), **options)


def observed(A, outputs, **changes):
    """The fact of a linear system with a control on each state."""
    config = config_from_plain(linear(A, torch.eye(len(A)).tolist(), outputs=outputs, **changes))
    found = {fact.name: fact for fact in found_of(config, outputs=config.outputs)}
    return found.get("observable")


@pytest.mark.usefixtures("without_start")
def test_states_that_outputs_do_not_tell_are_named():
    """A velocity tells no position, and a position tells both; what nobody sees and decays is not missed."""
    mass = [[0, 1], [0, 0]]
    told = observed(mass, {"measure": ["x1"], "noise": 0.01})
    assert told.found.startswith("yes; standard deviations at T: x1 0.0")
    not_told = observed(mass, {"measure": ["x2"], "noise": 0.01})
    assert not_told.found.startswith("no: the outputs hardly tell x1; ")
    assert "rank 1 of 2" in not_told.found
    assert not_told.advice.startswith("measure x1")
    decaying = observed([[-5, 0], [0, 0]], {"measure": ["x2"], "noise": 0.01})
    assert decaying.found.startswith("yes")
    assert "rank 1 of 2" in decaying.found
    growing = observed([[1, 0], [0, 0]], {"measure": ["x2"], "noise": 0.01})
    assert growing.found.startswith("no: the outputs hardly tell x1; ")
    assert observed(mass, {}) is None


@pytest.mark.usefixtures("without_start")
@pytest.mark.parametrize(("walk", "named"), [(0.01, False), (0.5, True)])
def test_a_parameter_that_walks_faster_than_outputs_tell_is_named(walk, named):
    """The first uncertainty of the length is 0.4/√12 = 0.12 m; the walk of 0.5 m per √s outruns the readings."""
    family = {"system": {"name": "pendulum"}, "family": {"length": [0.8, 1.2]}, "horizon": {"steps": 60, "dt": 0.05}}
    outputs = {"measure": ["angle"], "noise": 0.01, "process_noise": {"length": walk}}
    config = config_from_plain(linear([[0, 1], [0, 0]], [[0], [1]], outputs=outputs, **family))
    (found,) = [fact for fact in found_of(config, outputs=config.outputs) if fact.name == "observable"]
    expected = "no: at T more than half of the first uncertainty is left of length, as it walks; " if named else "yes; "
    assert found.found.startswith(expected)
    assert found.advice.startswith("a smaller walk of length") == named


@pytest.mark.gate
def test_check_names_what_outputs_do_not_tell(tmp_path, capsys):
    (tmp_path / "task.yaml").write_text(yaml.safe_dump(TASK))
    command = ["check", str(tmp_path / "task.yaml"), "--json", "outputs.measure=[angle]"]
    assert main([*command, "outputs.noise=0.01"]) == 0
    facts = {fact["fact"]: fact["found"] for fact in json.loads(capsys.readouterr().out)["facts"]}
    assert facts["outputs"] == "angle ± 0.01"
    assert facts["observable"].startswith("yes")
    for override, message in (
        ("outputs.noise=[0.1,0.2]", "Expected outputs.noise with one entry (angle), got 2"),
        ("outputs.noise=-1", "Expected outputs.noise > 0"),
        ("outputs.noise=null", "Expected outputs.noise, the standard deviation of each reading, got none"),
    ):
        assert main([*command, override]) != 0
        assert message in capsys.readouterr().err


@pytest.mark.usefixtures("without_start")
def test_modes_and_controllability():
    reached = facts(linear([[0, 1], [4, 0]], [[0], [1]]))
    assert reached["modes"].found == "2, -2 1/s at the goal, without feedback"
    assert reached["controllable"].found.startswith("yes")
    lost = facts(linear([[0.5, 0], [0, -1]], [[0], [1]]))["controllable"]
    assert "does not reach 0.5" in lost.found
    assert lost.advice
    assert not facts(linear([[-0.5, 0], [0, -1]], [[0], [1]]))["controllable"].advice, "what decays needs no control"


@pytest.mark.gate
def test_limits_and_what_they_do_not_admit():
    task = linear([[0, 1], [0, 0]], [[0], [1]], controls={"lower": -1, "upper": 2})
    assert "1 control: u1 between -1 and 2" in facts(task)["system"].found
    assert facts(task)["goal"].found == "an equilibrium without control"
    away = facts({**task, "controls": {"lower": 1, "upper": 2}})
    assert away["goal"].found == "u = (0) is beyond its limits"
    assert away["goal"].advice
    assert not any("Riccati" in fact.found for fact in away.values()), "whose V is zero at the goal"


class Falling(Linear):
    """ẋ = Ax + Bu − 1 in its last state, as gravity pulls."""

    def f(self, x):
        return super().f(x) - torch.eye(self.n).to(x)[-1]

    def dynamics(self, x, u):
        return self.f(x) + (self.g(x) @ u[..., None])[..., 0]


@pytest.mark.usefixtures("without_start")
@pytest.mark.parametrize(("B", "words"), [([[0], [2]], "held by u = (0.5)"), ([[1], [0]], "no control holds it")])
def test_a_goal_that_is_no_equilibrium(B, words):
    content = linear([[0, 1], [0, 0]], B)
    problem = build_problem(config_from_plain(content))
    falling = Falling([[0.0, 1.0], [0.0, 0.0]], torch.tensor(B).double().tolist())
    fact = facts(content, problem.replaced(system=falling))["goal"]
    assert words in fact.found
    assert fact.advice
    assert facts(content)["goal"].found == "an equilibrium without control"


@pytest.mark.usefixtures("without_start")
@pytest.mark.gate
def test_the_step_gain_is_that_at_which_the_hjb_law_breaks():
    """ẋ = u, φ = px²: the gain over a step is Δt p/R, and Euler steps of u = −px/R grow above 2."""
    stiff = linear([[0]], [[1]], cost={"Q": [1e-9], "R": [1], "Q_T": [30]})
    for policy in ("hjb", "sontag"):
        fact = facts({**stiff, "rollout": {"policy": policy}})["step gain"]
        assert "= 3 > 2" in fact.found
        assert fact.advice == "rollout.policy=sampled, or horizon.dt ≤ 0.067"
    for policy in ("sampled", "lookahead"):
        fact = facts({**stiff, "rollout": {"policy": policy}})["step gain"]
        assert "= 3 > 2" in fact.found
        assert fact.found.startswith("the law that this config has is stable")
        assert not fact.advice
    assert (
        "every control law" in facts(linear([[0]], [[1]], cost={"Q": [1e-9], "R": [1], "Q_T": [19]}))["step gain"].found
    )


@pytest.mark.usefixtures("without_start")
@pytest.mark.gate
@pytest.mark.parametrize(("method", "least"), [("euler", 2.0), ("midpoint", 2.0), ("rk4", 2.785)])
def test_a_step_that_a_method_cannot_take(method, least):
    """−λΔt at which each becomes unstable (Hairer, Wanner, Solving Ordinary Differential Equations II, § IV.2)."""
    by = {"rollout": {"policy": "sampled", "method": method}}
    name = "Euler" if method == "euler" else method
    assert f"grow under {name} steps" in facts(linear([[-10 * (least + 0.01)]], [[1]], **by))["Δt"].found
    assert "Δt" not in facts(linear([[-10 * (least - 0.01)]], [[1]], **by))


@pytest.mark.gate
def test_what_steps_miss_of_continuous_time():
    """ẋ = u from any x₀ under u = −Kx held: Σ x² of Euler against ∫x² of straight lines."""
    coarse = linear([[0]], [[1]], cost={"Q": [1], "R": [0.1], "Q_T": [1e-3]}, horizon={"steps": 10, "dt": 0.2})
    fact = facts(coarse)["steps"]
    P, K = 1e-3, []
    for _ in range(10):
        K.insert(0, P / (0.1 + 0.2 * P))
        P = 0.2 * (1 + 0.1 * K[0] ** 2) + P * (1 - 0.2 * K[0]) ** 2
    x, euler, true = 1.0, 0.0, 0.0
    for k in K:
        after = x * (1 - 0.2 * k)
        paid = 0.2 * 0.1 * (k * x) ** 2
        euler, true = euler + 0.2 * x**2 + paid, true + 0.2 * (x**2 + x * after + after**2) / 3 + paid
        x = after
    ratio = (true + 1e-3 * x**2) / (euler + 1e-3 * x**2)
    assert f"costs {ratio:.3g} times as much" in fact.found
    assert fact.advice.startswith("rollout.method=rk4")
    assert "steps" not in facts({**coarse, "rollout": {"policy": "sampled", "method": "rk4"}})
    assert "steps" not in facts({**coarse, "horizon": {"steps": 200, "dt": 0.01}})
    chosen = Candidate("an optimum", 1.0, 1.0, 0.0)
    assert "1.05 times" in Start(chosen, [chosen], 1.05).steps_miss
    assert "more than any number" in Start(chosen, [chosen], float("inf")).steps_miss
    assert not Start(chosen._replace(cost=float("inf"), finite=0.5), [chosen], 3.0).steps_miss, "nothing to compare"


@pytest.mark.gate
def test_a_start_that_is_not_finite_says_so():
    content = {**TASK, "experiment": "x", "rollout": {"policy": "hjb"}, "cost": {**TASK["cost"], "R": [1e-9]}}
    found = found_of(config_from_plain({**content, "horizon": {"steps": 150, "dt": 0.05}}))
    assert any("from the Riccati solution at the goal: finite on 0%" in fact.found for fact in found)


@pytest.mark.gate
def test_the_command(tmp_path, capsys):
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(TASK))
    assert main(["check", str(path)]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith("mine.yaml, before training\nhorizon       T = 1 s in 20 steps of 0.05 s\n")
    assert f"lyapnet train --config {path}" in shown
    assert main(["check", str(path), "horizon.steps=10", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["experiment"] == "mine"
    assert report["complete"]
    assert [fact["found"] for fact in report["facts"][:3]] == [
        "T = 0.5 s in 10 steps of 0.05 s", "between (-0.5, -0.5) and (0.5, 0.5)", "Pendulum: 2 states, 1 control",
    ]  # fmt: skip
    both = ["initial_states.lower=-0.5", "initial_states.upper=0.5", "--json"]
    assert main(["check", str(path), *both]) == 0
    assert json.loads(capsys.readouterr().out)["facts"][1]["found"] == "each state between -0.5 and 0.5"
    assert report["facts"][-1]["found"] == "training starts from 12 optima from states of X₀"
    assert main(["check", str(path), "network.name=fcn", "--json"]) == 0
    assert "expansion" in json.loads(capsys.readouterr().out)["facts"][-1]["advice"]
    path.write_text(yaml.safe_dump({**TASK, "horizon": {"stepz": 3}}))
    assert main(["check", str(path)]) == 2
    assert "horizon.stepz" in capsys.readouterr().err


def test_the_problem_keeps_its_precision():
    config = config_from_plain(linear([[0, 1], [0, 0]], [[0], [1]], training={"precision": "float32"}))
    learner = build_learner(config, build_problem(config))
    facts_of(learner)
    assert learner.problem.goal.dtype == learner.problem.system.A.dtype == torch.float32


def test_the_next_command_is_the_experiment_that_was_checked(tmp_path, capsys):
    path = tmp_path / "my task.yaml"
    path.write_text(yaml.safe_dump(TASK))
    assert main(["check", str(path), "network.name=fcn", "network.hidden=[4, 4]"]) == 0
    command = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("train"))
    expected = ["lyapnet", "train", "--config", str(path), "network.name=fcn", "network.hidden=[4, 4]"]
    assert shlex.split(command)[1:] == expected


@pytest.mark.parametrize(
    ("A", "B", "extent"),
    [
        ([[0, 1], [-1e12, 0]], [[0], [1e12]], [1, 1]),  # a mass of 1e-12 on a spring
        ([[0, 1], [0, 0]], [[0], [1e12]], [1, 1]),
        ([[0, 1], [0, 0]], [[0], [1]], [1e-9, 1e3]),
        ([[-1e9, 0], [1e12, -1e6]], [[1e9], [0]], [1, 1]),
    ],
)
def test_units_do_not_decide_what_is_reached(A, B, extent):
    matrices = [torch.tensor(each, dtype=torch.float64) for each in (A, B, extent)]
    assert not len(unreached_modes(*matrices))
    A, B, extent = matrices
    lost = torch.block_diag(A, torch.tensor([[-3.0]]))
    assert len(unreached_modes(lost, torch.cat([B, torch.zeros(1, 1)]), torch.cat([extent, torch.ones(1)]))) == 1


def test_a_mode_is_unreached_as_often_as_it_is():
    alike = unreached_modes(torch.zeros(3, 3), torch.tensor([[1.0, 0], [0, 1], [0, 0]]), torch.ones(3))
    assert len(alike) == 1, "of three alike one"
    assert not len(unreached_modes(torch.zeros(2, 2), torch.eye(2), torch.ones(2)))
