"""The schema of an experiment, one dataclass for each section with one sentence for each field; and its loading.

A YAML file lists only values that differ from these defaults; `key.sub=value` on the command line has precedence.
"""

import dataclasses
import math
import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from omegaconf import MISSING, OmegaConf

from lyapnet.base.errors import UsageError
from lyapnet.base.sizes import THREADS, check_sizes
from lyapnet.experiment.csv_columns import read_columns
from lyapnet.experiment.recipe import STANDARD, with_recipe
from lyapnet.experiment.schema import Names, check_values, checked, differences, read_yaml, setting
from lyapnet.task.models.reading import KINDS

TEXTS = ("equations", "drawing")  # keys of the section system whose values have many lines
MOST_LINES = 20  # largest number of these lines in tables and in the text of loggers
PLACE = "TEXT"  # placeholder for such a text while the rest is written as YAML

# names of registered classes, loaded lazily: a misspelt key is reported without loading torch
CONSTRAINTS = Names("task.constraints", "CONSTRAINTS")
COSTS = Names("task.cost", "COSTS")
ACTIVATIONS = Names("value.networks", "ACTIVATIONS")
NETWORKS = Names("value.networks", "NETWORKS")
POLICIES = Names("value.policy", "POLICIES")
PROGRAMS = Names("loop.programs", "PROGRAMS")
GRADIENTS = Names("loop.rollout", "GRADIENTS")
METHODS = Names("loop.rollout", "METHODS")
CONTROL_SETS = Names("task.control_sets", "CONTROL_SETS")
CONTROL_COSTS = Names("task.cost.control_costs", "CONTROL_COSTS")
SYSTEMS = Names("task.systems", "NAMED_SYSTEMS")
SWITCH = ("auto", "on", "off")
LOGGERS = ("tensorboard", "csv", "wandb", "mlflow")  # csv: metrics.csv, which every run has


@dataclass
class ProgramConfig:
    """The program, which is minimised; see Program for the loss and its units."""

    name: str = setting(
        MISSING,
        "A registered program, or module:Class of your own.",
        choices=PROGRAMS,
        user_class=True,
    )
    constraint: float = setting(1.0, "Weight of the residual (value) or of the hinge (lyapunov).", at_least=0)
    terminal: float = setting(0.0, "Weight of the condition on V at t = T.", at_least=0)
    trajectory_cost: float = setting(0.0, "Weight of the cost of the closed loop itself.", at_least=0)
    normalise: bool = setting(True, "Divide the terms by the batch's mean cost; false for the paper's sums.")
    cost_to_go: float | None = setting(None, "Weight of V's distance from the cost to go (value only).", at_least=0)
    relative: bool | None = setting(
        None, "Divide that distance by the cost of each trajectory, not by their mean (value only)."
    )
    margin: float | None = setting(None, "Reserve of the hinge, as a share of ℓ (lyapunov only).", at_least=0)
    bound: float | None = setting(None, "Weight of V(0, x₀), the upper bound of the cost (lyapunov only).", at_least=0)
    share: float | None = setting(None, "Smallest decrease of V, as a share of ℓ (region only).", above=0)
    growth: float | None = setting(None, "Weight of the share of D outside the region (region only).", at_least=0)
    steps: bool | None = setting(None, "Whether V is to fall in steps of Δt, not in continuous time (region only).")
    parameters: dict[str, Any] = setting({}, "Further arguments of a program of your own.")


@dataclass
class PointwiseConfig:
    """The program's condition at points off the closed loops; see PointwiseCondition."""

    weight: float | None = setting(
        None, "Weight of the condition at points of [0, T] × D; null: 0, with the region program 5.", at_least=0
    )
    points: int = setting(512, "Points in each step.", at_least=2)
    region: list[float] | None = setting(None, "D, a bound of each |x_i − x*_i|; null: 1.5 times that of X₀.", above=0)
    floor: float | None = setting(
        None,
        "ℓ₀ and φ₀ of it as shares of J̄/T and J̄; null: 0.01, of a stationary V 1e-4.",
        above=0,
    )
    counterexamples: str | None = setting(
        None, "A CSV file of further points, a row t, x_1, …, x_n each, as certify --refine writes it."
    )


