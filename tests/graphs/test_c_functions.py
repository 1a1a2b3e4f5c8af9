"""Traced torch functions as C: equal to torch, compiled without warnings; operators without a rule are named."""

import ctypes
import shutil
import subprocess

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from lyapnet.base.errors import ExportError
from lyapnet.graphs import c_rules
from lyapnet.graphs.c_functions import c_function, helpers
from lyapnet.graphs.c_text import Tables, in_single_precision, literal
from lyapnet.graphs.tracing import core_trace
from tests.graphs.test_casadi_functions import FUNCTIONS as OF_CASADI

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
STRICT = ("-std=c99", "-O1", "-Wall", "-Wextra", "-Wconversion", "-Wpedantic", "-Werror")
WEIGHTS = torch.linspace(-1, 1, 4 * 10, dtype=torch.float64).reshape(10, 4).sin()
FUNCTIONS = OF_CASADI | {
    "a layer and back": lambda x: torch.tanh(x @ WEIGHTS.mT) @ WEIGHTS,
    "long sums": lambda x: WEIGHTS.mT @ torch.tanh(WEIGHTS @ x[0]) + (x @ WEIGHTS.mT) @ x.sin().expand(10, 4),
    "one extreme": lambda x: x.min(-1).values,
    "places of extremes": lambda x: x.max(-1).indices + x.argmin(-1, keepdim=True) + x.min() + x[0].sum(-1).sum(-1),
    "computed places": lambda x: x.gather(-1, x.argmax(-1, True)) * x,
    "written places": lambda x: torch.zeros_like(x).scatter(-1, x.argmax(-1, True), x[:, :1]),
    "added at places": lambda x: x.index_add(-1, torch.tensor([2, 0, 2]), x[:, 1:].sin()),
    "put at places": lambda x: x.index_copy(-1, torch.tensor([2, 0]), x[:, 1:3].sin()),
    "wrapped": lambda x: torch.remainder(x, 0.7) + torch.remainder(x, -0.7) + torch.floor_divide(x, 0.3),
    "nothing": lambda x: torch.cat([x[:, :0], x, x[:, 4:]], -1) + 0.0 * x[:, :0].sum(),
    "singular": lambda x: torch.linalg.det(torch.zeros(3, 3).to(x) * x[0, 0]) + x,
    "shares": lambda x: torch.softmax(x, -1) + torch.nn.functional.pad(x, (1, 0))[:, :4] + torch.hypot(x, x + 1),
    "alike": lambda x: x.sin().sum(-1) * x[0].sin() + x.sin() + (1 + x).sin().sum() + (1 + x[0]).cumsum(-1)[1:].sum(),
    "shape of": lambda x: torch.zeros_like(x.sin()) + torch.full_like(x[:, 0] * 3, 2.0) + x.exp().new_ones(4),
    "constant": lambda x: torch.ones_like(x) * torch.eye(4).to(x)[0],
    "half asked for": lambda x: x.max(-1).values + x.sin().min(-1).indices + torch.stack([x, x.cos()]).unbind(0)[0],
    "undefined": lambda x: torch.nan_to_num(x / x - 1, nan=2.0),
}  # fmt: skip
POINT = torch.tensor([[0.3, -0.8, 1.7, -2.2]], dtype=torch.float64)


