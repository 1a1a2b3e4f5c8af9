"""The schema of an experiment: one dataclass a section, one sentence a field; and its loading, with clear refusals.

A YAML file lists only what differs from these defaults; `key.sub=value` on the command line comes last.
"""

import dataclasses
import difflib
import math
import operator
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from omegaconf import MISSING, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from lyapnet.errors import UsageError, did_you_mean
from lyapnet.networks import ACTIVATIONS, NETWORKS
from lyapnet.policy import POLICIES
from lyapnet.programs import PROGRAMS
from lyapnet.rollout import GRADIENTS, METHODS
from lyapnet.systems import SYSTEMS

SWITCH = ("auto", "on", "off")


def option(
    default: Any,
    doc: str,
    *,
    choices: Sequence[str] = (),
    user_class: bool = False,
    above: float | None = None,
    at_least: float | None = None,
    below: float | None = None,
) -> Any:
    """A field with its sentence and the values it admits; `user_class` also admits module:Class."""
    bounds = {">": above, "≥": at_least, "<": below}
    rule = {"doc": doc, "choices": tuple(choices), "user_class": user_class, "bounds": bounds}
    if isinstance(default, list | dict):
        return field(default_factory=lambda: type(default)(default), metadata=rule)
    return field(default=default, metadata=rule)


@dataclass
class ProgramConfig:
    """What is minimised; see Program for the loss and its units."""

    name: str = option(MISSING, "The value program or the Lyapunov program.", choices=tuple(PROGRAMS))
    constraint: float = option(1.0, "Weight of the residual (value) or of the hinge (lyapunov).", at_least=0)
    terminal: float = option(0.0, "Weight of the condition on V at t = T.", at_least=0)
    trajectory_cost: float = option(0.0, "Weight of the cost of the closed loop itself.", at_least=0)
    normalise: bool = option(True, "Measure the terms against the batch's mean cost; false for the paper's sums.")
    cost_to_go: float | None = option(None, "Weight of V's distance from the cost to go (value only).", at_least=0)
    margin: float | None = option(None, "Share of ℓ by which the hinge asks for more (lyapunov only).", at_least=0)
    bound: float | None = option(None, "Weight of V(0, x₀), which the hinge makes a bound (lyapunov only).", at_least=0)


@dataclass
class PointwiseConfig:
    """The program's condition off the closed loops, as a certificate asks for it; see PointwiseCondition."""

    weight: float = option(0.0, "Of the condition at points of [0, T] × D.", at_least=0)
    points: int = option(512, "Points of each step.", at_least=2)
    region: list[float] | None = option(None, "D, as a bound of each |x_i|; null: 1.5 times the extent of X₀.", above=0)
    counterexamples: str | None = option(
        None, "A CSV file of further points, a row t, x_1, …, x_n each, as certify --refine writes it."
    )


@dataclass
class SystemConfig:
    """The dynamics ẋ = f(x) + g(x)u."""

    name: str = option(
        MISSING, "A registered system, or module:Class of your own.", choices=tuple(SYSTEMS), user_class=True
    )
    parameters: dict[str, Any] = option({}, "Arguments of its constructor, in SI units.")


@dataclass
class CostConfig:
    """ℓ = xᵀQx + uᵀR(x)u and φ = xᵀQ_T x; a flat list is a diagonal (of one number: all alike), rows are a matrix."""

    Q: Any = option(MISSING, "State weight, symmetric positive semidefinite.")
    R: Any = option(MISSING, "Control weight, symmetric positive definite, or inverse_mass for BᵀM(q)⁻¹B.")
    Q_T: Any = option(MISSING, "Terminal weight, symmetric positive semidefinite.")


@dataclass
class InitialStatesConfig:
    """X₀, the box of initial states; a list of one number is the bound of every state."""

    lower: list[float] = option(MISSING, "Lower bounds, one for each state.")
    upper: list[float] = option(MISSING, "Upper bounds, one for each state.")


@dataclass
class HorizonConfig:
    """N steps of Δt."""

    steps: int = option(MISSING, "N, the number of time steps.", at_least=1)
    dt: float = option(0.01, "Δt in seconds.", above=0)


