"""What the README and the pages under docs/ say to type, typed; trainings are cut to two steps."""

import re
import shlex
import shutil
import sys
from pathlib import Path

import pytest
import torch
import typer

import lyapnet
from lyapnet.cli import app, main
from lyapnet.experiment.config import load_config
from lyapnet.lab.comparison.plan import jobs_of, load_comparison
from tests.fits import few_optima, shorten_fits
from tests.pages import PAGES, README, REPORT, ROOT, blocks
from tests.problems import problem_of

FILES_OF_READERS = ("logs/arm/", "V.onnx", "task.yaml")  # which pages name, but do not make
SHORT = ["training.iterations=2", "horizon.steps=8", "evaluation.validation_states=4", "evaluation.test_states=4"]


def commands(program: str, language_blocks: list[str] | None = None) -> list[list[str]]:
    """The arguments of every line of a bash block that calls the program, in the pages' order, none twice."""
    joined = [block.replace("\\\n", " ") for block in language_blocks or blocks("bash")]
    lines = [part.strip() for block in joined for line in block.splitlines() for part in line.split("&&")]
    found = [line.removeprefix(program) for line in dict.fromkeys(lines) if line.startswith(program)]
    return [shlex.split(line, comments=True) for line in found]


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    """A folder with the project's configs and the scene of a page, as a user's clone has them."""
    (tmp_path / "conf").symlink_to(ROOT / "conf")
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "contact").symlink_to(ROOT / "docs" / "contact")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder with the run that examples load."""
    folder = tmp_path_factory.mktemp("trained")
    assert train(["--config", "conf/double_integrator.yaml", f"logs={folder / 'logs'}"]) == 0
    return folder


def train(arguments: list[str]) -> int:
    return main(brief(["train", *arguments]))


def brief(arguments: list[str]) -> list[str]:
    """Few states and steps, one task or value of several, a second for a proof; any other command as it is."""
    if arguments[0] == "train":
        shortened = tuple(setting.split("=")[0] for setting in SHORT)
        return [*[a for a in arguments if not a.startswith(shortened)], *SHORT]
    if arguments[0] == "sweep":
        if "--vary" not in arguments:
            return [*arguments[:3], *SHORT]
        key, _, values = arguments[arguments.index("--vary") + 1].partition("=")
        value = "8" if key == "horizon.steps" else values.split(",")[0]
        return [*arguments[:3], "--vary", f"{key}={value}", "--out", "sweep", *SHORT]
    if arguments[0] == "tune":
        return [*with_option(arguments[:2], "--trials", "1"), "--no-final", *SHORT]
    if arguments[:2] == ["bench", "certify"]:
        return [*arguments, "--dimensions", "1", "--boxes", "2", "--repeats", "1", "--seconds", "1"]
    if arguments[0] == "compare":
        config, tasks = "conf/compare_smoke.yaml", ["--tasks", "double_integrator", "--methods", "lyapnet,ppo_tuned"]
        return ["compare", "--config", config, *tasks, "--workers", "2"]
    if arguments[:2] == ["certify", "sound"]:
        limited = with_option(arguments, "--seconds", "1")
        return [*with_option(limited, "--refine", "1"), *SHORT] if "--refine" in limited else limited
    if arguments[0] != "bench":
        return arguments
    first = [a.split(",")[0] for a in arguments]  # of several tasks and routes
    if arguments[1] == "optima":
        return [*first, "horizon.steps=4"]
    return [
        *with_option(with_option(first, "--batch", "2"), "--repeats", "1"),
        "horizon.steps=4",
        "rollout.compile=off",
    ]


def with_option(arguments: list[str], name: str, value: str) -> list[str]:
    """The arguments with another value of an option, or with the option."""
    if name not in arguments:
        return [*arguments, name, value]
    at = arguments.index(name)
    return [*arguments[: at + 1], value, *arguments[at + 2 :]]


def write_if_shown(experiment: str) -> None:
    """Write the YAML of an experiment that a page shows, unless the file exists, and the classes that it names."""
    names = f"{Path(experiment).stem}.yaml", f"experiment: {Path(experiment).stem}\n"
    shown = [block for block in blocks("yaml") if any(name in block for name in names)]
    if shown and not Path(experiment).exists():
        Path(experiment).write_text(shown[0], encoding="utf-8")
        for module, name in re.findall(r"(\w+):([A-Z]\w+)", shown[0]):
            for source in [block for block in blocks("python") if f"class {name}(" in block]:
                Path(f"{module}.py").write_text(source, encoding="utf-8")


def trains(arguments: list[str]) -> bool:
    return "trainer.strategy=ddp" not in arguments  # which starts this very process again: see test_distributed


@pytest.mark.nightly
def test_every_command_runs(workplace, capsys):
    trainings = [["train", *arguments] for arguments in filter(trains, commands("python train.py"))]
    assert len(trainings) >= 4
    beyond_reach = FILES_OF_READERS if shutil.which("ffmpeg") else (*FILES_OF_READERS, ".mp4")
    with few_optima(12, 40, 20):
        for arguments in [*trainings, *commands("lyapnet")]:
            if any(file in argument for argument in arguments for file in beyond_reach):
                continue
            if arguments[0] == "train":
                write_if_shown(arguments[arguments.index("--config") + 1])
            status, printed = main(brief(arguments)), capsys.readouterr()
            if arguments[:2] == ["certify", "check"]:
                assert status in (0, 1), (arguments, printed.err)
            elif "--certified" in arguments and status == 2:
                assert "got an unfinished one" in printed.err, "a proof of a second"
            else:
                assert status == 0, (arguments, printed.err)


@pytest.mark.gate
def test_every_command_of_the_readme_runs(workplace, capsys):
    """But for the proof and the comparison, which take longer than the others together: see cli/."""
    of_readme = blocks("bash", README)
    for arguments in filter(trains, commands("python train.py", of_readme)):
        assert train(arguments) == 0, capsys.readouterr().err
    others = commands("lyapnet", of_readme)
    assert len(others) >= 3
    for arguments in others:
        if arguments[:2] != ["certify", "sound"] and arguments[0] != "compare":
            assert main(brief(arguments)) == 0, (arguments, capsys.readouterr().err)


def understood(arguments: list[str]) -> dict:
    """What the command line makes of them, without doing it: the parameters of the innermost command."""
    command, context = typer.main.get_command(app), None
    while True:
        context = command.make_context("lyapnet", list(arguments), parent=context)
        if not isinstance(command, typer.core.TyperGroup):
            return context.params
        _, command, arguments = command.resolve_command(context, [*context._protected_args, *context.args])


@pytest.mark.gate
def test_every_command_is_understood(workplace):
    """Each option exists, and each experiment and change that is named makes a config."""
    trainings = [["train", *arguments] for arguments in commands("python train.py")]
    found = trainings + commands("lyapnet")
    assert len(found) >= 30
    for arguments in found:
        given = understood(arguments)
        if arguments[0] in ("train", "sweep"):
            experiments = given["config"] if arguments[0] == "sweep" else [given["config"]]
            for experiment in experiments:
                write_if_shown(experiment)
                load_config(experiment, list(given["overrides"] or ()))
        elif arguments[0] == "compare":
            assert load_comparison(given["config"]).tasks
    with pytest.raises(typer.TyperException):
        understood(["evaluate", "last.ckpt", "--samplez", "3"])


@pytest.mark.gate
def test_the_python_example_runs(trained, monkeypatch):
    monkeypatch.chdir(trained)
    (example,) = [block for block in blocks("python") if "lyapnet.load" in block and "controller.rollout" in block]
    names: dict = {}
    exec(example, names)
    assert names["u"].shape == (1,)
    assert names["trajectory"].x.shape == (9, 2)


@pytest.mark.gate
def test_the_oracle_example_runs(trained, monkeypatch):
    monkeypatch.chdir(trained)
    names: dict = {"controller": lyapnet.load("logs/double_integrator/version_0/checkpoints/best.ckpt")}
    (example,) = [block for block in blocks("python") if "oracle_of" in block]
    exec(example, names)
    assert names["optima"].cost.shape == (4,)


def test_the_example_of_a_table_keeps_its_contract():
    (example,) = [block for block in blocks("python") if "lyapnet.Table(" in block]
    names: dict = {}
    exec(example, names)
    cart = names["Cart"]()
    assert cart.f(torch.tensor([0.0, 2.0])).tolist() == pytest.approx([2.0, -0.5])
    problem_of(cart).check()


@pytest.mark.gate
@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::UserWarning")  # Lightning's own
def test_the_examples_from_python_train(workplace):
    examples = [block for block in blocks("python") if "lightning.Trainer(" in block]
    assert len(examples) == 2, "one in the README, one on the page from_python"
    for version, example in enumerate(examples):
        exec(example.replace("max_epochs=20", "max_epochs=1").replace("steps=100", "steps=4"), {"__name__": "example"})
        rows = (workplace / f"logs/lightning_logs/version_{version}/metrics.csv").read_text().splitlines()
        assert "trajectory_cost/val" in rows[0]
        assert len(rows) > 1


@pytest.mark.gate
def test_the_environment_example_runs(trained, monkeypatch):
    monkeypatch.chdir(trained)
    (example,) = [block for block in blocks("python") if "gymnasium.make" in block]
    names: dict = {}
    exec(example.replace("n_eval_episodes=20", "n_eval_episodes=1"), names)
    assert names["mean_return"] < 0


def table_after(text: str, start: str) -> list[list[str]]:
    """The cells of each row of the first table that starts so, its line of dashes left out."""
    rows = (start + text.partition(start)[2]).partition("\n\n")[0].splitlines()
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in (rows[0], *rows[2:])]


def test_the_tables_of_the_comparison_are_those_of_its_report():
    """Methods by tasks; the first cell names the report's columns that a cell holds."""
    head, *rows = table_after(REPORT.read_text(encoding="utf-8"), "| task | method | seeds | cost / J*")
    measured = {(row[0], row[1]): dict(zip(head, row, strict=True)) for row in rows}
    assert len(measured) == 4 * 5
    for start in ("| cost / J*; at our", "| seconds to 10 %"):
        (names, *tasks), *lines = table_after(PAGES[ROOT / "docs" / "compare.md"], start)
        shown = {(task, line[0]): cell for line in lines for task, cell in zip(tasks, line[1:], strict=True)}
        assert shown == {key: "; ".join(row[name] for name in names.split("; ")) for key, row in measured.items()}


