"""Regions of V(x) and u(x) made elsewhere: known truths, and whatever must not be certified."""

import json
import logging
import math
import sys

import numpy as np
import pytest
import torch
from torch import nn

from lyapnet.base.errors import UsageError
from lyapnet.claims.region import prove_region
from lyapnet.claims.region_certificate import RegionCertificate
from lyapnet.cli import main
from lyapnet.exchange.importing import controller_of, imported_controller
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.task.sets import Box, ControlBox
from lyapnet.task.systems import DoubleIntegrator, Linear
from tests.claims.planted import cost, riccati
from tests.exchange.importing.models import FLOAT, helper, linear, model_of, quadratic, saved
from tests.marks import sample
from tests.problems import problem_of

pytest.importorskip("onnxruntime")
P = riccati()
K = P[1:]
D = Box([-3.0, -4.0], [3.0, 4.0]).double()
X0 = Box([-0.2, -0.2], [0.2, 0.2]).double()
CONFIG = """
system: {name: double_integrator}
initial_states: {lower: [-0.2, -0.2], upper: [0.2, 0.2]}
"""
LIMITED = CONFIG + "controls: {lower: -1.5, upper: 1.5}\n"


def files(folder, V=None, u=None, config=CONFIG):
    """The config and the two files of a command."""
    (folder / "task.yaml").write_text(config, encoding="utf-8")
    value = saved(quadratic(P) if V is None else V, folder / "V.onnx")
    law = saved(linear(K) if u is None else u, folder / "u.onnx")
    return folder / "task.yaml", value, law


def claimed(controller, boxes=4000, seconds=60.0, states=D):
    budget = Budget(seconds, boxes, chunk=512)
    return prove_region(controller.closed_loop, controller.problem, None, states, budget)


