"""How the package is laid out: entries, import levels, longest files and functions. python tests/layout.py [PACKAGE]

A room is a top-level entry of the package, a file or a folder; its level is one more than that of the highest room that
it imports, wherever in its code. An import that runs back up, from a room to one that needs it, is upward.
"""

import ast
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import NamedTuple

PACKAGE = Path(__file__).parents[1] / "lyapnet"


def sources(package: Path = PACKAGE) -> dict[str, str]:
    """Full module name ↦ source of every file of a package."""
    names = {path: ".".join(path.relative_to(package.parent).with_suffix("").parts) for path in package.rglob("*.py")}
    return {name.removesuffix(".__init__"): path.read_text(encoding="utf-8") for path, name in names.items()}


def imports(source: str, modules: Mapping[str, str]) -> Iterator[str]:
    """Full names that a source imports, wherever in it: a name of `modules` where it is one, else the module's."""
    for module, name in _import_statements(source):
        full = f"{module}.{name}"
        yield full if name and full in modules else module


@cache  # of each source: a package is asked about many times
def _import_statements(source: str) -> tuple[tuple[str, str], ...]:
    """(module, name that is imported from it, or "" where it is imported itself) of a source's imports."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [(alias.name, "") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, "Expected absolute imports, got a relative one; write the full name."
            found += [(str(node.module), alias.name) for alias in node.names]
    return tuple(found)


def room(name: str) -> str:
    """The top-level entry that a module belongs to: systems for lyapnet.task.systems.base; "" for lyapnet itself."""
    return name.partition(".")[2].partition(".")[0]


def rooms(modules: Mapping[str, str]) -> dict[str, set[str]]:
    """Room ↦ the other rooms that it imports. lyapnet itself, whose names are imported when asked for, is none."""
    found: dict[str, set[str]] = defaultdict(set)
    for name, source in modules.items():
        if here := room(name):
            found[here] |= {room(i) for i in imports(source, modules) if i in modules} - {here, ""}
    return dict(found)


def levels(graph: Mapping[str, set[str]]) -> dict[str, int]:
    """Room ↦ its level, from 1.

    Raises:
        CycleError: there is a circle.
    """
    found: dict[str, int] = {}
    for name in TopologicalSorter(graph).static_order():
        found[name] = 1 + max((found[i] for i in graph.get(name, ())), default=0)
    return found


class Length(NamedTuple):
    """Of a file or a function."""

    lines: int
    name: str


def files(modules: Mapping[str, str]) -> list[Length]:
    """The files, longest first."""
    return sorted((Length(source.count("\n"), name) for name, source in modules.items()), reverse=True)


def functions(modules: Mapping[str, str]) -> list[Length]:
    """The functions and methods, longest first; a signature and a docstring count."""
    found = [
        Length(node.end_lineno - node.lineno + 1, f"{name}.{node.name}")
        for name, source in modules.items()
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.end_lineno
    ]
    return sorted(found, reverse=True)


def main(package: Path) -> None:
    """Print the layout of a package."""
    modules = sources(package)
    print(f"{len(modules)} modules, {sum(source.count(chr(10)) for source in modules.values())} lines")
    graph = rooms(modules)
    try:
        found = levels(graph)
    except CycleError as error:
        print(f"{len(graph)} entries at the top; a circle of rooms: {' → '.join(error.args[1])}")
    else:
        print(f"{len(graph)} entries at the top on {max(found.values())} levels, no upward import")
        for level in sorted(set(found.values())):
            print(f"{level:>3}  {'  '.join(sorted(name for name in found if found[name] == level))}")
    for what, lengths in (("files", files(modules)), ("functions", functions(modules))):
        print(f"longest {what}: {', '.join(f'{name} {lines}' for lines, name in lengths[:5])}")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if sys.argv[1:] else PACKAGE)
