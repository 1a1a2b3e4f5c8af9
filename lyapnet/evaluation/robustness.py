"""The cost of a controller under disturbances: other initial states, another plant, noise, delay, smaller steps."""

import inspect
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from lyapnet.base.errors import DivergenceError, OracleError
from lyapnet.base.random_streams import TEST, stream
from lyapnet.base.types import Control, State, Time
from lyapnet.controller.controller import Controller
from lyapnet.evaluation.optimality import mean_optimum, ratio_of_means
from lyapnet.evaluation.oracles import oracle_of
from lyapnet.experiment.assembly import is_in_range, ranges_of, with_parameters
from lyapnet.loop.rollout import ADAPTIVE_METHODS, Rollout
from lyapnet.task.family import FamilySystem, parameter_of
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box
from lyapnet.task.systems import ControlSystem

BEYOND = 0.2  # relative change of X₀'s extent and of each physical parameter
EARTH = (9.7, 9.9)  # m/s²: a parameter `gravity` between these is that of the Earth, which does not vary
NOISE = 0.01  # standard deviation of the measured x_i, relative to the largest |x_i| of the undisturbed loop


def physical_parameters(system: ControlSystem, parameters: Mapping[str, Any]) -> dict[str, float]:
    """The parameters that are varied, see `unchanged_parameters`."""
    unchanged = unchanged_parameters(system, parameters)
    return {name: float(value) for name, value in parameters.items() if name not in unchanged}


def unchanged_parameters(system: ControlSystem, parameters: Mapping[str, Any]) -> dict[str, str]:
    """Name ↦ reason of a constructor's arguments that are not varied: all but positive real numbers.

    An integer counts as real if the constructor expects a float, as for a mass of 1 kg, but not for 3 links.
    """
    arguments = inspect.signature(type(system)).parameters

    def reason(name: str, value: Any) -> str:
        if type(value) is not float and not (type(value) is int and arguments[name].annotation in (float, "float")):
            return "no real number"
        if value <= 0:
            return f"{value:g}, not positive"
        return f"{value:g} m/s² of the Earth" if name == "gravity" and EARTH[0] <= value <= EARTH[1] else ""

    return {name: why for name, value in parameters.items() if (why := reason(name, value))}


class Disturbance(NamedTuple):
    """A task that differs from the trained one."""

    name: str
    problem: Problem  # the disturbed problem
    policy: nn.Module  # u(t, x), unaware of the disturbance
    x0: State
    method: str  # integrator of the closed loop


class DisturbanceRow(NamedTuple):
    """The cost of a closed loop under a disturbance."""

    disturbance: str
    cost_mean: float | None  # None: the closed loop diverged
    optimal_cost_mean: float | None  # optimum of the disturbed task without noise; None: no oracle
    cost_ratio: float | None
    optimum_failures: int | None  # states without an optimum, not in the ratio
    terminal_error: float | None  # mean ‖x(T)‖


class NoisyPolicy(nn.Module):
    """u(t, x + w) with w ~ N(0, diag(σ²)), drawn at each call.

    Args:
        policy: u(t, x).
        deviation: σ (n,), in state units.
        generator: random generator of w.
    """

    def __init__(self, policy: nn.Module, deviation: Tensor, generator: torch.Generator):
        super().__init__()
        self.policy, self.deviation, self.generator = policy, deviation, generator
        self.held = getattr(policy, "held", False)

    def forward(self, t: Time, x: State) -> Control:
        noise = torch.randn(x.shape, generator=self.generator, dtype=x.dtype).to(x)
        return self.policy(t, x + self.deviation * noise)


