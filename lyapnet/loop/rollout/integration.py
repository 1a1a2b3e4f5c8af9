"""Closed-loop integration of the state and its running cost, differentiable in the parameters of V."""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from lyapnet.base.errors import DivergenceError
from lyapnet.base.types import ControlPath, PerState, State, StatePath, StepPath, Times, ValuePath
from lyapnet.loop.rollout.closed_loop import ClosedLoop, SteppedLoop
from lyapnet.loop.rollout.discrete_adjoint import DiscreteAdjoint
from lyapnet.loop.rollout.expectations import martingale, surprises
from lyapnet.task.horizon import TABLEAUX, Horizon
from lyapnet.task.noise import Increments
from lyapnet.task.problem import Problem
from lyapnet.task.sets import ControlSet


class Trajectory(NamedTuple):
    """A batch of closed-loop trajectories on the nodes of the horizon."""

    t: Times  # (N + 1,)
    x: StatePath  # (N + 1, *batch, n)
    u: ControlPath  # (N, *batch, m) applied from t_n on; never part of the graph
    running_cost: ValuePath  # (N + 1, *batch): ∫ℓ up to t_n
    terminal_cost: PerState  # (*batch,): φ(x_N)
    value: ValuePath | None  # (N + 1, *batch): V(t_n, x_n), if a V defines the control law

    def applied(self, controls: ControlSet) -> "Trajectory":
        """The trajectory with the controls that act, if its controls are elements of U; see ControlSet.applied."""
        return self._replace(u=controls.applied(self.x[:-1], self.u))

    def require_value(self) -> ValuePath:
        """V along the trajectory.

        Raises:
            ValueError: no V defines the control law.
        """
        if self.value is None:
            raise ValueError("Expected a trajectory under the control law of a V, got another law; use a ValuePolicy.")
        return self.value

    @property
    def cost(self) -> Any:  # a tensor, or an array if the fields are arrays
        """J_N = running cost plus terminal cost, (*batch,)."""
        return self.running_cost[-1] + self.terminal_cost

    @property
    def expected_cost(self) -> PerState:
        """A sample of E J_N given x₀; without noise J_N itself."""
        return self.cost

    def compensated(self) -> "Trajectory":
        """The trajectory without the unpredicted part of V; without noise itself."""
        return self

    @property
    def step_cost(self) -> Any:
        """∫ℓ over each step by the integrator's quadrature, (N, *batch); with Euler, Δt ℓ(x_n, u_n)."""
        return self.running_cost[1:] - self.running_cost[:-1]


