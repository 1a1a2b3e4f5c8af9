"""CasADi functions as systems: each operation against CasADi, names, what is refused, and that nothing is run."""

import json
import math
import os
import stat
import subprocess
import sys

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.cli import main
from lyapnet.task.models import reading
from lyapnet.task.models.casadi_functions import EXPRESSIONS, model_of_function
from lyapnet.task.models.systems import casadi_system

casadi = pytest.importorskip("casadi")
SX, MX, Function = casadi.SX, casadi.MX, casadi.Function

BY_NAME = {
    "ADD": lambda a, b: a + b, "SUB": lambda a, b: a - b, "MUL": lambda a, b: a * b, "DIV": lambda a, b: a / b,
    "NEG": lambda a, b: -a, "SQ": lambda a, b: a**2, "TWICE": lambda a, b: 2 * a, "INV": lambda a, b: 1 / a,
    "POW": lambda a, b: casadi.fabs(a) ** b, "CONSTPOW": lambda a, b: casadi.fabs(a) ** 2.5, "LT": lambda a, b: a < b,
    "LE": lambda a, b: a <= b, "EQ": lambda a, b: a == b, "NE": lambda a, b: a != b,
    "NOT": lambda a, b: casadi.logic_not(a > 0), "AND": lambda a, b: casadi.logic_and(a > 0, b > 0),
    "OR": lambda a, b: casadi.logic_or(a > 0, b > 0), "IF_ELSE_ZERO": lambda a, b: casadi.if_else(a > b, b, 0),
    "FABS": lambda a, b: casadi.fabs(a), "FMIN": casadi.fmin, "FMAX": casadi.fmax, "ATAN2": casadi.atan2,
    "HYPOT": casadi.hypot, "FMOD": casadi.fmod, "COPYSIGN": casadi.copysign, "REMAINDER": casadi.remainder,
    "SQRT": lambda a, b: casadi.sqrt(casadi.fabs(a)), "LOG": lambda a, b: casadi.log(casadi.fabs(a)),
    "LOG1P": lambda a, b: casadi.log1p(casadi.fabs(a)), "ASIN": lambda a, b: casadi.asin(a / 10),
    "ACOS": lambda a, b: casadi.acos(a / 10), "ATANH": lambda a, b: casadi.atanh(a / 10),
    "ACOSH": lambda a, b: casadi.acosh(1 + casadi.fabs(a)),
    **{name: lambda a, b, name=name: getattr(casadi, name.lower())(a) for name in (
        "SIN", "COS", "TAN", "ATAN", "SINH", "COSH", "TANH", "ASINH", "EXP", "EXPM1", "SIGN", "FLOOR", "CEIL", "ERF",
    )},
}  # fmt: skip
WITHOUT_FUNCTION = {"ASSIGN", "LIFT"}  # operations that CasADi inserts itself


def pendulum(**options):
    x, u, p = SX.sym("x", 2), SX.sym("u"), SX.sym("p", 2)
    rate = casadi.vertcat(x[1], -9.81 / p[1] * casadi.sin(x[0]) + u / (p[0] * p[1] ** 2))
    return Function("pendulum", [x, u, p], [rate], ["x", "u", "p"], ["xdot"], options)


def refusal(function, *arguments, **options):
    with pytest.raises(UsageError) as error:
        casadi_system(function, *arguments, **options)
    message = str(error.value)
    assert message.startswith("Expected ")
    assert len(message.splitlines()) == 1
    return message


def test_every_operation_has_a_case():
    assert set(BY_NAME) | WITHOUT_FUNCTION == set(EXPRESSIONS)


@pytest.mark.parametrize("name", sorted(BY_NAME))
def test_operations_equal_those_of_casadi(name):
    x, u = SX.sym("x", 2), SX.sym("u")
    function = Function("f", [x, u], [casadi.vertcat(BY_NAME[name](x[0], x[1]), u)])
    assert getattr(casadi, f"OP_{name}") in {function.instruction_id(k) for k in range(function.n_instructions())}
    states = np.random.default_rng(0).normal(size=(200, 2)) * 3
    got = casadi_system(function).dynamics(torch.tensor(states), torch.zeros(200, 1, dtype=torch.float64))
    expected = np.array([function(state, 0.0).full().ravel() for state in states])
    assert_close(got.numpy(), expected, rtol=1e-12, atol=1e-13)


