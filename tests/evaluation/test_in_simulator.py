"""Closed loops in MuJoCo: as with the model where the plant is the model, and not where it differs."""

import json

import numpy as np
import pytest
import torch
from scipy.linalg import solve_continuous_are

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.base.linear_algebra import apply
from lyapnet.cli import main
from lyapnet.evaluation.in_simulator import read_plant, simulate
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import config_from_plain
from lyapnet.task.models.robots import model_of_mjcf
from tests.task.models.test_robots import arm

pytest.importorskip("adam")
pytest.importorskip("mujoco")
PENDULUM = (
    '<mujoco><option timestep="0.002" integrator="RK4"/><worldbody><body>'
    '<joint name="angle" axis="0 1 0" damping="0.1"/>'
    '<geom size="0.1" pos="0 0 0.5" mass="{mass}" contype="0" conaffinity="0"/></body>{more}</worldbody>'
    '<actuator><motor name="torque" joint="angle"/></actuator></mujoco>'
)


class Quadratic(lyapnet.ValueFunction):
    """V = xᵀPx of the linear-quadratic regulator at the goal, without end."""

    P: torch.Tensor

    def __init__(self, problem):
        super().__init__()
        zero = torch.zeros(2, dtype=torch.float64)
        A = torch.autograd.functional.jacobian(problem.system.f, zero).numpy()
        P = solve_continuous_are(A, problem.system.g(zero).numpy(), np.diag([10, 0.1]), [[0.1]])
        self.register_buffer("P", torch.from_numpy(P))

    def forward(self, t, x):
        return (x * apply(self.P, x)).sum(-1)


@pytest.fixture(scope="module")
def controller():
    model = model_of_mjcf(PENDULUM.format(mass=1, more="").encode())
    units = dict(zip([*model.states, *model.controls], model.units, strict=True))
    system = {
        "name": "mjcf", "equations": model.equations, "states": {name: units[name] for name in model.states},
        "controls": {name: units[name] for name in model.controls}, "angles": model.angles,
    }  # fmt: skip
    task = {
        "experiment": "pendulum",
        "system": system,
        "cost": {"Q": [10, 0.1], "R": 0.1, "Q_T": [10, 0.1]},
        "initial_states": {"lower": [-0.5, -0.5], "upper": [0.5, 0.5]},
        "horizon": {"steps": 60, "dt": 0.02},
    }
    problem = build_problem(config_from_plain(task))
    return lyapnet.Controller(problem, Quadratic(problem), policy=lyapnet.SampledPolicy)


def plant(folder, text):
    path = folder / "plant.xml"
    path.write_text(text, encoding="utf-8")
    return path


def measured(controller, path):
    x0 = controller.initial_states.sample(6, torch.Generator().manual_seed(0))
    return simulate(controller, read_plant(path, controller), x0)


def test_the_model_as_plant_costs_what_the_model_costs(controller, tmp_path):
    loops = measured(controller, plant(tmp_path, PENDULUM.format(mass=1, more="")))
    torch.testing.assert_close(loops.cost, loops.model_cost, rtol=2e-4, atol=1e-6)
    assert loops.summary()["as_good_fraction"] == 1


def test_a_heavier_plant_costs_more(controller, tmp_path):
    summary = measured(controller, plant(tmp_path, PENDULUM.format(mass=2, more=""))).summary()
    assert summary["cost_ratio"] > 1.05


def test_what_mujoco_gives_up_has_no_cost(controller, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its log
    text = PENDULUM.format(mass=1, more="").replace('damping="0.1"', 'damping="0.1" stiffness="-1e9"')
    summary = measured(controller, plant(tmp_path, text)).summary()
    assert summary["finite_fraction"] == summary["as_good_fraction"] == 0


@pytest.mark.parametrize(
    ("text", "part"),
    [
        (PENDULUM.format(mass=1, more="").replace('"angle"', '"hip"'), "got angle"),
        (
            PENDULUM.format(mass=1, more="").replace('name="torque"', 'name="tork"'),
            "got torque; did you mean angle_torque?",
        ),
        ("<a/>", "Expected an MJCF or URDF file"),
    ],
)
def test_a_plant_without_the_names_is_refused(controller, text, part, tmp_path):
    with pytest.raises(UsageError, match="Expected") as error:
        read_plant(plant(tmp_path, text), controller)
    assert part in str(error.value)


@pytest.mark.gate
def test_the_command_on_a_urdf(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.urdf").write_text(arm(effort=50), encoding="utf-8")
    task = {
        "system": {"name": "urdf", "file": "arm.urdf"},
        "cost": {"Q": [10, 1], "R": 0.01, "Q_T": [10, 1]},
        "initial_states": {"lower": [-0.3, 0], "upper": [0.3, 0]},
        "horizon": {"steps": 40},
        "network": {"name": "icnn"},
        "program": {"name": "value"},
        "training": {"iterations": 2},
        "evaluation": {"test_states": 8, "optimum": False, "animate": False},
    }
    (tmp_path / "arm.yaml").write_text(json.dumps(task), encoding="utf-8")
    assert main(["train", "--config", "arm.yaml"]) == 0
    capsys.readouterr()
    checkpoint = "logs/arm/version_0/checkpoints/best.ckpt"
    command = ["evaluate", checkpoint, "--samples", "8", "--no-optimum", "--plant", "arm.urdf"]
    assert main([*command, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["simulator"]
    assert found["cost_ratio"] == pytest.approx(1, abs=0.03)
    assert main(command) == 0
    assert "in MuJoCo on arm.urdf, 8 states" in capsys.readouterr().out
