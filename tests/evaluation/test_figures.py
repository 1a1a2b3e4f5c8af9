"""What is drawn and listed: labels with units, shares that are counted again, pictures that differ when V does."""

import re
from pathlib import Path

import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure

from lyapnet.evaluation import figures
from lyapnet.evaluation.noise_figure import bands, states_to_draw
from lyapnet.evaluation.states import StateTable
from lyapnet.experiment.assembly import build_problem, build_rollout, build_value_function
from lyapnet.experiment.config import load_config
from lyapnet.loop.rollout import Rollout
from lyapnet.task.noise import StateNoise
from lyapnet.task.systems import Linear
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.policy import HJBPolicy
from tests.problems import Quadratic, problem_of

CONF = Path(__file__).parents[2] / "conf"
TASKS = ("double_integrator", "cartpole_swingup", "reacher")
LABELS = {  # of X₀'s slice
    "double_integrator": {"position (m)", "velocity (m/s)"},
    "cartpole_swingup": {"pole angle (rad)"},
    "reacher": {"shoulder angle (rad)", "elbow angle (rad)"},
}


@pytest.fixture(params=TASKS)
def drawing(request):
    """A task with its V and closed loop, on a short horizon."""
    return build(request.param)


def build(name, V=None):
    config = load_config(CONF / "from_scratch" / f"{name}.yaml", ["horizon.steps=6", "network.hidden=[8, 8]"])
    problem = build_problem(config)
    V = V or build_value_function(config, problem)
    return name, problem, V, build_rollout(config, problem, V)


def region(problem, V, rollout, **options):
    return figures.certified_region(rollout, problem, **options)


