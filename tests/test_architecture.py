"""The import rules: Lightning and OmegaConf stay at the edge, imports run one way, and importing lyapnet is light."""

import ast
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1] / "lyapnet"
FLOW = (
    "errors", "types", "linear_algebra", "sets", "systems", "cost", "calculus", "networks", "policy", "closed_loop",
    "tracing", "compilation", "runge_kutta", "discrete_adjoint", "rollout", "programs",
)  # fmt: skip
CORE = (*FLOW, "oracles", "certification")
EDGE = ("lightning", "omegaconf", "typer", "rich", "tensorboard", "matplotlib")


def sources(root=ROOT):
    """Full module name ↦ source of every file of the package."""
    names = {path: ".".join(path.relative_to(root.parent).with_suffix("").parts) for path in root.rglob("*.py")}
    return {name.removesuffix(".__init__"): path.read_text(encoding="utf-8") for path, name in names.items()}


def imports(source, modules):
    """Full names that a source imports, wherever in it: a name of `modules` where it is one, else the module's."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, "Expected absolute imports, got a relative one; write the full name."
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                yield full if full in modules else str(node.module)


def part(name):
    """The part of lyapnet that a module belongs to: systems for lyapnet.systems.base."""
    return name.partition(".")[2].partition(".")[0]


def edge_imports(modules):
    """(module, what it imports) for every core module that imports a library of the edge."""
    for name, source in modules.items():
        if part(name) in CORE:
            for imported in imports(source, modules):
                if imported.partition(".")[0] in EDGE:
                    yield name, imported


def upstream_imports(modules):
    """(module, what it imports) for every module of the flow that imports what comes later in it."""
    for name, source in modules.items():
        if part(name) in FLOW:
            allowed = FLOW[: FLOW.index(part(name)) + 1]
            yield from ((name, i) for i in imports(source, modules) if i in modules and part(i) not in allowed)


def one_way(modules):
    """The modules in an order in which each imports only earlier ones.

    Raises:
        CycleError: there is none.
    """
    graph = {name: {i for i in imports(source, modules) if i in modules} for name, source in modules.items()}
    return list(TopologicalSorter(graph).static_order())


def test_core_modules_do_not_import_the_edge():
    modules = sources()
    assert {f"lyapnet.{name}" for name in CORE} <= modules.keys()
    assert not list(edge_imports(modules))


@pytest.mark.parametrize(
    "line",
    [
        "import lightning as L",
        "from omegaconf import OmegaConf",
        "from lightning.pytorch import Callback",
        "def late():\n    import omegaconf.errors",
    ],
)
def test_core_module_that_imports_the_edge_is_found(line):
    modules = {**sources(), "lyapnet.programs.new": line}
    assert [name for name, _ in edge_imports(modules)] == ["lyapnet.programs.new"]


def test_imports_run_one_way():
    assert len(one_way(sources())) == len(sources())


def test_imports_follow_the_flow_from_system_to_program():
    assert not list(upstream_imports(sources()))


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("lyapnet.sets", "from lyapnet.rollout import Rollout"),
        ("lyapnet.systems.base", "import lyapnet.cost"),
        ("lyapnet.programs.terms", "def late():\n    from lyapnet.config import Config"),
    ],
)
def test_import_against_the_flow_is_found(module, line):
    modules = sources()
    assert [name for name, _ in upstream_imports({**modules, module: f"{modules[module]}\n{line}\n"})] == [module]


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("lyapnet.rollout", "from lyapnet.controller import load"),
        ("lyapnet.cost", "def late():\n    from lyapnet import programs"),
        ("lyapnet.systems.base", "from lyapnet.systems import SYSTEMS"),
    ],
)
def test_circle_of_imports_is_found(module, line):
    modules = sources()
    with pytest.raises(CycleError):
        one_way({**modules, module: f"{modules[module]}\n{line}\n"})


def loaded(*statements):
    """Top-level packages that are loaded after the statements, in a fresh interpreter."""
    program = "\n".join([*statements, "import sys", "print(*{name.partition('.')[0] for name in sys.modules})"])
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_importing_lyapnet_loads_neither_lightning_nor_matplotlib():
    heavy = {"lightning", "matplotlib", "tensorboard"}
    assert not heavy & loaded("import lyapnet", "import lyapnet.cli")
    assert heavy & loaded("import lyapnet.figures") == {"matplotlib"}
