"""Cores and memory of this process."""

import os
import sys

import psutil


def usable_cores() -> int:
    """The cores that this process may run on."""
    process = psutil.Process()
    if hasattr(process, "cpu_affinity"):  # not available on macOS
        return len(process.cpu_affinity())
    return os.cpu_count() or 1


def peak_memory() -> int:
    """The peak memory of this process in bytes."""
    if sys.platform == "win32":
        return psutil.Process().memory_info().peak_wset
    import resource  # on Unix, where psutil has no peak

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak  # in bytes on macOS, else in KiB
