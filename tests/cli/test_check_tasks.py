"""lyapnet check on every config and on tasks of other kinds: what it says before the first optimum is sought."""

import contextlib
import json
import math
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.cli import main
from lyapnet.experiment.assembly import Parts, build_problem, parts_of
from lyapnet.experiment.config import config_from_plain, load_config
from lyapnet.training.build_learner import build_learner, build_problem_to_train
from lyapnet.training.task_facts import facts_of, unreached_modes
from tests.fits import shorten_fits
from tests.marks import sample

CONF = Path(__file__).parents[2] / "conf"


class EnoughError(Exception):
    """Ends what seeks a start."""


def facts_before_optima(config, parts=None):
    """The facts that are told before anything is sought."""
    told = []

    def stop(stage, *counts):
        raise EnoughError(stage)

    parts = parts_of(config) if parts is None else parts
    learner = build_learner(config, build_problem_to_train(config, parts), parts)
    try:
        facts_of(learner, stop, told.append)
    except EnoughError:
        assert told[-1].name in ("goal", "step gain", "reference")
    return told


@pytest.mark.parametrize("path", sample(sorted(CONF.rglob("*.yaml")), 4), ids=lambda path: str(path.relative_to(CONF)))
def test_every_config(path):
    try:
        config = load_config(path)
    except UsageError:
        assert path.name.startswith("compare"), "the config of a comparison names others"
        return
    config.seeds = 1
    names = [fact.name for fact in facts_before_optima(config)]
    if config.reference.points:
        assert names == ["system", "reference"], "the goal moves"
        return
    noise = ["noise"] if config.noise else []
    assert names[: 4 + len(noise)] == ["system", *noise, "goal", "modes", "controllable"]
    assert "step gain" in names


class Own(lyapnet.ControlAffineSystem):
    """ẋ = f(x) + g(x)u from two functions."""

    def __init__(self, n, f, g):
        super().__init__()
        self.own_f, self.own_g = f, torch.tensor(g, dtype=torch.float64)
        self.state_names, self.state_units = [f"x{i}" for i in range(n)], [""] * n
        self.control_names, self.control_units = [f"u{i}" for i in range(len(g[0]))], ["1"] * len(g[0])

    def f(self, x):
        return self.own_f(x)

    def g(self, x):
        return self.own_g.to(x).expand(*x.shape[:-1], *self.own_g.shape)


class Profit(lyapnet.Cost):
    """Nothing but 3 − x₀ at the end."""

    def state(self, x):
        return torch.zeros_like(x[..., 0])

    def R(self, x):
        return torch.full_like(x[..., 0], 0.1)[..., None, None]

    def terminal(self, x):
        return 3 - x[..., 0]


def stacked(function):
    return lambda x: torch.stack(function(*x.unbind(-1)), -1)


