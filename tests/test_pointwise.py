"""The condition off the closed loops: against Riccati's V, formulas by hand, and finite differences."""

import csv

import pytest
import torch
import yaml
from scipy.linalg import solve_continuous_are
from test_config import PLAIN
from torch.testing import assert_close

from lyapnet.build import build_pointwise, build_rollout, build_task, build_value_function
from lyapnet.closed_loop import ClosedLoop
from lyapnet.config import config_from_plain
from lyapnet.cost import QuadraticCost
from lyapnet.data import InitialStateDataModule
from lyapnet.errors import UsageError
from lyapnet.modules import build_module
from lyapnet.policy import HJBPolicy
from lyapnet.programs import PointwiseCondition
from lyapnet.randomness import stream
from lyapnet.sets import Box
from lyapnet.systems import DoubleIntegrator

A, B = torch.tensor([[0.0, 1.0], [0.0, 0.0]]).double(), torch.tensor([[0.0], [1.0]]).double()
Q, DURATION, POINTS = torch.diag(torch.tensor([10.0, 0.1], dtype=torch.float64)), 2.0, 12
MEAN_COST, LARGEST = (torch.tensor(cost, dtype=torch.float64) for cost in (3.0, 100.0))
WRONG = [[4.0, 0.5], [0.5, 0.3]]


def riccati():
    return torch.tensor(solve_continuous_are(A.numpy(), B.numpy(), Q.numpy(), [[1.0]]))


@pytest.fixture
def of(quadratic):
    """The condition of V = xᵀPx with φ = xᵀQ_T x; margin None for the value program."""

    def build(P, margin=None, Q_T=None, further=None):
        V, system = quadratic(P), DoubleIntegrator()
        cost = QuadraticCost(Q, [[1.0]], riccati() if Q_T is None else Q_T)
        loop = ClosedLoop(system, cost, HJBPolicy(system, cost, V))
        return PointwiseCondition(loop, V, Box([-1.0, -2.0], [1.0, 2.0]), DURATION, POINTS, margin, further)

    return build


def value(condition, seed=0, largest=LARGEST):
    return condition(stream(seed), MEAN_COST, largest)


def by_hand(x, P, margin, Q_T, ceiling=torch.inf):
    """Both penalties at each state, from matrices: V̇ = 2xᵀP(Ax + Bu) and ℓ = xᵀQx + u² with u = −BᵀPx."""
    P, rows = torch.as_tensor(P), []
    for y in x:
        u = -B.T @ P @ y
        V, running, terminal = y @ P @ y, y @ Q @ y + u @ u, y @ Q_T @ y
        rate = 2 * y @ P @ (A @ y + B @ u)
        condition = (rate + (1 + (margin or 0.0)) * running) / (running + 0.01 * MEAN_COST / DURATION)
        end = (terminal - V) / (terminal + 0.01 * MEAN_COST)
        both = torch.stack([condition, end])
        rows.append((both.square() if margin is None else both.clamp_min(0)) * (ceiling >= V))
    return torch.stack(rows, -1)


