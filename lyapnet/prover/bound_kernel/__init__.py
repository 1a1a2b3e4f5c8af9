"""Bounds of a function by machine code, on one block of boxes after another."""
