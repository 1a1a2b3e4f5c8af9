"""lyapnet systems."""

import re

from lyapnet.cli import main
from lyapnet.cost import COSTS
from lyapnet.networks import NETWORKS
from lyapnet.programs import PROGRAMS
from lyapnet.sets import CONTROL_SETS
from lyapnet.systems import SYSTEMS


def test_systems_command_lists_every_registered_system(capsys, monkeypatch, build_system):
    monkeypatch.setenv("COLUMNS", "300")
    assert main(["systems"]) == 0
    *rows, cost, controls, network, program, _ = capsys.readouterr().out.splitlines()
    for name in SYSTEMS:
        (row,) = [row for row in rows if re.search(rf"\b{name}\b", row)]
        system = build_system(name)
        if name != "linear":
            for word in (*system.state_names, *system.state_units, *system.control_names, *system.control_units):
                assert word in row
    for line, known in ((cost, COSTS), (controls, CONTROL_SETS), (network, NETWORKS), (program, PROGRAMS)):
        assert line.split(": ")[1].split(", ") == list(known)
