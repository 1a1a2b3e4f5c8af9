"""The base classes of systems: dynamics with named coordinates, control-affine or not."""

import inspect
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from lyapnet.base.errors import UsageError
from lyapnet.base.linear_algebra import apply, multiply, solve
from lyapnet.base.shapes import Shape
from lyapnet.base.types import Control, ControlMatrix, Coordinates, InputMatrix, MassMatrix, PerState, State

HOLDING_STEPS = 20  # Gauss–Newton steps towards the control that holds a state


class ControlSystem(nn.Module, ABC):
    """ẋ = F(x, u) with n states and m controls, which need not be affine in u; see ControlAffineSystem for f + gu.

    A subclass implements `dynamics` with torch operations on tensors of any leading shape, and declares its
    coordinates. Physical parameters are constructor arguments, stored as Python floats or buffers. A subclass may have
    a method `energy(x)`, (*batch,), in J, which is constant for u = 0 without friction. It may also have a method
    `noise(x)`, σ(x) of shape (*batch, n, k) in state units per √s, if it is driven by noise: dx = F dt + σ(x)dW. A
    method `output(x)`, h(x) of shape (*batch, p), says what is measured of a state, if that is not the state itself.
    """

    state_names: Sequence[str] = ()
    state_units: Sequence[str] = ()
    control_names: Sequence[str] = ()
    control_units: Sequence[str] = ()
    angles: Sequence[int] = ()  # indices of the states that are angles in rad, unwrapped
    constants: Sequence[int] = ()  # indices of constant states, the parameters of a family
    contact_lengths: Sequence[
        str
    ] = ()  # attributes with smoothing lengths of contact, which searches for optima enlarge
    settings: Sequence[int] = ()  # states that are given, not measured: targets, the time on a reference

    @abstractmethod
    def dynamics(self, x: State, u: Control) -> State:
        """ẋ, in state units per second."""

    @property
    def affine(self) -> bool:
        """Whether ẋ = f(x) + g(x)u with the methods f and g."""
        return False

    def f(self, x: State) -> State:
        """The drift of a control-affine system; others refuse it.

        Raises:
            UsageError: the system is not control-affine.
        """
        raise _not_affine(self)

    def g(self, x: State) -> InputMatrix:
        """The input matrix of a control-affine system; others refuse it.

        Raises:
            UsageError: the system is not control-affine.
        """
        raise _not_affine(self)

    def affine_model(self, x: State, u: Control) -> tuple[State, InputMatrix]:
        """(F − F_u u, F_u) at (x, u), with which f + gu is the dynamics to first order in u; (f, g) if it is affine.

        F_u is computed by automatic differentiation, and differentiable where gradients are recorded.
        """
        if self.affine:
            return self.f(x), self.g(x)
        recording = torch.is_grad_enabled()
        with torch.enable_grad():
            u = u if recording and u.requires_grad else u.detach().requires_grad_()
            # one copy of (x, u) for each component of ẋ: all rows of the Jacobian in one backward pass
            copies = u.expand(self.n, *u.shape)
            rate = self.dynamics(x.expand(self.n, *x.shape), copies)
            rows = torch.eye(self.n).to(rate).reshape(self.n, *[1] * (rate.ndim - 2), self.n).expand_as(rate)
            (g,) = torch.autograd.grad(rate, copies, rows, create_graph=recording, materialize_grads=True)
            rate, g = rate[0], g.movedim(0, -2)
            parts = rate - apply(g, u), g
        return parts if recording else (parts[0].detach(), parts[1].detach())

    @property
    def reference_time(self) -> int | None:
        """The index of the state that is the time on a reference; None if there is none."""
        return None

    def recurring(self, x: State) -> State:
        """The state with the time on a periodic reference reduced to one period."""
        return x

    def holding_control(self, x: State) -> tuple[Control, State]:
        """The u that holds a state (n,), F(x, u) = 0, as the least squares solution of least norm, and its ẋ.

        By Gauss–Newton steps from u = 0, of which the first is exact for a control-affine system.
        """
        if self.affine:
            f, g = self.f(x), self.g(x)
            u = -apply(torch.linalg.pinv(g), f)
            return u, f + apply(g, u)
        with torch.no_grad():
            u = best = x.new_zeros(self.m)
            least = self.dynamics(x, u).norm()
            for _ in range(HOLDING_STEPS):
                f, g = self.affine_model(x, u)
                u = u - apply(torch.linalg.pinv(g.nan_to_num(0, 0, 0)), (f + apply(g, u)).nan_to_num(0, 0, 0))
                left = self.dynamics(x, u).norm()
                best, least = (u, left) if bool(left < least) else (best, least)
            return best, self.dynamics(x, best)

    def attribute_of(self, parameter: str) -> str:
        """The attribute that holds a parameter of the constructor: by default the one of its name."""
        return parameter

    def draw(self, x: np.ndarray, u: np.ndarray) -> Sequence[Shape]:
        """The shapes of the system in a state (n,) under a control (m,), in a plane in metres; by default none.

        `lyapnet animate` shows them; for a system without shapes it shows a plane of two states.
        """
        return ()

    @property
    def title(self) -> str:
        """The name of the system in tables."""
        return type(self).__name__

    @property
    def noisy(self) -> bool:
        """Whether the system declares noise by a method `noise(x)`.

        Raises:
            UsageError: `noise` is an attribute, not a method.
        """
        name, method = type(self).__name__, callable(getattr(type(self), "noise", None))
        if hasattr(self, "noise") and not method:
            raise UsageError(
                f"Expected {name}.noise as a method, σ(x) of shape (*batch, n, k), got an attribute; write "
                "def noise(self, x), or give the attribute another name if there is no noise."
            )
        return method

    @property
    def has_output(self) -> bool:
        """Whether the system declares its readings by a method `output(x)`."""
        return callable(getattr(type(self), "output", None))

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.state_names)

    @property
    def m(self) -> int:
        """Number of controls."""
        return len(self.control_names)

    def check_coordinates(self) -> None:
        """Check names, units and angles, and that no attribute hides a method, as g = 9.81 would hide g(x).

        Raises:
            UsageError: an attribute is wrong; names it.
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
        for attribute in ("angles", "constants", "settings"):
            listed = getattr(self, attribute)
            if not all(isinstance(i, int) and 0 <= i < self.n for i in listed):
                raise UsageError(f"Expected {name}.{attribute} as indices of states, got {listed!r}; count from 0.")

    def _refuse_hidden_names(self) -> None:
        base, name = ControlSystem, type(self).__name__
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


class ControlAffineSystem(ControlSystem):
    """ẋ = f(x) + g(x)u: a subclass implements f and g instead of the dynamics."""

    @abstractmethod
    def f(self, x: State) -> State:
        """The drift: ẋ at u = 0, in state units per second."""

    @abstractmethod
    def g(self, x: State) -> InputMatrix:
        """The input matrix ∂ẋ/∂u."""

    def dynamics(self, x: State, u: Control) -> State:
        """ẋ = f(x) + g(x)u."""
        return self.f(x) + apply(self.g(x), u)

    @property
    def affine(self) -> bool:
        return True


def _not_affine(system: ControlSystem) -> UsageError:
    return UsageError(
        f"Expected a control-affine system with f(x) and g(x), got {type(system).__name__}, whose dynamics(x, u) need "
        "not be affine in u; derive it from lyapnet.ControlAffineSystem if they are, or leave out what needs f + gu."
    )


def moving_states(system: ControlSystem) -> list[int]:
    """The indices of the states that are neither parameters of a family nor settings, as the time on a reference."""
    return [i for i in range(system.n) if i not in system.constants and i not in system.settings]


def functions_of_state(system: ControlSystem, u: Control) -> dict[str, Callable[[State], Tensor]]:
    """f(x) and g(x) by their names in messages; for a system that is not affine, ẋ under a control (m,)."""
    if system.affine:
        return {"f(x)": system.f, "g(x)": system.g}
    return {"dynamics(x, u)": lambda x: system.dynamics(x, u.to(x).expand(*x.shape[:-1], -1))}


def states_that_are_rates(system: ControlSystem, x: State) -> list[tuple[int, int]]:
    """Pairs (i, j) of states with ẋ_j = x_i whatever the control, such as velocity and position.

    Args:
        x: some states (b, n).
    """
    generator = torch.Generator().manual_seed(1)
    x = x + torch.rand(x.shape, generator=generator, dtype=torch.float64).to(x)  # also in components that X₀ fixes
    u = torch.rand(*x.shape[:-1], system.m, generator=generator, dtype=torch.float64).to(x)
    rates = system.dynamics(x, u)
    return [(i, j) for i in range(system.n) for j in range(system.n) if torch.equal(rates[:, j], x[:, i])]


class MechanicalSystem(ControlAffineSystem):
    """M(q)q̈ = Bu + h(q, q̇) − D q̇ with x = (q, q̇): the manipulator equation.

    h collects Coriolis, centrifugal and gravity forces; D = diag(damping). Hence
    f = (q̇, M⁻¹(h − D q̇)) and g = (0, M⁻¹B).
    Source: Tedrake, Underactuated Robotics, ch. 1.
    """

    dampings: Sequence[str] = ()  # attributes with the entries of D, if families may vary them; empty: D is constant
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

    def friction(self, qdot: Coordinates) -> Coordinates:
        """D q̇, (*batch, d), in N or N·m."""
        if not self.dampings:
            return self.D * qdot
        rates = zip(self.dampings, qdot.unbind(-1), strict=True)
        return torch.stack([getattr(self, name) * rate for name, rate in rates], -1)

    def kinetic_energy(self, q: Coordinates, qdot: Coordinates) -> PerState:
        """½ q̇ᵀM(q)q̇ in J."""
        return (apply(self.mass_matrix(q), qdot) * qdot).sum(-1) / 2

    def _split(self, x: State) -> tuple[Coordinates, Coordinates]:
        d = self.n // 2
        return x[..., :d], x[..., d:]

    def _accelerate(self, q: Coordinates, qdot: Coordinates, force: Coordinates) -> State:
        """(q̇, q̈) under a generalised force, friction included."""
        qddot = solve(self.mass_matrix(q), (force - self.friction(qdot))[..., None])[..., 0]
        return torch.cat([qdot, qddot], -1)

    def f(self, x: State) -> State:
        q, qdot = self._split(x)
        return self._accelerate(q, qdot, self.forces(q, qdot))

    def g(self, x: State) -> InputMatrix:
        q, _ = self._split(x)
        MinvB = self._solve_actuation(q)
        return torch.cat([torch.zeros_like(MinvB), MinvB], -2)

    def dynamics(self, x: State, u: Control) -> State:
        # One linear solve instead of the three of f + g u; a test compares both.
        q, qdot = self._split(x)
        return self._accelerate(q, qdot, self.forces(q, qdot) + apply(self.B, u))

    def inverse_mass(self, x: State) -> ControlMatrix:
        """BᵀM(q)⁻¹B: the control weight R of the reference tasks."""
        q, _ = self._split(x)
        return multiply(self.B.mT, self._solve_actuation(q))

    def _solve_actuation(self, q: Coordinates) -> Tensor:
        """M⁻¹B, (*batch, d, m)."""
        # expanded, because torch would treat a (d, d) B with a batch of d matrices as a batch of vectors
        return solve(self.mass_matrix(q), self.B.expand(*q.shape[:-1], *self.B.shape))


def _with_units(names: Sequence[str], units: Sequence[str]) -> list[str]:
    return [f"{name} ({unit})" if unit else name for name, unit in zip(names, units, strict=True)]


def require_positive(**parameters: float) -> None:
    """Raise ValueError for the first physical parameter that is not positive."""
    for name, value in parameters.items():
        if not (isinstance(value, int | float) and 0 < value < math.inf):
            raise ValueError(f"Expected {name} > 0, got {value!r}; give it in SI units.")