def drawn(figure):
    """The figure's bytes; matplotlib's warnings, as of a missing glyph, are errors here."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return bytes(canvas.buffer_rgba())


def labels(figure):
    """Every axis label, in one line each."""
    texts = [text for axes in figure.axes for text in (axes.get_xlabel(), axes.get_ylabel())]
    return {text.replace("\n", " ") for text in texts}


def title(figure):
    return " ".join([figure.get_suptitle(), *(axes.get_title() for axes in figure.axes)])


def share_in_title(figure):
    """The first percentage in the title."""
    return float(re.search(r"([\d.]+)\s*%", title(figure))[1]) / 100


def counted_share(problem, V, rollout, states, tolerance=1e-2):
    """The share of states whose summed hinge is at most tolerance · V(0, x₀): state by state, step by step."""
    policy, dt, held = rollout.closed_loop.policy, problem.horizon.dt, 0
    with torch.no_grad():
        for x0 in states:
            x, excess = x0, 0.0
            for step in range(problem.horizon.steps):
                t = torch.tensor(step * dt)
                u = policy(t, x)
                after = x + dt * problem.system.dynamics(x, u)
                excess += max(float(V(t + dt, after) - V(t, x) + dt * problem.cost.running(x, u)), 0.0)
                x = after
            held += excess <= tolerance * float(V(torch.tensor(0.0), x0))
    return held / len(states)


def test_figures_are_drawn_with_units(drawing):
    name, problem, V, rollout = drawing
    with torch.no_grad():
        sample = rollout(problem.initial_states.sample(5))
    paths = figures.trajectories(sample, problem)
    slices = figures.value_slices(V, problem)
    for figure in (region(problem, V, rollout), paths, slices):
        assert isinstance(figure, Figure)
        assert len(set(drawn(figure))) > 10
    for figure in (region(problem, V, rollout), slices):
        assert LABELS[name] <= labels(figure)
    system = problem.system
    states = {f"{name} ({unit})" for name, unit in zip(system.state_names, system.state_units, strict=True)}
    controls = {f"{name} ({unit})" for name, unit in zip(system.control_names, system.control_units, strict=True)}
    assert states | controls | {"time (s)"} <= labels(paths)


def test_slices_of_V_have_a_labelled_scale_each_that_they_fill(drawing):
    _, problem, V, _ = drawing
    figure = figures.value_slices(V, problem)
    filled = [c for axes in figure.axes for c in axes.collections if isinstance(c, QuadContourSet)]
    if not filled:
        assert "V(t, x) (cost)" in labels(figure), "curves over one state share an axis"
        return
    assert len(filled) == 3
    region = figures.widest_slice(problem.initial_states, 61)
    for t, each in zip((0.0, 0.5, 0.95), filled, strict=True):
        with torch.no_grad():
            value = V(torch.tensor(t * problem.horizon.duration).to(region.states), region.states)
        least, most = float(value.min()), float(value.max())
        step = each.levels[1] - each.levels[0]
        assert each.levels[0] <= least < each.levels[0] + 1.01 * step, "no colour is for what does not occur"
        assert each.levels[-1] - 1.01 * step < most <= each.levels[-1]
    assert "V (cost)" in labels(figure)
    assert len(figure.axes) == 6, "three panels, each with its colour bar"


def test_a_stationary_V_is_drawn_once(drawing):
    _, problem, V, _ = drawing
    figure = figures.value_slices(V, problem.in_steps(stationary=True))
    shown = " ".join([title(figure), *labels(figure)])
    assert "V(x)" in shown
    assert "t = " not in shown
    assert "V(t" not in shown


def test_slice_of_initial_states(drawing):
    name, problem, *_ = drawing
    cut = figures.widest_slice(problem.initial_states, 7)
    assert {problem.system.state_labels[i] for i in cut.axes} == LABELS[name]
    assert cut.states.shape == (7 ** len(cut.axes), problem.system.n)
    assert problem.initial_states.contains(cut.states).all()
    others = [i for i in range(problem.system.n) if i not in cut.axes]
    assert torch.equal(cut.states[:, others], problem.initial_states.center[others].expand(len(cut.states), -1))


class Level(ValueFunction):
    """V = base + slope · (1 s − t), whatever the state: no control at all."""

    def __init__(self, base, slope):
        super().__init__()
        self.base, self.slope = base, slope

    def forward(self, t, x):
        return (self.base + self.slope * (1 - t)).expand(x.shape[:-1]) + 0 * x.sum(-1)


@pytest.mark.parametrize("name", ["double_integrator", "cartpole_swingup"])
def test_share_in_the_title_is_the_share_that_is_counted(name, monkeypatch):
    """A V that falls at a rate between the least and the greatest cost holds on a part of the slice."""
    _, problem, V, rollout = build(name, Level(1.0, 4.0) if name == "double_integrator" else None)
    states = figures.widest_slice(problem.initial_states, 9).states
    original = figures.widest_slice
    monkeypatch.setattr(figures, "widest_slice", lambda box, points: original(box, 9))
    share = counted_share(problem, V, rollout, states)
    assert share_in_title(region(problem, V, rollout)) == pytest.approx(share, abs=5.1e-4)
    if name == "double_integrator":
        assert 0.1 < share < 0.9


@pytest.mark.parametrize(("V", "share"), [(Level(-1.0, 0.0), 0), (Level(1.0, 1e6), 1)])
@pytest.mark.parametrize("name", TASKS)
def test_nothing_and_everything_are_told_apart(name, V, share):
    """A negative V satisfies nothing; one that falls faster than any cost accrues, everything."""
    _, problem, V, rollout = build(name, V)
    assert share_in_title(region(problem, V, rollout)) == share


def test_another_value_function_is_another_picture():
    _, problem, V, rollout = build("double_integrator")
    _, _, other, other_rollout = build("double_integrator", Level(1.0, 4.0))
    assert drawn(region(problem, V, rollout)) == drawn(region(problem, V, rollout))
    assert drawn(region(problem, V, rollout)) != drawn(region(problem, other, other_rollout))


def table(cost, value, optimal):
    zero = torch.zeros(len(cost))
    cost, value, optimal = map(torch.tensor, (cost, value, optimal))
    return StateTable(zero[:, None], cost, value, optimal, zero, zero, zero > 0, zero > 0, zero, zero[:, None], zero)


def test_optimality_is_drawn_where_the_optimum_is_known():
    figure = figures.optimality(table([1.1, 2.2, 9.0], [1.2, 1.6, 9.0], [1.0, 2.0, float("nan")]))
    drawn(figure)
    assert labels(figure) == {"optimum J*(x₀) (cost)", "J(x₀), closed loop (cost)", "V(0, x₀) (cost)"}
    assert "2 initial states, 1 without optimum left out" in title(figure)
    assert "1.1000" in title(figure)  # 3.3 / 3
    assert "20.0%" in title(figure)  # (0.2 + 0.4) / 3
    for axes, points in zip(figure.axes, ([1.1, 2.2], [1.2, 1.6]), strict=True):
        line, states = axes.get_lines()
        assert list(line.get_xdata()) == list(line.get_ydata())
        assert states.get_xydata().tolist() == [[1.0, points[0]], [2.0, points[1]]]


def test_of_many_states_the_first_have_a_panel_and_the_others_are_counted():
    states, controls = 30, 15
    system = Linear((-torch.eye(states)).tolist(), torch.eye(states)[:, :controls].tolist())
    problem = problem_of(system, steps=5)
    problem.noise = StateNoise([0.1] * states)
    V = Quadratic(torch.eye(states))
    rollout = Rollout(problem, HJBPolicy(problem, V), gradient="discrete")
    x0 = problem.initial_states.sample(8, torch.Generator().manual_seed(0))
    with torch.no_grad():
        path = rollout(x0)
        noisy = rollout(states_to_draw(x0), problem.noise.draw(5, 0.1, states_to_draw(x0), torch.Generator()))
    for figure in (figures.trajectories(path, problem), bands(noisy, problem)):
        shown = [axes for axes in figure.axes if axes.get_visible()]
        assert len(shown) == 2 * figures.MOST_PANELS + 1
        assert figure.get_suptitle() == "at most 12 of 30 states and of 15 controls"
    few = problem_of(Linear([[0.0]], [[1.0]]), steps=5)
    path = Rollout(few, HJBPolicy(few, Quadratic(torch.eye(1))), gradient="discrete")(torch.ones(2, 1))
    assert figures.trajectories(path, few).get_suptitle() == ""
