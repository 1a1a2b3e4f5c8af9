"""Names that every system has: an attribute that hides one is refused by its name."""

import pytest
import torch

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import config_from_plain

TASK = {
    "experiment": "x", "cost": {"Q": 1, "R": 1, "Q_T": 1}, "initial_states": {"lower": -1, "upper": 1},
    "horizon": {"steps": 4, "dt": 0.1},
}  # fmt: skip


class Ball(lyapnet.ControlAffineSystem):
    """A ball on a table."""

    state_names, state_units = ("position", "velocity"), ("m", "m/s")
    control_names, control_units = ("force",), ("N",)

    def f(self, x):
        return torch.stack([x[..., 1], -x[..., 1]], -1)

    def g(self, x):
        return x.new_tensor([[0.0], [1.0]]).expand(*x.shape[:-1], 2, 1)


class ClassMass(Ball):
    m = 2.0


class ClassCount(Ball):
    n = torch.tensor(2)


class ClassTitle(Ball):
    title = 3


class ClassGravity(Ball):
    g = 9.81


class Named(Ball):
    title = "a ball"


class Attributes(Ball):
    """With an attribute of any name."""

    def __init__(self, name: str = "mass", value: float = 2.0):
        super().__init__()
        setattr(self, name, value)


def build(own, **parameters):
    return build_problem(config_from_plain({**TASK, "system": {"name": f"{__name__}:{own}", "parameters": parameters}}))


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("ClassMass", r"ClassMass\.m as the number of controls, got 2\.0; m is a reserved name"),
        ("ClassCount", r"ClassCount\.n as the number of states, got tensor\(2\); n is a reserved name"),
        ("ClassTitle", r"ClassTitle\.title as a text, got 3"),
        ("ClassGravity", r"ClassGravity\.g as the function that every system has, got 9\.81; g is a reserved name"),
    ],
)
def test_a_class_that_hides_one_is_refused(name, reason):
    with pytest.raises(UsageError, match=reason):
        build(name)


@pytest.mark.parametrize("attribute", ["g", "f", "draw", "dynamics", "half", "type", "holding_control"])
def test_an_object_that_hides_a_function_is_refused(attribute):
    with pytest.raises(UsageError, match=rf"Attributes\.{attribute} as the function .* give the attribute another one"):
        build("Attributes", name=attribute)


@pytest.mark.parametrize("attribute", ["n", "m", "title", "state_labels"])
def test_an_object_cannot_take_a_property(attribute):
    with pytest.raises(UsageError, match=r"has no setter.*reserved names"):
        build("Attributes", name=attribute)


def test_other_names_are_free():
    assert build("Attributes").system.mass == 2.0
    assert build("Named").system.title == "a ball"
