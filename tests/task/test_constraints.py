"""State constraints: against formulas and closed forms; through optimum, training, evaluation and checkpoints."""

import dataclasses
import math

import pytest
import torch
from torch.testing import assert_close

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.evaluation import evaluate
from lyapnet.evaluation.measurement import evaluation
from lyapnet.evaluation.oracles import RiccatiOracle, oracle_of
from lyapnet.evaluation.path_figure import has_plane, paths
from lyapnet.experiment.assembly import Parts, build_problem
from lyapnet.experiment.checkpoint import KEY, read_checkpoint
from lyapnet.experiment.config import config_from_plain, load_config
from lyapnet.lab.comparison.reference_problems import bounded_problem
from lyapnet.task.constraints import AllOf, Ball, Constraints, OfFirstStates, StateLimits, parts_of
from lyapnet.task.cost import PenaltyCost
from lyapnet.training.build_learner import build_learner
from lyapnet.training.modules import ValueModule
from lyapnet.training.penalty_weight import find_penalty_weight
from lyapnet.training.stage_messages import silent
from lyapnet.training.task_facts import facts_of
from lyapnet.value.expansions import greedy_law, optimal_trajectories, path_under, riccati
from tests.configs import objects
from tests.fits import shorten_fits
from tests.problems import CONF
from tests.tasks_without_goal import tasks as tasks_without_goal

INTEGRATOR = {
    "experiment": "constrained",
    "system": {"name": "double_integrator"},
    "cost": {"Q": [1, 0.1], "R": [0.1], "Q_T": [10, 1]},
    "initial_states": {"lower": [-1, -0.2], "upper": [1, 0.2]},
    "horizon": {"steps": 40, "dt": 0.05},
}
SPEED = {"lower": {"velocity": -0.5}, "upper": {"velocity": 0.5}}
BRIEF = ["training.iterations=2", "training.validate_every=1", "rollout.gradient=backprop", "evaluation.test_states=8",
         "evaluation.validation_states=4"]  # fmt: skip


def constrained(**constraints):
    return {**INTEGRATOR, "constraints": constraints}


def problem_of(content, *overrides, parts=None):
    return build_problem(config_from_plain(content, overrides), parts)


def bryson_denham(limit, *overrides):
    return objects(load_config(CONF / "bryson_denham.yaml", [f"constraints.upper.position={limit}", *overrides]))[0]


class Tube(Constraints):
    """|position + velocity| ≤ reach, squared: a user's own."""

    names = ("tube",)

    def __init__(self, reach=2.0):
        super().__init__()
        self.reach = reach

    def forward(self, x):
        return ((x[..., 0] + x[..., 1]) ** 2 / self.reach**2 - 1)[..., None]


def test_limits_and_balls():
    x = torch.randn(50, 3)
    limits = StateLimits([0, 2], [1.0, -2.0], [1.0, -1.0], [2.0, 0.5])
    assert_close(limits(x), torch.stack([(x[:, 0] - 1) / 2, (-2 - x[:, 2]) / 0.5], -1))
    outside, inside = (Ball([0, 1], [1.0, 0.5], 0.4, side) for side in (False, True))
    distance = torch.linalg.vector_norm(x[:, :2] - torch.tensor([1.0, 0.5]), dim=-1, keepdim=True)
    assert torch.equal(outside(x) > 0, distance < 0.4)
    assert_close(inside(x), -outside(x))
    edge = torch.tensor([[1.0 + 0.4 * 0.99, 0.5, 0.0]])
    assert float(outside(edge)) == pytest.approx(0.01, rel=0.01), "how deep, in units of the radius"
    both = AllOf([limits, AllOf([outside])])
    assert_close(both(x), torch.cat([limits(x), outside(x)], -1))
    assert [type(part) for part in parts_of(both)] == [StateLimits, Ball]
    assert_close(both.worst(x), both(x).amax(-1))
    assert [both.ignores(i, 4) for i in range(4)] == [False, False, False, True]


