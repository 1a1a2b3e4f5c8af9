"""Linear systems, with the double integrator and chains of integrators."""

from collections.abc import Sequence
from typing import TypeGuard

import torch
from jaxtyping import Float
from torch import Tensor

from lyapnet.base.linear_algebra import apply
from lyapnet.base.types import Control, ControlMatrix, InputMatrix, PerState, State
from lyapnet.task.systems.base import ControlAffineSystem, ControlSystem, require_positive


class Linear(ControlAffineSystem):
    """ẋ = Ax + Bu.

    Args:
        A: (n, n).
        B: (n, m).

    Raises:
        ValueError: A is not square, or B has another number of rows.
    """

    A: Float[Tensor, "n n"]
    B: Float[Tensor, "n m"]

    def __init__(self, A: Sequence[Sequence[float]] | Tensor, B: Sequence[Sequence[float]] | Tensor):
        super().__init__()
        a, b = _matrix("A", A), _matrix("B", B)
        if a.ndim != 2 or a.shape[0] != a.shape[1] or b.ndim != 2 or b.shape[0] != a.shape[0]:
            raise ValueError(
                f"Expected A of shape (n, n) and B of shape (n, m), got {tuple(a.shape)} and {tuple(b.shape)}; "
                "write both as lists of rows."
            )
        self.register_buffer("A", a, persistent=False)
        self.register_buffer("B", b, persistent=False)
        self.state_names = tuple(f"x{i + 1}" for i in range(a.shape[0]))
        self.state_units = ("",) * a.shape[0]
        self.control_names = tuple(f"u{i + 1}" for i in range(b.shape[1]))
        self.control_units = ("",) * b.shape[1]

    def f(self, x: State) -> State:
        return apply(self.A, x)

    def g(self, x: State) -> InputMatrix:
        return self.B.expand(*x.shape[:-1], *self.B.shape)

    def dynamics(self, x: State, u: Control) -> State:
        return apply(self.A, x) + apply(self.B, u)


def is_linear(system: ControlSystem) -> TypeGuard[Linear]:
    """Whether a system is Linear and no subclass overrides f, g or dynamics."""
    return isinstance(system, Linear) and all(
        getattr(type(system), name) is getattr(Linear, name) for name in ("f", "g", "dynamics")
    )


class DoubleIntegrator(Linear):
    """m q̈ = u: a mass on a line, without friction.

    Args:
        mass: in kg.
    """

    def __init__(self, mass: float = 1.0):
        require_positive(mass=mass)
        super().__init__([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0 / mass]])
        self.mass = mass
        self.state_names, self.state_units = ("position", "velocity"), ("m", "m/s")
        self.control_names, self.control_units = ("force",), ("N",)

    def energy(self, x: State) -> PerState:
        """½ m q̇² in J."""
        return 0.5 * self.mass * x[..., 1] ** 2

    def inverse_mass(self, x: State) -> ControlMatrix:
        """1/m: the control weight R of the reference task."""
        return torch.full((*x.shape[:-1], 1, 1), 1.0 / self.mass).to(x)


class IntegratorChain(Linear):
    """ẋ_i = x_{i+1} for i < n, ẋ_n = u: n integrators in a row, with one input at the end.

    Args:
        length: n.
    """

    def __init__(self, length: int = 4):
        if length < 1:
            raise ValueError(f"Expected length ≥ 1, got {length}; a chain has at least one integrator.")
        shift = [[float(j == i + 1) for j in range(length)] for i in range(length)]
        super().__init__(shift, [[float(i == length - 1)] for i in range(length)])


def _matrix(name: str, rows: Sequence[Sequence[float]] | Tensor) -> Tensor:
    try:
        matrix = torch.as_tensor(rows, dtype=torch.get_default_dtype())
    except (TypeError, ValueError) as error:
        raise ValueError(f"Expected {name} as a list of rows of one length, got {rows!r}; correct it.") from error
    if not torch.isfinite(matrix).all():
        raise ValueError(f"Expected finite entries in {name}, got {matrix.tolist()}; correct them.")
    return matrix
