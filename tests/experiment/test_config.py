"""Configs: what is refused and how, what overrides what, and the shipped files against the task sheet."""

import dataclasses
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from omegaconf import MISSING

from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import (
    MOST_LINES,
    Config,
    abridge_texts,
    config_from_plain,
    load_config,
    outline,
    to_plain,
    to_yaml,
)
from lyapnet.experiment.recipe import STANDARD
from lyapnet.loop.programs import LyapunovProgram
from lyapnet.training.build import build_module
from lyapnet.training.plan import plan_run
from tests.configs import CONF, EXPERIMENTS, HANGAR, PLAIN, objects

# Many calls of the command line in one process, as a user meets it: without the shape checks of the tests.
CALLS = """
import contextlib, io, json, sys
from pathlib import Path
from lyapnet.cli import main, options

options.FIRST = float("inf")  # no line about what is being done, however busy the machine is

def call(folder, arguments):
    with contextlib.redirect_stderr(io.StringIO()) as message, contextlib.redirect_stdout(io.StringIO()):
        status = main(["train", *arguments, f"logs={folder}"])
    return status, message.getvalue(), Path(folder).exists()

print(json.dumps([call(f"logs_{i}", arguments) for i, arguments in enumerate(json.load(sys.stdin))]))
"""


def train(folder, calls):
    """(exit status, message, whether a run's folder was made) of `lyapnet train` with each list of arguments."""
    arguments = [sys.executable, "-c", CALLS]
    done = subprocess.run(arguments, cwd=folder, input=json.dumps(calls), capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def is_refused(outcome, *named):
    """One line that says what was expected and names the culprit; exit status 2; nothing was made."""
    status, message, made_a_folder = outcome
    assert status == 2, message
    assert message.count("\n") == 1, message
    assert "Expected" in message
    for name in named:
        assert name in message
    assert not made_a_folder, "refused only after the folder of the run was made"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("horizon: {steps: 5\ncost: 3", "column 5: did not find expected ',' or '}' while parsing a flow mapping"),
        ("horizon: 3\n cost: 3", "column 6: mapping values are not allowed in this context"),
    ],
)
def test_what_is_no_yaml_is_said_with_its_line_once(text, reason, tmp_path):
    path = tmp_path / "broken.yaml"
    path.write_text(text)
    with pytest.raises(UsageError) as raised:
        load_config(path)
    assert str(raised.value) == f"Expected YAML in {str(path)!r}, got in line 2, {reason}; correct the file."


@pytest.fixture
def plain():
    return yaml.safe_load(PLAIN)


# Refusals: the overrides, joined by &, and what their message names.

