"""One law for one V: a controller of parts takes the law that V is made for, and says so where nobody knows it."""

import copy

import pytest
import torch
from torch import nn

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.evaluation.oracles import discrete_riccati
from lyapnet.experiment.assembly import Parts, build_problem
from lyapnet.experiment.config import config_from_plain
from lyapnet.loop.rollout import Rollout
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.systems import DoubleIntegrator
from lyapnet.training.build import build_learner
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.networks import NETWORKS
from lyapnet.value.policy import HJBPolicy, LookaheadPolicy, SampledPolicy, SontagPolicy, known_law
from tests.marks import sample
from tests.problems import Quadratic, problem_of, with_expansion

TASK = {
    "experiment": "laws",
    "program": {"name": "value"},
    "system": {"name": "double_integrator"},
    "cost": {"Q": [10, 0.1], "R": 1, "Q_T": [10, 0.1]},
    "initial_states": {"lower": [-1, -0.7], "upper": [1, 0.7]},
    "horizon": {"steps": 8, "dt": 0.1},
    "training": {"precision": "float64"},
}


class Own(ValueFunction):
    """A network of a user's own."""

    def __init__(self, scaling=None):
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(3, 8), nn.Tanh(), nn.Linear(8, 1))

    def forward(self, t, x):
        return 5 * self.layers(torch.cat([t.expand(x.shape[:-1])[..., None], x], -1))[..., 0] ** 2


def learner_of(name, law):
    """What a config trains, with weights that are not zero."""
    end = {}
    if name == "stationary":
        end = {"horizon": {**TASK["horizon"], "stationary": True}, "cost": {"Q": [10, 0.1], "R": 1}}
    network = {"network": {"name": "expansion" if name in ("stationary", "own") else name}}
    if name == "anchored":
        network["network"]["terminal"] = "exact"
    config = config_from_plain({**TASK, **end, **network, "rollout": {"policy": law, "gradient": "discrete"}})
    parts = Parts(network=Own if name == "own" else None)
    learner = build_learner(config, build_problem(config), parts)
    with_expansion(learner.V)
    return learner


@pytest.mark.parametrize(
    ("name", "law"),
    sample([*((name, "sampled") for name in (*NETWORKS, "own")), ("expansion", "hjb"), ("stationary", "hjb")], 6),
)
def test_a_controller_of_parts_costs_what_its_training_measured(name, law):
    learner = learner_of(name, law)
    x0 = learner.problem.initial_states.sample(6)
    measured = learner.rollout(x0).cost.detach()
    made = lyapnet.Controller(learner.problem, learner.V).rollout(x0).cost
    torch.testing.assert_close(made, measured, rtol=1e-9, atol=1e-9)
    other = {"sampled": HJBPolicy, "hjb": SampledPolicy}[law]
    differing = lyapnet.Controller(learner.problem, learner.V, policy=other).rollout(x0).cost
    assert ((differing - measured).abs() > 1e-6 * measured).any()


def test_training_from_python_tells_v_its_law():
    problem, V = problem_of(DoubleIntegrator()), Own()
    module = lyapnet.ValueModule(problem, V, lyapnet.ValueProgram())
    assert known_law(problem, V) is HJBPolicy
    x0 = problem.initial_states.sample(4)
    assert torch.allclose(lyapnet.Controller(problem, V).rollout(x0).cost, module.rollout(x0).cost, rtol=1e-9)
    lyapnet.ValueModule(
        problem, V, lyapnet.ValueProgram(), Rollout(problem, SontagPolicy(problem, V), "rk4", "backprop")
    )
    assert known_law(problem, copy.deepcopy(V)) is SontagPolicy


def exact(dt=0.2, steps=30):
    """The discretised double integrator, and its exact V, of which nobody says what law it is made for."""
    system, cost = DoubleIntegrator(), QuadraticCost(torch.eye(2), torch.eye(1), torch.eye(2))
    problem = problem_of(system, cost, steps, dt)
    return problem, Quadratic(discrete_riccati(system, cost, problem.horizon).P, dt)


def test_the_constructor_says_so_where_nobody_knows_and_it_matters(caplog):
    problem, V = exact()
    lyapnet.Controller(problem, V)
    (note,) = caplog.messages
    assert "the control law for which Quadratic was trained is unknown" in note
    assert "policy=lyapnet.SampledPolicy" in note
    x0 = problem.initial_states.sample(16)
    optimal = V(torch.tensor(0.0), x0)
    held = lyapnet.Controller(problem, V, policy=SampledPolicy).rollout(x0).cost
    torch.testing.assert_close(held, optimal.detach(), rtol=1e-9, atol=1e-9)
    assert lyapnet.Controller(problem, V, policy=HJBPolicy).rollout(x0).cost.mean() > 1.01 * optimal.mean()
    assert len(caplog.messages) == 1, "a law that is named needs no note"


def test_it_says_nothing_where_the_steps_are_short_enough(caplog):
    problem, V = exact(0.01, 100)
    assert isinstance(lyapnet.Controller(problem, V).closed_loop.policy, HJBPolicy)
    assert not caplog.messages


def test_a_class_may_name_its_law_and_wrong_names_are_refused():
    problem, V = exact()
    V.made_for = LookaheadPolicy
    assert isinstance(lyapnet.Controller(problem, V).closed_loop.policy, LookaheadPolicy)
    V.made_for = nn.Linear
    with pytest.raises(UsageError, match="Expected made_for of Quadratic as a ValuePolicy, got Linear"):
        lyapnet.Controller(problem, V)
    with pytest.raises(ValueError, match="Expected a rollout or a policy, got both"):
        lyapnet.Controller(problem, V, Rollout(problem, HJBPolicy(problem, V)), policy=HJBPolicy)
