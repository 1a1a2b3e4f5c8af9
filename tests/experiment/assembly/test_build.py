"""From a config to objects: the shipped files against the task sheet, and classes of the user's own."""

import math
import sys

import pytest
import torch
import yaml
from torch.testing import assert_close

from lyapnet.base.contracts import copied
from lyapnet.base.errors import UsageError
from lyapnet.claims.preconditions import over_time
from lyapnet.evaluation.oracles import oracle_of
from lyapnet.experiment.assembly import resolve
from lyapnet.experiment.assembly.named_parts import parts_named, python_expression
from lyapnet.experiment.config import config_from_plain, load_config, to_plain
from lyapnet.loop.programs import LyapunovProgram, RegionProgram, ValueProgram
from lyapnet.prover.bounds import BoundedFunction
from lyapnet.task.sets import Box
from lyapnet.task.systems import (
    SYSTEMS,
    Cartpole,
    ControlAffineSystem,
    DoubleIntegrator,
    PathTracking,
    Pendulum,
    Reacher,
    VanDerPol,
)
from tests.configs import CONF, EXPERIMENTS, HANGAR, PLAIN, SCRATCH, objects
from tests.problems import untrained

# The shipped configs against the task sheet

BALANCING = {"cart_mass": 1, "pole_mass": 0.1, "length": 0.3, "cart_damping": 0.1, "pole_damping": 0.1}
SWINGUP = {"cart_mass": 1, "pole_mass": 1, "length": 1, "cart_damping": 0, "pole_damping": 0.1}
DOUBLE_INTEGRATOR = (DoubleIntegrator, {"mass": 1}, 400, [10, 0.1], [10, 0.1], [0, 0], [1, 0.7])
TASKS = {  # program; system, its parameters, N, Q, Q_T, centre and half-width of X₀
    "double_integrator": (LyapunovProgram, *DOUBLE_INTEGRATOR),
    "double_integrator_certified": (LyapunovProgram, *DOUBLE_INTEGRATOR),
    "double_integrator_value": (ValueProgram, *DOUBLE_INTEGRATOR),
    "cartpole_balancing": (
        LyapunovProgram, Cartpole, BALANCING, 79, [0, 25, 0.5, 0.1], [0, 25, 0.5, 0.1],
        [0, 0, 0, 0], [0.6, 0.6, 0.2, 0.2],
    ),
    "cartpole_balancing_certified": (
        LyapunovProgram, Cartpole, BALANCING, 79, [0, 25, 0.5, 0.1], [0, 25, 0.5, 0.1],
        [0, 0, 0, 0], [0.6, 0.6, 0.2, 0.2],
    ),
    "cartpole_swingup": (
        ValueProgram, Cartpole, SWINGUP, 171, [0, 0, 0, 0], [80, 600, 0.8, 4.5],
        [0, torch.pi, 0, 0], [0, 0.3, 0, 0],
    ),
    "reacher": (
        ValueProgram, Reacher, {"damping": 0.25}, 170, [1, 1, 0, 0], [100, 100, 1, 1],
        [0, 0, 0, 0], [3, 3, 0, 0],
    ),
}  # fmt: skip


OWN = (
    "acrobot",
    "landing",
    "pendulum_swingup",
    "planar_quadrotor",
    "quadrotor",
    "satellite",
    "three_link_arm",
    "quadrotor_transfer",
)  # of four sections, as a user writes them


PENDULUM = {"mass": 0.15, "length": 0.5, "damping": 0.1, "gravity": 9.81}
CIRCLE = {"speed": 2, "length": 1, "radius": 10}
REGIONS = {  # arXiv 2506.01356, table 1 and appendix C.2: system, its parameters, the limit of |u|, D
    "double_integrator": (DoubleIntegrator, {"mass": 1}, 1, [26.4, 9.6]),
    "van_der_pol": (VanDerPol, {"damping": 1}, 1, [4.8, 10.8]),
    "pendulum_strong": (Pendulum, PENDULUM, 6, [20, 100]),
    "path_tracking_wide": (PathTracking, CIRCLE, 0.84, [10, 10]),
    "path_tracking_narrow": (PathTracking, CIRCLE, 0.5, [10, 10]),
    # arXiv 2411.18235, table 2, in Euler steps of 0.05 s:
    "steps_pendulum_strong": (Pendulum, PENDULUM, 6, [12, 12]),
    "steps_path_tracking_wide": (PathTracking, CIRCLE, 0.84, [3, 3]),
    "steps_path_tracking_narrow": (PathTracking, CIRCLE, 0.5, [3, 3]),
}
REFERENCE = ("double_integrator", "cartpole_balancing", "cartpole_swingup", "reacher")  # the paper's four tasks


