"""Independent random streams from one seed."""

import numpy as np
import torch

TRAINING, VALIDATION, TEST, FIGURES, CERTIFICATION, POINTS, START, LOST, NOISE, PLANTS, OUTPUTS, SEARCH = range(12)


def stream(seed: int, *path: int) -> torch.Generator:
    """A generator for one purpose; streams of different (seed, path) are independent, and equal on every machine."""
    state = np.random.SeedSequence(seed, spawn_key=path).generate_state(1, np.uint64)[0]
    return torch.Generator().manual_seed(int(state))
