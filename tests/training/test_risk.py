"""Training with risk: weights of dear closed loops, and configs that cannot have one."""

import pytest
import torch
from torch.testing import assert_close

from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import Config, config_from_plain
from lyapnet.loop.random_plants import ON_MODEL, ON_PLANTS
from lyapnet.loop.rollout import NoisyTrajectory
from lyapnet.training.build import build_module
from lyapnet.training.learner import Learner
from lyapnet.training.start import choose_start

TASK = {
    "experiment": "risk",
    "system": {"name": "pendulum"},
    "cost": {"Q": [1, 0.1], "R": 0.1, "Q_T": [2, 1]},
    "initial_states": {"lower": -1, "upper": 1},
    "horizon": {"steps": 20, "dt": 0.05},
    "program": {"name": "value"},
}
NOISE = {"noise": {"velocity": 0.4}, "rollout": {"gradient": "discrete", "policy": "sampled"}}
PLANTS = {"randomise": {"length": [0.6, 1.4]}, "rollout": {"gradient": "discrete"}}


def config(**changes) -> Config:
    return config_from_plain({**TASK, **changes})


def learner_of(**changes) -> Learner:
    torch.manual_seed(0)
    return build_module(config(**changes)).members[0]


def states(learner: Learner) -> torch.Tensor:
    return learner.problem.initial_states.sample(32, torch.Generator().manual_seed(0)).to(learner.problem.goal)


def test_under_noise_dear_loops_count_more():
    learner = learner_of(**NOISE, risk=20.0)
    trajectory = learner.roll_out(states(learner), 0)
    assert isinstance(trajectory, NoisyTrajectory)
    assert trajectory.surprise is not None
    # an untrained V expects almost everything: surprises as those of a trained one
    trajectory.surprise = torch.randn(trajectory.surprise.shape, generator=torch.Generator().manual_seed(1)) / 200
    weights, surprise = learner._weights(trajectory), trajectory.surprise.sum(0)
    assert_close(weights.mean(), torch.tensor(1.0))
    assert (weights.argsort() == surprise.argsort()).all()
    assert_close(weights.log().diff(), 20 * surprise.diff(), atol=1e-4, rtol=1e-4)
    compensated = trajectory.compensated()
    derivative = torch.autograd.grad(
        learner.program(compensated, weights=weights).trajectory_cost, compensated.terminal_cost, retain_graph=True
    )[0]
    assert_close(derivative, weights / len(weights))
    (indifferent,) = torch.autograd.grad(learner.program(compensated).trajectory_cost, compensated.terminal_cost)
    assert_close(indifferent, torch.ones_like(weights) / len(weights))


def test_where_a_few_loops_are_all_that_counts_the_cost_has_no_derivative():
    learner = learner_of(**NOISE, risk=20.0)
    trajectory = learner.roll_out(states(learner), 0)
    assert isinstance(trajectory, NoisyTrajectory)
    for spread, some in ((0.005, True), (1.0, False)):  # of θ Σ D_n: about 0.45 and 90
        trajectory.surprise = spread * torch.randn(20, 32, generator=torch.Generator().manual_seed(1))
        assert bool((learner._weights(trajectory) > 0).any()) == some


def test_of_random_plants_the_dear_ones_count_more_and_the_model_as_before():
    learner = learner_of(**PLANTS, risk=0.5)
    trajectory = learner.roll_out(states(learner), 0)
    weights = learner._weights(trajectory)
    assert (weights[ON_MODEL] == 1).all()
    assert_close(weights[ON_PLANTS].mean(), torch.tensor(1.0))
    excess = (trajectory.cost - trajectory.require_value()[0])[ON_PLANTS]
    assert (weights[ON_PLANTS].argsort() == excess.argsort()).all()
    assert float(weights[ON_PLANTS].max()) > 1.2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"risk": 1.0}, "Expected noise or randomise with risk, got neither"),
        ({"risk": -1.0, **NOISE}, "risk"),
        ({"risk": 1.0, **NOISE, "rollout": {"gradient": "discrete", "policy": "lookahead"}}, "it ignores risk"),
        (
            {
                "risk": 1.0,
                **NOISE,
                "system": {"name": "quadrotor"},
                "cost": {"Q": 1, "R": 1, "Q_T": 1},
                "noise": dict.fromkeys(
                    ["x", "y", "z", "roll", "pitch", "yaw", "x velocity", "y velocity", "z velocity"], 0.1
                ),
            },
            "at most 8 sources",
        ),
    ],
)  # fmt: skip
def test_tasks_without_a_place_for_risk_are_refused(changes, message):
    with pytest.raises(UsageError, match=message):
        build_problem(config(**changes))


def test_a_risk_that_no_law_can_bear_is_refused_before_training():
    learner = learner_of(**NOISE, risk=50.0, network={"name": "expansion"}, system={"name": "double_integrator"})
    with pytest.raises(UsageError, match=r"keeps E exp\(risk · J\) finite, got 50.*choose a smaller risk"):
        choose_start([learner])
    bearable = learner_of(**NOISE, risk=0.5, network={"name": "expansion"}, system={"name": "double_integrator"})
    assert choose_start([bearable]) is not None