def test_a_config_names_them_and_scales_limits_by_their_distance_from_the_goal():
    outside = [{"center": {"position": 2, "velocity": 0}, "radius": 0.3}]
    content = constrained(upper={"position": 1.5}, lower={"position": -1.0}, outside=outside)
    h = problem_of(content, "target=[1,0]").constraints
    assert h.names == ("position ≥ -1 m", "position ≤ 1.5 m", "outside 0.3 around position = 2, velocity = 0")
    assert_close(h(torch.tensor([1.25, 0.0]))[:2], torch.tensor([-2.25 / 2, -0.5]))
    touching = problem_of(constrained(upper={"position": 1}), "target=[1,0]").constraints
    assert_close(touching(torch.tensor([0.0, 0.0])), torch.tensor([-0.5])), "the goal is at it: as far as X₀ reaches"


def test_without_a_goal_limits_are_scaled_by_how_far_x0_reaches_from_them():
    """A room that is to stay above 20 °C is not 20 units away from 0 °C, nor 293 from 0 K."""
    house = tasks_without_goal.problem_of("heating")
    x = house.initial_states.center
    x[0] = 20.5
    assert house.constraints is not None
    assert_close(house.constraints(x)[0], torch.tensor(-0.25, dtype=x.dtype)), "from 20 to 22"


@pytest.mark.parametrize(
    ("constraints", "message"),
    [
        ({"upper": {"speed": 1}}, "constraints.upper among position, velocity, got 'speed'"),
        ({"upper": {"position": "high"}}, "constraints.upper"),
        ({"upper": [1, 2]}, "constraints.upper"),
        ({"outside": [{"center": {"position": 3}}]}, "constraints.outside, each as"),
        ({"outside": [{"center": {"place": 3}, "radius": 1}]}, "constraints.outside.0..center among position"),
        ({"outside": [{"center": {"position": 3}, "radius": 0}]}, "radius > 0"),
        ({"upper": {"position": 0.5}}, "X₀ within the constraints, got .*% of its states outside"),
        ({"name": "own"}, "constraints.name as one of listed, or module:Class"),
        ({"name": "tests.task.test_cost:nothing"}, "constraints.name"),
        ({"margin": 0}, "constraints.margin > 0"),
    ],
)
def test_what_does_not_fit_is_refused(constraints, message):
    with pytest.raises(UsageError, match=message):
        problem_of(constrained(**constraints))


def test_the_penalty():
    problem, m = problem_of(constrained(**SPEED, margin=0.02)).relaxed(weight=3.0), 0.02
    cost = problem.cost
    assert isinstance(cost, PenaltyCost)
    v = torch.tensor([0.0, 0.5 * (1 - 1.01 * m), 0.5 * (1 - m / 2), 0.5, 0.5 * (1 + m), -0.5])
    x = torch.stack([torch.zeros_like(v), v], -1)
    paid = 3.0 * torch.tensor([0, 0, 1 / 8, 1, 8, 1])
    assert_close(cost.state(x) - cost.cost.state(x), paid, atol=1e-9, rtol=1e-9)
    end = problem.horizon.dt * paid  # the last state pays for a step
    assert_close(cost.terminal(x) - cost.cost.terminal(x), end, atol=1e-9, rtol=1e-9)
    assert not problem_of(constrained()).constraints
    assert problem_of(constrained()).relaxed().constraints is None


@pytest.mark.gate
@pytest.mark.parametrize("limit", [0.25, 1 / 6, 0.1])
def test_the_oracle_finds_the_closed_form_of_bryson_and_denham(limit):
    """J* = 2, 2 + 6(1 − 4a)² and 4/(9a), of the continuous task with fixed end."""
    pytest.importorskip("casadi")
    problem = bryson_denham(limit)
    J = 4 / (9 * limit) if limit < 1 / 6 else 2 + 6 * (1 - 4 * limit) ** 2
    optima = oracle_of(problem).solve(problem.initial_states.sample(1))
    assert float(optima.cost) == pytest.approx(J, rel=2e-3)
    free = problem_of(constrained()).replaced(constraints=None)
    assert isinstance(oracle_of(free), RiccatiOracle)
    assert not isinstance(oracle_of(problem_of(constrained(**SPEED))), RiccatiOracle)
    law = iter(optima.u)
    path = path_under(problem, lambda n, x: next(law), problem.initial_states.sample(1))
    assert abs(float(problem.constraints.worst(path.x).max())) <= 1e-6


