"""Each report of a stranger: what `lyapnet check` says of it, and the least costs that are right."""

import functools
import re
import shutil

import pytest
import torch
from torch.testing import assert_close

from lyapnet.base.errors import UsageError
from lyapnet.evaluation.oracles import oracle_of
from lyapnet.experiment.assembly import parts_of
from lyapnet.experiment.config import load_config
from lyapnet.training.penalty_weight import find_penalty_weight
from lyapnet.training.stage_messages import silent
from tests.cli.test_check_tasks import facts_before_optima
from tests.marks import sample
from tests.reports.run import HERE, task_of
from tests.reports.values import RIGHT
from tests.tasks_without_goal.run import train_and_measure
from tests.tasks_without_goal.tasks import inside, problem_in, replay

pytest.importorskip("casadi")

REFUSED = {
    "usage": r"a weight in R for every control, got none for up, down, .*; write cost\.R=(?P<R>[0-9.e-]+), .* adds at "
    r"most 3\.6 to costs of 531",
    "drag3": r"Drone\.f\(x\) with finite slopes, got nan by x\[2\] at x = \(.*, 0, 0\); write .*lyapnet\.norm\(v\)",
}
# what is said before a start is sought: words of what is found, or None where nothing is to be said
FACTS = {
    "tumour": {"domain": "tumour > 0, where f is defined", "goal": "none: φ is 0, of slope (1, 0)", "modes": None},
    "algae": {"goal": "none: φ is 0, of slope (0, 0, 0, 0, 0, -1)", "modes": None},
    "reach": {"goal": "none: φ is 0, of slope (-1, 0), at the goal (1, 0)", "modes": None},
    "jets": {"modes": "0 (6 times) 1/s", "controllable": "yes"},
    "minimum_time": {"goal": "an equilibrium without control", "step gain": "made to be held for Δt"},
    "distance": {
        "kink": "q and φ have a kink at the goal: training smooths them, √(x² + ε²) − ε with ε = 0.0",
        "controllable": "yes",
        "step gain": "made to be held for Δt",
    },
    "friction": {"jumps": "Block.f(x) jumps by 11.8 where speed = 0 at system.py:"},
    "battery_scalar": {"system": "1 state,", "goal": "(0.9), an equilibrium without control"},
    "boost_rounded": {"goal": "(0.454, 15), an equilibrium at u = (0.339)", "jumps": None},
    "drag2": {"goal": "an equilibrium without control", "modes": "0 (4 times) 1/s", "jumps": None},
    "hopper": {"goal": "(-0.0245, 0), an equilibrium without control", "modes": "0 ± 20i", "jumps": None},
    "sir": {"goal": "none: φ is 0, of slope (0, 100)", "modes": None},
    "fishery": {"goal": "none: φ is 200, of slope (0, -1)", "modes": None},
    "hexa": {"goal": "an equilibrium at u = (2.45, ", "modes": "0 (13 times)", "controllable": "u does not reach 0"},
}
# of J*, by which optima may differ: the states are known to 5e-5, J* to six digits
TOLERANCE = {
    "tumour": 1e-6, "reach": 2e-6, "jets": 2e-6, "minimum_time": 2e-5, "distance": 2e-4, "boost_rounded": 1e-4,
    "drag2": 4e-5, "hopper": 1e-4, "sir": 2e-3, "fishery": 1e-4, "hexa": 2e-4,
}  # fmt: skip
KEPT = 1e-6  # h that is taken for zero
SHARE, SPREAD = 1.005, 0.01  # of J*, and of its spread: what a training may miss


@functools.cache
def solved(name):
    """The problem of a report, and the optimal controls (b, steps, m) from the states of which J* is known."""
    problem = problem_in(HERE / name)
    optima = oracle_of(problem).solve(torch.tensor(list(RIGHT[name])))
    assert not any(optima.reasons)
    return problem, optima.u.transpose(0, 1)


@pytest.mark.gate
@pytest.mark.parametrize("name", sample(TOLERANCE, 6))
def test_optima_are_right(name):
    problem, u = solved(name)
    right, found = torch.tensor(list(RIGHT[name].values())), replay(problem, list(RIGHT[name]), u)
    assert_close(found.J, right, rtol=TOLERANCE[name], atol=0)
    assert bool((found.h <= KEPT).all())
    assert bool(problem.controls.contains(u).all())
    another = right.roll(1)  # the twin: that of another state
    assert not bool(torch.isclose(found.J, another, rtol=TOLERANCE[name], atol=0).any())


@pytest.mark.parametrize("name", sample(TOLERANCE, 6))
def test_other_controls_cost_more(name):
    """The twin: a tenth of the way to the middle of what is allowed."""
    problem, u = solved(name)
    low, high = problem.controls.limits
    found, other = (replay(problem, list(RIGHT[name]), each) for each in (u, 0.9 * u + 0.05 * (low + high)))
    assert bool(((other.J > found.J) | (other.h > KEPT)).all())


def config_of(folder, *overrides):
    return load_config(folder / "task.yaml", list(overrides))


