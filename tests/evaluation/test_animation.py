"""Closed loops in motion: shapes at the right place, frames that show them, files that play, refusals."""

import io

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image

from lyapnet.base.errors import UsageError
from lyapnet.base.shapes import Arrow, Disk, Line, Polygon, chain, corners_of, oblique, rectangle
from lyapnet.cli import main
from lyapnet.controller.controller import Controller
from lyapnet.evaluation import movie
from lyapnet.evaluation.animation import Film
from lyapnet.evaluation.scenes import set_stage
from lyapnet.task.systems import (
    SYSTEMS,
    ControlAffineSystem,
    DoubleIntegrator,
    IntegratorChain,
    Pendulum,
    Quadrotor,
    Reacher,
)
from tests.problems import Quadratic, problem_of, untrained

FIXTURE = "tests/fixtures/version_0.1/certified/checkpoints/best.ckpt"
DRAWN = [name for name, cls in SYSTEMS.items() if cls.draw is not ControlAffineSystem.draw]


def film(name="pendulum_swingup", system=None, **options):
    controller = untrained(name, "horizon.steps=6")
    if system is not None:
        controller.problem.system.draw = system
    return Film(
        controller.rollout(controller.initial_states.sample(3)), controller.problem, controller.value, **options
    )


# shapes


def test_most_registered_systems_draw_themselves():
    assert len(DRAWN) == len(SYSTEMS) - 6  # the linear ones and three of other planes


@pytest.mark.parametrize("name", DRAWN)
def test_shapes_are_finite_and_move_with_the_state(name):
    system = SYSTEMS[name]()
    x = np.linspace(0.1, 0.6, system.n)
    first, other = (
        np.concatenate([corners_of(shape) for shape in system.draw(x + shift, np.ones(system.m))]) for shift in (0, 0.3)
    )
    assert np.isfinite(first).all()
    assert first.shape == other.shape
    assert np.abs(first - other).max() > 0.01


def test_the_pendulum_is_upright_at_zero_and_hangs_at_pi():
    system, still = Pendulum(length=2.0), np.zeros(1)
    for angle, place in ((0, (0, 2)), (np.pi, (0, -2)), (np.pi / 2, (2, 0))):
        rod, bob = system.draw(np.array([angle, 0.0]), still)
        assert np.asarray(bob.center) == pytest.approx(place, abs=1e-12)
        assert np.linalg.norm(np.diff(rod.points, axis=0)) == pytest.approx(2)


def test_the_hand_of_the_reacher_moves_as_its_energy_says():
    # a second route to the links: a point mass in the hand, M = JᵀJ, would have det M = (l₁ l₂ sin q₂)²
    def hand(q):
        return np.asarray(Reacher().draw(np.array([*q, 0, 0]), np.zeros(2))[0].points)[-1]

    q, h = np.array([0.3, 1.1]), 1e-6
    J = np.stack([(hand(q + h * e) - hand(q - h * e)) / (2 * h) for e in np.eye(2)], -1)
    assert abs(np.linalg.det(J)) == pytest.approx(0.3 * 0.33 * np.sin(1.1), rel=1e-6)


def test_a_quadrotor_is_pushed_along_its_thrust():
    # f + g u of the velocities, seen obliquely, is along the arrow where gravity is taken away
    system, x = Quadrotor(), np.array([0, 0, 0, 0.4, -0.3, 0.2, *[0.0] * 6])
    arrow = next(shape for shape in system.draw(x, np.array([3.0, 0, 0, 0])) if isinstance(shape, Arrow))
    state, u = torch.tensor(x), torch.tensor([3.0, 0, 0, 0]).double()
    force = system.dynamics(state, u)[6:9] + torch.tensor([0, 0, 9.81]).double()
    seen = oblique(force.numpy()) * 0.3 / 9.81
    assert np.asarray(arrow.head) - arrow.tail == pytest.approx(seen, rel=1e-6)


def test_a_member_of_a_family_is_drawn_with_its_own_length():
    controller = untrained("pendulum_swingup", "family={length: [0.8, 1.2]}")
    z = np.array([0.0, 0.0, 1.2])
    _, bob = controller.system.draw(z, np.zeros(1))
    assert np.asarray(bob.center) == pytest.approx((0, 1.2))


def test_helpers():
    assert chain([1, 1], [0, np.pi / 2]) == pytest.approx(np.array([(0, 0), (1, 0), (1, 1)]))
    assert corners_of(rectangle((1, 2), 4, 2)).tolist() == [[-1, 1], [3, 1], [3, 3], [-1, 3]]
    turned = corners_of(rectangle((0, 0), 2, 0, np.pi / 2))
    assert turned[1] == pytest.approx((0, 1))
    assert corners_of(Disk((1, 1), 2)).tolist() == [[-1, -1], [3, 3]]


def test_a_stage_is_a_square_around_its_points():
    """Of points within 4 m × 1 m: 1.1 times the longer side, about the middle of both."""
    panel = Figure().subplots()
    set_stage(panel, problem_of(DoubleIntegrator()), np.array([[1.0, 7.0], [5.0, 8.0], [2.0, 7.5]]))
    assert panel.get_xlim() == pytest.approx((3 - 2.2, 3 + 2.2))
    assert panel.get_ylim() == pytest.approx((7.5 - 2.2, 7.5 + 2.2))


# films