@pytest.mark.parametrize("name", [*OWN, *REFERENCE, "double_integrator_value"])
def test_configs_of_four_sections_name_nothing_else(name):
    content = yaml.safe_load((CONF / f"{name}.yaml").read_text())
    lyapunov = {"program": {"name": "lyapunov"}} if name in REFERENCE[:2] else {}
    assert {key: content.pop(key) for key in lyapunov} == lyapunov
    assert set(content) == {"system", "cost", "initial_states", "horizon"}


def test_the_limited_pendulum_has_limits_besides():
    content = yaml.safe_load((CONF / "pendulum_limited.yaml").read_text())
    assert set(content) == {"system", "cost", "controls", "initial_states", "horizon"}
    assert objects(load_config(CONF / "pendulum_limited.yaml"))[0].controls.limits == (-8, 8)


@pytest.mark.parametrize("name", REGIONS)
def test_the_regions_are_the_published_tasks(name):
    cls, parameters, limit, reach = REGIONS[name]
    config = load_config(CONF / "regions" / f"{name}.yaml")
    problem, _, program, _ = objects(config)
    assert type(problem.system) is cls
    x, u = torch.randn(9, len(reach)).double(), torch.randn(9, 1).double()
    assert_close(problem.system.dynamics(x, u), cls(**parameters).double().dynamics(x, u))
    assert problem.controls.limits == (-limit, limit)
    assert config.pointwise.region == reach
    assert (config.experiment, type(program)) == (f"{name}_region", RegionProgram)
    if name.startswith("steps_"):
        assert (program.steps, problem.horizon.dt, problem.horizon.method) == (True, 0.05, "euler")
    else:
        assert not program.steps


def test_every_shipped_config_is_a_task_of_the_sheet():
    alone = {"integrator_chain", "pendulum_limited", "pendulum_held", "pendulum_periodic", "obstacle"}
    alone |= {
        "cartpole_family",
        "reacher_family",
        "pendulum_weights",
        "cartpole_weights",
        "bryson_denham",
        "keep_out",
        "pendulum_noise",
    }
    alone |= {"pendulum_noise_certified", "van_der_pol_noise_certified", "pendulum_reach"}
    alone |= {
        "double_integrator_two_sided",
        "cartpole_balancing_two_sided",
        "cartpole_swingup_plants",
        "cartpole_outputs",
        "reacher_circle",
        "rocket",
        "minimum_time",
        "kinematic_bicycle",
        "cartpole_walls",
        "pushing",
        "dragging",
    }
    assert {path.stem for path in EXPERIMENTS if path.parent == CONF} == {*TASKS, *OWN, *alone}
    assert {path.stem for path in (CONF / "regions").glob("*.yaml")} == set(REGIONS)
    assert {path.stem for path in (CONF / "paper").glob("*.yaml")} == set(REFERENCE)
    assert {path.stem for path in SCRATCH.glob("*.yaml")} == {*REFERENCE, "double_integrator_value"}


@pytest.mark.parametrize("name", [*REFERENCE, "double_integrator_value"])
def test_what_begins_from_scratch_is_the_same_task(name):
    ours, scratch = load_config(CONF / f"{name}.yaml"), load_config(SCRATCH / f"{name}.yaml")
    for section in ("system", "cost", "initial_states", "horizon"):
        assert to_plain(scratch)[section] == to_plain(ours)[section]
    assert scratch.program.name == ours.program.name
    assert (scratch.rollout.policy, scratch.experiment) == ("hjb", f"{name}_from_scratch")