@dataclass
class SystemConfig:
    """The dynamics ẋ = f(x) + g(x)u."""

    name: str = setting(
        MISSING,
        "A registered system, or module:Class of your own.",
        choices=SYSTEMS,
        user_class=True,
    )
    parameters: dict[str, Any] = setting({}, "Arguments of its constructor, in SI units.")
    file: str = setting("", "File of a model for casadi, found from the folder of the YAML; it is read into equations.")
    equations: str = setting(
        "", "A line der(STATE) = expression for each state, and lines NAME = expression before them.", lines=True
    )
    states: dict[str, str] = setting({}, "Name and unit of each state of the equations, in their order.")
    controls: dict[str, str] = setting({}, "Name and unit of each control, likewise.")
    angles: list[str] = setting([], "Names of the states of the equations that are angles in rad.")
    drawing: str = setting(
        "", "Shapes of the equations' system: lines line(x, y, …), faint, polygon, disk and arrow, in m.", lines=True
    )
    title: str = setting("", "What a system of equations is called in tables and messages; of a file, the file's name.")


@dataclass
class CostConfig:
    """ℓ = xᵀQx + uᵀR(x)u and φ = xᵀQ_T x; a flat list is a diagonal (one number: repeated), rows are a matrix."""

    name: str = setting("quadratic", "quadratic, or module:Class of your own.", choices=COSTS, user_class=True)
    Q: Any = setting(None, "State weight, symmetric positive semidefinite.")
    R: Any = setting(None, "Control weight, symmetric positive definite, or inverse_mass for BᵀM(q)⁻¹B.")
    Q_T: Any = setting(None, "Terminal weight, symmetric positive semidefinite.")
    periodic: list[str] = setting([], "Names of angles δ for which 2(1 − cos δ) replaces δ².")
    huber: float | None = setting(
        None, "δ: 2δ²(√(1 + q/δ²) − 1) replaces q, and likewise φ, for less growth far away.", above=0
    )
    time: float | None = setting(
        None, "Cost of each second until all states of cost.within are about so near their goal.", above=0
    )
    within: dict[str, float] = setting({}, "State: distance from the goal at which time costs no more.")
    obstacles: list[dict[str, Any]] = setting([], "Bumps, each as {center: {state: …}, radius: …, weight: …}.")
    control_costs: list[dict[str, Any]] = setting(
        [], "Costs of controls beside uᵀRu, each as {name: …, weight: …}: absolute, norm, power, …"
    )
    parameters: dict[str, Any] = setting({}, "Arguments of the constructor of a cost of your own.")


@dataclass
class ControlsConfig:
    """U, the admissible controls: all, those between limits, or a set of the user's own."""

    lower: Any = setting(None, "Least controls: a number, or one for each; null: no limit.")
    upper: Any = setting(None, "Greatest controls, likewise.")
    name: str = setting(
        "unbounded", "A registered control set, or module:Class of your own.", choices=CONTROL_SETS,
        user_class=True,
    )  # fmt: skip
    parameters: dict[str, Any] = setting({}, "Arguments of its constructor.")


@dataclass
class ConstraintsConfig:
    """h(x) ≤ 0, the states that closed loops may enter: limits of states, balls, or a class of the user's own."""

    lower: dict[str, float] = setting({}, "Least values of states, by name.")
    upper: dict[str, float] = setting({}, "Greatest values, likewise.")
    outside: list[dict[str, Any]] = setting([], "Balls to stay out of, each as {center: {state: …}, radius: …}.")
    inside: list[dict[str, Any]] = setting([], "Balls to stay in, likewise.")
    name: str = setting(
        "listed", "listed: those above; or module:Class of your own, besides.", choices=CONSTRAINTS,
        user_class=True,
    )  # fmt: skip
    parameters: dict[str, Any] = setting({}, "Arguments of its constructor.")
    margin: float | None = setting(
        None,
        "Margin of h within which training adds a penalty; null: 0.02, or 0.002 if u acts on h directly and "
        "network.penalty is true.",
        above=0,
    )


@dataclass
class DomainConfig:
    """Declared borders of f, g, q and φ, in addition to those found by a search; limits to keep are in constraints."""

    lower: dict[str, float] = setting({}, "Borders below, of states by name.")
    upper: dict[str, float] = setting({}, "Borders above, likewise.")


