"""Bounds by machine code agree with those of the interpreter, which is used where there is no machine code."""

import math

import mpmath
import pytest
import torch

from lyapnet.base.errors import CompilationError
from lyapnet.graphs import compilation
from lyapnet.prover import bounds
from lyapnet.prover.bound_kernel import kernel as machine_code
from lyapnet.prover.bounds import BoundedFunction
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.prover.condition import DecreaseCondition
from lyapnet.prover.proof import prove
from lyapnet.prover.taylor import box_form
from lyapnet.task.cost.minimum import LEAST
from tests.claims.planted import domain, loop, riccati
from tests.functions import FUNCTIONS
from tests.marks import sample
from tests.prover.test_rules import CASES, WRITTEN_OUT, graph_of, random_boxes, values_on, violated

aten = torch.ops.aten
pytestmark = pytest.mark.skipif(not compilation.has_compiler(), reason="needs a C++ compiler")
WITHOUT_A_RULE = {aten._linalg_solve_ex.default, aten.linalg_inv_ex.default, aten.index_put.default}
"""index_put has none if several numbers are added to one entry."""


def both(function, lower, upper, degree):
    """(forms by machine code, forms of the interpreter); None where an operation has no rule."""
    bounded = BoundedFunction(function, (lower.amin(0), upper.amax(0)), degree)
    kernel = bounded.kernel(lower, upper)
    interpreted = bounded.image(box_form(lower, upper, degree))
    return None if kernel is None else (kernel.forms(lower, upper), interpreted)


def differences(forms, others):
    """The largest distances of bounds (outside, inside) those of other forms, relative to the size of the values."""
    outside = inside = 0.0
    for form, other in zip(forms, others, strict=True):
        assert form.terms.shape == other.terms.shape
        size = other.magnitude.clamp_min(1e-3)  # the arguments have size 1, and may cancel
        for sign, side, true in zip((-1, 1), form.interval(), other.interval(), strict=True):
            assert torch.equal(side.isfinite(), true.isfinite())
            distance = (sign * (side - true) / size)[true.isfinite()]
            outside, inside = max(outside, float(distance.max())), max(inside, -float(distance.min()))
    return outside, inside


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("operation", sample(CASES, 8), ids=str)
def test_bounds_are_those_of_the_interpreter(operation, degree):
    """Except for rounding: machine code counts fewer operations, of a minimum over controls more."""
    found = both(graph_of(CASES[operation], 0), *random_boxes(120, 0), degree)
    assert (found is None) == (operation in WITHOUT_A_RULE)
    if found is not None:
        outside, inside = differences(*found)
        assert outside < (1e-11 if operation is LEAST else 1e-12)
        assert inside < 1e-10


@pytest.mark.parametrize("places", [[0, 1], [1, 1]])
def test_at_most_one_number_is_added_to_each_entry(places):
    function = graph_of(lambda y, z, M, N: aten.index_add(y, 0, torch.tensor(places), z[:2]), 0)
    found = both(function, *random_boxes(120, 0), 1)
    assert (found is None) == (places == [1, 1])
    assert found is None or max(differences(*found)) < 1e-10


@pytest.mark.parametrize(("low", "high"), [(-0.2, None), (None, 0.2), (-0.2, math.inf), (-math.inf, 0.2), (-0.2, 0.2)])
def test_limits_are_those_of_the_interpreter(low, high):
    sides = [None if side is None else torch.tensor(side, dtype=torch.float64) for side in (low, high)]
    function, boxes = graph_of(lambda y, z, M, N: aten.clamp.Tensor(y, *sides), 0), random_boxes(120, 0)
    forms, others = both(function, *boxes, 2)
    assert max(differences(forms, others)) < 1e-10
    assert not violated(forms[0].interval(), values_on(function, *boxes)).any()


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_bounds_of_whole_functions_are_those_of_the_interpreter(name, degree):
    lower, upper = (torch.cat([torch.zeros(60, 1), side[:, 1:]], 1) for side in random_boxes(60, 1))
    found = both(lambda t, x: (FUNCTIONS[name](t, x),), lower, upper + torch.tensor([0.3, 0, 0]), degree)
    if found is not None:
        outside, inside = differences(*found)
        assert outside < 1e-12
        assert inside < 1e-10


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_functions_of_one_number_do_not_disturb_each_other(degree):
    """They share the range of their argument, and some its powers, even if one of them is undefined on a part of it."""

    def function(t, x):
        y = x[0] + t * x[1]
        return torch.sigmoid(y), torch.log(y), torch.nn.functional.softplus(y), torch.sin(y), torch.exp(y)

    forms, others = both(function, *random_boxes(120, 0), degree)
    assert max(differences(forms, others)) < 1e-10
    assert forms[2].radius.isfinite().all()