def certified(folder, capsys, *options, V=None, u=None, config=CONFIG):
    """What the command prints as JSON."""
    task, value, law = files(folder, V, u, config)
    capsys.readouterr()
    line = ["certify", "region", str(task), "--value", str(value), "--law", str(law), "--set=-3:3,-4:4", *options]
    assert main([*line, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def refused(folder, capsys, *options, V=None, u=None, config=CONFIG):
    """The one line that the command answers."""
    task, value, law = files(folder, V, u, config)
    capsys.readouterr()
    assert main(["certify", "region", str(task), "--value", str(value), "--law", str(law), *options]) == 2
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1
    return error


@pytest.mark.gate
def test_of_a_linear_law_the_largest_ellipse_is_proved(tmp_path, capsys):
    result = certified(tmp_path, capsys)
    largest = float((D.upper**2 / torch.from_numpy(P).inverse().diagonal()).min())
    assert result["verdict"] == "certified"
    assert largest * (1 - 2e-3) < result["rho"] < largest
    area = math.pi * result["rho"] / math.sqrt(float(torch.from_numpy(P).det()))
    assert 0.98 * area < result["region_volume_proved"] <= area


@pytest.mark.gate
def test_a_constant_beside_V_changes_nothing(tmp_path, capsys):
    (tmp_path / "plain").mkdir()
    plain = certified(tmp_path / "plain", capsys)
    for shift in (5.0, -5.0):
        moved = quadratic(P, [("Add", ["v", "shift"], ["y"], {})], {"shift": shift})
        result = certified(tmp_path, capsys, V=moved)
        assert result["verdict"] == "certified"
        assert result["rho"] == pytest.approx(plain["rho"], rel=1e-6)


@pytest.mark.gate
def test_files_and_functions_from_python_are_one_claim(tmp_path):
    class V(nn.Module):
        def __init__(self):
            super().__init__()
            self.P = nn.Parameter(torch.from_numpy(P))

        def forward(self, x):
            return ((x @ self.P) * x).sum(-1, keepdim=True)

    u = nn.Linear(2, 1, bias=False)
    with torch.no_grad():
        u.weight.copy_(torch.from_numpy(-K))
    about = problem_of(DoubleIntegrator(), cost(), 100, 0.1, X0)
    mine, theirs = claimed(controller_of(about, V(), u)), claimed(imported_controller(*files(tmp_path)))
    assert mine.verdict == theirs.verdict == "certified"
    assert mine.rho == pytest.approx(theirs.rho, rel=1e-9)


def test_a_copy_is_certified_that_later_training_does_not_change():
    u = nn.Linear(2, 1, bias=False)
    V = nn.Bilinear(2, 2, 1)
    about = problem_of(DoubleIntegrator(), cost(), 100, 0.1, X0)

    class Quadratic(nn.Module):
        def __init__(self):
            super().__init__()
            self.form = V

        def forward(self, x):
            return self.form(x, x)

    with torch.no_grad():
        u.weight.copy_(torch.from_numpy(-K))
        V.weight.copy_(torch.from_numpy(P)[None])
    controller = controller_of(about, Quadratic(), u)
    with torch.no_grad():
        u.weight.neg_()
        V.weight.neg_()
    torch.testing.assert_close(controller.policy(0.0, torch.ones(2)), -torch.from_numpy(K).sum().reshape(1))
    assert controller.value(0.0, torch.ones(2)) == pytest.approx(P.sum())


BRAKE = """
import torch
from lyapnet import ControlAffineSystem

class Brake(ControlAffineSystem):
    state_names, state_units = ("position", "velocity"), ("m", "m/s")
    control_names, control_units = ("force",), ("N",)

    def f(self, x):
        return torch.stack([x[..., 1], 0 * x[..., 1]], -1)

    def g(self, x):
        return torch.tensor([[0.0], [1.0]]).to(x).expand(*x.shape[:-1], 2, 1)
"""


@pytest.mark.gate
def test_a_state_that_nothing_depends_on_is_left_out(tmp_path, capsys, monkeypatch):
    """A brake of the user's own: V = v², u = −v, wherever it is."""
    (tmp_path / "brake_of_mine.py").write_text(BRAKE, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    velocity, second = ("Gather", ["x", "second"], ["v"], {"axis": 1}), {"second": np.array([1])}
    V = model_of([velocity, ("Mul", ["v", "v"], ["y"], {})], second)
    u = model_of([velocity, ("Neg", ["v"], ["y"], {})], second)
    try:
        result = certified(tmp_path, capsys, "--system=brake_of_mine:Brake", V=V, u=u)
    finally:
        sys.modules.pop("brake_of_mine", None)
    assert result["verdict"] == "certified"
    assert result["states_left_out"] == ["position"]
    assert result["rho"] == pytest.approx(16.0, rel=1e-6)


@pytest.mark.gate
def test_the_goal_is_that_of_the_config(tmp_path, capsys):
    """V and u about x* = (0.1, 0), where V is not 0."""
    config = CONFIG + "target: [0.1, 0.0]\n"
    goal = {"goal": np.array([[0.1, 0.0]])}
    V = quadratic(P, [("Add", ["v", "shift"], ["y"], {})], {"shift": 3.0, **goal})
    u = linear(K, constants=goal)
    for model in (V, u):
        for node in model.graph.node:
            node.input[:] = ["e" if each == "x" else each for each in node.input]
        model.graph.node.insert(0, helper.make_node("Sub", ["x", "goal"], ["e"]))
    result = certified(tmp_path, capsys, V=V, u=u, config=config)
    assert result["verdict"] == "certified"
    assert result["equilibrium_offset"] < 1e-12
    elsewhere = certified(tmp_path, capsys, "--seconds=30", V=V, u=u)
    assert elsewhere["equilibrium_offset"] >= 0.1, "0 is none"


# What limits do


@pytest.mark.gate
def test_limits_clamp_the_law_and_it_is_said(tmp_path, caplog):
    free = claimed(imported_controller(*files(tmp_path)))
    with caplog.at_level(logging.WARNING):
        controller = imported_controller(*files(tmp_path, config=LIMITED))
    assert "note: u(x) leaves U, as at x = [" in caplog.text
    claim = claimed(controller)
    assert 0 < claim.rho < 0.9 * free.rho, "limits cost something here"
    x = D.sample(1000, torch.Generator().manual_seed(0))
    assert controller.policy(0.0, x).abs().max() == 1.5
    words = RegionCertificate(controller, claim, {"seed": 0}).in_words()
    assert "u(0, x) is u(x) clamped to U" in words
    assert "those of V.onnx (SHA-256 " in words


@pytest.mark.gate
def test_between_limits_the_region_is_what_a_grid_says(tmp_path):
    claim = claimed(imported_controller(*files(tmp_path, config=LIMITED)))
    x = torch.cartesian_prod(*(torch.linspace(-float(side), float(side), 400, dtype=torch.float64) for side in D.upper))
    slope, u = 2 * x @ torch.from_numpy(P), (-x @ torch.from_numpy(K).mT).clamp(-1.5, 1.5)
    fall = slope[:, 0] * x[:, 1] + slope[:, 1] * u[:, 0]
    V = ((x @ torch.from_numpy(P)) * x).sum(-1)
    assert claim.rho <= float(V[(fall >= 0) & (claim.hole < V)].min())


@pytest.mark.gate
def test_a_law_within_its_limits_makes_no_note(tmp_path, caplog):
    saturated = [("Div", ["u", "most"], ["s"], {}), ("Tanh", ["s"], ["z"], {}), ("Mul", ["z", "most"], ["y"], {})]
    with caplog.at_level(logging.WARNING):
        model = linear(K, saturated, {"most": 1.5}, kind=FLOAT)
        controller = imported_controller(*files(tmp_path, u=model, config=LIMITED))
    assert not caplog.text
    assert claimed(controller).verdict == "certified"


# What must not be certified


@pytest.mark.gate
@pytest.mark.parametrize("V", sample([-P, np.diag([1.0, -1.0]), np.diag([1.0, 0.0])], 3))
def test_an_indefinite_V_has_no_region(V, tmp_path, capsys):
    result = certified(tmp_path, capsys, "--seconds=3", V=quadratic(V))
    assert result["verdict"] != "certified"
    assert result["rho"] is None


def test_a_law_that_does_not_stabilise_has_no_region(tmp_path, capsys):
    result = certified(tmp_path, capsys, "--seconds=3", u=linear(-K))
    assert result["verdict"] != "certified"
    assert result["rho"] is None
    assert "does not stabilise the goal" in result["reason"]


def test_V_and_u_swapped_have_no_region(tmp_path, capsys):
    task, value, law = files(tmp_path)
    capsys.readouterr()
    line = ["certify", "region", str(task), "--value", str(law), "--law", str(value), "--set=-3:3,-4:4", "--seconds=3"]
    assert main([*line, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["verdict"] != "certified"
    assert result["rho"] is None


def test_a_law_of_two_numbers_is_refused(tmp_path, capsys):
    error = refused(tmp_path, capsys, u=linear(np.vstack([K, K])))
    assert "Expected u(x) with 1 number for a state, got 2; look whether V and u are swapped" in error
    assert "Expected V(x) with 1 number for a state, got 2" in refused(tmp_path, capsys, V=linear(np.vstack([K, K])))


def test_a_file_of_other_states_is_refused(tmp_path, capsys):
    error = refused(tmp_path, capsys, V=quadratic(np.eye(3)))
    assert "Expected an input of 2 states in 'V.onnx'" in error


def test_numbers_that_are_none_are_refused(tmp_path, capsys):
    error = refused(tmp_path, capsys, V=quadratic(P, [("Mul", ["v", "c"], ["y"], {})], {"c": np.nan}))
    assert "Expected" in error
    assert "nan" in error


JUMP = [("Greater", ["v", "c"], ["t"], {}), ("Where", ["t", "low", "v"], ["y"], {})]


def test_a_V_that_jumps_is_refused(tmp_path, capsys):
    """Downwards at V = 0.05: V̇ < 0 wherever it has a derivative."""
    error = refused(tmp_path, capsys, V=quadratic(P, JUMP, {"c": 0.05, "low": 0.01}))
    assert "Expected a continuous V, got aten." in error


def test_an_operator_without_bounds_is_refused(tmp_path, capsys):
    error = refused(tmp_path, capsys, V=quadratic(P, [("Floor", ["v"], ["y"], {})]))
    assert "Expected operators with a rule for bounds, got aten.floor.default" in error


def test_a_law_that_jumps_at_the_goal_has_no_region(tmp_path, capsys):
    """u = −sign(Kx) reaches the goal or chatters beside it: no contraction."""
    result = certified(tmp_path, capsys, "--seconds=3", u=linear(K, [("Sign", ["u"], ["y"], {})]))
    assert result["verdict"] != "certified"
    assert result["rho"] is None


def bump(name, height, point, side):
    """Nodes and constants that add height · exp(−‖x − point‖²/side²) to a result."""
    nodes = [
        ("Sub", ["x", "at"], ["from"], {}),
        ("ReduceSumSquare", ["from", "axes"], ["square"], {"keepdims": 1}),
        ("Mul", ["square", "narrow"], ["exponent"], {}),
        ("Exp", ["exponent"], ["shape"], {}),
        ("Mul", ["shape", "height"], ["bump"], {}),
        ("Add", [name, "bump"], ["y"], {}),
    ]
    return nodes, {"at": np.array([point]), "axes": np.array([1]), "narrow": -1 / side**2, "height": height}


def planted(kind, seed):
    """(V, u, point): a bump in V, or in u, somewhere in the region, around which V rises along closed loops."""
    generator = np.random.default_rng(seed)
    rho = float((D.upper**2 / torch.from_numpy(P).inverse().diagonal()).min())
    angle, share, side = generator.uniform(0, 2 * np.pi), generator.uniform(0.1, 0.8), 10 ** generator.uniform(-2, -0.5)
    point = np.linalg.solve(np.linalg.cholesky(P).T, [np.cos(angle), np.sin(angle)]) * np.sqrt(share * rho)
    if kind == "V":
        nodes, constants = bump("v", 0.3 * side * np.abs(P @ point).max() * 10, point, side)
        return quadratic(P, nodes, constants), linear(K), point, side
    push = 2 * float(point @ (Q_PLUS @ point)) / (2 * (P @ point)[1])
    nodes, constants = bump("u", push, point, side)
    return quadratic(P), linear(K, nodes, constants), point, side


Q_PLUS = np.diag([10.0, 0.1]) + K.T @ K  # V̇ = −xᵀ(Q + KᵀK)x without a bump


def rise(controller, point, side):
    """The lowest V around the point where V does not fall; infinite where it falls all around."""
    x = torch.tensor(point, dtype=torch.float64) + 3 * side * (2 * torch.rand(20_000, 2, dtype=torch.float64) - 1)
    x.requires_grad_()
    V = controller.V(torch.zeros((), dtype=torch.float64), x)
    (slope,) = torch.autograd.grad(V.sum(), x)
    u = controller.closed_loop.policy(torch.zeros((), dtype=torch.float64), x)
    fall, V = (slope * controller.system.dynamics(x, u)).sum(-1), V.detach()
    return float(V[fall >= 0].min()) if bool((fall >= 0).any()) else math.inf


@pytest.mark.gate
@pytest.mark.parametrize("kind", ["V", "u"])
@pytest.mark.parametrize("seed", sample(range(20), 20))
def test_no_region_is_certified_over_a_planted_bump(kind, seed, tmp_path):
    V, u, point, side = planted(kind, seed)
    controller = imported_controller(*files(tmp_path, V, u))
    lowest = rise(controller, point, side)
    assert lowest < math.inf, "the bump counts"
    claim = claimed(controller, 3000, 20.0)
    assert claim.rho < lowest


@pytest.mark.gate
def test_without_a_bump_it_is_certified(tmp_path):
    """The twin, of height 0."""
    nodes, constants = bump("v", 0.0, [0.5, 0.5], 0.1)
    controller = imported_controller(*files(tmp_path, quadratic(P, nodes, constants)))
    assert rise(controller, [0.5, 0.5], 0.1) == math.inf
    assert claimed(controller).verdict == "certified"


# The command


def test_one_file_alone_is_refused(tmp_path, capsys):
    task, value, _ = files(tmp_path)
    assert main(["certify", "region", str(task), "--value", str(value)]) == 2
    assert "Expected --value and --law, both and without --at, got one" in capsys.readouterr().err


def test_a_config_that_is_none_is_refused(tmp_path, capsys):
    _, value, law = files(tmp_path)
    assert main(["certify", "region", str(value), "--value", str(value), "--law", str(law)]) == 2
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1
    assert "Expected" in error


def test_a_family_is_refused(tmp_path, capsys):
    config = (
        CONFIG.replace("double_integrator", "cartpole").replace("[-0.2, -0.2]", "[-0.2]").replace("[0.2, 0.2]", "[0.2]")
    )
    error = refused(tmp_path, capsys, config=config + "family: {pole_mass: [0.1, 0.2]}\n")
    assert "Expected one system, got a family" in error
    assert "Expected one system, got a family" in family_from_python()


def family_from_python():
    class Still(Linear):
        constants = (1,)

    about = problem_of(Still([[-1.0, 0.0], [0.0, 0.0]], [[1.0], [0.0]]), None, 100, 0.1, Box([-1.0, 0.5], [1.0, 1.0]))
    with pytest.raises(UsageError) as error:
        controller_of(about, nn.Linear(2, 1), nn.Linear(2, 1))
    return str(error.value)


@pytest.mark.gate
def test_the_report_says_what_it_is_about_and_repeats_it(tmp_path, capsys):
    certified(tmp_path, capsys, "--report", str(tmp_path / "report"), config=LIMITED)
    report = json.loads((tmp_path / "report" / "report.json").read_text(encoding="utf-8"))
    assert report["controls"] == {"lower": [-1.5], "upper": [1.5]}
    assert (report["network"]["name"], report["rollout"]["policy"]) == ("V.onnx", "u.onnx")
    for name in ("value", "law"):
        assert f"--{name}={tmp_path}" in report["command"]
    assert "SHA-256" in report["claim"]["words"]
    assert "u(x) clamped to U" in report["certificate"]["origin"]


def test_limits_of_the_problem_are_those_of_the_law():
    about = problem_of(DoubleIntegrator(), cost(), 100, 0.1, X0, ControlBox(-1.0, 1.0))
    controller = controller_of(about, Norm(), nn.Linear(2, 1))
    assert controller.policy(0.0, 100 * torch.ones(2)).abs() == 1


class Norm(nn.Module):
    def forward(self, x):
        return (x**2).sum(-1)


@pytest.mark.gate
def test_a_model_written_for_float32_is_certified(tmp_path):
    controller = imported_controller(*files(tmp_path, quadratic(P, kind=FLOAT), linear(K, kind=FLOAT)))
    assert claimed(controller).verdict == "certified"
