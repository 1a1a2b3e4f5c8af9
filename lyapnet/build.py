"""From a config to the objects it names."""

import copy
import csv
import importlib
import inspect
import sys
from collections.abc import Callable, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from lyapnet.closed_loop import ClosedLoop
from lyapnet.config import Config, CostConfig, SystemConfig
from lyapnet.cost import QuadraticCost
from lyapnet.errors import UsageError, did_you_mean
from lyapnet.networks import NETWORKS, IgnoringStates, Scaling, TerminalAnchor
from lyapnet.policy import POLICIES
from lyapnet.programs import PROGRAMS, PointwiseCondition, Program
from lyapnet.rollout import Horizon, Rollout
from lyapnet.sets import Box
from lyapnet.systems import SYSTEMS, ControlAffineSystem, Linear

DTYPES = {"float64": torch.float64, "float32": torch.float32}


class Task(NamedTuple):
    """minimise J over u(·) for every x₀ ∈ X₀."""

    system: ControlAffineSystem
    cost: QuadraticCost
    initial_states: Box
    horizon: Horizon


def build_task(config: Config, system: ControlAffineSystem | None = None) -> Task:
    """The task of a config, in its precision.

    Args:
        system: taken instead of the one that the config names.

    Raises:
        UsageError: a parameter, matrix, bound or dimension does not fit; names the section.
    """
    dtype = DTYPES[config.training.precision]
    with _float64_defaults():
        # in float64 for the checks below, and a copy: the caller's system keeps its precision
        system = build_system(config.system) if system is None else copy.deepcopy(system).double()
        with _section("initial_states"):
            bounds = (config.initial_states.lower, config.initial_states.upper)
            initial_states = Box(*(_repeated(bound, system.n) for bound in bounds))
            _require_length("initial_states.lower", initial_states.dimension, system)
        check_system(system, initial_states.sample(3, torch.Generator().manual_seed(0)))
        with _section("cost"):
            cost = build_cost(config.cost, system)
            cost.check(initial_states.sample(256, torch.Generator().manual_seed(0)))
        with _section("horizon"):
            horizon = Horizon(config.horizon.steps, config.horizon.dt)
    return Task(system.to(dtype), cost.to(dtype), initial_states.to(dtype), horizon)


def build_system(config: SystemConfig) -> ControlAffineSystem:
    """The system of a config, registered or the user's own."""
    cls = resolve(config.name, SYSTEMS, "system.name", ControlAffineSystem)
    _check_parameters(cls, config)
    with _float64_defaults(), _section(f"system.parameters of {config.name}"):
        return cls(**config.parameters)


def parameters_of(system: ControlAffineSystem, config: SystemConfig) -> dict[str, Any]:
    """The constructor's arguments, defaults included, of the system of a config; none where they do not fit it."""
    try:
        bound = inspect.signature(type(system)).bind(**config.parameters)
    except TypeError:  # a system of the user's own that was passed in the place of the config's
        return {}
    bound.apply_defaults()
    return dict(bound.arguments)


def physical_parameters(system: ControlAffineSystem, parameters: Mapping[str, Any]) -> dict[str, float]:
    """The positive real numbers among a constructor's arguments; gravity is no property of a system.

    An integer counts where the constructor asks for a float: 1 kg, but not 3 links.
    """
    arguments = inspect.signature(type(system)).parameters
    return {
        name: float(value)
        for name, value in parameters.items()
        if name != "gravity"
        and (type(value) is float or (type(value) is int and arguments[name].annotation in (float, "float")))
        and value > 0
    }


def with_parameters(system: ControlAffineSystem, parameters: Mapping[str, Any], like: Tensor) -> ControlAffineSystem:
    """A system of the same class from other arguments, in the precision and on the device of a tensor."""
    with _float64_defaults():
        return type(system)(**parameters).to(like)


def _check_parameters(cls: type, config: SystemConfig) -> None:
    """Hold the names under system.parameters against the constructor's arguments."""
    arguments = inspect.signature(cls).parameters.values()
    named = [a for a in arguments if a.kind in (a.POSITIONAL_OR_KEYWORD, a.KEYWORD_ONLY)]
    names = [a.name for a in named]
    open_ended = any(a.kind is a.VAR_KEYWORD for a in arguments)
    for name in config.parameters:
        if name not in names and not open_ended:
            hint = did_you_mean(name, names, "remove it.", "system.parameters.")
            known = ", ".join(names) or "none"
            raise UsageError(f"Expected parameters of {config.name} ({known}), got system.parameters.{name}; {hint}")
    missing = [a.name for a in named if a.default is a.empty and a.name not in config.parameters]
    if missing:
        keys = ", ".join(f"system.parameters.{name}" for name in missing)
        raise UsageError(f"Expected values for {keys}, got none; {config.name} has no default for them.")


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