class LatePolicy(nn.Module):
    """A law with a delay of one sample: on [t_n, t_n + Δt) acts the control computed from x_{n−1}, at first u*.

    The control computed from x_n is u(t_n, x_n), or with a prediction u(t_n + Δt, F(x_n, u_n)), where u_n acts
    meanwhile and F is the model's step. Without disturbances the prediction is the best law from t = Δt on.

    Args:
        policy: u(t, x).
        model: the problem of the model.
        predicts: whether the state at which the control will act is predicted.
    """

    held = True

    def __init__(self, policy: nn.Module, model: Problem, predicts: bool):
        super().__init__()
        self.policy, self.model, self.predicts = policy, model, predicts
        self.computed: Control | None = None  # the control that acts next

    def forward(self, t: Time, x: State) -> Control:
        if t.ndim:  # all nodes of a known path at once
            return self.policy(t, x)
        u = self.computed
        if u is None or t == 0:
            u = self.model.rest_at(x)
        horizon = self.model.horizon
        self.computed = (
            self.policy((t + horizon.dt).clamp(max=horizon.duration), self.model.step(x, u)[0])
            if self.predicts
            else self.policy(t, x)
        )
        return u


def disturbances(controller: Controller, samples: int, seed: int) -> Iterator[Disturbance]:
    """The task itself and its disturbances, each from `samples` initial states:

    1. initial states up to 20 % outside X₀, none inside;
    2. each positive physical parameter 20 % lower and higher, see `unchanged_parameters`; policy and cost use the old
       value;
    3. noise of 1 % on the measured state;
    4. a delay of one sample, without and with a prediction by the model, see LatePolicy;
    5. half the Δt;
    6. continuous time. A law for held controls is held for Δt, with fourth order steps, and so is the optimum.
       Another law is evaluated at every t by an adaptive integrator; its optimum uses half the Δt, or Riccati.

    For a family it is the task of one member, see `nominal`. If V accepts the disturbed parameter, there is also the
    task in which V is told its value.
    """
    family = nominal(controller)
    ranges = ranges_of(controller.config, controller.system) if isinstance(controller.system, FamilySystem) else {}
    whole, controller = controller, controller.with_(**family) if family else controller
    X0 = controller.initial_states
    x0 = X0.sample(samples, stream(seed, TEST))
    problem = controller.problem
    undisturbed = Disturbance("none", problem, controller.closed_loop.policy, x0, controller.method)
    yield undisturbed
    yield undisturbed._replace(name=f"x₀ up to {BEYOND:.0%} outside X₀", x0=_outside(X0, samples, stream(seed, TEST)))
    known = controller.parameters
    for name, value in physical_parameters(controller.system, known).items():
        for share in (-BEYOND, BEYOND):
            system = with_parameters(controller.system, {**known, name: value * (1 + share)}, x0)
            yield undisturbed._replace(
                name=f"{name.replace('_', ' ')} {share:+.0%}", problem=problem.replaced(system=system)
            )
            if name in family and is_in_range(ranges[name], value * (1 + share)):
                told = whole.with_(**{**family, name: value * (1 + share)})
                policy = told.closed_loop.policy
                named = f"{name.replace('_', ' ')} {share:+.0%}, told"
                yield undisturbed._replace(name=named, problem=told.problem, policy=policy)
    policy = NoisyPolicy(undisturbed.policy, NOISE * magnitude(controller, x0), stream(seed, TEST))
    yield undisturbed._replace(name=f"noise of {NOISE:.0%} on the state", policy=policy)
    if controller.method not in ADAPTIVE_METHODS:
        for predicts, named in ((False, "u one sample late"), (True, "u one sample late, predicted")):
            late = LatePolicy(undisturbed.policy, problem.without_noise(), predicts)
            yield undisturbed._replace(name=named, policy=late)
    finer = problem.in_steps(steps=2 * problem.horizon.steps, dt=problem.horizon.dt / 2)
    yield undisturbed._replace(name="half the Δt", problem=finer)
    if controller.closed_loop.policy.held:
        if controller.method != "rk4":
            yield undisturbed._replace(name="continuous time, u held for Δt", method="rk4")
    elif controller.method not in ADAPTIVE_METHODS:
        yield undisturbed._replace(name="continuous time", problem=finer, method=ADAPTIVE_METHODS[0])


