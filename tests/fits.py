"""Fits to optima that are quick, and less right."""

from contextlib import contextmanager

import pytest

from lyapnet.training import pretraining


def shorten_fits(patch: pytest.MonkeyPatch, first: int, later: int) -> None:
    """Fit in fewer steps, before and after the fitted law shows where it leads, by any method."""
    for name in ("SMOOTH", "WITH_KINKS"):
        patch.setattr(pretraining, name, getattr(pretraining, name)._replace(steps=(first, later)))


@contextmanager
def few_optima(count, first, later):
    """Starts that are sought with some optima and short fits; brief ones of 10 steps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lyapnet.training.start.MAX_OPTIMA", count)
        shorten_fits(patch, first, later)
        patch.setattr("lyapnet.training.pretraining.BRIEF_STEPS", 10)
        yield
