"""Families without end: the regulator of each member, V(x, p) that vanishes at each goal, and one law for all."""

import math

import numpy as np
import pytest
import torch
from scipy.linalg import solve_discrete_are
from torch.testing import assert_close

from lyapnet import Region, certify, load, train
from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly import Parts, build_problem, build_value_function, member
from lyapnet.experiment.config import config_from_plain
from lyapnet.task.cost import RegulatorTail
from lyapnet.task.systems import ControlAffineSystem
from lyapnet.training.build import build_module
from lyapnet.training.build_learner import build_pointwise
from lyapnet.training.examples import draw_examples
from lyapnet.value.calculus import gradients
from lyapnet.value.expansions import greedy_law, optimal_trajectories, path_under, riccati
from lyapnet.value.networks import StationaryNetwork
from tests.fits import shorten_fits
from tests.marks import sample
from tests.task.test_setpoints import Tanks

FLOAT64 = {"training": {"precision": "float64"}}
NOW = torch.zeros(())


class Mass(ControlAffineSystem):
    """m ẍ = u − d ẋ."""

    state_names, state_units = ("position", "velocity"), ("m", "m/s")
    control_names, control_units = ("force",), ("N",)

    def __init__(self, mass: float = 1.0, damping: float = 0.2):
        super().__init__()
        self.mass, self.damping = mass, damping

    def f(self, x):
        return torch.stack([x[..., 1], -self.damping / self.mass * x[..., 1]], -1)

    def g(self, x):
        zero = torch.zeros_like(x[..., 0])
        return torch.stack([zero, zero + 1 / self.mass], -1)[..., None]


MASS = {
    "experiment": "mass",
    "system": {"name": f"{__name__}:Mass"},
    "cost": {"Q": [1, 0.1], "R": 0.1},
    "initial_states": {"lower": [-1, -1], "upper": [1, 1]},
    "horizon": {"steps": 200, "dt": 0.05, "stationary": True},
    "family": {"mass": [0.5, 2.0]},
}
TANKS = {
    "experiment": "tanks",
    "system": {"name": f"{Tanks.__module__}:Tanks"},
    "cost": {"Q": [1, 10], "R": 1},
    "controls": {"lower": 0.0, "upper": 2.0},
    "initial_states": {"lower": 0.2, "upper": 0.7},
    "horizon": {"steps": 150, "dt": 0.05, "stationary": True},
    "family": {"target_lower": [0.25, 0.45]},
}
PENDULUM = {
    "experiment": "pendulum",
    "system": {"name": "pendulum", "parameters": {"damping": 0.1}},
    "cost": {"Q": [1, 0.1], "R": 0.5},
    "controls": {"lower": -20, "upper": 20},
    "initial_states": {"lower": [-1, -1], "upper": [1, 1]},
    "horizon": {"steps": 100, "dt": 0.05, "stationary": True},
    "network": {"embed_angles": True},
    "family": {"length": [0.8, 1.2], "target_angle": [-0.5, 0.7]},
}
WEIGHTS = {**MASS, "family": {"cost.Q.position": [0.5, 5], "cost.R.force": [0.05, 0.5], "mass": [0.8, 1.2]}}
TASKS = pytest.mark.parametrize(
    "task", sample([MASS, TANKS, PENDULUM, WEIGHTS], 4), ids=["mass", "tanks", "pendulum", "weights"]
)


def config_of(task, *overrides):
    return config_from_plain({**task, **FLOAT64}, overrides)


def problem_of(task, *overrides):
    return build_problem(config_of(task, *overrides))


def riccati_of(mass, Q=1.0, R=0.1, dt=0.05):
    """P of one Euler step, by scipy alone."""
    A = np.eye(2) + dt * np.array([[0.0, 1.0], [0.0, -0.2 / mass]])
    return torch.from_numpy(
        solve_discrete_are(A, dt * np.array([[0.0], [1 / mass]]), dt * np.diag([Q, 0.1]), [[dt * R]])
    )


def relative_error(found, expected):
    """The largest relative error of δᵀPδ in any direction δ."""
    root = torch.linalg.cholesky(expected)
    share = torch.linalg.solve_triangular(root, torch.linalg.solve_triangular(root, found, upper=False).mT, upper=False)
    return float((torch.linalg.eigvalsh(share) - 1).abs().max())


