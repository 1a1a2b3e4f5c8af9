"""Closed loops in MuJoCo: as with the model where the plant is the model, and not where it differs."""

import json
import re
import subprocess
import sys
from importlib import import_module

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.linalg import solve_continuous_are

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.base.linear_algebra import apply
from lyapnet.cli import main
from lyapnet.evaluation.in_simulator import read_plant, simulate
from lyapnet.evaluation.simulator_movie import SimulatorMovie, renderer_of
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


def test_the_positions_of_the_first_loop_are_kept(controller, tmp_path):
    ball = '<body pos="0 0 9"><freejoint/><geom size="0.1"/></body>'
    x0 = torch.tensor([[0.3, -0.2], [0.1, 0.0]], dtype=torch.float64)
    plants = [read_plant(plant(tmp_path, PENDULUM.format(mass=1, more=more)), controller) for more in ("", ball)]
    alone, beside = (simulate(controller, each, x0).positions for each in plants)
    assert alone.shape == (61, 1)
    assert alone[0, 0] == 0.3
    np.testing.assert_allclose(alone[:, 0], controller.rollout(x0).x[:, 0, 0], atol=0.02)
    assert beside.shape == (61, 8)
    np.testing.assert_allclose(beside[:, 3], 9 - 9.81 * (0.02 * np.arange(61)) ** 2 / 2, atol=1e-2)
    np.testing.assert_allclose(beside[:, 0], alone[:, 0], atol=1e-12)


class Renderer:
    """Draws the height of the first joint as brightness."""

    def __init__(self, *_):
        self.cameras, self.of_inertia = [], False

    def update_scene(self, data, camera, shown):
        self.bright, self.cameras = round(100 * data.qpos[0]), [*self.cameras, camera]
        self.of_inertia = bool(shown.flags[import_module("mujoco").mjtVisFlag.mjVIS_INERTIA])

    def render(self):
        return np.full((4, 6, 3), self.bright, dtype=np.uint8)


@pytest.mark.parametrize("camera", ["", '<camera pos="0 -3 0"/>'])
def test_a_movie_shows_these_positions(controller, camera, tmp_path):
    drawn = read_plant(plant(tmp_path, PENDULUM.format(mass=1, more=camera)), controller)
    positions, renderer = np.linspace(0, 2, 41)[:, None], Renderer()
    movie = SimulatorMovie(drawn, renderer, positions, 2.0, rate=10)
    shown = [int(frame[0, 0, 0]) for frame in movie.frames()]
    assert shown == [round(100 * float(positions[node, 0])) for node in movie.nodes]
    assert (len(shown), shown[0], shown[-1]) == (31, 0, 200), "2 s are shown in 3"
    assert {*renderer.cameras} == {0 if camera else -1}
    assert not renderer.of_inertia
    movie.write(tmp_path / "movie.gif")
    with Image.open(tmp_path / "movie.gif") as written:
        assert written.n_frames > 20


def test_a_plant_without_shapes_is_drawn_by_its_inertias(controller, tmp_path):
    mass = '<inertial pos="0 0 0.5" mass="1" diaginertia="0.1 0.1 0.01"/>'
    drawn = read_plant(plant(tmp_path, re.sub("<geom.*?/>", mass, PENDULUM.format(mass=1, more=""))), controller)
    renderer = Renderer()
    assert [*SimulatorMovie(drawn, renderer, np.zeros((41, 1)), 2.0, rate=10).frames()]
    assert renderer.of_inertia


def test_without_a_library_to_draw_a_line_says_so(controller, tmp_path, monkeypatch):
    drawn = read_plant(plant(tmp_path, PENDULUM.format(mass=1, more="")), controller)

    def missing(*_):
        raise RuntimeError("no EGL\nhere")

    monkeypatch.setattr(drawn.mujoco, "Renderer", missing)
    with pytest.raises(UsageError, match=r"Expected a library .+, got none \(no EGL.+; set MUJOCO_GL=egl"):
        renderer_of(drawn)


@pytest.mark.parametrize(("options", "part"), [
    (["--animation", "a.gif"], "Expected --plant with --animation"),
    (["--animation", "a.png", "--plant", "b.xml"], "Expected a file that ends in .gif or .mp4"),
    (["--animation", "missing/a.gif", "--plant", "b.xml"], "Expected --animation in a folder that exists"),
])  # fmt: skip
def test_an_animation_that_cannot_be_is_refused_before_the_work(options, part, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["evaluate", "zoo:double_integrator", *options]) == 2
    assert part in capsys.readouterr().err


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
    scene = '<geom type="plane" size="2 2 0.1" pos="0 0 -1"/><light pos="0 0 3"/><camera pos="0 -3 0" euler="90 0 0"/>'
    rod = '<joint name="elbow_pitch" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 1" size="0.05" mass="2"/>'
    motor = '<actuator><motor name="elbow_pitch_torque" joint="elbow_pitch"/></actuator>'
    plant(tmp_path, f"<mujoco><worldbody>{scene}<body>{rod}</body></worldbody>{motor}</mujoco>")
    command = [
        "evaluate",
        checkpoint,
        "--samples",
        "2",
        "--no-optimum",
        "--plant",
        "plant.xml",
        "--animation",
        "arm.gif",
    ]
    command = [sys.executable, "-m", "lyapnet", *command]  # in which MuJoCo takes its library anew
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:  # on a machine without one
        assert re.search(
            "error: Expected a library by which MuJoCo draws without a window, got none .+; set", done.stderr
        )
        return
    with Image.open("arm.gif") as frames:
        assert 20 < frames.n_frames <= 61
        assert np.ptp(np.asarray(frames.convert("L")).astype(float)) > 20, "not empty"
