"""The law as a function block for programmable controllers: its text, computed in Python, is the controller's law."""

import math
import re
import sys

import numpy as np
import pytest
import torch

from lyapnet.base.errors import ExportError, UsageError
from lyapnet.controller.controller import Controller
from lyapnet.exchange.export import export
from lyapnet.exchange.export.c import Style
from lyapnet.exchange.export.law import Law
from lyapnet.exchange.export.structured_text import BlockInPython, comment, run, structured_text
from lyapnet.exchange.export.verification import Points, points
from lyapnet.graphs.structured_text_functions import in_single_precision, real
from lyapnet.graphs.structured_text_in_python import in_python, standard_functions
from lyapnet.graphs.structured_text_library import FURTHER, further_functions
from lyapnet.task.systems import DoubleIntegrator
from tests.exchange.export.test_export import KINDS, controller_of
from tests.marks import sample
from tests.problems import Formula, problem_of

pytest.importorskip("pycparser")
DOUBLE, SINGLE = torch.float64, torch.float32


def text_of(controller, dtype=DOUBLE, tried=None):
    tried = points(controller) if tried is None else tried
    return structured_text(controller, Law(controller, dtype), Style(dtype=dtype), tried)


@pytest.fixture(scope="module")
def limited():
    """A controller with a limit, and its block."""
    controller = controller_of("a limit, held")
    return controller, text_of(controller)


TOLERANCES = {"float64": (1e-9, 1e-6), "float32": (1e-3, 3e-2)}  # as for C; of a law that looks ahead


@pytest.mark.gate
@pytest.mark.parametrize("dtype", TOLERANCES)
@pytest.mark.parametrize("kind", KINDS)
def test_the_block_agrees_with_the_controller(kind, dtype, tmp_path):
    if (kind, dtype) == ("limits on one side", "float32"):  # a limit of 1e150 stands for none
        with pytest.raises(ExportError, match=r"overflow and .* got overflow encountered"):
            export(controller_of(kind), tmp_path / "law.st", "st", dtype=dtype)
        return
    (path,), agreement = export(controller_of(kind), tmp_path / "law.st", "st", dtype=dtype)
    assert agreement.states >= 400
    usual, ahead = TOLERANCES[dtype]
    assert max(agreement.control, agreement.value) < (ahead if "ahead" in kind else usual)
    text = path.read_text(encoding="ascii")
    assert ("LREAL" in text) == (dtype == "float64")
    assert ("lyapnet_parameters" in text) == (kind == "a family")
    assert f"verified: computed in Python, on {agreement.states} states" in text


def test_a_code_tells_where_the_law_was_not_compared(limited):
    controller, text = limited
    block, x0 = BlockInPython(text, Law(controller), DOUBLE), controller.initial_states.upper
    loop = controller.rollout(x0[None])
    results = [block(float(t), x) for t, x in zip(loop.t, loop.x[:, 0].numpy(), strict=True)]
    assert not any(code for _, _, code in results)
    assert [u for u, *_ in results[:-1]] == pytest.approx(loop.u[:, 0].numpy(), rel=1e-9, abs=1e-12)
    far = (x0 + 1e3).numpy()
    assert block(0.1, far)[2] == 2
    assert block(0.0, far)[2] == 2 + 4
    assert block(0.1, np.full(len(x0), np.nan))[2] == 1 + 2
    assert block(math.nan, x0.numpy())[2] == 1


def test_the_value_is_computed_when_asked_for(limited):
    controller, text = limited
    block, x = BlockInPython(text, Law(controller), DOUBLE), controller.initial_states.upper.numpy()
    u, V, code = block(0.0, x)
    assert pytest.approx(float(controller.value(0.0, x))) == V
    assert block(0.0, x, with_value=False) == (u, 0.0, code)


def test_parameters_outside_of_their_box_have_a_code():
    controller = controller_of("a family")
    block = BlockInPython(text_of(controller), Law(controller), DOUBLE)
    state = controller.initial_states.center.numpy()
    assert block(0.1, state)[2] == 0
    state[-1] = 2 * controller.initial_states.upper[-1]
    assert block(0.1, state)[2] == 2


def test_a_comment_stays_a_comment():
    text = comment({"x": "length *) END_FUNCTION_BLOCK (* (m)", "X₀": "−1 ≤ x ≤ 1, Δt, ‖x‖"})
    assert text.isascii()
    assert (text.count("(*"), text.count("*)")) == (1, 1)
    assert "X0: -1 <= x <= 1, dt" in text


