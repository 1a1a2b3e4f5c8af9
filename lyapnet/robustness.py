"""What a controller costs where its assumptions fail: other initial states, another plant, noise, a finer grid."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lyapnet.build import parameters_of, physical_parameters, with_parameters
from lyapnet.controller import Controller
from lyapnet.errors import DivergenceError, OracleError
from lyapnet.oracles import oracle_of
from lyapnet.randomness import TEST, stream
from lyapnet.rollout import Horizon, Rollout, Trajectory
from lyapnet.sets import Box
from lyapnet.systems import ControlAffineSystem
from lyapnet.types import Control, State, Time

BEYOND = 0.2  # of X₀'s extent, and of each physical parameter
NOISE = 0.01  # of the largest |x_i| of the undisturbed closed loop, standard deviation at each evaluation of the policy


class Disturbance(NamedTuple):
    """One way in which the task at hand is not the task of the training."""

    name: str
    system: ControlAffineSystem  # the plant
    policy: nn.Module  # u(t, x), which knows nothing of it
    horizon: Horizon
    x0: State


class Row(NamedTuple):
    """What a disturbance costs."""

    disturbance: str
    cost_mean: float | None  # of the closed loop; None: it diverged
    optimal_cost_mean: float | None  # of the disturbed task, without noise; None: no oracle
    cost_ratio: float | None
    optimum_failures: int | None  # states without an optimum, left out of the ratio
    terminal_error: float | None  # mean ‖x(T)‖


class NoisyPolicy(nn.Module):
    """u(t, x + w) with w ~ N(0, diag(σ²)), drawn anew at each call.

    Args:
        policy: u(t, x).
        deviation: σ (n,), in state units.
        generator: of the draws.
    """

    def __init__(self, policy: nn.Module, deviation: Tensor, generator: torch.Generator):
        super().__init__()
        self.policy, self.deviation, self.generator = policy, deviation, generator

    def forward(self, t: Time, x: State) -> Control:
        noise = torch.randn(x.shape, generator=self.generator, dtype=x.dtype).to(x)
        return self.policy(t, x + self.deviation * noise)


def disturbances(controller: Controller, samples: int, seed: int) -> Iterator[Disturbance]:
    """The task itself, and every disturbance of it, each from `samples` initial states.

    Those are: initial states up to 20 % outside X₀ and none inside; each positive physical parameter of the system 20 %
    lower and higher, gravity aside, while the policy and the cost keep the old one; noise of 1 % on the state that the
    policy reads; and half the Δt.
    """
    X0 = controller.initial_states
    x0 = X0.sample(samples, stream(seed, TEST))
    task = Disturbance("none", controller.system, controller.closed_loop.policy, controller.horizon, x0)
    yield task
    yield task._replace(name=f"x₀ up to {BEYOND:.0%} outside X₀", x0=_outside(X0, samples, stream(seed, TEST)))
    known = parameters_of(controller.system, controller.config.system)
    for name, value in physical_parameters(controller.system, known).items():
        for share in (-BEYOND, BEYOND):
            system = with_parameters(controller.system, {**known, name: value * (1 + share)}, x0)
            yield task._replace(name=f"{name.replace('_', ' ')} {share:+.0%}", system=system)
    policy = NoisyPolicy(task.policy, NOISE * _magnitude(controller, x0), stream(seed, TEST))
    yield task._replace(name=f"noise of {NOISE:.0%} on the state", policy=policy)
    horizon = Horizon(2 * task.horizon.steps, task.horizon.dt / 2)
    yield task._replace(name="half the Δt", horizon=horizon)


def robustness(
    controller: Controller,
    samples: int = 64,
    seed: int = 0,
    optimum: bool = True,
    say: Callable[[str], object] = lambda name: None,
) -> list[Row]:
    """What each disturbance costs, against the optimum of the disturbed task.

    Args:
        samples: initial states for each.
        seed: of every draw.
        optimum: whether the costs are compared with optima, where there is an oracle.
        say: hears which disturbance is measured.

    Raises:
        ValueError: fewer than one sample.
    """
    if samples < 1:
        raise ValueError(f"Expected samples ≥ 1, got {samples}; choose how many initial states to draw.")
    rows = []
    for disturbance in disturbances(controller, samples, seed):
        say(disturbance.name)
        rows.append(_row(controller, disturbance, optimum))
    return rows


def _row(controller: Controller, disturbance: Disturbance, optimum: bool) -> Row:
    name, system, policy, horizon, x0 = disturbance
    method = controller.config.rollout.method
    try:
        with torch.no_grad():
            trajectory = Rollout(system, controller.cost, policy, horizon, method, "backprop")(x0)
    except DivergenceError:
        return Row(name, None, None, None, None, None)
    cost, error = float(trajectory.cost.mean()), float(torch.linalg.vector_norm(trajectory.x[-1], dim=-1).mean())
    if not optimum:
        return Row(name, cost, None, None, None, error)
    try:
        optimal, ratio, failures = _against_optimum(controller, disturbance, trajectory)
    except OracleError:
        return Row(name, cost, None, None, None, error)
    return Row(name, cost, optimal, ratio, failures, error)


def _against_optimum(
    controller: Controller, disturbance: Disturbance, trajectory: Trajectory
) -> tuple[float | None, float | None, int]:
    """Mean optimum and ratio of the means over the states whose optimum is known, and how many have none."""
    oracle = oracle_of(disturbance.system, controller.cost, disturbance.horizon, controller.config.rollout.method)
    optima = oracle.solve(disturbance.x0, trajectory.u)
    known = torch.isfinite(optima.cost)
    if not known.any():
        return None, None, optima.failures
    optimal = optima.cost[known].mean()
    return float(optimal), float(trajectory.cost[known].mean() / optimal), optima.failures


def _outside(X0: Box, samples: int, generator: torch.Generator) -> State:
    """States of the box 20 % larger than X₀, moved out along the ray from its centre where they are inside."""
    enlarged = Box(X0.center - (1 + BEYOND) * X0.widths / 2, X0.center + (1 + BEYOND) * X0.widths / 2)
    offset = enlarged.sample(samples, generator).to(X0.center) - X0.center
    half = torch.where(X0.widths > 0, X0.widths / 2, 1.0)
    reach = (offset / half).abs().amax(-1, keepdim=True)  # 1 on the boundary of X₀
    stretched = 1 + BEYOND * (reach / (1 + BEYOND))  # (0, 1.2] onto (1, 1.2]
    return X0.center + offset * torch.where(reach > 0, stretched / reach, 0.0)


def _magnitude(controller: Controller, x0: State) -> Tensor:
    """The largest |x_i| of the undisturbed closed loop, (n,)."""
    return controller.rollout(x0).x.abs().flatten(0, -2).amax(0)
