"""What a process may use of the machine, and what it has used."""

import os
import subprocess
import sys

import pytest

from lyapnet.base.machine import usable_cores

ON_ONE_CORE = """
import os
from lyapnet.base.machine import usable_cores
os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
print(usable_cores())
"""
HOLDING = """
from lyapnet.base.machine import peak_memory
size = peak_memory() + 2**26  # a process begins with the peak of the one that started it
held = b"1" * size
del held
print(size, peak_memory())
"""


def printed(program):
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return [int(number) for number in done.stdout.split()]


def test_cores_are_those_of_the_process():
    assert usable_cores() == len(os.sched_getaffinity(0))
    assert printed(ON_ONE_CORE) == [1]


@pytest.mark.gate
def test_peak_of_memory_is_in_bytes_and_outlives_what_was_held():
    size, peak = printed(HOLDING)
    assert size < peak < size + 2**27