@dataclass
class NetworkConfig:
    """V(t, x). Fields left at null take the network's own default."""

    name: str = option(
        MISSING, "A registered network, or module:Class of your own.", choices=tuple(NETWORKS), user_class=True
    )
    hidden: list[int] | None = option(None, "Widths of the hidden layers.", at_least=1)
    activation: str | None = option(None, "A smooth activation.", choices=tuple(ACTIVATIONS))
    ignored_states: list[str] = option([], "Names of states on which V does not depend.")
    embed_angles: bool = option(False, "Join sin θ and cos θ of the system's angles to the inputs.")
    epsilon: float | None = option(None, "ε of the term ε‖x‖² (icnn, anchored).", above=0)
    terminal: str = option("free", "exact builds V(T, ·) = φ in.", choices=("free", "exact"))
    state_scale: list[float] | None = option(
        None, "Expected |x|; null: the extent of X₀, 1 where it has none.", above=0
    )
    value_scale: float | None = option(None, "Expected V; null: φ at the state scale.", above=0)


@dataclass
class RolloutConfig:
    """How the closed loop is integrated and differentiated; see Rollout."""

    policy: str = option("hjb", "The control law that V defines.", choices=tuple(POLICIES))
    method: str = option("euler", "The integrator.", choices=METHODS)
    gradient: str = option("adjoint", "The gradient's route.", choices=GRADIENTS)
    compile: str = option(
        "auto", "Run gradient discrete as machine code; auto where that earns its compilation.", choices=SWITCH
    )
    rtol: float = option(1e-6, "Relative tolerance of an adaptive method.", above=0)
    atol: float = option(1e-8, "Absolute tolerance of an adaptive method.", above=0)


@dataclass
class TrainingConfig:
    """The optimisation."""

    iterations: int = option(200, "Gradient steps.", at_least=1)
    batch_size: int = option(64, "Initial states in each step, per process.", at_least=1)
    optimizer: str = option("adam", "adam, or adamw with decoupled weight decay.", choices=("adam", "adamw"))
    learning_rate: float = option(1e-2, "Step size at the start.", above=0)
    final_learning_rate: float = option(1e-4, "Step size at the end of a cosine schedule.", at_least=0)
    beta1: float = option(0.9, "Adam's averaging of the gradient.", at_least=0, below=1)
    beta2: float = option(0.99, "Adam's averaging of the squared gradient.", at_least=0, below=1)
    weight_decay: float = option(0.0, "Of the optimiser.", at_least=0)
    precision: str = option("float64", "Floating-point type of everything.", choices=("float64", "float32"))
    threads: int = option(
        1, "CPU threads; in networks this small, more of them mostly wait for each other.", at_least=1
    )
    validate_every: int = option(10, "Steps between validations, each followed by a checkpoint.", at_least=1)


@dataclass
class EvaluationConfig:
    """What is measured on states that training never sees."""

    validation_states: int = option(64, "States of each validation.", at_least=1)
    test_states: int = option(256, "States of the table at the end of training.", at_least=1)
    optimum: bool = option(True, "Compare with the optimum, where there is an oracle.")
    figures_every: int = option(5, "Validations between figures in TensorBoard; the last one always draws.", at_least=1)
    certify_every: int = option(0, "Validations between statistical bounds in TensorBoard; 0 for none.", at_least=0)
    certified_states: int = option(1000, "Fresh states of each such bound.", at_least=1)
    confidence: float = option(1 - 1e-6, "Of each such bound by itself.", above=0, below=1)