class NoisyTrajectory(Trajectory):
    """A batch of trajectories under noise, with the effects of the noise on V.

    Attributes:
        martingale: M = Σ_n V_xᵀσΔW, (*batch,), of mean zero.
        variation: ⟨M⟩ = Σ_n Δt |σᵀV_x|², (*batch,).
        surprise: D_n = V_{n+1} − E[V_{n+1} | x_n], (N, *batch), of mean zero; None if it was not computed. In a task
            with a risk θ > 0 the certainty equivalent replaces E, and exp(θD_n) has mean one.
        risk: θ.
    """

    martingale: PerState
    variation: PerState
    surprise: StepPath | None
    risk: float

    @classmethod
    def of(
        cls, trajectory: Trajectory, martingale: PerState, variation: PerState, surprise: StepPath | None, risk: float
    ) -> "NoisyTrajectory":
        """A trajectory with the effects of its noise."""
        own = cls(*trajectory)
        own.martingale, own.variation, own.surprise, own.risk = martingale, variation, surprise, risk
        return own

    def _replace(self, **fields: Any) -> "NoisyTrajectory":
        return self.of(super()._replace(**fields), self.martingale, self.variation, self.surprise, self.risk)

    @property
    def expected_cost(self) -> PerState:
        """J_N − M, which has the mean of J_N and varies less."""
        return self.cost - self.martingale

    @property
    def exponentials(self) -> tuple[PerState, PerState]:
        """(exp(θ(J_N − V₀)) − Z, Z) in float64, with V₀ = V(0, x₀) and Z = exp(θM − ½θ²⟨M⟩), whose mean is one.

        For the mean g of the first over paths from x₀, (1/θ) log E exp(θJ) = V₀ + log(1 + g)/θ: for any V, and with
        little variance if V is right.
        """
        J, V0, M = (each.double() for each in (self.cost, self.require_value()[0], self.martingale))
        above, moved = self.risk * (J - V0), self.risk * (M - self.risk / 2 * self.variation.double())
        return torch.expm1(above) - torch.expm1(moved), torch.exp(moved)

    def compensated(self) -> Trajectory:
        """The trajectory without the unpredicted part of V, so that programs see expectations over each step.

        V_n − Σ_{k<n} D_k replaces V_n and φ − Σ D_k replaces φ. Then V_{n+1} − V_n becomes E[V_{n+1} | x_n] − V_n, and
        V_n minus the cost to go becomes the sum of the expected residuals from t_n on, which is zero on every path if V
        is the cost to go. Squares of these have no floor from the noise.
        """
        if self.surprise is None:
            return self
        value = self.require_value()
        before = torch.cat([torch.zeros_like(value[:1]), self.surprise.cumsum(0)])
        end = self.terminal_cost - self.surprise.sum(0)
        return Trajectory(self.t, self.x, self.u, self.running_cost, end, value - before)


FIXED_STEP_METHODS = tuple(TABLEAUX)
ADAPTIVE_METHODS = ("dopri5",)
METHODS = FIXED_STEP_METHODS + ADAPTIVE_METHODS
GRADIENTS = ("adjoint", "backprop", "discrete")


