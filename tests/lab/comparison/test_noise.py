"""Environments and comparisons know no noise, and say so."""

import pytest

from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import load_config
from lyapnet.lab.comparison.reference_problems import bounded_problem


def test_an_environment_refuses_noise():
    noisy = build_problem(load_config("conf/pendulum_noise.yaml"))
    with pytest.raises(UsageError, match="Expected a task without noise for an environment"):
        bounded_problem(noisy, 1.0)
    assert bounded_problem(noisy.without_noise(), 1.0).problem.noise is None
