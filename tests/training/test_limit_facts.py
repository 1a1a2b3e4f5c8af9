"""How much of X₀ limits can hold near the goal: against closed forms, the strongest controls, and optima."""

import math
import re

import pytest
import torch

from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import config_from_plain
from lyapnet.training.experiment import train
from lyapnet.training.limit_facts import limit_facts


def task(A, B, widths, controls, **changes):
    n = len(A)
    return {
        "experiment": "x", "system": {"name": "linear", "parameters": {"A": A, "B": B}},
        "cost": {"Q": [1] * n, "R": [1] * len(B[0]), "Q_T": [1] * n}, "controls": controls,
        "initial_states": {"lower": [-w for w in widths], "upper": widths}, "horizon": {"steps": 20, "dt": 0.1},
        **changes,
    }  # fmt: skip


def found(content):
    facts = limit_facts(build_problem(config_from_plain(content)))
    assert len(facts) < 2
    return facts[0] if facts else None


def growing_mode(problem):
    """λ of the fastest mode, l and |lᵀB|, from differences of ẋ at the goal."""
    rows, step = torch.eye(problem.system.n).double(), 1e-6
    u = torch.zeros(problem.system.n, problem.system.m).double()
    A = ((problem.system.dynamics(step * rows, u) - problem.system.dynamics(-step * rows, u)) / (2 * step)).mT
    values, vectors = torch.linalg.eig(A.mT)
    k = int(values.real.argmax())
    left = vectors[:, k].real
    return float(values[k].real), left, float((left @ problem.system.g(rows[0] * 0)).abs().sum())


BALL = {"name": "ball", "parameters": {"radius": 1.0}}
POLYTOPE = {"name": "polytope", "parameters": {"A": [[1, 1], [-1, -1], [1, -1], [-1, 1]], "b": [1, 1, 1, 1]}}


@pytest.mark.parametrize(("B", "controls", "held"), [
    ([[1.0]], {"lower": -1, "upper": 1}, (-0.5, 0.5)),
    ([[1.0]], {"lower": -1, "upper": 2}, (-1.0, 0.5)),
    ([[-1.0]], {"lower": -1, "upper": 2}, (-0.5, 1.0)),
    ([[1.0, -2.0]], {"lower": [-1, -0.25], "upper": [1, 0.25]}, (-0.75, 0.75)),
    ([[1.0, 1.0]], BALL, (-math.sqrt(0.5), math.sqrt(0.5))),
    ([[1.0, 0.5]], POLYTOPE, (-0.5, 0.5)),
    ([[1.0]], {"lower": None, "upper": 1}, (-0.5, math.inf)),
])  # fmt: skip
def test_the_share_of_one_growing_state(B, controls, held):
    """ẋ = 2x + bu is held from −max bu ≤ 2x ≤ −min bu, and X₀ is |x| ≤ 2."""
    low, high = (max(-2.0, min(2.0, end)) for end in (-held[1], -held[0]))
    share = 1 - (high - low) / 4
    told = found(task([[2.0]], B, [2.0], controls))
    assert told.advice
    assert int(re.search(r"for (\d+)% of X₀", told.found)[1]) / 100 == pytest.approx(share, abs=0.025)
    assert f"mode 2 1/s grows whatever u is, and what is missing {math.exp(4):.2g}-fold within T" in told.found


def test_what_is_outside_grows_under_the_strongest_control_and_what_is_inside_is_held():
    """A pole and a cart of mass 1 within ±1: the strongest control against lᵀx, from both sides of the border."""
    A, B = torch.tensor([[0.0, 1.0], [9.0, -1.0]]).double(), torch.tensor([[0.0], [1.0]]).double()
    values, vectors = torch.linalg.eig(A.mT)
    k = int(values.real.argmax())
    left, rate = vectors[:, k].real, float(values[k].real)
    border = float((left @ B).abs()) / rate / float(left[0].abs())
    for width, held in ((0.99 * border, True), (1.01 * border, False)):
        told = found(task(A.tolist(), B.tolist(), [width, 1e-9], {"lower": -1, "upper": 1}))
        assert told.found.startswith("the linear model" if held else "the limits are too small for"), told
        x, most = torch.tensor([width, 0.0]).double(), 0.0
        for _ in range(5000):
            u = (-torch.sign(left @ x) * torch.sign(left @ B)[0]).clamp(-1, 1)
            x = x + 2e-3 * (A @ x + B[:, 0] * u)
            most = max(most, abs(float(left @ x)))
        assert (most <= 1.01 * width * float(left[0].abs())) == held


