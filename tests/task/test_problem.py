"""Horizons and problems, and what is refused of the parts that a problem is made of."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly import Parts, build_problem
from lyapnet.experiment.config import load_config
from lyapnet.task.cost import Cost, QuadraticCost
from lyapnet.task.horizon import Horizon
from lyapnet.task.sets import Box, ControlBox, ControlSet, Unbounded
from lyapnet.task.systems import ControlAffineSystem, DoubleIntegrator
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.networks import FCN, Scaling
from tests.problems import problem_of

CONF = Path(__file__).parents[2] / "conf"


# Horizon


@pytest.mark.parametrize(("steps", "dt"), [(0, 0.1), (-1, 0.1), (1, 0.0), (1, -0.1), (1, math.inf), (1, math.nan)])
def test_a_horizon_of_nothing_is_refused(steps, dt):
    with pytest.raises(ValueError, match=r"Expected (steps ≥ 1|dt > 0), got"):
        Horizon(steps, dt)


def test_horizon_nodes_are_multiples_of_dt():
    horizon = Horizon(400, 0.01)
    assert horizon.duration == 4.0
    assert horizon.times(torch.zeros(1)).tolist() == [n * 0.01 for n in range(401)]
    assert horizon.times(torch.zeros(1, dtype=torch.float32)).dtype == torch.float32


# Problem


class Away(Cost):
    """q = φ = ‖x − goal‖² and R = 1."""

    def __init__(self, goal):
        super().__init__()
        self.goal = goal

    def state(self, x):
        return ((x - self.goal) ** 2).sum(-1)

    def R(self, x):
        return torch.ones(*x.shape[:-1], 1, 1).to(x)

    def terminal(self, x):
        return self.state(x)


def test_the_goal_is_the_costs_or_the_origin():
    assert problem_of(DoubleIntegrator()).goal.tolist() == [0, 0]
    problem = problem_of(DoubleIntegrator(), Away(torch.tensor([1.0, 0.5])))
    assert problem.goal.tolist() == [1, 0.5]
    assert problem.float().goal.dtype == torch.float32


def test_parts_are_exchanged_one_by_one():
    problem = problem_of(DoubleIntegrator())
    other = problem.replaced(horizon=Horizon(3, 0.2))
    assert other.horizon.steps == 3
    for name in ("system", "cost", "controls", "initial_states"):
        assert getattr(other, name) is getattr(problem, name)
    assert problem.horizon.steps == 10


def test_a_box_of_another_dimension_is_refused():
    with pytest.raises(ValueError, match=r"Expected initial_states with 2 entries .*, got 3"):
        problem_of(DoubleIntegrator(), initial_states=Box([-1.0] * 3, [1.0] * 3))


def test_a_problem_checks_its_parts_on_its_own_states():
    """R loses its definiteness where x₁ ≤ −0.5: in X₀ or not."""
    cost = QuadraticCost(torch.eye(2), lambda x: x[..., :1, None] + 0.5, torch.eye(2))
    problem_of(DoubleIntegrator(), cost, initial_states=Box([-0.4, -1.0], [1.0, 1.0])).check()
    with pytest.raises(ValueError, match=r"Expected R\(x\) symmetric positive definite"):
        problem_of(DoubleIntegrator(), cost).check()
    with pytest.raises(UsageError, match=r"Detached\.f\(x\)"):
        problem_of(Detached()).check()


@pytest.mark.parametrize("m", [1, 2, 3])
def test_one_number_is_a_diagonal_for_R_as_it_is_for_Q(m, tmp_path):
    shift = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]
    B = torch.eye(3)[:, 3 - m :].tolist()
    text = f"""
