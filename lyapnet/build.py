"""From a config to the objects it names."""

import copy
import importlib
import inspect
import math
import sys
from collections.abc import Callable, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lyapnet.calculus import ValueFunction
from lyapnet.config import Config, ControlsConfig, CostConfig, SystemConfig
from lyapnet.contracts import initialised, remedy
from lyapnet.cost import COSTS, Cost, QuadraticCost
from lyapnet.errors import LyapnetError, UsageError, did_you_mean, raised
from lyapnet.networks import NETWORKS, IgnoringStates, Scaling, TerminalAnchor
from lyapnet.policy import POLICIES
from lyapnet.problem import Horizon, Problem
from lyapnet.programs import PROGRAMS, Program
from lyapnet.rollout import Rollout
from lyapnet.sets import CONTROL_SETS, Box, ControlBox, ControlSet
from lyapnet.systems import SYSTEMS, ControlAffineSystem, Linear

DTYPES = {"float64": torch.float64, "float32": torch.float32}


@dataclass(frozen=True)
class Parts:
    """The user's own parts, taken in the place of those that a config names; None: the config's."""

    system: ControlAffineSystem | None = None
    cost: Cost | None = None
    controls: ControlSet | None = None
    network: type[ValueFunction] | None = None
    program: Program | None = None


# section of a config ↦ (what is registered, what a class of the user's own derives from)
REGISTRIES: dict[str, tuple[Mapping[str, type], type]] = {
    "system": (SYSTEMS, ControlAffineSystem),
    "cost": (COSTS, Cost),
    "controls": (CONTROL_SETS, ControlSet),
    "network": (NETWORKS, ValueFunction),
    "program": (PROGRAMS, Program),
}


def own_parts(config: Config) -> dict[str, str]:
    """The sections whose class is the user's own, with the name of the class."""
    return {part: name for part, (known, _) in REGISTRIES.items() if (name := getattr(config, part).name) not in known}


def parts_of(config: Config) -> Parts:
    """The user's own parts that a config names as module:Class, imported; nothing for what is registered.

    Raises:
        UsageError: no such module or class, or arguments that it does not take.
    """
    return parts_named(config, own_parts(config))


def parts_named(config: Config, names: Mapping[str, str]) -> Parts:
    """Parts by their section and the name of their class, with the other options of a config; as parts_of."""
    config = copy.deepcopy(config)
    for part, name in names.items():
        getattr(config, part).name = name
    builders: dict[str, Callable[[], Any]] = {
        "system": lambda: build_system(config.system),
        "cost": lambda: _build_cost(config.cost),
        "controls": lambda: build_controls(config.controls, build_system(config.system)),
        "network": lambda: _class_of(config, "network"),
        "program": lambda: build_program(config),
    }
    return Parts(**{part: builders[part]() for part in names})


def build_problem(config: Config, parts: Parts | None = None) -> Problem:
    """The problem of a config, in its precision.

    Args:
        parts: taken instead of those that the config names.

    Raises:
        UsageError: a parameter, matrix, bound or dimension does not fit; names the section.
    """
    parts, dtype = parts or Parts(), DTYPES[config.training.precision]
    with _float64_defaults():
        # in float64 for the checks below, and copies: the caller's own parts keep their precision
        system, cost, controls = (copy.deepcopy(initialised(p)) for p in (parts.system, parts.cost, parts.controls))
        system = build_system(config.system) if system is None else system.double()
        system.check_coordinates()
        with _section("initial_states"):
            bounds = (config.initial_states.lower, config.initial_states.upper)
            initial_states = Box(*(_repeated(bound, system.n) for bound in bounds))
            _require_length("initial_states.lower", initial_states.dimension, system)
        with _section("horizon"):
            horizon = Horizon(config.horizon.steps, config.horizon.dt)
        with _section("cost"):
            cost = _build_cost(config.cost, system) if cost is None else cost.double()
        with _section("controls"):
            controls = build_controls(config.controls, system) if controls is None else controls.double()
        problem = Problem(system, cost, controls, initial_states, horizon)
        problem.check()
        return problem.to(dtype)


