"""The classes named in a config: registered ones, and the user's own."""

import importlib
import inspect
import sys
from collections.abc import Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from lyapnet.base.contracts import remedy, require_initialised
from lyapnet.base.errors import LyapnetError, UsageError, describe_error, did_you_mean
from lyapnet.experiment.config import Config, SystemConfig
from lyapnet.loop.programs import PROGRAMS, Program
from lyapnet.task.constraints import CONSTRAINTS, Constraints
from lyapnet.task.control_sets import CONTROL_SETS
from lyapnet.task.cost import COSTS, Cost, QuadraticCost
from lyapnet.task.models.reading import KINDS
from lyapnet.task.sets import ControlSet
from lyapnet.task.systems import NAMED_SYSTEMS, ControlSystem, EquationSystem
from lyapnet.task.systems.equations import defined
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.networks import NETWORKS

DTYPES = {"float64": torch.float64, "float32": torch.float32}


@dataclass(frozen=True)
class Parts:
    """The user's objects, which replace those named in a config; None: as in the config."""

    system: ControlSystem | None = None
    cost: Cost | None = None
    controls: ControlSet | None = None
    constraints: Constraints | None = None
    network: type[ValueFunction] | None = None
    program: Program | None = None


# section of a config ↦ (registered classes, base class of users' classes)
REGISTRIES: dict[str, tuple[Mapping[str, type], type]] = {
    "system": (NAMED_SYSTEMS, ControlSystem),
    "cost": (COSTS, Cost),
    "controls": (CONTROL_SETS, ControlSet),
    "constraints": (CONSTRAINTS, Constraints),
    "network": (NETWORKS, ValueFunction),
    "program": (PROGRAMS, Program),
}
# section ↦ (the one class that reads these settings, their keys)
SETTINGS_OF_ONE_CLASS: dict[str, tuple[type, Sequence[str]]] = {
    "system": (EquationSystem, ("equations", "states", "controls", "angles", "drawing", "title")),
    "cost": (QuadraticCost, ("Q", "R", "Q_T", "periodic")),
}


def own_parts(config: Config) -> dict[str, str]:
    """Section ↦ name of the class, for the user's own classes."""
    return {part: name for part, (known, _) in REGISTRIES.items() if (name := getattr(config, part).name) not in known}


def resolve(name: str, registry: Mapping[str, type], key: str, base: type) -> Any:
    """A registered class, or the user's own from module:Class, with the working directory on the import path.

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
        module = importlib.import_module(module_name)
        cls = getattr(module, class_name, None)
    except (Exception, SystemExit) as error:  # the module is the user's
        raise UsageError(
            f"Expected {key} as module:Class, got {name!r} ({describe_error(error)}); correct the name, or the module."
        ) from error
    if cls is None:
        classes = [known for known, value in vars(module).items() if isinstance(value, type)]
        hint = did_you_mean(class_name, classes, "correct the name, or the module.", f"{module_name}:")
        raise UsageError(f"Expected {key} as a class of {module_name}, got {name!r}, which does not exist; {hint}")
    if not (isinstance(cls, type) and issubclass(cls, base)):
        raise UsageError(f"Expected {key} as a subclass of {base.__name__}, got {name!r}; derive your class from it.")
    return cls


def class_of(options: Any, part: str) -> Any:
    """The class that a section of a config names, or the class for its equations.

    Raises:
        UsageError: no such class, or a setting that this class does not read.
    """
    registry, base = REGISTRIES[part]
    cls = resolve(options.name, registry, f"{part}.name", base)
    if unread := _unread_settings(options, part):
        keys = ", ".join(f"{part}.{key}" for key in unread)
        raise UsageError(
            f"Expected no {keys} with {part}.name={options.name}, got values, which it does not read; remove them, or "
            f"choose another {part}.name."
        )
    return class_of_equations(options) if cls is EquationSystem else cls


def _unread_settings(options: Any, part: str) -> list[str]:
    """The keys of the settings that a section has, but the class that it names does not read."""
    reader, keys = SETTINGS_OF_ONE_CLASS.get(part, (None, ()))
    if REGISTRIES[part][0].get(options.name) is reader:
        return []
    return [key for key in keys if getattr(options, key) not in (None, "", [], {})]


def section_without_unread_settings(options: Any, part: str) -> Any:
    """A section of a config without the settings that `class_of` refuses."""
    defaults = type(options)()
    return replace(options, **{key: getattr(defaults, key) for key in _unread_settings(options, part)})


def without_unread_settings(config: Config) -> Config:
    """A config without the settings that `class_of` refuses; 0.3 ignored them."""
    sections = {part: getattr(config, part) for part in SETTINGS_OF_ONE_CLASS}
    return replace(
        config, **{part: section_without_unread_settings(options, part) for part, options in sections.items()}
    )


def class_of_equations(options: SystemConfig) -> type[EquationSystem]:
    """The class of the systems with the equations of a config.

    Raises:
        UsageError: there are none.
    """
    if not options.equations:
        advice = "name the model's file in system.file" if options.name in KINDS else "write der(STATE) = … for each"
        raise UsageError(f"Expected system.equations with system.name={options.name}, got none; {advice}.")
    named = {"title": options.title} if options.title else {}
    return defined(
        options.equations,
        options.states,
        options.controls,
        list(options.parameters),
        options.angles,
        drawing=options.drawing,
        **named,
    )


def instance_of(options: Any, part: str) -> Any:
    """An object of the class that a section names, from its parameters."""
    cls = class_of(options, part)
    check_parameters(cls, options.name, options.parameters, part)
    with float64_defaults(), section(f"{part}.parameters of {options.name}"):
        return require_initialised(cls(**options.parameters))


def check_parameters(cls: type, name: str, parameters: Mapping[str, Any], part: str) -> None:
    """Check the names of a section's parameters against the constructor's arguments."""
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


@contextmanager
def section(name: str):
    """Convert errors of constructors to UsageErrors that name the config's section."""
    try:
        yield
    except LyapnetError:
        raise
    except (Exception, SystemExit) as error:
        if str(error).startswith("Expected "):  # raised by lyapnet
            raise UsageError(f"{name}: {error}") from error
        raise UsageError(f"Expected {name} that can be built, got {describe_error(error)}; {remedy(error)}.") from error


@contextmanager
def default_dtype(dtype: torch.dtype):
    """Set torch's default dtype, which is used, for example, by torch.tensor([[0.0], [1 / L]]) in a user's f.

    A command uses one dtype throughout: 1/L in float32 differs by 5e-8 from the value used when building in float64.
    """
    previous = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(previous)


def float64_defaults():
    """Build in float64 for every precision, so that float32 runs start from the rounded float64 weights."""
    return default_dtype(torch.float64)


def default_of(config: Config):
    """Set the dtype of a config's precision as default, for training and evaluation."""
    return default_dtype(DTYPES[config.training.precision])
