"""Traced functions as flat programs on tensors, run by a kernel that is compiled once for a machine, not for a task."""