def build_system(config: SystemConfig) -> ControlAffineSystem:
    """The system of a config, registered or the user's own."""
    return _with_parameters(config, "system")


def build_controls(config: ControlsConfig, system: ControlAffineSystem) -> ControlSet:
    """The control set of a config: a box where it has limits, else a registered one or the user's own."""
    if config.lower is None and config.upper is None:
        return _with_parameters(config, "controls")
    if config.name != "unbounded" or config.parameters:
        raise UsageError(f"Expected limits or a controls.name, got both ({config.name}); leave one of them out.")
    with _float64_defaults(), _section("controls"):
        lower = _limits("controls.lower", config.lower, -math.inf, system)
        return ControlBox(lower, _limits("controls.upper", config.upper, math.inf, system))


def _limits(key: str, given: Any, none: float, system: ControlAffineSystem) -> list[float]:
    """A limit for each control, from a number, one for all, or a list in which null is none."""
    entries = [none if entry is None else entry for entry in (given if isinstance(given, list) else [given])]
    if not all(type(entry) in (int, float) and not math.isnan(entry) for entry in entries):
        raise UsageError(f"Expected {key} as a number or a list of them, got {given!r}; write null where is no limit.")
    entries = _repeated(entries, system.m)
    _require_length(key, len(entries), system, system.m)
    return entries


def with_parameters(system: ControlAffineSystem, parameters: Mapping[str, Any], like: Tensor) -> ControlAffineSystem:
    """A system of the same class from other arguments, in the precision and on the device of a tensor."""
    with _float64_defaults():
        return type(system)(**parameters).to(like)


def _check_parameters(cls: type, name: str, parameters: Mapping[str, Any], part: str) -> None:
    """Hold the names under a section's parameters against the constructor's arguments."""
    arguments = inspect.signature(cls).parameters.values()
    named = [a for a in arguments if a.kind in (a.POSITIONAL_OR_KEYWORD, a.KEYWORD_ONLY)]
    names = [a.name for a in named]
    open_ended = any(a.kind is a.VAR_KEYWORD for a in arguments)
    for key in parameters:
        if key not in names and not open_ended:
            hint = did_you_mean(key, names, "remove it.", f"{part}.parameters.")
            known = ", ".join(names) or "none"
            raise UsageError(f"Expected parameters of {name} ({known}), got {part}.parameters.{key}; {hint}")
    missing = [a.name for a in named if a.default is a.empty and a.name not in parameters]
    if missing:
        keys = ", ".join(f"{part}.parameters.{key}" for key in missing)
        raise UsageError(f"Expected values for {keys}, got none; {name} has no default for them.")


def _build_cost(config: CostConfig, system: ControlAffineSystem | None = None) -> Cost:
    """The cost of a config; a quadratic one with its shapes held against the system's."""
    if config.name not in COSTS:
        return _with_parameters(config, "cost")
    assert system is not None
    for key in ("Q", "R", "Q_T"):
        if getattr(config, key) is None:
            raise UsageError(
                f"Expected a value for cost.{key}, got none; add it to the config, or cost.{key}=… to the command."
            )
    if config.parameters:
        raise UsageError("Expected no cost.parameters with the quadratic cost, got some; it has Q, R and Q_T.")
    R = _control_weight(config.R, system)
    cost = QuadraticCost(_rows("Q", _repeated(config.Q, system.n)), R, _rows("Q_T", _repeated(config.Q_T, system.n)))
    _require_length("cost.Q", len(cost.Q), system)
    return cost


