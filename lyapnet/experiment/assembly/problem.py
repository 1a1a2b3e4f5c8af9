"""Builds the problem of a config."""

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from lyapnet.base.contracts import copied, require_initialised
from lyapnet.base.errors import LyapnetError, UsageError
from lyapnet.base.types import State
from lyapnet.experiment.assembly.classes import DTYPES, Parts, float64_defaults, instance_of, section
from lyapnet.experiment.assembly.constraints import ball_of, build_constraints, choose_margins
from lyapnet.experiment.assembly.control_costs import KEY, control_costs_of, within_open_limits
from lyapnet.experiment.assembly.domain import in_domain
from lyapnet.experiment.assembly.entries import by_state, index_of, repeated, require_length, rows
from lyapnet.experiment.assembly.family import family_of
from lyapnet.experiment.assembly.free_controls import refuse_free_controls
from lyapnet.experiment.assembly.mapped_controls import (
    refuse_beside_mapped_controls,
    require_rest_in_mapped_controls,
    set_for_target,
)
from lyapnet.experiment.assembly.noise import build_noise, check_risk
from lyapnet.experiment.assembly.outputs import estimator_parts
from lyapnet.experiment.assembly.reference import reference_of, require_points
from lyapnet.experiment.assembly.stationary import without_end
from lyapnet.experiment.assembly.target import Trim, trim, with_target
from lyapnet.experiment.config import Config, ControlsConfig, CostConfig, InitialStatesConfig, SystemConfig
from lyapnet.task.contracts import check_shapes_of_controls, check_shapes_of_cost, check_shapes_of_system
from lyapnet.task.cost import (
    COSTS,
    Cost,
    CostWrapper,
    ObstacleCost,
    PeriodicCost,
    PseudoHuberCost,
    QuadraticCost,
    RegulatorTail,
    TimeCost,
)
from lyapnet.task.horizon import TABLEAUX, Horizon
from lyapnet.task.mapped_controls import MappedControls
from lyapnet.task.problem import TEST_STATES, Problem
from lyapnet.task.sets import Box, ControlBox, ControlSet
from lyapnet.task.systems import ControlSystem, Linear


def build_problem(config: Config, parts: Parts | None = None) -> Problem:
    """The problem of a config, in its precision.

    Args:
        parts: objects that replace those named in the config.

    Raises:
        UsageError: a parameter, matrix, bound or dimension does not fit; names the section.
    """
    parts, dtype = parts or Parts(), DTYPES[config.training.precision]
    with float64_defaults():
        # float64 copies for the checks below; the caller's own parts keep their precision
        given = (parts.system, parts.cost, parts.controls, parts.constraints)
        system, cost, controls, constraints = (copy.deepcopy(require_initialised(part)) for part in given)
        system = build_system(config.system) if system is None else system.double()
        system.check_coordinates()
        initial_states = build_initial_states(config.initial_states, system)
        x = _checked_states(system, initial_states)
        with section("horizon"):
            method = config.rollout.method
            held = method if method in TABLEAUX else "rk4"  # for an adaptive method
            horizon = Horizon(config.horizon.steps, config.horizon.dt, held, config.horizon.stationary)
        if cost is None and config.cost.name in COSTS:
            _refuse_free_controls(config, system, controls, initial_states, horizon)
        with section("cost"):
            cost = build_cost(_cost_section(config), system) if cost is None else cost.double()
            if config.cost.huber is not None and not isinstance(parts.cost, CostWrapper):
                cost = PseudoHuberCost(cost, config.cost.huber)
            if not isinstance(parts.cost, CostWrapper):
                cost = _with_time(config.cost, cost, system)
        check_shapes_of_cost(copied(cost), system.m, x)
        with section("controls"):
            controls = build_controls(config.controls, system) if controls is None else controls.double()
        check_shapes_of_controls(copied(controls), x.new_ones(len(x), system.m))
        if isinstance(controls, MappedControls):
            refuse_beside_mapped_controls(config, controls)
            copied(controls.of(system)).check(x, system.m)
        controls = _with_control_costs(config, cost, controls, system.m)
        require_points(config.reference)
        if config.reference.points:
            system, cost, initial_states = reference_of(config, system, cost, controls, initial_states)
        elif config.family:
            system, cost, initial_states = family_of(
                config, system, cost, controls, initial_states, own_cost=parts.cost is not None
            )
        elif not isinstance(parts.cost, CostWrapper):  # a composite cost from the user is not changed
            cost = with_target(config, cost, system, set_for_target(controls), initial_states)
        if not isinstance(parts.cost, CostWrapper):
            cost = _with_obstacles(config.cost, cost, system)
        problem = Problem(
            system,
            cost,
            controls,
            initial_states,
            horizon,
            noise=build_noise(config, system),
            risk=config.risk,
        )
        require_rest_in_mapped_controls(problem)
        check_risk(config, problem)
        if not config.family and config.cost.name not in COSTS:
            _refuse_free_controls_of_own_cost(problem)
        problem = problem.replaced(constraints=build_constraints(config.constraints, problem, constraints))
        problem.check()
        estimator_parts(config.outputs, problem)  # raises errors in outputs now, because training does not use them
        problem = in_domain(config.domain, problem)
        if problem.constraints is not None and config.constraints.margin is None and config.network.penalty:
            problem.constraints.margin = choose_margins(problem, problem.constraints)
        if horizon.stationary and (config.family or not isinstance(parts.cost, RegulatorTail)):
            problem = without_end(problem)
        return problem.to(dtype)


