"""The controllers that come with lyapnet: each a checkpoint, and a record of how it was made and what it reaches."""

from lyapnet.zoo.entries import Entry, entries, entry

__all__ = ["Entry", "entries", "entry"]