def test_each_member_has_the_riccati_solution_of_its_own():
    root = problem_of(MASS, "rollout.method=euler", "rollout.policy=hjb").cost.root
    assert 3 < len(root.coefficients) < 20
    errors, of_middle = [], []
    for mass in (0.5 + 1.5 * torch.rand(50, generator=torch.Generator().manual_seed(5))).tolist():
        L = root(torch.tensor([mass]))
        errors.append(relative_error(L @ L.mT, riccati_of(mass)))
        of_middle.append(relative_error(riccati_of(1.25), riccati_of(mass)))
    assert max(errors) < 1e-4
    assert max(of_middle) > 0.2, "the solution of one member is not that of the others"


@pytest.mark.gate
def test_weights_of_the_cost_have_one_each():
    root = problem_of(WEIGHTS, "rollout.method=euler", "rollout.policy=hjb").cost.root
    for q, r, m in [(0.5, 0.5, 1.2), (5.0, 0.05, 0.9), (1.7, 0.2, 1.03)]:
        L = root(torch.tensor([math.log10(q), math.log10(r), m]))
        assert relative_error(L @ L.mT, riccati_of(m, q, r)) < 2e-4


@TASKS
def test_the_tail_of_a_member_is_that_of_the_task_built_alone(task):
    config = config_of(task)
    family = build_problem(config)
    n, names = family.cost.n, family.system.names
    for z in family.initial_states.sample(3, torch.Generator().manual_seed(3)):
        own, parts, p = member(config, Parts(), family, family.system.values(z[n:].tolist()))
        alone, x = build_problem(own, parts), family.initial_states.sample(8)[:, :n]
        assert isinstance(alone.cost, RegulatorTail)
        together = torch.cat([x, torch.tensor(p).expand(8, -1)], -1)
        assert len(p) == len(names)
        assert_close(family.cost.terminal(together), alone.cost.terminal(x), rtol=2e-4, atol=1e-9)
        assert_close(family.cost.running(together, x[:, :1]), alone.cost.running(x, x[:, :1]), rtol=1e-5, atol=1e-6)


def network_of(task, spread=0.5):
    """V with random weights, started from the regulators; and its problem."""
    config = config_of(task)
    problem = build_problem(config)
    V = build_value_function(config, problem)
    assert isinstance(V, StationaryNetwork)
    V.start_from_regulator(problem.goal, torch.eye(problem.system.n), 0.3)
    torch.manual_seed(1)
    torch.nn.init.normal_(V.network.output.weight, std=spread)
    return V.requires_grad_(False), problem


def goals_of(problem, count=20):
    z = problem.initial_states.sample(count, torch.Generator().manual_seed(7))
    return z - problem.cost.from_goal(z)


@TASKS
def test_V_is_right_at_the_goal_of_each_member_for_any_weights(task):
    V, problem = network_of(task)
    goals, n = goals_of(problem), problem.cost.n
    assert_close(problem.system.dynamics(goals, problem.rest_at(goals)), 0 * goals, atol=1e-6, rtol=0)
    assert float(V(NOW, goals).max()) < 1e-18
    assert float(V.value_and_state_gradient(NOW, goals)[1].abs().max()) < 1e-8
    for goal in goals[:4]:
        bend = torch.autograd.functional.hessian(lambda z: V(NOW, z), goal + 1e-7)[:n, :n]
        L = problem.cost.root(goal[n:])
        assert_close(bend, 2 * L @ L.mT, rtol=1e-4, atol=1e-4 * float(L.square().max()))
        assert_close(V.curvature_at(NOW, goal)[:n, :n], 2 * L @ L.mT, rtol=1e-6, atol=1e-8)
    away = goals + 0.3 * torch.cat([torch.randn(20, n), torch.zeros(20, problem.system.n - n)], -1)
    assert bool((V(NOW, away) > 0).all())
    others = goals[:, n:].flip(0)
    moved = torch.cat([goals[:, :n], others], -1)
    if task in (TANKS, PENDULUM):
        assert float(V(NOW, moved).max()) > 1e-3, "the goal of one member is not that of another"


