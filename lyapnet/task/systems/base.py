"""What a system is: dynamics affine in the control, and facts about its coordinates."""

import inspect
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from lyapnet.base.errors import UsageError
from lyapnet.base.linear_algebra import apply, multiply, solve
from lyapnet.base.shapes import Shape
from lyapnet.base.types import Control, ControlMatrix, Coordinates, InputMatrix, MassMatrix, PerState, State


class ControlAffineSystem(nn.Module, ABC):
    """ẋ = f(x) + g(x)u with n states and m controls.

    A subclass writes f and g with torch operations on tensors of any leading shape, and declares its coordinates.
    Physical parameters are constructor arguments; they stay Python floats or become buffers. One that has an energy may
    say so in a method `energy(x)` of shape (*batch,), in J: constant along u = 0 without friction.
    """

    state_names: Sequence[str] = ()
    state_units: Sequence[str] = ()
    control_names: Sequence[str] = ()
    control_units: Sequence[str] = ()
    angles: Sequence[int] = ()  # indices of the states that are angles in rad, unwrapped
    constants: Sequence[int] = ()  # indices of the states that stay what they are: the parameters of a family

    @abstractmethod
    def f(self, x: State) -> State:
        """The drift: ẋ at u = 0, in state units per second."""

    @abstractmethod
    def g(self, x: State) -> InputMatrix:
        """The input matrix ∂ẋ/∂u."""

    def dynamics(self, x: State, u: Control) -> State:
        """ẋ = f(x) + g(x)u."""
        return self.f(x) + apply(self.g(x), u)

    def holding_control(self, x: State) -> tuple[Control, State]:
        """u that holds a state (n,), f(x) + g(x)u = 0, and the ẋ that stays: by least squares, of least norm."""
        f, g = self.f(x), self.g(x)
        u = -apply(torch.linalg.pinv(g), f)
        return u, f + apply(g, u)

    def draw(self, x: np.ndarray, u: np.ndarray) -> Sequence[Shape]:
        """What it looks like in a state (n,) under a control (m,): shapes in a plane, in metres; here none.

        `lyapnet animate` moves them; of a system without shapes it shows the plane of two states.
        """
        return ()

    @property
    def title(self) -> str:
        """What it is called in tables."""
        return type(self).__name__

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.state_names)

    @property
    def m(self) -> int:
        """Number of controls."""
        return len(self.control_names)

    def check_coordinates(self) -> None:
        """Refuse names and units that are no lists of as many strings, angles that are no states, and attributes that
        hide what every system has, as g = 9.81 hides g(x).

        Raises:
            UsageError: naming the attribute.
        """
        name = type(self).__name__
        self._refuse_hidden_names()
        for names, units in (("state_names", "state_units"), ("control_names", "control_units")):
            for attribute in (names, units):
                listed = getattr(self, attribute)
                if not isinstance(listed, list | tuple) or not all(isinstance(entry, str) for entry in listed):
                    raise UsageError(f"Expected {name}.{attribute} as a list of strings, got {listed!r}; write it so.")
            listed, of_each = getattr(self, names), getattr(self, units)
            if not listed or len(set(listed)) < len(listed):
                raise UsageError(f"Expected {name}.{names} with a name for each, got {listed!r}; declare them.")
            if len(of_each) != len(listed):
                raise UsageError(
                    f"Expected one unit for each of the {len(listed)} {name}.{names}, got {len(of_each)}; "
                    f"declare {units}."
                )
        for attribute in ("angles", "constants"):
            listed = getattr(self, attribute)
            if not all(isinstance(i, int) and 0 <= i < self.n for i in listed):
                raise UsageError(f"Expected {name}.{attribute} as indices of states, got {listed!r}; count from 0.")

    def _refuse_hidden_names(self) -> None:
        base, name = ControlAffineSystem, type(self).__name__
        for attribute in dir(base):
            if not attribute.startswith("_") and callable(getattr(base, attribute)):
                value = getattr(self, attribute)
                if not callable(value):
                    raise UsageError(
                        f"Expected {name}.{attribute} as the function that every system has, got {value!r}; "
                        f"{attribute} is a reserved name: give the attribute another one."
                    )
        for attribute, what, kind in (
            ("n", "the number of states", int), ("m", "the number of controls", int), ("title", "a text", str),
        ):  # fmt: skip
            value = inspect.getattr_static(self, attribute)
            if not isinstance(value, property | kind) or isinstance(value, bool):
                raise UsageError(
                    f"Expected {name}.{attribute} as {what}, got {value!r}; {attribute} is a reserved name: give the "
                    "attribute another one."
                )

    @property
    def state_labels(self) -> list[str]:
        """Names with units, as in "pole angle (rad)"."""
        return _with_units(self.state_names, self.state_units)

    @property
    def control_labels(self) -> list[str]:
        """Names with units, as in "force (N)"."""
        return _with_units(self.control_names, self.control_units)