experiment: small
program: {{name: value}}
system: {{name: linear, parameters: {{A: {shift}, B: {B}}}}}
cost: {{Q: [2], R: [0.5], Q_T: [3]}}
initial_states: {{lower: [-1], upper: [1]}}
horizon: {{steps: 4, dt: 0.1}}
network: {{name: fcn}}
"""
    (tmp_path / "small.yaml").write_text(text, encoding="utf-8")
    cost = build_problem(load_config(tmp_path / "small.yaml")).cost
    for matrix, expected, size in ((cost.Q, 2, 3), (cost.R_constant, 0.5, m), (cost.Q_T, 3, 3)):
        assert torch.equal(matrix, expected * torch.eye(size))
    rows = load_config(tmp_path / "small.yaml", [f"cost.R={(0.5 * torch.eye(m)).tolist()}"])
    assert torch.equal(build_problem(rows).cost.R_constant, cost.R_constant)
    assert_close(cost.R_inverse, 2 * torch.eye(m))
    with pytest.raises(UsageError, match=rf"Expected cost.R with {'one entry' if m == 1 else f'{m} entries'}"):
        build_problem(load_config(tmp_path / "small.yaml", [f"cost.R={[0.5] * (m + 1)}"]))


@pytest.mark.parametrize("name", ["double_integrator", "reacher"])
def test_everything_follows_a_problem_to_a_precision(name):
    problem = build_problem(load_config(CONF / f"{name}.yaml", ["training.precision=float32"]))
    assert {buffer.dtype for buffer in problem.buffers()} == {torch.float32}
    assert problem.goal.dtype == problem.cost.R(problem.goal).dtype == torch.float32


# Systems that break their contract


class Sound(DoubleIntegrator):
    """The twin of the systems below: what they break is right here."""


class ThreeRows(Sound):
    def f(self, x):
        return torch.cat([x, x[..., :1]], -1)


class SinglePrecision(Sound):
    def g(self, x):
        return super().g(x).float()


class Detached(Sound):
    def f(self, x):
        return super().f(x).detach()


class NumPy(Sound):
    def f(self, x):
        return x.detach().numpy()


class OneUnit(Sound):
    def __init__(self):
        super().__init__()
        self.state_units = ("m",)


class Tabulated(Sound):
    """A lookup by NumPy, whose slope autograd does not see."""

    def f(self, x):
        table = np.interp(x[..., 0].detach().numpy(), [-1.0, 0.0, 1.0], [0.0, 0.0, 1.0])
        return super().f(x) + torch.as_tensor(table).to(x)[..., None]


class Mixing(Sound):
    def f(self, x):
        return super().f(x) - (x.mean(0) if x.ndim > 1 else 0)


class Shaped(Sound):
    """Friction for a batch alone."""

    def f(self, x):
        return super().f(x) - (0.1 * x if x.ndim > 1 else 0)


class Noisy(Sound):
    def f(self, x):
        return super().f(x) + 0.1 * torch.randn_like(x)


class InPlace(Sound):
    def f(self, x):
        with torch.no_grad():
            x[..., 0] += 1
        return super().f(x)


class Pole(Sound):
    def f(self, x):
        return super().f(x) + torch.sqrt(x[..., :1])


class WrongBackward(Sound):
    class Sine(torch.autograd.Function):
        @staticmethod
        def forward(ctx, x):
            return torch.sin(x)

        @staticmethod
        def backward(ctx, grad):
            return grad

    def f(self, x):
        return self.Sine.apply(super().f(x))


class Exits(Sound):
    def f(self, x):
        sys.exit(0)


@pytest.mark.parametrize(
    ("system", "named"),
    [
        (ThreeRows, r"ThreeRows\.f\(x\).*\(64, 2\).*\(64, 3\)"),
        (SinglePrecision, r"SinglePrecision\.g\(x\).*float64.*float32"),
        (Detached, r"Detached\.f\(x\) with autograd's derivative"),
        (NumPy, r"NumPy\.f\(x\).*ndarray"),
        (OneUnit, "one unit for each"),
        (Tabulated, r"Tabulated\.f\(x\) with autograd's derivative.*lyapnet\.Table"),
        (Mixing, r"Mixing\.f\(x\) to be a function of each state by itself.*size of a batch at test_problem.py"),
        (Shaped, r"Shaped\.f\(x\) to be a function of each state by itself.*size of a batch at test_problem.py"),
        (Noisy, r"Noisy\.f\(x\) to be a function of each state by itself"),
        (InPlace, r"InPlace\.f\(x\)"),
        (Pole, r"finite Pole\.f\(x\), got nan at x = "),
        (WrongBackward, r"WrongBackward\.f\(x\) with autograd's derivative"),
        (Exits, r"Exits\.f\(x\).*SystemExit"),
    ],
)
def test_system_that_breaks_its_contract_is_refused_by_name(system, named):
    problem_of(Sound()).check()
    with pytest.raises(UsageError, match=named) as refused:
        problem_of(system()).check()
    assert len(str(refused.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("method", "broken", "named"),
    [
        ("state", lambda x: x[..., :1] ** 2, r"q\(x\) of QuadraticCost as a tensor of \(64,\).*\(64, 1\)"),
        ("terminal", lambda x: x**2, r"φ\(x\) of QuadraticCost as a tensor of \(64,\)"),
        ("terminal", lambda x: (x**2).sum(), r"φ\(x\) of QuadraticCost as a tensor of \(64,\)"),
        ("state", lambda x: (x.detach() ** 2).sum(-1), r"q\(x\) of QuadraticCost with autograd's derivative"),
    ],
)
def test_cost_that_breaks_its_contract_is_refused_by_name(method, broken, named):
    cost = QuadraticCost(torch.eye(2), torch.eye(1), torch.eye(2))
    problem_of(DoubleIntegrator(), cost).check()
    setattr(cost, method, broken)
    with pytest.raises(UsageError, match=named):
        problem_of(DoubleIntegrator(), cost).check()


class Bowl(ValueFunction):
    """V = ½‖x‖² + t; a network by its scale."""

    def __init__(self):
        super().__init__()
        self.scale = torch.nn.Parameter(torch.tensor(1.0))

    def forward(self, t, x):
        return self.scale * (0.5 * (x**2).sum(-1) + t)


class HalfDetached(Bowl):
    def forward(self, t, x):
        return super().forward(t, x) + 0.1 * (x.detach() ** 2).sum(-1)


class TimeDetached(Bowl):
    def forward(self, t, x):
        return super().forward(t.detach(), x)


class Pair(Bowl):
    def forward(self, t, x):
        return super().forward(t, x), x


class Column(Bowl):
    def forward(self, t, x):
        return super().forward(t, x)[..., None]


class OfTheBatch(Bowl):
    def forward(self, t, x):
        return super().forward(t, x) - (x**2).mean()


class OtherGradient(Bowl):
    def value_and_state_gradient(self, t, x):
        return self(t, x), self.scale * x * 1.01


class OwnGradient(Bowl):
    """The twin of the one before."""

    def value_and_state_gradient(self, t, x):
        return self(t, x), self.scale * x


@pytest.mark.parametrize(
    ("V", "named"),
    [
        (HalfDetached, r"HalfDetached\.forward\(t, x\) with autograd's derivative"),
        (TimeDetached, r"TimeDetached\.forward\(t, x\) with autograd's derivative"),
        (Pair, r"Pair\.forward\(t, x\) as a tensor.*tuple"),
        (Column, r"Column\.forward\(t, x\) as a tensor of \(64,\).*\(64, 1\)"),
        (OfTheBatch, r"OfTheBatch\.forward\(t, x\) to be a function of each state by itself"),
        (OtherGradient, r"OtherGradient\.value_and_state_gradient\(t, x\) as V and its gradient"),
    ],
)
def test_value_function_that_breaks_its_contract_is_refused_by_name(V, named):
    problem = problem_of(DoubleIntegrator())
    for sound in (Bowl(), OwnGradient(), FCN(Scaling([1.0, 1.0], duration=1.0, value=1.0))):
        problem.check_value_function(sound)
    with pytest.raises(UsageError, match=named):
        problem.check_value_function(V())


def test_kinks_jumps_and_large_numbers_keep_the_contract():
    class Rough(Sound):
        dynamics = ControlAffineSystem.dynamics

        def f(self, x):
            rough = x.abs() + torch.relu(x - 0.3) + torch.sign(x) + torch.floor(3 * x) + x.clamp(-0.5, 0.5)
            return 1e6 * super().f(x) + rough

    problem_of(Rough()).check()


def test_a_control_set_whose_minimum_lies_outside_is_refused():
    class Leaky(Unbounded):
        def project(self, u):
            return u.clamp(-1, 1)

    problem_of(DoubleIntegrator()).check()
    with pytest.raises(ValueError, match=r"Leaky\.minimise"):
        problem_of(DoubleIntegrator(), controls=Leaky()).check()


# The record by which another problem is noticed


class Rubbed(DoubleIntegrator):
    """With friction on the velocity."""

    def f(self, x):
        return super().f(x) - 0.01 * torch.stack([torch.zeros_like(x[..., 1]), x[..., 1]], -1)


class Renamed(DoubleIntegrator):
    def __init__(self):
        super().__init__()
        self.state_names = ["velocity", "position"]


class Between(ControlSet):
    """[−1, upper]."""

    def __init__(self, upper):
        super().__init__()
        self.upper = upper

    def minimise(self, R, b):
        return self.project(-b / (2 * R[..., 0]))

    def contains(self, u):
        return (u == self.project(u)).all(-1)

    def project(self, u):
        return u.clamp(-1.0, self.upper)


def cost_of(q=1.0, r=1.0, end=1.0):
    return QuadraticCost(q * torch.eye(2), r * torch.eye(1), end * torch.eye(2))


OTHERS = {
    "the same": ({}, []),
    "in float32 and back": ({"cost": cost_of(1 + 1e-7)}, []),
    "f": ({"system": Rubbed()}, ["f"]),
    "g": ({"system": DoubleIntegrator(mass=1.01)}, ["g"]),
    "names": ({"system": Renamed()}, ["state names"]),
    "q": ({"cost": cost_of(q=1.01)}, ["q"]),
    "R": ({"cost": cost_of(r=1.01)}, ["R"]),
    "the end": ({"cost": cost_of(end=1.01)}, ["φ"]),
    "limits": ({"controls": Between(2.0)}, ["U"]),
    "other limits": ({"controls": Between(2.01)}, ["U"]),
    "a box": ({"controls": ControlBox(-2.0, 2.0)}, ["U", "lower limits", "upper limits"]),
    "a box that no control meets": ({"controls": ControlBox(-2e4, 2e4)}, ["lower limits", "upper limits"]),
    "a box on one side": ({"controls": ControlBox(-math.inf, 2e4)}, ["upper limits"]),
}


@pytest.mark.parametrize("at_rest", [False, True])
@pytest.mark.parametrize("other", OTHERS)
def test_another_problem_is_noticed_by_its_record(other, at_rest):
    box = Box([-1.0, 0.0], [1.0, 0.0]) if at_rest else None
    own = {"controls": Between(2.0)} if other == "other limits" else {}
    changes, expected = OTHERS[other]
    common = {"system": DoubleIntegrator(), "initial_states": box}
    record = problem_of(**common | own).record()
    assert problem_of(**common | changes).differences(record) == expected


@pytest.mark.parametrize(
    ("own", "other", "expected"),
    [
        ((-2e4, 2e4), (-2e4, 6e3), ["upper limits"]),
        ((-1000.0, 8.0), (-1000.0, 8.09), ["upper limits"]),
        ((-math.inf, 8.0), (-math.inf, 8.4), ["upper limits"]),
        ((-8.0, 8.0), (-8.0, 8.0), []),
    ],
)
def test_limits_are_told_apart(own, other, expected):
    one, two = (problem_of(DoubleIntegrator(), controls=ControlBox(*sides)) for sides in (own, other))
    found = two.differences(one.record())
    assert [part for part in found if part != "U"] == expected
    assert not one.differences(one.float().record())
    free = problem_of(DoubleIntegrator())
    assert free.differences(one.record()), "without limits it is another problem too"


def test_the_precision_is_no_difference():
    problem = problem_of(DoubleIntegrator(mass=0.3), cost_of(0.1))
    record = problem.record()
    assert not problem.float().differences(record)


@pytest.mark.parametrize("evil", [None, "record", [], {}, {"x": "x"}, {"x": [[[]]]}, {"x": {"y": 1}}])
def test_a_record_that_is_none_tells_nothing(evil):
    assert problem_of(DoubleIntegrator()).differences(evil) == []


@pytest.mark.parametrize("evil", [None, "f", [], [[1.0]], [["a", "b"]], [[1.0, 2.0], [3.0]], {"f": 1}, [[[[]]]], 1e308])
def test_a_part_that_is_none_is_another(evil):
    problem = problem_of(DoubleIntegrator())
    assert problem.differences({**problem.record(), "f": evil}) == ["f"]


def test_numbers_that_are_none_are_the_same():
    problem = problem_of(DoubleIntegrator())
    infinite = {**problem.record(), "U": [[math.nan], [math.inf], [1.0]]}
    assert problem.differences(infinite) == ["U"]


# What is said of code that breaks a contract


class Toy(DoubleIntegrator):
    """f or g by some way of writing it."""

    dynamics = ControlAffineSystem.dynamics

    def __init__(self, f=None, g=None):
        super().__init__()
        self.own_f, self.own_g = f, g

    def f(self, x):
        return super().f(x) if self.own_f is None else torch.stack([x[..., 1], self.own_f(x[..., 0])], -1)

    def g(self, x):
        return super().g(x) if self.own_g is None else self.own_g(x)


WRITTEN = {
    "an if": ({"f": lambda q: q if q > 0 else 2 * q}, "torch.where"),
    "an if over the batch": ({"f": lambda q: q if q.sum() > 0 else 2 * q}, "torch.where"),
    "float": ({"f": lambda q: q * float(q)}, r"no float\(x\)"),
    "np.interp": ({"f": lambda q: torch.as_tensor(np.interp(q, [-1, 1], [-1, 1]))}, "lyapnet.Table for np.interp"),
    "np.sin": ({"f": np.sin}, "torch.sin for np.sin"),
    "NumPy and detach": ({"f": lambda q: torch.as_tensor(np.sin(q.detach().numpy()))}, "lyapnet.Table"),
    "float32": ({"g": lambda x: torch.ones(*x.shape, 1).float()}, r"append \.to\(x\)"),
    "an axis missing": ({"g": lambda x: torch.ones(*x.shape)}, r"append \[\.\.\., None\]"),
    "one for all": ({"g": lambda x: torch.ones(2, 1)}, r"append \.expand\(\*x\.shape\[:-1\], 2, 1\)"),
    "a row more": ({"g": lambda x: torch.ones(*x.shape[:-1], 3, 1)}, "give its axis 1 2 entries, not 3"),
    "another shape": ({"g": lambda x: torch.ones(7)}, "return one result for each state"),
    "anything else": ({"f": lambda q: q.nothing}, "correct it there"),
}


@pytest.mark.filterwarnings("ignore:Converting a tensor")
@pytest.mark.parametrize("written", WRITTEN)
def test_a_broken_contract_says_what_to_write(written):
    own, remedy = WRITTEN[written]
    with pytest.raises(UsageError, match=rf"^Expected Toy\.[fg]\(x\).*; .*{remedy}.*\.$"):
        problem_of(Toy(**own)).check()


def test_what_only_looks_at_values_keeps_the_contract():
    def looked_at(q):
        if (q.abs() > 100).any():
            raise ValueError
        return q

    problem_of(Toy(looked_at)).check()


class Forgotten(DoubleIntegrator):
    """Without super().__init__()."""

    def __init__(self, k=1.0):
        self.k = k


class ForgottenBuffer(DoubleIntegrator):
    def __init__(self):
        self.register_buffer("k", torch.ones(()))


def test_a_forgotten_super_is_named():
    config = load_config(CONF / "from_scratch" / "double_integrator.yaml")
    with pytest.raises(UsageError, match=r"Expected Forgotten\.__init__ to call super\(\)\.__init__\(\)"):
        build_problem(config, Parts(system=Forgotten()))
    for name in ("Forgotten", "ForgottenBuffer"):
        config.system.name = f"{__name__}:{name}"
        with pytest.raises(UsageError, match=r"call .*super\(\)\.__init__\(\)"):
            build_problem(config)