def nominal(family: Controller) -> dict[str, float]:
    """The nominal member of a family: the parameters of the config, else the middle of each range of p.

    Empty if the task is no family.
    """
    system = family.system
    if not isinstance(system, FamilySystem):
        return {}
    ranges = ranges_of(family.config, system)
    middle = {
        name: math.sqrt(least * greatest) if name in system.weights else (least + greatest) / 2
        for name, (least, greatest) in ranges.items()
    }
    given = {name: parameter_of(system.system, name, middle[name]) for name in middle}
    return {name: value if is_in_range(ranges[name], value) else middle[name] for name, value in given.items()}


def not_varied(controller: Controller) -> dict[str, str]:
    """Name ↦ reason of the parameters, of a family's nominal member, that have no row; see `unchanged_parameters`."""
    family = nominal(controller)
    member = controller.with_(**family) if family else controller
    return unchanged_parameters(member.system, member.parameters)


def robustness(
    controller: Controller,
    samples: int = 64,
    seed: int = 0,
    optimum: bool = True,
    say: Callable[[str], object] = lambda name: None,
) -> list[DisturbanceRow]:
    """The cost under each disturbance, compared with the optimum of the disturbed task.

    Args:
        samples: number of initial states.
        seed: seed of all random draws.
        optimum: whether costs are compared with optima, if there is an oracle.
        say: called with the name of each disturbance before it is measured.

    Raises:
        ValueError: fewer than one sample.
    """
    if samples < 1:
        raise ValueError(f"Expected samples ≥ 1, got {samples}; choose how many initial states to draw.")
    rows = []
    for disturbance in disturbances(controller, samples, seed):
        say(disturbance.name)
        rows.append(_row(disturbance, optimum))
    return rows


def _row(disturbance: Disturbance, optimum: bool) -> DisturbanceRow:
    name, problem, policy, x0, method = disturbance
    problem = problem.without_noise()  # one disturbance at a time
    try:
        with torch.no_grad():
            path = Rollout(problem, policy, method, "backprop")(x0)
    except DivergenceError:
        return DisturbanceRow(name, None, None, None, None, None)
    cost = float(path.cost.mean())
    error = float(torch.linalg.vector_norm(problem.cost.from_goal(path.x[-1]), dim=-1).mean())
    without_optimum = DisturbanceRow(name, cost, None, None, None, error)
    if not optimum:
        return without_optimum
    try:
        optima = oracle_of(problem, method).solve(x0, path.u)
    except OracleError:
        return without_optimum
    return without_optimum._replace(
        optimal_cost_mean=mean_optimum(optima.cost),
        cost_ratio=ratio_of_means(path.cost, optima.cost),
        optimum_failures=optima.failures,
    )


def _outside(X0: Box, samples: int, generator: torch.Generator) -> State:
    """Random states between X₀ and a box that is 20 % larger; moved outwards along rays from the centre."""
    enlarged = Box(X0.center - (1 + BEYOND) * X0.widths / 2, X0.center + (1 + BEYOND) * X0.widths / 2)
    offset = enlarged.sample(samples, generator).to(X0.center) - X0.center
    half = torch.where(X0.widths > 0, X0.widths / 2, 1.0)
    reach = (offset / half).abs().amax(-1, keepdim=True)  # 1 on the boundary of X₀
    stretched = 1 + BEYOND * (reach / (1 + BEYOND))  # (0, 1.2] onto (1, 1.2]
    return X0.center + offset * torch.where(reach > 0, stretched / reach, 0.0)


def magnitude(controller: Controller, x0: State) -> Tensor:
    """The largest |x_i| of the undisturbed closed loop, (n,)."""
    return controller.rollout(x0).x.abs().flatten(0, -2).amax(0)