@pytest.mark.gate
def test_a_violation_is_no_cheaper_optimum():
    """Controls that violate a constraint cost less than the optimum, and are none to compare with."""
    pytest.importorskip("casadi")
    problem, x0 = bryson_denham(0.1), torch.tensor([[0.0, 1.0]])
    free = optimal_trajectories(problem.replaced(constraints=None), x0, torch.zeros(100, 1, 1)).path
    optima = oracle_of(problem).solve(x0, free.u)
    assert float(free.cost) < 0.5 * float(optima.cost)
    assert optima.reasons == [""]


def test_a_state_from_which_a_limit_cannot_be_kept_has_no_optimum():
    pytest.importorskip("casadi")
    problem = problem_of({**constrained(upper={"position": 1.01}), "controls": {"lower": -1, "upper": 1}})
    optima = oracle_of(problem).solve(torch.tensor([[0.999, 0.19], [0.0, 0.0]]))
    assert optima.failures == 1
    assert "IPOPT" in optima.reasons[0]


@pytest.mark.gate
def test_the_penalty_is_as_dear_as_the_optima_need(monkeypatch):
    monkeypatch.setattr("lyapnet.training.penalty_weight.OPTIMA", 3)
    problem = bryson_denham(0.1).relaxed()
    found, said = find_penalty_weight(problem, silent), []
    assert found.kept == found.states
    problem.cost.weight.fill_(found.weight)
    x0, idle = torch.tensor([[0.0, 1.0]]), torch.zeros(100, 1, 1)
    path = optimal_trajectories(problem, x0, idle).path
    assert float(problem.constraints.worst(path.x).max()) < 0
    ell, true = problem.horizon.dt * problem.cost.cost.running(path.x[:-1], path.u).sum(0), problem.cost.cost
    assert float(ell + true.terminal(path.x[-1])) == pytest.approx(4.4444, rel=0.01)
    problem.cost.weight.fill_(found.weight / 100)
    assert float(problem.constraints.worst(optimal_trajectories(problem, x0, idle).path.x).max()) > 0
    impossible = problem_of({**constrained(upper={"position": 1.01}), "controls": {"lower": -1, "upper": 1}})
    impossible = impossible.replaced(initial_states=lyapnet.Box([0.99, 0.1], [1.0, 0.2])).relaxed()
    found = find_penalty_weight(impossible, lambda stage, *counts: said.append(stage))
    assert found.kept < found.states
    assert f"penalties up to {found.largest:.3g}/s" in str(found)
    assert found.worst > 0
    assert found.largest < 1e8, "a hundredfold weight moves no path any more, and the search ends"
    assert said[0] == "optima without constraints"


@pytest.fixture
def few_optima(monkeypatch):
    """For what does not ask how good a start is."""
    monkeypatch.setattr("lyapnet.training.start.MAX_OPTIMA", 12)
    shorten_fits(monkeypatch, 260, 140)
    monkeypatch.setattr("lyapnet.training.penalty_weight.OPTIMA", 6)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    content = {**constrained(**SPEED), "logs": str(tmp_path_factory.mktemp("logs"))}
    with pytest.MonkeyPatch.context() as patch:
        shorten_fits(patch, 1000, 500)
        # a law that is faster as it is written, and holds a wide margin alone
        return lyapnet.train(content, [*BRIEF, "rollout.policy=sampled", "constraints.margin=0.02"])


@pytest.mark.gate
def test_a_training_with_constraints(run):
    """Of a few steps: what it finds, says, keeps, and goes on with."""
    relaxation, result = run.record()["relaxation"], run.evaluation
    assert relaxation["kept"] == relaxation["states"]
    assert result["violated_fraction"] <= 0.25
    assert set(result["constraints"]) == {"velocity ≥ -0.5 m/s", "velocity ≤ 0.5 m/s"}
    assert all(-1 < each["worst"] < 0.1 for each in result["constraints"].values())
    assert result["cost_ratio"] == pytest.approx(1, abs=0.05)
    assert read_checkpoint(run.last)[KEY]["penalty"] == relaxation["weight"]
    controller = lyapnet.load(run.best)
    assert not isinstance(controller.cost, PenaltyCost)
    problem, x0 = controller.problem, controller.initial_states.sample(16)
    assert float(problem.constraints.worst(controller.rollout(x0).x).max()) < 0.1
    free = path_under(problem, greedy_law(problem, riccati(problem)), x0)
    assert float(problem.constraints.worst(free.x).max()) > 0.5