@dataclass
class InitialStatesConfig:
    """X₀, the box of initial states; a single number is a bound for every state."""

    lower: list[float] = setting(MISSING, "Lower bounds, one for each state.")
    upper: list[float] = setting(MISSING, "Upper bounds, one for each state.")


@dataclass
class HorizonConfig:
    """N steps of Δt."""

    steps: int = setting(MISSING, "N, the number of time steps.", at_least=1)
    dt: float = setting(0.01, "Δt in seconds.", above=0)
    stationary: bool = setting(False, "A task without end: V(x), and the regulator's cost as φ.")


@dataclass
class OutputsConfig:
    """What is measured of a state, and what an estimator assumes; V and the law are about the state itself."""

    measure: list[str] = setting([], "Names of the measured states; none: the readings of the system's output(x).")
    noise: list[float] | None = setting(
        None, "Standard deviation of each reading, in its unit; null: the state is known.", above=0
    )
    process_noise: dict[str, float] = setting(
        {}, "Random walk that an estimator assumes, each as STATE: σ in its unit per √s; see the page on outputs.",
        at_least=0,
    )  # fmt: skip
    input_disturbances: dict[str, float] = setting(
        {}, "Constant disturbances of controls, which an estimator finds and the law takes off, each as CONTROL: σ of "
        "its drift, in its unit per √s.",
        above=0,
    )  # fmt: skip
    initial_deviation: list[float] | None = setting(
        None, "Standard deviation of the first estimate of each state; null: that of a uniform x₀ in X₀.", above=0
    )
    delay: int = setting(0, "Steps of Δt after its readings at which a control acts.", at_least=0)


@dataclass
class ReferenceConfig:
    """r(t), which states are to follow in the place of a target; the time on it is then the last state."""

    file: str = setting("", "CSV file with the columns t and names of states; it is read into points.")
    points: dict[str, list[float]] = setting(
        {}, "Times t in s, rising from 0, and the values of states there, by name."
    )
    speed: float = setting(1.0, "How many times as fast as t says.", above=0)
    periodic: bool = setting(False, "Whether it repeats; its last point is then its first one.")
    control: list[float] | None = setting(
        None, "What the cost counts u from; null: the control that follows r, f(r) + g(r)u = ṙ."
    )


@dataclass
class NetworkConfig:
    """V(t, x). Fields with null use the network's default."""

    name: str = setting(
        "expansion",
        "A registered network, or module:Class of your own.",
        choices=NETWORKS,
        user_class=True,
    )
    hidden: list[int] | None = setting(None, "Widths of the hidden layers.", at_least=1)
    activation: str | None = setting(None, "A smooth activation.", choices=ACTIVATIONS)
    ignored_states: list[str] = setting([], "Names of states on which V does not depend.")
    embed_angles: bool = setting(False, "Join sin θ and cos θ of the system's angles to the inputs.")
    epsilon: float | None = setting(None, "ε of the term ε‖x‖² (icnn, anchored).", above=0)
    smooth: bool | None = setting(None, "Smooth in time, for sound certificates (expansion).")
    penalty: bool = setting(False, "Add the known constraint penalty of one step to N.")
    terminal: str = setting("free", "exact: V(T, ·) = φ by construction.", choices=("free", "exact"))
    state_scale: list[float] | None = setting(
        None, "Expected |x − x*|; null: the extent of X₀, 1 where it has none.", above=0
    )
    value_scale: float | None = setting(None, "Expected V; null: φ at the state scale.", above=0)


@dataclass
class RolloutConfig:
    """How the closed loop is integrated and differentiated; see Rollout."""

    policy: str = setting("hjb", "The control law that V defines.", choices=POLICIES)
    choose_policy: bool = setting(
        False, "Use lookahead instead, if the search for an initial V finds that it costs much less."
    )
    method: str = setting("euler", "The integrator.", choices=METHODS)
    gradient: str = setting("adjoint", "How the gradient is computed.", choices=GRADIENTS)
    compile: str = setting(
        "auto", "Run gradient discrete as machine code, where it can: auto, on; off.", choices=SWITCH
    )
    costate_limit: float | None = setting(
        None,
        "Largest length of a costate relative to its batch's median, with gradient discrete; null: no limit.",
        at_least=1,
    )
    rtol: float = setting(1e-6, "Relative tolerance of an adaptive method.", above=0)
    atol: float = setting(1e-8, "Absolute tolerance of an adaptive method.", above=0)