@pytest.mark.parametrize("operation", sample(sorted(CASES.keys() - WITHOUT_A_RULE, key=str), 4), ids=str)
def test_no_value_lies_outside(operation):
    """The twin: bounds made 20 % narrower are caught."""
    lower, upper = random_boxes(300, 0)
    torch.manual_seed(0)
    bounded = BoundedFunction(graph_of(CASES[operation], 0), (lower.amin(0), upper.amax(0)))
    (form,) = bounded.kernel(lower, upper).forms(lower, upper)
    values = values_on(graph_of(WRITTEN_OUT.get(operation, CASES[operation]), 0), lower, upper)
    assert not violated(form.interval(), values).any()
    assert violated(form.interval(), values, 0.8).any()


@pytest.mark.parametrize(
    ("right", "wrong", "operation", "degree"),
    sample(
        [
            ("radius += x.size(j) * y.size(k)", "radius += 0 * y.size(k)", aten.mul.Tensor, 2),
            ("absolute(c[k] * e[k]) * 0.5", "absolute(c[k] * e[k]) * 0.4", aten.mul.Tensor, 1),
            ("std::fabs(weights[i * columns + j])", "0.9 * std::fabs(weights[i * columns + j])", aten.mm.default, 1),
            ("radius += std::fabs(weight) * x.radius()", "radius = x.radius()", aten.sum.default, 1),
            ("span / 12", "span / 13", aten.sigmoid.default, 2),
            ("span / 48", "span / 49", aten.sigmoid.default, 3),
            ("across[k] - diagonal[k]", "across[k] + diagonal[k]", aten.sqrt.default, 2),
            ("(least + most) * 0.5", "least", aten.tan.default, 2),
            ("absolute(mine[i] - other[i]) * 0.5", "absolute(mine[i] - other[i]) * 0.4", aten.where.self, 2),
        ],
        9,
    ),
)
def test_a_wrong_formula_is_caught(right, wrong, operation, degree, tmp_path, monkeypatch):
    assert sum(source.read_text().count(right) for source in machine_code.SOURCES) == 1
    for source in machine_code.SOURCES:
        (tmp_path / source.name).write_text(source.read_text().replace(right, wrong))
    monkeypatch.setattr(machine_code, "SOURCES", tuple(tmp_path / source.name for source in machine_code.SOURCES))
    monkeypatch.setattr(
        compilation, "FLAGS", tuple(flag.replace("-O3", "-O0") for flag in compilation.FLAGS)
    )  # compiles in a third of the time
    machine_code.library.cache_clear()
    try:
        forms, others = both(graph_of(CASES[operation], 0), *random_boxes(120, 0), degree)
        outside, inside = differences(forms, others)
    finally:
        machine_code.library.cache_clear()
    assert max(outside, inside) > 1e-9


