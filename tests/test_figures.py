"""What is drawn and listed: labels with units, shares that are counted again, pictures that differ when V does."""

import re
from pathlib import Path

import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import nn

from lyapnet import figures
from lyapnet.build import build_rollout, build_task, build_value_function
from lyapnet.cli import main
from lyapnet.config import load_config
from lyapnet.evaluation import StateTable
from lyapnet.systems import SYSTEMS

CONF = Path(__file__).parents[1] / "conf"
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
    config = load_config(CONF / f"{name}.yaml", ["horizon.steps=6", "network.hidden=[8, 8]"])
    task = build_task(config)
    V = V or build_value_function(config, task)
    return name, task, V, build_rollout(config, task, V)


def region(task, V, rollout, **options):
    return figures.certified_region(rollout, task.system, task.initial_states, **options)


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


def counted_share(task, V, rollout, states, tolerance=1e-2):
    """The share of states whose summed hinge is at most tolerance · V(0, x₀): state by state, step by step."""
    policy, dt, held = rollout.closed_loop.policy, task.horizon.dt, 0
    with torch.no_grad():
        for x0 in states:
            x, excess = x0, 0.0
            for step in range(task.horizon.steps):
                t = torch.tensor(step * dt)
                u = policy(t, x)
                after = x + dt * task.system.dynamics(x, u)
                excess += max(float(V(t + dt, after) - V(t, x) + dt * task.cost.running(x, u)), 0.0)
                x = after
            held += excess <= tolerance * float(V(torch.tensor(0.0), x0))
    return held / len(states)


def test_figures_are_drawn_with_units(drawing):
    name, task, V, rollout = drawing
    with torch.no_grad():
        sample = rollout(task.initial_states.sample(5))
    paths = figures.trajectories(sample, task.system)
    slices = figures.value_slices(V, task.system, task.initial_states, task.horizon.duration)
    for figure in (region(task, V, rollout), paths, slices):
        assert isinstance(figure, Figure)
        assert len(set(drawn(figure))) > 10
    for figure in (region(task, V, rollout), slices):
        assert LABELS[name] <= labels(figure)
    system = task.system
    states = {f"{name} ({unit})" for name, unit in zip(system.state_names, system.state_units, strict=True)}
    controls = {f"{name} ({unit})" for name, unit in zip(system.control_names, system.control_units, strict=True)}
    assert states | controls | {"time (s)"} <= labels(paths)


def test_slice_of_initial_states(drawing):
    name, task, *_ = drawing
    cut = figures.widest_slice(task.initial_states, 7)
    assert {figures.state_label(task.system, i) for i in cut.axes} == LABELS[name]
    assert cut.states.shape == (7 ** len(cut.axes), task.system.n)
    assert task.initial_states.contains(cut.states).all()
    others = [i for i in range(task.system.n) if i not in cut.axes]
    assert torch.equal(cut.states[:, others], task.initial_states.center[others].expand(len(cut.states), -1))


class Level(nn.Module):
    """V = base + slope · (1 s − t), whatever the state: no control at all."""

    def __init__(self, base, slope):
        super().__init__()
        self.base, self.slope = base, slope

    def forward(self, t, x):
        return (self.base + self.slope * (1 - t)).expand(x.shape[:-1]) + 0 * x.sum(-1)


@pytest.mark.parametrize("name", ["double_integrator", "cartpole_swingup"])
def test_share_in_the_title_is_the_share_that_is_counted(name, monkeypatch):
    """A V that falls at a rate between the least and the greatest cost holds on a part of the slice."""
    _, task, V, rollout = build(name, Level(1.0, 4.0) if name == "double_integrator" else None)
    states = figures.widest_slice(task.initial_states, 9).states
    original = figures.widest_slice
    monkeypatch.setattr(figures, "widest_slice", lambda box, points: original(box, 9))
    share = counted_share(task, V, rollout, states)
    assert share_in_title(region(task, V, rollout)) == pytest.approx(share, abs=5.1e-4)
    if name == "double_integrator":
        assert 0.1 < share < 0.9


@pytest.mark.parametrize(("V", "share"), [(Level(-1.0, 0.0), 0), (Level(1.0, 1e6), 1)])
@pytest.mark.parametrize("name", TASKS)
def test_nothing_and_everything_are_told_apart(name, V, share):
    """A negative V satisfies nothing; one that falls faster than any cost accrues, everything."""
    _, task, V, rollout = build(name, V)
    assert share_in_title(region(task, V, rollout)) == share


def test_another_value_function_is_another_picture():
    _, task, V, rollout = build("double_integrator")
    _, _, other, other_rollout = build("double_integrator", Level(1.0, 4.0))
    assert drawn(region(task, V, rollout)) == drawn(region(task, V, rollout))
    assert drawn(region(task, V, rollout)) != drawn(region(task, other, other_rollout))


def test_systems_command_lists_every_registered_system(capsys, monkeypatch, build_system):
    monkeypatch.setenv("COLUMNS", "300")
    assert main(["systems"]) == 0
    rows = capsys.readouterr().out.splitlines()
    for name in SYSTEMS:
        (row,) = [row for row in rows if re.search(rf"\b{name}\b", row)]
        system = build_system(name)
        if name != "linear":
            for word in (*system.state_names, *system.state_units, *system.control_names, *system.control_units):
                assert word in row


def table(cost, value, optimal):
    zero = torch.zeros(len(cost))
    cost, value, optimal = map(torch.tensor, (cost, value, optimal))
    return StateTable(zero[:, None], cost, value, optimal, zero, zero, zero > 0, zero[:, None])


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