@dataclass
class TrainingConfig:
    """The optimisation."""

    iterations: int = setting(200, "Gradient steps.", at_least=1, below=10**12)
    batch_size: int = setting(64, "Initial states in each step, per process.", at_least=1)
    optimizer: str = setting(
        "adam",
        "adam, adamw with decoupled weight decay, or muon for the matrices of V and adamw for the rest.",
        choices=("adam", "adamw", "muon"),
    )
    learning_rate: float = setting(1e-2, "Greatest step size: at the start, or after the warmup.", above=0)
    final_learning_rate: float = setting(1e-4, "Step size at the end of a cosine schedule.", at_least=0)
    warmup: int = setting(0, "Steps in which the learning rate rises to its greatest, linearly.", at_least=0)
    beta1: float = setting(0.9, "Adam's averaging of the gradient.", at_least=0, below=1)
    beta2: float = setting(0.99, "Adam's averaging of the squared gradient.", at_least=0, below=1)
    weight_decay: float = setting(0.0, "AdamW weight decay.", at_least=0)
    precision: str = setting("float64", "Floating-point type of everything.", choices=("float64", "float32"))
    threads: int | None = setting(
        None,
        "CPU threads; null: compiled programs on all cores, or OMP_NUM_THREADS, and torch on one.",
        at_least=1,
        below=THREADS + 1,
    )
    lost_share: float = setting(
        0.0,
        "Largest share of a batch drawn from lost states, whose closed loop costs more than V predicts.",
        at_least=0,
        below=1,
    )
    least_gain: float = setting(
        0.0,
        "Early stopping if the validation loss falls by less than this in 40 steps, or the law is optimal; 0: never.",
        at_least=0,
    )
    validate_every: int = setting(10, "Steps between validations, each followed by a checkpoint.", at_least=1)


@dataclass
class EvaluationConfig:
    """Measurements on states that training does not use."""

    validation_states: int = setting(64, "Initial states in each validation.", at_least=1)
    test_states: int = setting(256, "Initial states of the evaluation at the end of training.", at_least=1)
    optimum: bool = setting(True, "Compare with the optimum, where there is an oracle.")
    figures_every: int = setting(5, "Validations between figures; the last one always draws.", at_least=1)
    animate: bool = setting(True, "Show closed loops in motion in TensorBoard, after the last step.")
    certify_every: int = setting(0, "Validations between statistical bounds; 0 for none.", at_least=0)
    certified_states: int = setting(1000, "Fresh states for each such bound.", at_least=1)
    confidence: float = setting(1 - 1e-6, "Confidence of each such bound by itself.", above=0, below=1)


