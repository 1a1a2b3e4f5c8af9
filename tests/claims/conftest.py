"""For tests of claims."""

import pytest

from lyapnet.prover import counterexamples


@pytest.fixture(scope="module", autouse=True)
def _short_ascents():
    """Half of a proof of a small closed loop would be the ascent to counterexamples, which no certificate relies on.

    What one finds lowers the level that is proved; what none finds has to be excluded by bounds. In tests/prover,
    test_counterexamples.py ascends all the way.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(counterexamples, "STEPS", 6)
        yield
