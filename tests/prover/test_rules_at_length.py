"""The rules for bounds as in test_rules.py, in more boxes, at more points, and in more compositions."""

import pytest
from hypothesis import given, settings

from tests.prover.test_rules import CASES, ELEMENTARY, EXPRESSIONS, examine, largest_error, outside_of_composition

pytestmark = pytest.mark.nightly


@pytest.mark.parametrize("operation", CASES, ids=str)
def test_no_value_lies_outside_in_ten_thousand_boxes(operation):
    """The twin in test_rules.py finds bounds that are too narrow in 300 of them."""
    counts = [examine(operation, 2000, seed) for seed in range(1, 6)]
    assert sum(outside for outside, _, _ in counts) == 0


@settings(max_examples=1000)
@given(EXPRESSIONS)
def test_no_value_of_a_thousand_compositions_lies_outside(expression):
    assert outside_of_composition(expression) == 0


@pytest.mark.parametrize("name", ELEMENTARY)
def test_elementary_functions_err_by_less_at_a_hundred_thousand_points(name):
    assert largest_error(name, 100_000) < 2