@dataclass
class Config:
    """One experiment."""

    experiment: str = setting(MISSING, "Its name: runs go to <logs>/<experiment>/version_<k>.", folder=True)
    logs: str = setting("logs", "The folder of all runs.")
    seed: int = setting(0, "Seed of the weights and of every draw of states.", at_least=0, below=2**63)
    seeds: int = setting(1, "Runs trained side by side, with the seeds seed, seed + 1, …", at_least=1)
    program: ProgramConfig = field(default_factory=ProgramConfig)
    pointwise: PointwiseConfig = field(default_factory=PointwiseConfig)
    system: SystemConfig = field(default_factory=SystemConfig)
    cost: CostConfig = field(default_factory=CostConfig)
    controls: ControlsConfig = field(default_factory=ControlsConfig)
    constraints: ConstraintsConfig = field(default_factory=ConstraintsConfig)
    domain: DomainConfig = field(default_factory=DomainConfig)
    initial_states: InitialStatesConfig = field(default_factory=InitialStatesConfig)
    horizon: HorizonConfig = field(default_factory=HorizonConfig)
    target: Any = setting(
        None, "x*, the goal of the cost: a list, or {state: value} with the others solved for; null: the cost's own.",
        mapping=True,
    )  # fmt: skip
    target_control: list[float] | None = setting(
        None, "u*, the control at rest; null: the control that holds x*, f(x*) + g(x*)u* = 0."
    )
    family: dict[str, list[float]] = setting(
        {},
        "Ranges of parameters in V: of the system, target_STATE, and weights of the cost as cost.Q.STATE; each as "
        "[least, greatest].",
    )
    reference: ReferenceConfig = field(default_factory=ReferenceConfig)
    noise: dict[str, float] = setting(
        {}, "σ of states that noise drives, each as STATE: σ in its unit per √s; see the page on noise.", at_least=0
    )
    risk: float = setting(
        0.0, "θ in 1/(unit of the cost): what is minimised is log E exp(θJ)/θ over noise or random plants; 0: E J.",
        at_least=0,
    )  # fmt: skip
    randomise: dict[str, list[float]] = setting(
        {}, "Ranges [least, greatest] of parameters of the plant that V and the law are not told; see the page on "
        "plants that differ.",
    )  # fmt: skip
    outputs: OutputsConfig = field(default_factory=OutputsConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    rollout: RolloutConfig = field(default_factory=RolloutConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
    trainer: dict[str, Any] = setting({}, "Passed to lightning.Trainer: accelerator, devices, gradient_clip_val, …")
    loggers: list[str] = setting(["tensorboard"], "Loggers of curves besides metrics.csv.", choices=LOGGERS)
    callbacks: list[str] = setting([], "Lightning callbacks of your own, each as module:Class.")
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)


def configs_of_seeds(config: Config) -> list[Config]:
    """The config of each seed, as a run of its own."""
    return [dataclasses.replace(config, seed=config.seed + k, seeds=1) for k in range(config.seeds)]


def label_of(config: Config) -> str:
    """The name of a seed's run within an ensemble."""
    return f"seed_{config.seed}"


def load_config(path: str | Path, overrides: Sequence[str] = ()) -> Config:
    """The config of a YAML file with `key.sub=value` overrides.

    Raises:
        UsageError: no such file, not YAML, an unknown key, a wrong type, a value out of range.
    """
    content = read_yaml(path, Config)
    config = config_from_plain({"experiment": Path(path).stem, **content}, overrides)
    _require_noise_of_each(content, overrides, config.outputs)
    return _with_model(_with_reference(config, Path(path).parent), Path(path).parent)


def _require_noise_of_each(content: Mapping[str, Any], overrides: Sequence[str], outputs: OutputsConfig) -> None:
    """Require a list outputs.noise to have one entry for each reading; a number without brackets holds for all."""
    written = None
    for layer in (OmegaConf.create(dict(content)), OmegaConf.from_dotlist(list(overrides))):
        written = OmegaConf.select(layer, "outputs.noise", default=written)
    require_one_for_each(written if OmegaConf.is_list(written) else None, outputs.measure)


def require_one_for_each(noise: Sequence[float] | None, measure: Sequence[str]) -> None:
    """Raise UsageError for a list of one standard deviation for several readings."""
    if noise is not None and len(noise) == 1 < len(measure):
        listed = ", ".join(measure)
        raise UsageError(
            f"Expected outputs.noise with {len(measure)} entries ({listed}), got {list(map(float, noise))}; give one "
            "for each, or a number without brackets for all."
        )


def _with_reference(config: Config, folder: Path) -> Config:
    """The config with the points from the file of its reference, whose path is relative to the folder of the YAML."""
    reference = config.reference
    if not reference.file:
        return config
    if reference.points:
        raise UsageError("Expected reference.file or reference.points, got both; leave one out.")
    points = read_columns(folder / reference.file)
    return dataclasses.replace(config, reference=dataclasses.replace(reference, file="", points=points))


def _with_model(config: Config, folder: Path) -> Config:
    """The config with the equations from the model file of its system."""
    system = config.system
    if not system.file:
        return config
    if system.equations:
        raise UsageError("Expected system.file or system.equations, got both; leave one out.")
    if system.name not in KINDS:
        raise UsageError(
            f"Expected system.name as {' or '.join(KINDS)} with system.file, got {system.name}; it reads no file."
        )
    from lyapnet.task.models.systems import model_of_file  # here, because it loads torch

    path = folder / system.file
    read, limits = model_of_file(path, system.name, system.states, system.controls, system.parameters)
    own = {key: getattr(system, key) or read[key] for key in ("angles", "drawing")} | {
        "title": system.title or path.stem
    }
    system = dataclasses.replace(system, file="", **{**read, **own})
    controls = config.controls
    if limits and controls == ControlsConfig():
        controls = dataclasses.replace(controls, lower=_none_if_infinite(limits[0]), upper=_none_if_infinite(limits[1]))
    return dataclasses.replace(config, system=system, controls=controls)


def _none_if_infinite(limits: Sequence[float]) -> list[float | None] | None:
    """Limits with None instead of ±∞; None if all are infinite."""
    given = [limit if math.isfinite(limit) else None for limit in limits]
    return None if all(limit is None for limit in given) else given


def outline(path: str | Path, overrides: Sequence[str] = ()) -> Config:
    """The config of a YAML file, with only keys, types and horizon checked, so that torch is not loaded.

    Raises:
        UsageError: as load_config, for these checks.
    """
    content = {"experiment": Path(path).stem, **read_yaml(path, Config)}
    given = {key: content.get(key, {}) for key in STANDARD}
    standard = {key: {**STANDARD[key], **section} for key, section in given.items() if isinstance(section, Mapping)}
    config = checked(Config, {**content, **standard}, overrides)
    check_values(config.horizon, "horizon.")
    _require_noise_of_each(content, overrides, config.outputs)
    return config


def config_from_plain(content: Mapping[str, Any], overrides: Sequence[str] = ()) -> Config:
    """The config of plain nested dictionaries, checked like a file.

    Raises:
        UsageError: as load_config.
    """
    config = checked(Config, with_recipe(content, overrides, _recommended_weights), overrides)
    # YAML reads on and off as booleans
    config.rollout.compile = {"True": "on", "False": "off"}.get(config.rollout.compile, config.rollout.compile)
    check_values(config)
    check_sizes(config)
    return config


def _recommended_weights(program: str) -> Mapping[str, Any]:
    """The recommended weights of a registered program; empty for a user's program."""
    from lyapnet.loop import programs  # loads torch

    known = programs.PROGRAMS.get(program)
    return {} if known is None else known.recommended


def to_plain(config: Config) -> dict[str, Any]:
    """The config as nested dictionaries, lists, numbers and strings, as stored in checkpoints."""
    return dataclasses.asdict(config)


def abridge_texts(config: Config) -> Config:
    """The config for tables and the text of loggers, with only the first lines of long texts."""
    texts = {key: getattr(config.system, key).splitlines() for key in TEXTS}
    shortened = {
        key: "\n".join([*lines[:MOST_LINES], f"# and {len(lines) - MOST_LINES} further lines, in config.yaml"])
        for key, lines in texts.items()
        if len(lines) > MOST_LINES
    }
    return dataclasses.replace(config, system=dataclasses.replace(config.system, **shortened))


def to_yaml(config: Config) -> str:
    """The resolved config as YAML; a single number for all readings is written without brackets, texts line by line."""
    plain = to_plain(config)
    blocks = {key: text for key in TEXTS if (text := plain["system"][key])}
    plain["system"].update(dict.fromkeys(blocks, PLACE))

    def block(found: re.Match[str]) -> str:
        text = blocks[found[1]]
        ending = "+" if text.endswith("\n") else "-"
        return f"  {found[1]}: |2{ending}\n{textwrap.indent(text, '    ')}".removesuffix("\n")

    return re.sub(rf"^  ({'|'.join(TEXTS)}): {PLACE}$", block, _to_yaml(plain), flags=re.MULTILINE)


def _to_yaml(plain: dict[str, Any]) -> str:
    if len(plain["outputs"]["noise"] or []) == 1:
        (plain["outputs"]["noise"],) = plain["outputs"]["noise"]
    return OmegaConf.to_yaml(OmegaConf.create(plain))


def differing_keys(one: Config, other: Config) -> list[str]:
    """The full names of fields in which two configs differ."""
    return list(differences(to_plain(one), to_plain(other)))