@pytest.mark.parametrize("name", REFERENCE)
def test_the_papers_literal_program_has_the_task_of_ours(name):
    """And its loss: the mean sum, without normalisation, margin or a cost term."""
    ours, literal = load_config(CONF / f"{name}.yaml"), load_config(CONF / "paper" / f"{name}.yaml")
    for section in ("system", "cost", "initial_states", "horizon"):
        assert to_plain(literal)[section] == to_plain(ours)[section]
    program = literal.program
    assert program.name == ours.program.name
    assert (program.constraint, program.trajectory_cost, program.normalise) == (1, 0, False)
    assert (literal.training.batch_size, literal.rollout.gradient) == (12, "adjoint")
    assert literal.network.hidden == {"cartpole_balancing": [200, 500], "double_integrator": [64, 64]}.get(
        name, [128, 128]
    )


def test_one_number_stands_for_every_state():
    config = load_config(CONF / "integrator_chain.yaml", ["system.parameters.length=3", "network.state_scale=[2]"])
    problem, V, _, _ = objects(config)
    assert_close(problem.cost.Q, torch.eye(3, dtype=torch.float64))
    assert_close(problem.initial_states.widths, torch.full((3,), 2.0, dtype=torch.float64))
    assert_close(V.inputs.state_scale, torch.full((3,), 2.0, dtype=torch.float64))
    assert_close(problem.system.f(torch.tensor([1.0, 2.0, 3.0])), torch.tensor([2.0, 3.0, 0.0]).double())


@pytest.mark.parametrize(
    ("limits", "lower", "upper"),
    [
        ({"lower": -8, "upper": 8}, [-8, -8], [8, 8]),
        ({"lower": [-8], "upper": [2, None]}, [-8, -8], [2, math.inf]),
        ({"upper": 3.5}, [-math.inf, -math.inf], [3.5, 3.5]),
    ],
)
def test_limits_of_the_controls(limits, lower, upper):
    config = load_config(CONF / "from_scratch" / "reacher.yaml")
    config.controls.lower, config.controls.upper = limits.get("lower"), limits.get("upper")
    controls = objects(config)[0].controls
    assert_close(torch.stack(controls.limits), torch.tensor([lower, upper], dtype=torch.float64))
    again = objects(config_from_plain(to_plain(config)))[0].controls
    assert_close(torch.stack(again.limits), torch.stack(controls.limits))


@pytest.mark.parametrize(
    ("override", "reason"),
    [
        ("controls.lower=[-1,-1,-1]", "controls.lower with 2 entries .*got 3"),
        ("controls.upper=fast", "controls.upper as a number or a list of them, got 'fast'"),
        ("controls={lower: 2, upper: 1}", "lower < upper"),
        ("controls={lower: 1, name: 'mine:Mine'}", "limits or a controls.name, got both"),
    ],
)
def test_limits_that_do_not_fit_are_refused(override, reason):
    config = load_config(CONF / "from_scratch" / "reacher.yaml", [override])
    with pytest.raises(UsageError, match=f"Expected .*{reason}"):
        objects(config)


@pytest.mark.parametrize("name", TASKS)
def test_shipped_config_is_its_task(name):
    config = load_config(CONF / f"{name}.yaml")
    problem, V, program, rollout = objects(config)
    program_class, system_class, parameters, N, Q, Q_T, center, half_width = TASKS[name]
    assert config.experiment == name
    assert type(program) is program_class
    assert type(problem.system) is system_class
    assert (problem.horizon.steps, problem.horizon.dt) == (N, 0.01)
    assert_close(problem.cost.Q, torch.tensor(Q, dtype=torch.float64).diag())
    assert_close(problem.cost.Q_T, torch.tensor(Q_T, dtype=torch.float64).diag())
    assert_close(problem.initial_states.center, torch.tensor(center, dtype=torch.float64))
    assert_close(problem.initial_states.widths, 2 * torch.tensor(half_width, dtype=torch.float64))
    expected, x = system_class(**parameters), torch.randn(8, problem.system.n)
    assert_close(problem.system.f(x), expected.f(x))
    assert_close(problem.system.g(x), expected.g(x))
    assert_close(problem.cost.R(x), expected.inverse_mass(x))
    assert V(torch.tensor(0.0), x).shape == (8,)
    assert config.rollout.policy == ("hjb" if name.endswith("certified") else "sampled")
    assert rollout.method == "euler"


