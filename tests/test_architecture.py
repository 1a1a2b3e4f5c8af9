"""The layout: which room imports which, that Lightning and OmegaConf stay at the edge, and that imports are light."""

import subprocess
import sys
from graphlib import CycleError, TopologicalSorter

import pytest

from tests.layout import files, functions, imports, levels, room, rooms, sources

# Each line imports only lines above it.
LEVELS = (
    {
        "drawing",
        "errors",
        "findings",
        "interpolation",
        "machine",
        "operators",
        "provenance",
        "random_streams",
        "recipe",
        "shapes",
        "tables",
        "types",
    },
    {"linear_algebra", "sizes"},
    {"files"},
    {"cluster", "constraints", "contracts", "cost", "derivatives", "devices", "horizon", "schema", "sets", "systems"},
    {"domain"},
    {"calculus", "checkpoint", "graphs", "operating_points", "problem"},
    {"expansions", "family", "networks"},
    {"after_horizon", "linearisation", "policy", "regulator"},
    {"beyond", "rollout"},
    {"programs"},
    {"config"},
    {"build"},
    {"controller"},
    {"evaluation", "export", "importing", "loading"},
    {"certification"},
    {"bench", "training", "view", "zoo"},
    {"comparison"},
    {"cli"},
    {"__main__"},
)
MATHEMATICS = {
    "after_horizon", "beyond", "calculus", "constraints", "contracts", "cost", "derivatives", "domain", "errors",
    "expansions", "family", "files", "findings", "graphs", "horizon", "interpolation", "linear_algebra",
    "linearisation", "networks", "operating_points", "operators", "policy", "problem", "programs", "random_streams",
    "regulator", "rollout", "sets", "shapes", "systems", "types",
}  # fmt: skip
EDGE = {"lightning", "omegaconf", "typer", "rich", "tensorboard", "matplotlib"}
SHOWN = {"figures", "tables", "report"}  # files of other rooms that may draw or print


def upward(modules):
    """(room, what it imports) for every import of a room from the same line or a later one."""
    line = {name: number for number, names in enumerate(LEVELS) for name in names}
    for here, imported in rooms(modules).items():
        yield from ((here, other) for other in sorted(imported) if line.get(other, 99) >= line.get(here, -1))


def edge_imports(modules):
    """(module, what it imports) for every library of the edge in the mathematics, the oracles or the certificates."""
    for name, source in modules.items():
        inner = room(name) in MATHEMATICS or name.startswith(("lyapnet.evaluation.oracles", "lyapnet.certification"))
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
def test_every_room_stands_on_its_level():
    assert set().union(*LEVELS) == rooms(sources()).keys()
    assert not list(upward(sources()))
    assert max(levels(rooms(sources())).values()) <= 18


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("lyapnet.sets", "from lyapnet.rollout import Rollout"),
        ("lyapnet.cost", "import lyapnet.problem"),
        ("lyapnet.training.data", "from lyapnet.comparison.sweep import Point"),
        ("lyapnet.programs.terms", "def late():\n    from lyapnet.config import Config"),
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
        "lyapnet.systems.base": modules["lyapnet.systems.base"] + "\nfrom lyapnet.systems import SYSTEMS\n",
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
    "module", ["lyapnet.programs.new", "lyapnet.certification.new", "lyapnet.evaluation.oracles.new"]
)
def test_mathematics_that_imports_the_edge_is_found(module, line):
    assert [name for name, _ in edge_imports({**sources(), module: line})] == [module]


def test_files_and_functions_stay_short():
    assert [(lines, name) for lines, name in files(sources()) if lines > 400] == []
    long = [(lines, name) for lines, name in functions(sources()) if lines > 60 and not name.startswith("lyapnet.cli")]
    assert long == []  # a command's function is its options


def loaded(*statements):
    """The modules that are loaded after the statements, in a fresh interpreter."""
    program = "\n".join([*statements, "import sys", "print(*sys.modules)"])
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


@pytest.mark.gate
def test_importing_lyapnet_and_its_command_line_loads_no_heavy_library():
    heavy = {"torch", "lightning", "matplotlib", "tensorboard", "gymnasium", "casadi"}
    assert not heavy & loaded("import lyapnet", "import lyapnet.cli")
    assert heavy & loaded("import lyapnet.evaluation.figures") == {"torch", "matplotlib"}


@pytest.mark.gate
def test_check_says_what_is_written_without_torch_and_the_rest_without_lightning():
    assert "torch" not in loaded("import lyapnet.training.fact, lyapnet.training.stages, lyapnet.config")
    slow = {"lightning", "matplotlib", "casadi", "scipy", "sympy", "torch._dynamo"}
    assert not slow & loaded("import lyapnet.build, lyapnet.training.build_learner, lyapnet.training.facts")


@pytest.mark.gate
def test_training_and_comparing_import_no_module_of_unix_alone():
    without = "sys.modules |= dict.fromkeys(['fcntl', 'resource'])"
    psutil = "import sys, psutil"  # which on Linux imports them itself
    found = loaded(psutil, without, "import lyapnet.training.experiment, lyapnet.comparison.execution")
    assert "lyapnet.training.run_lock" in found


@pytest.mark.gate
def test_training_loads_neither_bench_nor_comparison():
    found = loaded("import lyapnet", "lyapnet.train")
    assert "lyapnet.training.experiment" in found
    assert not {"lyapnet.bench", "lyapnet.comparison", "gymnasium", "casadi", "stable_baselines3"} & found