def operating_point(config: Config, parts: Parts | None = None) -> tuple[ControlSystem, Trim]:
    """The system of a config and the operating point of its target; cost and horizon are not needed.

    Raises:
        UsageError: as build_problem, for these parts.
    """
    parts = parts or Parts()
    with float64_defaults():
        system, controls = (copy.deepcopy(require_initialised(part)) for part in (parts.system, parts.controls))
        system = build_system(config.system) if system is None else system.double()
        system.check_coordinates()
        initial_states = build_initial_states(config.initial_states, system)
        x = _checked_states(system, initial_states)
        with section("controls"):
            controls = build_controls(config.controls, system) if controls is None else controls.double()
        check_shapes_of_controls(copied(controls), x.new_ones(len(x), system.m))
        return system, trim(config, system, set_for_target(controls), initial_states)


def _checked_states(system: ControlSystem, initial_states: Box) -> State:
    """States of X₀ at which f, g and ẋ have the right shapes; a UsageError where they do not."""
    x = initial_states.sample(TEST_STATES, torch.Generator().manual_seed(0))
    check_shapes_of_system(copied(system), x)
    return x


def _cost_section(config: Config) -> CostConfig:
    """The cost section; for a stationary V, which needs no Q_T, with Q_T = Q until φ is computed."""
    if not config.horizon.stationary:
        return config.cost
    if config.cost.Q_T is not None:
        raise UsageError("Expected no cost.Q_T with horizon.stationary, got one; φ is the regulator's: remove it.")
    return replace(config.cost, Q_T=config.cost.Q)


def _refuse_free_controls(
    config: Config, system: ControlSystem, controls: ControlSet | None, initial_states: Box, horizon: Horizon
) -> None:
    """Refuse a quadratic cost whose R has no weight for a limited control; other errors are reported later."""
    try:
        R = torch.as_tensor(_control_weight(config.cost.R, system), dtype=torch.float64)
        if torch.linalg.eigvalsh(R)[0] > 0:
            return
        weighted = build_cost(replace(_cost_section(config), R=1.0), system)
        controls = build_controls(config.controls, system) if controls is None else controls.double()
        if isinstance(controls, MappedControls):
            return
        cost = with_target(config, weighted, system, controls, initial_states)
        problem = Problem(system, cost, controls, initial_states, horizon)
    except (LyapnetError, ValueError, TypeError, RuntimeError):
        return
    refuse_free_controls(problem, R)


