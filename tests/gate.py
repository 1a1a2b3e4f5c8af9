"""The option --gate-part K/N: the default tests and a part of the gate. A run of CI takes one, N commits in a row all.

A test is in the part that the SHA-256 of its id says; tests that share a fixture of their file stay together, in the
part that the file's name says. Which part a test is in depends on no other test.
"""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass

import pytest

PARTS = 25  # of which .ci/run takes one


@dataclass(frozen=True)
class Part:
    """Part `number` of `of`, counted from 1."""

    number: int
    of: int

    @classmethod
    def parse(cls, text: str) -> "Part":
        numbers = text.split("/")
        if len(numbers) != 2 or not all(n.isdecimal() for n in numbers) or not 1 <= int(numbers[0]) <= int(numbers[1]):
            raise pytest.UsageError(f"Expected --gate-part K/N with 1 ≤ K ≤ N, such as 2/4, got {text!r}.")
        return cls(*map(int, numbers))

    def has(self, name: str) -> bool:
        digest = hashlib.sha256(name.encode()).digest()
        return int.from_bytes(digest[:8], "big") % self.of == self.number - 1

    def __str__(self):
        return f"{self.number}/{self.of}"


def kept_together(nodeid: str, fixtures: Iterable[tuple[str, str]]) -> str:
    """The name by which a test's part is chosen: its file where they share a fixture, else its own id.

    Args:
        nodeid: The id of the test.
        fixtures: (scope, id of the file that has it) of each fixture that the test needs.
    """
    file = nodeid.partition("::")[0]
    return file if any(scope != "function" and place == file for scope, place in fixtures) else nodeid


def pytest_addoption(parser):
    parser.addoption("--gate-part", metavar="K/N", type=Part.parse, help="default tests, and part K of N of the gate")


def pytest_configure(config):
    """With a part of the gate, the gate is not left out: `pytest --gate-part 2/4` is a whole command."""
    if config.option.gate_part and "not gate" in config.option.markexpr:
        config.option.markexpr = "not nightly"


def pytest_sessionstart(session):
    part, reporter = session.config.option.gate_part, session.config.pluginmanager.get_plugin("terminalreporter")
    if part and reporter:
        reporter.write_line(f"the default tests, and part {part} of the gate; again: pytest --gate-part {part}")


@pytest.hookimpl(trylast=True)  # after marks were added, and after tests/conftest.py has noted those of all tests
def pytest_collection_modifyitems(items, config):
    part = config.option.gate_part
    if part is None:
        return
    left = [item for item in items if item.get_closest_marker("gate") and not part.has(_name(item))]
    config.hook.pytest_deselected(items=left)
    items[:] = [item for item in items if item not in set(left)]


def _name(item) -> str:
    definitions = item._fixtureinfo.name2fixturedefs.values()  # pytest tells names alone to plugins, and not scopes
    return kept_together(item.nodeid, [(each[-1].scope, each[-1].baseid) for each in definitions])
