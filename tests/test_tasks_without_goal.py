"""Tasks that are about no goal: costs of any sign, against closed forms and against the same task with a goal."""

import json

import pytest
import torch
from torch.testing import assert_close

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.cli import main
from lyapnet.evaluation.measurement import evaluate
from lyapnet.evaluation.optimality import in_spreads
from lyapnet.evaluation.worst_states import excess
from lyapnet.loop.programs import LyapunovProgram, RegionProgram, ValueProgram
from lyapnet.loop.rollout import Rollout
from lyapnet.task.cost import ObstacleCost, spread
from lyapnet.training.learner import Learner
from lyapnet.training.penalty_weight import find_penalty_weight
from lyapnet.training.stage_messages import silent
from lyapnet.value.after_horizon import choose_law
from lyapnet.value.linearisation import Missing, riccati_or_reason
from tests.fits import shorten_fits

R, T = 0.5, 1.0


class Sledge(lyapnet.ControlAffineSystem):
    """ẋ = u."""

    state_names, state_units, control_names, control_units = ("position",), ("m",), ("speed",), ("m/s",)

    def f(self, x):
        return torch.zeros_like(x)

    def g(self, x):
        return torch.ones_like(x)[..., None]


class Far(lyapnet.Cost):
    """−x(T), and R u² per second: u = 1/(2R), V = level − x − (T − t)/(4R)."""

    def __init__(self, level: float = 0.0):
        super().__init__()
        self.level = level

    def state(self, x):
        return torch.zeros_like(x[..., 0])

    def R(self, x):
        return torch.full((*x.shape[:-1], 1, 1), R, dtype=x.dtype)

    def terminal(self, x):
        return self.level - x[..., 0]


class Exact(lyapnet.ValueFunction):
    """The closed form of V."""

    made_for = lyapnet.SampledPolicy

    def __init__(self, share: float = 1.0):
        super().__init__()
        self.share = torch.nn.Parameter(torch.tensor(share, dtype=torch.float64))

    def forward(self, t, x):
        return -self.share * x[..., 0] - (T - t) / (4 * R)


def far(level=0.0, lower=-1.0, upper=2.0, cost=None):
    box, horizon = lyapnet.Box([lower], [upper]), lyapnet.Horizon(steps=20, dt=T / 20)
    return lyapnet.Problem(Sledge(), cost or Far(level), lyapnet.Unbounded(), box, horizon).double()


class Named(Far):
    """One that says where it would be zero, and goes below."""

    def __init__(self):
        super().__init__(1.0)
        self.goal = torch.tensor([1.0], dtype=torch.float64)


class Dips(Far):
    """Zero at the origin, without slope, and negative elsewhere."""

    def state(self, x):
        return x[..., 0] ** 2 * (1 - x[..., 0] ** 2)

    def terminal(self, x):
        return x[..., 0] ** 2


@pytest.mark.parametrize(
    ("cost", "reason"),
    [
        (Far(), "φ is 0, of slope (-1), at the origin, the default, because no target is named"),
        (Far(10.0), "φ is 10, of slope (-1), at the origin"),
        (Named(), "φ is 0, of slope (-1), at the goal (1)"),
        (Dips(), "q is negative"),
    ],
)
def test_a_task_without_a_goal_says_why(cost, reason):
    problem = far(cost=cost)
    assert not problem.has_goal
    assert reason in problem.no_goal.replace("-0,", "0,")
    missing = riccati_or_reason(problem)
    assert isinstance(missing, Missing)
    assert missing.reason == problem.no_goal
    assert problem.goal.tolist() == [0.5], "the centre of X₀ is a state that is typical"
    assert problem.in_steps(method="rk4").no_goal == problem.no_goal


class Batch(Sledge):
    """A volume that is fed, and a product in it that u makes: on X₀ there is none of it."""

    state_names, state_units = ("product", "volume"), ("g", "l")

    def f(self, x):
        return torch.stack([torch.zeros_like(x[..., 0]), 0.1 + 0 * x[..., 1]], -1)

    def g(self, x):
        return torch.stack([x[..., 1], torch.zeros_like(x[..., 1])], -1)[..., None]


class Yield(Far):
    def terminal(self, x):
        return -x[..., 0] * x[..., 1]


