"""py.typed is kept: every type of the public interface is known, and a user's script is clean under pyright strict.

An editable install leads checkers to these types too.
"""

import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import lyapnet
from tests.layout import PACKAGE
from tests.pages import ROOT

pytest.importorskip("pyright", reason="pyright comes with the development extra")

DECLARED = "    system: ControlSystem\n"  # of Problem
STRICT = {"include": ["right.py", "wrong.py"], "typeCheckingMode": "strict"}
SCRIPT = """
from dataclasses import dataclass
from pathlib import Path

import lightning
import lyapnet
import numpy as np
import torch
from torch import Tensor


class Pendulum(lyapnet.ControlAffineSystem):
    state_names, state_units = ("angle", "rate"), ("rad", "rad/s")
    control_names, control_units = ("torque",), ("N·m",)
    angles = (0,)

    def __init__(self, length: float = 1.0):
        super().__init__()
        self.length = length
        self.friction = lyapnet.Table([[-2.0, 0.0, 2.0]], [-0.1, 0.0, 0.1], method="cubic")

    def f(self, x: Tensor) -> Tensor:
        pull = 9.81 / self.length * torch.sin(x[..., 0])
        return torch.stack([x[..., 1], pull - self.friction(x[..., 1:])], -1)

    def g(self, x: Tensor) -> Tensor:
        return torch.tensor([[0.0], [self.length**-2]]).to(x).expand(*x.shape[:-1], 2, 1)


class Network(lyapnet.ValueFunction):
    def __init__(self):
        super().__init__()
        self.layers = torch.nn.Sequential(torch.nn.Linear(3, 64), torch.nn.Tanh(), torch.nn.Linear(64, 1))

    def forward(self, t: Tensor, x: Tensor) -> Tensor:
        return self.layers(torch.cat([t.expand(x.shape[:-1])[..., None], x], -1))[..., 0]


@dataclass(frozen=True)
class AbsoluteProgram(lyapnet.Program):
    degree = 1

    def penalty(self, excess: Tensor) -> Tensor:
        return excess.abs()

    def constraint_loss(self, values: Tensor, trajectory: lyapnet.Trajectory) -> Tensor:
        return (values.diff(dim=0) + trajectory.step_cost).abs().sum(0)

    def terminal_term(self, values: Tensor, trajectory: lyapnet.Trajectory) -> Tensor:
        return (values[-1] - trajectory.terminal_cost).abs()


Q, X0 = [[10.0, 0.0], [0.0, 0.1]], lyapnet.Box([-1.0, -0.7], [1.0, 0.7])
cost = lyapnet.PeriodicCost(lyapnet.QuadraticCost(Q, [[0.1]], Q), [0], 2)
speed = lyapnet.AllOf([lyapnet.StateLimits([1], [2.0], [1.0], [1.0])])
controls, horizon = lyapnet.ControlBox(-2.0, [2.0]), lyapnet.Horizon(steps=100, dt=0.01)
problem = lyapnet.Problem(Pendulum(0.5), cost, controls, X0, horizon, speed)
labels: list[str] = problem.system.state_labels + lyapnet.SYSTEMS["double_integrator"]().control_labels

module = lyapnet.ValueModule(problem.relaxed(1.0), Network(), AbsoluteProgram(trajectory_cost=1))
data = lyapnet.InitialStateDataModule(problem, batch_size=64, steps_per_epoch=10)
lightning.Trainer(max_epochs=20).fit(module, data)
batches: list[Tensor] = list(data.train_dataloader())
own = lyapnet.Controller(problem, module.V)
torque: Tensor = own.controls.project(own.law(torch.tensor(0.0), torch.zeros(2)))

run = lyapnet.train("pendulum.yaml", ["training.iterations=60"], resume="last")
folder: Path = run.folder
controller = lyapnet.load(run.best, system=Pendulum(0.5), beyond="hold")
u: np.ndarray = controller.policy(0.0, [0.8, -0.3])
value: Tensor = controller.value(0.0, torch.zeros(2))
angles: np.ndarray = controller.rollout([0.8, -0.3], steps=50).x[..., 0]
trajectory: lyapnet.Trajectory = controller.rollout(torch.tensor([0.8, -0.3]), steps=50)
paid: Tensor = controller.closed_loop.cost.running(trajectory.x[:-1], trajectory.u)
"""
WRONG = SCRIPT.replace("dt=0.01", 'dt="0.01"')


