"""Tasks whose system is not affine in its controls: from a config to exports, and what refuses them by name."""

import re

import pytest
import torch

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.controller.controller import Controller
from lyapnet.exchange.export import export
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import config_from_plain
from lyapnet.loop.programs import ValueProgram
from lyapnet.training.task_facts import convexity_facts
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.policy import LookaheadPolicy, SampledPolicy
from tests.problems import problem_of

GLIDER = {
    "experiment": "x", "system": {"name": "glider"}, "controls": {"lower": -0.1, "upper": 0.25},
    "target": {"speed": 12}, "cost": {"Q": [0.05, 5], "R": 20, "Q_T": [0.1, 10]},
    "initial_states": {"lower": [8, -0.6], "upper": [18, 0.6]}, "horizon": {"steps": 20, "dt": 0.05},
}  # fmt: skip


class Bowl(ValueFunction):
    """V = xᵀPx about the steady glide, with a P that couples speed and path angle."""

    def __init__(self, slope: float = 1.0):
        super().__init__()
        self.slope = slope

    def forward(self, t, x):
        speed, angle = x[..., 0] - 12, x[..., 1] + 0.0627212459
        return self.slope * (0.1 * speed**2 + 0.5 * speed * angle + 8 * angle**2)


def controller_of(law=SampledPolicy, **changes):
    return Controller(build_problem(config_from_plain({**GLIDER, **changes})), Bowl(), policy=law)


# What knows them


@pytest.mark.gate
def test_a_target_is_solved_for_and_linearised():
    problem = build_problem(config_from_plain(GLIDER))
    assert problem.system.dynamics(problem.goal, problem.rest).abs().max() < 1e-9
    f, g = problem.system.affine_model(problem.goal, problem.rest)
    u = problem.rest + 1e-4
    expected = problem.system.dynamics(problem.goal, u)
    assert (f + g @ u - expected).abs().max() < 1e-6
    assert (f - expected).abs().max() > 1e-2


@pytest.mark.gate
def test_a_family_has_other_parameters_in_its_dynamics():
    problem = build_problem(config_from_plain({**GLIDER, "family": {"mass": [1.5, 2.5]}, "target": {"speed": 12}}))
    x = problem.initial_states.sample(6, torch.Generator().manual_seed(0))
    for each in x:
        member = lyapnet.SYSTEMS["glider"](mass=float(each[2]))
        u = torch.full((1,), 0.1)
        assert torch.allclose(problem.system.dynamics(each, u)[:2], member.dynamics(each[:2], u))


@pytest.mark.gate
def test_a_record_tells_other_dynamics():
    problem = build_problem(config_from_plain(GLIDER))
    record = problem.record()
    assert "f" not in record
    assert not problem.differences(record)
    for parameter in ("induced", "lift_slope", "mass"):
        other = lyapnet.SYSTEMS["glider"](**{parameter: 1.5 * getattr(problem.system, parameter)}).double()
        assert problem.replaced(system=other).differences(record) == ["ẋ"]


@pytest.mark.gate
@pytest.mark.parametrize("law", [SampledPolicy, LookaheadPolicy])
@pytest.mark.parametrize("form", ["c", "torch"])
def test_the_exported_law_is_that_of_python(law, form, tmp_path):
    """Each export is held against the controller on 10 000 states; it raises where they differ."""
    controller, out = controller_of(law), tmp_path / ("law.pt2" if form == "torch" else "law")
    export(controller, out, form)
    assert out.exists()


# What check says


def found_of(scale):
    """What is found for V times a number."""
    problem, V = build_problem(config_from_plain(GLIDER)), Bowl(scale)
    (fact,) = convexity_facts(problem, V, SampledPolicy(problem, V))
    return problem, V, fact.found


@pytest.mark.gate
def test_check_names_a_state_where_the_hamiltonian_is_not_convex():
    """There it bends downwards indeed; ℓ alone is convex, and says so."""
    problem, V, found = found_of(100.0)
    share, t, x, u = re.search(r"at (\d+)% of .* t = (\S+) s, x = \((.*?)\), u = \((.*?)\)", found).groups()
    assert 0 < int(share) < 100
    x, u = (torch.tensor([float(number) for number in each.split(", ")]) for each in (x, u))
    V_x = V.value_and_state_gradient(torch.tensor(float(t)), x)[1]

    def hamiltonian(u):
        return problem.cost.running(x, u) + (V_x * problem.system.dynamics(x, u)).sum(-1)

    low, middle, high = (hamiltonian(u + side) for side in (-1e-3, 0.0, 1e-3))
    assert low + high < 2 * middle
    assert "is convex in u at 512 states" in found_of(0.0)[2]


def test_nothing_is_said_of_affine_systems():
    problem = problem_of(lyapnet.SYSTEMS["pendulum"]())
    assert not convexity_facts(problem, Bowl(), SampledPolicy(problem, Bowl()))


# What refuses them


@pytest.mark.parametrize("claim", [lyapnet.Funnel(), lyapnet.Region(), lyapnet.Tube(), lyapnet.LowerBound()])
def test_proofs_are_refused_by_name(claim):
    with pytest.raises(UsageError, match=r"Expected a control-affine system for a .* certificate, got Glider; .*"):
        lyapnet.certify(controller_of(), claim)


@pytest.mark.gate
def test_samples_are_not_refused():
    certificate = lyapnet.certify(controller_of(), lyapnet.Sampled(samples=4))
    assert certificate.verdict


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"horizon": {"steps": 20, "dt": 0.05, "stationary": True}, "cost": {"Q": [0.05, 5], "R": 20}},
         "system for horizon.stationary, got Glider; take stationary: false"),
        ({"target": None, "reference": {"points": {"time": [0.0, 1.0, 2.0], "speed": [12.0, 13.0, 12.0]}}},
         "system for a reference, got Glider; take a target"),
        ({"controls": {"name": "ball", "parameters": {"radius": 0.2}}}, "limits of each control.*got ControlBall"),
    ],
)  # fmt: skip
def test_tasks_that_need_f_and_g_are_refused_by_name(changes, expected):
    plain = {key: value for key, value in {**GLIDER, **changes}.items() if value is not None}
    with pytest.raises(UsageError, match=expected):
        build_problem(config_from_plain(plain))


def test_the_twin_in_jax_refuses_it():
    twin = pytest.importorskip("lyapnet.lab.bench.jax_twin", exc_type=ImportError)
    controller = controller_of()
    with pytest.raises(UsageError, match="has no twin in JAX"):
        twin.JaxTwin(controller.problem, controller.V, ValueProgram(trajectory_cost=1))


def test_f_and_g_are_refused_wherever_they_are_asked_for():
    system = lyapnet.SYSTEMS["glider"]()
    for refused in (system.f, system.g):
        with pytest.raises(UsageError, match=r"Expected a control-affine system with f\(x\) and g\(x\), got Glider"):
            refused(torch.ones(2))
