"""Each group of tests that guards what is proved, read or kept has a sample by default, and all of it in CI.

CI takes a 25th of the gate with each commit, tests/gate.py: 25 commits in a row have all of it.
"""

import pytest

from tests.marks import at_the_gate, sample
from tests.pages import ROOT

GROUPS = {  # name ↦ files of its tests, or beginnings of their names in a file
    "false claims": ["claims/test_false_claims.py"],
    "false attempts": ["claims/test_false_attempts.py"],
    "negative controls": ["claims/test_negative_controls.py"],
    "rules of operators": ["prover/test_rules.py"],
    "all operators": ["prover/test_operators.py", "exchange/importing/test_operators.py"],
    "broken files": ["test_malformed.py::test_what"],
    "hostile files": ["test_hostile_files.py"],
    "files that run something": ["test_evil_files.py"],
    "kills": ["experiment/test_checkpoint.py::test_kill", "training/test_runs.py::test_killed"],
}


def faults(marks: dict[str, set[str]], beginnings: list[str]) -> list[str]:
    """What is wrong with a group, from the marks of all tests by their ids."""
    by_beginning = [[name for name in marks if name.startswith(f"tests/{beginning}")] for beginning in beginnings]
    names = [name for each in by_beginning for name in each]
    found = [f"no test in {beginning}" for beginning, its in zip(beginnings, by_beginning, strict=True) if not its]
    found += [f"off in CI: {name}" for name in names if "nightly" in marks[name]]
    if all(marks[name] & {"gate", "nightly"} for name in names):
        found.append(f"no test of {', '.join(beginnings)} by default")
    return found


@pytest.mark.parametrize("group", GROUPS)
def test_a_group_has_a_sample_by_default_and_none_of_it_at_night(group, marks):
    files = {f"tests/{beginning.partition('::')[0]}" for beginning in GROUPS[group]}
    assert [file for file in files if not (ROOT / file).is_file()] == []
    if not files <= {name.partition("::")[0] for name in marks}:
        pytest.skip("its files were not collected")
    assert faults(marks, GROUPS[group]) == []


def test_ids_are_the_same_on_every_machine(marks):
    """Else a test is in another part of the gate elsewhere."""
    assert [name for name in marks if str(ROOT) in name] == []


def test_a_group_without_a_sample_or_in_part_off_is_found():
    good = {"tests/a.py::test[0]": set(), "tests/a.py::test[1]": {"gate"}, "tests/b.py::other": {"nightly"}}
    assert faults(good, ["a.py"]) == []
    assert faults(good, ["a.py", "c.py"]) == ["no test in c.py"]
    assert faults({**good, "tests/a.py::test[0]": {"gate"}}, ["a.py"]) == ["no test of a.py by default"]
    assert faults({**good, "tests/a.py::test[2]": {"nightly"}}, ["a.py"]) == ["off in CI: tests/a.py::test[2]"]


def test_samples():
    assert [hasattr(case, "marks") for case in sample("abcde", 2)] == [False, True, False, True, False]
    assert at_the_gate((1, 2)).values == (1, 2)
    named = at_the_gate(pytest.param(3, id="three", marks=pytest.mark.xfail))
    assert (named.values, named.id, {mark.name for mark in named.marks}) == ((3,), "three", {"xfail", "gate"})
