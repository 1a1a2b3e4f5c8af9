"""The layout: which folder imports which, that Lightning and OmegaConf stay at the edge, and that imports are light."""

import re
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter

import pytest

from tests.layout import imports, room, rooms, sources
from tests.pages import ROOT

MATHEMATICS = {"base", "task", "value", "loop", "graphs", "prover"}
PROVER_NEEDS_NONE_OF = {"controller", "experiment", "evaluation", "training", "claims", "exchange", "lab", "zoo", "cli"}
EDGE = {"lightning", "omegaconf", "typer", "rich", "tensorboard", "matplotlib"}
SHOWN = {"drawing", "figures", "tables", "report"}  # files of other rooms that may draw or print


def order_in_docs():
    """The folders of the package in the order of the table in docs/architecture.md."""
    return re.findall(r"^\| `(\w+)/` \|", (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8"), re.M)


def upward(modules):
    """(folder, what it imports) for every import of a folder that the table has later, or not at all."""
    order = order_in_docs()
    for here, imported in rooms(modules).items():
        if here != "__main__":
            yield from ((here, other) for other in sorted(imported) if other not in order[: order.index(here)])


def edge_imports(modules):
    """(module, what it imports) for every library of the edge in the mathematics, the oracles or the certificates."""
    for name, source in modules.items():
        inner = room(name) in MATHEMATICS or name.startswith(("lyapnet.evaluation.oracles", "lyapnet.claims"))
        if inner and name.rpartition(".")[2] not in SHOWN:
            yield from ((name, i) for i in imports(source, modules) if i.partition(".")[0] in EDGE)


def one_way(modules):
    """The modules in an order in which each imports only earlier ones; lyapnet itself imports when it is asked.

    Raises:
        CycleError: there is none.
    """
    graph = {name: {i for i in imports(source, modules) if i in modules} for name, source in modules.items()}
    graph.pop("lyapnet")
    return list(TopologicalSorter({name: found - {"lyapnet"} for name, found in graph.items()}).static_order())


@pytest.mark.gate
def test_each_folder_imports_only_those_above_it_in_the_docs():
    assert sorted([*order_in_docs(), "__main__"]) == sorted(rooms(sources()))
    assert not list(upward(sources()))


def test_there_are_about_fifteen_folders():
    assert len(order_in_docs()) <= 16


def test_the_prover_knows_no_controller():
    found = {room(i) for name, source in sources().items() if room(name) == "prover" for i in imports(source, {})}
    assert not found & PROVER_NEEDS_NONE_OF


def test_the_command_line_alone_imports_the_lab():
    graph = rooms(sources())
    assert {name for name, imported in graph.items() if "lab" in imported} == {"cli"}


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("lyapnet.task.sets", "from lyapnet.loop.rollout import Rollout"),
        ("lyapnet.task.cost", "import lyapnet.controller"),
        ("lyapnet.training.data", "from lyapnet.lab.sweep import Point"),
        ("lyapnet.loop.programs.terms", "def late():\n    from lyapnet.experiment.config import Config"),
    ],
)
def test_upward_import_is_found(module, line):
    modules = sources()
    found = list(upward({**modules, module: f"{modules[module]}\n{line}\n"}))
    assert [here for here, _ in found] == [room(module)]


def test_modules_import_one_way():
    assert len(one_way(sources())) == len(sources()) - 1


def test_circle_within_a_room_is_found():
    modules = sources()
    circle = {
        **modules,
        "lyapnet.task.systems.base": modules["lyapnet.task.systems.base"]
        + "\nfrom lyapnet.task.systems import SYSTEMS\n",
    }
    with pytest.raises(CycleError):
        one_way(circle)


def test_mathematics_does_not_import_the_edge():
    assert rooms(sources()).keys() >= MATHEMATICS
    assert not list(edge_imports(sources()))


@pytest.mark.parametrize(
    "line",
    [
        "import lightning as L",
        "from omegaconf import OmegaConf",
        "from lightning.pytorch import Callback",
        "def late():\n    import omegaconf.errors",
    ],
)
@pytest.mark.parametrize(
    "module", ["lyapnet.loop.programs.new", "lyapnet.claims.new", "lyapnet.evaluation.oracles.new"]
)
def test_mathematics_that_imports_the_edge_is_found(module, line):
    assert [name for name, _ in edge_imports({**sources(), module: line})] == [module]


STAGES = {  # what is imported in turn in a fresh interpreter
    "command line": "import lyapnet, lyapnet.cli",
    "facts": "import lyapnet.training.config_facts, lyapnet.training.stage_messages, lyapnet.experiment.config",
    "assembly": "import lyapnet.experiment.assembly, lyapnet.training.build_learner, lyapnet.training.task_facts",
    "figures": "import lyapnet.evaluation.figures",
    "training": "lyapnet.train",
    "comparison": "import lyapnet.lab.comparison.execution",
}
WITHOUT_UNIX = "import sys, psutil\nsys.modules |= dict.fromkeys(['fcntl', 'resource'])"  # psutil imports them itself


@pytest.fixture(scope="module")
def loaded():
    """Stage ↦ the modules that are loaded after it and those before it, where no module of Unix alone is found."""
    program = "\n".join([WITHOUT_UNIX, *(f"{line}\nprint(*sys.modules)" for line in STAGES.values())])
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return dict(zip(STAGES, (set(line.split()) for line in done.stdout.splitlines()), strict=True))


@pytest.mark.gate
def test_importing_lyapnet_and_its_command_line_loads_no_heavy_library(loaded):
    heavy = {"torch", "lightning", "matplotlib", "tensorboard", "gymnasium", "casadi"}
    assert not heavy & loaded["command line"]
    assert heavy & loaded["figures"] == {"torch", "matplotlib"}


@pytest.mark.gate
def test_check_says_what_is_written_without_torch_and_the_rest_without_lightning(loaded):
    assert "torch" not in loaded["facts"]
    assert not {"lightning", "matplotlib", "casadi", "scipy", "sympy", "torch._dynamo"} & loaded["assembly"]


@pytest.mark.gate
def test_training_and_comparing_import_no_module_of_unix_alone(loaded):
    assert {"lyapnet.training.run_lock", "lyapnet.lab.comparison.execution"} <= loaded["comparison"]


@pytest.mark.gate
def test_training_loads_neither_bench_nor_comparison(loaded):
    assert "lyapnet.training.experiment" in loaded["training"]
    assert (
        not {"lyapnet.lab.bench", "lyapnet.lab.comparison", "gymnasium", "casadi", "stable_baselines3"}
        & loaded["training"]
    )
