"""Columns of a CSV file: names, units, and what is missing."""

import math

import numpy as np
import pytest

from lyapnet.base.errors import UsageError
from lyapnet.lab.identification import read_measurements
from lyapnet.lab.identification.measurements import readable
from lyapnet.lab.identification.units import UNITS, factor, name_and_unit
from lyapnet.task.systems import SYSTEMS, Cartpole, Pendulum

ROWS = "0,0.5,90,1\n10,-0.5,180,2\n25,0,270,3\n"


def read(folder, text, system=None):
    path = folder / "data.csv"
    path.write_text(text)
    return read_measurements(path, system or Pendulum())


def test_columns_are_found_by_name_and_converted(tmp_path):
    read_one = read(tmp_path, f"time (ms),torque [mN·m],angle [deg],temperature\n{ROWS}")
    np.testing.assert_allclose(read_one.t, [0, 0.01, 0.025])
    np.testing.assert_allclose(read_one.u, [[5e-4], [-5e-4], [0]])
    np.testing.assert_allclose(read_one.y, np.array([[0.5], [1.0], [1.5]]) * math.pi)
    assert (read_one.outputs, read_one.unread) == (("angle",), ("temperature",))


def test_an_underscore_stands_for_a_space_and_order_does_not_matter(tmp_path):
    rows = "1,2,0,0.1\n3,4,1,0.1\n5,6,2,0.1\n"
    found = read(tmp_path, f"pole_angle,cart_position,t,force\n{rows}", Cartpole())
    assert found.outputs == ("cart position", "pole angle"), "as the system has them"
    np.testing.assert_array_equal(found.y, [[2, 1], [4, 3], [6, 5]])


@pytest.mark.parametrize(
    ("heading", "expected"),
    [("angle", ("angle", "")), ("angle [deg]", ("angle", "deg")), ("pole rate(rpm)", ("pole rate", "rpm"))],
)
def test_headings(heading, expected):
    assert name_and_unit(heading) == expected


@pytest.mark.parametrize(
    ("unit", "wanted", "expected"),
    [("rpm", "rad/s", math.pi / 30), ("L/min", "m³/s", 1 / 60_000), ("Nm", "N·m", 1), ("", "m", 1), ("", "", 1),
     ("furlong", "furlong", 1), ("km/h", "m/s", 1 / 3.6), ("deg", "rad", math.pi / 180)],
)  # fmt: skip
def test_factors(unit, wanted, expected):
    assert factor(unit, wanted, "x") == pytest.approx(expected)


@pytest.mark.parametrize(("unit", "wanted"), [("m", "rad"), ("deg", ""), ("parsec", "m"), ("rad", "rad/s")])
def test_a_unit_of_another_kind_is_refused(unit, wanted):
    with pytest.raises(UsageError, match=r"Expected x in a unit of its kind .*, got .*; convert the column\."):
        factor(unit, wanted, "x")


def test_units_of_registered_systems_are_known():
    """Else no column of theirs could have another one."""
    with_units = {unit for cls in SYSTEMS.values() for unit in (*cls.state_units, *cls.control_units) if unit}
    assert {unit for unit in with_units if unit not in UNITS} <= {"1", "1/s", "1/s²"}


def test_pieces_begin_with_whole_segments(tmp_path):
    t = "".join(f"{k},0,0\n" for k in range(130))
    found = read(tmp_path, f"t,torque,angle\n{t}")
    assert [len(piece) for piece in found.pieces(40)] == [40, 40, 50], "a short rest belongs to the last one"
    assert [len(piece) for piece in found.pieces(200)] == [130]
    np.testing.assert_array_equal(np.concatenate([piece.t for piece in found.pieces(40)]), found.t)


class WithOutput(Pendulum):
    """A pendulum whose bob is seen from the side."""

    output_names, output_units = ("height",), ("m",)

    def output(self, x):
        return self.length * x[..., :1].cos()


def test_outputs_are_readings_too(tmp_path):
    system = WithOutput().double()
    assert readable(system) == {"angle": "rad", "velocity": "rad/s", "height": "m"}
    found = read(tmp_path, f"t,torque,height [mm],velocity\n{ROWS}", system)
    assert found.outputs == ("velocity", "height")
    np.testing.assert_allclose(found.y[:, 1], [0.09, 0.18, 0.27])
