"""What the table of an evaluation shows, and what it leaves to --json."""

import pytest

import lyapnet
from lyapnet.controller.controller import Controller
from lyapnet.evaluation.tables import BOUNDS, ROWS, evaluation_table
from lyapnet.loop.programs import LyapunovProgram, ValueProgram
from tests.problems import untrained


@pytest.fixture(scope="module")
def controller():
    return untrained("double_integrator", "network.hidden=[4,4]", "horizon.steps=20")


@pytest.mark.parametrize(("program", "shown"), [(ValueProgram(), False), (LyapunovProgram(constraint=1), True)])
def test_rows_on_bounds_are_those_of_programs_that_ask_for_one(program, shown, controller):
    result = lyapnet.evaluate(Controller(controller.problem, controller.V, program=program), samples=4, optimum=False)
    labels = {str(cell) for cell in evaluation_table("x", result).columns[0].cells}
    for key in BOUNDS:
        assert key in result
        assert (ROWS[key] in labels) == shown
    assert ROWS["largest_rise"] in labels


def test_a_caption_is_made_of_sentences(controller):
    result = lyapnet.evaluate(controller, samples=4, optimum=False)
    caption = str(evaluation_table("x", result).caption)
    assert caption.startswith("The optimum was not requested.")
    assert "The optimum was" not in str(evaluation_table("x", lyapnet.evaluate(controller, samples=4)).caption)
