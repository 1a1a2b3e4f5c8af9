"""Fits to optima that are quick, and less right."""

import pytest

from lyapnet.training import pretraining


def shorten_fits(patch: pytest.MonkeyPatch, first: int, later: int) -> None:
    """Fit in fewer steps, before and after the fitted law shows where it leads, by any method."""
    for name in ("SMOOTH", "WITH_LIMITS"):
        patch.setattr(pretraining, name, getattr(pretraining, name)._replace(steps=(first, later)))
