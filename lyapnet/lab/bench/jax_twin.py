"""An implementation in JAX to compare with: lyapnet's loss and gradient in the simplest form.

Everything is written for one state and vmapped: V_x is `jax.grad` of V, the closed loop one `lax.scan`, the gradient
`jax.value_and_grad` of the loss, and the whole jitted. It covers the HJB policy under Euler with the exact gradient of
the discretisation. JAX is no dependency of lyapnet: this file alone imports it, and lyapnet.lab.bench alone
imports this one, where JAX is installed.

On one thread: set the environment variable NPROC=1 before JAX first computes, or start under `taskset -c 0`. Either
gives XLA's CPU client (JAX 0.10) a pool of one thread, and CPU time is then wall time. The often quoted
XLA_FLAGS="--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1" changes nothing there.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax  # pyright: ignore[reportMissingImports]
import jax.numpy as jnp  # pyright: ignore[reportMissingImports]
import numpy as np
import torch
from torch import Tensor, nn

from lyapnet.base.errors import UsageError
from lyapnet.loop.programs import LyapunovProgram, Program, ValueProgram
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.problem import Problem
from lyapnet.task.systems import Cartpole, DoubleIntegrator, Linear, Reacher
from lyapnet.task.systems.base import MechanicalSystem
from lyapnet.value.networks import (
    ACTIVATIONS,
    FCN,
    AnchoredNetwork,
    GoalAnchor,
    PartiallyConvexNetwork,
    TerminalAnchor,
)

Array = Any  # jax.Array
Parameters = Mapping[str, Array]  # θ, under the names of V.named_parameters()

# Exactly these classes: a subclass may have overridden anything.
_NETWORKS = (FCN, PartiallyConvexNetwork, GoalAnchor, AnchoredNetwork, TerminalAnchor)
_COVERED = (*_NETWORKS, Linear, DoubleIntegrator, Cartpole, Reacher, ValueProgram, LyapunovProgram)
_FUNCTIONS = {"tanh": jnp.tanh, "softplus": jax.nn.softplus, "silu": jax.nn.silu, "sin": jnp.sin}
_ACTIVATIONS = {ACTIVATIONS[name]: function for name, function in _FUNCTIONS.items()}


class Trajectories(NamedTuple):
    """A batch of closed-loop trajectories, in the shapes of lyapnet's Trajectory."""

    x: Array
    u: Array
    running_cost: Array
    value: Array
    terminal_cost: Array


