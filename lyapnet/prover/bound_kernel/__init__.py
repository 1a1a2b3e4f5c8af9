"""Bounds of a function by machine code, one block of boxes after another."""
