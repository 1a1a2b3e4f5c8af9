"""Traced functions as flat programs on tensors, which one kernel runs: compiled once for a machine, not for a task."""