class Rollout(nn.Module):
    """x₀ ↦ Trajectory under u = policy(t, x), by torchdiffeq on the state augmented with the running cost.

    Fixed-step methods take one step between nodes: with Euler, x_{n+1} = x_n + Δt(f + g u) and the cost is J_N. With
    noise each step also adds σ(x_n)ΔW_n (see Noise), with gradient discrete alone.

    Args:
        problem, policy: problem and control law of the closed loop.
        method: a member of METHODS; None: that of the horizon. rk4 is the 3/8 rule, dopri5 chooses its own steps
            between the nodes. A law for held controls is held over each step of a fixed-step method; other laws
            are evaluated as u(t, x) at every stage.
        gradient: a member of GRADIENTS.

            * adjoint: the costate equation ȧ = −aᵀ(f_x + f_u u_x) − (ℓ_x + ℓ_u u_x) is integrated backwards from node
              to node, and ∫(aᵀf_u + ℓ_u)u_θ dt gives the parameters' gradient (Pontryagin's form of the neural-ODE
              adjoint). Memory does not grow with the graph of a step. It is the gradient of the continuous problem,
              and differs on a fixed grid from the discrete one by O(Δt).
            * backprop: automatic differentiation through the steps, the exact gradient of the discretisation.
            * discrete: the same exact gradient by the discrete costate equation, see DiscreteAdjoint. Several times
              faster than both, with memory that grows neither with the network nor with the graph of the steps. For
              fixed-step methods only.
        rtol, atol: tolerances of adaptive methods.
        costate_limit: for gradient discrete, largest length of a costate relative to the median of its batch; None: no
            limit, the exact gradient (see DiscreteAdjoint).
        held: whether u is held over each step; None: as the law requires.

    Raises:
        ValueError: an unknown method or gradient (torchdiffeq would only warn, or fail later); discrete with an
            adaptive method, whose steps depend on the state; adjoint with a held law, except for Euler; a costate limit
            below 1, or with another gradient.
    """

    problem: Problem
    closed_loop: ClosedLoop
    stepped: ClosedLoop
    horizon: Horizon
    method: str
    gradient: str
    discrete: DiscreteAdjoint | None

    def __init__(
        self,
        problem: Problem,
        policy: nn.Module,
        method: str | None = None,
        gradient: str = "adjoint",
        rtol: float = 1e-6,
        atol: float = 1e-8,
        costate_limit: float | None = None,
        held: bool | None = None,
    ):
        super().__init__()
        method = problem.horizon.method if method is None else method
        for name, value, known in (("method", method, METHODS), ("gradient", gradient, GRADIENTS)):
            if value not in known:
                raise ValueError(f"Expected {name} as one of {', '.join(known)}, got {value!r}; choose one of them.")
        if gradient == "discrete" and method not in FIXED_STEP_METHODS:
            raise ValueError(
                f"Expected method as one of {', '.join(FIXED_STEP_METHODS)} for gradient discrete, got {method!r}; "
                "choose one of them, or gradient adjoint."
            )
        if costate_limit is not None and not (gradient == "discrete" and costate_limit >= 1):
            raise ValueError(
                f"Expected a costate_limit ≥ 1 of gradient discrete, got {costate_limit} of {gradient}; leave it out."
            )
        wanted = getattr(policy, "held", False) if held is None else held
        held = bool(wanted) and method in FIXED_STEP_METHODS[1:]  # with Euler steps every law is held
        if held and gradient == "adjoint":
            raise ValueError(
                f"Expected gradient discrete or backprop for a law that is held over steps of {method}, got adjoint; "
                "choose one of them: the costate equation of continuous time does not describe a held control."
            )
        self.closed_loop, self.horizon = ClosedLoop(problem, policy), problem.horizon
        self.stepped = SteppedLoop(problem.in_steps(method=method), policy) if held else self.closed_loop
        self.problem, self.method, self.gradient = problem, method, gradient
        step = "euler" if held else method  # SteppedLoop gives the mean over a step of `method`
        self.solver_arguments: dict[str, Any] = {"method": step, "rtol": rtol, "atol": atol}
        if method in ADAPTIVE_METHODS:  # otherwise the integration of a diverging closed loop would not end
            self.solver_arguments["options"] = {"max_num_steps": 10_000}
        self.discrete = None
        if gradient == "discrete":
            steps, dt = self.horizon.steps, self.horizon.dt
            self.discrete = DiscreteAdjoint(self.stepped, steps, dt, step, costate_limit)

    def forward(self, x0: State, increments: Increments | None = None, with_surprises: bool = True) -> Trajectory:
        """The closed loop from x₀ (*batch, n).

        Args:
            increments: ΔW of each step (N, *batch, k), see Noise.draw; None: the loop without its noise.
            with_surprises: whether to compute the surprises, for which V is evaluated at 2k states in each step.

        Raises:
            ValueError: increments of another shape, for a problem without noise, or with another gradient.
            DivergenceError: a state or cost is not finite; names the step and the initial state. Or an adaptive method
                gave up.
        """
        t = self.horizon.times(x0)
        if self.discrete is not None:
            x, running_cost, value, u = self._integrate_discretely(x0, increments)
        elif increments is None:
            x, running_cost, value, u = self._integrate(x0, t)
        else:
            raise ValueError(f"Expected no increments with gradient {self.gradient}, got some; take discrete.")
        _require_finite(x, running_cost, t, noisy=increments is not None)
        trajectory = Trajectory(t, x, u, running_cost, self.closed_loop.cost.terminal(x[-1]), value)
        V, noise = self.closed_loop.V, self.problem.noise
        if increments is None or noise is None or V is None:
            return trajectory
        surprise, value = None, trajectory.require_value()
        if with_surprises:
            surprise = surprises(V, noise, t, x, value, increments, self.problem.risk)
        moved = martingale(V, noise, t, x.detach(), increments)
        return NoisyTrajectory.of(trajectory, *moved, surprise, self.problem.risk)

    @property
    def takes_steps_of_problem(self) -> bool:
        """Whether its steps equal Problem.step, with u held."""
        held = self.stepped is not self.closed_loop
        return self.method == self.problem.horizon.method and (held or self.method == "euler")

    def _integrate_discretely(
        self, x0: State, increments: Increments | None
    ) -> tuple[StatePath, ValuePath, ValuePath | None, ControlPath]:
        """(x, ∫ℓ, V, u) at the nodes, with the gradient by DiscreteAdjoint."""
        assert self.discrete is not None
        flat = None if increments is None else increments.reshape(len(increments), -1, increments.shape[-1])
        path = self.discrete(x0.reshape(-1, x0.shape[-1]), flat)
        x, running_cost, value, u = (y.reshape(len(y), *x0.shape[:-1], *y.shape[2:]) for y in path)
        return x, running_cost, None if self.closed_loop.V is None else value, u

    def _integrate(self, x0: State, t: Times) -> tuple[StatePath, ValuePath, ValuePath | None, ControlPath]:
        """(x, ∫ℓ, V, u) at the nodes, by torchdiffeq."""
        y = self._solve(torch.cat([x0, torch.zeros_like(x0[..., :1])], -1), t)
        x, V = y[..., :-1], self.closed_loop.V
        nodes = t.reshape(-1, *[1] * (x0.ndim - 1))
        with torch.no_grad():
            u = self.closed_loop.policy(nodes[:-1], x[:-1])
        return x, y[..., -1], None if V is None else V(nodes, x), u

    def _solve(self, y0: Tensor, t: Times) -> Tensor:
        """The augmented state at the nodes."""
        from torchdiffeq import odeint, odeint_adjoint  # imported here because it takes 0.3 s

        solve: Callable[..., Any] = odeint
        arguments = dict(self.solver_arguments)
        if self.gradient == "adjoint" and torch.is_grad_enabled():
            solve = odeint_adjoint
            arguments |= self._adjoint_arguments()
        try:
            return solve(self.stepped, y0, t, **arguments)
        except AssertionError as error:  # raised by torchdiffeq for a step size of 0 or too many steps
            if self.method not in ADAPTIVE_METHODS:
                raise
            message = f"Expected {self.method} to reach t = {t[-1]:.4g} s, got {error}; {_REMEDY}."
            raise DivergenceError(message) from error

    def _adjoint_arguments(self) -> dict[str, Any]:
        arguments: dict[str, Any] = {"adjoint_params": tuple(p for p in self.parameters() if p.requires_grad)}
        if self.method in ADAPTIVE_METHODS:
            # The parameters' gradient is a pure integral. Excluding it from the error estimate saves steps (Kidger,
            # Chen, Lyons, "Hey, that's not an ODE", ICML 2021).
            arguments["adjoint_options"] = {"norm": "seminorm", **self.solver_arguments["options"]}
        return arguments


_REMEDY = (
    "lower the learning rate or Δt, shorten the horizon, or start closer to the goal; lyapnet check says how stiff the "
    "control law is, and from where on X₀ the start is finite"
)


def _require_finite(x: StatePath, running_cost: ValuePath, t: Times, noisy: bool) -> None:
    finite = (torch.isfinite(x).all(-1) & torch.isfinite(running_cost)).reshape(len(t), -1)
    if finite.all():
        return
    broken = torch.nonzero(~finite.all(0)).flatten()
    first_steps = (~finite[:, broken]).int().argmax(0)
    earliest = int(first_steps.argmin())
    step, x0 = int(first_steps[earliest]), x[0].reshape(finite.shape[1], -1)[broken[earliest]]
    remedy = f"{_REMEDY}; or noise is too strong for Δt" if noisy else _REMEDY
    raise DivergenceError(
        f"Expected a finite closed loop, got a non-finite state or running cost at step {step} (t = {t[step]:.4g} s) "
        f"from x0 = {[round(v, 6) for v in x0.tolist()]} ({len(broken)} of {finite.shape[1]} trajectories); {remedy}."
    )