def test_a_number_stands_for_every_state_or_control():
    numbers = objects(load_config(CONF / "reacher.yaml", ["cost={Q: 2, R: 3, Q_T: 4}"]))[0].cost
    lists = objects(load_config(CONF / "reacher.yaml", ["cost={Q: [2, 2, 2, 2], R: [3, 3], Q_T: [4, 4, 4, 4]}"]))[
        0
    ].cost
    assert_close(numbers.Q, lists.Q)
    assert_close(numbers.Q_T, lists.Q_T)
    assert_close(numbers.R_constant, lists.R_constant)
    assert_close(numbers.R_constant, 3 * torch.eye(2, dtype=torch.float64))


@pytest.mark.parametrize(
    ("override", "reason"),
    [
        ("cost.Q=[1,1,1]", r"cost.Q with 4 entries \(.*\), got 3"),
        ("cost.Q_T=[1,1,1]", r"cost.Q_T with 4 entries \(.*\), got 3"),
        ("cost.R=[1,1,1]", r"cost.R with 2 entries \(.*\), got 3"),
        ("cost.R=true", "R as a number, the diagonal's numbers or a list of rows, got True"),
        ("initial_states.lower=[1,1,1]", r"initial_states.lower with 4 entries \(.*\), got 3"),
        ("initial_states.upper=[1,1,1]", r"initial_states.upper with 4 entries \(.*\), got 3"),
    ],
)
def test_lists_that_do_not_fit_are_named(override, reason):
    with pytest.raises(UsageError, match=f"Expected {reason}"):
        objects(load_config(CONF / "reacher.yaml", [override]))


# The user's own classes


@pytest.fixture
def plain():
    return yaml.safe_load(PLAIN)


