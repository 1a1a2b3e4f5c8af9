"""Counterexamples where no sample is: the ascent goes up to them."""

import math

import pytest
import torch

from lyapnet.prover import counterexamples
from lyapnet.prover.condition import bounded_condition
from lyapnet.prover.counterexamples import find_counterexample, violations
from tests.claims.planted import Planted, domain, loop, riccati

POINT, SIDE = torch.tensor([1.0, 0.0, 0.0]).double(), 0.3  # where c has no slope


@pytest.fixture(scope="module", autouse=True)
def short_ascents():
    """They go all the way here."""


@pytest.fixture
def planted():
    """A condition that fails within 0.03 of a point alone, of a bump that is wider."""
    return Planted(loop(riccati()), 0.9, 0.02).plant(POINT, SIDE, 1e-4)


def found(condition):
    bounded = bounded_condition(condition, domain())
    return find_counterexample(condition, bounded, *domain(), math.inf, torch.Generator().manual_seed(0))


def test_an_ascent_finds_what_no_sample_meets(planted):
    point = found(planted)
    assert torch.linalg.vector_norm(torch.tensor([point.t, *point.x]) - POINT) < 0.03
    assert point.condition > 0
    at = torch.tensor(point.t).double(), torch.tensor(point.x).double()
    assert point.condition == pytest.approx(float(planted(*at).detach()))
    assert point.height == pytest.approx(float(planted.height(*at)))
    assert len(violations(planted, domain(), math.inf, 5, torch.Generator().manual_seed(0))) == 5


def test_without_it_nothing_is_found(planted, monkeypatch):
    """The twin; and with it nothing where nothing is planted."""
    monkeypatch.setattr(counterexamples, "STEPS", 0)
    assert found(planted) is None
    monkeypatch.undo()
    assert found(Planted(loop(riccati()), 0.9, 0.02).plant(POINT, SIDE, -1e-4)) is None
