"""What the README says to type, typed; trainings are cut to two steps."""

import re
import shlex
import sys
from pathlib import Path

import pytest

import lyapnet
from lyapnet.cli import main
from lyapnet.comparison.plan import jobs_of, load_comparison

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
SHORT = ["training.iterations=2", "horizon.steps=8", "evaluation.validation_states=4", "evaluation.test_states=4"]
CHECKPOINT = "logs/double_integrator/version_0/checkpoints/best.ckpt"


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


def commands(program: str) -> list[list[str]]:
    """The arguments of every line of a bash block that calls the program, in the README's order."""
    lines = [part.strip() for block in blocks("bash") for line in block.splitlines() for part in line.split("&&")]
    return [shlex.split(line.removeprefix(program)) for line in lines if line.startswith(program)]


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    """A folder with the project's configs, as a user's clone has them."""
    (tmp_path / "conf").symlink_to(ROOT / "conf")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def train(arguments: list[str]) -> int:
    return main(["train", *[a for a in arguments if not a.startswith(("training.iter", "horizon.steps"))], *SHORT])


def brief(arguments: list[str]) -> list[str]:
    """Few states and steps, one value of a sweep, a second for a certificate; any other command as it is."""
    if arguments[0] == "sweep":
        if "--vary" not in arguments:
            return [*arguments[:3], *SHORT]
        key, _, values = arguments[arguments.index("--vary") + 1].partition("=")
        value = "8" if key == "horizon.steps" else values.split(",")[0]
        return [*arguments[:3], "--vary", f"{key}={value}", "--out", "sweep", *SHORT]
    if arguments[:2] == ["bench", "certify"]:
        return [*arguments, "--dimensions", "1", "--boxes", "2", "--repeats", "1", "--seconds", "1"]
    if arguments[0] == "compare":
        config, tasks = "conf/compare_smoke.yaml", ["--tasks", "double_integrator", "--methods", "lyapnet,ppo_tuned"]
        return ["compare", "--config", config, *tasks, "--workers", "2"]
    if "--seconds" in arguments:
        at = arguments.index("--seconds")
        short = SHORT if "--refine" in arguments else []
        return [*arguments[: at + 1], "1", *arguments[at + 2 :], *short]
    if arguments[0] != "bench":
        return arguments
    at = arguments.index("--batch") if "--batch" in arguments else len(arguments)
    return [
        *arguments[:at],
        *arguments[at + 2 :],
        "--batch",
        "2",
        "--repeats",
        "1",
        "horizon.steps=4",
        "rollout.compile=off",
    ]


def test_every_command_runs(workplace, capsys):
    trainings = commands("python train.py")
    assert len(trainings) >= 4
    for arguments in trainings:
        if "trainer.strategy=ddp" not in arguments:  # starts this very process again: see test_distributed
            assert train(arguments) == 0, capsys.readouterr().err
    for arguments in commands("lyapnet"):
        assert main(brief(arguments)) == 0, capsys.readouterr().err


def test_the_python_example_runs(workplace):
    assert train(["--config", "conf/double_integrator.yaml"]) == 0
    (example,) = [block for block in blocks("python") if "controller.rollout" in block]
    names: dict = {}
    exec(example, names)
    assert names["u"].shape == (1,)
    assert names["trajectory"].x.shape == (9, 2)
    (example,) = [block for block in blocks("python") if "oracle_of" in block]
    exec(example, names)
    assert names["optima"].cost.shape == (4,)


def test_the_environment_example_runs(workplace):
    assert train(["--config", "conf/double_integrator.yaml"]) == 0
    (example,) = [block for block in blocks("python") if "gymnasium.make" in block]
    names: dict = {}
    exec(example, names)
    assert names["mean_return"] < 0


def test_the_table_of_the_comparison_is_that_of_its_report():
    lines = [line for line in README.splitlines() if line.startswith("| ")]
    start = next(k for k, line in enumerate(lines) if line.startswith("| task | method"))
    shown = [line for line in lines[start:] if line.count("|") == lines[start].count("|")]
    report = (ROOT / "docs" / "compare" / "report.md").read_text(encoding="utf-8")
    assert len(shown) == 2 + 4 * 5
    assert "\n".join(shown) in report


def test_a_system_of_your_own(workplace):
    (source,) = [block for block in blocks("python") if "ControlAffineSystem" in block]
    assert len(source.strip().splitlines()) <= 24
    (config,) = [block for block in blocks("yaml") if "experiment:" in block]
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
        assert main(["evaluate", path, "--system", "pendulum:Pendulum", "--samples", "3"]) == 0
        assert main(["evaluate", path, "--samples", "3"]) == 2  # the system has to be passed
        compared = {job.method for job in jobs_of(load_comparison("compare_pendulum.yaml"))}
        assert compared == {"lyapnet", "ppo_tuned"}
    finally:
        sys.modules.pop("pendulum", None)


def test_the_tour_names_every_file():
    package = ROOT / "lyapnet"
    files = {p.name for p in package.glob("*.py")} | {
        f"{p.name}/" for p in package.iterdir() if (p / "__init__.py").exists()
    }
    missing = {name for name in files - {"__init__.py"} if f"`{name}`" not in README}
    assert not missing


def test_pictures_exist():
    for picture in re.findall(r"!\[[^]]*\]\(([^)]+)\)", README):
        assert (ROOT / picture).is_file(), picture