def written(functions, folder, compiler="cc", single=False):
    """name ↦ a Python function of one of several functions of x (1, 4), all in one C library."""
    tables, bodies = Tables(), []
    for name, function in functions.items():
        graph = core_trace(lambda x, function=function: (function(x),), [torch.zeros(1, 4)], "a function", ExportError)
        signature = f"void {name.replace(' ', '_')}(const double *x, double *y)"
        bodies.append(signature + ";\n" + c_function(signature, graph, {"x": POINT}, ["y"], tables)[0])
    code = "\n".join(bodies)
    text = "\n".join(["#include <math.h>", *helpers(code), *tables.text, code])
    (folder / "f.c").write_text(in_single_precision(text) if single else text)
    library, kind = folder / "f.so", np.float32 if single else np.float64
    command = [compiler, *STRICT, "-shared", "-fPIC", "-o", str(library), str(folder / "f.c"), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    loaded = ctypes.CDLL(str(library))

    def calling(name, size):
        def call(x):
            given, y = x.numpy().astype(kind), np.empty(size, kind)
            getattr(loaded, name.replace(" ", "_"))(*(each.ctypes.data_as(ctypes.c_void_p) for each in (given, y)))
            return torch.from_numpy(y)

        return call

    return {name: calling(name, function(POINT).numel()) for name, function in functions.items()}


@pytest.fixture(scope="module")
def in_c(tmp_path_factory):
    return written(FUNCTIONS, tmp_path_factory.mktemp("c"))


@pytest.mark.gate
@pytest.mark.parametrize("name", FUNCTIONS)
def test_operations_of_user_systems_are_written(name, in_c):
    for x in (POINT, POINT.flip(-1) / 2, torch.zeros_like(POINT)):
        assert_close(in_c[name](x), FUNCTIONS[name](x).flatten(), rtol=1e-12, atol=1e-13, equal_nan=True)


@pytest.mark.gate
@pytest.mark.parametrize("single", [False, True], ids=["double", "single"])
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_compilers_take_each_precision_without_a_warning(compiler, single, tmp_path):
    if shutil.which(compiler) is None:
        pytest.skip(f"no {compiler}")
    found = written(FUNCTIONS, tmp_path, compiler, single)
    tolerance = 1e-4 if single else 1e-12
    for name in ("a layer and back", "long sums", "trigonometry", "powers", "branches", "products"):
        y = found[name](POINT)
        assert y.dtype == (torch.float32 if single else torch.float64)
        assert_close(y.double(), FUNCTIONS[name](POINT).flatten(), rtol=tolerance, atol=tolerance, equal_nan=True)


def test_single_precision_is_a_matter_of_words():
    code = "double v1 = sin(2.5 * v0[3 * i0 + 1]) + 1e-9 - asinh(w12[0]) + 1e300 + sine(4) + v1.x;"
    single = "float v1 = sinf(2.5f * v0[3 * i0 + 1]) + 1e-09f - asinhf(w12[0]) + INFINITY + sine(4) + v1.x;"
    assert in_single_precision(code) == single


def test_the_same_operations_are_written_once():
    def lines_of(function):
        graph = core_trace(lambda x: (function(x),), [torch.zeros(1, 4)], "a function", ExportError)
        return c_function("void f(const double *x, double *y)", graph, {"x": POINT}, ["y"], Tables())

    once, size = lines_of(lambda x: x.sin().exp())
    again, same_size = lines_of(lambda x: x.sin().exp() + 0 * x[0].sin().exp()[None])
    other, _ = lines_of(lambda x: x.sin().exp() + 0 * (1.0 + x[0]).sin().exp()[None])
    assert again.count("sin(") == again.count("exp(") == once.count("sin(") == 1
    assert same_size == size == 0, "one loop, in which all are numbers"
    assert other.count("sin(") == 2


def test_a_matrix_and_its_transpose_are_one_table():
    W = torch.randn(9, 4, generator=torch.Generator().manual_seed(0)).double()
    function = lambda x: torch.tanh(x @ W.mT) @ W  # noqa: E731
    graph = core_trace(lambda x: (function(x),), [torch.zeros(1, 4)], "a function", ExportError)
    tables = Tables()
    body, _ = c_function("void f(const double *x, double *y)", graph, {"x": POINT}, ["y"], tables)
    assert (len(tables.text), tables.count) == (1, 36)
    assert "sum_products(" in body


@pytest.mark.gate
def test_what_is_not_a_number_stays_so(in_c):
    x = torch.tensor([[torch.nan, 1.0, 2.0, 3.0]])
    for name in ("extremes", "branches", "products", "one extreme", "places of extremes"):
        for place in (0, 2):
            z = x.roll(place, -1)
            expected = FUNCTIONS[name](z).flatten()
            assert_close(in_c[name](z), expected, rtol=1e-12, atol=1e-13, equal_nan=True)
            assert expected.isnan().any()


def test_a_wrong_rule_is_another_function(monkeypatch, tmp_path):
    monkeypatch.setitem(c_rules.RULES, "sin", c_rules.RULES["cos"])
    name = "trigonometry"
    wrong = written({name: FUNCTIONS[name]}, tmp_path)[name](POINT)
    assert not torch.allclose(wrong, FUNCTIONS[name](POINT).flatten())


@pytest.mark.parametrize(
    ("function", "named"),
    [
        (lambda x: torch.special.bessel_j0(x), "bessel_j0"),
        (lambda x: x.sort(-1).values, "sort"),
        (lambda x: torch.linalg.eigvalsh(x.mT @ x), "eigh"),
        (lambda x: x.long() * 1.0, "_to_copy"),
        (lambda x: ((x > 0) + (x > -1)) * 1.0, "add"),
        (lambda x: x.exp().as_strided((2, 2), (1, 2), 0), "as_strided"),
        (lambda x: x.expand(300_000, 4).exp().sum(), "fit on a stack"),
    ],
    ids=["bessel", "sort", "eigenvalues", "whole numbers", "sum of Booleans", "strides", "large"],
)
def test_what_has_no_rule_is_named(function, named):
    graph = core_trace(lambda x: (function(x),), [torch.zeros(1, 4)], "a function", ExportError)
    with pytest.raises(ExportError, match=named):
        c_function("void f(const double *x, double *y)", graph, {"x": POINT}, ["y"], Tables())


def test_numbers_are_written_to_the_last_bit():
    numbers = [0.1, -1 / 3, 1e-320, 1.7976931348623157e308, 2.0, 1e22]
    assert [float(literal(number)) for number in numbers] == numbers
    assert [literal(number) for number in (torch.inf, -torch.inf, torch.nan)] == ["INFINITY", "-INFINITY", "NAN"]


def test_a_table_is_written_once():
    tables = Tables()
    first, again = tables.of(torch.tensor([1.0, 2.0])), tables.of(torch.tensor([1.0, 2.0]))
    other = tables.of(torch.tensor([1.0, -2.0]))
    assert first.name == again.name != other.name
    assert len(tables.text) == 2