@pytest.mark.parametrize("content", [
    task([[-2.0]], [[1.0]], [2.0], {"lower": -0.1, "upper": 0.1}),  # nothing grows
    task([[2.0]], [[1.0]], [2.0], {}),  # no limits
    task([[0.4]], [[1.0]], [9.0], {"lower": -0.1, "upper": 0.1}),  # hardly within T = 2 s
    task([[2.0]], [[1.0]], [0.2], {"lower": -1, "upper": 1}),  # held with less than half
    task([[0.0, 1.0], [-4.0, 0.5]], [[0.0], [1.0]], [9.0, 9.0], {"lower": -1, "upper": 1}),  # oscillates
    task([[2.0, 0.0], [0.0, -1.0]], [[0.0], [1.0]], [2.0, 2.0], {"lower": -1, "upper": 1}),  # not reached: said there
])  # fmt: skip
def test_nothing_is_said(content):
    assert found(content) is None


def test_what_limits_take_of_a_goal_that_they_have_to_hold():
    """ẋ = 2x + u − 0.8 is held where 2x − 0.8 is between −1 and 1."""
    equations = {
        "name": "equations", "states": {"x": "m"}, "controls": {"u": "N"}, "equations": "der(x) = 2*x + u - 0.8",
    }  # fmt: skip
    content = task([[2.0]], [[1.0]], [1.0], {"lower": -1, "upper": 1}, system=equations, target=[0.0])
    assert "for 50% of X₀" in found(content).found, "from -0.1 to 0.9, of X₀ from -1 to 1"


def test_a_swing_up_is_told_without_advice():
    content = task([[0.0]], [[1.0]], [1.0], {"lower": -8, "upper": 8}, system={"name": "pendulum"},
                   cost={"Q": [0.5, 0.05], "R": 0.05, "Q_T": [50, 5]},
                   initial_states={"lower": [2.84, -0.5], "upper": [3.44, 0.5]})  # fmt: skip
    told = found(content)
    assert "for all of X₀" in told.found
    assert "swing" in told.found
    assert not told.advice


@pytest.mark.gate
def test_optima_of_a_pole_fall_where_limits_are_too_small_and_stay_where_they_are_not():
    pytest.importorskip("casadi")
    from lyapnet.evaluation import oracle_of

    content = task(
        [[0.0]], [[1.0]], [1.0], {"lower": -10, "upper": 10}, system={"name": "cartpole"},
        cost={"Q": [1, 10, 0.1, 0.1], "R": 0.01, "Q_T": [10, 100, 1, 1]}, horizon={"steps": 100, "dt": 0.02},
        initial_states={"lower": [-0.1, -1, -0.1, -3], "upper": [0.1, 1, 0.1, 3]},
    )  # fmt: skip
    problem = build_problem(config_from_plain(content)).double()
    x = problem.initial_states.sample(512, torch.Generator().manual_seed(0))
    mode, left, slope = growing_mode(problem)
    taken = (x @ left).abs() * mode / (10 * slope)
    chosen = torch.cat([x[taken > 1.05][:4], x[taken < 0.4][:4]])
    optima = oracle_of(problem)
    angles = optima.rollout(chosen, optima.solve(chosen).u)[0][..., 1]
    assert (angles[:, :4].abs().amax(0) > math.pi).all(), "they fall, and swing around"
    assert (angles[:, 4:].abs().amax(0) < math.pi / 2).all()


@pytest.mark.parametrize("width", [1.0, 0.3])
def test_a_training_begins_with_a_note(width, tmp_path, capsys):
    config = task(
        [[2.0]], [[1.0]], [width], {"lower": -1, "upper": 1}, logs=str(tmp_path), loggers=["csv"],
        rollout={"compile": "off"}, training={"iterations": 1}, network={"name": "fcn", "hidden": [4]},
        evaluation={"validation_states": 2, "test_states": 2, "optimum": False}, program={"name": "value"},
    )  # fmt: skip
    train(config_from_plain(config))
    notes = [line for line in capsys.readouterr().out.splitlines() if line.startswith("note: ")]
    assert ["too small" in note and note.endswith("near the goal.") for note in notes] == [True] * (width == 1.0)