@pytest.mark.gate
def test_a_resumed_training_has_the_same_penalty(run):
    first = read_checkpoint(run.last)
    before = {k: v.clone() for k, v in first["state_dict"].items()}
    again = lyapnet.train(first[KEY]["config"], ["training.iterations=4"], resume="last")
    stored = read_checkpoint(again.last)
    assert stored["global_step"] == 4
    assert stored[KEY]["penalty"] == run.record()["relaxation"]["weight"]
    assert any(not torch.equal(before[k], stored["state_dict"][k]) for k in before)


@pytest.mark.gate
def test_who_violates_is_told(run):
    controller = lyapnet.load(run.best)
    tighter = AllOf([StateLimits([1], [0.3], [1.0], [0.3], ["slow"]), StateLimits([0], [9.0], [1.0], [9.0], ["far"])])
    problem = controller.problem.replaced(constraints=tighter)
    result = evaluate(lyapnet.Controller(problem, controller.V), 64, optimum=False)
    assert 0.2 < result["violated_fraction"] < 0.8
    slow, far = result["constraints"]["slow"], result["constraints"]["far"]
    assert slow["violated"] == result["violated_fraction"]
    assert slow["worst"] > 0
    assert 0 < slow["time"] < 2
    assert far["violated"] == 0


@pytest.mark.gate
@pytest.mark.usefixtures("few_optima")
def test_own_constraints_are_never_imported_by_a_checkpoint(tmp_path):
    content = {**constrained(name="tests.task.test_constraints:Tube"), "logs": str(tmp_path)}
    run = lyapnet.train(content, [*BRIEF, "rollout.policy=lookahead", "horizon={steps: 10, dt: 0.2}", "loggers=[csv]"])
    with pytest.raises(UsageError, match=r"Expected constraints=…"):
        lyapnet.load(run.best)
    assert lyapnet.load(run.best, constraints=Tube()).problem.constraints.names == ("tube",)
    by_hand = problem_of(INTEGRATOR, parts=Parts(constraints=Tube(3.0)))
    assert by_hand.constraints.reach == 3.0


@pytest.mark.gate
def test_no_number_is_a_violation(run):
    table = evaluation(lyapnet.load(run.best), 8, optimum=False).table
    broken = dataclasses.replace(table, worst=torch.where(torch.arange(8)[:, None] < 2, torch.nan, -1.0))
    assert broken.violated.sum() == 2
    assert broken.violations(["one"])["one"]["violated"] == 0.25


def test_constraints_have_names():
    tube = Tube()
    tube.names = ()
    with pytest.raises(UsageError, match=r"Tube.names with a name for each component"):
        problem_of(INTEGRATOR, parts=Parts(constraints=tube))


def test_another_constraint_is_noticed():
    problem, other = problem_of(constrained(**SPEED)), problem_of(constrained(upper={"velocity": 0.5}))
    assert problem.differences(problem.record()) == []
    assert problem.relaxed(2.0).record() == problem.record(), "what training adds is its own"
    assert problem.differences(other.record()) == ["h"]
    assert problem_of(constrained()).differences(problem.record()) == ["h"]
    assert problem.differences(problem_of(constrained()).record()) == ["h"]


def test_a_family_has_them_of_its_states():
    own, family = Tube(), {**constrained(**SPEED), "family": {"target_position": [-0.5, 0.5]}}
    problem = problem_of(family, parts=Parts(constraints=own))
    z = torch.tensor([0.3, 0.4, 0.5])
    assert_close(problem.constraints(z)[:2], problem_of(constrained(**SPEED)).constraints(z[:2]))
    assert_close(problem.constraints(z)[2:], own(z[:2]))
    assert [type(part) for part in parts_of(problem.constraints)] == [StateLimits, OfFirstStates]


def test_a_lightning_module_wants_the_relaxed_problem():
    problem = problem_of(constrained(**SPEED))
    V = objects(config_from_plain(constrained(**SPEED)))[1]
    with pytest.raises(UsageError, match=r"pass problem.relaxed\(weight=…\)"):
        ValueModule(problem, V, lyapnet.ValueProgram())
    assert ValueModule(problem.relaxed(0.5), V, lyapnet.ValueProgram()).penalty is not None


