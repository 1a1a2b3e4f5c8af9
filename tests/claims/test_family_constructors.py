"""Families whose constructor derives something from the parameter that counts beyond X₀ alone: none passes.

Each has a wall far outside of X₀, at a place that depends on the parameter in another way than f and g read it.
"""

import math
from typing import ClassVar

import pytest
import torch

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.task.family import FamilySystem, check_members

Z = torch.tensor([[-1.0, 0.8], [1.0, 1.2], [0.3, 0.9], [-0.5, 1.1]]).double()  # X₀ × P


class Wall(lyapnet.ControlAffineSystem):
    """ẋ = −kx + u + a wall at x = 2k."""

    state_names, state_units, control_names, control_units = ("x",), ("m",), ("u",), ("m/s",)

    def __init__(self, k: float = 1.0):
        super().__init__()
        self.k = k
        self.wall = self.derived(k)

    def derived(self, k):
        return 2 * k

    def place(self):
        return self.wall

    def f(self, x):
        return torch.stack([-self.k * x[..., 0] + 40 * torch.relu(x[..., 0] - self.place())], -1)

    def g(self, x):
        return torch.ones(*x.shape, 1).to(x)


class Read(Wall):
    """A counterpart that is sound: f computes the derived number."""

    def place(self):
        return 2 * self.k


class Unused(Wall):
    """A counterpart that is sound: the derived number is not used by f or g."""

    def place(self):
        return 2.0


class Property(Wall):
    """A counterpart that is sound: the derived number is a property."""

    def derived(self, k):
        if k <= 0:
            raise ValueError("k > 0")
        return 0.0

    @property
    def twice(self):
        return 2 * self.k

    def place(self):
        return self.twice


class Buffer(Wall):
    def derived(self, k):
        self.register_buffer("place_of_it", torch.tensor(2.0 * k))
        return 0.0

    def place(self):
        return self.place_of_it


class Threshold(Wall):
    """Another wall for a hundredth of P."""

    def derived(self, k):
        return 2.0 if 0.9301 < k < 0.9341 else 3.0


class Least(Wall):
    def derived(self, k):
        return max(k, 1.19) + 1.0


class Shared(Wall):
    """The derived number is stored in an object that all members share."""

    shared: ClassVar = [2.0]

    def derived(self, k):
        Shared.shared[0] = 2 * k
        return 0.0

    def place(self):
        return Shared.shared[0]


class Function(Wall):
    def derived(self, k):
        return lambda: 2 * k

    def place(self):
        return self.wall()


class InDynamics(Wall):
    def place(self):
        return 9.0

    def dynamics(self, x, u):
        return super().dynamics(x, u) + 40 * torch.relu(x - self.wall)


class InWeight(Wall):
    """The derived number is the weight of a cost."""

    def place(self):
        return 9.0

    def inverse_mass(self, x):
        return (1 + torch.relu(x - self.wall))[..., None]


class InMatrix(Wall):
    def derived(self, k):
        return {"places": [9.0, math.sqrt(k) + 1]}

    def place(self):
        return self.wall["places"][1]


class InPart(Wall):
    """The derived number is stored in a submodule."""

    def derived(self, k):
        self.part = torch.nn.Linear(1, 1)
        torch.nn.init.constant_(self.part.weight, 1.0)
        torch.nn.init.constant_(self.part.bias, -2 * k)
        return 0.0

    def f(self, x):
        return torch.stack([-self.k * x[..., 0] + 40 * torch.relu(self.part(x)[..., 0])], -1)


def check(cls):
    family = FamilySystem(cls(1.0), ["k"], [""]).double()
    check_members(family, lambda values: cls(**values).double(), Z)


@pytest.mark.parametrize("cls", [Read, Unused, Property])
def test_what_f_derives_itself_passes(cls):
    check(cls)


@pytest.mark.parametrize(
    "cls",
    [Wall, Buffer, Threshold, Least, Shared, Function, InDynamics, InWeight, InMatrix, InPart],
)
def test_what_the_constructor_derives_is_refused_beyond_the_states_tried(cls):
    with pytest.raises(UsageError, match="__init__") as error:
        check(cls)
    assert len(str(error.value).splitlines()) == 1
