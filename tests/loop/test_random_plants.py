"""Closed loops on plants whose parameters the law is not told, against loops written by hand; and what must fail."""

import pytest
import torch
from torch.testing import assert_close

from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly import build_plants, build_problem, build_rollout, build_value_function
from lyapnet.experiment.config import config_from_plain
from lyapnet.loop.programs import ValueProgram
from lyapnet.loop.random_plants import ON_MODEL, RandomPlants
from lyapnet.loop.rollout import Rollout
from lyapnet.task.family import FamilySystem
from lyapnet.task.systems import Pendulum, Quadrotor
from lyapnet.training.build import build_module

TASK = {
    "experiment": "plants",
    "system": {"name": "pendulum"},
    "cost": {"Q": [1, 0.1], "R": 0.1, "Q_T": [2, 1]},
    "initial_states": {"lower": -1, "upper": 1},
    "horizon": {"steps": 20, "dt": 0.05},
    "randomise": {"length": [0.7, 1.3], "mass": [0.8, 1.2]},
}


def config(**changes):
    return config_from_plain({**TASK, **changes})


def plants_of(**changes) -> tuple[Rollout, RandomPlants]:
    """The closed loop with the model, and on random plants, of an untrained V."""
    own = config(**changes)
    problem = build_problem(own)
    torch.manual_seed(0)
    rollout = build_rollout(own, problem, build_value_function(own, problem))
    plants = build_plants(own, rollout)
    assert plants is not None
    return rollout, plants


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def by_hand(rollout: Rollout, z0: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The Euler steps of each closed loop, one pendulum at a time, and its cost."""
    problem, law, paths, costs = rollout.problem, rollout.closed_loop.policy, [], []
    dt = problem.horizon.dt
    for row in z0:
        system, x, J = Pendulum(length=float(row[2]), mass=float(row[3])).to(z0), row[:2], 0.0
        path = [x]
        for t in problem.horizon.times(z0)[:-1]:
            u = law(t, x[None])[0]
            J = J + dt * (x**2 @ torch.tensor([1.0, 0.1]).to(x) + 0.1 * u @ u)
            x = x + dt * system.dynamics(x[None], u[None])[0]
            path.append(x)
        paths.append(torch.stack(path))
        costs.append(J + x**2 @ torch.tensor([2.0, 1.0]).to(x))
    return torch.stack(paths, 1), torch.stack(costs)


def test_each_closed_loop_is_that_of_its_plant_under_the_law_of_the_model():
    rollout, plants = plants_of()
    z0 = plants.draw(rollout.problem.initial_states.sample(5, seeded()), seeded(1))
    with torch.no_grad():
        found, model = plants(z0), rollout(z0[:, :2])
        x, J = by_hand(rollout, z0)
    assert_close(found.x, x)
    assert_close(found.cost, J)
    assert found.value is not None
    t = rollout.problem.horizon.times(z0)
    assert_close(found.value[3], rollout.closed_loop.V(t[3], x[3]))
    assert (found.cost - model.cost).abs().max() > 1e-3, "the plants differ from the model"


@pytest.mark.gate
def test_the_gradient_is_that_of_autograd_through_the_steps_by_hand():
    rollout, plants = plants_of()
    theta = [p for p in rollout.closed_loop.V.parameters() if p.requires_grad]
    z0 = plants.draw(rollout.problem.initial_states.sample(4, seeded()), seeded(1))
    found, expected, model = (
        torch.cat([g.flatten() for g in torch.autograd.grad(J.mean(), theta, allow_unused=True) if g is not None])
        for J in (plants(z0).cost, by_hand(rollout, z0)[1], rollout(z0[:, :2]).cost)
    )
    assert_close(found, expected, rtol=1e-10, atol=1e-10)
    assert (model - expected).norm() > 1e-3 * expected.norm()


def test_plants_that_equal_the_model_are_the_model():
    rollout, plants = plants_of(randomise={"length": [1.0, 1.0]})
    x0 = rollout.problem.initial_states.sample(6, seeded())
    with torch.no_grad():
        same, model = plants(plants.draw(x0, seeded())), rollout(x0)
    for one, other in zip(same, model, strict=True):
        assert_close(one, other)


def test_parameters_are_drawn_in_their_ranges_and_again_by_the_same_seed():
    _, plants = plants_of()
    x0 = torch.zeros(500, 2, dtype=torch.float64)
    first, again, other = (plants.draw(x0, seeded(seed))[:, 2:] for seed in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    low, high = torch.tensor([0.7, 0.8]), torch.tensor([1.3, 1.2])
    assert ((first >= low) & (first <= high)).all()
    assert (first.amin(0) < low + 0.02).all()
    assert (first.amax(0) > high - 0.02).all()


def test_the_weights_of_a_run_are_kept_once():
    with_plants, without = (
        build_module(config(randomise=given)).state_dict().keys() for given in (TASK["randomise"], {})
    )
    assert with_plants == without


@pytest.mark.gate
def test_single_precision_and_constraints_and_limits_have_plants_too():
    for changes in (
        {"training": {"precision": "float32"}},
        {"constraints": {"upper": {"velocity": 3.0}}},
        {"controls": {"lower": -5, "upper": 5}},
    ):
        rollout, plants = plants_of(**changes)
        x0 = rollout.problem.initial_states.sample(3, seeded()).to(rollout.problem.goal)
        assert plants(plants.draw(x0, seeded())).cost.isfinite().all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"randomise": {"wind": [0, 1]}}, "Expected parameters of randomise among the numbers that Pendulum keeps"),
        ({"randomise": {"length": [1.2, 0.8]}}, r"Expected randomise.length as \[least, greatest\]"),
        ({"randomise": {"length": [1.0]}}, r"Expected randomise.length as \[least, greatest\]"),
        ({"family": {"length": [0.8, 1.2]}}, "Expected randomise without family, got both"),
        ({"noise": {"velocity": 0.1}, "rollout": {"gradient": "discrete"}}, "Expected randomise without noise"),
        ({"cost": {"Q": 1, "R": 1}, "horizon": {"steps": 9, "dt": 0.1, "stationary": True}}, "stationary: false"),
    ],
)
def test_what_can_have_no_plants_is_refused_by_name(changes, message):
    with pytest.raises(UsageError, match=message):
        plants_of(**changes)


def test_every_number_of_the_quadrotor_can_be_drawn():
    """f and g of a batch of plants are those of quadrotors built one by one."""
    system = FamilySystem(Quadrotor(), ["mass", "gravity", "carried"], ["", "", ""])
    z = torch.cat([torch.randn(5, 12, generator=seeded()), 1 + torch.rand(5, 3, generator=seeded(1))], -1).double()
    for row in z:
        mass, gravity, carried = row[12:].tolist()
        alone = Quadrotor(mass, gravity, carried)
        assert_close(system.f(z[None])[0, :, :12][z.eq(row).all(-1)][0], alone.f(row[:12]))
        assert_close(system.g(z)[z.eq(row).all(-1)][0, :12], alone.g(row[:12]))


def test_a_training_batch_is_half_on_the_model_and_half_on_plants():
    learner = build_module(config()).members[0]
    x0 = learner.problem.initial_states.sample(6, seeded())
    z0 = learner.with_plants(x0, 1)
    assert_close(z0[::2, 2:], torch.ones(3, 2, dtype=z0.dtype))
    assert (z0[1::2, 2:] != 1).all()
    with torch.no_grad():
        loops, model = learner.roll_out(x0, 1), learner.rollout(x0)
    assert_close(loops.cost[::2], model.cost[::2])
    assert (loops.cost[1::2] != model.cost[1::2]).all()


@pytest.mark.parametrize("normalise", [True, False])
def test_v_is_fitted_on_the_model_and_the_cost_is_that_of_all(normalise):
    """V's error counts on the model alone, as in a program on these loops; the cost on all of them."""
    rollout, plants = plants_of()
    z0 = plants.draw_beside_model(rollout.problem.initial_states.sample(6, seeded()), seeded(1))
    with torch.no_grad():
        loops, model = plants(z0), rollout(z0[::2, :2])
    program = ValueProgram(constraint=0.0, cost_to_go=1.0, trajectory_cost=1.0, normalise=normalise)
    terms, own, all_alike = (
        program(loops, on_model=ON_MODEL).terms, program(model).terms, program(loops).terms
    )  # fmt: skip
    unit = (model.cost.mean() / loops.cost.mean()) ** 2 if normalise else 1.0  # J̄² of the batch
    assert_close(terms["cost_to_go"], own["cost_to_go"] * unit)
    assert_close(terms["trajectory_cost"], all_alike["trajectory_cost"])
    assert (all_alike["cost_to_go"] - terms["cost_to_go"]).abs() > 1e-3 * terms["cost_to_go"]
