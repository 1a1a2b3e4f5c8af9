"""Twelve CasADi models: each is imported as it is, equals CasADi, and is affine where it is known to be."""

import numpy as np
import pytest
import torch

casadi = pytest.importorskip("casadi")

from lyapnet.task.models.reading import LINEAR_SOLVERS, read_model  # noqa: E402
from lyapnet.task.models.systems import casadi_system  # noqa: E402
from tests.task.models.casadi_models import MODELS  # noqa: E402


@pytest.mark.parametrize("name", MODELS)
def test_a_model_equals_casadi(name):
    function, affine, sections = MODELS[name]()
    given = sections.get("system", {})
    parameters = given.get("parameters", {})
    system = casadi_system(function, given.get("states", ()), given.get("controls", ()), **parameters)
    assert system.affine == affine
    box, random = sections["initial_states"], np.random.default_rng(0)
    x = torch.tensor(random.uniform(box["lower"], box["upper"], (50, system.n)))
    limits = (np.broadcast_to(sections["controls"][side], system.m) for side in ("lower", "upper"))
    u = torch.tensor(random.uniform(*limits, (50, system.m)))
    p = [[*parameters.values()]] if parameters else []
    expected = np.array([function(*row, *p).full().ravel() for row in zip(x.numpy(), u.numpy(), strict=True)])
    scale = 1 + np.abs(expected).max(1, keepdims=True)
    assert np.abs((system.dynamics(x, u).numpy() - expected) / scale).max() < 1e-12
    if affine:
        by_parts = system.f(x) + (system.g(x) @ u[..., None])[..., 0]
        assert np.abs((by_parts.numpy() - expected) / scale).max() < 1e-12


@pytest.mark.parametrize("name", LINEAR_SOLVERS)
def test_a_file_may_have_linear_solves(name, tmp_path):
    x, u = casadi.MX.sym("x", 2), casadi.MX.sym("u")
    A = casadi.blockcat([[3, casadi.cos(x[0])], [casadi.cos(x[0]), 2]])
    function = casadi.Function("f", [x, u], [casadi.solve(A, casadi.vertcat(x[1], u), name)], ["x", "u"], ["xdot"])
    function.save(str(tmp_path / "plant.casadi"))
    read = read_model(tmp_path / "plant.casadi", "casadi", {"states": [], "controls": []})
    assert read["equations"] == casadi_system(function).definition.equations