def test_an_environment_refuses_what_its_reward_does_not_know():
    with pytest.raises(UsageError, match="without state constraints for an environment"):
        bounded_problem(problem_of(constrained(**SPEED)), 5.0)


def test_paths_around_a_disk():
    free = problem_of(constrained(**SPEED))
    assert not has_plane(free)
    outside = [{"center": {"position": 0.5, "velocity": 0.9}, "radius": 0.3}]
    problem = problem_of(constrained(outside=outside))
    assert has_plane(problem)
    V = objects(config_from_plain(constrained(outside=outside)))[1]
    controller = lyapnet.Controller(problem, V)
    figure = paths(controller.rollout(problem.initial_states.sample(5)), problem)
    (panel,) = figure.axes
    assert panel.get_xlabel() == "position (m)"
    assert len([line for line in panel.lines if len(line.get_xdata()) == 41]) == 5
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["not to be entered", "closed loop", "goal", "X₀"]
    assert math.isclose(panel.patches[0].get_radius(), 0.3)


@pytest.mark.gate
@pytest.mark.usefixtures("few_optima")
def test_what_is_said_before_training_names_the_penalty():
    config = config_from_plain(constrained(**SPEED), ["rollout.policy=sampled"])
    learner = build_learner(config, build_problem(config).relaxed())
    facts = {fact.name: fact.found for fact in facts_of(learner)}
    assert facts["constraints"].startswith("penalty of ")
    assert "optima from 6 states keep them, at 1." in facts["constraints"]
    assert float(learner.problem.cost.weight) > 0


def test_what_constraints_with_parameters_ignore():
    class Learned(Constraints):
        names = ("learned",)

        def __init__(self):
            super().__init__()
            self.layer = torch.nn.Linear(1, 1)

        def forward(self, x):
            return self.layer(x[..., :1])

    assert [Learned().double().ignores(i, 2) for i in range(2)] == [False, True]


def margins_of(content, *overrides):
    return build_problem(config_from_plain({**INTEGRATOR, **content}, overrides)).constraints.margin


def test_the_margin_is_small_where_controls_act_on_a_constraint_at_once():
    disk = {"outside": [{"center": {"position": 2}, "radius": 0.4}]}
    assert margins_of({"constraints": SPEED}) == [0.002, 0.002]
    assert margins_of({"constraints": {**SPEED, **disk}}) == [0.002, 0.002, 0.02]
    at_rest = {"lower": [-1, 0], "upper": [1, 0]}
    energy = {"inside": [{"center": {"position": 0, "velocity": 0}, "radius": 3}]}
    assert margins_of({"constraints": energy, "initial_states": at_rest}) == [0.002], "though its slope is zero on X₀"
    chain = {
        "system": {"name": "integrator_chain", "parameters": {"length": 3}},
        "cost": {"Q": [1], "R": [1], "Q_T": [1]},
        "initial_states": {"lower": [-0.1] * 3, "upper": [0.1] * 3},
    }
    for state, margin in (("x1", 0.02), ("x2", 0.02), ("x3", 0.002)):
        assert margins_of({**chain, "constraints": {"upper": {state: 1}}}) == [margin]


def test_the_margin_is_what_is_asked_for_and_wide_for_a_law_that_does_not_look_ahead():
    assert margins_of({"constraints": SPEED}, "constraints.margin=0.01") == 0.01
    assert margins_of({"constraints": SPEED}, "rollout.policy=sampled") == 0.02


def test_each_constraint_is_paid_for_within_its_own_margin():
    disk = {"outside": [{"center": {"position": 2}, "radius": 0.4}]}
    problem = problem_of(constrained(**SPEED, **disk))
    cost = problem.relaxed(weight=3.0).cost
    h = problem.constraints
    x = torch.tensor([[0.0, 0.4995], [1.601, 0.0], [1.601, 0.4995]])
    each = torch.relu(1 + h(x) / torch.tensor([0.002, 0.002, 0.02])) ** 3
    assert (each.sum(0) > 0).tolist() == [False, True, True]
    assert_close(cost.penalty(x), 3 * each.sum(-1), atol=1e-12, rtol=1e-12)