@pytest.mark.parametrize("name", sample(FACTS, 4))
def test_what_is_said_before_training(name):
    with inside(HERE / name):
        config = config_of(HERE / name)
        told = {fact.name: fact for fact in facts_before_optima(config, parts_of(config))}
    for fact, words in FACTS[name].items():
        if words is None:
            assert fact not in told
        else:
            assert words in told[fact].found
    if name == "friction":
        lines = (HERE / name / "system.py").read_text(encoding="utf-8").splitlines()
        (line,) = [number for number, line in enumerate(lines, 1) if "torch.sign" in line]
        assert f"system.py:{line} (" in told["jumps"].found
        assert "torch.tanh" in told["jumps"].advice


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_refused_says_what_to_write(name, tmp_path):
    """And what it says to write is taken."""
    with pytest.raises(UsageError, match=REFUSED[name]) as refused:
        problem_in(HERE / name)
    if name == "usage":
        R = re.search(REFUSED[name], str(refused.value))["R"]
        assert problem_in(HERE / name, f"cost.R={R}").has_goal
        return
    shutil.copy(HERE / name / "task.yaml", tmp_path)
    source, root = (HERE / name / "system.py").read_text(encoding="utf-8"), "torch.sqrt(vx**2 + vy**2)"
    assert root in source
    (tmp_path / "system.py").write_text(source.replace(root, "lyapnet.norm(x[..., 2:])"), encoding="utf-8")
    _, u = solved("drag2")
    found = replay(problem_in(tmp_path), list(RIGHT["drag2"]), u)
    assert_close(found.J, torch.tensor(list(RIGHT["drag2"].values())), rtol=TOLERANCE["drag2"], atol=0)


def test_one_number_is_the_limit_of_every_state():
    number, entries = (problem_in(HERE / "battery_scalar", *each) for each in ([], ["initial_states.lower=[0.1]"]))
    assert number.initial_states.lower.tolist() == entries.initial_states.lower.tolist() == [0.1]
    assert number.initial_states.upper.tolist() == [0.8]


def test_what_an_operating_point_is_rounded_to_is_solved_for():
    problem = problem_in(HERE / "boost_rounded")
    assert problem.goal.tolist() == pytest.approx([0.45412458, 15], rel=1e-8)
    assert problem.rest.tolist() == pytest.approx([0.33938833], rel=1e-8)
    exact = problem_in(HERE / "boost_rounded", "target={voltage: 15}")
    assert exact.goal.tolist() == pytest.approx(problem.goal.tolist(), rel=1e-12)


@pytest.mark.gate
@pytest.mark.parametrize("name", ["reach", "sir"])
def test_a_penalty_keeps_the_constraints(name, monkeypatch):
    monkeypatch.setattr("lyapnet.training.penalty_weight.OPTIMA", 6)
    problem, state = problem_in(HERE / name), list(RIGHT[name])[1:2]
    found = find_penalty_weight(problem.relaxed(), silent)
    assert found.kept == 6
    free = oracle_of(problem.replaced(constraints=None)).solve(torch.tensor(state)).u.transpose(0, 1)
    assert replay(problem, state, free).h > KEPT, "the twin: without constraints they are violated"


@pytest.mark.gate
def test_steps_of_algae_are_too_long():
    """A culture that is fed at a quarter of the rates eats faster than an Euler step of 0.2 days can follow."""
    fine, dt = problem_in(HERE / "algae", "horizon.dt=0.01"), problem_in(HERE / "algae").horizon.dt
    x = torch.tensor(list(RIGHT["algae"]))
    u = (fine.controls.limits[1] / 4).expand(len(x), -1)
    slopes, fastest = torch.func.vmap(torch.func.jacrev(fine.system.dynamics)), 0.0
    for k in range(2000):
        x, _ = fine.step(x, u)
        if not k % 50:
            fastest = max(fastest, float(-torch.linalg.eigvals(slopes(x, u)).real.min()))
    assert dt * fastest > 2
    assert fine.horizon.dt * fastest < 1, "the twin: its own steps are short"


def test_the_readme_names_every_report():
    rows = [line for line in (HERE / "README.md").read_text(encoding="utf-8").splitlines() if line.startswith("| `")]
    folders = sorted(path.parent.name for path in HERE.glob("*/task.yaml"))
    assert sorted(row.split("`")[1] for row in rows) == folders == sorted({*FACTS, *REFUSED})


missed = pytest.mark.xfail(
    reason="costs 1.0061 J* (seed 0, three states); an earlier version 1.0006", raises=AssertionError, strict=True
)


@pytest.mark.nightly
@pytest.mark.parametrize("name", [pytest.param(n, marks=missed) if n == "minimum_time" else n for n in TOLERANCE])
def test_a_training_by_the_default_recipe(name):
    run, found = train_and_measure(task_of(name), seed=0)
    assert not run["status"]
    assert found["ratio"] <= SHARE or found["regret"] <= SPREAD
    assert found["h"] <= 0
    assert found["beyond"] <= KEPT
