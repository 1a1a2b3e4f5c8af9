"""The start of a training: chosen by trying, of all that is known before the first step."""

import dataclasses
import json
import math

import pytest
import torch
from torch.testing import assert_close

from lyapnet import ControlAffineSystem, Cost, load, train
from lyapnet.base.errors import UsageError
from lyapnet.cli import main
from lyapnet.evaluation.oracles import discrete_riccati
from lyapnet.experiment.assembly import Parts
from lyapnet.experiment.checkpoint import read_checkpoint
from lyapnet.experiment.config import config_from_plain
from lyapnet.loop.programs.terms import costs_to_go
from lyapnet.task.systems import Linear
from lyapnet.training import initial_networks, pretraining
from lyapnet.training import start as start_module
from lyapnet.training.build import build_module
from lyapnet.training.candidates import ZERO_VALUE
from lyapnet.training.initial_networks import raise_to_costs
from lyapnet.training.optimizer import OptimizerOptions
from lyapnet.training.start import ANOTHER_WAY, LOOPS_UNDER_NOISE, choose_start, expansions_of
from lyapnet.value.expansions import optimal_trajectories
from lyapnet.value.networks import ExpansionNetwork
from tests.fits import few_optima
from tests.marks import sample

LINEAR = {
    "experiment": "mine",
    "system": {"name": "double_integrator"},
    "cost": {"Q": [10, 0.1], "R": [1], "Q_T": [10, 0.1]},
    "initial_states": {"lower": [-1, -0.7], "upper": [1, 0.7]},
    "horizon": {"steps": 50, "dt": 0.05},
}
SWING = LINEAR | {
    "system": {"name": "pendulum"},
    "cost": {"Q": [0.5, 0.05], "R": [0.05], "Q_T": [50, 5]},
    "initial_states": {"lower": [math.pi - 0.3, -0.5], "upper": [math.pi + 0.3, 0.5]},
    "horizon": {"steps": 60, "dt": 0.04},
}


@pytest.fixture(scope="module", autouse=True)
def _few_optima():
    with few_optima(12, 130, 70):
        yield


def started(content, *overrides, **options):
    module = build_module(config_from_plain(content, overrides))
    return module.members, choose_start(list(module.members), **options)


@pytest.fixture(scope="module")
def swing():
    """The learner of the swing-up where it starts from, that start, and what was told meanwhile."""
    told = {}
    (learner,), start = started(SWING, report=lambda stage, *counts: told.setdefault(stage, []).append(counts))
    return learner, start, told


@pytest.mark.gate
def test_a_linear_task_is_solved_before_the_first_step(monkeypatch):
    monkeypatch.setattr("lyapnet.training.start.optima_for", None)  # no step gains on Riccati's law: none is sought
    (learner,), start = started(LINEAR)
    problem = learner.problem
    assert "Riccati" in start.chosen.name
    assert [candidate.name for candidate in start.candidates] == [ZERO_VALUE, start.chosen.name], (
        "X₀ is around the goal"
    )
    x = problem.initial_states.sample(20)
    exact = discrete_riccati(problem.system, problem.cost, problem.horizon)
    assert_close(learner.rollout(x).cost, exact.value(0, x), rtol=1e-5, atol=0)
    assert_close(learner.V(torch.zeros(()), x), exact.value(0, x), rtol=1e-9, atol=0)


@pytest.mark.gate
def test_what_training_starts_from_stays_the_best_where_nothing_is_better(tmp_path):
    run = train(
        {**LINEAR, "logs": str(tmp_path)},
        ["training.iterations=4", "training.validate_every=2", "evaluation.figures_every=100", "rollout.compile=off"],
    )
    assert read_checkpoint(run.best)["global_step"] == 0
    assert read_checkpoint(run.last)["global_step"] == 4
    assert run.evaluation["cost_ratio"] == pytest.approx(1, abs=1e-4)


def test_the_learning_rate_rises_before_it_falls():
    options = OptimizerOptions(learning_rate=0.1, final_learning_rate=0.01, warmup=4)
    without = dataclasses.replace(options, warmup=0)
    shares = [options.rate(step, 20) / without.rate(step, 20) for step in range(21)]
    assert shares == pytest.approx([0.2, 0.4, 0.6, 0.8] + 17 * [1.0])
    assert config_from_plain(LINEAR).training.warmup > 0


