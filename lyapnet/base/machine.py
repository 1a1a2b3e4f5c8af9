"""What this process may use of the machine, and what it has used."""

import os
import sys

import psutil


def usable_cores() -> int:
    """The cores that this process may run on."""
    process = psutil.Process()
    if hasattr(process, "cpu_affinity"):  # not on macOS, where a process may run on any
        return len(process.cpu_affinity())
    return os.cpu_count() or 1


def peak_memory() -> int:
    """The most bytes of memory that this process has held at once."""
    if sys.platform == "win32":
        return psutil.Process().memory_info().peak_wset
    import resource  # of Unix alone, where psutil knows no peak

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak  # macOS counts in bytes, the others in KiB
