"""What lyapnet 0.3 called its modules still leads to them."""

import subprocess
import sys
from importlib import import_module

import pytest

from lyapnet.base.moved_modules import MOVED
from lyapnet.experiment.assembly.classes import resolve
from lyapnet.task.systems import ControlAffineSystem, Pendulum


@pytest.mark.parametrize("former", MOVED)
def test_a_former_name_is_the_same_module(former):
    found = import_module(f"lyapnet.{former}")
    assert found is import_module(f"lyapnet.{MOVED[former]}")
    assert found.__name__ == found.__spec__.name == f"lyapnet.{MOVED[former]}"


@pytest.mark.gate
def test_modules_within_are_the_same_too():
    program = (
        "import sys, lyapnet.certification.funnel, lyapnet.claims.funnel; "
        "from lyapnet.systems.pendulum import Pendulum as former; from lyapnet.task.systems import Pendulum; "
        "print(sys.modules['lyapnet.certification.funnel'] is sys.modules['lyapnet.claims.funnel'], former is Pendulum)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "True True\n"


def test_a_config_may_name_a_class_by_its_former_module():
    assert resolve("lyapnet.systems:Pendulum", {}, "system.name", ControlAffineSystem) is Pendulum


def test_what_became_a_function_says_so():
    with pytest.raises(ModuleNotFoundError, match=r"lyapnet\.export is a function since 0\.4: lyapnet\.export\("):
        import_module("lyapnet.export")


@pytest.mark.parametrize("name", ["lyapnet.systems.no_such", "lyapnet.no_such", "lyapnet.certification.no_such"])
def test_what_never_was_is_not_found(name):
    with pytest.raises(ModuleNotFoundError, match=r"No module named"):
        import_module(name)