@pytest.mark.gate
def test_far_from_the_goal_optima_are_the_best_start(swing):
    learner, start, told = swing
    stages = ["the optimum from the centre of X₀", "optima from 12 states of X₀ within 30 s of work",
              "fitting V to 12 optima within 60 s of work"]  # fmt: skip
    assert [stage for stage in told if stage in stages] == stages
    assert told[stages[1]][-1] == (12, 12)
    assert told[stages[2]][-1] == (129, 130)
    assert "optim" in start.chosen.name
    costs = {candidate.name: candidate.cost for candidate in start.candidates}
    assert {"the optimum from the centre of X₀", "12 optima from states of X₀"} < costs.keys()
    assert start.chosen.cost == min(costs.values())
    seconds = [candidate.seconds for candidate in start.candidates]
    assert seconds[1] > 0
    assert seconds[1:] == sorted(seconds[1:])
    assert seconds[2] < seconds[0] < seconds[3], "V = 0 is tried where what is quick to know is known"
    assert costs[ZERO_VALUE] > 10 * start.chosen.cost
    mean = learner.rollout(learner.problem.initial_states.sample(64)).cost.mean()
    assert float(mean.detach()) == pytest.approx(start.chosen.cost, rel=0.05)


@pytest.mark.gate
def test_within_limits_optima_are_a_start_too(swing, tmp_path, capsys):
    """Without limits, the best start costs less, and its controls are larger."""
    limited = {**SWING, "controls": {"lower": -9, "upper": 9}, "logs": str(tmp_path)}
    brief = ["training.iterations=2", "evaluation.test_states=4", "evaluation.validation_states=4", "loggers=[csv]",
             "rollout.compile=off"]  # fmt: skip
    run = train(limited, brief)
    used = run.evaluation["at_limits"]["torque"]
    assert used["states"] == 1
    assert 0 < used["lower"] + used["upper"] < 0.5
    assert run.evaluation["cost_ratio"] < 1.2
    assert main(["evaluate", str(run.best), "--samples", "3"]) == 0
    assert "torque at its lower, upper limit" in " ".join(capsys.readouterr().out.split())
    trajectory = load(run.best).rollout(torch.tensor([[math.pi, 0.2]]))
    assert float(trajectory.u.abs().max()) == 9
    unlimited, *_ = swing
    assert float(unlimited.rollout(torch.tensor([[math.pi, 0.2]])).u.detach().abs().max()) > 9


@pytest.mark.gate
@pytest.mark.parametrize("task", sample([LINEAR, SWING], 2))
def test_an_X0_of_one_point(task):
    point = {"lower": task["initial_states"]["lower"], "upper": task["initial_states"]["lower"]}
    (learner,), start = started({**task, "initial_states": point})
    assert start.chosen.finite == 1
    assert start.chosen.cost < start.candidates[0].cost / 2
    assert all(buffer.isfinite().all() for buffer in learner.V.buffers())


@pytest.mark.gate
def test_every_seed_of_an_ensemble_starts_from_it():
    members, start = started(LINEAR, "seeds=2")
    x = members[0].problem.initial_states.sample(5)
    values = [member.V(torch.zeros(()), x) for member in members]
    assert_close(values[0], values[1])
    assert start.chosen.cost < start.candidates[0].cost
    weights = [member.V.network.hidden[0].weight for member in members]
    assert not torch.equal(weights[0], weights[1]), "their networks differ all the same"


@pytest.mark.gate
def test_states_that_V_ignores_are_left_out_of_the_expansion():
    task = LINEAR | {
        "system": {"name": "linear", "parameters": {"A": [[0, 1, 0], [0, 0, 0], [0, 0, -1]], "B": [[0], [1], [0]]}},
        "cost": {"Q": [10, 0.1, 0], "R": [1], "Q_T": [10, 0.1, 0]},
        "initial_states": {"lower": [-1, -0.7, -1], "upper": [1, 0.7, 1]},
        "network": {"ignored_states": ["x3"]},
    }
    names = build_module(config_from_plain({**task, "network": {}})).members[0].problem.system.state_names
    task["network"]["ignored_states"] = [names[2]]
    (learner,), start = started(task)
    (whole,), same = started(LINEAR)
    x = learner.problem.initial_states.sample(5)
    assert_close(learner.V(torch.zeros(()), x), whole.V(torch.zeros(()), x[:, :2]), rtol=1e-9, atol=0)
    assert start.chosen.cost == pytest.approx(same.chosen.cost, rel=0.3)