def test_a_gain_that_is_zero_on_all_of_x0_is_no_goal():
    horizon = lyapnet.Horizon(steps=20, dt=T / 20)
    problem = lyapnet.Problem(
        Batch(), Yield(), lyapnet.ControlBox([0.0], [1.0]), lyapnet.Box([0, 0.9], [0, 1.1]), horizon
    )
    assert "φ is negative" in problem.double().no_goal


def test_a_regulator_has_a_goal():
    problem = far(cost=lyapnet.QuadraticCost([[1.0]], [[1.0]], [[1.0]]))
    assert problem.has_goal
    assert problem.goal.tolist() == [0.0]


@pytest.mark.parametrize(("center", "goal"), [(0.6, True), (0.0, False)])
def test_the_tail_of_an_obstacle_may_reach_a_goal(center, goal):
    """The bump at the origin is 8e-5, of slope 0.003, or all of 8."""
    regulator = lyapnet.QuadraticCost([[1.0]], [[1.0]], [[1.0]])
    problem = far(cost=ObstacleCost(regulator, [0], [center], 0.25, 8.0))
    assert problem.has_goal is goal


@pytest.mark.gate
def test_the_exact_v_has_no_regret_and_another_one_has():
    problem = far(level=0.0)
    exact = evaluate(lyapnet.Controller(problem, Exact()), 32, optimum=True)
    assert exact["cost_ratio"] is None
    assert exact["regret"] == pytest.approx(0, abs=1e-7)
    assert exact["value_error"] == pytest.approx(0, abs=1e-7)
    assert exact["cost_mean"] == pytest.approx(exact["optimal_cost_mean"], abs=1e-9)
    assert not {"terminal_errors", "at_goal_fraction", "satisfied_fraction", "lqr_cost_mean"} & exact.keys()
    other = evaluate(lyapnet.Controller(problem, Exact(0.5)), 32, optimum=True)
    u, best = 0.5 / (2 * R), 1 / (2 * R)  # the regret of a wrong constant u is R T (u − u*)², the spread that of x₀
    assert other["regret"] * 3 / 12**0.5 == pytest.approx(R * T * (u - best) ** 2, rel=0.2)  # of a uniform draw


def test_a_constant_changes_neither_loss_nor_gradient_nor_regret():
    """Without a goal only differences of costs mean something; with the twin, a program that takes ratios."""

    def loss(level, has_goal):
        problem = far(level)
        V = _Raised(level)
        trajectory = Rollout(problem, lyapnet.SampledPolicy(problem, V), gradient="backprop")(
            torch.linspace(-1, 2, 9, dtype=torch.float64)[:, None]
        )
        program = ValueProgram(constraint=1, cost_to_go=10, trajectory_cost=1).without_goal("")
        output = program(trajectory, spread_of_costs=None if has_goal else spread(trajectory.cost.detach()))
        (output.loss - output.terms["trajectory_cost"].detach()).backward()
        terms = output.terms["constraint"], output.terms["cost_to_go"]
        return [float(value.detach()) for value in (*terms, V.share.grad)]

    assert loss(0.0, False) == pytest.approx(loss(100.0, False), rel=1e-6)
    assert loss(5.0, True) != pytest.approx(loss(100.0, True), rel=0.1)


def test_losses_of_validations_compare_in_units_of_the_same_spread():
    """A law that costs more never has the lower loss because its costs differ more from state to state."""
    problem = far()
    V = Exact()
    learner = Learner(problem, V, Rollout(problem, lyapnet.SampledPolicy(problem, V)), ValueProgram(0, 0, 1))
    x0 = torch.linspace(-1, 2, 9, dtype=torch.float64)[:, None]
    with torch.no_grad():
        best = learner.rollout(x0)

    def loss(scale):
        """Of costs that are 5 higher, and differ so many times as much."""
        end, mean = best.terminal_cost, best.terminal_cost.mean()
        return float(learner.measure_on(best._replace(terminal_cost=mean + scale * (end - mean) + 5)))

    apart = loss(1.0) - loss(3.0)
    optima = best.cost.where(torch.arange(9) < 5, torch.nan)
    learner.validation_optimum, optimal = optima, optima[:5].std(correction=0)
    assert loss(1.0) == pytest.approx(loss(3.0))
    assert loss(1.0) == pytest.approx(float((best.cost.mean() + 5) / optimal))
    assert abs(apart) > 0.1, "the twin, where no optimum is known"