@TASKS
def test_its_gradient_is_autograds(task):
    V, problem = network_of(task)
    z = problem.initial_states.sample(100)
    value, slope = V.value_and_state_gradient(NOW, z)
    assert_close(slope, gradients(V, NOW, z)[1])
    assert_close(value, V(NOW, z))
    problem.check_value_function(V)


def test_a_setpoint_beyond_its_range_counts_as_its_end():
    V, _ = network_of(TANKS, spread=0.0)
    x = torch.tensor([0.5, 0.3])
    beyond, end = (torch.cat([x, torch.tensor([p])]) for p in (0.6, 0.45))
    assert_close(V(NOW, beyond), V(NOW, end))


def test_states_that_cost_nothing_are_flat():
    cartpole = {
        **MASS, "system": {"name": "cartpole"}, "cost": {"Q": [0, 1, 0.1, 0.1], "R": 0.1},
        "initial_states": {"lower": [-0.1] * 4, "upper": [0.1] * 4}, "family": {"length": [0.8, 1.2]},
        "network": {"ignored_states": ["cart position"]},
    }  # fmt: skip
    problem = problem_of(cartpole)
    assert problem.cost.ignores_at_end(0, 5)
    assert not any(problem.cost.ignores_at_end(i, 5) for i in (1, 2, 3, 4))
    V = build_value_function(config_of(cartpole), problem)
    z = problem.initial_states.sample(5)
    assert_close(V(NOW, z), V(NOW, z + torch.tensor([3.0, 0, 0, 0, 0])))
    with pytest.raises(UsageError, match=r"got length in network\.ignored_states; leave it out"):
        build_value_function(config_of(cartpole, "network.ignored_states=[length]"), problem)


@pytest.mark.parametrize(
    ("task", "changes", "message"),
    [
        (MASS, {"cost": {"Q": [1, 0.1], "R": 0.1, "Q_T": 1}}, "no cost.Q_T with horizon.stationary"),
        (MASS, {"family": {"cost.Q_T.position": [1, 2]}}, "no weight of Q_T in a family with horizon.stationary"),
        (TANKS, {"controls": {"lower": 0.0, "upper": 0.75}}, "held|widen controls"),  # u* reaches 0.8
        (TANKS, {"target_control": [0.6]}, "an equilibrium"),
        (PENDULUM, {"constraints": {"upper": {"angle": 0.6}}, "initial_states": {"lower": -0.5, "upper": 0.5}},
         "hold the target"),
        (PENDULUM, {"cost": {"Q": [1, 0.1], "R": 0.5, "obstacles": [
            {"center": {"angle": 0.7}, "radius": 0.05, "weight": 5.0}]}}, r"q\(x\*\) = 0 for horizon.stationary"),
        (MASS, {"family": {"mass": [1e-6, 10.0]}}, "smooth in its parameters for horizon.stationary"),
    ],
)  # fmt: skip
def test_what_some_member_does_not_have_is_refused(task, changes, message):
    with pytest.raises(UsageError, match=message):
        problem_of({**task, **changes})


class Loaded(Mass):
    """A mass with a load that stays, as a state."""

    state_names, state_units = (*Mass.state_names, "load"), (*Mass.state_units, "N")
    constants = (2,)

    def f(self, x):
        return torch.cat([super().f(x), torch.zeros_like(x[..., :1])], -1)

    def g(self, x):
        return torch.cat([super().g(x), torch.zeros_like(x[..., :1, None])], -2)


@pytest.mark.parametrize("family", [{}, {"mass": [0.5, 2.0]}])
def test_constants_that_no_family_names_are_refused(family):
    loaded = {"system": {"name": f"{__name__}:Loaded"}, "cost": {"Q": [1, 0.1, 0], "R": 0.1}, "family": family}
    box = {"initial_states": {"lower": [-1, -1, -1], "upper": [1, 1, 1]}}
    with pytest.raises(UsageError, match=r"constant states that are parameters of a family for .*, got load"):
        problem_of({**MASS, **loaded, **box})


def test_the_region_program_is_about_one_system():
    config = config_of({**MASS, "program": {"name": "region"}, "pointwise": {"weight": 1.0}})
    (learner,) = build_module(config_of(MASS)).members
    from lyapnet.experiment.assembly import build_program

    with pytest.raises(UsageError, match="one system with the region program, got a family"):
        build_pointwise(config, learner.rollout, build_program(config))


