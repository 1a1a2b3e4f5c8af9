"""Shared by the tests of rollouts, which are tests of the mathematics and run it in Python."""

import pytest
import torch

from lyapnet.value.policy import HJBPolicy
from tests.problems import problem_of


@pytest.fixture
def traced():
    return False


@pytest.fixture
def policy(system, cost, V):
    return HJBPolicy(problem_of(system, cost), V)


@pytest.fixture
def x0(system):
    return 0.5 * torch.randn(3, system.n)
