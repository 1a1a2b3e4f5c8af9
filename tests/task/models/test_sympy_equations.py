"""Right-hand sides in SymPy: against SymPy's own evaluation, Kane's method, and what is refused."""

import numpy as np
import pytest
import sympy
import torch
from sympy.physics import mechanics
from torch.testing import assert_close

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.task.systems import Pendulum

q, w, torque = mechanics.dynamicsymbols("q w torque")
m, length = sympy.symbols("m length")
X = torch.randn(20, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def test_kanes_pendulum_is_the_registered_one():
    frame, point = mechanics.ReferenceFrame("N"), mechanics.Point("O")
    point.set_vel(frame, 0)
    arm = frame.orientnew("A", "Axis", [q, frame.z])
    arm.set_ang_vel(frame, w * frame.z)
    tip = point.locatenew("P", length * arm.y)
    tip.v2pt_theory(point, frame, arm)
    loads = [(tip, -9.81 * m * frame.y), (arm, torque * frame.z)]
    kane = mechanics.KanesMethod(frame, [q], [w], [q.diff() - w])
    kane.kanes_equations([mechanics.Particle("bob", tip, m)], loads)
    system = lyapnet.sympy_system(kane.rhs(), {q: "rad", w: "rad/s"}, {torque: "N·m"}, {m: 2.0, length: 0.5}, [q])
    other = Pendulum(mass=2.0, length=0.5, damping=0.0, gravity=9.81).double()
    assert system.affine
    assert system.state_labels == ["q (rad)", "w (rad/s)"]
    assert_close(system.f(X), other.f(X))
    assert_close(system.g(X), other.g(X).expand(20, 2, 1))


@pytest.mark.parametrize(
    "expression",
    [
        sympy.sin(q) * sympy.exp(-(w**2)) + sympy.sqrt(1 + q**2), sympy.Abs(q) * sympy.sign(w), sympy.Max(q, w, 0),
        sympy.Piecewise((q, q > w), (w**3, True)), sympy.atan2(q, w) + sympy.pi, sympy.Rational(1, 3) * q**-2,
        sympy.tanh(q) + sympy.acos(sympy.tanh(w)), sympy.log(q**2) + sympy.cosh(w), sympy.Min(q, w) - sympy.asinh(q),
    ],
)  # fmt: skip
def test_expressions_equal_those_of_sympy(expression):
    system = lyapnet.sympy_system([expression, torque], [q, w], [torque])
    expected = [float(expression.subs({q: a, w: b}).evalf(30)) for a, b in X.tolist()]
    assert_close(system.f(X)[:, 0].numpy(), np.array(expected), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("rates", "part"),
    [
        ([w, m * torque], "got m; give its value"),
        ([w], "Expected a rate for each of 2 states"),
        ([w, torque * q.diff()], "unknown functions"),
        ([w, torque * sympy.gamma(q)], "gamma"),
    ],
)
def test_what_has_no_value_or_expression_is_named(rates, part):
    with pytest.raises(UsageError, match="Expected") as error:
        lyapnet.sympy_system(rates, [q, w], [torque])
    assert part in str(error.value)