def optima_of(task, count=6):
    """Optimal closed loops from states of X₀ and members all over the ranges; and their problem."""
    problem = problem_of(task, "horizon.steps=60")
    box = problem.initial_states
    x0 = torch.stack([box.lower + (box.upper - box.lower) * (k / (count - 1)) for k in range(count)])
    path = path_under(problem, greedy_law(problem, riccati(problem)), x0)
    return problem, optimal_trajectories(problem, x0, path.u, iterations=20)


@pytest.mark.gate
def test_examples_beside_optima_are_of_members_within_the_ranges(monkeypatch):
    """Beyond them V has the goal of the end, and the expansion another one."""
    problem, optimum = optima_of(TANKS)
    low, high = 0.25 - 1e-12, 0.45 + 1e-12
    p = draw_examples(problem, optimum, torch.Generator().manual_seed(0)).x[:, 2]
    assert bool(((low <= p) & (p <= high)).all())
    monkeypatch.setattr("lyapnet.training.examples._within_ranges", lambda problem, x, deviation: deviation)
    p = draw_examples(problem, optimum, torch.Generator().manual_seed(0)).x[:, 2]
    assert not bool(((low <= p) & (p <= high)).all()), "there are such deviations"


def test_points_of_the_condition_approach_the_goals_of_the_members():
    config = config_of(TANKS, "pointwise.weight=1", "pointwise.region=[0.3,0.3,0.1]")
    (learner,) = build_module(config).members
    condition, problem = learner.pointwise, learner.problem
    _, z = condition.draw(torch.Generator().manual_seed(0))
    away = problem.cost.from_goal(z)[:, :2].norm(dim=-1)
    near = z[away < 0.01]
    assert len(near) > 100
    assert float(near[:, 2].min()) < 0.28, "not those of one member alone"
    assert float(near[:, 2].max()) > 0.42


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A brief training of the two tanks, with an estimator."""
    patch = pytest.MonkeyPatch()
    patch.setattr("lyapnet.training.start.MAX_OPTIMA", 24)
    shorten_fits(patch, 200, 100)
    folder = tmp_path_factory.mktemp("tanks")
    outputs = {"measure": ["lower"], "noise": [1e-4]}
    own = {**TANKS, "logs": str(folder), "trainer": {"accelerator": "cpu"}, "outputs": outputs, **FLOAT64}
    short = [*("training.iterations=3", "training.warmup=0", "rollout.compile=off", "loggers=[csv]"),
             *("evaluation.validation_states=8", "evaluation.test_states=16")]  # fmt: skip
    yield train(config_from_plain(own, short))
    patch.undo()


@pytest.mark.gate
def test_one_training_holds_each_setpoint_for_ever(run):
    controller = load(run.best, system=Tanks())
    assert run.evaluation["after_T"] == "hold"
    assert 0.99 < run.evaluation["cost_ratio"] < 1.05
    for level in (0.25, 0.31, 0.45):
        x = torch.as_tensor(controller.rollout([0.4, 0.5], steps=1000, target_lower=level).x)
        assert_close(x[-1, :2], torch.tensor([1.44 * level, level]).to(x), atol=1e-4, rtol=0)
        alone = controller.with_(target_lower=level)
        assert float(alone.value(0.0, [1.44 * level, level])) < 1e-12 < float(alone.value(0.0, [0.4, 0.5]))
    with pytest.raises(UsageError, match="got a family; choose one member"):
        certify(controller, Region())


@pytest.mark.gate
def test_a_setpoint_changes_in_the_loop_without_an_offset(run):
    controller = load(run.best, system=Tanks())
    loop, plant, x = controller.with_estimator(), Tanks(), torch.tensor([0.5, 0.35])
    for level in (0.25, 0.45, 0.3):
        for _ in range(400):
            u = loop.step(x[1:], target_lower=level)
            x = x + 0.05 * plant.dynamics(x, u)
        assert_close(x, torch.tensor([1.44 * level, level]), atol=1e-3, rtol=0)
        untold = controller.policy(0.0, x, target_lower=0.35)
        assert abs(float(untold) - 1.2 * math.sqrt(level)) > 1e-3, "it is the setpoint that moves it"