def test_frames_of_a_pendulum_show_where_it_is():
    shown = film(rate=2, speed=0.04)  # 0.12 s
    frames = list(shown.frames())
    assert len(frames) == len(shown.nodes) == round(shown.t[-1] / 0.04 * 2) + 1
    assert all(frame.shape == frames[0].shape and not any(side % 2 for side in frame.shape[:2]) for frame in frames)
    assert shown.nodes[0] == 0
    assert shown.nodes[-1] == len(shown.t) - 1
    assert any((frames[0] != frame).any() for frame in frames[1:])
    center = shown._shapes(0, 0)[1].center
    column, height = shown._panel.transData.transform(center)
    assert frames[0][frames[0].shape[0] - int(height), int(column)].tolist() == [0, 114, 178]  # BLUE


def test_a_gif_plays():
    shown = film(rate=2, speed=0.04)
    image = Image.open(io.BytesIO(shown.gif()))
    assert image.format == "GIF"
    assert 1 < image.n_frames <= len(shown.nodes)  # equal frames become one, shown longer
    assert image.info["loop"] == 0


def test_level_sets_of_V_where_a_system_draws_nothing():
    P = torch.eye(3).double()
    problem = problem_of(IntegratorChain(3), steps=4)
    V = Quadratic(torch.stack([P, 2 * P, 3 * P, 4 * P, 5 * P]), problem.horizon.dt)
    controller = Controller(problem, V)
    trajectory = controller.rollout(torch.tensor([[1.0, 1, 0], [-1, -1, 0]]).double())
    shown = Film(trajectory, problem, controller.value, rate=2)
    assert shown._panel.get_xlabel() == "x1"
    start, end = (np.concatenate(next(iter(shown._scene(node))).allsegs[2]) for node in (0, 4))
    assert np.abs(end).max() == pytest.approx(np.abs(start).max() / 5**0.5, rel=0.02)  # of V = (1 + n) ‖x‖²


def test_one_state_is_drawn_over_time():
    problem = problem_of(IntegratorChain(1), steps=2)
    controller = Controller(problem, Quadratic(torch.eye(1).double()))
    trajectory = controller.rollout(torch.tensor([[1.0], [-1.0]]).double())
    shown = Film(trajectory, problem, controller.value, rate=2)
    assert shown._panel.get_xlabel() == "time (s)"
    lines = [line.get_xydata() for line in shown._scene(2)][::2]
    assert np.allclose(lines, torch.stack([trajectory.t.expand(2, -1), trajectory.x[..., 0].T], -1))


@pytest.mark.parametrize("seconds", [0.4, 5.0, 40.0])
def test_a_film_lasts_three_to_ten_seconds(seconds):
    controller = untrained("pendulum_swingup", "horizon.steps=4", f"horizon.dt={seconds / 4}")
    x = controller.problem.goal.expand(1, -1)
    shown = Film(controller.rollout(x), controller.problem, controller.value, rate=10)
    assert (len(shown.nodes) - 1) / 10 == pytest.approx(min(max(seconds, 3), 10))
    assert shown.speed == pytest.approx(seconds / min(max(seconds, 3), 10))


@pytest.mark.parametrize("options", [{"rate": 0.0}, {"speed": -1.0}, {"speed": float("nan")}, {"rate": float("inf")}])
def test_rates_are_positive(options):
    with pytest.raises(UsageError, match="> 0"):
        film(**options)


@pytest.mark.parametrize(
    "draw",
    [
        lambda x, u: [Line([(0, 0), (x[7], 0)])],
        lambda x, u: 3,
        lambda x, u: ["rod"],
        lambda x, u: [Disk((float("nan"), 0), 1)],
        lambda x, u: [Polygon([])],
    ],
)
def test_a_draw_that_is_wrong_is_named(draw):
    with pytest.raises(UsageError, match=r"Pendulum\.draw"):
        film(system=draw)


def test_an_mp4_needs_ffmpeg(monkeypatch, tmp_path):
    monkeypatch.setattr(movie.shutil, "which", lambda name: None)
    with pytest.raises(UsageError, match="ffmpeg"):
        film(rate=2).write(tmp_path / "a.mp4")
    assert not list(tmp_path.iterdir())


def test_an_mp4_is_what_ffmpeg_makes_of_the_frames(monkeypatch, tmp_path):
    program = tmp_path / "ffmpeg"  # keeps what it is sent, in the place of one that encodes
    program.write_text('#!/bin/sh\nfor last; do :; done\ncat > "$last"\n')
    program.chmod(0o755)
    monkeypatch.setattr(movie.shutil, "which", lambda name: str(program))
    shown = film(rate=2, speed=0.06)
    shown.write(tmp_path / "a.mp4")
    assert (tmp_path / "a.mp4").stat().st_size == sum(frame.nbytes for frame in shown.frames())
    program.write_text("#!/bin/sh\necho no codec >&2\nexit 3\n")
    with pytest.raises(UsageError, match="no codec"):
        shown.write(tmp_path / "b.mp4")


# the command


def test_the_command_writes_a_gif(tmp_path, capsys, caplog):
    out = tmp_path / "new" / "loops.gif"
    options = ["--out", str(out), "--from", "0.5,-0.2", "--frames-per-second", "2"]
    assert main(["animate", FIXTURE, *options]) == 0
    assert f"wrote {out}" in capsys.readouterr().out
    with Image.open(out) as image:
        assert image.n_frames > 1


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--out", "a.png"], ".gif or .mp4"),
        (["--out", "a.gif", "--from", "0.5;1"], "--from"),
        (["--out", "a.gif", "--from", "0.5"], "shape"),
        (["--out", "a.gif", "--speed", "0"], "speed > 0"),
    ],
)
def test_what_the_command_refuses(options, expected, capsys, caplog):
    assert main(["animate", FIXTURE, *options]) != 0
    error = capsys.readouterr().err
    assert expected in error
    assert len(error.strip().splitlines()) == 1
