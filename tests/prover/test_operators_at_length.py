"""All of torch's operators as in test_operators.py, on tensors of more shapes."""

from functools import partial

import pytest

from tests.prover.test_operators import SHAPES, examined, require_refused_or_bounded


@pytest.mark.nightly
def test_each_operator_is_refused_or_bounded_on_all_shapes():
    require_refused_or_bounded(partial(examined, tries=2 * len(SHAPES)))
