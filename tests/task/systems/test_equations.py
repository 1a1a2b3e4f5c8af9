"""Systems by equations: what they compute, what is affine in u, what is refused, and that no text is run."""

import copy
import math
import pickle
from pathlib import Path

import pytest
import torch
from torch.testing import assert_close

from lyapnet.base.errors import UsageError
from lyapnet.cli import main
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import config_from_plain, load_config
from lyapnet.task.systems import KinematicBicycle, Pendulum
from lyapnet.task.systems.equations import EquationSystem, defined

PENDULUM = """
inertia = mass*length**2  # kg m²
der(angle) = rate
der(rate) = -g/length*sin(angle) - damping/inertia*rate + torque/inertia
"""
PARAMETERS = {"mass": 2.0, "length": 0.5, "damping": 0.3, "g": 9.81}
TASK = {
    "experiment": "equations",
    "system": {
        "name": "equations",
        "equations": PENDULUM,
        "states": {"angle": "rad", "rate": "rad/s"},
        "controls": {"torque": "N·m"},
        "angles": ["angle"],
        "parameters": PARAMETERS,
    },
    "cost": {"Q": [1, 0.1], "R": 0.1, "Q_T": [1, 0.1]},
    "initial_states": {"lower": [-1, -1], "upper": [1, 1]},
    "horizon": {"steps": 10, "dt": 0.05},
}
X = torch.randn(50, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
U = torch.randn(50, 1, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def system_of(text, states=("x", "y"), controls=("u",), parameters=(), **values):
    return defined(text, dict.fromkeys(states, ""), dict.fromkeys(controls, ""), parameters)(**values)


def rates(text, x, u, **options):
    return system_of(f"{text}\nder(x) = z\nder(y) = 0", **options).dynamics(x, u)[..., 0]


def refusal(text, **options):
    with pytest.raises(UsageError) as error:
        system_of(text, **options)
    message = str(error.value)
    assert message.startswith("Expected ")
    assert len(message.splitlines()) == 1
    return message


@pytest.mark.parametrize(("title", "told", "name"), [
    ("", "Equations", "Equations"), ("pole on a cart", "pole on a cart", "pole_on_a_cart"),
    ("3 links", "3 links", "system_3_links"),
])  # fmt: skip
def test_what_a_system_is_called(title, told, name):
    config = config_from_plain({**TASK, "system": {**TASK["system"], "title": title}})
    problem = build_problem(config)
    assert (problem.system.title, type(problem.system).__name__) == (told, name)
    assert type(pickle.loads(pickle.dumps(problem.system))) is type(problem.system)


def test_a_pendulum_is_the_registered_one():
    system = build_problem(config_from_plain(TASK)).system
    other = Pendulum(mass=2.0, length=0.5, damping=0.3, gravity=9.81).double()
    at = X + torch.tensor([torch.pi, 0.0])  # the registered one counts its angle from upright
    assert isinstance(system, EquationSystem)
    assert system.affine
    assert_close(system.f(at), other.f(X), rtol=1e-12, atol=1e-12)
    assert_close(system.g(at), other.g(X).expand_as(system.g(at)))
    assert_close(system.dynamics(X, U), system.f(X) + system.g(X)[..., 0] * U)
    assert list(system.angles) == [0]
    assert system.state_labels == ["angle (rad)", "rate (rad/s)"]


def test_what_is_not_affine_has_dynamics_alone():
    text = "der(x) = v*cos(h)\nder(y) = v*sin(h)\nder(h) = v*tan(steer)\nder(v) = a"
    system = system_of(text, ("x", "y", "h", "v"), ("a", "steer"))
    other = KinematicBicycle()
    x, u = torch.randn(20, 4), torch.randn(20, 2)
    assert not system.affine
    assert_close(system.dynamics(x, u), other.dynamics(x, u))
    with pytest.raises(UsageError, match="control-affine"):
        system.f(x)


@pytest.mark.parametrize(
    "expression",
    ["u*sin(x) + y", "-(u - x)/y", "u if x > 0 else 2*u", "where(x > y and not y < 0, u, 3)", "(x + u)*2 - u/x**2"],
)
def test_operations_that_are_affine_are_split_exactly(expression):
    system = system_of(f"der(x) = {expression}\nder(y) = x")
    assert system.affine
    assert_close(system.f(X) + system.g(X)[..., 0] * U, system.dynamics(X, U), rtol=1e-14, atol=1e-14)
    with torch.enable_grad():
        u = U.clone().requires_grad_()
        (slope,) = torch.autograd.grad(system.dynamics(X, u)[:, 0].sum(), u)
    assert_close(system.g(X)[:, 0], slope)


@pytest.mark.parametrize("expression", ["u**2", "u*u", "sin(u)", "x/u", "max(u, 0)", "u if u > 0 else -u", "abs(u)"])
def test_operations_that_are_not_affine(expression):
    assert not system_of(f"der(x) = {expression}\nder(y) = x").affine


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        ("z = x**2 + y**-1 - 2*pi", lambda x, y: x**2 + 1 / y - 2 * torch.pi),
        ("z = (x > 0) + (y > 0) + (x > 0)", lambda x, y: 2.0 * (x > 0) + (y > 0)),
        ("z = 3*(x <= y)", lambda x, y: 3.0 * (x <= y)),
        ("z = atan2(x, y) + hypot(x, y)", lambda x, y: torch.atan2(x, y) + torch.hypot(x, y)),
        ("z = min(x, max(y, 0.5))", lambda x, y: torch.minimum(x, y.clamp(min=0.5))),
        ("a = 2\nb = a*3\nz = b", lambda x, y: torch.full_like(x, 6.0)),
        ("z = copysign(3, x) + sign(y)", lambda x, y: torch.copysign(torch.tensor(3.0), x) + torch.sign(y)),
        ("z = sin(1.5)*x + log(2)", lambda x, y: math.sin(1.5) * x + math.log(2)),
        ("z = 1 if not (x > 0 or y > 0) else 0", lambda x, y: (~((x > 0) | (y > 0))).double()),
    ],
)  # fmt: skip
def test_expressions(expression, expected):
    assert_close(rates(expression, X, U), expected(*X.unbind(-1)), rtol=1e-6, atol=1e-6)