MISSPELT = {
    "horizon.stepz=5": ("horizon.stepz", "horizon.steps?"),
    "program.constrain=1": ("program.constrain;", "program.constraint?"),
    "cost.QT=[1, 1]": ("cost.QT", "cost.Q_T?"),
    "horizn.steps=5": ("horizn", "horizon?"),
    "steps=5": ("unknown key steps", "horizon.steps?"),
    "learning_rate=1": ("unknown key learning_rate", "training.learning_rate?"),
    "trainer.acelerator=cpu": ("trainer.acelerator", "trainer.accelerator?"),
    "system.parameters.mas=2": ("system.parameters.mas", "system.parameters.mass?"),
    "rollout.method=rk5": ("rollout.method", "'rk5'", "rk4?"),
    "rollout.gradient=ajoint": ("rollout.gradient", "'ajoint'", "adjoint?"),
    "rollout.policy=sontang": ("rollout.policy", "sontag?"),
    "network.name=fnc": ("network.name", "fcn?", "module:Class"),
    "network.activation=softpuls": ("network.activation", "softplus?"),
    "network.terminal=exactly": ("network.terminal", "exact?"),
    "system.name=cartpol": ("system.name", "cartpole?", "module:Class"),
    "program.name=lyapunof": ("program.name", "lyapunov?"),
    "training.optimizer=adamm": ("training.optimizer", "adam?"),
    "training.precision=float16": ("training.precision", "float64, float32"),
}
MISTYPED = {
    "horizon.steps=ten": ("horizon.steps", "'ten'"),
    "horizon.steps=1.5": ("horizon.steps", "1.5"),
    "horizon.steps=true": ("horizon.steps",),
    "horizon.steps=": ("horizon.steps",),
    "horizon.dt=fast": ("horizon.dt", "'fast'"),
    "horizon=5": ("horizon", "steps, dt", "5"),
    "seed=a": ("seed", "'a'"),
    "program.normalise=maybe": ("program.normalise", "maybe"),
    "network.hidden=64": ("network.hidden",),
    "network.hidden=[a]": ("network.hidden", "'a'"),
    "training.beta1=high": ("training.beta1", "'high'"),
    "initial_states.lower=five": ("initial_states.lower as a number or a list", "'five'"),
    "initial_states.lower=true": ("initial_states.lower as a number or a list", "True"),
    "target=here": ("target as a number or a list", "'here'"),
    "loggers=csv": ("loggers as a list", "'csv'"),
    "family.mass=3": ("family.mass as a list", "got 3"),
    "initial_states.lower=[a, b]": ("initial_states.lower", "'a'"),
    "trainer=5": ("trainer",),
    "system.parameters=5": ("system.parameters",),
    "system.parameters.mass=heavy": ("system.parameters", "mass", "heavy"),
    "cost.Q=true": ("cost", "Q", "number", "True"),
    "cost.Q=abc": ("cost", "Q", "abc"),
    "cost.Q=[a, b]": ("cost", "Q", "'a'"),
    "cost.Q={a: 1}": ("cost.Q",),
    "cost.R=one": ("cost", "R", "number", "one"),
    "cost.R=null": ("cost", "R"),
    "cost.R=inverse_mas": ("cost", "R", "inverse_mas", "inverse_mass"),
    "experiment=null": ("experiment",),
    "horizon.steps=${nothing}": ("horizon.steps", "nothing"),
}
OUT_OF_RANGE = {
    **{
        f"experiment={name}": ("experiment", name)
        for name in (
            "..",
            "../..",
            "/tmp/elsewhere",
            ".",
            "a//b",
            "a/",
            "a/../../b",
            "./a",
            "${oc.env:HOME}",
        )
    },
    "experiment=''": ("experiment", "''"),
    r"experiment='a\..'": ("experiment", r"a\\.."),
    'experiment="a\\nb"': ("experiment", r"a\nb"),
    'experiment="a\\0b"': ("experiment", r"a\x00b"),
    "horizon.dt=-0.01": ("horizon.dt", "> 0", "-0.01"),
    "horizon.dt=0": ("horizon.dt", "> 0"),
    "horizon.dt=.nan": ("horizon.dt", "nan"),
    "horizon.dt=.inf": ("horizon.dt", "inf"),
    "pointwise.weight=-1": ("pointwise.weight", "-1"),
    "pointwise.points=1": ("pointwise.points", "got 1"),
    "pointwise.region=[0, 1]": ("pointwise.region", "> 0"),
    "horizon.steps=0": ("horizon.steps", "1", "got 0"),
    "horizon.steps=-3": ("horizon.steps", "-3"),
    "seed=-1": ("seed", "-1"),
    "program.constraint=-1": ("program.constraint", "-1"),
    "program.constraint=0 & program.terminal=0 & program.trajectory_cost=0": ("program", "weight"),
    "program.margin=-0.1": ("program.margin", "-0.1"),
    "program.bound=-0.1": ("program.bound", "-0.1"),
    "network.hidden=[]": ("network.hidden",),
    "network.hidden=[0]": ("network.hidden", "0"),
    "network.hidden=[-3]": ("network.hidden", "-3"),
    "network.epsilon=0": ("network.epsilon", "> 0"),
    "network.state_scale=[0, 1]": ("network", "state_scale", "> 0"),
    "network.value_scale=-1": ("network.value_scale", "> 0"),
    "rollout.rtol=0": ("rollout.rtol", "> 0"),
    "training.iterations=0": ("training.iterations", "got 0"),
    "training.batch_size=0": ("training.batch_size", "got 0"),
    "training.learning_rate=0": ("training.learning_rate", "> 0"),
    "training.beta2=1": ("training.beta2", "1"),
    "evaluation.test_states=0": ("evaluation.test_states", "got 0"),
    "system.parameters.mass=-1": ("system.parameters", "mass > 0", "-1"),
    "cost.Q=[[1, 2], [3, 4]]": ("cost", "Q", "symmetric", "[3.0, 4.0]"),
    "cost.Q=[-1, 1]": ("cost", "Q", "semidefinite", "-1"),
    "cost.Q=[1, .nan]": ("cost", "Q", "finite", "nan"),
    "cost.Q_T=[[1, 2], [2, 1]]": ("cost", "Q_T", "semidefinite", "-1"),
    "cost.R=[0]": ("cost", "R", "positive definite", "0"),
    "cost.R=[-1]": ("cost", "R", "positive definite", "-1"),
    "cost.R=-1": ("cost", "R", "positive definite", "-1"),
    "cost.Q=-5": ("cost", "Q", "semidefinite", "-5"),
    "initial_states.lower=5": ("initial_states", "lower ≤ upper", "5.0 > 1.0"),
    "initial_states.lower=[1, 2]": ("initial_states", "lower ≤ upper", "2.0 > 1.0"),
    "initial_states.lower=[-.inf, 0]": ("initial_states", "finite", "inf"),
}
WRONG_SHAPE = {
    "cost.Q=[1, 1, 1]": ("cost", "Q", "3"),
    "cost.Q=[[1, 2], [3]]": ("cost", "Q", "[3]"),
    "cost.Q=[]": ("cost", "Q"),
    "cost.Q_T=[1,2,3]": ("cost", "Q_T", "3"),
    "cost.R=[1, 1]": ("cost.R", "one entry", "force", "got 2"),
    "cost.R=[[1, 0]]": ("cost", "R", "square"),
    "initial_states.lower=[-1,-1,-1]": ("initial_states.lower", "2 entries", "position, velocity", "got 3"),
    "initial_states={lower: [-1,-1,-1], upper: [1,1,1]}": ("initial_states", "position, velocity", "3"),
    "network.state_scale=[1,2,3]": ("network.state_scale", "position, velocity", "3"),
    "system={name: linear, parameters: {A: [[1, 2]], B: [[1]]}}": ("system.parameters", "A", "(1, 2)"),
}
IMPOSSIBLE = {
    "program.name=value": ("program.margin", "value"),
    "program.cost_to_go=1": ("program.cost_to_go", "lyapunov"),
    "program.name=value & program.margin=null & program.bound=0.5": ("program.bound", "value"),
    "program.bound=1": ("program", "bound < constraint"),
    "program.bound=0.5 & program.terminal=0.5": ("program.terminal > program.bound", "network.terminal=exact"),
    "network.name=fcn & network.epsilon=0.1": ("network.epsilon", "fcn"),
    "network.embed_angles=true": ("network.embed_angles", "anchored"),
    "network.activation=tanh": ("network", "activation", "convex", "softplus"),
    "system.name=linear": ("system.parameters.A", "linear"),
    "system.name=cartpole & system.parameters.mass=1": ("system.parameters.mass", "cart_mass"),
    "system.name=reacher": ("initial_states", "4", "shoulder angle"),
    "system.angles=[velocity]": ("system.angles", "system.name=double_integrator"),
    "system.equations='der(a) = a'": ("system.equations", "system.name=double_integrator"),
    "system.title=Sledge": ("system.title", "system.name=double_integrator"),
    "cost.name=hangar:Price": ("cost.Q", "cost.name=hangar:Price"),
    "cost.name=hangar:Price & cost.Q=null & cost.R=null & cost.Q_T=null & cost.periodic=[position]": (
        "cost.periodic",
        "cost.name=hangar:Price",
    ),
    "system={name: linear, parameters: {A: [[0, 1], [0, 0]], B: [[0], [1]]}} & cost.R=inverse_mass": (
        "cost",
        "R",
        "inverse_mass",
    ),
    "system.name=nowhere:Thing": ("system.name", "nowhere"),
    "system.name=json:Nothing": ("system.name", "Nothing"),
    "system.name=json:JSONDecoder": ("system.name", "ControlSystem", "json:JSONDecoder"),
    "network.name=json:JSONDecoder & network.hidden=null": ("network.name", "json:JSONDecoder"),
    "system.name=hangar:Drone & system.parameters.mas=4": ("system.parameters.mas", "system.parameters.mass?"),
    "network.name=hangar:Bowl & network.activation=sin": ("network.activation", "hangar:Bowl"),
    "trainer.max_epochs=3": ("trainer.max_epochs", "lyapnet"),
    "trainer.callbacks=[]": ("trainer.callbacks", "lyapnet"),
    "trainer.nonsense=3": ("trainer.nonsense",),
    "network.ignored_states=[speed]": ("network.ignored_states", "position, velocity", "'speed'"),
    "network.ignored_states=[position, velocity]": ("network.ignored_states", "all"),
    "network.ignored_states=[velocity] & network.terminal=exact": ("cost.Q_T", "ignored_states", "terminal=exact"),
    "loggers=[tensorbord]": ("loggers", "tensorboard?"),
    "callbacks=[hangar:Drone]": ("callbacks", "Callback", "hangar:Drone"),
    "callbacks=[nowhere:Thing]": ("callbacks", "module:Class", "nowhere"),
    "callbacks=[hangar:Greedy]": ("callbacks", "hangar:Greedy", "appetite"),
    "controls.name=unbound": ("controls.name", "unbounded?", "module:Class"),
    "program.parameters.greed=1": ("program.parameters.greed", "lyapunov"),
    "cost.parameters.greed=1": ("cost.parameters",),
    "pointwise.weight=1 & pointwise.region=[1, 2, 3]": ("pointwise.region", "position, velocity", "3"),
    "pointwise.weight=1 & pointwise.counterexamples=nowhere.csv": ("pointwise.counterexamples", "nowhere.csv"),
}
UNREADABLE = {
    "horizon.steps": ("key.sub=value", "'horizon.steps'"),
    "=5": ("key.sub=value", "'=5'"),
    "cost.Q=[1, 2": ("cost.Q=[1, 2",),
}
FILES = {
    "open_list.yaml": "a: [1",
    "list.yaml": "- 1\n- 2",
    "empty.yaml": "",
    "words.yaml": "just words",
    "tab.yaml": "a:\tb: c",
    "python.yaml": "experiment: !!python/object/apply:os.getcwd []",
    "binary.yaml": bytes(range(128, 256)),
}
REFUSED = MISSPELT | MISTYPED | OUT_OF_RANGE | WRONG_SHAPE | IMPOSSIBLE | UNREADABLE


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory):
    """What became of every override above, of the config without any, and of every file and own class below."""
    folder = tmp_path_factory.mktemp("refused")
    for name, content in {"good.yaml": PLAIN, "hangar.py": HANGAR, **FILES}.items():
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    calls = {"": ["--config", "good.yaml"]}
    calls |= {overrides: ["--config", "good.yaml", *overrides.split(" & ")] for overrides in REFUSED}
    calls |= {name: ["--config", name] for name in [*FILES, "missing.yaml", "."]}
    return dict(zip(calls, train(folder, list(calls.values())), strict=True))


