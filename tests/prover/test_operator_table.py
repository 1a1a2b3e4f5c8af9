"""The table of operators: all columns agree with torch; the overview in the docs; registration of a row.

`python -m tests.prover.test_operator_table` updates the overview in docs/operators.md.
"""

import ctypes
import json
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch._decomp import core_aten_decompositions, decomposition_table
from torch.testing import assert_close

from lyapnet.base.errors import ExportError, UsageError
from lyapnet.graphs import c_functions, casadi_functions, javascript_functions
from lyapnet.graphs.c_text import Tables
from lyapnet.graphs.compilation import has_compiler
from lyapnet.graphs.javascript_functions import JavaScriptTables, javascript_function
from lyapnet.graphs.number_kernel import rules as number_rules
from lyapnet.graphs.number_kernel.kernel import NumberKernel
from lyapnet.graphs.operators import OPERATORS, READERS, Operator, add, remove
from lyapnet.graphs.tracing import NOT_CORE, SHAPED, core_trace, is_view, name_of, trace
from lyapnet.prover import kept_proofs
from lyapnet.prover import operators as own
from lyapnet.prover.bound_kernel import writing
from lyapnet.prover.bound_rules import ARRANGEMENTS, OF_SHAPE, RULES
from lyapnet.prover.bounds import BoundedFunction
from lyapnet.prover.elementary_functions import Elementary
from lyapnet.prover.operators import complaints, forget, has_bounds, register
from lyapnet.prover.simplification import COPIES
from tests.marks import sample
from tests.pages import PAGES, ROOT, blocks

aten = torch.ops.aten
PAGE = ROOT / "docs" / "operators.md"
POINTS = 64
ROWS = list(OPERATORS)
NODE = shutil.which("node")