def test_each_expression_is_computed_once():
    system = system_of("der(x) = sin(x)*y + sin(x)\nder(y) = sin(x)*y")
    assert sorted(each.operation for each in system.formulas.instructions.values()) == ["*", "+", "sin"]


@pytest.mark.parametrize("again", [copy.deepcopy, lambda system: pickle.loads(pickle.dumps(system))])
def test_copies(again):
    system = build_problem(config_from_plain(TASK)).system
    copied = again(system)
    assert type(copied) is type(system)
    assert_close(copied.dynamics(X, U), system.dynamics(X, U))


@pytest.mark.parametrize("name", ["mass", "g"])  # g is also the name of the input matrix
def test_a_family_over_a_parameter(name):
    ends = [0.5 * PARAMETERS[name], 1.5 * PARAMETERS[name]]
    family = build_problem(config_from_plain({**TASK, "family": {name: ends}})).system
    member = {**TASK["system"], "parameters": {**PARAMETERS, name: ends[1]}}
    alone = build_problem(config_from_plain({**TASK, "system": member})).system
    z = torch.cat([X, torch.full_like(X[:, :1], ends[1])], -1)
    assert_close(family.f(z)[:, :2], alone.f(X))
    assert_close(family.g(z)[:, :2], alone.g(X))


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("der(x) = y", "with der(y) = …"),
        ("der(x) = y\nder(y) = q", "got q"),
        ("der(x) = y\nder(y) = xx", "got xx; did you mean x?"),
        ("der(x) = y\nder(y) = b\nb = x", "got b"),  # used before it is defined
        ("der(x) = y\nder(x) = y\nder(y) = 0", "which is taken"),
        ("x = 3\nder(x) = y\nder(y) = 0", "which is taken"),
        ("der(x) = y\nder(z) = 0\nder(y) = 0", "got der(z)"),
        ("der(x) = y\nder(y) = sinn(x)", "did you mean sin?"),
        ("der(x) = y\nder(y) = sin(x, y)", "sin of 1 numbers"),
        ("der(x) = y\nder(y) = x^2", "write a**b for a power"),
        ("der(x) = y\nder(y)", "got 'der(y)'"),
        ("der(x) = y\nder(y) = x +", "got 'der(y) = x +'"),
        ("der(x) = y\nder(y) = 'x'", "got \"'x'\""),
        ("der(x) = y\nder(y) = x < y < 1", "got 'x < y < 1'"),
        ("der(x) = y\nder(y) = " + "+".join(["x"] * 20_000), "divide it into lines"),
        ("der(x) = y\nder(y) = 1" + "0" * 400, "divide it into lines"),
    ],
)
def test_what_cannot_be_read_is_one_line(text, part):
    assert part in refusal(text)


