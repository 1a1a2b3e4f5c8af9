"""Measurements of lyapnet itself and against others; nothing but the command line imports it."""