def _control_weight(R: Any, system: ControlAffineSystem) -> Any:
    """R as a matrix, or as the function of the state that inverse_mass names."""
    if not isinstance(R, str):
        R = _rows("R", _repeated(R, system.m))
        _require_length("cost.R", len(R), system, system.m)
        return R
    if R != "inverse_mass":
        raise ValueError(f"Expected R as a matrix or inverse_mass, got {R!r}; write R as a list of rows.")
    inverse_mass: Callable[[Tensor], Tensor] | None = getattr(system, "inverse_mass", None)
    if inverse_mass is None:
        raise ValueError(
            f"Expected R as a matrix, got inverse_mass, which {type(system).__name__} has not; write R as rows."
        )
    # constant for a linear system: a matrix then, as the Riccati equation needs it
    return inverse_mass(torch.zeros(system.n)) if isinstance(system, Linear) else inverse_mass


def _with_parameters(section: Any, part: str) -> Any:
    """An object of the class that a section names, from its parameters."""
    cls = resolve(section.name, REGISTRIES[part][0], f"{part}.name", REGISTRIES[part][1])
    _check_parameters(cls, section.name, section.parameters, part)
    with _float64_defaults(), _section(f"{part}.parameters of {section.name}"):
        return initialised(cls(**section.parameters))


def _class_of(config: Config, part: str) -> Any:
    """The class that a section of a config names."""
    registry, base = REGISTRIES[part]
    return resolve(getattr(config, part).name, registry, f"{part}.name", base)


def build_value_function(config: Config, problem: Problem, network: type[ValueFunction] | None = None) -> ValueFunction:
    """V(t, x) with fresh weights drawn from the config's seed, in its precision.

    Args:
        network: the class taken instead of the one that the config names.

    Raises:
        UsageError: an option that the network does not have, or a value that it refuses.
    """
    options, n = config.network, problem.system.n
    cls, kept = network or _class_of(config, "network"), _kept_states(config, problem.system)
    angles = [kept.index(angle) for angle in problem.system.angles if angle in kept]
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
    for key in (key for key in chosen if key not in accepted):
        name = {"embedded_angles": "embed_angles"}.get(key, key)
        raise UsageError(f"Expected a network that takes {name}, got {options.name}; remove network.{name}.")
    with _float64_defaults(), torch.random.fork_rng(devices=[]), _section("network"):
        torch.manual_seed(config.seed)
        V = cls(scaling=_scaling(config, problem, kept), **chosen)
        if options.terminal == "exact":
            V = TerminalAnchor(V, _terminal_cost(problem, kept), problem.horizon.duration)
        if len(kept) < n:
            V = IgnoringStates(V, kept, n)
    return V.to(DTYPES[config.training.precision])


def build_rollout(config: Config, problem: Problem, V: ValueFunction) -> Rollout:
    """The closed loop of V under the config's control law, integrator and gradient route.

    Raises:
        UsageError: compile is on for a route that has nothing to compile; or the law does not suit the problem.
    """
    options = config.rollout
    if options.compile == "on" and options.gradient != "discrete":
        raise UsageError(
            f"Expected rollout.gradient=discrete for rollout.compile=on, got {options.gradient}; only that route "
            "compiles: take it, or leave compile at auto."
        )
    with _section("rollout"):
        return Rollout(
            problem, POLICIES[options.policy](problem, V), options.method, options.gradient, options.rtol, options.atol
        )


def build_program(config: Config) -> Program:
    """The program of a config.

    Raises:
        UsageError: an option that the program does not have, or values that contradict each other.
    """
    section = vars(config.program)
    options = {key: value for key, value in section.items() if key not in ("name", "parameters") and value is not None}
    cls = _class_of(config, "program")
    for name in options.keys() - inspect.signature(cls).parameters.keys():
        raise UsageError(f"Expected no program.{name} with the {config.program.name} program, got one; remove it.")
    _check_parameters(cls, config.program.name, config.program.parameters, "program")
    with _section("program"):
        program = cls(**options, **config.program.parameters)
        program.check_terminal(exact=config.network.terminal == "exact")
        return program


