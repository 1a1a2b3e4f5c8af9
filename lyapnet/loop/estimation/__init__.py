"""Estimates of states from noisy readings, and whether the readings determine the states."""