@dataclass
class Config:
    """One experiment."""

    experiment: str = option(MISSING, "Its name: runs go to <logs>/<experiment>/version_<k>.")
    logs: str = option("logs", "The folder of all runs.")
    seed: int = option(0, "Seed of the weights and of every draw of states.", at_least=0)
    seeds: int = option(1, "Runs trained together as one batch, with the seeds seed, seed + 1, …", at_least=1)
    program: ProgramConfig = field(default_factory=ProgramConfig)
    pointwise: PointwiseConfig = field(default_factory=PointwiseConfig)
    system: SystemConfig = field(default_factory=SystemConfig)
    cost: CostConfig = field(default_factory=CostConfig)
    initial_states: InitialStatesConfig = field(default_factory=InitialStatesConfig)
    horizon: HorizonConfig = field(default_factory=HorizonConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    rollout: RolloutConfig = field(default_factory=RolloutConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
    trainer: dict[str, Any] = option({}, "Passed to lightning.Trainer: accelerator, devices, gradient_clip_val, …")
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)


def configs_of_seeds(config: Config) -> list[Config]:
    """The config of each seed's run alone."""
    return [dataclasses.replace(config, seed=config.seed + k, seeds=1) for k in range(config.seeds)]


def label_of(config: Config) -> str:
    """The name of a seed's run within an ensemble."""
    return f"seed_{config.seed}"


def load_config(path: str | Path, overrides: Sequence[str] = ()) -> Config:
    """The config of a YAML file with `key.sub=value` overrides.

    Raises:
        UsageError: no such file, not YAML, an unknown key, a wrong type, a value out of range.
    """
    return config_from_plain(read_yaml(path, Config), overrides)


def read_yaml(path: str | Path, schema: type) -> dict[str, Any]:
    """The content of a YAML file that has some keys of a schema.

    Raises:
        UsageError: no such file, not YAML, or none of the keys.
    """
    try:
        content = OmegaConf.to_container(
            OmegaConf.load(path), resolve=False
        )  # reads 1e-2 as a number; YAML 1.1 does not
    except OSError as error:
        raise UsageError(
            f"Expected a config file, got {str(path)!r} ({error.strerror or error}); see conf/."
        ) from error
    except (yaml.YAMLError, UnicodeDecodeError, OmegaConfBaseException) as error:
        reason = " ".join(str(error).split())
        raise UsageError(f"Expected YAML in {str(path)!r}, got {reason}; correct the file.") from error
    sections = [f.name for f in dataclasses.fields(schema)]
    if not isinstance(content, Mapping) or not any(name in content for name in sections):
        raise UsageError(
            f"Expected a config in {str(path)!r}, got none of its keys ({', '.join(sections)}); see conf/."
        )
    return {str(key): value for key, value in content.items()}


def config_from_plain(content: Mapping[str, Any], overrides: Sequence[str] = ()) -> Config:
    """The config of plain nested dictionaries, checked like a file.

    Raises:
        UsageError: as load_config.
    """
    config = checked(Config, content, overrides)
    # YAML reads on and off as booleans
    config.rollout.compile = {"True": "on", "False": "off"}.get(config.rollout.compile, config.rollout.compile)
    check_values(config)
    return config


Schema = TypeVar("Schema")


def checked(schema: type[Schema], content: Mapping[str, Any], overrides: Sequence[str] = ()) -> Schema:
    """An object of a schema from plain nested dictionaries with overrides: its keys and types, not its values.

    Raises:
        UsageError: an unknown key, a missing one, or a wrong type.
    """
    for override in overrides:
        if "=" not in override.lstrip("="):
            raise UsageError(f"Expected overrides as key.sub=value, got {override!r}; put an = between key and value.")
    try:
        layers = [OmegaConf.create(dict(content)), OmegaConf.from_dotlist(list(overrides))]
        for layer in layers:
            _refuse_unknown_keys(OmegaConf.to_container(layer, resolve=False), schema, "")
        merged = OmegaConf.merge(OmegaConf.structured(schema), *layers)
        config = OmegaConf.to_object(merged)
    except OmegaConfBaseException as error:
        raise UsageError(_explain(error, schema)) from error
    except TypeError as error:  # a section's field changed from a list to a mapping, or back
        raise UsageError(
            f"Expected values of the same kind in file and command, got {' '.join(overrides)!r}."
        ) from error
    except yaml.YAMLError as error:
        raise UsageError(f"Expected a YAML value after =, got {' '.join(overrides)!r}; quote it.") from error
    assert isinstance(config, schema)
    return config


def to_plain(config: Config) -> dict[str, Any]:
    """The config as nested dictionaries, lists, numbers and strings, as a checkpoint holds it."""
    return dataclasses.asdict(config)


def to_yaml(config: Config) -> str:
    """The resolved config as YAML."""
    return OmegaConf.to_yaml(OmegaConf.create(to_plain(config)))


def differing_keys(one: Config, other: Config) -> list[str]:
    """Full names of the fields in which two configs differ."""
    return list(differences(to_plain(one), to_plain(other)))


def differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Full name ↦ both values, where two nested dictionaries differ; None for one that is missing."""
    a, b = dict(_leaves(one)), dict(_leaves(other))
    return {key: (a.get(key), b.get(key)) for key in dict.fromkeys([*a, *b]) if a.get(key) != b.get(key)}


def _leaves(content: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in content.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _refuse_unknown_keys(content: Any, schema: Any, prefix: str) -> None:
    known = {f.name: f for f in dataclasses.fields(schema)}
    for key, value in content.items():
        if key not in known:
            near = difflib.get_close_matches(str(key), known, n=1, cutoff=0.5)
            names = _same_name_elsewhere(str(key), schema) or [prefix + name for name in near]
            hint = f"did you mean {names[0]}?" if names else f"choose one of {', '.join(known)}."
            raise UsageError(f"Expected a key of the schema, got unknown key {prefix}{key}; {hint}")
        section = known[key].type
        if isinstance(section, type) and dataclasses.is_dataclass(section):
            if not isinstance(value, Mapping):
                names = ", ".join(f.name for f in dataclasses.fields(section))
                raise UsageError(
                    f"Expected {prefix}{key} as a section with {names}, got {value!r}; indent its keys below it."
                )
            _refuse_unknown_keys(value, section, f"{prefix}{key}.")
        for entry in get_args(section)[1:]:  # of dict[str, section]
            for name, one in value.items() if dataclasses.is_dataclass(entry) else ():
                _refuse_unknown_keys(one, entry, f"{prefix}{key}.{name}.")


def _annotations(schema: type, prefix: str = "") -> dict[str, Any]:
    """Full name and type of every field."""
    found: dict[str, Any] = {}
    for f in dataclasses.fields(schema):
        if isinstance(f.type, type) and dataclasses.is_dataclass(f.type):
            found |= _annotations(f.type, f"{prefix}{f.name}.")
        else:
            found[f"{prefix}{f.name}"] = f.type
    return found


def _same_name_elsewhere(key: str, schema: type) -> list[str]:
    """The full names of fields of that name: for a key written in the wrong section."""
    return [name for name in _annotations(schema) if name.split(".")[-1] == key]


def _explain(error: OmegaConfBaseException, schema: type) -> str:
    key = error.full_key or "a key"
    if isinstance(error, MissingMandatoryValue):
        return f"Expected a value for {key}, got none; add it to the config file or append {key}=… to the command."
    annotation = _annotations(schema).get(key.split("[")[0])
    kind = annotation.__name__ if type(annotation) is type else annotation or "another type"
    got = str(error).splitlines()[0]
    return f"Expected {key} as {kind}, got: {got}; correct its value."


def check_values(config: Any, prefix: str = "") -> None:
    """Hold every field, and every entry of a section, against the rule it was declared with."""
    for f in dataclasses.fields(config):
        key, value = f"{prefix}{f.name}", getattr(config, f.name)
        entries = {f"{key}.{name}": entry for name, entry in value.items()} if isinstance(value, dict) else {key: value}
        for name, entry in entries.items():
            if dataclasses.is_dataclass(entry):
                check_values(entry, f"{name}.")
            elif f.metadata and entry is not None:
                _check_value(name, entry, f.metadata)


def _check_value(key: str, value: Any, rule: Mapping[str, Any]) -> None:
    choices = rule["choices"]
    if choices and value not in choices and not (rule["user_class"] and ":" in value):
        hint = did_you_mean(str(value), choices, "choose one of them.")
        own = ", or module:Class" if rule["user_class"] else ""
        raise UsageError(f"Expected {key} as one of {', '.join(choices)}{own}, got {value!r}; {hint}")
    holds = {">": operator.gt, "≥": operator.ge, "<": operator.lt}
    bounds = {symbol: bound for symbol, bound in rule["bounds"].items() if bound is not None}
    if bounds and value == []:
        raise UsageError(f"Expected {key} with at least one entry, got none; {rule['doc']}")
    for symbol, bound in bounds.items():
        for number in value if isinstance(value, list) else [value]:
            if not (holds[symbol](number, bound) and math.isfinite(number)):
                raise UsageError(f"Expected {key} {symbol} {bound}, got {value}; {rule['doc']}")