def _refuse_free_controls_of_own_cost(problem: Problem) -> None:
    """The same for a user's cost; an R that fails or is no matrix is reported by the check of its contract."""
    try:
        R: Any = problem.cost.R(problem.initial_states.lower[None])
    except Exception:  # the cost is the user's
        return
    if isinstance(R, Tensor) and R.shape == (1, problem.system.m, problem.system.m):
        refuse_free_controls(problem, R)


def build_system(config: SystemConfig) -> ControlSystem:
    """The system of a config, registered or the user's own."""
    return instance_of(config, "system")


def with_parameters(system: ControlSystem, parameters: Mapping[str, Any], like: Tensor) -> ControlSystem:
    """A system of the same class with other arguments, in the precision and on the device of a tensor."""
    with float64_defaults():
        return type(system)(**parameters).to(like)


def build_initial_states(config: InitialStatesConfig, system: ControlSystem) -> Box:
    """X₀ of a config; a single number is a bound for every state."""
    with section("initial_states"):
        bounds = {side: repeated(getattr(config, side), system.n) for side in ("lower", "upper")}
        for side, bound in bounds.items():
            require_length(f"initial_states.{side}", len(bound), system.state_names)
        return Box(**bounds)


def build_cost(config: CostConfig, system: ControlSystem | None = None) -> Cost:
    """The cost of a config; the shapes of a quadratic one are checked against the system."""
    if config.name not in COSTS:
        return instance_of(config, "cost")
    assert system is not None
    if config.time is not None:  # states cost time; φ is the cost of one second near the goal
        at_end = (config.time * _nearness(config, system)).tolist()
        config = replace(
            config, Q=0.0 if config.Q is None else config.Q, Q_T=at_end if config.Q_T is None else config.Q_T
        )
    for key in ("Q", "R", "Q_T"):
        if getattr(config, key) is None:
            raise UsageError(
                f"Expected a value for cost.{key}, got none; add it to the config, or cost.{key}=… to the command."
            )
    if config.parameters:
        raise UsageError("Expected no cost.parameters with the quadratic cost, got some; it has Q, R and Q_T.")
    R = _control_weight(config.R, system)
    weights = {key: rows(key, repeated(getattr(config, key), system.n)) for key in ("Q", "Q_T")}
    for key, weight in weights.items():
        require_length(f"cost.{key}", len(weight), system.state_names)
    cost = QuadraticCost(R=R, **weights)
    return _make_periodic(config.periodic, cost, system) if config.periodic else cost


def _with_control_costs(config: Config, cost: Cost, controls: ControlSet, m: int) -> ControlSet:
    """Add the listed costs of controls to a cost; returns the controls at which they are finite.

    Raises:
        UsageError: the costs and the control set have no known minimiser, or the task is stationary.
    """
    costs = control_costs_of(config.cost, m) or cost.nonquadratic
    if costs is None:
        return controls
    if config.horizon.stationary:
        raise UsageError(
            f"Expected no {KEY} with horizon.stationary, got some; its regulator is computed for uᵀRu alone."
        )
    cost.nonquadratic = costs
    controls = within_open_limits(controls, costs, m)
    with section(KEY):
        costs.require_minimiser(controls, m)
    return controls


def _make_periodic(names: Sequence[str], cost: QuadraticCost, system: ControlSystem) -> Cost:
    """Make a cost periodic in some angles, in which it has to be even."""
    angles = [index_of(name, "cost.periodic", system) for name in names]
    for weight in (cost.Q, cost.Q_T):
        beside = weight[angles] * (1 - torch.eye(system.n)[angles])
        if beside.any():
            raise UsageError("Expected no products of a cost.periodic angle in Q and Q_T, got some; remove them.")
    return PeriodicCost(cost, angles, system.n)


