"""The problem: everything that an optimum, a rollout, a certificate or an environment is about."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from lyapnet.cost import Cost
from lyapnet.errors import UsageError
from lyapnet.sets import Box, ControlSet
from lyapnet.systems import ControlAffineSystem
from lyapnet.types import State, Times


@dataclass(frozen=True)
class Horizon:
    """N steps of Δt seconds; T = NΔt.

    Raises:
        ValueError: no step, or Δt not positive.
    """

    steps: int
    dt: float

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise ValueError(f"Expected steps ≥ 1, got {self.steps}; a horizon needs at least one step.")
        if not 0 < self.dt < float("inf"):
            raise ValueError(f"Expected dt > 0, got {self.dt}; give the step length in seconds.")

    @property
    def duration(self) -> float:
        """T in s."""
        return self.steps * self.dt

    def times(self, like: Tensor) -> Times:
        """The nodes t_n = nΔt, n = 0 … N, in the dtype and on the device of a tensor."""
        return torch.arange(self.steps + 1, dtype=like.dtype, device=like.device) * self.dt


class Problem(nn.Module):
    """minimise J(x₀) = ∫₀ᵀ ℓ(x, u) dt + φ(x(T)) over u(t) ∈ U, subject to ẋ = f(x) + g(x)u, for every x₀ ∈ X₀.

    Args:
        system: f and g.
        cost: ℓ and φ.
        controls: U.
        initial_states: X₀.
        horizon: T, and its steps.

    Raises:
        ValueError: X₀ has another dimension than the system.
    """

    def __init__(
        self, system: ControlAffineSystem, cost: Cost, controls: ControlSet, initial_states: Box, horizon: Horizon
    ):
        super().__init__()
        if initial_states.dimension != system.n:
            raise ValueError(
                f"Expected initial_states with {system.n} entries ({', '.join(system.state_names)}), got "
                f"{initial_states.dimension}; give one for each."
            )
        self.system, self.cost, self.controls = system, cost, controls
        self.initial_states, self.horizon = initial_states, horizon

    @property
    def goal(self) -> State:
        """The state (n,) at which q and φ vanish."""
        like = self.initial_states.lower
        return torch.zeros_like(like) if self.cost.goal is None else self.cost.goal.to(like)

    def replaced(self, **parts: Any) -> "Problem":
        """The problem with some of its parts exchanged."""
        own = {name: getattr(self, name) for name in ("system", "cost", "controls", "initial_states", "horizon")}
        return Problem(**{**own, **parts})

    def check(self) -> None:
        """Hold f, g and the cost against their contracts on states of X₀.

        Raises:
            ValueError: naming what is wrong, and where.
        """
        x, m = self.initial_states.sample(256, torch.Generator().manual_seed(0)), self.system.m
        check_system(self.system, x[:3])
        self.cost.check(x)
        R = self.cost.R(x)
        if R.shape != (len(x), m, m):
            raise ValueError(
                f"Expected R(x) of shape {(len(x), m, m)}, got {tuple(R.shape)}; give a row for each control."
            )
        b = torch.randn(len(x), m, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(x)
        u = self.controls.minimise(R, 100 * b)
        inside = u.shape == b.shape and torch.allclose(u, self.controls.project(u), rtol=1e-6, atol=1e-9)
        if not inside:
            raise ValueError(
                f"Expected {type(self.controls).__name__}.minimise(R, b) in the set and of shape {tuple(b.shape)}, got "
                f"{tuple(u.shape)} or a control outside; correct it."
            )


def check_system(system: ControlAffineSystem, x: Tensor) -> None:
    """Hold a system's f and g against their contract on a batch (b, n) of states.

    Raises:
        UsageError: f or g fails, returns another type, dtype or shape, or loses its gradient; or names lack a unit.
    """
    name, n, m = type(system).__name__, system.n, system.m
    if len(system.state_units) != n or len(system.control_units) != m:
        raise UsageError(f"Expected one unit for each state and control name of {name}, got another number of units.")
    x = x.requires_grad_()
    for symbol, function, shape in (("f", system.f, (len(x), n)), ("g", system.g, (len(x), n, m))):
        try:
            value = function(x)
        except (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
            line = " ".join(str(error).split())
            raise UsageError(
                f"Expected {name}.{symbol}(x) for x of shape {tuple(x.shape)}, got {type(error).__name__}: {line}"
            ) from error
        got = (tuple(value.shape), value.dtype) if isinstance(value, Tensor) else type(value).__name__
        if got != (shape, x.dtype):
            raise UsageError(f"Expected {name}.{symbol}(x) as a tensor of {shape} and {x.dtype}, got {got}.")
        moved = not torch.equal(value, function(x.detach() + 1e-3))
        if moved and not value.requires_grad:
            raise UsageError(
                f"Expected {name}.{symbol}(x) differentiable by autograd, got a detached tensor; use torch on x."
            )