def test_a_wrong_operation_is_found(monkeypatch):
    monkeypatch.setitem(EXPRESSIONS, "SIN", "cos({0})")
    assert "report this with the model" in refusal(pendulum(), p_0=1.0, p_1=2.0)


def test_names_and_parameters():
    system = casadi_system(pendulum(), {"angle": "rad", "pole rate": "rad/s"}, ["torque"], ["angle"], p_0=2.0, p_1=0.5)
    assert system.state_labels == ["angle (rad)", "pole rate (rad/s)"]
    assert list(system.control_names) == ["torque"]
    assert system.title == "pendulum"
    assert system.affine
    x = torch.randn(10, 2, dtype=torch.float64)
    assert_close(system.f(x)[:, 1], -9.81 / 0.5 * torch.sin(x[:, 0]))
    assert_close(system.g(x)[:, 1, 0], torch.full((10,), 2.0, dtype=torch.float64))


def test_symbols_name_states_and_parameters():
    angle, rate, torque, mass = (SX.sym(name) for name in ("angle", "rate", "torque", "mass"))
    function = Function("f", [casadi.vertcat(angle, rate), torque, mass], [casadi.vertcat(rate, torque / mass)])
    model = model_of_function(function)
    assert (model.states, model.controls, model.parameters) == (["angle", "rate"], ["torque"], ["mass"])


def test_an_expanded_mx_is_the_same():
    x, u = MX.sym("x", 2), MX.sym("u")
    inner = pendulum()
    outer = Function(
        "outer", [x, u], [inner(x, u, casadi.DM([1.0, 2.0])) + casadi.mtimes(MX.eye(2), x)], ["x", "u"], ["f"]
    )
    system = casadi_system(outer)
    at = torch.randn(5, 2, dtype=torch.float64)
    expected = casadi_system(inner, p_0=1.0, p_1=2.0).f(at) + at
    assert_close(system.f(at), expected)
    assert list(system.state_names) == ["x_0", "x_1"]


def test_inputs_in_any_order_and_time_that_does_not_count():
    t, p, u, x = SX.sym("t"), SX.sym("p"), SX.sym("u"), SX.sym("x")
    function = Function("f", [t, p, u, x], [p * u - x], ["t", "p", "u", "x"], ["ode"])
    system = casadi_system(function, p=3.0)
    assert float(system.dynamics(torch.tensor([1.0]), torch.tensor([2.0]))) == pytest.approx(5.0)


def test_a_derivative_with_structural_zeros():
    x, u = SX.sym("x", 3), SX.sym("u")
    rate = SX(3, 1)
    rate[1] = u
    system = casadi_system(Function("f", [x, u], [rate]))
    assert_close(system.dynamics(torch.ones(3), torch.ones(1)), torch.tensor([0.0, 1.0, 0.0]))


def bad_functions():
    x, u, t = SX.sym("x", 2), SX.sym("u"), SX.sym("t")
    X, U = MX.sym("x", 2), MX.sym("u")
    table = casadi.interpolant("table", "linear", [[0.0, 1.0, 2.0]], [0.0, 1.0, 4.0])
    yield Function("f", [x], [x]), "got inputs i0"
    yield Function("f", [x, u], [x[0]]), "of shape (2, 1)"
    yield Function("f", [x, u], [x, x]), "Expected one result"
    yield Function("f", [x, u], [x * casadi.erfinv(u)]), "OP_ERFINV"
    yield Function("f", [x, u, t], [x * t], ["x", "u", "t"], ["xdot"]), "do not depend on time"
    yield Function("f", [X, U], [casadi.vertcat(table(X[0]), U)]), "OP_CALL"
    yield Function("f", [SX.sym("x", 2, 2), u], [SX(4, 1)]), "dense columns"
    yield Function("f", [x, u], [x + math.inf]), "finite numbers"


@pytest.mark.parametrize("k", range(8))
def test_what_is_no_such_function_is_refused_by_name(k):
    function, part = list(bad_functions())[k]
    assert part in refusal(function)


