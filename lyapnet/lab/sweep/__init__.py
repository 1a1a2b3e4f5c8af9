"""Runs of one or more configs side by side, with one key varied."""