@pytest.mark.gate
@pytest.mark.parametrize("wrong", [False, True])
def test_a_fit_does_not_begin_with_an_expansion_that_is_worse_than_nothing(wrong, monkeypatch):
    def bent(problem, *told):
        for name, expansion in expansions_of(problem, *told):
            yield name, expansion._replace(hessian=30 * expansion.hessian) if wrong else expansion

    monkeypatch.setattr("lyapnet.training.start.expansions_of", bent)
    (learner,), start = started(SWING)
    assert start.chosen.cost < 20
    assert start.chosen.name == "12 optima from states of X₀" or not wrong
    t = torch.zeros(())
    value, slope, *_ = learner.V.expansion(t)
    assert (value == slope == 0) == wrong
    assert bool(learner.V.curvature(t).any()), "what stands for V_xx in the law comes from the optima then"


@pytest.mark.gate
def test_fitting_to_optima_is_kept_where_it_is_better_and_taken_back_where_not(monkeypatch):
    """A cart-pole that is to be balanced: Riccati's law costs a few per cent more than the optimum."""
    task = LINEAR | {
        "system": {"name": "cartpole", "parameters": {"pole_mass": 0.1, "length": 0.3}},
        "cost": {"Q": [0, 25, 0.5, 0.1], "R": [1], "Q_T": [0, 25, 0.5, 0.1]},
        "initial_states": {"lower": [-0.6, -0.6, -0.2, -0.2], "upper": [0.6, 0.6, 0.2, 0.2]},
        "horizon": {"steps": 40, "dt": 0.02},
    }
    _, better = started(task)
    assert better.chosen.name == "12 optima from states of X₀"
    monkeypatch.setattr(pretraining, "SMOOTH", pretraining.SMOOTH._replace(rate=(1e3, 1e3)))
    (learner,), taken_back = started(task)
    assert taken_back.chosen.name == "the Riccati solution at the goal"
    assert not learner.V.network.output.weight.any(), "the network is zero again"


def test_a_network_without_a_place_for_it_starts_as_it_is():
    assert started(LINEAR, "network.name=fcn")[1] is None


@pytest.mark.gate
def test_a_run_records_its_start_and_loads_with_it(tmp_path, capsys):
    brief = ["training.iterations=2", "evaluation.test_states=4", "evaluation.validation_states=4", "loggers=[csv]",
             "rollout.compile=off"]  # fmt: skip
    run = train(LINEAR | {"logs": str(tmp_path)}, brief)
    record = json.loads((run.folder / "run.json").read_text())["start"]
    assert record["chosen"] == "the Riccati solution at the goal"
    assert record["seconds"].keys() == record["tried"].keys()
    assert record["tried"][ZERO_VALUE] > record["tried"][record["chosen"]]
    assert "start: the Riccati solution at the goal, the cheapest of" in capsys.readouterr().out
    controller = load(run.best)
    assert controller.config.rollout.policy == "sampled"
    again = train(LINEAR | {"logs": str(tmp_path)}, ["training.iterations=3", *brief[1:]], resume="last")
    assert "start:" not in capsys.readouterr().out, "a run that goes on has its start behind it"
    assert again.folder == run.folder


def test_exact_terminal_values_are_not_for_it():
    with pytest.raises(UsageError, match="terminal"):
        build_module(config_from_plain(LINEAR, ["network.terminal=exact"]))


class Rooted(ControlAffineSystem):
    """A block with drag √(v²) v: f has no finite slope at rest, and so at the goal."""

    state_names, state_units, control_names, control_units = ("p", "v"), ("m", "m/s"), ("u",), ("N",)

    def f(self, x):
        return torch.stack([x[..., 1], -0.3 * x[..., 1].square().sqrt() * x[..., 1]], -1)

    def g(self, x):
        return torch.tensor([[0.0], [1.0]]).to(x).expand(*x.shape[:-1], 2, 1)


@pytest.mark.gate
def test_optima_are_sought_where_there_is_no_expansion():
    """Around a goal at which f has no slope, where the centre of X₀ says nothing."""
    task = {**LINEAR, "system": {"name": "mine:Rooted"}, "initial_states": {"lower": [-2, -1], "upper": [2, 1]}}
    module = build_module(config_from_plain(task), Parts(system=Rooted()))
    start = choose_start(list(module.members))
    names = [candidate.name for candidate in start.candidates if candidate.missing is None]
    assert start.chosen.name == "12 optima from states of X₀"
    assert "the optimum from the centre of X₀" not in names
    assert "no Riccati solution at the goal: f + gu* has no finite slope" in str(start)
    x = module.members[0].problem.initial_states.sample(64)
    smooth = drag_without_root(module.members[0].problem)
    guess = torch.zeros(50, 64, 1)
    optimum = optimal_trajectories(smooth, x, guess).path.cost
    cost = module.members[0].rollout(x).cost.detach()
    assert float((cost / optimum).median()) < 1.03
    calm = next(candidate for candidate in start.candidates if candidate.name == ZERO_VALUE)
    assert calm.cost > 1.5 * start.chosen.cost, "what it was before"