class _Raised(Exact):
    def __init__(self, level):
        super().__init__(0.7)
        self.level = level

    def forward(self, t, x):
        return self.level + super().forward(t, x)


def test_excess_and_regret_are_in_units_of_the_spread():
    cost, value = torch.tensor([-3.0, -1.0, 1.0, 3.0]), torch.tensor([-4.0, -1.0, 1.0, 3.0])
    assert_close(excess(cost, value, has_goal=False), torch.tensor([1.0, 0, 0, 0]) / 5**0.5)
    assert in_spreads(cost - value, cost) == pytest.approx(0.25 / 5**0.5)
    assert in_spreads(cost, torch.full((4,), torch.nan)) is None
    assert in_spreads(torch.ones(3), torch.full((3,), -100.0)) == pytest.approx(10.0), "X₀ may be a point"


@pytest.mark.parametrize("program", [LyapunovProgram(), RegionProgram()])
def test_a_program_about_a_goal_says_that_it_needs_one(program):
    problem, V = far(), Exact()
    with pytest.raises(UsageError, match=r"Expected a task with a goal.*φ is -?0, of slope \(-1\).*program.name=value"):
        Learner(problem, V, Rollout(problem, lyapnet.SampledPolicy(problem, V)), program)
    assert Learner(problem, V, Rollout(problem, lyapnet.SampledPolicy(problem, V)), ValueProgram(relative=True))


@pytest.mark.parametrize("claim", [lyapnet.Funnel(), lyapnet.Sampled(), lyapnet.Statistical()])
def test_a_certificate_about_a_goal_says_that_it_needs_one(claim):
    with pytest.raises(UsageError, match="Expected a task with a goal, towards which V falls"):
        lyapnet.certify(lyapnet.Controller(far(), Exact()), claim)


def test_nothing_holds_a_goal_that_is_not_there():
    found = choose_law(far(), lambda *_: pytest.fail("no closed loop is asked for"))
    assert (found.beyond, found.loops, found.reason) == ("hold", 0, "the task has no goal")


@pytest.mark.gate
def test_the_price_of_constraints_is_positive_where_costs_are_not(monkeypatch):
    monkeypatch.setattr("lyapnet.training.penalty_weight.OPTIMA", 4)
    limit = lyapnet.task.constraints.StateLimits([0], [2.2], [1.0], [2.2], ["near"])
    problem = far().replaced(constraints=limit.double()).relaxed()
    found = find_penalty_weight(problem, silent)
    assert found.kept == 4
    assert found.cost_ratio is None
    assert found.weight > 0
    assert found.price > 0
    assert "more than without" in str(found)


@pytest.mark.gate
def test_a_training_without_a_goal(tmp_path, monkeypatch, capsys):
    """From YAML to a table: one state, a cost of both signs, an end that is to be far."""
    monkeypatch.setattr("lyapnet.training.optima.MAX_OPTIMA", 12)
    monkeypatch.setattr("lyapnet.training.start.MAX_OPTIMA", 12)
    shorten_fits(monkeypatch, 100, 50)
    monkeypatch.setattr("lyapnet.training.pretraining.BRIEF_STEPS", 10)
    (tmp_path / "task.yaml").write_text(
        json.dumps({
            "experiment": "far",
            "system": {"name": f"{__name__}:Sledge"},
            "cost": {"name": f"{__name__}:Far"},
            "initial_states": {"lower": -1, "upper": 2},
            "horizon": {"steps": 20, "dt": 0.05},
            "training": {"iterations": 4},
            "logs": str(tmp_path / "logs"),
        })
    )  # fmt: skip
    assert main(["train", "--config", str(tmp_path / "task.yaml"), "rollout.gradient=backprop"]) == 0
    result = json.loads((tmp_path / "logs/far/version_0/evaluation.json").read_text())
    assert result["regret"] < 1e-3
    shown = capsys.readouterr().out
    assert "regret, mean (cost − optimum)" in shown
    assert "spread of J*" in shown
    assert "certify tube" in shown
    assert "cost / optimum" not in shown