def test_parameters_have_to_fit():
    assert "none for p_1" in refusal(pendulum(), p_0=1.0)
    assert "did you mean p_0?" in refusal(pendulum(), p_0=1.0, p_1=1.0, p_00=1.0)
    assert "Expected 2 names for x" in refusal(pendulum(), ["angle"], p_0=1.0, p_1=1.0)


def config(folder, **system):
    text = {
        "system": {"name": "casadi", "file": "plant.casadi", "parameters": {"p_0": 1.0, "p_1": 0.5}, **system},
        "cost": {"Q": [1, 0.1], "R": 0.1, "Q_T": [1, 0.1]},
        "initial_states": {"lower": [-1, -1], "upper": [1, 1]},
        "horizon": {"steps": 20, "dt": 0.02},
        "training": {"iterations": 2},
        "evaluation": {"test_states": 8, "optimum": False, "animate": False},
        "program": {"name": "value"},
        "network": {"name": "icnn"},
    }
    path = folder / "task.yaml"
    path.write_text(json.dumps(text), encoding="utf-8")
    return path


@pytest.mark.parametrize("kind", [SX, MX])
def test_the_right_hand_side_of_do_mpc(kind):
    names = ["_x", "_u", "_z", "_tvp", "_p", "_w"]  # of model._rhs_fun
    x, u, z, tvp, p, w = given = [kind.sym(*each) for each in zip(names, (2, 1, 0, 0, 1, 0), strict=True)]
    rate = casadi.vertcat(x[1], u / p - x[0])
    system = casadi_system(Function("rhs_fun", given, [rate], names, ["_rhs"]), _p=2.0)
    assert list(system.state_names) == ["_x_0", "_x_1"]
    assert_close(system.g(torch.zeros(1, 2, dtype=torch.float64))[0, 1, 0].item(), 0.5)
    z = kind.sym("_z", 1)
    said = refusal(Function("rhs_fun", [x, u, z, tvp, p, w], [rate + z], names, ["_rhs"]), _p=2.0)
    assert "algebraic states z; solve for them" in said


@pytest.mark.parametrize("inner", [False, True])
def test_linear_solves_are_written_out(inner):
    x, u = MX.sym("x", 3), MX.sym("u")
    A = casadi.blockcat([[3 + casadi.cos(x[0]), x[1], 0.3], [0.5, 4, casadi.sin(x[2])], [x[0], 0.1, 5]])
    first = casadi.solve(A.T, casadi.vertcat(x[:2], u))
    rate = casadi.inv(A + casadi.diag(first)) @ x + casadi.solve(A, first)
    function = Function("f", [x, u], [rate], ["x", "u"], ["xdot"])
    with pytest.raises(RuntimeError):
        function.expand()  # which CasADi does not do
    if inner:
        function = Function("outer", [x, u], [2 * function(x, u)], ["x", "u"], ["xdot"])
    states, controls = np.random.default_rng(0).normal(size=(50, 3)) / 3, np.linspace(-1, 1, 50)
    got = casadi_system(function).dynamics(torch.tensor(states), torch.tensor(controls)[:, None])
    expected = np.array([function(*each).full().ravel() for each in zip(states, controls, strict=True)])
    assert_close(got.numpy(), expected, rtol=1e-12, atol=1e-13)


def test_accelerations_by_a_linear_solve_are_affine():
    x, u = MX.sym("x", 2), MX.sym("u")
    M = casadi.blockcat([[2, casadi.cos(x[0])], [casadi.cos(x[0]), 1]])
    assert casadi_system(Function("f", [x, u], [casadi.solve(M, casadi.vertcat(u, x[1]))])).affine


def test_a_value_that_is_not_finite_is_compared_no_further():
    x, u = SX.sym("x", 2), SX.sym("u")
    system = casadi_system(Function("f", [x, u], [casadi.sqrt(x) + u]))
    at = torch.tensor([[4.0, 9.0]], dtype=torch.float64)
    assert_close(system.f(at), at.sqrt())


def test_a_wrong_operation_is_found_where_other_entries_are_not_finite(monkeypatch):
    monkeypatch.setitem(EXPRESSIONS, "SIN", "cos({0})")
    x, u = SX.sym("x", 2), SX.sym("u")
    rate = casadi.vertcat(casadi.log(-casadi.fabs(x[0])), casadi.sin(x[1]) + u)
    assert "report this with the model" in refusal(Function("f", [x, u], [rate]))