@pytest.mark.gate
@pytest.mark.parametrize("overrides", REFUSED)
def test_bad_value_is_refused(overrides, outcomes):
    is_refused(outcomes[overrides], *REFUSED[overrides])


@pytest.mark.gate
@pytest.mark.parametrize("name", [*FILES, "missing.yaml", "."])
def test_bad_file_is_refused(name, outcomes):
    is_refused(outcomes[name], f"'{name}'")


@pytest.mark.gate
def test_without_bad_values_the_config_trains(outcomes):
    status, said, made = outcomes[""]
    assert (status, made) == (0, True)
    assert not [line for line in said.splitlines() if not line.startswith("train: ")], "but what it is doing"


@pytest.mark.parametrize(
    ("name", "expected"), [("paper/reacher", "paper/reacher"), ("a b", "a b"), ("${system.name}", "double_integrator")]
)
def test_names_of_experiments_within_the_folder_of_all_runs_are_taken(name, expected, plain):
    plain["experiment"] = name
    assert config_from_plain(plain).experiment == expected


def test_control_characters_in_paths_are_refused(plain):
    with pytest.raises(UsageError, match=r"^Expected logs without control characters, got 'a\\x00b'"):
        config_from_plain({**plain, "logs": "a\0b"})


@pytest.mark.parametrize("override", ["horizon.stepz=5", "horizon.dt=-1", "cost.R=[-1]", "cost.R=[1, 1]"])
def test_refusals_are_usage_errors_and_value_errors(override, plain):
    with pytest.raises(UsageError) as raised:
        objects(config_from_plain(plain, [override]))
    assert isinstance(raised.value, ValueError)
    assert raised.value.exit_status == 2