@pytest.mark.parametrize(
    "attack",
    [
        "__import__('os').system('touch {mark}')", "open('{mark}', 'w')", "x.__class__", "[x for x in (1, 2)]",
        "(lambda: x)()", "exec('1')", "sin.__globals__", "x[0]", "f'{{x}}'", "x := 3", "*x", "**x", "sin(*[x])",
        "sin(x=1)", "1j*x", "True", "None", "..." , "{{x}}", "await x", "(yield x)", "(" * 300 + "x" + ")" * 300,
    ],
)  # fmt: skip
def test_no_text_is_run(attack, tmp_path):
    mark = tmp_path / "mark"
    refusal(f"der(x) = y\nder(y) = {attack.format(mark=mark)}")
    assert not mark.exists()


def test_powers_of_constants_take_no_time():
    assert system_of("der(x) = y\nder(y) = x*9**9**9**9").f(X).shape == (50, 2)


@pytest.mark.parametrize("names", [("sin", "y"), ("x", "x y"), ("1x", "y"), ("pi", "y"), ("der", "y")])
def test_names_that_expressions_cannot_use(names):
    if names == ("x", "x y"):  # spaces become _
        assert system_of("der(x) = x_y\nder(x_y) = 0", names).n == 2
    else:
        refusal(f"der({names[0]}) = y\nder(y) = 0", states=names)


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({"equations": ""}, "write der(STATE) = … for each"),
        ({"name": "casadi", "equations": ""}, "name the model's file"),
        ({"states": {}}, "Expected system.states"),
        ({"controls": {}}, "Expected system.controls"),
        ({"angles": ["angel"]}, "did you mean angle?"),
        ({"parameters": {**PARAMETERS, "mass": "two"}}, "Expected a number for system.parameters.mass"),
        ({"file": "plant.casadi"}, "got both"),
    ],
)
def test_a_config_that_lacks_something(changes, part, tmp_path, capsys):
    import yaml

    path = tmp_path / "task.yaml"
    path.write_text(yaml.safe_dump({**TASK, "system": {**TASK["system"], **changes}}), encoding="utf-8")
    assert main(["check", str(path)]) == 2
    assert part in capsys.readouterr().err


def test_equations_in_yaml_keep_their_lines(tmp_path):
    path = Path(tmp_path / "task.yaml")
    path.write_text(
        "system:\n  name: equations\n  states: {x: m}\n  controls: {u: m/s}\n  equations: |\n    speed = u\n"
        "    der(x) = speed\ncost: {Q: 1, R: 1, Q_T: 1}\ninitial_states: {lower: -1, upper: 1}\nhorizon: {steps: 5}\n",
        encoding="utf-8",
    )
    assert load_config(path).system.equations == "speed = u\nder(x) = speed\n"