def unit(operands):
    """Points of the unit cube, with some of its corners."""
    points = torch.rand(POINTS, operands, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    points[:8] = points[:8].round()
    return points


def as_function(row):
    """The operator as a function of the operands, one row of x each; truths are 0 and 1."""

    def function(x):
        operands = [side > 0.5 if of is None else side for side, of in zip(x, row.domain, strict=True)]
        return (row(*operands).double(),)

    return function


def case(row):
    """(the operator as a function of x, x, torch's values)."""
    x = torch.stack([side.double() for side in row.at(unit(row.operands))])
    function = as_function(row)
    return function, x, function(x)[0]


# How each column computes a row


def by_numbers(row):
    function, x, _ = case(row)
    return NumberKernel(trace(function, (x,)), (x,))(x)[0]


def by_c(row, folder):
    function, x, expected = case(row)
    tables, graph = Tables(), core_trace(function, [x], "a function", ExportError)
    signature = "void f(const double *x, double *y)"
    body, _ = c_functions.c_function(signature, graph, {"x": x}, ["y"], tables)
    (folder / "f.c").write_text("\n".join(["#include <math.h>", *c_functions.helpers(body), *tables.text, body]))
    command = ["cc", "-std=c99", "-O1", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", "-o", folder / "f.so"]
    subprocess.run([*command, folder / "f.c", "-lm"], check=True)
    y = np.empty(expected.numel())
    doubles = ctypes.POINTER(ctypes.c_double)
    ctypes.CDLL(str(folder / "f.so")).f(x.numpy().ctypes.data_as(doubles), y.ctypes.data_as(doubles))
    return torch.from_numpy(y)


def by_casadi(row):
    function, x, _ = case(row)
    (y,) = casadi_functions.casadi_function(casadi_functions.trace_for_casadi(function, [x]), [x]).call(
        [x.flatten().numpy()]
    )
    return torch.tensor(np.array(y)).flatten()


def by_javascript(row):
    function, x, expected = case(row)
    tables, graph = JavaScriptTables(), core_trace(function, [x], "a function", ExportError)
    text = javascript_function("f", graph, {"x": x}, ["y"], tables)
    calls = (
        f"const y = new Float64Array({expected.numel()});\nf(Float64Array.from({json.dumps(x.flatten().tolist())}), y)"
    )
    output = "console.log(JSON.stringify([...y].map(String)))"
    program = "\n".join([javascript_functions.HELPERS, *tables.text, text, calls, output])
    done = subprocess.run([NODE, "-e", program], capture_output=True, text=True, check=True)
    return torch.tensor([float(number.replace("Infinity", "inf")) for number in json.loads(done.stdout)])


def are_equal(found, row):
    try:
        assert_close(found, case(row)[2], rtol=1e-12, atol=1e-12, equal_nan=True)
    except AssertionError:
        return False
    return True


def read_by(reader):
    """The rows that a reader of traces has."""
    return [name for name in ROWS if name in READERS[reader]]


needs_compiler = pytest.mark.skipif(not has_compiler(), reason="needs a C++ compiler")
needs_c = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
needs_node = pytest.mark.skipif(NODE is None, reason="no Node.js")


@needs_compiler
@pytest.mark.parametrize("name", read_by("numbers"))
def test_the_kernel_for_numbers_is_torch(name):
    assert are_equal(by_numbers(OPERATORS[name]), OPERATORS[name])


@needs_c
@pytest.mark.parametrize("name", sample(read_by("C"), 4))
def test_c_is_torch(name, tmp_path):
    assert are_equal(by_c(OPERATORS[name], tmp_path), OPERATORS[name])


@pytest.mark.parametrize("name", read_by("CasADi"))
def test_casadi_is_torch(name):
    assert are_equal(by_casadi(OPERATORS[name]), OPERATORS[name])


@needs_node
@pytest.mark.gate
@pytest.mark.parametrize("name", read_by("C"))
def test_javascript_is_torch(name):
    assert are_equal(by_javascript(OPERATORS[name]), OPERATORS[name])


@pytest.mark.parametrize("name", [name for name in ROWS if has_bounds(OPERATORS[name])])
def test_bounds_hold_and_derivatives_are_torchs(name):
    assert not list(complaints(OPERATORS[name]))


@pytest.mark.parametrize("name", [name for name in ROWS if None not in OPERATORS[name].domain])
def test_slopes_of_torch_are_differences(name):
    """The derivative that all readers trace, except where a function jumps."""
    row = OPERATORS[name]
    x = torch.stack(row.at(0.05 + 0.9 * unit(row.operands)[8:])).requires_grad_()
    y = row(*x).double()
    if not y.requires_grad or name in SLOPES_ASIDE:
        return
    (slope,) = torch.autograd.grad(y.sum(), x)
    for k in range(row.operands):
        step = torch.zeros(row.operands, 1).double()
        step[k] = 1e-6
        differences = (row(*(x + step)) - row(*(x - step))) / 2e-6
        assert_close(slope[k], differences.detach(), rtol=1e-6, atol=1e-6)


SLOPES_ASIDE = {"ceil", "floor", "trunc", "round", "remainder", "fmod"}  # a difference may go across a jump


# A row of one's own

SOFT = Operator(
    "logaddexp",
    c="larger({0}, {1}) + log1p(exp(-fabs({0} - {1})))",
    casadi=lambda casadi, a, b: casadi.fmax(a, b) + casadi.log1p(casadi.exp(-casadi.fabs(a - b))),
    domain=((-3, 3), (-3, 3)),
)


def soft(operators, x, y):
    return operators.add(y, operators.softplus(operators.sub(x, y)))


@pytest.fixture
def registered():
    """Register something; it is forgotten at the end."""
    rows = []

    def take(row, *bound):
        is_new = row.name not in OPERATORS
        register(row, *bound)
        rows.append((row, is_new))

    yield take
    for row, is_new in rows:
        forget(row, is_new)


WRONG = {
    "numbers": replace(SOFT, numbers="x + y"),
    "C": replace(SOFT, c=f"{SOFT.c} + 1e-9"),
    "CasADi": replace(SOFT, casadi="fmax"),
}


@pytest.mark.gate
@needs_c
@needs_compiler
@pytest.mark.parametrize("wrong", [None, *WRONG])
def test_a_wrong_column_is_found(wrong, registered, tmp_path):
    row = WRONG.get(wrong, SOFT)
    registered(row, soft)
    found = {"C": are_equal(by_c(row, tmp_path), row), "CasADi": are_equal(by_casadi(row), row)}
    try:
        found["numbers"] = are_equal(by_numbers(row), row)
    except NotImplementedError:  # a kernel compares itself with torch
        found["numbers"] = False
    derived = {"C": ["numbers", "C"]}.get(wrong, [wrong])  # the kernel computes C number by number
    assert [name for name in ("numbers", "C", "CasADi") if not found[name]] == [name for name in derived if name]


@needs_node
def test_a_row_of_ones_own_is_javascript(registered):
    registered(SOFT)
    assert are_equal(by_javascript(SOFT), SOFT)


def erf(**changes):
    """The error function, as docs/operators.md has it, with some of its parts changed."""
    factor = 2 / torch.pi**0.5

    def slope(x):
        return factor * torch.exp(-x * x)

    def where_slope_is(a, lo, hi):
        x = torch.sqrt(-torch.log((a / factor).clamp(max=1)))
        return [x, -x]

    return Elementary(**({"function": torch.erf, "derivative": slope, "stationary": where_slope_is} | changes))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"function": torch.tanh}, "another function"),
        ({"derivative": torch.cos}, "another derivative of order 1"),
        ({"stationary": lambda a, lo, hi: [lo]}, "values outside"),
    ],
)
def test_wrong_bounds_are_refused(changes, said, registered):
    with pytest.raises(UsageError, match=said):
        register(OPERATORS["erf"], erf(**changes))
    assert not has_bounds(OPERATORS["erf"])
    registered(OPERATORS["erf"], erf())
    assert has_bounds(OPERATORS["erf"])
    with pytest.raises(UsageError, match="without bounds"):
        register(OPERATORS["erf"], erf())