def test_file_and_command_line_are_refused_alike(plain):
    plain["horizon"]["stepz"] = 5
    for content, overrides in ((plain, []), (yaml.safe_load(PLAIN), ["horizon.stepz=5"])):
        with pytest.raises(UsageError, match=r"horizon\.stepz; did you mean horizon\.steps\?"):
            config_from_plain(content, overrides)


@pytest.mark.parametrize("name", ["wandb", "mlflow"])
def test_logger_whose_library_is_missing_is_refused(name, plain, monkeypatch):
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(
        UsageError, match=rf"^Expected {name} for loggers=\[{name}\], got none .*; pip install {name}\.$"
    ):
        plan_run(config_from_plain(plain, [f"loggers=[{name}]", "logs=nowhere"]))
    assert not Path("nowhere").exists()


def mandatory(schema=Config, prefix=""):
    """Full names of the fields without a default."""
    for f in dataclasses.fields(schema):
        if dataclasses.is_dataclass(f.type):
            yield from mandatory(f.type, f"{prefix}{f.name}.")
        elif f.default == MISSING:
            yield prefix + f.name


def test_mandatory_keys_are_these():
    task = ["initial_states.lower", "initial_states.upper", "horizon.steps"]
    assert list(mandatory()) == ["experiment", "program.name", "system.name", *task]


