"""Pictures of environments: they show where the system is, in the view and in numbers, and nothing is left behind."""

import gc
import itertools
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from matplotlib.artist import Artist

from lyapnet.base.errors import UsageError
from lyapnet.base.shapes import Line, corners_of
from lyapnet.lab.comparison.environments import IDS, Environment
from lyapnet.task.systems import IntegratorChain, Pendulum
from tests.problems import problem_of

BLUE, RED = (0, 114, 178), (213, 94, 0)


def colours_at(environment, frame, place, size=2):
    """The colours around a place of the panel."""
    column, height = environment._picture.panel.transData.transform(place)
    row, column = frame.shape[0] - round(height), round(column)
    return {tuple(c) for c in frame[row - size : row + size + 1, column - size : column + size + 1].reshape(-1, 3)}


def test_a_cartpole_is_drawn_where_it_is():
    environment = Environment("cartpole_swingup", render_mode="rgb_array")
    environment.reset(options={"state": np.array([0.5, 2.0, 0.0, 0.0])})
    tip = (0.5 + np.sin(2.0), np.cos(2.0))  # 1 m from the cart
    frame = environment.render()
    assert frame.dtype == np.uint8
    assert frame.ndim == frame.shape[-1] == 3
    assert BLUE in colours_at(environment, frame, tip)
    assert BLUE not in colours_at(environment, frame, (0.0, 1.0)), "the goal's pole is elsewhere"
    environment.reset(options={"state": np.zeros(4)})
    frame = environment.render()
    assert BLUE in colours_at(environment, frame, (0.0, 1.0))
    assert BLUE not in colours_at(environment, frame, tip)


def test_a_system_without_shapes_shows_its_plane():
    environment = Environment("double_integrator", render_mode="rgb_array")
    x0 = np.array([0.7, -0.4])
    environment.reset(options={"state": x0})
    assert BLUE in colours_at(environment, environment.render(), x0)
    assert environment._picture.panel.get_xlabel() == "position (m)"
    for _ in range(40):
        environment.step(np.array([1.0]))
    frame = environment.render()
    assert BLUE in colours_at(environment, frame, environment.state)
    assert BLUE not in colours_at(environment, frame, [-0.7, 0.6])
    assert RED in colours_at(environment, frame, [0, 0]), "the goal"


def test_one_state_is_shown_over_time():
    environment = Environment(problem_of(IntegratorChain(1), steps=8), 2.0, render_mode="rgb_array")
    environment.reset(options={"state": np.array([0.5])})
    for _ in range(4):
        environment.step(np.array([1.0]))
    frame, dt = environment.render(), environment.problem.horizon.dt
    assert environment._picture.panel.get_xlabel() == "time (s)"
    assert BLUE in colours_at(environment, frame, [4 * dt, environment.state[0]])
    assert BLUE not in colours_at(environment, frame, [7 * dt, environment.state[0]])


def test_the_view_grows_with_what_is_shown_and_begins_anew():
    environment = Environment("cartpole_swingup", render_mode="rgb_array")
    environment.reset(seed=0)
    environment.render()
    first = environment._picture.panel.get_xlim()
    environment.reset(options={"state": np.array([30.0, 3.0, 0.0, 0.0])})
    environment.render()
    shapes = environment.problem.system.draw(environment.state, np.zeros(1))
    assert max(corners_of(shape)[:, 0].max() for shape in shapes) < environment._picture.panel.get_xlim()[1]
    environment.reset(seed=0)
    environment.render()
    assert environment._picture.panel.get_xlim() == first


@pytest.mark.parametrize("mode", ["human", "ansi", "rgb", ""])
def test_an_unknown_mode_is_refused(mode):
    with pytest.raises(UsageError, match="rgb_array") as refused:
        Environment("reacher", render_mode=mode)
    assert len(str(refused.value).splitlines()) == 1


def test_nothing_is_drawn_without_a_mode_or_an_episode():
    silent = gymnasium.make(IDS["reacher"]).unwrapped
    silent.reset(seed=0)
    with pytest.warns(UserWarning, match="rgb_array"):
        assert silent.render() is None
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset"):
        Environment("reacher", render_mode="rgb_array").render()


@pytest.mark.parametrize("dt", [0.01, 0.04, 2.0])
def test_frames_per_second_are_those_of_real_time(dt):
    problem = problem_of(IntegratorChain(2), steps=3, dt=dt)
    assert Environment(problem, 1.0).metadata["render_fps"] == pytest.approx(1 / dt)
    assert Environment.metadata["render_fps"] == 100, "of the class as before"


def test_a_draw_that_is_wrong_is_named():
    problem = problem_of(Pendulum(), steps=3)
    problem.system.draw = lambda x, u: [Line([(0, 0), (x[7], 0)])]
    environment = Environment(problem, 1.0, render_mode="rgb_array")
    with pytest.raises(UsageError, match=r"Pendulum\.draw"):
        environment.reset(seed=0)


def test_pictures_leave_the_episode_as_it_is():
    seen, unseen = (Environment("cartpole_balancing", render_mode=mode) for mode in ("rgb_array", None))
    for environment in (seen, unseen):
        environment.reset(seed=5)
    for action in np.random.default_rng(0).uniform(-1, 1, (5, 1)):
        one, other = seen.step(action), unseen.step(action)
        first, again = seen.render(), seen.render()
        np.testing.assert_array_equal(first, again)
        assert first is not again
        np.testing.assert_array_equal(one[0], other[0])
        assert one[1] == other[1]


@pytest.mark.gate
def test_nothing_is_left_of_past_pictures():
    environment = Environment("cartpole_balancing", render_mode="rgb_array")

    def artists():
        for _ in range(10):
            environment.reset(seed=0)
            environment.step(np.zeros(1))
            environment.render()
        gc.collect()
        return sum(issubclass(type(each), Artist) for each in gc.get_objects())

    assert artists() == artists()
    pyplot = sys.modules.get("matplotlib.pyplot")
    assert pyplot is None or not pyplot.get_fignums()


def test_gymnasium_collects_the_pictures_of_an_episode():
    task = problem_of(IntegratorChain(2), steps=3)
    environment = gymnasium.make("lyapnet/Task-v0", task=task, control_scale=1.0, render_mode="rgb_array_list")
    environment.reset(seed=0)
    while not environment.step(np.zeros(1))[3]:
        pass
    frames = environment.render()
    assert len(frames) == 4
    assert {frame.shape for frame in frames} == {(484, 484, 3)}
    assert not any(np.array_equal(frame, later) for frame, later in itertools.pairwise(frames))


@pytest.mark.gate
def test_an_environment_without_pictures_loads_no_matplotlib():
    program = (
        "import sys; from lyapnet.lab.comparison.environments import Environment; {}; "
        "print('matplotlib' in sys.modules)"
    )
    for made, drawn in (
        ("Environment('reacher')", "False"),
        ("Environment('reacher', render_mode='rgb_array')", "True"),
    ):
        said = subprocess.run([sys.executable, "-c", program.format(made)], capture_output=True, text=True)
        assert said.stdout.strip() == drawn, said.stderr
