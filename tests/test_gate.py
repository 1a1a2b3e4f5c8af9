"""The parts of the gate: disjoint, together all of it, each beside the default tests; CI takes one after the other."""

import os
import re
import subprocess
import sys

import pytest

from tests.gate import PARTS, Part, kept_together
from tests.pages import ROOT

FILES = {
    "pytest.ini": """
[pytest]
addopts = -q --strict-markers -m 'not gate and not nightly'
markers =
    gate
    nightly
""",
    "test_apart.py": """
import pytest
def test_default(): pass
@pytest.mark.gate
@pytest.mark.parametrize("k", range(30))
def test_case(k): assert k != 7
@pytest.mark.nightly
def test_night(): pass
""",
    "test_together.py": """
import pytest
@pytest.fixture(scope="module")
def training(): return 0
@pytest.mark.gate
@pytest.mark.parametrize("k", range(9))
def test_case(training, k): assert training == 0
def test_default(training): pass
""",
}
DEFAULT = {"test_apart.py::test_default", "test_together.py::test_default"}
APART = {f"test_apart.py::test_case[{k}]" for k in range(30)}
TOGETHER = {f"test_together.py::test_case[{k}]" for k in range(9)}


@pytest.fixture
def run(tmp_path):
    """Arguments of pytest ↦ what it prints, in a folder of a few tests."""
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    command = [sys.executable, "-m", "pytest", "-p", "tests.gate", "-p", "no:cacheprovider"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}

    def printed(*arguments: str) -> str:
        return subprocess.run(
            [*command, *arguments], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        ).stdout

    return printed


def names(text: str) -> set[str]:
    return set(re.findall(r"^(test_\S+::\S+)", text, re.MULTILINE))


def test_parts_are_disjoint_and_together_all_and_each_has_the_default(run):
    parts = [names(run("--collect-only", "--gate-part", f"{k}/3")) for k in (1, 2, 3)]
    assert all(part >= DEFAULT for part in parts)
    gates = [part - DEFAULT for part in parts]
    assert sorted(name for gate in gates for name in gate) == sorted(APART | TOGETHER)  # each once
    assert all(gate & APART for gate in gates)
    assert [TOGETHER & gate for gate in gates if TOGETHER & gate] == [TOGETHER]
    assert names(run("--collect-only")) == DEFAULT
    assert names(run("--collect-only", "-m", "not nightly")) == DEFAULT | APART | TOGETHER
    assert names(run("--collect-only", "-m", "gate", "--gate-part", "2/3")) == gates[1]


def test_a_part_is_named_and_what_fails_in_it_fails_again(run):
    (number,) = [k for k in range(1, 5) if Part(k, 4).has("test_apart.py::test_case[7]")]
    said = run("--gate-part", f"{number}/4")
    assert said.splitlines()[0].endswith(f"again: pytest --gate-part {number}/4")
    assert "FAILED test_apart.py::test_case[7]" in said
    assert "FAILED" not in run("--gate-part", f"{number % 4 + 1}/4")


@pytest.mark.parametrize("text", ["0/4", "5/4", "2", "a/b", "1/2/3", "-1/4", "1/0"])
def test_what_is_no_part_is_refused(text):
    with pytest.raises(pytest.UsageError, match="Expected --gate-part K/N with 1 ≤ K ≤ N"):
        Part.parse(text)


def test_tests_of_a_shared_fixture_are_kept_together():
    file, name = "tests/a.py", "tests/a.py::test[0]"
    assert kept_together(name, [("module", file)]) == file
    assert kept_together(name, [("function", file), ("session", "tests"), ("module", "tests/b.py")]) == name


def test_commits_in_a_row_have_all_parts(tmp_path):
    """The lines of .ci/run that choose one, in a repository of its own; a merge counts as one commit."""
    (chosen,) = re.findall(r"^# The part of the gate.*?\n\n", (ROOT / ".ci/run").read_text("utf-8"), re.M | re.DOTALL)

    def git(*arguments: str):
        identity = ["-c", "user.name=a", "-c", "user.email=a@b"]
        subprocess.run(["git", *identity, *arguments], cwd=tmp_path, check=True, capture_output=True)

    def part(*arguments: str, place=tmp_path) -> str:
        script = f"set -euo pipefail\n{chosen}echo $part"
        return subprocess.run(
            ["bash", "-c", script, "run", *arguments], cwd=place, check=True, capture_output=True, text=True
        ).stdout.strip()

    git("init", "--quiet", "--initial-branch", "main")
    parts = []
    for k in range(PARTS + 1):
        if k == 3:
            git("checkout", "--quiet", "-b", "aside")
            for _ in range(2):
                git("commit", "--quiet", "--allow-empty", "-m", "aside")
            git("checkout", "--quiet", "main")
            git("merge", "--quiet", "--no-ff", "-m", "merge", "aside")
        else:
            git("commit", "--quiet", "--allow-empty", "-m", f"commit {k}")
        parts.append(part())
    assert set(parts[:PARTS]) == {f"{k}/{PARTS}" for k in range(1, PARTS + 1)}
    assert parts[PARTS] == parts[0]
    assert part("1/1") == "1/1"
    subprocess.run(["git", "clone", "--quiet", "--depth", "1", f"file://{tmp_path}", tmp_path / "shallow"], check=True)
    assert (
        Part.parse(part(place=tmp_path / "shallow")).of == PARTS
    )  # by the hash of the commit: its number is not known