class MechanicalSystem(ControlAffineSystem):
    """M(q)q̈ = Bu + h(q, q̇) − D q̇ with x = (q, q̇): the manipulator equation.

    h collects Coriolis, centrifugal and gravity forces; D = diag(damping). Hence
    f = (q̇, M⁻¹(h − D q̇)) and g = (0, M⁻¹B).
    Source: Tedrake, Underactuated Robotics, ch. 1.
    """

    B: Float[Tensor, "d m"]
    D: Float[Tensor, " d"]

    def __init__(self, actuation: Sequence[Sequence[float]], damping: Sequence[float]):
        super().__init__()
        if not all(isinstance(d, int | float) and 0 <= d < math.inf for d in damping):
            raise ValueError(f"Expected damping ≥ 0, got {list(damping)}; friction takes energy away.")
        self.register_buffer("B", torch.tensor(actuation, dtype=torch.get_default_dtype()), persistent=False)
        self.register_buffer("D", torch.tensor(damping, dtype=torch.get_default_dtype()), persistent=False)

    @abstractmethod
    def mass_matrix(self, q: Coordinates) -> MassMatrix:
        """M(q), (*batch, d, d), symmetric positive definite."""

    @abstractmethod
    def forces(self, q: Coordinates, qdot: Coordinates) -> Coordinates:
        """h(q, q̇), (*batch, d): all forces but control and friction, in N or N·m."""

    def kinetic_energy(self, q: Coordinates, qdot: Coordinates) -> PerState:
        """½ q̇ᵀM(q)q̇ in J."""
        return (apply(self.mass_matrix(q), qdot) * qdot).sum(-1) / 2

    def _split(self, x: State) -> tuple[Coordinates, Coordinates]:
        d = self.n // 2
        return x[..., :d], x[..., d:]

    def _accelerate(self, q: Coordinates, qdot: Coordinates, force: Coordinates) -> State:
        """(q̇, q̈) under a generalised force, friction included."""
        qddot = solve(self.mass_matrix(q), (force - self.D * qdot)[..., None])[..., 0]
        return torch.cat([qdot, qddot], -1)

    def f(self, x: State) -> State:
        q, qdot = self._split(x)
        return self._accelerate(q, qdot, self.forces(q, qdot))

    def g(self, x: State) -> InputMatrix:
        q, _ = self._split(x)
        MinvB = self._solve_actuation(q)
        return torch.cat([torch.zeros_like(MinvB), MinvB], -2)

    def dynamics(self, x: State, u: Control) -> State:
        # One solve instead of the three of f + g u; a test holds the two equal.
        q, qdot = self._split(x)
        return self._accelerate(q, qdot, self.forces(q, qdot) + apply(self.B, u))

    def inverse_mass(self, x: State) -> ControlMatrix:
        """BᵀM(q)⁻¹B: the control weight R of the reference tasks."""
        q, _ = self._split(x)
        return multiply(self.B.mT, self._solve_actuation(q))

    def _solve_actuation(self, q: Coordinates) -> Tensor:
        """M⁻¹B, (*batch, d, m)."""
        # expanded: torch would take a (d, d) B beside a batch of d matrices for a batch of vectors
        return solve(self.mass_matrix(q), self.B.expand(*q.shape[:-1], *self.B.shape))


def _with_units(names: Sequence[str], units: Sequence[str]) -> list[str]:
    return [f"{name} ({unit})" if unit else name for name, unit in zip(names, units, strict=True)]


def require_positive(**parameters: float) -> None:
    """Refuse physical parameters that are not positive, naming the first one."""
    for name, value in parameters.items():
        if not (isinstance(value, int | float) and 0 < value < math.inf):
            raise ValueError(f"Expected {name} > 0, got {value!r}; give it in SI units.")
