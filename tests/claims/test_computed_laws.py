"""Readings of a law that a program computes."""

import pytest
import torch

from lyapnet.base.errors import ExportError, UsageError
from lyapnet.claims.computed_laws import add_program_errors
from lyapnet.graphs.tracing import core_trace
from lyapnet.prover.float_errors import FloatLaw
from lyapnet.prover.readings import Readings
from lyapnet.task.sets import Box

D = Box([0.0, -1.0], [0.0, 1.0])
HELD = Readings(0.1, 0.0, (0.0, 0.5), (0.25,), 2.0)
UNIT = 2.0**-24


def law_of(function, sha256="a"):
    at = [torch.tensor(0.3).double(), torch.tensor([0.2, 0.7]).double()]
    graph = core_trace(lambda t, x: (function(x),), at, "it", ExportError)
    return FloatLaw(graph, [2], torch.float32, [0.0], 1.9, sha256, "")


def test_errors_count_where_the_state_is_measured():
    """|x₂| ≤ 1 + 0.5; 2x₂ has the error of x₂."""
    found = add_program_errors(law_of(lambda x: 2 * x[1:]), HELD, D, [0])
    assert 3 * UNIT <= found.computed.errors[0] <= 1.25 * 3 * UNIT
    assert found.control_errors == (0.25 + found.computed.errors[0],)
    assert found.computed.latest == 1.9


def test_states_that_are_left_out_are_taken_far_out():
    (error,) = add_program_errors(law_of(lambda x: x[1:] + x[:1]), HELD, D, [0]).computed.errors
    assert error >= 1e6 * UNIT
    (same,) = add_program_errors(law_of(lambda x: 2 * x[1:] + 0 * x[:1]), HELD, D, [0]).computed.errors
    assert same < 10 * UNIT


def test_kept_readings_are_compared():
    law = law_of(lambda x: 2 * x[1:])
    kept = add_program_errors(law, HELD, D, [0])
    assert add_program_errors(law, kept, D, [0]) == kept
    assert add_program_errors(None, HELD, D, [0]) is HELD
    assert add_program_errors(None, None, D, [0]) is None
    with pytest.raises(UsageError, match=r"Expected --file with the C of this proof, of SHA-256 a, got none; .+\."):
        add_program_errors(None, kept, D, [0])
    with pytest.raises(UsageError, match=r"Expected --file with the C of this proof, of SHA-256 a, got b; .+\."):
        add_program_errors(law_of(lambda x: 2 * x[1:], "b"), kept, D, [0])
    with pytest.raises(UsageError, match=r"Expected errors of the C of at most .+, as in this proof, got .+; prove"):
        add_program_errors(law_of(lambda x: 3 * x[1:]), kept, D, [0])