@pytest.mark.gate
@pytest.mark.parametrize("write", [lambda f, path: f.save(str(path)), lambda f, path: path.write_text(f.serialize())])
def test_a_file_is_trained_and_its_checkpoint_needs_it_no_more(write, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    model = tmp_path / "models"
    model.mkdir()
    write(pendulum(), model / "plant.casadi")
    path = config(model)  # the file is found beside the YAML
    assert main(["train", "--config", str(path)]) == 0
    (model / "plant.casadi").unlink()
    controller = lyapnet.load("logs/task/version_0/checkpoints/best.ckpt")
    x = torch.tensor([[0.3, -0.2]], dtype=torch.float64)
    expected = pendulum()([0.3, -0.2], 0.0, [1.0, 0.5]).full().ravel()
    assert_close(controller.system.f(x)[0].numpy(), expected)


@pytest.mark.gate
@pytest.mark.parametrize(
    ("content", "part"),
    [
        (b"", "Expected a casadi model"),
        (b"\xff\xfe", "Expected a casadi model"),
        (b"jhpnnagiieahaaaadaaa", "Expected a casadi model"),
        (b"a" * 100_000, "Expected a casadi model"),
        (None, "No such file"),
    ],
)
def test_files_that_hold_something_else(content, part, tmp_path, capsys):
    if content is not None:
        (tmp_path / "plant.casadi").write_bytes(content)
    assert main(["check", str(config(tmp_path))]) == 2
    error = capsys.readouterr().err
    assert part in error
    assert "Traceback" not in error


def hostile(kind, folder):
    """A function that runs code when it is read, and the file that shows it."""
    mark = folder / "mark"
    if kind == "library":
        source = (
            f'#include <stdio.h>\n__attribute__((constructor)) void run(void) {{ fclose(fopen("{mark}", "w")); }}\n'
        )
        (folder / "evil.c").write_text(source + "int f(void) { return 0; }\n", encoding="utf-8")
        subprocess.run(["cc", "-shared", "-fPIC", "-o", "evil.so", "evil.c"], cwd=folder, check=True)
        x, u = MX.sym("x"), MX.sym("u")
        function = Function("h", [x, u], [casadi.external("f", str(folder / "evil.so"))(x) + u], ["x", "u"], ["xdot"])
    else:
        compiler = folder / "compiler.sh"
        compiler.write_text(f'#!/bin/sh\ntouch {mark}\nexec cc "$@"\n', encoding="utf-8")
        compiler.chmod(compiler.stat().st_mode | stat.S_IEXEC)
        options = {"jit": True, "compiler": "shell", "jit_options": {"compiler": str(compiler)}}
        x, u = SX.sym("x"), SX.sym("u")
        function = Function("h", [x, u], [x + u], ["x", "u"], ["xdot"], options)
    assert mark.exists()  # it runs when it is made
    mark.unlink()
    return function, mark


@pytest.mark.gate
@pytest.mark.parametrize("kind", ["library", "compiler"])
def test_no_code_of_a_file_is_run(kind, tmp_path):
    make = (
        "import sys; from pathlib import Path; from tests.task.models.test_casadi_functions import hostile\n"
        "folder = Path(sys.argv[2]); function, mark = hostile(sys.argv[1], folder)\n"
        "function.save(str(folder / 'plant')); mark.unlink(missing_ok=True)"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    made = subprocess.run(
        [sys.executable, "-c", make, kind, str(tmp_path)], env=environment, check=False, capture_output=True, text=True
    )
    assert made.returncode == 0, made.stderr
    with pytest.raises(UsageError, match="Expected a casadi model in plant"):
        reading.read_model(tmp_path / "plant", "casadi", {"states": [], "controls": []})
    assert not (tmp_path / "mark").exists()
    read = "import casadi, sys; casadi.Function.load(sys.argv[1])"  # the twin: CasADi itself runs it
    subprocess.run([sys.executable, "-c", read, str(tmp_path / "plant")], check=False, capture_output=True)
    assert (tmp_path / "mark").exists()