@pytest.mark.parametrize("key", [*mandatory(), "cost.Q", "cost.R", "cost.Q_T"])
def test_missing_mandatory_key_is_refused(key, plain):
    *sections, name = key.split(".")
    section = plain
    for part in sections:
        section = section[part]
    del section[name]
    with pytest.raises(UsageError, match=f"^Expected .*{key}, got none"):
        objects(config_from_plain(plain))


FOUR = ("system", "cost", "initial_states", "horizon")


def test_four_sections_in_a_file_are_enough(tmp_path, plain):
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump({section: plain[section] for section in FOUR}))
    config = load_config(path, ["training.iterations=9"])
    assert config.experiment == "mine"
    assert (config.network.name, config.rollout.policy, config.program.name) == ("expansion", "sampled", "value")
    assert (config.training.iterations, config.training.batch_size) == (9, STANDARD["training"]["batch_size"])
    assert config.trainer == STANDARD["trainer"]
    assert build_module(config).members[0].rollout.gradient == "discrete"


def test_with_constraints_the_standard_law_looks_ahead(plain):
    task = {"experiment": "mine", **{section: plain[section] for section in FOUR}}
    limits = {"upper": {"position": 2}}
    assert config_from_plain({**task, "constraints": limits}).rollout.policy == "lookahead"
    assert config_from_plain(task, ["constraints.upper.position=2"]).rollout.policy == "lookahead"
    assert config_from_plain({**task, "constraints": limits}, ["rollout.policy=sampled"]).rollout.policy == "sampled"
    own = {**task, "constraints": limits, "rollout": {"policy": "hjb"}}
    assert config_from_plain(own).rollout.policy == "hjb"
    assert config_from_plain(task).rollout.policy == "sampled"
    for none in ({"margin": 0.01}, {"upper": {}}):
        assert config_from_plain({**task, "constraints": none}).rollout.policy == "sampled"
    for none in ("constraints.margin=0.01", "constraints={}"):
        assert config_from_plain(task, [none]).rollout.policy == "sampled"