def chosen(condition, P, margin, ceiling=torch.inf, seed=0):
    """The states of a step: the worse half of all that are drawn, and the first of them."""
    _, x = condition._draw(stream(seed))
    worst = by_hand(x, P, margin, torch.eye(2), ceiling)[0].topk(POINTS // 2).indices
    return torch.cat([x[worst], x[: POINTS - len(worst)]])


@pytest.mark.parametrize("margin", [None, 0.0])
def test_the_solution_of_riccati_leaves_nothing(of, margin):
    """V̇ + ℓ = 0 everywhere, and V(T, ·) = φ; the twin: a V that is too small."""
    assert abs(value(of(riccati(), margin)).item()) < 1e-12
    assert value(of(0.9 * riccati(), margin)) > 1e-3


@pytest.mark.parametrize("margin", [None, 0.0, 0.2])
def test_formulas_by_hand(of, margin):
    condition = of(WRONG, margin, torch.eye(2))
    expected = by_hand(chosen(condition, WRONG, margin), WRONG, margin, torch.eye(2)).mean(-1).sum()
    assert_close(value(condition).detach(), expected)
    assert expected > 0.1


def test_a_hinge_forgives_what_the_square_does_not(of):
    """1.3 times Riccati's V pays for more than ℓ: no violation, but no solution either."""
    generous = 1.3 * riccati()
    assert value(of(generous, 0.0)) == 0
    assert value(of(generous)) > 1e-2
    assert value(of(generous, 0.5)) > 1e-2, "a margin above what it pays for"


def test_points_above_the_ceiling_do_not_count(of):
    condition, largest = of(WRONG, 0.2, torch.eye(2)), torch.tensor(0.2)
    x = chosen(condition, WRONG, 0.2, 1.2 * largest)
    low, all_of_them = (by_hand(x, WRONG, 0.2, torch.eye(2), c).mean(-1).sum() for c in (1.2 * largest, torch.inf))
    assert_close(value(condition, largest=largest).detach(), low)
    assert 0 < low < 0.9 * all_of_them
    assert value(condition, largest=torch.tensor(0.0)) == 0


def test_points_are_those_of_the_stream(of):
    condition = of(WRONG, 0.2, torch.eye(2))
    assert value(condition) == value(condition)
    assert value(condition) != value(condition, seed=1)
    t, x = condition._draw(stream(0))
    assert len(t) == 4 * POINTS
    assert condition.region.contains(x).all()
    assert (t >= 0).all()
    assert (t <= DURATION).all()


def test_further_points_join_those_of_every_step(of):
    further = torch.tensor([[0.5, 0.3, -0.2], [2.0, -0.9, 1.5]])
    condition = of(WRONG, 0.2, torch.eye(2), further)
    x = torch.cat([chosen(condition, WRONG, 0.2), further[:, 1:]])
    assert_close(value(condition).detach(), by_hand(x, WRONG, 0.2, torch.eye(2)).mean(-1).sum())
    assert value(condition) != value(of(WRONG, 0.2, torch.eye(2)))


@pytest.mark.parametrize("margin", [None, 0.2])
def test_gradient_against_finite_differences(of, margin, monkeypatch):
    """With the denominators held, which take no part in it; the twin: they would."""
    condition = of(WRONG, margin, torch.eye(2))
    (P,), penalty, units = condition.V.parameters(), PointwiseCondition._penalty, []
    (slope,) = torch.autograd.grad(value(condition), P)

    def difference(held):
        columns = []
        for k in range(4):
            step = 1e-5 * torch.eye(4)[k].reshape(1, 2, 2)
            ends = []
            for sign in (1, -1):
                remaining = iter(units)
                again = (lambda self, excess, unit: penalty(self, excess, next(remaining))) if held else penalty  # noqa: B023
                monkeypatch.setattr(PointwiseCondition, "_penalty", again)
                with torch.no_grad():
                    P.add_(sign * step)
                    ends.append(value(condition))
                    P.sub_(sign * step)
            columns.append((ends[0] - ends[1]) / 2e-5)
        return torch.stack(columns).reshape(1, 2, 2)

    def recording(self, excess, unit):
        units.append(unit.detach())
        return penalty(self, excess, unit)

    monkeypatch.setattr(PointwiseCondition, "_penalty", recording)
    value(condition)
    assert_close(slope, difference(held=True), rtol=1e-5, atol=1e-6)
    assert not torch.allclose(slope, difference(held=False), rtol=1e-2)


# In a training


def config_of(*overrides):
    return config_from_plain(yaml.safe_load(PLAIN), ["pointwise.weight=2", "pointwise.points=8", *overrides])


def built(*overrides):
    config = config_of(*overrides)
    task = build_task(config)
    V = build_value_function(config, task)
    return build_pointwise(config, task, V, build_rollout(config, task, V).closed_loop)


def one_step(*overrides):
    """(the terms of the first member, its gradients) of a step."""
    module = build_module(config_of(*overrides))
    config = module.members[0].config
    task = build_task(config)
    states = [
        InitialStateDataModule(task.initial_states, 2, 2, member.config.seed).batch(0) for member in module.members
    ]
    loss = module.training_step(torch.stack(states) if len(states) > 1 else states[0], 0)["loss"]
    gradients = torch.autograd.grad(loss, list(module.members[-1].V.parameters()))
    return module.members[-1].output, gradients


def test_the_loss_has_the_term_with_its_weight():
    output, gradients = one_step()
    without, others = one_step("pointwise.weight=0")
    assert "pointwise" not in without.terms
    assert_close(output.loss - without.loss, 2 * output.terms["pointwise"])
    assert output.terms["pointwise"] > 0
    assert any(not torch.allclose(a, b, rtol=1e-3) for a, b in zip(gradients, others, strict=True))


def test_a_member_of_an_ensemble_has_the_points_of_its_seed():
    discrete = ["rollout.gradient=discrete", "rollout.compile=off"]
    member, gradients = one_step("seed=3", "seeds=2", *discrete)
    alone, expected = one_step("seed=4", *discrete)
    assert_close(member.terms["pointwise"], alone.terms["pointwise"], rtol=1e-9, atol=0)
    for a, b in zip(gradients, expected, strict=True):
        assert_close(a, b, rtol=1e-9, atol=1e-12)
    assert not torch.allclose(one_step("seed=3", *discrete)[0].terms["pointwise"], alone.terms["pointwise"], rtol=1e-3)


# What is built


def write(path, rows):
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    return f"pointwise.counterexamples={path}"


def test_what_a_config_says():
    condition = built()
    assert condition.region.upper.tolist() == [1.5, 1.5], "one and a half times X₀"
    assert (condition.points, condition.margin, condition.further) == (8, 0.1, None)
    assert condition.duration == pytest.approx(0.4)
    assert built("pointwise.region=[2, 3]").region.lower.tolist() == [-2, -3]
    assert built("pointwise.region=[2]").region.upper.tolist() == [2, 2]
    assert built("pointwise.weight=0") is None
    assert built("program={name: value}").margin is None


def test_counterexamples_are_read_to_the_last_digit(tmp_path):
    points = [[0.1, 1 / 3, -0.7], [0.2, 1e-17, 2.0]]
    torch.set_default_dtype(torch.float32)  # as a user has it
    condition = built(write(tmp_path / "points.csv", [["t", "position", "velocity"], *points]))
    assert condition.further.tolist() == points
    assert len(built(write(tmp_path / "none.csv", [["t", "position", "velocity"]])).further) == 0


@pytest.mark.parametrize(
    "rows",
    [
        [["t", "x"], [0.1, 0.2]],
        [["t", "x", "v"], [0.1, 0.2, "far"]],
        [["t", "x", "v"], [0.1, 0.2, "nan"]],
        [["t", "x", "v"], [0.1, 0.2, 0.3], [0.1]],
        [[0.1, 0.2, 0.3], [0.1, 0.2, 0.3]],
        [],
    ],
    ids=["two columns", "words", "nan", "ragged", "no heading", "empty"],
)
def test_a_broken_file_of_counterexamples_is_refused(rows, tmp_path):
    path = tmp_path / "points.csv"
    with pytest.raises(UsageError, match=r"Expected pointwise.counterexamples as a CSV of rows t, x_1, …, x_2, got"):
        built(write(path, rows))
    with pytest.raises(UsageError, match=r"nowhere\.csv"):
        built("pointwise.counterexamples=nowhere.csv")
    path.write_bytes(bytes(range(128, 256)))
    with pytest.raises(UsageError, match=r"points\.csv"):
        built(f"pointwise.counterexamples={path}")


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["pointwise.region=[1, 2, 3]"], "pointwise.region"),
        (["pointwise.region=[0, 1]"], "pointwise.region"),
        (["initial_states={lower: [-1, 0], upper: [1, 0]}"], "Expected pointwise.region, got none, and X₀ is thin"),
        (["pointwise.points=1"], "pointwise.points"),
        (["pointwise.weight=-1"], "pointwise.weight"),
    ],
)
def test_a_region_that_does_not_fit_is_refused(overrides, message):
    with pytest.raises(UsageError, match=message):
        built(*overrides)
    built("initial_states={lower: [-1, 0], upper: [1, 0]}", "pointwise.region=[1, 2]")