@pytest.mark.parametrize("part", ["second", "third", "third_range", "fourth_range"])
def test_a_wrong_higher_derivative_is_found(part, monkeypatch):
    sigmoid = RULES[aten.sigmoid.default]
    right = getattr(sigmoid.derivatives, part)
    if part.endswith("range"):
        wrong = lambda lo, hi: (0.9 * right(lo, hi)[0], 0.9 * right(lo, hi)[1])  # noqa: E731
    else:
        wrong = lambda v: 1.001 * right(v)  # noqa: E731
    derivatives = sigmoid.derivatives._replace(**{part: wrong})
    monkeypatch.setitem(RULES, aten.sigmoid.default, replace(sigmoid, derivatives=derivatives))
    assert any("derivative of order" in each for each in complaints(OPERATORS["sigmoid"]))


def test_wrong_composed_bounds_are_refused():
    with pytest.raises(UsageError, match="values outside"):
        register(SOFT, lambda operators, x, y: operators.maximum(x, y))
    assert SOFT.name not in OPERATORS
    assert not RULES.keys() & {*SOFT.overloads}


def test_an_operator_without_bounds_makes_up_none():
    with pytest.raises(UsageError, match="no rule for bounds of logaddexp2"):
        register(SOFT, lambda operators, x, y: operators.logaddexp2(x, y))


@pytest.mark.gate
@needs_compiler
def test_a_kernel_from_before_goes_on(registered):
    before = NumberKernel(trace(lambda x: (x.sin().sum() * x,), (torch.ones(3),)), (torch.ones(3),))
    registered(SOFT, soft)
    assert are_equal(by_numbers(SOFT), SOFT)
    x = torch.tensor([1.0, 2.0, 3.0])
    assert_close(before(x)[0], x.sin().sum() * x)


def test_what_is_there_or_no_operator_is_refused():
    with pytest.raises(UsageError, match="that lyapnet lacks, got sin"):
        register(Operator("sin", "cos({0})"))
    with pytest.raises(UsageError, match="that lyapnet lacks, got mm"):
        add(Operator("mm", "{0}"))
    with pytest.raises(UsageError, match=r"operator of torch\.ops\.aten, got 'no_such'"):
        register(Operator("no_such", "cos({0})"))


def test_machine_code_has_what_is_composed(registered):
    registered(SOFT, soft)
    box = torch.zeros(1, 3).double(), torch.ones(1, 3).double()
    bounded = BoundedFunction(lambda t, x: (torch.logaddexp(x[0], t * x[1]),), (box[0][0], box[1][0]))
    assert SOFT.overloads[0] in bounded.operators
    assert bounded.kernel(*box) is not None


def test_a_kept_proof_depends_on_what_registers_bounds(registered):
    key = kept_proofs.hash_of_sources()
    registered(SOFT, soft)
    assert kept_proofs.hash_of_sources() != key


def test_a_row_taken_out_is_in_no_reader():
    add(SOFT)
    remove(SOFT)
    assert not any(SOFT.name in rules for rules in READERS.values())


@pytest.mark.gate
@needs_c
@needs_compiler
def test_the_page_adds_operators_in_one_file(tmp_path):
    for source in blocks("python", PAGE):
        names = {}
        exec(compile(source, str(PAGE), "exec"), names)
    try:
        row = OPERATORS["logaddexp"]
        assert are_equal(by_numbers(row), row)
        assert are_equal(by_c(row, tmp_path), row)
        assert are_equal(by_casadi(row), row)
        for each in (row, OPERATORS["erf"]):
            assert not list(complaints(each))
    finally:
        forget(OPERATORS["logaddexp"])
        forget(OPERATORS["erf"], is_new=False)


# The overview

COLUMNS = ("bounds", "machine code", "numbers", "C", "CasADi")


