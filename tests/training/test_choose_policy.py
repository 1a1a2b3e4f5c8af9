"""The law that the search for a start chooses: one that looks ahead where V's sampled law costs much more."""

import pytest
import torch

import lyapnet
from lyapnet.evaluation.references import costs_of_holding
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import config_from_plain
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.systems import Linear
from lyapnet.training.build_learner import build_learner
from lyapnet.training.candidates import Candidate, Start
from lyapnet.training.pretraining import FitResult, fit
from lyapnet.training.start import _gain_by_looking_ahead, choose_start
from lyapnet.value.expansions import riccati
from lyapnet.value.policy import LookaheadPolicy, SampledPolicy
from tests.fits import shorten_fits
from tests.problems import Formula, problem_of

FEW = ["training.iterations=2", "evaluation.test_states=4", "evaluation.validation_states=4", "loggers=[csv]",
       "evaluation.optimum=false", "evaluation.animate=false", "rollout.gradient=backprop"]  # fmt: skip


TASK = {
    "experiment": "limited",
    "system": {"name": "double_integrator"},
    "cost": {"Q": [1, 1], "R": 0.01, "Q_T": [1, 1]},
    "controls": {"lower": -0.2, "upper": 0.2},
    "initial_states": {"lower": [0.5, 0], "upper": [1.0, 0.3]},
    "horizon": {"steps": 8, "dt": 0.2},
}
SAID = "law: rollout.policy=lookahead, with V as it is, costs 0.2 of the cost less than sampled"

FITTED = "V fitted for the law that looks ahead"


@pytest.fixture
def brief(monkeypatch, tmp_path):
    """The task, its log folder, and a search for a start that is brief and finds that looking ahead gains a fifth."""
    monkeypatch.setattr("lyapnet.training.start.MAX_OPTIMA", 12)
    shorten_fits(monkeypatch, 60, 20)
    monkeypatch.setattr("lyapnet.training.start.fit", lambda *given: fit(*given)._replace(excess=0.2))
    monkeypatch.setattr("lyapnet.training.start._gain_by_looking_ahead", lambda policy, x0: 0.2)
    return {**TASK, "logs": str(tmp_path)}


def law_of(checkpoint):
    return type(lyapnet.load(checkpoint).closed_loop.policy)


@pytest.mark.gate
def test_the_law_that_costs_much_less_is_trained_and_stays_the_run_s(brief, capsys):
    run = lyapnet.train(brief, FEW)
    assert SAID in capsys.readouterr().out
    assert "policy: lookahead" in (run.folder / "config.yaml").read_text()
    assert law_of(run.best) is law_of(run.last) is LookaheadPolicy
    tried = run.record()["start"]["tried"]
    chosen = run.record()["start"]["chosen"]
    assert chosen in (FITTED, "the law that looks ahead")
    assert tried[chosen] == min(tried[FITTED], tried["the law that looks ahead"])
    more = lyapnet.train(brief, [*FEW, "training.iterations=3"], resume="last")
    assert (more.folder, law_of(more.last)) == (run.folder, LookaheadPolicy)


@pytest.mark.gate
def test_a_law_that_is_named_stays(brief, capsys):
    run = lyapnet.train(brief, [*FEW, "rollout.policy=sampled"])
    assert SAID in capsys.readouterr().out
    assert law_of(run.best) is SampledPolicy
    assert FITTED not in run.record()["start"]["tried"]


def test_what_looking_ahead_gains():
    """ẋ = u, with a V that is flat about the goal and steep beside it; its curvature is said to be Riccati's."""
    problem = problem_of(Linear([[0.0]], [[1.0]]), QuadraticCost([[1.0]], [[0.01]], [[1.0]]), steps=20, dt=0.1)
    x0 = torch.linspace(0.5, 1, 8)[:, None]
    steep, known = Formula(lambda t, x: 2 * x[..., 0] ** 4), riccati(problem)
    exact = Formula(lambda t, x: known.hessian[(t / 0.1).round().long().clamp(0, 20), 0, 0] / 2 * x[..., 0] ** 2)
    assert _gain_by_looking_ahead(SampledPolicy(problem, steep), x0) > 0.1
    assert _gain_by_looking_ahead(SampledPolicy(problem, exact), x0) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize(
    ("given", "overrides", "chosen"),
    [
        ({}, [], True),
        ({"rollout": {"policy": "sampled"}}, [], False),
        ({}, ["rollout.policy=sampled"], False),
        ({"rollout": {"policy": "sampled", "choose_policy": True}}, [], True),
        ({"constraints": {"upper": {"velocity": 1}}}, [], False),
    ],
)
def test_who_names_a_law_has_it(given, overrides, chosen):
    assert config_from_plain({**TASK, **given}, overrides).rollout.choose_policy is chosen


def test_the_same_v_under_the_law_that_looks_ahead():
    config = config_from_plain(TASK, FEW)
    learner = build_learner(config, build_problem(config))
    ahead = learner.looking_ahead()
    assert ahead.V is learner.V
    assert type(ahead.rollout.closed_loop.policy) is LookaheadPolicy
    assert type(learner.rollout.closed_loop.policy) is SampledPolicy
    x0 = learner.problem.initial_states.sample(4, torch.Generator().manual_seed(0))
    law = LookaheadPolicy(learner.problem, learner.V)
    expected = costs_of_holding(law, learner.problem.horizon, learner.problem, x0)
    torch.testing.assert_close(ahead.path_from(x0).cost, expected.double(), rtol=1e-5, atol=0)


@pytest.mark.parametrize(("excess", "asked"), [(0.02, 0), (0.1, 1)])
def test_a_law_close_to_the_optima_has_nothing_to_save(excess, asked, monkeypatch):
    calls = list[torch.Tensor]()
    monkeypatch.setattr("lyapnet.training.start.MAX_OPTIMA", 6)
    monkeypatch.setattr("lyapnet.training.start.fit", lambda *_: FitResult(excess, 0.0))
    monkeypatch.setattr("lyapnet.training.start._cheapest", lambda candidates: candidates[-1])  # the fitted V
    monkeypatch.setattr("lyapnet.training.start._gain_by_looking_ahead", lambda policy, x0: calls.append(x0) or 0.01)
    config = config_from_plain(TASK, FEW)
    choose_start([build_learner(config, build_problem(config))])
    assert len(calls) == asked


def test_little_is_no_reason():
    candidate = Candidate("anything", 1.0, 1.0, 0.0)
    assert Start(candidate, [candidate], 1.0, 0.2).should_look_ahead
    assert not Start(candidate, [candidate], 1.0, 0.01).should_look_ahead