LOG = Own(2, stacked(lambda p, q: (-p * torch.log(p / q), q * (1 - p ** (2 / 3)))), [[0], [1]])
ROOT = Own(3, stacked(lambda x, v, w: (v, -torch.sqrt(v**2 + w**2) * v, -w)), [[0, 0], [1, 0], [0, 1]])
NORM = Own(2, stacked(lambda v, w: (-v * (v**2 + w**2 + 1e-12).sqrt(), -w)), [[1, 0], [0, 1]])
STIFF = Own(2, stacked(lambda x, y: (y, -1e4 * y)), [[0], [1e4]])
CHAINS = Own(
    12, lambda x: torch.cat([x[..., 4:], torch.zeros_like(x[..., :4])], -1), [[0] * 4] * 8 + torch.eye(4).tolist()
)
QUATERNION = Own(4, lambda x: torch.zeros_like(x), [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
FLEA = Own(2, stacked(lambda x, v: (v, -9.81e-12 * x)), [[0], [1e12]])
GRAVITY = Own(2, stacked(lambda x, v: (v, 0 * x - 9.81)), [[0], [1]])
ROUNDED = Own(2, stacked(lambda x, v: (0 * x + 1e-14, 0 * v - 9.81)), [[1, 0], [0, 1]])
LENGTH = Own(2, stacked(lambda x, v: (v, torch.tensor(1 / 0.3) * (x - 0.1))), [[0], [1]])  # in the default precision
UNSTABLE = Own(2, stacked(lambda x, y: (0.5 * x, -y)), [[0], [1]])
TABLE = lyapnet.Table([[0.0, 0.5, 1.0]], [2.0, 2.0, 1.0])
CHARGE = Own(1, lambda x: -TABLE(x)[..., None] * x, [[1]])

# a system and changes to the task ↦ facts, each with words of what is found, or None where it must not be there
TASKS = {
    "logarithm": (LOG, {"lower": 1, "upper": 2}, {"goal": "where f is defined) lies the origin, the default, because"}),
    "root": (
        ROOT,
        {},
        {"modes": "the rate of x1, by x1, x2", "step gain": "for the reason above", "goal": "an equilib"},
    ),
    "norm": (NORM, {}, {"modes": "-1e-06, -1 1/s", "controllable": "yes"}),
    "stiff": (STIFF, {}, {"modes": "0, -1e+04", "Δt": "a decaying mode grow under Euler steps"}),
    "twelve states": (CHAINS, {}, {"modes": "0 (12 times) 1/s", "controllable": "yes"}),
    "quaternion": (QUATERNION, {}, {"modes": "0 (4 times)", "controllable": "does not reach 0"}),
    "badly scaled": (FLEA, {"lower": [-1e-6, -1e3], "upper": [1e-6, 1e3]}, {"controllable": "yes"}),
    "tight limits": (GRAVITY, {"controls": {"lower": 0, "upper": 1}}, {"goal": "held by u = (9.81)"}),
    "target": (GRAVITY, {"target": [1, 0]}, {"goal": "(1, 0), an equilibrium at u = (9.81)"}),
    "rounding": (ROUNDED, {"target": [1, 0]}, {"goal": "(1, 0), an equilibrium at u = (0, 9.81)"}),
    "explicit target_control": (GRAVITY, {"target": [1, 0], "target_control": 0}, {"goal": "which the cost charges"}),
    "constants of f": (LENGTH, {"target": [0.4, 0]}, {"goal": "(0.4, 0), an equilibrium at u = (-1)"}),
    "unreached": (UNSTABLE, {}, {"controllable": "does not reach 0.5"}),
    "one state with a table": (CHARGE, {}, {"modes": "-2 1/s", "controllable": "yes"}),
}


def config_of(lower=-1, upper=1, **more):
    box = {"initial_states": {"lower": lower, "upper": upper}, "horizon": {"steps": 8, "dt": 0.1}}
    return config_from_plain(
        {"experiment": "own", "system": {"name": "own:Own"}, "cost": {"Q": 1, "R": 1, "Q_T": 1}, **box, **more}
    )


@pytest.mark.parametrize("kind", TASKS)
def test_tasks_of_other_kinds(kind):
    system, changes, expected = TASKS[kind]
    told = {fact.name: fact for fact in facts_before_optima(config_of(**changes), Parts(system=system))}
    for name, words in expected.items():
        assert words in told[name].found
    assert told["goal"].found.startswith("none") == ("modes" not in told)
    assert bool(told["goal"].advice) == (kind in ("logarithm", "tight limits"))
    if kind == "root":
        assert "√(v² + ε²)" in told["modes"].advice


def test_limits_of_a_control_without_unit():
    told = facts_before_optima(config_of(controls={"lower": 0, "upper": 20}, target=[1, 0]), Parts(system=GRAVITY))
    assert next(fact for fact in told if fact.name == "system").found.endswith(": u0 between 0 and 20")


def test_a_cost_without_rest_has_no_goal():
    config = config_of(cost={"name": "own:Profit"})
    told = facts_before_optima(config, Parts(system=STIFF, cost=Profit()))
    assert [fact.name for fact in told] == ["system", "goal"]
    assert "none: φ is 3, of slope (-1, 0), at the origin" in told[-1].found


def test_what_u_does_not_reach_does_not_depend_on_units():
    A, B = torch.tensor([[0.0, 1, 0], [2, 0, 0], [1, 0, -3]]).double(), torch.tensor([[0.0], [1], [0]]).double()
    assert not len(unreached_modes(A, B, torch.ones(3).double()))
    A[2, 0] = 0
    for size in (1e-12, 1.0, 1e12):
        units = torch.tensor([1.0, size, 1 / size]).double()
        changed = A * units / units[:, None]
        (mode,) = unreached_modes(changed, 1e-9 * B / units[:, None], 1 / units)
        assert mode.real.item() == pytest.approx(-3)
        assert not mode.imag


LONG = {
    "system": {"name": "pendulum"},
    "cost": {"Q": [1, 0.1], "R": 0.1, "Q_T": [10, 1]},
    "controls": {"lower": -1, "upper": 1},
    "initial_states": {"lower": [2, -1], "upper": [math.pi, 1]},
    "horizon": {"steps": 200, "dt": 0.02},
}


@pytest.mark.gate
def test_an_interrupt_leaves_the_facts(tmp_path):
    path = tmp_path / "long.yaml"
    path.write_text(yaml.safe_dump(LONG))
    arguments = [sys.executable, "-m", "lyapnet", "check", str(path)]
    process = subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    for line in process.stderr:
        if "optimum from the centre" in line:
            process.send_signal(signal.SIGINT)
            break
    shown, notes = process.communicate(timeout=60)
    assert process.returncode == 130
    lines = shown.splitlines()
    assert lines[0] == "long.yaml, before training"
    assert [line[:14].strip() for line in lines if not line.startswith(" ")][1:] == [
        "horizon", "X₀", "system", "goal", "modes", "controllable", "limits", "step gain", "start",
    ]  # fmt: skip
    assert max(map(len, lines)) <= 80
    *stages, last = notes.splitlines()
    assert all(line.startswith("check: ") for line in stages)
    assert last.startswith("Stopped after ")
    assert last.endswith("not reached: the best start.")


@pytest.mark.gate
def test_an_interrupt_leaves_one_json_object(tmp_path, capfd, monkeypatch):
    path = tmp_path / "long.yaml"
    path.write_text(yaml.safe_dump({**LONG, "initial_states": {"lower": 0, "upper": [1, 0]}}))
    monkeypatch.setattr("lyapnet.training.start.optimal_trajectories", lambda *_, **__: signal.raise_signal(2))
    assert main(["check", str(path), "--json"]) == 130
    shown = capfd.readouterr()
    report = json.loads(shown.out)
    assert not report["complete"]
    assert report["not_reached"] == ["the best start"]
    assert [fact["fact"] for fact in report["facts"]][-2:] == ["step gain", "start"]
    assert "Stopped after" in shown.err.splitlines()[-1]


def test_an_interrupt_that_an_import_keeps_to_itself_counts(tmp_path, capfd, monkeypatch):
    def keeps(*arguments):
        with contextlib.suppress(BaseException):
            signal.raise_signal(signal.SIGINT)
        return load_config(*arguments)

    path = tmp_path / "short.yaml"
    path.write_text(yaml.safe_dump(LONG))
    monkeypatch.setattr("lyapnet.experiment.config.load_config", keeps)
    assert main(["check", str(path)]) == 130
    shown = capfd.readouterr()
    assert shown.out.splitlines()[1].startswith("horizon ")
    assert "not reached: system, goal, modes" in shown.err


def test_a_failure_of_linear_algebra_is_a_fact(monkeypatch):
    def fails(*arguments, **options):
        raise torch.linalg.LinAlgError("linalg.eigh: it failed to converge")

    monkeypatch.setattr("lyapnet.training.start.optimal_trajectories", fails)
    config = config_of(lower=[1, 0], upper=[2, 1])
    facts = facts_of(build_learner(config, build_problem(config, Parts(system=UNSTABLE))))
    left_out, last = facts[-3], facts[-1]
    assert "no optimum from the centre of X₀: a matrix of second derivatives is singular" in left_out.found
    assert last.found.startswith("not found: a matrix of second derivatives is singular")
    assert "R" in last.advice


@pytest.mark.gate
def test_a_whole_check_where_the_origin_is_no_state(tmp_path, capfd, monkeypatch):
    """Nothing of LAPACK or torch is on the terminal, and what cannot be is a fact; tests of signals ask CasADi."""
    (tmp_path / "growing.py").write_text(
        "import torch, lyapnet\n\n\n"
        "class Growing(lyapnet.ControlAffineSystem):\n"
        "    state_names, state_units, control_names, control_units = ['p'], [''], ['u'], ['']\n\n"
        "    def f(self, x):\n        return -x * torch.log(x)\n\n"
        "    def g(self, x):\n        return -torch.sqrt(x)[..., None]\n"
    )
    (tmp_path / "task.yaml").write_text(
        "system: {name: 'growing:Growing'}\ncost: {Q: 1, R: 1, Q_T: 1}\ncontrols: {lower: 0, upper: 2}\n"
        "initial_states: {lower: 0.5, upper: 2}\nhorizon: {steps: 10, dt: 0.1}\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("lyapnet.training.start.MAX_OPTIMA", 4)
    shorten_fits(monkeypatch, 20, 10)
    monkeypatch.setattr("lyapnet.training.pretraining.BRIEF_STEPS", 10)
    monkeypatch.setattr("lyapnet.training.optima.optimal_cost", lambda problem: None)
    assert main(["check", "task.yaml"]) == 0
    shown, notes = capfd.readouterr()
    assert "(p > 0, where f and g are defined) lies the origin" in " ".join(shown.split())
    assert "no Riccati solution at the goal, for the reason above" in shown
    assert "training starts from" in shown
    assert all(line.startswith("check: ") for line in notes.splitlines())