def _with_time(config: CostConfig, cost: Cost, system: ControlSystem) -> Cost:
    """The cost with the cost of time of a config."""
    if config.time is None:
        if config.within:
            raise UsageError("Expected a cost.time with cost.within, got none; give the cost of a second.")
        return cost
    Q = _nearness(config, system)
    near = QuadraticCost(Q=Q, R=torch.eye(1), Q_T=Q)
    near = _make_periodic(config.periodic, near, system) if config.periodic else near
    return TimeCost(cost, near, config.time, system.n)


def _nearness(config: CostConfig, system: ControlSystem) -> Tensor:
    """Q (n, n) with xᵀQx = ½ Σ_i (x_i/w_i)², of the distances w_i of cost.within."""
    widths = by_state(config.within, "cost.within", system)
    if not widths or not all(type(width) in (int, float) and 0 < width < math.inf for width in widths.values()):
        raise UsageError(
            f"Expected cost.within as {{state: distance > 0}} with cost.time, got {config.within}; give the "
            "distance from the goal at which it counts as reached."
        )
    Q = torch.zeros(system.n, system.n)
    for i, width in widths.items():
        Q[i, i] = 1 / (2 * width**2)
    return Q


def _with_obstacles(config: CostConfig, cost: Cost, system: ControlSystem) -> Cost:
    """The cost with the obstacles of a config."""
    for k, given in enumerate(config.obstacles):
        center, radius = ball_of(given, "cost.obstacles", {"center", "radius", "weight"}, system)
        states = [index_of(name, f"cost.obstacles[{k}].center", system) for name in center]
        with section("cost.obstacles"):
            cost = ObstacleCost(cost, states, list(center.values()), radius, given["weight"])
    return cost


def _control_weight(R: Any, system: ControlSystem) -> Any:
    """R as a matrix, or the function inverse_mass of the state."""
    if not isinstance(R, str):
        R = rows("R", repeated(R, system.m))
        require_length("cost.R", len(R), system.control_names)
        return R
    if R != "inverse_mass":
        raise ValueError(f"Expected R as a number, the diagonal's numbers, a list of rows or inverse_mass, got {R!r}.")
    inverse_mass: Callable[[Tensor], Tensor] | None = getattr(system, "inverse_mass", None)
    if inverse_mass is None:
        raise ValueError(
            f"Expected R as a matrix, got inverse_mass, which {type(system).__name__} does not have; write R as rows."
        )
    # constant for a linear system: the Riccati equation needs a matrix
    return inverse_mass(torch.zeros(system.n)) if isinstance(system, Linear) else inverse_mass


def build_controls(config: ControlsConfig, system: ControlSystem) -> ControlSet:
    """The control set of a config: a box if it has limits, else a registered set or the user's own."""
    if config.lower is None and config.upper is None:
        return instance_of(config, "controls")
    refuse_two_sets(config)
    with float64_defaults(), section("controls"):
        lower = _limits("controls.lower", config.lower, -math.inf, system)
        return ControlBox(lower, _limits("controls.upper", config.upper, math.inf, system))


def refuse_two_sets(config: ControlsConfig) -> None:
    """Raise UsageError if a config has both limits and a named set."""
    limited = config.lower is not None or config.upper is not None
    if limited and (config.name != "unbounded" or config.parameters):
        raise UsageError(f"Expected limits or a controls.name, got both ({config.name}); leave one of them out.")


def _limits(key: str, given: Any, none: float, system: ControlSystem) -> list[float]:
    """A limit for each control, from a single number or a list; null means no limit."""
    entries = [none if entry is None else entry for entry in (given if isinstance(given, list) else [given])]
    if not all(type(entry) in (int, float) and not math.isnan(entry) for entry in entries):
        raise UsageError(f"Expected {key} as a number or a list of them, got {given!r}; write null where is no limit.")
    entries = repeated(entries, system.m)
    require_length(key, len(entries), system.control_names)
    return entries