def build_cost(config: CostConfig, system: ControlAffineSystem) -> QuadraticCost:
    """The cost of a config, its shapes held against the system's."""
    R: Any = config.R
    if isinstance(R, str):
        if R != "inverse_mass":
            raise ValueError(f"Expected R as a matrix or inverse_mass, got {R!r}; write R as a list of rows.")
        inverse_mass: Callable[[Tensor], Tensor] | None = getattr(system, "inverse_mass", None)
        if inverse_mass is None:
            raise ValueError(
                f"Expected R as a matrix, got inverse_mass, which {type(system).__name__} does not have; "
                "write R as a list of rows."
            )
        # constant for a linear system: a matrix then, as the Riccati equation needs it
        R = inverse_mass(torch.zeros(system.n)) if isinstance(system, Linear) else inverse_mass
    else:
        R = _rows("R", R)
        _require_length("cost.R", len(R), system, system.m)
    cost = QuadraticCost(_rows("Q", _repeated(config.Q, system.n)), R, _rows("Q_T", _repeated(config.Q_T, system.n)))
    _require_length("cost.Q", len(cost.Q), system)
    return cost


def build_value_function(config: Config, task: Task, network: type[nn.Module] | None = None) -> nn.Module:
    """V(t, x) with fresh weights drawn from the config's seed, in its precision.

    Args:
        network: the class taken instead of the one that the config names.

    Raises:
        UsageError: an option that the network does not have, or a value that it refuses.
    """
    options = config.network
    cls = network or resolve(options.name, NETWORKS, "network.name", nn.Module)
    n, kept = task.system.n, _kept_states(config, task.system)
    angles = [kept.index(angle) for angle in task.system.angles if angle in kept]
    chosen: dict[str, Any] = {
        "hidden": options.hidden,
        "activation": options.activation,
        "epsilon": options.epsilon,
        "embedded_angles": angles if options.embed_angles else None,
    }
    chosen = {key: value for key, value in chosen.items() if value is not None}
    accepted = inspect.signature(cls).parameters
    if "scaling" not in accepted:
        raise UsageError(
            f"Expected a network built as {options.name}(scaling, …), got none; add that argument to __init__."
        )
    for key in chosen:
        if key not in accepted:
            name = {"embedded_angles": "embed_angles"}.get(key, key)
            raise UsageError(f"Expected a network that takes {name}, got {options.name}; remove network.{name}.")
    with _float64_defaults(), torch.random.fork_rng(devices=[]), _section("network"):
        torch.manual_seed(config.seed)
        V = cls(scaling=_scaling(config, task, kept), **chosen)
        if options.terminal == "exact":
            V = TerminalAnchor(V, _terminal_cost(task.cost, kept), task.horizon.duration)
        if len(kept) < n:
            V = IgnoringStates(V, kept, n)
    return V.to(DTYPES[config.training.precision])


def build_rollout(config: Config, task: Task, V: nn.Module) -> Rollout:
    """The closed loop of V under the config's control law, integrator and gradient route.

    Raises:
        UsageError: compile is on for a route that has nothing to compile.
    """
    options = config.rollout
    if options.compile == "on" and options.gradient != "discrete":
        raise UsageError(
            f"Expected rollout.gradient=discrete for rollout.compile=on, got {options.gradient}; only that route "
            "compiles: take it, or leave compile at auto."
        )
    policy = POLICIES[options.policy](task.system, task.cost, V)
    return Rollout(
        task.system, task.cost, policy, task.horizon, options.method, options.gradient, options.rtol, options.atol
    )


def build_program(config: Config) -> Program:
    """The program of a config."""
    options = {key: value for key, value in vars(config.program).items() if key != "name" and value is not None}
    cls = PROGRAMS[config.program.name]
    for name in options.keys() - inspect.signature(cls).parameters.keys():
        raise UsageError(f"Expected no program.{name} with the {config.program.name} program, got one; remove it.")
    bound = config.program.bound or 0
    if config.program.constraint > bound > 0 and config.network.terminal == "free" and bound >= config.program.terminal:
        raise UsageError(
            f"Expected program.terminal > program.bound = {bound:g}, got {config.program.terminal:g}; V(T, ·) would "
            "sink below φ: raise it, or set network.terminal=exact."
        )
    with _section("program"):
        return cls(**options)


def build_pointwise(config: Config, task: Task, V: nn.Module, closed_loop: ClosedLoop) -> PointwiseCondition | None:
    """The program's condition off the closed loops; None without weight.

    Raises:
        UsageError: a region or a file of counterexamples that does not fit the system.
    """
    options = config.pointwise
    if not options.weight:
        return None
    n, lower = task.system.n, task.initial_states.lower
    extent = _repeated(options.region, n) or (1.5 * task.initial_states.magnitude).tolist()
    _require_length("pointwise.region", len(extent), task.system)
    if min(extent) <= 0:
        raise UsageError("Expected pointwise.region, got none, and X₀ is thin; give a bound of each |x_i|.")
    region = Box([-bound for bound in extent], extent).to(lower)
    further = None if options.counterexamples is None else _points_of(Path(options.counterexamples), n).to(lower)
    margin = (config.program.margin or 0.0) if config.program.name == "lyapunov" else None
    return PointwiseCondition(closed_loop, V, region, task.horizon.duration, options.points, margin, further)