def test_literals_in_single_precision_are_float32_numbers():
    """Some compilers take a literal beside a REAL as LREAL."""
    text = in_single_precision("(* every 0.1 s *) a := 0.1 * b[10] + 1.5E-05; EXP(MIN(a, 700.0))")
    assert text == "(* every 0.1 s *) a := 0.10000000149011612 * b[10] + 1.4999999621068127E-05; EXP(MIN(a, 87.0))"


@pytest.mark.gate
def test_limits_hold_in_single_precision():
    controller = controller_of("a limit, held", more=("controls.lower=-0.1", "controls.upper=0.1"))
    block = BlockInPython(text_of(controller, SINGLE), Law(controller, SINGLE), SINGLE)
    limit = float(controller.controls.upper.max())
    controls = [
        float(block(0.0, x)[0][0])
        for x in controller.initial_states.sample(20, torch.Generator().manual_seed(0)).numpy()
    ]
    assert max(map(abs, controls)) <= limit
    assert any(abs(u) > 0.99 * limit for u in controls), "a limit that is never reached tests nothing"


WRONG = {
    "another control": ("u[0] := ", "u[0] := 1.0E-6 + "),
    "another value": ("        V := ", "        V := 1.0E-6 + "),
    "another function": ("EXP(MIN(a, 700.0))", "EXP(MIN(a, 0.0))"),
}


@pytest.mark.parametrize("edit", sample(WRONG, 3))
def test_a_text_with_another_law_is_not_kept(edit, tmp_path, monkeypatch):
    def wrong(text):
        assert WRONG[edit][0] in text
        return in_python(text.replace(*WRONG[edit]))

    monkeypatch.setattr("lyapnet.exchange.export.structured_text.in_python", wrong)
    with pytest.raises(ExportError, match="Expected the controller's own u and V"):
        export(controller_of("a limit, held"), tmp_path / "law.st", "st")
    assert not [*tmp_path.iterdir()]


def functions_in_python(names):
    found = standard_functions(float)
    exec(in_python("\n".join(further_functions(names, "own"))), found)
    return found


@pytest.mark.parametrize("name", FURTHER)
def test_further_functions_are_those_of_the_c_library(name):
    operands = FURTHER[name][0].count(",") + 1
    meaning = {"remainder_of": lambda a, b: a % b, "exp2": lambda a: 2**a}.get(name) or getattr(math, name)
    names = functions_in_python({name})
    draw = np.random.default_rng(0)
    sides = {"acosh": (1.01, 9), "log2": (0.1, 9), "log1p": (-0.9, 9), "atanh": (-0.99, 0.99), "erf": (-6.5, 6.5)}.get(
        name, (-3, 3)
    )
    for scale in (1.0, 1e-6) if sides[0] < 0 else (1.0,):
        for given in scale * draw.uniform(*sides, size=(200, operands)):
            assert names[f"own_{name}"](*given) == pytest.approx(meaning(*given), rel=1e-12, abs=1e-12 * scale)


def test_corners_of_the_further_functions():
    names = functions_in_python({"atan2", "floor", "fmod", "remainder_of", "tanh", "exp"})
    for a, b in [(0.0, 0.0), (0.0, -1.0), (1.0, 0.0), (-1.0, 0.0), (1.0, -1e-300), (-2.0, -2.0)]:
        assert names["own_atan2"](a, b) == pytest.approx(math.atan2(a, b))
    assert [names["own_floor"](a) for a in (-2.0, -1.5, -0.5, 1.5, 2.5, 3.0)] == [-2, -2, -1, 1, 2, 3]
    assert [names["own_floor"](a) for a in (2.5e9 + 0.5, -(2.5e9) - 0.5, 1e16)] == [2.5e9, -2.5e9 - 1, 1e16]
    for a in (3.4999999999999996, -0.7000000000000001, 2.5e9 + 0.5):  # a / 0.7 may be rounded up to a whole number
        assert names["own_remainder_of"](a, 0.7) == pytest.approx(a % 0.7, abs=1e-6 if a > 1e9 else 1e-15)
        assert names["own_fmod"](a, 0.7) == pytest.approx(math.fmod(a, 0.7), abs=1e-6 if a > 1e9 else 1e-15)
    assert [names["own_tanh"](a) for a in (-500.0, 0.0, 500.0)] == [-1, 0, 1]
    assert names["own_exp"](1e6) == math.exp(700)


