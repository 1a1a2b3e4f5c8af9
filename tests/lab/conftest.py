"""Measurements that nothing but the command line uses: their tests run at the gate.

Those of identification, whose results go into configs of users, run by default too.
"""

from pathlib import Path

import pytest

HERE = Path(__file__).parent


@pytest.hookimpl(tryfirst=True)  # before tests are deselected by their marks
def pytest_collection_modifyitems(items):
    for item in items:
        measures = item.path.is_relative_to(HERE) and not item.path.is_relative_to(HERE / "identification")
        if measures and item.get_closest_marker("nightly") is None:
            item.add_marker(pytest.mark.gate)
