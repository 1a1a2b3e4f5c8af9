"""The shapes of results of a problem's functions, checked before anything is computed."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lyapnet.base.contracts import check_result
from lyapnet.base.types import Control, State
from lyapnet.task.cost import Cost
from lyapnet.task.sets import ControlSet
from lyapnet.task.systems import ControlSystem


class Contract(NamedTuple):
    """A function of a part, and the shape of its result for one state."""

    name: str  # in messages
    function: Callable[..., Any]
    shape: Sequence[int]
    dtype: torch.dtype | None = None  # None: that of its arguments

    def check(self, *arguments: Tensor) -> None:
        """Check the shape and the dtype of the result for batches of arguments (b, …).

        Raises:
            UsageError: the function fails, or its result has another type, shape or dtype.
        """
        check_result(self.name, self.function, arguments, self.shape, self.dtype)


def contracts_of_system(system: ControlSystem) -> list[Contract]:
    """f and g, functions of x; none of a system that is not control-affine."""
    name, n, m = type(system).__name__, system.n, system.m
    if not system.affine:
        return []
    return [Contract(f"{name}.f(x)", system.f, (n,)), Contract(f"{name}.g(x)", system.g, (n, m))]


def contracts_of_cost(cost: Cost, m: int) -> list[Contract]:
    """q, φ and R, functions of x, for m controls."""
    name = type(cost).__name__
    return [
        Contract(f"q(x) of {name}", cost.state, ()),
        Contract(f"φ(x) of {name}", cost.terminal, ()),
        Contract(f"R(x) of {name}", cost.R, (m, m)),
    ]


def check_shapes_of_system(system: ControlSystem, x: State) -> None:
    """Check the shapes of f, g and ẋ at states (b, n).

    Raises:
        UsageError: one is wrong; says which one, and its shape.
    """
    x = x.detach().clone().requires_grad_()  # code in NumPy, which has no derivatives, refuses it
    for contract in contracts_of_system(system):
        contract.check(x)
    dynamics = Contract(f"{type(system).__name__}.dynamics(x, u)", system.dynamics, (system.n,))
    dynamics.check(x, x.new_ones(len(x), system.m))


def check_shapes_of_cost(cost: Cost, m: int, x: State) -> None:
    """Check the shapes of q, φ and R at states (b, n), for m controls.

    Raises:
        UsageError: one is wrong; says which one, and its shape.
    """
    x = x.detach().clone().requires_grad_()
    for contract in contracts_of_cost(cost, m):
        contract.check(x)


def check_shapes_of_controls(controls: ControlSet, b: Control) -> None:
    """Check the shapes of the three functions of U at vectors (b, m), with R = I.

    Raises:
        UsageError: one is wrong; says which one, and its shape.
    """
    name, m = type(controls).__name__, b.shape[-1]
    R = torch.eye(m, dtype=b.dtype).expand(len(b), m, m)
    Contract(f"{name}.project(u)", controls.project, (m,)).check(b)
    Contract(f"{name}.contains(u)", controls.contains, (), torch.bool).check(b)
    Contract(f"{name}.minimise(R, b)", controls.minimise, (m,)).check(R, b)
