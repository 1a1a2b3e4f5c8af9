"""The region program: what it calls the region, against ellipses known in closed form, and how it grows."""

import math

import pytest
import torch
from scipy.linalg import solve_continuous_are

from lyapnet.base.errors import UsageError
from lyapnet.base.random_streams import stream
from lyapnet.experiment.config import config_from_plain
from lyapnet.loop.programs import RegionCondition, RegionProgram
from lyapnet.loop.rollout import Rollout
from lyapnet.task.sets import Box
from lyapnet.task.systems import DoubleIntegrator, Linear
from lyapnet.training.build import build_module
from lyapnet.training.start import choose_start
from lyapnet.value.policy import HJBPolicy
from tests.fits import shorten_fits
from tests.problems import Formula, problem_of

A, B, Q = [[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], torch.eye(2).double()
P = torch.tensor(solve_continuous_are(A, B, Q.numpy(), [[1.0]]))
COST = torch.tensor(3.0, dtype=torch.float64)
OWN = {
    "experiment": "mine",
    "system": {"name": "double_integrator"},
    "cost": {"Q": 1, "R": 1},
    "controls": {"lower": -1, "upper": 1},
    "initial_states": {"lower": [-1, -1], "upper": [1, 1]},
    "horizon": {"steps": 60, "dt": 0.1, "stationary": True},
    "program": {"name": "region"},
    "pointwise": {"region": [2, 2]},
}

OSCILLATOR = {
    "system": {"name": "van_der_pol"},
    "initial_states": {"lower": [-2, -2], "upper": [2, 2]},
    "pointwise": {"region": [4.8, 10.8]},
}


@pytest.fixture
def of(quadratic):
    """The condition of V = xᵀPx and the regulator's law, for a double integrator without limits."""

    def build(P, reach=(2.0, 3.0), **options):
        problem = problem_of(DoubleIntegrator()).in_steps(stationary=True)
        rollout = Rollout(problem, HJBPolicy(problem, quadratic(P)))
        box = Box([-r for r in reach], list(reach))
        return RegionCondition(rollout, RegionProgram(**options), box, weight=5.0, points=64)

    return build


def inscribed(P, reach):
    """The area of the largest ellipse xᵀPx ≤ ρ in a box, by hand: its extent along x_i is √(ρ (P⁻¹)_ii)."""
    inverse = torch.linalg.inv(P)
    rho = min(r**2 / float(inverse[i, i]) for i, r in enumerate(reach))
    return math.pi * rho / math.sqrt(float(torch.linalg.det(P)))


@pytest.mark.parametrize("reach", [(2.0, 3.0), (1.0, 5.0)])
def test_the_sampled_region_is_the_inscribed_ellipse(of, reach):
    share = float(of(P, reach).sampled_share(stream(0)))
    assert share == pytest.approx(inscribed(P, reach) / (4 * reach[0] * reach[1]), abs=0.01)


def turning(growth=0.06, size=0.9):
    """The condition of V = ‖x‖² on [−1, 1]² for steps that turn by 45° and shrink by `size`."""
    half = size * math.sqrt(0.5)
    step = torch.tensor([[half, -half], [half, half]]).double()
    system = Linear(((step - torch.eye(2)) / 0.1).tolist(), [[0.0], [0.0]])
    problem = problem_of(system, dt=0.1).in_steps(stationary=True)
    rollout = Rollout(problem, HJBPolicy(problem, Formula(lambda t, x: x.square().sum(-1) + 0 * t)))
    program = RegionProgram(steps=True, growth=growth, share=1e-9)
    return RegionCondition(rollout, program, Box([-1.0, -1.0], [1.0, 1.0]), 5.0, 64)


def test_with_steps_the_region_ends_where_the_next_step_leaves_the_set():
    """‖x‖ = 1/0.9 in the direction of a corner: beyond the circle in the square, whose share is π/4."""
    beyond = math.sqrt(1 / 0.81 - 1)
    area = 4 * beyond + 4 * (math.atan2(1, beyond) - math.pi / 4) / 0.81
    assert float(turning().sampled_share(stream(0))) == pytest.approx(area / 4, abs=0.02)


@torch.no_grad()
def test_with_steps_V_has_to_fall_from_step_to_step():
    """(0.81 − 1)‖x‖²/Δt; V̇ of the same system is another number."""
    condition, x = turning(), torch.tensor([[0.3, -0.4]]).double()
    rate = condition.rate(torch.zeros(()), x, torch.zeros(1, 1).double())
    assert float(rate) == pytest.approx(-0.19 * 0.25 / 0.1)
    assert float(turning(growth=0.0)(stream(1), COST, COST)) == 0
    assert float(turning(growth=0.0, size=1.01)(stream(1), COST, COST)) > 0


def test_where_V_rises_there_is_no_region(of):
    wrong = torch.tensor([[1.0, -0.9], [-0.9, 1.0]]).double()  # its law pushes away
    assert float(of(wrong).sampled_share(stream(0))) < 0.01


@torch.no_grad()
def test_the_condition_is_the_share_outside_where_V_falls_fast_enough(of):
    """Of Riccati's V, V̇ = −ℓ, so that with a share of one nothing fails, and what is left is growth × the outside."""
    exact, none = of(P, growth=0.06, share=1.0), of(P, growth=0.0, share=1.0)
    assert float(none(stream(1), COST, COST)) < 1e-12
    outside = 1 - inscribed(P, (2.0, 3.0)) / 24
    assert float(exact(stream(1), COST, COST)) == pytest.approx(0.06 * outside, rel=0.2)  # the step is smoothed
    assert float(of(0.5 * P, growth=0.0, share=1.0)(stream(1), COST, COST)) > 0.1  # half of V pays for half of ℓ


@torch.no_grad()
@pytest.mark.parametrize("size", [1.0, 7.0])
def test_the_level_and_the_ceiling_in_closed_form(size, monkeypatch):
    """Of a V that is c everywhere, ρ = (1024 c⁻³⁰)^(−1/30) = c 2^(−1/3), and all of D is at V = c: above 1.15 ρ."""
    problem = problem_of(DoubleIntegrator()).in_steps(stationary=True)
    rollout = Rollout(problem, HJBPolicy(problem, Formula(lambda t, x: size + 0 * x.sum(-1))))
    condition = RegionCondition(rollout, RegionProgram(growth=0.5), Box([-2.0, -3.0], [2.0, 3.0]), 5.0, 64, floor=0.2)
    outside = 1 / (1 + math.exp(-8 * math.log(2) / 3))  # σ(8 log(c/ρ)) at each point of D
    assert float(condition(stream(0), COST, COST)) == pytest.approx(0.5 * outside, rel=1e-12)
    given = []
    monkeypatch.setattr(condition, "condition", lambda generator, *numbers: given.extend(numbers) or COST)
    condition(stream(0), COST, COST)
    assert [float(number) for number in given] == pytest.approx([0.2 * float(COST), 1.15 * size * 2 ** (-1 / 3)])


def test_the_defaults_of_the_program():
    assert RegionProgram() == RegionProgram(share=0.4, growth=0.06)
    assert RegionProgram.recommended == {"constraint": 0, "trajectory_cost": 1, "share": 0.4, "growth": 0.06}


def test_its_boundary_has_points_on_each_side(of):
    x = of(P)._boundary(stream(2))
    on = torch.stack([(x[:, i].abs() == reach) for i, reach in enumerate((2.0, 3.0))])
    assert bool(on.any(0).all())
    for i, reach in enumerate((2.0, 3.0)):
        assert {float(side) for side in x[on[i], i]} == {-reach, reach}


def test_it_follows_its_learner_to_another_device():
    """To that of tensors without data, which others cannot be mixed with; limits of controls have to have some."""
    (learner,) = build_module(config_from_plain({**OWN, "controls": {}})).members
    learner.to("meta")
    condition = learner.pointwise
    assert condition(stream(1), COST.to("meta"), COST.to("meta")).is_meta
    assert condition.sampled_share(stream(1)).is_meta


def test_along_ignored_states_D_has_no_boundary():
    cart = {
        "system": {"name": "cartpole"}, "cost": {"Q": [0, 1, 0.1, 0.1], "R": 0.1},
        "initial_states": {"lower": [-0.1] * 4, "upper": [0.1] * 4}, "pointwise": {"region": [9, 1, 2, 3]},
        "controls": {"lower": -9, "upper": 9}, "network": {"ignored_states": ["cart position"]},
    }  # fmt: skip
    (learner,) = build_module(config_from_plain(OWN | cart)).members
    assert learner.pointwise.axes == [1, 2, 3]
    on = learner.pointwise._boundary(stream(2)).abs() == learner.pointwise.region.upper
    assert bool(on.any(1).all())
    assert not on[:, 0].any()


def test_growth_widens_the_region(of):
    """Down its gradient the inscribed ellipse becomes larger, and up, smaller."""
    condition = of(torch.eye(2), growth=1e4, share=1e-6)
    shape = condition.V.P
    (slope,) = torch.autograd.grad(condition(stream(3), COST, COST), shape)
    step = 0.1 * (slope + slope.mT)[0] / slope.abs().max()
    down, up = (inscribed(shape.detach()[0] + sign * step, (2.0, 3.0)) for sign in (-1, 1))
    assert down > inscribed(shape.detach()[0], (2.0, 3.0)) > up


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["horizon.stationary=false", "cost.Q_T=1"], "horizon.stationary: true"),
        (["pointwise.weight=0"], "pointwise.weight > 0"),
        (["program.share=2"], "share in"),
        (["program.growth=-1"], "program.growth"),
    ],
)
def test_what_does_not_suit_a_region_is_refused(overrides, message):
    with pytest.raises(UsageError, match=message):
        build_module(config_from_plain(OWN, overrides))


@pytest.mark.gate
def test_training_for_it_makes_the_region_larger(monkeypatch):
    monkeypatch.setattr("lyapnet.training.start.MAX_OPTIMA", 24)
    shorten_fits(monkeypatch, 200, 100)
    (learner,) = build_module(config_from_plain(OWN | OSCILLATOR, ["pointwise.points=128"])).members
    choose_start([learner])
    condition, optimizer = learner.pointwise, torch.optim.Adam(learner.V.parameters(), 0.003)
    before = float(condition.sampled_share(stream(0)))
    for k in range(200):
        optimizer.zero_grad()
        condition(stream(1, k), COST, COST).backward()
        optimizer.step()
    assert float(condition.sampled_share(stream(0))) > 2 * before