class JaxTwin:
    """program(V, rollout(x₀)).loss and its gradient in the parameters of V.

    Args:
        problem, V, program: what is translated.
        checkpoint: recompute each step in the backward pass (`jax.checkpoint`): less than half the time on a CPU in
            batches of 64 and more, for a user in less of a hurry.

    Raises:
        UsageError: a network, system, control weight or program that has no translation here.
    """

    def __init__(self, problem: Problem, V: nn.Module, program: Program, checkpoint: bool = False):
        networks = [V]
        while isinstance(networks[-1], TerminalAnchor | GoalAnchor):
            networks.append(networks[-1].network)
        for part in (*networks, problem.system, program):
            if type(part) not in _COVERED:
                known = ", ".join(cls.__name__ for cls in _COVERED)
                raise UsageError(f"Expected parts among {known}, got {type(part).__name__}; it has no twin in JAX.")
        inverse_mass = problem.system.inverse_mass if isinstance(problem.system, MechanicalSystem) else None
        cost = problem.cost
        if not isinstance(cost, QuadraticCost) or not problem.has_linear_law:
            raise UsageError(
                "Expected a quadratic cost and controls without limits, got others; they have no twin in JAX."
            )
        if cost.R_constant is None and cost.R_of_state != inverse_mass:
            raise UsageError("Expected R as a matrix or the inverse mass, got a function; it has no twin in JAX.")
        self.problem, self.V, self.program, self.checkpoint = problem, V, program, checkpoint

    def prepare_gradient(self, x0: Tensor) -> Callable[[], tuple[Array, tuple[Array, ...]]]:
        """The compiled (loss, gradient) of a batch (b, n), the gradient in the order of V.parameters()."""
        return self._prepare(jax.value_and_grad(self._loss), x0)

    def prepare_rollout(self, x0: Tensor) -> Callable[[], Trajectories]:
        """The compiled closed loop from a batch (b, n) alone."""
        return self._prepare(self._rollout, x0)

    def _prepare(self, function: Callable[..., Any], x0: Tensor) -> Callable[[], Any]:
        """The function compiled for x₀ and V's present parameters; a call runs it once, to its end, in x₀'s dtype."""
        jitted = jax.jit(function)
        float64 = partial(jax.enable_x64, x0.dtype == torch.float64)  # in this thread, inside the context alone
        with float64():  # copies: asarray may share its memory with torch
            theta, start = tuple(jnp.array(_array(p)) for p in self.V.parameters()), jnp.array(_array(x0))

        def run() -> Any:
            with float64():
                return jax.block_until_ready(jitted(theta, start))

        run()
        return run

    def _loss(self, parameters: tuple[Array, ...], x0: Array) -> Array:
        program, path = self.program, self._rollout(parameters, x0)
        step_cost = jnp.diff(path.running_cost, axis=0)
        violation = jnp.diff(path.value, axis=0) + (1 + getattr(program, "margin", 0)) * step_cost
        penalty = jnp.square if isinstance(program, ValueProgram) else jax.nn.relu
        C, B = penalty(violation).sum(0).mean(), penalty(path.terminal_cost - path.value[-1]).mean()
        remaining = path.running_cost[-1] - path.running_cost + path.terminal_cost
        D, J, V = jnp.square(path.value - remaining).mean(), remaining[0].mean(), path.value[0].mean()
        if program.normalise:
            unit = jax.lax.stop_gradient(J) ** program.degree
            C, B, D, V = C * self.problem.horizon.steps ** (program.degree - 1) / unit, B / unit, D / unit, V / unit
            J = jnp.log(J)
        terms = {"constraint": C, "terminal": B, "trajectory_cost": J, "cost_to_go": D, "bound": V}
        return sum(weight * terms[name] for name, weight in program.weights.items() if weight)

    def _rollout(self, parameters: tuple[Array, ...], x0: Array) -> Trajectories:
        system: Any = self.problem.system
        cost, horizon, V = self.problem.cost, self.problem.horizon, partial(_value, self.V, self._named(parameters))
        t = jnp.arange(horizon.steps + 1, dtype=x0.dtype) * horizon.dt

        def step(node: tuple[Array, Array], t_n: Array) -> Any:
            x, running_cost = node
            value, V_x = jax.value_and_grad(V, 1)(t_n, x)
            g = _g(system, x)
            # BᵀM⁻¹B is Bᵀ times the lower half of g
            R = _array(system.B).T @ g[-len(system.B) :] if cost.R_constant is None else _array(cost.R_constant)
            u = -0.5 * (V_x @ g / R[0] if len(R) == 1 else jnp.linalg.solve(R, V_x @ g))
            rate = x @ _array(cost.Q) @ x + u @ R @ u
            after = x + horizon.dt * _dynamics(system, x, u), running_cost + horizon.dt * rate
            return after, (*node, value, u)

        def of_state(x0: Array) -> Trajectories:
            body = jax.checkpoint(step) if self.checkpoint else step
            (x_N, cost_N), (x, running_cost, value, u) = jax.lax.scan(body, (x0, jnp.zeros_like(x0[0])), t[:-1])
            running_cost, value = jnp.append(running_cost, cost_N), jnp.append(value, V(t[-1], x_N))
            return Trajectories(jnp.append(x, x_N[None], 0), u, running_cost, value, x_N @ _array(cost.Q_T) @ x_N)

        return jax.vmap(of_state, out_axes=Trajectories(1, 1, 1, 1, 0))(x0)

    def _named(self, parameters: tuple[Array, ...]) -> Parameters:
        return {name: p for (name, _), p in zip(self.V.named_parameters(), parameters, strict=True)}