def test_elementary_functions_err_by_less_than_bounds_assume():
    """Compared with 50 digits; the bounds assume 8 ε."""
    generator = torch.Generator().manual_seed(0)
    wide = 1400 * torch.rand(3000, generator=generator) - 700
    small = 10.0 ** (-20 * torch.rand(3000, generator=generator))
    of = (mpmath.exp, mpmath.expm1, mpmath.log1p)
    with mpmath.workdps(50):
        for which, points in ((0, wide), (0, small), (1, -small), (1, wide), (2, small), (2, 1 - small)):
            values = machine_code.elementary(which, points)
            for point, value in zip(points.tolist(), values.tolist(), strict=True):
                true = of[which](mpmath.mpf(point))
                assert abs(mpmath.mpf(value) - true) <= 4 * 2.0**-52 * abs(true)


def test_many_boxes_are_bounded_by_machine_code(monkeypatch):
    """Few boxes are bounded by the interpreter; boxes with a width along other axes are counted separately."""
    function, (lower, upper) = graph_of(CASES[aten.sin.default], 0), random_boxes(60, 0)
    bounded = BoundedFunction(function, (lower.amin(0), upper.amax(0)))
    monkeypatch.setattr(bounds, "MANY", 100)
    asked = []
    monkeypatch.setattr(machine_code.BoundKernel, "forms", lambda self, *sides: asked.append(sides) or "machine code")
    assert bounded.forms(lower, upper) != "machine code"
    assert bounded.forms(lower, upper) == "machine code"
    flat = torch.cat([lower[:, :1], upper[:, 1:]], 1)
    assert bounded.forms(lower, flat) != "machine code"
    assert len(asked) == 1


@pytest.fixture
def another_library(tmp_path, monkeypatch):
    """An empty cache, in which no library is compiled yet."""
    monkeypatch.setenv("LYAPNET_CACHE", str(tmp_path))
    for each in (machine_code.library, machine_code.has_library):
        each.cache_clear()
    yield
    for each in (machine_code.library, machine_code.has_library):
        each.cache_clear()


@pytest.mark.parametrize("reason", ["no compiler", "a compiler that fails"])
def test_without_machine_code_a_note_says_so_once(reason, another_library, monkeypatch, caplog):
    if reason == "no compiler":
        monkeypatch.setattr(compilation, "has_compiler", lambda: False)
    else:
        monkeypatch.setattr(compilation, "FLAGS", ("--no-such-flag",))
    monkeypatch.setattr(bounds, "MANY", 0)
    function, (lower, upper) = graph_of(CASES[aten.sin.default], 0), random_boxes(60, 0)
    for _ in range(2):
        bounded = BoundedFunction(function, (lower.amin(0), upper.amax(0)))
        (form,), (interpreted,) = bounded.forms(lower, upper), bounded.image(box_form(lower, upper, 2))
        assert torch.equal(form.terms, interpreted.terms)
    notes = [record.getMessage() for record in caplog.records if "machine code" in record.getMessage()]
    assert len(notes) == 1
    assert "bounds go on without machine code" in notes[0]


@pytest.mark.gate
def test_machine_code_that_was_exchanged_is_compiled_again(another_library, caplog):
    machine_code.library()
    machine_code.library.cache_clear()
    path = compilation.file_of_library("bounds", machine_code.SOURCES)
    path.unlink()  # the code that runs here keeps its file
    path.write_bytes(b"another")
    assert machine_code.elementary(0, torch.zeros(3)).tolist() == [1, 1, 1]
    assert "digest does not match" in caplog.text
    path.chmod(0o666)
    machine_code.library.cache_clear()
    with pytest.raises(CompilationError, match="only you can write"):
        machine_code.library()


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_a_proof_has_the_same_verdict(scale, workers, monkeypatch):
    """One that holds, and one that fails."""
    proofs = []
    for many in (0, 10**9):
        monkeypatch.setattr(bounds, "MANY", many)
        condition = DecreaseCondition(loop(scale * riccati()), 0.9, 0.02)
        generator = torch.Generator().manual_seed(0)
        proofs.append(prove(condition, domain(), 10.0, Budget(30, workers=workers), generator=generator))
    assert proofs[0].verdict == proofs[1].verdict == ("certified" if scale == 1 else "falsified")
    assert (proofs[0].level, proofs[0].boxes) == (proofs[1].level, proofs[1].boxes)