@pytest.fixture
def own_classes(tmp_path, monkeypatch):
    """A module of the user's in the working directory; its name."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "hangar.py").write_text(HANGAR)
    yield "hangar"
    sys.modules.pop("hangar", None)


@pytest.mark.parametrize(("name", "mass"), [("Balloon", 1), ("Drone", 4), ("Squadron", 4)])
def test_classes_of_the_users_own_are_built(name, mass, own_classes, plain):
    """Also without a constructor, and with one that takes anything."""
    parameters = {"mass": mass} if name != "Balloon" else {}
    plain["system"] = {"name": f"{own_classes}:{name}", "parameters": parameters}
    plain["network"] = {"name": f"{own_classes}:Bowl", "hidden": [6]}
    problem, V, _, rollout = objects(config_from_plain(plain))
    x = torch.randn(3, 2)
    assert problem.system.mass == mass
    assert V.width == 6
    assert_close(rollout.closed_loop.policy(torch.tensor(0.0), x), -x[:, 1:] / mass)  # −½ R⁻¹gᵀV_x with V = ‖x‖²


def test_a_class_in_the_place_of_another_reads_no_settings_of_that(own_classes, plain):
    plain["system"] = {"name": "equations", "equations": "der(a) = 0", "states": {"a": "m"}}
    config = config_from_plain(plain)
    parts = parts_named(config, {"cost": f"{own_classes}:Price", "system": f"{own_classes}:Balloon"})
    assert (type(parts.cost).__name__, type(parts.system).__name__) == ("Price", "Balloon")
    assert config == config_from_plain(plain), "and the config stays as it is"


@pytest.mark.parametrize("name", ["maglev", "json", "maglev:"])
def test_a_module_without_a_class_is_told_from_one_with_it(name):
    with pytest.raises(UsageError, match=rf"got '{name}'; name the class too, as in {name.rstrip(':')}:Class\.$"):
        resolve(name, SYSTEMS, "system.name", ControlAffineSystem)
    with pytest.raises(UsageError, match=r"got 'cartpol'; did you mean cartpole\?$"):
        resolve("cartpol", SYSTEMS, "system.name", ControlAffineSystem)


def test_a_limit_on_one_side_means_the_same_to_the_law_its_bounds_and_the_oracle():
    """u ≥ −0.05 and no more: ∞ is written .inf or null; the law is at the limit on one side, and free on the other."""
    short = ("horizon.steps=8", "horizon.dt=0.2", "network.hidden=[4]", "controls.lower=-0.05")
    one, other = (untrained("double_integrator", *short, f"controls.upper={none}") for none in (".inf", "null"))
    assert_close(torch.stack(one.controls.limits), torch.stack(other.controls.limits))
    x = one.initial_states.sample(200, torch.Generator().manual_seed(0))
    free = untrained("double_integrator", *short[:-1])
    free.V.load_state_dict(one.V.state_dict())
    u, without = one.policy(torch.tensor(0.0), x), free.policy(torch.tensor(0.0), x)
    assert_close(u, without.clamp(min=-0.05))
    assert float(u.max()) > 0.05 > -0.05 == float(u.min())
    domain = over_time(Box(x.amin(0), x.amax(0)), 0.0)
    loop = copied(one.closed_loop)
    law = BoundedFunction(lambda t, x: (loop.policy(t, x),), domain)
    ((low, high),) = law.bounds(*(corner[None] for corner in domain))
    assert -0.2 < float(low) <= -0.05
    assert float(u.max()) <= float(high) < 1
    some = torch.tensor([[0.9, 0.5], [-0.9, -0.5]]).to(x)  # one is pushed to each side
    at_most, least = (oracle_of(each.problem, "euler").solve(some).cost for each in (one, free))
    both = oracle_of(untrained("double_integrator", *short, "controls.upper=0.05").problem, "euler").solve(some).cost
    assert bool((least < at_most + 1e-9).all())
    assert bool((at_most < both + 1e-9).all())
    assert float((both - at_most).max()) > 1e-3 < float((at_most - least).max())


@pytest.mark.parametrize(
    ("override", "reason"),
    [
        ("controls={lower: 1, upper: 1}", "lower < upper, .*belongs into f"),
        ("controls={lower: .inf}", "lower < upper"),
        ("controls={lower: .nan}", "controls.lower as a number"),
        ("constraints={upper: {position: .inf}}", "finite limits"),
        ("constraints={lower: {position: .nan}}", "finite limits"),
        ("constraints={lower: {position: 1}, upper: {position: 1}}", "lower < upper limits"),
        ("constraints={lower: {position: 2}, upper: {position: 1}}", "lower < upper limits"),
        ("constraints={outside: [{center: {position: .inf}, radius: 1}]}", "a finite centre"),
        ("constraints={inside: [{center: {position: 0}, radius: .inf}]}", "a finite centre"),
        ("cost.obstacles=[{center: {position: .inf}, radius: 1, weight: 1}]", "a finite centre"),
        ("cost.obstacles=[{center: {position: 3}, radius: 1, weight: .inf}]", "a finite centre"),
        ("target=[.inf,0]", "target of finite numbers"),
        ("initial_states.upper=[.inf,1]", "finite bounds"),
        ("family={damping: [0, .inf]}", "family"),
    ],
)
def test_bounds_without_meaning_are_refused(override, reason):
    with pytest.raises(UsageError, match=f"Expected .*{reason}"):
        untrained("double_integrator", override)


def test_parts_of_the_users_own_as_python():
    changes = {
        "system": {"name": "hangar:Drone", "parameters": {"mass": 0.5, "names": ["a"]}},
        "network": {"name": "hangar.nets:Small"},
        "program": {"name": "hangar:Program", "constraint": 2, "parameters": {"power": 3}},
    }
    config = config_from_plain({**yaml.safe_load(PLAIN), **changes})
    assert python_expression(config, "system") == "hangar.Drone(mass=0.5, names=['a'])"
    assert python_expression(config, "network") == "hangar.nets.Small"
    assert python_expression(config, "program").startswith("hangar.Program(")
    assert {"constraint=2.0", "power=3)"} <= {*python_expression(config, "program").partition("(")[2].split(", ")}