def flat(gradient: tuple[Array, ...]) -> Tensor:
    """A gradient as one float64 vector, to compare with torch's."""
    return torch.cat([torch.tensor(np.asarray(g), dtype=torch.float64).flatten() for g in gradient])


def _array(tensor: Any) -> np.ndarray:
    return tensor.detach().cpu().numpy()


def _value(V: Any, theta: Parameters, t: Array, x: Array) -> Array:
    """V(t, x)."""
    if isinstance(V, TerminalAnchor | GoalAnchor):
        N = partial(_value, V.network, {name.removeprefix("network."): p for name, p in theta.items()}, t)
        if isinstance(V, TerminalAnchor):
            return x @ _array(V.cost.Q_T) @ x + (1 - t / V.duration) * N(x)
        N_0, N_x = jax.value_and_grad(N)(jnp.zeros_like(x))
        return N(x) - N_0 - N_x @ x + V.epsilon * (x @ x)

    def linear(name: str, z: Array) -> Array:
        return theta[f"{name}.weight"] @ z + theta[f"{name}.bias"]

    activation, angles = _ACTIVATIONS[V.activation], x[_array(V.inputs.angles)]
    tau = (2 / V.inputs.duration * t - 1)[None]
    xi = jnp.concatenate([x / _array(V.inputs.state_scale), jnp.sin(angles), jnp.cos(angles)])
    if isinstance(V, FCN):
        z = jnp.append(tau, xi)
        for k in range(len(V.hidden)):
            z = activation(linear(f"hidden.{k}", z))
        return V.value_scale * linear("output", z)[0]
    h = jnp.tanh(linear("time", tau))
    z = activation(theta["through.0.weight"] @ xi + linear("shift.0", h))
    for k in range(1, len(V.through)):
        convex = jax.nn.softplus(theta[f"convex.{k - 1}.raw_weight"]) / len(z)
        z = activation(convex @ z + theta[f"through.{k}.weight"] @ xi + linear(f"shift.{k}", h))
    return V.value_scale / len(z) * jax.nn.softplus(linear("weights", h)) @ z


def _dynamics(system: Any, x: Array, u: Array) -> Array:
    """ẋ = f + gu."""
    if isinstance(system, Linear):
        return _array(system.A) @ x + _array(system.B) @ u
    qdot = x[system.n // 2 :]
    M, h = _manipulator(system, x)
    return jnp.append(qdot, jnp.linalg.solve(M, h + _array(system.B) @ u - _array(system.D) * qdot))


def _g(system: Any, x: Array) -> Array:
    B = _array(system.B)
    if isinstance(system, Linear):
        return B
    return jnp.append(jnp.zeros_like(B), jnp.linalg.solve(_manipulator(system, x)[0], B), 0)


def _manipulator(system: MechanicalSystem, x: Array) -> tuple[Array, Array]:
    """M(q) and h(q, q̇)."""
    _, q2, v1, v2 = x
    if isinstance(system, Cartpole):
        ml, total = system.pole_mass * system.length, system.cart_mass + system.pole_mass
        M = [[total, ml * jnp.cos(q2)], [ml * jnp.cos(q2), ml * system.length]]
        return jnp.array(M), ml * jnp.sin(q2) * jnp.array([v2**2, system.gravity])
    assert isinstance(system, Reacher)
    a2_cos, a3 = system.a2 * jnp.cos(q2), system.a3
    M = jnp.array([[system.a1 + 2 * a2_cos, a3 + a2_cos], [a3 + a2_cos, a3]])
    return M, system.a2 * jnp.sin(q2) * jnp.array([v2 * (2 * v1 + v2), -(v1**2)])
