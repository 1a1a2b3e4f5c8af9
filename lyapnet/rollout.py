"""Closed-loop integration of the state and its running cost, differentiable in the parameters of V."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torchdiffeq import odeint, odeint_adjoint

from lyapnet.cost import QuadraticCost
from lyapnet.errors import DivergenceError
from lyapnet.systems import ControlAffineSystem
from lyapnet.types import ControlPath, PerState, State, StatePath, Time, Times, ValuePath


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


class Trajectory(NamedTuple):
    """A batch of closed-loop trajectories on the nodes of the horizon."""

    t: Times  # (N + 1,)
    x: StatePath  # (N + 1, *batch, n)
    u: ControlPath  # (N, *batch, m) applied from t_n on; a record, never part of the graph
    running_cost: ValuePath  # (N + 1, *batch): ∫ℓ up to t_n
    terminal_cost: PerState  # (*batch,): φ(x_N)

    @property
    def cost(self) -> Any:  # a tensor, or an array where the fields are arrays
        """J_N = running cost plus terminal cost, (*batch,)."""
        return self.running_cost[-1] + self.terminal_cost

    @property
    def step_cost(self) -> Any:
        """∫ℓ over each step in the integrator's own quadrature, (N, *batch); with Euler, Δt ℓ(x_n, u_n)."""
        return self.running_cost[1:] - self.running_cost[:-1]


class ClosedLoop(nn.Module):
    """The right-hand side of (x, ∫ℓ): d/dt (x, c) = (f + g u, ℓ(x, u)) with u = policy(t, x)."""

    def __init__(self, system: ControlAffineSystem, cost: QuadraticCost, policy: nn.Module):
        super().__init__()
        self.system, self.cost, self.policy = system, cost, policy

    def forward(self, t: Time, y: Tensor) -> Tensor:
        x = y[..., :-1]
        u = self.policy(t, x)
        return torch.cat([self.system.dynamics(x, u), self.cost.running(x, u)[..., None]], -1)


FIXED_STEP_METHODS = ("euler", "midpoint", "rk4")
ADAPTIVE_METHODS = ("dopri5",)
METHODS = FIXED_STEP_METHODS + ADAPTIVE_METHODS
GRADIENTS = ("adjoint", "backprop")


class Rollout(nn.Module):
    """x₀ ↦ Trajectory under u = policy(t, x), by torchdiffeq on the state augmented with the running cost.

    Fixed-step methods take one step from node to node: with Euler, x_{n+1} = x_n + Δt(f + g u) and the cost is J_N.

    Args:
        system, cost, policy, horizon: what is integrated.
        method: a member of METHODS; rk4 is the 3/8 rule, dopri5 chooses its own steps between the nodes.
        gradient: a member of GRADIENTS.
            adjoint: the costate equation ȧ = −aᵀ(f_x + f_u u_x) − (ℓ_x + ℓ_u u_x) is integrated backwards from node
                to node, and ∫(aᵀf_u + ℓ_u)u_θ dt gives the parameters' gradient (Pontryagin's form of the neural-ODE
                adjoint). Memory does not grow with the graph of a step; the gradient is that of the continuous
                problem, so on a fixed grid it differs from the discrete one by O(Δt).
            backprop: automatic differentiation through the steps; the exact gradient of the discretisation.
        rtol, atol: tolerances of adaptive methods.

    Raises:
        ValueError: an unknown method or gradient (torchdiffeq itself would only warn, or fail later).
    """

    def __init__(
        self,
        system: ControlAffineSystem,
        cost: QuadraticCost,
        policy: nn.Module,
        horizon: Horizon,
        method: str = "euler",
        gradient: str = "adjoint",
        rtol: float = 1e-6,
        atol: float = 1e-8,
    ):
        super().__init__()
        for name, value, known in (("method", method, METHODS), ("gradient", gradient, GRADIENTS)):
            if value not in known:
                raise ValueError(f"Expected {name} as one of {', '.join(known)}, got {value!r}; choose one of them.")
        self.closed_loop = ClosedLoop(system, cost, policy)
        self.horizon, self.method, self.gradient = horizon, method, gradient
        self.solver_arguments: dict[str, Any] = {"method": method, "rtol": rtol, "atol": atol}
        if method in ADAPTIVE_METHODS:  # a closed loop that blows up would be followed for ever
            self.solver_arguments["options"] = {"max_num_steps": 10_000}

    def forward(self, x0: State) -> Trajectory:
        """The closed loop from x₀ (*batch, n).

        Raises:
            DivergenceError: a state or cost is not finite; names the step and the initial state. Or an adaptive method,
                which takes its steps for the whole batch, gave up.
        """
        loop, t = self.closed_loop, self.horizon.times(x0)
        y0 = torch.cat([x0, torch.zeros_like(x0[..., :1])], -1)
        y = self._integrate(y0, t)
        _require_finite(y, t)
        x, running_cost = y[..., :-1], y[..., -1]
        with torch.no_grad():
            nodes = t[:-1].reshape(-1, *[1] * (x0.ndim - 1))
            u = loop.policy(nodes, x[:-1])
        return Trajectory(t, x, u, running_cost, loop.cost.terminal(x[-1]))

    def _integrate(self, y0: Tensor, t: Times) -> Tensor:
        """The augmented state at the nodes, by the route of `gradient`."""
        solve: Callable[..., Any] = odeint
        arguments = dict(self.solver_arguments)
        if self.gradient == "adjoint" and torch.is_grad_enabled():
            solve = odeint_adjoint
            arguments |= self._adjoint_arguments()
        try:
            return solve(self.closed_loop, y0, t, **arguments)
        except (
            AssertionError
        ) as error:  # how torchdiffeq says that an adaptive step shrank to nothing, or too many came
            if self.method not in ADAPTIVE_METHODS:
                raise
            message = f"Expected {self.method} to reach t = {t[-1]:.4g} s, got {error}; {_REMEDY}."
            raise DivergenceError(message) from error

    def _adjoint_arguments(self) -> dict[str, Any]:
        arguments: dict[str, Any] = {"adjoint_params": tuple(p for p in self.parameters() if p.requires_grad)}
        if self.method in ADAPTIVE_METHODS:
            # The parameters' gradient is an integral that feeds back into nothing: leaving it out of the error
            # estimate saves steps (Kidger, Chen, Lyons, "Hey, that's not an ODE", ICML 2021).
            arguments["adjoint_options"] = {"norm": "seminorm", **self.solver_arguments["options"]}
        return arguments


_REMEDY = "lower the learning rate or Δt, shorten the horizon, or start closer to the goal"


def _require_finite(y: Tensor, t: Times) -> None:
    finite = torch.isfinite(y).all(-1).reshape(len(t), -1)
    if finite.all():
        return
    broken = torch.nonzero(~finite.all(0)).flatten()
    first_steps = (~finite[:, broken]).int().argmax(0)
    earliest = int(first_steps.argmin())
    step, x0 = int(first_steps[earliest]), y[0].reshape(finite.shape[1], -1)[broken[earliest], :-1]
    raise DivergenceError(
        f"Expected a finite closed loop, got a non-finite state or running cost at step {step} (t = {t[step]:.4g} s) "
        f"from x0 = {[round(v, 6) for v in x0.tolist()]} ({len(broken)} of {finite.shape[1]} trajectories); {_REMEDY}."
    )