def resolve(name: str, registry: Mapping[str, type], key: str, base: type) -> Any:
    """A registered class, or the user's own from module:Class, found from the working directory.

    Raises:
        UsageError: no such module or class, or not a subclass of `base`.
    """
    if name in registry:
        return registry[name]
    module_name, _, class_name = name.partition(":")
    choices = f"one of {', '.join(registry)}, or module:Class" if registry else "module:Class"
    if not class_name:
        hint = did_you_mean(name, registry, f"name the class too, as in {module_name}:Class.")
        raise UsageError(f"Expected {key} as {choices}, got {name!r}; {hint}")
    if (here := str(Path.cwd())) not in sys.path:
        sys.path.insert(0, here)
    try:
        cls = getattr(importlib.import_module(module_name), class_name)
    except (Exception, SystemExit) as error:  # of any kind: the module is the user's
        raise UsageError(
            f"Expected {key} as {choices}, got {name!r} ({raised(error)}); correct the name, or the module."
        ) from error
    if not (isinstance(cls, type) and issubclass(cls, base)):
        raise UsageError(f"Expected {key} as a subclass of {base.__name__}, got {name!r}; derive your class from it.")
    return cls


def _kept_states(config: Config, system: ControlAffineSystem) -> list[int]:
    """The indices of the states that V depends on."""
    names, ignored = list(system.state_names), config.network.ignored_states
    if unknown := [name for name in ignored if name not in names]:
        raise UsageError(
            f"Expected network.ignored_states among {', '.join(names)}, got {unknown[0]!r}; name states of the system."
        )
    if len(set(ignored)) == len(names):
        raise UsageError("Expected V to depend on a state, got all in network.ignored_states; leave some out.")
    return [i for i, name in enumerate(names) if name not in ignored]


def _terminal_cost(problem: Problem, kept: list[int]) -> Cost:
    """φ as a function of the kept states alone, which it has to be."""
    n = problem.system.n
    if not all(problem.cost.ignores_at_end(i, n) for i in range(n) if i not in kept):
        raise UsageError(
            "Expected cost.Q_T without the states in network.ignored_states for terminal=exact, got weights on them."
        )
    return problem.cost if len(kept) == n else problem.cost.restricted_to(kept, n)


def _scaling(config: Config, problem: Problem, kept: list[int]) -> Scaling:
    extent = problem.initial_states.magnitude.double()
    given = entry_per_state("network.state_scale", config.network.state_scale, problem.system)
    scale = given or [v if v > 0 else 1.0 for v in extent.tolist()]
    value = config.network.value_scale
    if value is None:
        value = float(problem.cost.terminal(torch.tensor(scale).to(problem.goal))) or 1.0
    return Scaling([scale[i] for i in kept], problem.horizon.duration, value)


def _rows(name: str, matrix: Any) -> Any:
    """A flat list of numbers as the diagonal matrix it stands for."""
    if not isinstance(matrix, list | tuple):
        raise ValueError(f"Expected {name} as a list of rows, or of the diagonal's numbers, got {matrix!r}.")
    if all(type(entry) in (int, float) for entry in matrix):
        return torch.diag(torch.tensor(matrix, dtype=torch.get_default_dtype()))
    return matrix


def entry_per_state(key: str, entries: list[float] | None, system: ControlAffineSystem) -> list[float] | None:
    """A list with an entry for each state, or with one number for all; None where there is none.

    Raises:
        UsageError: another length; names the key.
    """
    repeated = _repeated(entries, system.n)
    if repeated is not None:
        _require_length(key, len(repeated), system)
    return repeated


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
    """Name the config's section in what a constructor refuses, or what goes wrong in one of the user's own."""
    try:
        yield
    except LyapnetError:
        raise
    except (Exception, SystemExit) as error:
        if str(error).startswith("Expected "):  # lyapnet's own words
            raise UsageError(f"{name}: {error}") from error
        raise UsageError(f"Expected {name} that can be built, got {raised(error)}; {remedy(error)}.") from error


@contextmanager
def _float64_defaults():
    """Build in float64 whatever the precision, so that float32 runs start from the rounded float64 weights."""
    previous = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(previous)