@pytest.mark.gate
def test_a_system_of_your_own(workplace, monkeypatch, capsys):
    monkeypatch.setattr("lyapnet.training.start.MAX_OPTIMA", 12)
    shorten_fits(monkeypatch, 40, 20)
    monkeypatch.setattr("lyapnet.training.pretraining.BRIEF_STEPS", 10)
    (source,) = [block for block in blocks("python") if "class Pendulum(ControlAffineSystem)" in block]
    assert len(source.strip().splitlines()) <= 24
    (config,) = [block for block in blocks("yaml") if "pendulum:Pendulum" in block and "system:" in block]
    (comparison,) = [block for block in blocks("yaml") if "comparison:" in block]
    (workplace / "pendulum.py").write_text(source, encoding="utf-8")
    (workplace / "pendulum.yaml").write_text(config, encoding="utf-8")
    (workplace / "compare_pendulum.yaml").write_text(comparison, encoding="utf-8")
    try:
        assert train(["--config", "pendulum.yaml"]) == 0
        from pendulum import Pendulum  # pyright: ignore[reportMissingImports]

        path = "logs/pendulum/version_0/checkpoints/best.ckpt"
        controller = lyapnet.load(path, system=Pendulum(0.5))
        assert controller.policy(0.0, [0.3, 0.0]).shape == (1,)
        names: dict = {}
        (use,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("use ")]
        exec(use.removeprefix("use ").strip(), names)  # the line that the training ends with
        assert names["controller"].system.length == 0.5
        assert main(["evaluate", path, "--system", "pendulum:Pendulum", "--samples", "3"]) == 0
        assert main(["evaluate", path, "--samples", "3"]) == 2  # the system has to be passed
        compared = {job.method for job in jobs_of(load_comparison("compare_pendulum.yaml"))}
        assert compared == {"lyapnet", "ppo_tuned"}
    finally:
        sys.modules.pop("pendulum", None)


def test_the_tour_names_every_folder_and_no_other():
    folders = {f"{path.name}/" for path in (ROOT / "lyapnet").iterdir() if (path / "__init__.py").exists()}
    first = {row.partition("|")[2].partition("|")[0] for row in rows_after(README, "| where in").splitlines()}
    assert set(re.findall(r"`(\w+/)`", " ".join(first))) == folders


def rows_after(page: Path, heading: str) -> str:
    """The rows of the table whose first row starts so."""
    _, _, rest = PAGES[page].partition(heading)
    return rest.partition("\n\n")[0].partition("\n")[2]
