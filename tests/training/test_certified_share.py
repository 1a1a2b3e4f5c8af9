"""The statistical bound as a curve over the training: of these weights, on fresh states, without a trace in the run."""

from functools import partial

import pytest
import torch

import lyapnet
from lyapnet.base.random_streams import CERTIFICATION, TEST, TRAINING, VALIDATION, stream
from lyapnet.claims.statistical import bound_share
from lyapnet.experiment.checkpoint import read_checkpoint
from tests.runs import SMALL, Desk, dies_at, logged, values, without_figures

pytestmark = pytest.mark.gate

TRAINING_OPTIONS = {**SMALL["training"], "iterations": 30, "validate_every": 10}
CERTIFIED = {"certify_every": 2, "certified_states": 40, "confidence": 0.9}
DISCRETE = {"gradient": "discrete", "compile": "off"}
BOUNDS = [f"{name}_lower_bound/val" for name in ("probability", "decrease", "cost")]


def trained(folder, *arguments, certified=CERTIFIED, **changes):
    folder.mkdir(exist_ok=True)
    evaluation = {**SMALL["evaluation"], **certified}
    desk = Desk(folder, **{"training": TRAINING_OPTIONS, "rollout": DISCRETE, "evaluation": evaluation, **changes})
    status, _, errors = desk.train(*arguments, prepare=without_figures)
    assert (status, errors) == (0, "")
    return desk


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return trained(tmp_path_factory.mktemp("certified"))


def bounds_of(checkpoint, step, seed=0):
    """The bounds of a checkpoint, by the way of `lyapnet certify`."""
    controller = lyapnet.load(checkpoint)
    limits = controller.program.tolerances()
    draw = stream(seed, CERTIFICATION, step)
    claim = bound_share(controller.rollout, controller.problem, limits, 40, 0.9, generator=draw)
    return [claim.lower_bounds[event] for event in ("all", "decrease", "cost")]


def test_the_curves_are_the_bounds_of_the_weights_at_their_steps(run):
    for tag in BOUNDS:
        assert [*values(run.run, tag)] == [0, 20, 30], "every second validation, and the last"
    last = [values(run.run, tag)[30] for tag in BOUNDS]
    assert last == pytest.approx(bounds_of(run.last, 30), abs=1e-6)
    assert any(0 < bound < 1 for bound in last)
    assert last != pytest.approx(bounds_of(run.last, 29), abs=1e-6), "other states, another bound"


def test_the_run_is_the_same_without_them(run, tmp_path):
    without = trained(tmp_path / "without", certified={})
    mine, its = (read_checkpoint(desk.last)["state_dict"] for desk in (run, without))
    assert all(torch.equal(mine[key], its[key]) for key in its)
    curves, fewer = logged(run.run), logged(without.run)
    assert curves["loss/train"] == fewer["loss/train"]
    assert set(BOUNDS) <= curves.keys()
    assert not set(BOUNDS) & fewer.keys(), "off by default"


@pytest.mark.gate
def test_a_killed_run_resumes_with_the_same_curves(run, tmp_path):
    desk = Desk(
        tmp_path,
        **{"training": TRAINING_OPTIONS, "rollout": DISCRETE, "evaluation": {**SMALL["evaluation"], **CERTIFIED}},
    )
    place = "lyapnet.training.certified_share:CertifiedShare"
    assert desk.train(prepare=partial(_dies, place))[0] < 0
    assert [*values(desk.run, BOUNDS[0])] == [0]
    assert desk.train("--resume", "last", prepare=without_figures)[0] == 0
    for tag in BOUNDS:
        assert values(desk.run, tag) == values(run.run, tag)


def _dies(place):
    without_figures()
    dies_at(place, "act", call=2)


def test_each_member_of_an_ensemble_has_its_own(run, tmp_path):
    desk = trained(tmp_path / "ensemble", seeds=2)
    first, second = (desk.run / f"seed_{k}" for k in (0, 1))
    for tag in BOUNDS:
        assert values(first, tag) == pytest.approx(values(run.run, tag))
    assert any(values(first, tag) != values(second, tag) for tag in BOUNDS)


def test_its_states_are_drawn_for_nothing_else():
    paths = [(CERTIFICATION, 0), (CERTIFICATION, 1), (CERTIFICATION,), (VALIDATION,), (TEST,), (TRAINING, 0, 0)]
    draws = [tuple(torch.rand(4, generator=stream(0, *path)).tolist()) for path in paths]
    assert len(set(draws)) == len(paths)
    assert tuple(torch.rand(4, generator=stream(0, CERTIFICATION, 1)).tolist()) == draws[1]