def test_what_a_file_says_comes_on_top_of_the_standard_recipe(plain):
    task = {"experiment": "mine", **{section: plain[section] for section in FOUR}}
    config = config_from_plain({**task, "program": {"name": "lyapunov", "margin": 0.1}, "training": {"batch_size": 7}})
    recommended = LyapunovProgram.recommended
    assert (config.program.name, config.program.cost_to_go) == ("lyapunov", None)
    assert (config.program.constraint, config.program.margin) == (recommended["constraint"], 0.1)
    assert config_from_plain(task, ["program.name=lyapunov"]).program.bound == recommended["bound"]
    own = config_from_plain({**task, "program": {"name": "mine:Program"}}).program
    assert (own.constraint, own.trajectory_cost, own.bound) == (1, 0, None)
    assert (config.training.batch_size, config.training.learning_rate) == (7, STANDARD["training"]["learning_rate"])
    assert config_from_plain({**task, "program": {"cost_to_go": 3}}).program.trajectory_cost == 1


def test_a_file_that_names_a_network_gets_the_schemas_defaults_alone(plain):
    """As in version 0.1, whose files all name one."""
    config = config_from_plain({**plain, "network": {"name": "fcn"}})
    assert (config.rollout.policy, config.training.learning_rate, config.trainer) == ("hjb", 1e-2, {})


# Precedence and round trips


def test_command_line_overrides_file_overrides_defaults(tmp_path, plain):
    path = tmp_path / "experiment.yaml"
    path.write_text(yaml.safe_dump({**plain, "training": {"batch_size": 7, "iterations": 3}}))
    config = load_config(path, ["training.iterations=9", "initial_states.lower=[-2, -2]"])
    assert (config.training.iterations, config.training.batch_size) == (9, 7)
    assert config.training.optimizer == "adam"
    assert config.initial_states.lower == [-2, -2]
    assert config.initial_states.upper == [1, 1]


def test_a_number_stands_for_a_list_of_one(plain):
    plain |= {"initial_states": {"lower": -2, "upper": 0.5}, "target": 0, "target_control": 0}
    config = config_from_plain(plain, ["network.state_scale=3", "initial_states.upper=1"])
    assert config.network.state_scale == [3]
    problem = build_problem(config)
    assert problem.initial_states.lower.tolist() == [-2, -2]
    assert problem.initial_states.upper.tolist() == [1, 1]
    assert problem.goal.tolist() == [0, 0]


def test_an_outline_has_what_is_written(tmp_path, plain):
    path = tmp_path / "outlined.yaml"
    task = {key: plain[key] for key in ("system", "cost", "initial_states", "horizon")}
    path.write_text(yaml.safe_dump({**task, "program": {"constraint": 0.5}}), encoding="utf-8")
    written, whole = outline(path, ["horizon.steps=7"]), load_config(path, ["horizon.steps=7"])
    assert written.horizon == whole.horizon
    assert written.program.constraint == whole.program.constraint == 0.5
    assert written.initial_states == whole.initial_states
    for override, words in (("horizon.stepz=7", "did you mean horizon.st"), ("horizon.steps=0", "horizon.steps ≥ 1")):
        with pytest.raises(UsageError, match=words):
            outline(path, [override])


def test_one_key_of_the_trainer_section_keeps_the_others(plain):
    plain["trainer"] = {"gradient_clip_val": 3, "devices": 1}
    config = config_from_plain(plain, ["trainer.accelerator=cpu", "trainer.devices=2"])
    assert config.trainer == {"gradient_clip_val": 3, "devices": 2, "accelerator": "cpu"}


@pytest.mark.parametrize("path", [path for path in EXPERIMENTS if path.parent == CONF], ids=lambda path: path.stem)
def test_config_survives_plain_data_and_yaml(path, tmp_path):
    config = load_config(path, ["seed=3"])
    assert config_from_plain(to_plain(config)) == config
    written = tmp_path / "written.yaml"
    written.write_text(to_yaml(config))
    assert load_config(written) == config


