"""Functions of wrong shapes are refused at once, before anything is computed with them."""

import re

import pytest
import torch

from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly import Parts, build_problem, operating_point
from lyapnet.experiment.config import config_from_plain
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.sets import ControlBox
from lyapnet.task.systems import DoubleIntegrator
from tests.problems import problem_of
from tests.task.test_problem import Bowl

WRONG = {  # results for x of shape (*batch, k): wrong for every function below; some broadcast, some do not
    "further axes": lambda x: x[..., :1, None, None],
    "one number": lambda x: x.sum(),
    "no entries": lambda x: x[..., 0:0],
    "more axes and entries": lambda x: x[..., None].expand(*x.shape, 5),
    "too many entries": lambda x: torch.cat([x] * 7, -1),
    "None": lambda x: None,
}
FUNCTIONS = {
    "f": r"\.f\(x\)", "g": r"\.g\(x\)", "dynamics": r"\.dynamics\(x, u\)", "state": r"q\(x\)", "terminal": r"φ\(x\)",
    "R": r"R\(x\)", "minimise": r"\.minimise\(R, b\)", "project": r"\.project\(u\)", "contains": r"\.contains\(u\)",
}  # fmt: skip
CALLS = 3  # of f, before a wrong shape is refused


class Counted(DoubleIntegrator):
    """Counts the calls of f."""

    calls = 0

    def f(self, x):
        Counted.calls += 1
        return super().f(x)


def parts(function="", result=None):
    """System, cost and controls, with one function that returns something else."""
    Counted.calls = 0
    every = Counted(), QuadraticCost(torch.eye(2), torch.eye(1), torch.eye(2)), ControlBox(-1.0, 1.0)
    for part in every:
        if function and hasattr(part, function):
            of_b = (lambda R, b: result(b)) if function == "minimise" else lambda x, *u: result(x)
            setattr(part, function, of_b)
    return every


def config(**further):
    """A config of many steps, for which parts stand in."""
    return config_from_plain({
        "experiment": "small", "system": {"name": "double_integrator"}, "cost": {"Q": [1], "R": [1], "Q_T": [1]},
        "initial_states": {"lower": [-1], "upper": [1]}, "horizon": {"steps": 10_000, "dt": 0.1},
        "program": {"name": "value"}, "network": {"name": "fcn"}, **further,
    })  # fmt: skip


def assert_refused_at_once(function, call):
    with pytest.raises(UsageError, match=rf"Expected .*{FUNCTIONS[function]}.* as a tensor of .*, got .*;") as refused:
        call()
    assert len(str(refused.value).splitlines()) == 1
    assert Counted.calls <= CALLS


@pytest.mark.parametrize("result", WRONG)
@pytest.mark.parametrize("function", FUNCTIONS)
def test_a_function_of_another_shape_is_refused_at_once(function, result):
    """A g of (*batch, 1, 1, 1) made ẋ larger in each step: 20 s went by until its shape was looked at."""
    for further in ({}, {"target": {"position": 0.5}}):
        system, cost, controls = parts(function, WRONG[result])
        given = Parts(system=system, cost=cost, controls=controls)
        assert_refused_at_once(function, lambda given=given, further=further: build_problem(config(**further), given))
    system, cost, controls = parts(function, WRONG[result])
    problem = problem_of(system, cost, controls=controls, steps=10_000)
    assert problem.no_goal == ""  # in which nothing is computed either
    assert Counted.calls <= CALLS
    assert_refused_at_once(function, problem.check)


def test_so_are_those_of_an_operating_point():
    for function in ("f", "g", "project", "contains"):
        system, _, controls = parts(function, WRONG["further axes"])
        given = Parts(system=system, controls=controls)
        assert_refused_at_once(function, lambda given=given: operating_point(config(target={"position": 0.5}), given))


def test_functions_of_the_right_shape_are_not_refused():
    """The twin: a problem of the same parts, whose target is then solved for."""
    system, cost, controls = parts()
    problem = build_problem(config(target={"position": 0.5}), Parts(system=system, cost=cost, controls=controls))
    problem.check()
    assert Counted.calls > CALLS
    assert problem.goal.tolist() == [0.5, 0.0]


def test_numbers_do_not_stand_for_a_set():
    """contains(u) as 0.0 and 1.0 counts as a wrong type."""
    system, cost, controls = parts("contains", lambda u: (u.abs() <= 1).all(-1).to(u))
    with pytest.raises(UsageError, match=r"contains\(u\) as a tensor of \(64,\) and torch.bool.*; return a comparison"):
        problem_of(system, cost, controls=controls).check()


@pytest.mark.parametrize(
    ("returned", "named"),
    [
        (lambda V, V_x: (V[..., None], V_x), "(t, x)[0] as a tensor of (64,)"),
        (lambda V, V_x: (V, V_x[..., None]), "(t, x)[1] as a tensor of (64, 2)"),
        (lambda V, V_x: (V,), "(t, x)[1] for arguments of shape (64,) and (64, 2), got IndexError"),
    ],
)
def test_so_are_a_gradient_and_its_value(returned, named):
    class Other(Bowl):
        def value_and_state_gradient(self, t, x):
            return returned(*super().value_and_state_gradient(t, x))

    problem = problem_of(DoubleIntegrator())
    problem.check_value_function(Bowl())
    with pytest.raises(UsageError, match=re.escape(f"Other.value_and_state_gradient{named}")):
        problem.check_value_function(Other())
