"""lyapnet systems."""

import gc
import os
import re
import subprocess
import sys

import pytest

from lyapnet import cli
from lyapnet.cli import main
from lyapnet.loop.programs import PROGRAMS
from lyapnet.task.constraints import CONSTRAINTS
from lyapnet.task.control_sets import CONTROL_SETS
from lyapnet.task.cost import COSTS
from lyapnet.task.systems import BY_EQUATIONS, SYSTEMS
from lyapnet.value.networks import NETWORKS
from tests.marks import sample


def test_systems_command_lists_every_registered_system(capsys, monkeypatch, build_system):
    monkeypatch.setenv("COLUMNS", "1000")
    assert main(["systems"]) == 0
    *rows, equations, cost, controls, constraints, network, program, _ = capsys.readouterr().out.splitlines()
    for name in SYSTEMS:
        (row,) = [row for row in rows if re.search(rf"\b{name}\b", row)]
        system = build_system(name)
        if name != "linear":
            for word in (*system.state_names, *system.state_units, *system.control_names, *system.control_units):
                assert word in row
    listed = (
        (equations, BY_EQUATIONS),
        (cost, COSTS),
        (controls, CONTROL_SETS),
        (constraints, CONSTRAINTS),
        (network, NETWORKS),
    )
    for line, known in ((equations, BY_EQUATIONS), *listed, (program, PROGRAMS)):
        assert line.split(": ")[1].split(", ") == list(known)


def into(output, command):
    """(status, standard error) of a command whose standard output is a descriptor."""
    done = subprocess.run([sys.executable, "-m", "lyapnet", *command], stdout=output, stderr=subprocess.PIPE, text=True)
    return done.returncode, done.stderr


@pytest.mark.parametrize("command", sample([["--version"], ["systems"], ["--help"]], 3))
def test_an_output_that_nobody_reads_ends_the_command_silently(command):
    read, write = os.pipe()
    os.close(read)
    assert into(write, command) == (141, "")
    os.close(write)


def test_code_of_the_users_own_that_leaves_is_named(monkeypatch, capsys):
    monkeypatch.setattr("lyapnet.cli.app", lambda *arguments, **options: sys.exit(3))
    assert main(["systems"]) == 1
    assert "Expected code of your own that returns, got SystemExit: 3" in capsys.readouterr().err


@pytest.mark.parametrize(("imported", "searched"), [("lyapnet.base", "garbage"), ("lyapnet.cli", "")])
def test_a_command_ends_without_a_last_search_for_garbage(imported, searched):
    code = f"import {imported}\nclass Cycle:\n    def __del__(self): print('garbage')\nx = Cycle()\nx.x = x\ndel x"
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()
        == searched
    )


def test_commands_seldom_search_for_garbage_and_leave_that_as_it_was(monkeypatch):
    before, seen = gc.get_threshold(), []
    monkeypatch.setattr(cli, "app", lambda *_, **__: seen.append(gc.get_threshold()[0]))
    try:
        for threshold in (700, 1_000_000):
            gc.set_threshold(threshold)
            assert main(["systems"]) == 0
            assert gc.get_threshold()[0] == threshold
    finally:
        gc.set_threshold(*before)
    assert seen == [cli.ALLOCATIONS, 1_000_000]