def drag_without_root(problem):
    class Smooth(Rooted):
        def f(self, x):
            return torch.stack([x[..., 1], -0.3 * x[..., 1].abs() * x[..., 1]], -1)

    return problem.replaced(system=Smooth())


@pytest.mark.gate
@pytest.mark.parametrize("sigma", [0.5, 0.1])
def test_under_strong_noise_training_starts_on_another_way(sigma):
    """Around the wall with a gap, through which the optimum without noise leads."""
    _, start = started({
        "experiment": "gap",
        "system": {"name": "tests.noise_tasks.walker.system:Walker"},
        "cost": {"name": "tests.noise_tasks.walker.system:Wall"},
        "initial_states": {"lower": [0, -0.2], "upper": [0, 0.2]},
        "horizon": {"steps": 100, "dt": 0.02},
        "noise": {"aside": sigma},
    })  # fmt: skip
    assert (start.chosen.name == ANOTHER_WAY) == (sigma == 0.5)
    assert (ANOTHER_WAY in [each.name for each in start.candidates]) == (sigma == 0.5)


class Logarithm(Cost):
    """u² on the way, and 3 log(1 + x²) at the end, which no quadratic function equals."""

    R_constant = torch.eye(1)

    def state(self, x):
        return torch.zeros_like(x[..., 0])

    def R(self, x):
        return self.R_constant.expand(*x.shape, 1)

    def terminal(self, x):
        return 3 * torch.log(1 + x[..., 0] ** 2)


class Drift(Linear):
    """dx = u dt."""

    def __init__(self):
        super().__init__([[0.0]], [[1.0]])


FROM_A_POINT = {
    "experiment": "mine",
    "system": {"name": f"{__name__}:Drift"},
    "cost": {"name": f"{__name__}:Logarithm"},
    "initial_states": {"lower": 0, "upper": 0},
    "horizon": {"steps": 20, "dt": 0.05},
    "noise": {"x1": 1.0},
}


@pytest.mark.gate
@pytest.mark.parametrize("measured", [True, False])
def test_under_noise_V_starts_with_the_mean_of_the_costs_to_go(measured, monkeypatch):
    if not measured:
        monkeypatch.setattr(start_module, "raise_to_costs", lambda *_: None)
    (learner,), start = started(FROM_A_POINT | {"noise": {"x1": 4.0}})
    assert start.chosen.name == LOOPS_UNDER_NOISE
    path = learner.roll_out(torch.zeros(4096, 1), 5).compensated()
    missed = costs_to_go(path.step_cost, path.terminal_cost) - path.require_value()
    assert (missed.mean(1).abs().max() < 0.015 * path.cost.mean()) == measured


@pytest.mark.gate
def test_a_measured_level_changes_nothing_where_V_is_the_cost_to_go(monkeypatch):
    rises = []
    monkeypatch.setattr(ExpansionNetwork, "raise_by", lambda self, t, rise: rises.append(rise))
    (learner,), _ = started(LINEAR | {"noise": {"velocity": 0.4}})
    assert learner.V(torch.tensor(0.0), torch.zeros(2)) > 0.9
    assert rises[0].abs().max() < 1e-5
    learner.V.expansion.values[:, 0] += 0.1  # the counterpart
    x0 = torch.zeros(8, 2)
    raise_to_costs(learner, x0, learner.problem.noise.draw(50, 0.05, x0, torch.Generator().manual_seed(0)))
    assert_close(rises[1], torch.full((51,), -0.1), rtol=0, atol=1e-5)


@pytest.mark.gate
@pytest.mark.parametrize("spread", [True, False])
def test_a_network_can_learn_where_noise_leads_from_a_single_point(spread, monkeypatch):
    if not spread:
        monkeypatch.setattr(initial_networks, "_deviations", lambda problem, expansion, x0: 0 * x0.double()[None])
    (learner,), _ = started(FROM_A_POINT)
    assert (learner.V.scale > 0.1) == spread
    assert (learner.V.coordinates.abs() < 3) == spread, "one standard deviation of x is about one unit of the network"