def pyright(site: Path, *arguments: str) -> dict:
    """What pyright says in the folder of a site, whose packages are installed as far as it knows."""
    command = [sys.executable, "-m", "pyright", "--outputjson", "--pythonpath", sys.executable, *arguments]
    environment = {**os.environ, "PYTHONPATH": str(site)}
    said = subprocess.run(command, cwd=site.parent, env=environment, capture_output=True, text=True, check=False)
    return json.loads(said.stdout)


def interface() -> set[str]:
    """Full names of what lyapnet.__all__ lists, but for __version__, where each is defined."""
    objects = {name: getattr(lyapnet, name) for name in lyapnet.__all__ if name != "__version__"}
    classes_and_functions = {f"{each.__module__}.{each.__qualname__}" for each in objects.values() if callable(each)}
    return classes_and_functions | {f"lyapnet.{name}" for name, each in objects.items() if not callable(each)}


def symbols(site: Path) -> dict[str, bool]:
    """Symbol of the public interface ↦ whether its type is known, whatever checker reads it."""
    found = pyright(site, "--verifytypes", "lyapnet", "--ignoreexternal")["typeCompleteness"]["symbols"]
    names = interface()
    return {
        each["name"]: each["isTypeKnown"] and not each["isTypeAmbiguous"]
        for each in found
        if each["name"] in names or each["name"].startswith(tuple(f"{name}." for name in names))
    }


@pytest.fixture
def site(tmp_path):
    """A folder with nothing but the package."""
    shutil.copytree(PACKAGE, tmp_path / "site" / "lyapnet", ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path / "site"


@pytest.mark.gate
def test_every_type_of_the_public_interface_is_known(site):
    known = symbols(site)
    assert len(known) >= 300
    assert interface() <= known.keys()
    assert [name for name, is_known in known.items() if not is_known] == []


@pytest.mark.gate
def test_an_attribute_without_its_type_is_found(site):
    problem = site / "lyapnet" / "task" / "problem.py"
    source = problem.read_text(encoding="utf-8")
    assert source.count(DECLARED) == 1
    problem.write_text(source.replace(DECLARED, ""), encoding="utf-8")
    unknown = {name for name, is_known in symbols(site).items() if not is_known}
    assert {
        "lyapnet.task.problem.Problem.system",
        "lyapnet.task.problem.Problem",
        "lyapnet.controller.loading.load",
    } <= unknown


@pytest.mark.gate
def test_a_script_of_a_user_is_clean_under_strict_and_a_wrong_argument_is_found(site):
    assert WRONG != SCRIPT
    for name, content in (("right", SCRIPT), ("wrong", WRONG)):
        (site.parent / f"{name}.py").write_text(content, encoding="utf-8")
    (site.parent / "pyrightconfig.json").write_text(json.dumps(STRICT), encoding="utf-8")
    said = pyright(site)
    assert said["summary"]["filesAnalyzed"] == 2
    found = [(Path(each["file"]).name, each["rule"], each["message"]) for each in said["generalDiagnostics"]]
    assert [each[:2] for each in found] == [("wrong.py", "reportArgumentType")], found


def editable_path(project: Path, pyproject: str) -> str:
    """What an editable install of a project puts into the path file of an environment."""
    (project / "lyapnet").mkdir(parents=True)
    shutil.copy(PACKAGE / "__init__.py", project / "lyapnet")
    for name in ("README.md", "LICENSE"):
        shutil.copy(ROOT / name, project)
    (project / "pyproject.toml").write_text(pyproject, encoding="utf-8")
    command = [sys.executable, "-c", "from setuptools.build_meta import build_editable; build_editable('.')"]
    subprocess.run(command, cwd=project, capture_output=True, check=True)
    with zipfile.ZipFile(next(project.glob("*.whl"))) as wheel:
        (name,) = (name for name in wheel.namelist() if name.endswith(".pth"))
        return wheel.read(name).decode().strip()


def test_an_editable_install_is_a_path_that_checkers_follow(tmp_path):
    pytest.importorskip("setuptools", minversion="77")
    pyproject = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert editable_path(tmp_path / "ours", pyproject) == str(tmp_path / "ours")
    (line,) = (line for line in pyproject.splitlines() if line.startswith("package-dir"))
    assert editable_path(tmp_path / "twin", pyproject.replace(line, "")).startswith("import ")