def _points_of(path: Path, n: int) -> Tensor:
    """The points (t, x) of a CSV file with a header, (k, 1 + n)."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            heading, *lines = csv.reader(file)
        if heading[:1] != ["t"]:
            raise ValueError("no heading t, …")
        rows = [[float(entry) for entry in row] for row in lines]
        points = torch.tensor(rows, dtype=torch.float64) if rows else torch.empty(0, 1 + n)
        if points.shape[-1:] != (1 + n,) or not points.isfinite().all():
            raise ValueError(f"{len(rows)} rows of {points.shape[-1]}, or not finite")
    except (OSError, ValueError) as error:
        raise UsageError(
            f"Expected pointwise.counterexamples as a CSV of rows t, x_1, …, x_{n}, got {str(path)!r} ({error}); "
            "see lyapnet certify --refine."
        ) from error
    return points


def resolve(name: str, registry: Mapping[str, type], key: str, base: type) -> Any:
    """A registered class, or the user's own from module:Class, found from the working directory.

    Raises:
        UsageError: no such module or class, or not a subclass of `base`.
    """
    if name in registry:
        return registry[name]
    module_name, _, class_name = name.partition(":")
    if (here := str(Path.cwd())) not in sys.path:
        sys.path.insert(0, here)
    try:
        cls = getattr(importlib.import_module(module_name), class_name)
    except (ImportError, AttributeError, ValueError) as error:
        raise UsageError(
            f"Expected {key} as one of {', '.join(registry)}, or module:Class, got {name!r} ({error}); "
            "check the spelling and the working directory."
        ) from error
    if not (isinstance(cls, type) and issubclass(cls, base)):
        raise UsageError(f"Expected {key} as a subclass of {base.__name__}, got {name!r}; derive your class from it.")
    return cls


def _kept_states(config: Config, system: ControlAffineSystem) -> list[int]:
    """The indices of the states that V depends on."""
    names, ignored = list(system.state_names), config.network.ignored_states
    for name in ignored:
        if name not in names:
            raise UsageError(
                f"Expected network.ignored_states among {', '.join(names)}, got {name!r}; name states of the system."
            )
    if len(set(ignored)) == len(names):
        raise UsageError("Expected V to depend on a state, got all in network.ignored_states; leave some out.")
    return [i for i, name in enumerate(names) if name not in ignored]


def _terminal_cost(cost: QuadraticCost, kept: list[int]) -> QuadraticCost:
    """φ as a function of the kept states alone, which it has to be."""
    Q_T = cost.Q_T[kept][:, kept]
    if (cost.Q_T != 0).sum() != (Q_T != 0).sum():
        raise UsageError(
            "Expected cost.Q_T without the states in network.ignored_states for terminal=exact, got weights on them."
        )
    return QuadraticCost(cost.Q[kept][:, kept], torch.eye(1), Q_T)


def _scaling(config: Config, task: Task, kept: list[int]) -> Scaling:
    extent = task.initial_states.magnitude.double()
    given = _repeated(config.network.state_scale, task.system.n)
    scale = given or [v if v > 0 else 1.0 for v in extent.tolist()]
    _require_length("network.state_scale", len(scale), task.system)
    value = config.network.value_scale
    if value is None:
        state = torch.tensor(scale, dtype=torch.float64)
        value = float(state @ task.cost.Q_T.double() @ state) or 1.0
    return Scaling([scale[i] for i in kept], task.horizon.duration, value)


def _rows(name: str, matrix: Any) -> Any:
    """A flat list of numbers as the diagonal matrix it stands for."""
    if not isinstance(matrix, list | tuple):
        raise ValueError(f"Expected {name} as a list of rows, or of the diagonal's numbers, got {matrix!r}.")
    if isinstance(matrix, list | tuple) and all(isinstance(v, int | float) for v in matrix):
        return torch.diag(torch.tensor(matrix, dtype=torch.get_default_dtype()))
    return matrix


def _repeated(entries: Any, n: int) -> Any:
    """A list of one number as the number of every state; anything else as it is."""
    alone = isinstance(entries, list | tuple) and len(entries) == 1 and isinstance(entries[0], int | float)
    return [*entries] * n if alone else entries


def _require_length(key: str, length: int, system: ControlAffineSystem, expected: int | None = None) -> None:
    expected = system.n if expected is None else expected
    if length != expected:
        names = ", ".join(system.state_names if expected == system.n else system.control_names)
        raise UsageError(f"Expected {key} with {expected} entries ({names}), got {length}; give one for each.")


@contextmanager
def _section(name: str):
    """Name the config's section in what a constructor refuses."""
    try:
        yield
    except UsageError:
        raise
    except (ValueError, TypeError) as error:
        raise UsageError(f"{name}: {error}") from error


@contextmanager
def _float64_defaults():
    """Build in float64 whatever the precision, so that float32 runs start from the rounded float64 weights."""
    previous = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(previous)