@pytest.mark.parametrize("ending", ["", "\n", "\n\n"])
def test_equations_are_written_line_by_line(ending, plain):
    equations = f"  a = -x  # as in the book\n\nder(x) = a + u{ending}"
    given = {**plain, "system": {"name": "equations", "equations": equations, "states": {"x": "m"}}}
    config = config_from_plain({**given, "target": None})
    text = to_yaml(config)
    assert "\n    der(x) = a + u\n" in text
    assert config_from_plain(yaml.safe_load(text)) == config


def test_loggers_have_the_first_lines_of_long_equations(plain):
    lines = [f"v{k} = x + {k}" for k in range(MOST_LINES + 5)]
    given = {**plain, "system": {"name": "equations", "equations": "\n".join(lines), "states": {"x": "m"}}}
    shown = abridge_texts(config_from_plain(given))
    assert shown.system.equations.splitlines() == [*lines[:MOST_LINES], "# and 5 further lines, in config.yaml"]
    assert abridge_texts(shown) == config_from_plain(to_plain(abridge_texts(shown)))


def test_defaults_are_not_shared_between_configs(plain):
    config_from_plain(plain).trainer["accelerator"] = "gpu"
    config_from_plain(plain).system.parameters["mass"] = 2
    assert config_from_plain(plain).trainer == {}
    assert config_from_plain(plain).system.parameters == {}


@pytest.mark.parametrize("path", EXPERIMENTS, ids=lambda path: str(path.relative_to(CONF)))
def test_first_line_of_a_shipped_config_runs_it(path):
    command = f"# python train.py --config conf/{path.relative_to(CONF)}"
    assert path.read_text().splitlines()[0].startswith(command)


@pytest.mark.parametrize(
    ("override", "said"),
    [
        *((f"training.least_gain={value}", "training.least_gain") for value in ("-1", "much", "nan", "[1]", "inf", "")),
        *((f"rollout.choose_policy={value}", "rollout.choose_policy as bool") for value in ("maybe", "[true]", "")),
        *((f"constraints.margin={v}", "constraints.margin") for v in ("-0.1", "0", "wide", "nan", "[0.1]", "{a: 1}")),
        *((f"network.penalty={value}", "network.penalty as bool") for value in ("heavy", "[1]")),
        *((f"rollout.policy={value}", "rollout.policy as one of hjb") for value in ("look_ahead", "3")),
        *((f"rollout.compile={value}", "rollout.compile as one of auto, on, off") for value in ("maybe", "1")),
        ("horizon.stationary=sometimes", "horizon.stationary as bool"),
        ("training.least_gian=0.1", "did you mean training.least_gain?"),
        ("rollout.choose_polcy=true", "did you mean rollout.choose_policy?"),
        ("constraints.margn=0.1", "did you mean constraints.margin?"),
        ("network.penlty=true", "did you mean network.penalty?"),
    ],
)
def test_what_is_no_value_of_a_key_is_refused_in_one_line(override, said):
    with pytest.raises(UsageError) as refused:
        load_config(Path("conf/obstacle.yaml"), [override])
    assert said in str(refused.value)
    assert re.fullmatch(r"Expected .+, got.+[;:,] .+[.?]", str(refused.value))


@pytest.mark.parametrize(
    ("changes", "overrides", "least_gain"),
    [
        ({}, [], STANDARD["training"]["least_gain"]),
        ({"training": {"batch_size": 7}}, [], STANDARD["training"]["least_gain"]),
        ({"training": {"iterations": 900}}, [], 0),
        ({}, ["training.iterations=900"], 0),
        ({}, ["training.iterations=900", "training.least_gain=0.1"], 0.1),
        ({"training": {"iterations": 900, "least_gain": 0.1}}, [], 0.1),
        ({"program": {"name": "region"}}, [], 0),
    ],
)
def test_who_names_a_number_of_steps_has_them_all(changes, overrides, least_gain, plain):
    task = {"experiment": "mine", **{section: plain[section] for section in FOUR}}
    assert config_from_plain({**task, **changes}, overrides).training.least_gain == least_gain