FORMULAS = {
    "a choice of sides": lambda t, x: torch.where(x[..., 0] > 0.1, x.square().sum(-1), 2 * x[..., 0] + t),
    "nested choices": lambda t, x: x.sign().sum(-1) + torch.where((x[..., 0] > 0) & ~(x[..., 1] > 0), t, 3.0),
    "a linear system": lambda t, x: x[..., 0] + torch.linalg.solve(_matrix(x), x[..., None]).sum((-1, -2)).detach(),
    "a determinant": lambda t, x: x[..., 0] + torch.linalg.det(_matrix(x)).detach(),
    "the least entry": lambda t, x: x.min(-1).values + x.argmax(-1) + torch.logsumexp(x, -1),
    "a computed index": lambda t, x: x[..., 0] + x.gather(-1, x.argmin(-1, keepdim=True))[..., 0].detach(),
    "powers": lambda t, x: (1.1 + x[..., 0]) ** 2.5 + x[..., 1] ** 3 + (x * x + 1).rsqrt().sum(-1),
    "rounding": lambda t, x: (3 * x).floor().sum(-1) + (3 * x).ceil().sum(-1) + torch.remainder(x[..., 0], 0.7),
    "functions": lambda t, x: (x.tanh() + x.sinh() + x.cosh() + x.expm1() + x.erf() + x.atan() + x.sigmoid()).sum(-1),
    "angles": lambda t, x: torch.atan2(x[..., 0], x[..., 1]) + torch.hypot(x[..., 0], x[..., 1]),
    "signs": lambda t, x: -(-x[..., 0] - (t - x[..., 1])) / (-2 - (x[..., 0] - -x[..., 1]).abs()),
    "a long product": lambda t, x: (torch.arange(240).reshape(20, 12).sin().to(x) @ _twelve(x)).sum((-1, -2)),
}  # fmt: skip


def _matrix(x):
    first = torch.stack([x[..., 0] * 0.1, 2 + x[..., 1]], -1)
    return torch.stack([first, torch.stack([3 + x[..., 0], x[..., 1]], -1)], -2)


def _twelve(x):
    return torch.cat([x * k for k in range(1, 7)], -1)[..., None]


@pytest.mark.parametrize("name", FORMULAS)
def test_each_kind_of_operation(name):
    controller = Controller(problem_of(DoubleIntegrator()), Formula(FORMULAS[name]))
    law, draw = Law(controller), torch.rand(40, 2, generator=torch.Generator().manual_seed(0), dtype=DOUBLE) * 2 - 1
    tried = Points(torch.linspace(0, 1, 40, dtype=DOUBLE), draw, draw.amin(0), draw.amax(0))
    _, V = run(structured_text(controller, law, Style(), tried), law, DOUBLE)(tried.t.numpy(), draw.numpy())
    expected = FORMULAS[name](tried.t, draw).numpy()
    assert np.ptp(expected) > 0.1
    np.testing.assert_allclose(V, expected, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize(("number", "text"), [
    (1.0, "1.0"), (-1e-05, "-1.0E-05"), (2.5e20, "2.5E20"),
    (math.inf, "1.0E38"), (-1e150, "-1.0E38"), (math.nan, "1.0E38"), (-1e-300, "-1.2E-38"), (0.0, "0.0"),
])  # fmt: skip
def test_literals_are_those_of_the_standard(number, text):
    assert real(number) == text


def test_a_division_by_zero_is_told(limited):
    controller, text = limited
    broken = re.sub(r"(END_VAR\n    v0 := MAX\(t, 0.0\);)", r"\1\n    v1 := 1.0 / x[0];", text, count=1)
    block = BlockInPython(broken, Law(controller), DOUBLE)
    block(0.0, np.ones(2))
    with pytest.raises(
        ExportError, match=r"without division by zero, overflow .* at t = 0, x = \[0.0, 1.0\]; export it to c"
    ):
        block(0.0, np.array([0.0, 1.0]))


def test_what_is_refused(tmp_path, monkeypatch):
    controller = controller_of("a limit, held")
    with pytest.raises(UsageError, match=r"Expected a name that ends in \.st"):
        export(controller, tmp_path / "law.txt", "st")
    for name in ("a_", "a__b"):
        with pytest.raises(UsageError, match="Expected a name without __ and without _ at its end"):
            export(controller, tmp_path / "law.st", "st", name=name)
    monkeypatch.setitem(sys.modules, "pycparser.c_parser", None)
    with pytest.raises(ExportError, match=r"Expected pycparser, got .*; pip install 'lyapnet\[plc\]'"):
        export(controller, tmp_path / "law.st", "st")
    assert not [*tmp_path.iterdir()]


@pytest.mark.gate
def test_names_begin_as_asked(tmp_path):
    (path,), _ = export(controller_of("the HJB law"), tmp_path / "arm.st", "st", name="arm")
    text = path.read_text(encoding="ascii")
    assert "FUNCTION_BLOCK arm_law" in text
    assert "lyapnet_" not in text