def coverage():
    """name ↦ for each of COLUMNS: ✓ a rule, ◦ written in other operators, or nothing."""
    bounds = {name_of(each) for each in (RULES | ARRANGEMENTS).keys() | OF_SHAPE | COPIES}
    code = {name_of(each) for each in (writing.RULES | ARRANGEMENTS).keys() | OF_SHAPE | COPIES}
    rules = {"bounds": bounds, "machine code": code, **READERS}
    rules["CasADi"] = READERS["CasADi"].keys() | casadi_functions.MOVES
    core = {name_of(each) for each in core_aten_decompositions()} | {name_of(each) for each in NOT_CORE}
    simpler = {"C": core, "CasADi": core, "numbers": {name_of(each) for each in decomposition_table}}
    names = sorted({*bounds, *code, *(name for reader in READERS.values() for name in reader), *casadi_functions.MOVES})
    return {
        name: ["✓" if name in rules[column] or (column not in ("bounds", "machine code") and is_free(name))
               else "◦" if name in simpler.get(column, ()) else "" for column in COLUMNS]
        for name in names
    }  # fmt: skip


def is_free(name):
    """Whether an operator only looks at entries, or reads a shape: no reader of numbers needs a rule."""
    packet = getattr(aten, name, None)
    if name in SHAPED or name == "getitem":
        return True
    return packet is not None and any(is_view(getattr(packet, each)) for each in packet.overloads()[:1])


def overview():
    """The operators that the same readers have in one row, the largest group first."""
    groups = {}
    for name, marks in coverage().items():
        groups.setdefault(tuple(marks), []).append(f"`{name}`")
    groups = sorted(groups.items(), key=lambda group: -len(group[1]))
    rows = [f"| {' | '.join(marks)} | {', '.join(names)} |" for marks, names in groups]
    return "\n".join([f"| {' | '.join(COLUMNS)} | operators |", "|" + ":-:|" * len(COLUMNS) + "---|", *rows])


def test_the_overview_is_that_of_the_readers():
    assert number_rules.RULES is READERS["numbers"]
    assert overview() in PAGES[PAGE]


def test_the_overview_of_a_reader_that_lacks_a_rule_is_another(monkeypatch):
    monkeypatch.delitem(READERS["C"], "sin")
    assert overview() not in PAGES[PAGE]


if __name__ == "__main__":
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(re.sub(r"\| bounds \|.*", lambda _: overview() + "\n", text, flags=re.DOTALL), encoding="utf-8")


# A registration that fails leaves nothing behind

ERFINV = Operator("erfinv", domain=((-0.9, 0.9),))


@pytest.mark.parametrize(
    ("row", "bound", "kind", "says"),
    [
        (ERFINV, lambda operators, x: None, "smooth", "while they were checked"),
        (Operator("erfinv", domain=((-0.9, 0.9),) * 2), lambda operators, x: x, "smooth", "while they were checked"),
        (Operator("erfinv", domain=((2.0, 3.0),)), lambda operators, x: operators.mul(x, 0.0), "smooth", "not finite"),
        (ERFINV, lambda operators, x: operators.mul(x, 0.0), "smooth", "values outside"),
        (ERFINV, lambda operators, x: x, "bogus", "kind as one of smooth, kink, jump"),
    ],
    ids=["None", "operands", "no numbers", "wrong", "kind"],
)
@pytest.mark.usefixtures("as_users_call")
def test_a_registration_that_fails_leaves_no_rule(row, bound, kind, says):
    with pytest.raises(UsageError, match=says):
        register(row, bound, kind)
    assert "erfinv" not in OPERATORS
    assert torch.ops.aten.erfinv.default not in RULES


def test_the_file_in_which_a_bound_is_written_joins_what_a_proof_depends_on(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "written_elsewhere.py").write_text(
        "def bound(operators, x, y):\n    return operators.add(y, operators.softplus(operators.sub(x, y)))\n",
        encoding="utf-8",
    )
    from written_elsewhere import bound

    with pytest.raises(UsageError, match="values outside"):
        register(SOFT, lambda operators, x, y: x)
    assert own.files() == []
    register(SOFT, bound)
    try:
        assert (tmp_path / "written_elsewhere.py").read_bytes() in own.files()
    finally:
        forget(SOFT)
    assert own.files() == []


@pytest.mark.gate
@needs_c
@needs_compiler
def test_a_row_registered_after_a_first_trace_is_read_too(registered, tmp_path):
    by_c(OPERATORS["exp"], tmp_path)
    test_a_wrong_column_is_found("C", registered, tmp_path)
