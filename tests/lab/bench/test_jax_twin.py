"""The benchmark's peer in JAX computes what lyapnet computes; skipped where JAX is not installed."""

from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from torch.testing import assert_close

from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly import build_problem, build_program, build_rollout, build_value_function
from lyapnet.experiment.config import load_config
from lyapnet.loop.programs import Program, ValueProgram
from lyapnet.loop.rollout import Rollout
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.problem import Problem
from lyapnet.task.systems import Cartpole
from lyapnet.value.calculus import ValueFunction

jax = pytest.importorskip("jax")

from lyapnet.lab.bench.jax_twin import JaxTwin, flat  # noqa: E402

CONF = Path(__file__).parents[3] / "conf"
OTHER = {
    "double_integrator": "system.parameters.mass=1.01",
    "double_integrator_value": "system.parameters.mass=1.01",
    "cartpole_swingup": "system.parameters.pole_mass=1.01",
    "reacher": "system.parameters.a2=0.0481",
}
configs = pytest.mark.parametrize("name", OTHER)


def build(name, *changes):
    config = load_config(
        CONF / "from_scratch" / f"{name}.yaml", ["horizon.steps=15", "rollout.gradient=backprop", *changes]
    )
    problem = build_problem(config)
    V = build_value_function(config, problem)
    case = Case(problem, V, build_program(config), build_rollout(config, problem, V))
    return case, problem.initial_states.sample(5, torch.Generator().manual_seed(1))


class Case(NamedTuple):
    problem: Problem
    V: ValueFunction
    program: Program
    rollout: Rollout


def twin_of(case, problem=None, **options):
    return JaxTwin(problem or case.problem, case.V, case.program, **options)


def gradients(name, *changes, problem_changes=(), **options):
    """∂loss/∂θ by the twin, which may be that of another task, and by torch."""
    case, x0 = build(name, *changes)
    loss = case.program(case.rollout(x0)).loss
    expected = torch.cat([g.flatten() for g in torch.autograd.grad(loss, list(case.V.parameters()))])
    problem = build(name, *changes, *problem_changes)[0].problem if problem_changes else None
    _, gradient = twin_of(case, problem, **options).prepare_gradient(x0)()
    return flat(gradient), expected.double()


def error(gradient, expected):
    return float((gradient - expected).norm() / expected.norm())


@configs
def test_gradient_is_that_of_backpropagation(name):
    assert error(*gradients(name)) < 1e-9


def test_checkpointing_the_steps_changes_no_number():
    assert error(*gradients("double_integrator_value", checkpoint=True)) < 1e-9


@configs
def test_twin_of_another_system_has_another_gradient(name):
    assert error(*gradients(name, problem_changes=[OTHER[name]])) > 1e-5


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("double_integrator", ["program.normalise=false", "program.terminal=0", "program.bound=0"]),
        ("double_integrator", ["program.bound=0.5", "program.normalise=false"]),
        ("double_integrator", ["network.terminal=exact", "network.hidden=[5,6,7]", "network.epsilon=0.1"]),
        ("double_integrator", ["network.hidden=[8]", "program.margin=0", "program.constraint=0", "program.bound=0"]),
        ("double_integrator_value", ["program.cost_to_go=3", "program.terminal=1"]),
        ("double_integrator_value", ["program.cost_to_go=3", "program.normalise=false"]),
        ("double_integrator_value", ["network.activation=sin", "program.terminal=2", "cost.R=[[0.3]]"]),
        ("double_integrator_value", ["program.normalise=false", "network.activation=silu", "network.hidden=[5,6,7]"]),
        ("cartpole_balancing", ["system.parameters.cart_damping=0.2"]),
        ("reacher", ["network.embed_angles=true", "network.activation=softplus", "cost.R=[[1,0.2],[0.2,2]]"]),
        (
            "double_integrator_value",
            ["system={name: linear, parameters: {A: [[0.1, 1], [0.5, -0.3]], B: [[0, 1], [1, 0.3]]}}", "cost.R=[1, 2]"],
        ),
    ],
)
def test_options_are_translated(name, changes):
    assert error(*gradients(name, *changes)) < 1e-9


@configs
def test_rollout_is_the_same_trajectory(name):
    case, x0 = build(name)
    path, expected = twin_of(case).prepare_rollout(x0)(), case.rollout(x0)
    for field in ("x", "u", "running_cost", "terminal_cost"):
        assert_close(torch.tensor(getattr(path, field)), getattr(expected, field).detach(), rtol=1e-10, atol=1e-12)
    values = case.V(expected.t[:, None], expected.x).detach()
    assert_close(torch.tensor(path.value), values, rtol=1e-10, atol=1e-12)


def test_float32_stays_float32_and_float64_is_switched_on_for_the_twin_alone():
    assert 1e-12 < error(*gradients("double_integrator_value", "training.precision=float32")) < 1e-3
    case, x0 = build("double_integrator_value")
    loss, _ = twin_of(case).prepare_gradient(x0)()
    assert loss.dtype == "float64"
    assert jax.numpy.zeros(1).dtype == "float32"


class Own(Cartpole):
    pass


class OwnProgram(ValueProgram):
    pass


def test_what_has_no_translation_is_refused():
    case, _ = build("cartpole_swingup")
    problem, V, program = case.problem, case.V, case.program
    JaxTwin(problem, V, program)
    icnn = build("cartpole_swingup", "network.name=icnn", "network.embed_angles=false")[0].V
    cost = QuadraticCost(problem.cost.Q, lambda x: torch.ones(*x.shape[:-1], 1, 1), problem.cost.Q_T)
    linear = build("double_integrator")[0].problem
    inverse_mass = QuadraticCost(linear.cost.Q, linear.system.inverse_mass, linear.cost.Q_T)
    for pieces, what in (
        ((problem.replaced(system=Own()), V, program), "Own"),
        ((problem, icnn, program), "ICNN"),
        ((problem, V, OwnProgram()), "OwnProgram"),
        ((problem.replaced(cost=cost), V, program), "inverse mass"),
        ((linear.replaced(cost=inverse_mass), V, program), "inverse mass"),  # BᵀM⁻¹B is read off g: mechanical alone
    ):
        with pytest.raises(UsageError, match=what):
            JaxTwin(*pieces)
