"""Drawings by equations: the shapes of a registered system, counts of numbers, and texts in files."""

import numpy as np
import pytest
import yaml

from lyapnet.base.errors import UsageError
from lyapnet.base.shapes import Line, corners_of
from lyapnet.experiment.config import MOST_LINES, abridge_texts, config_from_plain, to_yaml
from lyapnet.task.systems import Cartpole
from lyapnet.task.systems.equations import defined

EQUATIONS = "der(position) = velocity\nder(angle) = rate\nder(velocity) = force\nder(rate) = force"
STATES = {"position": "m", "angle": "rad", "velocity": "m/s", "rate": "rad/s"}
DRAWING = """
x = position + length*sin(angle)  # the pole's end
y = length*cos(angle)
faint(min(position, 0) - length, 0, max(position, 0) + length, 0)
a = position - 0.2*length
b = position + 0.2*length
polygon(a, -0.1*length, b, -0.1*length, b, 0.1*length, a, 0.1*length)
line(position, 0, x, y)
disk(x, y, 0.07*length if length == length else 1)
arrow(position, 0, position + length*force/(9.81*(1 + 0.5)), 0)
"""


def system_of(drawing):
    return defined(EQUATIONS, STATES, {"force": "N"}, ["length"], drawing=drawing)(length=0.8)


def test_a_cart_and_its_pole_are_drawn_as_the_registered_ones():
    system, known = system_of(DRAWING), Cartpole(pole_mass=0.5, length=0.8)
    random = np.random.default_rng(0)
    for _ in range(5):
        x, u = random.normal(size=4), random.normal(size=1)
        pairs = [*zip(system.draw(x, u), known.draw(x, u), strict=True)]
        for got, expected in pairs:
            assert type(got) is type(expected)
            np.testing.assert_allclose(np.sort(corners_of(got), 0), np.sort(corners_of(expected), 0), atol=1e-12)
            if isinstance(expected, Line):
                assert (got.width, got.faint) == (expected.width, expected.faint)


def test_nothing_is_drawn_without_a_drawing():
    assert system_of("").draw(np.zeros(4), np.zeros(1)) == []


@pytest.mark.parametrize(("text", "part"), [
    ("circle(0, 0, 1)", "Expected a shape (line, faint, polygon, disk, arrow) or name = expression in line 1"),
    ("x = 1\nline(0, 0, 1)", "Expected 4 numbers or more, in pairs x, y, for line in line 2 of drawing, got 3"),
    ("line(0, 0)", "got 2"), ("disk(0, 0)", "Expected 3 numbers for disk"), ("disk(0, 0, 1, 1, 1)", "got 5"),
    ("arrow(0, 0, 1, 1, 2, 2)", "Expected 4 numbers for arrow"), ("polygon(0, 0, 1, 1)", "Expected 6 numbers or more"),
    ("line(0, 0, top, 1)", "got top"), ("disk(0, 0, r=1)", "got 'disk(0, 0, r=1)'"), ("import os", "got 'import os'"),
    ("disk(0, 0, __import__('os'))", "Expected a known function"), ("3", "got '3'"), ("disk(\0)", "Expected"),
    ("disk(0, 0, " + "(" * 10_000 + "1" + ")" * 10_000 + ")", "Expected"),
])  # fmt: skip
def test_other_lines_are_refused(text, part):
    with pytest.raises(UsageError, match=r"Expected .+, got.+[;:,] .+[.?]") as error:
        system_of(text)
    assert part in str(error.value)


TASK = {
    "experiment": "drawn", "cost": {"Q": [1] * 4, "R": 1, "Q_T": [1] * 4}, "horizon": {"steps": 5, "dt": 0.1},
    "initial_states": {"lower": [-1] * 4, "upper": [1] * 4},
}  # fmt: skip


@pytest.mark.parametrize("ending", ["", "\n"])
def test_both_texts_are_written_line_by_line(ending):
    equations = f"# drawing: TEXT\n{EQUATIONS}"  # as the place of a text is written
    drawing = DRAWING.removesuffix("\n") + ending
    system = {"name": "equations", "equations": equations, "drawing": drawing, "states": STATES,
              "controls": {"force": "N"}, "parameters": {"length": 0.8}}  # fmt: skip
    config = config_from_plain({**TASK, "system": system})
    written = to_yaml(config)
    assert yaml.safe_load(written)["system"]["drawing"] == drawing
    assert yaml.safe_load(written)["system"]["equations"] == equations
    assert "\n    line(position, 0, x, y)\n" in written


def test_loggers_have_the_first_lines():
    drawing = "\n".join(f"disk(0, 0, {k})" for k in range(MOST_LINES + 3))
    system = {"name": "equations", "equations": EQUATIONS, "drawing": drawing, "states": STATES,
              "controls": {"force": "N"}, "parameters": {"length": 0.8}}  # fmt: skip
    shown = abridge_texts(config_from_plain({**TASK, "system": system})).system
    assert shown.drawing.splitlines()[MOST_LINES:] == ["# and 3 further lines, in config.yaml"]
    assert shown.equations == EQUATIONS
