"""Attempts to have ONNX files read as what onnxruntime does not compute: every operator in every type it admits.

Each is refused in one line, or onnxruntime's result lies within the bounds at every state.
"""

import itertools

import numpy as np
import pytest
import torch

from lyapnet.base.errors import UsageError
from lyapnet.exchange.importing import imported_controller
from lyapnet.exchange.importing.arithmetic import DOUBLE, FLOAT, FORMATS
from lyapnet.exchange.importing.onnx_file import bounds_at, require_same
from lyapnet.exchange.importing.onnx_function import OnnxFunction
from tests.exchange.importing.models import helper, model_of, onnx
from tests.exchange.importing.test_operators import EXAMPLES, UNBOUNDED, N
from tests.exchange.importing.test_regions import claimed, files
from tests.marks import sample

onnxruntime = pytest.importorskip("onnxruntime")
TENSOR = onnx.TensorProto
TYPES = {
    TENSOR.UINT8: np.uint8, TENSOR.INT8: np.int8, TENSOR.UINT16: np.uint16, TENSOR.INT16: np.int16,
    TENSOR.INT32: np.int32, TENSOR.INT64: np.int64, TENSOR.UINT32: np.uint32, TENSOR.UINT64: np.uint64,
}  # fmt: skip
NUMBERS = {FLOAT: np.float32, DOUBLE: np.float64, **TYPES}


def adversarial():
    """States of every magnitude, close to ties, denormal, and beyond what float32 holds."""
    ties = [0.5, 1.0, 2.0**-24, 1 + 2.0**-24, 1 + 2.0**-23, 2.0**24 + 1, 1 / 3, 88.7, -103.9, 9.01, 17.9, np.pi]
    sizes = [0.0, 1e-45, 7e-46, 1.1e-38, 1e-30, 1e-10, 1e-3, 1e3, 1e10, 1e19, 1e30, 3e38]
    generator = np.random.default_rng(0)
    rows = [np.full(N, sign * each) for each in (*ties, *sizes) for sign in (1, -1)]
    rows += [generator.normal(size=N) * 10.0 ** generator.uniform(-6, 3, N) for _ in range(24)]
    return torch.tensor(np.stack(rows))


STATES = adversarial()
ADDED = ("Add", ["x", "e"], ["y"], {})


def outcome(model, n=N, states=None):
    """What becomes of a model: the line that refuses it; or None where onnxruntime is within the bounds."""
    try:
        function = OnnxFunction(model, n, "u.onnx", rounds=True)
        require_same(function, model, STATES if states is None else states)
    except UsageError as error:
        line = str(error)
        assert len(line.splitlines()) == 1
        assert line.startswith("Expected ")
        assert "within its rounding" not in line, line
        return line
    return None


def constant_outcome(model, rounding=0.0):
    """As outcome, of x + a constant: what both make of it at 0."""
    try:
        constant = OnnxFunction(model, N, "u.onnx", rounds=True)(STATES[:1] * 0)[0]
    except UsageError as error:
        line = str(error)
        assert len(line.splitlines()) == 1
        assert line.startswith("Expected ")
        return line
    try:
        session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    except Exception:  # refused where the file is imported
        return "not in onnxruntime"
    (found,) = session.run(None, {"x": np.zeros((1, N))})
    np.testing.assert_allclose(found[0], constant, rtol=rounding, atol=0)
    return None


def in_type(example, kind):
    """A model of a kind, in which what an example casts to FLOAT is cast to it."""
    nodes, constants = example
    cast = [
        (op, given, found, {**options, **({"to": kind} if options.get("to") == FLOAT else {})})
        for op, given, found, options in nodes
    ]
    return model_of(cast, constants, N, kind=kind, opset=20)


@pytest.mark.parametrize("kind", [FLOAT, DOUBLE])
@pytest.mark.parametrize("name", sample(sorted(EXAMPLES.keys() - UNBOUNDED), 4))
def test_each_operator_rounds_within_its_bounds(name, kind):
    examples = EXAMPLES[name] if kind == FLOAT else EXAMPLES[name][:1]
    found = [outcome(in_type(example, kind)) for example in examples]
    if kind == FLOAT:
        assert set(found) == {None}
        function = OnnxFunction(in_type(examples[0], kind), N, "u.onnx", rounds=True)
        torch.testing.assert_close(
            function(STATES), torch.stack([function(x[None])[0] for x in STATES]), equal_nan=True
        )
    else:
        assert found[0] is None or "onnxruntime runs" in found[0]


MATRIX, WIDE = np.random.default_rng(1).normal(size=(N, N)), np.random.default_rng(2).normal(size=(N, 100))
TRANSPOSED = ("Transpose", ["x"], ["t"], {})
POSITIVE = ("Exp", ["x"], ["p"], {})
CHOSEN = ("Where", ["t", "k", "x"], ["y"], {})
COMBINED = {  # what is easily got wrong, in float32
    "a product of what moves": ([TRANSPOSED, ("MatMul", ["x", "t"], ["y"], {})], {}),
    "an outer product": ([TRANSPOSED, ("MatMul", ["t", "x"], ["y"], {})], {}),
    "α of what moves": ([TRANSPOSED, ("Gemm", ["x", "t"], ["y"], {"alpha": 1e3})], {}),
    "a large α": ([("Gemm", ["x", "W"], ["y"], {"alpha": 1e30})], {"W": MATRIX * 1e-30}),
    "a small α": ([("Gemm", ["x", "W"], ["y"], {"alpha": 1e-30})], {"W": MATRIX * 1e30}),
    "β of infinity": ([("Gemm", ["x", "W", "c"], ["y"], {"beta": 0.0})], {"W": MATRIX, "c": np.full(N, np.inf)}),
    "weights that overflow": ([("MatMul", ["x", "W"], ["y"], {})], {"W": MATRIX * 1e37}),
    "weights that underflow": (
        [("MatMul", ["x", "W"], ["h"], {}), ("Mul", ["h", "k"], ["y"], {})], {"W": MATRIX * 1e-40, "k": 1e38}
    ),
    "a sum that cancels": (
        [("MatMul", ["x", "W"], ["h"], {}), ("Tanh", ["h"], ["r"], {}), ("ReduceSum", ["r", "a"], ["y"], {})],
        {"W": WIDE * 100, "a": np.array([1])},
    ),
    "constants that round": ([("MatMul", ["W", "V"], ["c"], {}), ("MatMul", ["x", "c"], ["y"], {})],
                             {"W": MATRIX * 1e5, "V": MATRIX * 1e3}),
    "constants that cancel": (
        [("Sub", ["a", "b"], ["c"], {}), ("Mul", ["c", "k"], ["d"], {}), ("Add", ["x", "d"], ["y"], {})],
        {"a": 0.1, "b": 0.09999, "k": 1e7},
    ),
    "Elu with a large α": ([("Elu", ["x"], ["y"], {"alpha": 1e6})], {}),
    "limits in the wrong order": ([("Clip", ["x", "a", "b"], ["y"], {})], {"a": 1.0, "b": -1.0}),
    "a limit that is none": ([("Clip", ["x", "a", "b"], ["y"], {})], {"a": np.nan, "b": 1.0}),
    "a maximum with nan": ([("Max", ["x", "a"], ["y"], {})], {"a": np.nan}),
    "a denormal divisor": ([("Div", ["x", "a"], ["y"], {})], {"a": 1e-42}),
    "a division by itself": ([("Div", ["x", "x"], ["y"], {})], {}),
    "a logarithm close to 1": (
        [POSITIVE, ("Add", ["p", "k"], ["q"], {}), ("Log", ["q"], ["y"], {})], {"k": 1.0}
    ),
    "a large angle": ([("Mul", ["x", "k"], ["q"], {}), ("Sin", ["q"], ["y"], {})], {"k": 1e6}),
    "a sigmoid that vanishes": ([("Sigmoid", ["x"], ["q"], {}), ("Mul", ["q", "k"], ["y"], {})], {"k": 1e8}),
    "a softplus that vanishes": ([("Softplus", ["x"], ["q"], {}), ("Mul", ["q", "k"], ["y"], {})], {"k": 1e8}),
    "a high power": ([("Pow", ["x", "p"], ["y"], {})], {"p": 17.0}),
    "a negative power": ([POSITIVE, ("Pow", ["p", "e"], ["y"], {})], {"e": -3.0}),
    "a tie": ([("Equal", ["x", "a"], ["t"], {}), CHOSEN], {"a": 1 / 3, "k": 100.0}),
    "a denormal above 0": ([("Greater", ["x", "a"], ["t"], {}), CHOSEN], {"a": 0.0, "k": 100.0}),
    "a denormal as a truth": ([("Cast", ["x"], ["t"], {"to": 9}), CHOSEN], {"k": 100.0}),
    "squares that overflow": (
        [("Mul", ["x", "k"], ["q"], {}), ("ReduceSumSquare", ["q"], ["y"], {})], {"k": 1e15}
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", COMBINED)
def test_operators_together_round_within_their_bounds(name):
    assert outcome(in_type(COMBINED[name], FLOAT)) is None


def test_bounds_that_are_too_narrow_are_seen(monkeypatch):
    """The twin of all of these: with a thousandth of the rounding, onnxruntime is outside of its bounds."""
    monkeypatch.setitem(FORMATS, FLOAT, FORMATS[FLOAT]._replace(unit=2.0**-34))
    for name in ("Exp", "Tanh", "Sin", "MatMul", "Div"):
        function = OnnxFunction(in_type(EXAMPLES[name][0], FLOAT), N, "u.onnx", rounds=True)
        with pytest.raises(UsageError, match="within its rounding"):
            require_same(function, in_type(EXAMPLES[name][0], FLOAT), STATES)


# Whole numbers


def of_whole(operator, kind, *values, to=DOUBLE, **options):
    """x + what an operator makes of constant whole numbers, cast to real ones."""
    constants = {f"c{k}": np.asarray(value, dtype=TYPES[kind]) for k, value in enumerate(values)}
    nodes = [
        (operator, [*constants], ["whole"], options),
        ("Cast", ["whole"], ["real"], {"to": to}),
        ("Add", ["x", "real"], ["y"], {}),
    ]
    return model_of(nodes, constants, N, kind=to, opset=18)


def ends(kind):
    info = np.iinfo(TYPES[kind])
    return info.min, info.max


BOTH = {"Add", "Sub", "Mul", "Div", "Max", "Min", "Less", "GreaterOrEqual", "Equal"}
ALONE = {"Neg", "Abs", "Identity"}


@pytest.mark.parametrize("kind", TYPES)
@pytest.mark.parametrize("operator", sample(sorted(BOTH | ALONE), 4))
def test_whole_numbers_do_not_wrap(operator, kind):
    """At both ends of a type, and around 0; honest numbers are read."""
    least, most = ends(kind)
    values = [least, least + 1, 0, 1, 3, most - 1, most] + ([-1, -3] if least < 0 else [])
    pairs = itertools.product(values, values) if operator in BOTH else ([each] for each in values)
    for pair in [list(pair) for pair in pairs][:: 3 if operator in BOTH else 1]:
        constant_outcome(of_whole(operator, kind, *pair))
    if kind in (TENSOR.INT32, TENSOR.INT64):  # in which onnxruntime has all of these
        assert constant_outcome(of_whole(operator, kind, *([7, 3] if operator in BOTH else [7]))) is None


def casting():
    """(from, value, to): numbers that do and do not fit."""
    for source, to in itertools.product(NUMBERS, NUMBERS):
        least, most = ends(to) if to in TYPES else (-(2**24), 2**24)
        values = [0, 1, 7, least, most, least - 1, most + 1, 300, -1, 2**33, 2**63, 2**24 + 1, 2**53 + 1]
        values += [0.5, -0.5, -1.5, 1e10, np.nan, np.inf] if source in (FLOAT, DOUBLE) else []
        if source in TYPES:
            low, high = ends(source)
            values = [each for each in values if low <= each <= high]
        yield pytest.param(source, values, to, id=f"{source}-{to}")


@pytest.mark.parametrize(("source", "values", "to"), [*casting()])
def test_casts_do_not_wrap(source, values, to):
    found = {}
    for value in values:
        constants = {"c": np.asarray(value, dtype=NUMBERS[source])}
        nodes = [("Cast", ["c"], ["d"], {"to": to}), ("Cast", ["d"], ["e"], {"to": DOUBLE}), ADDED]
        found[value] = constant_outcome(model_of(nodes, constants, N, opset=18), 2.0**-24 * (FLOAT in (source, to)))
    assert found[7] is None
    for value in found.keys() & {300, -1, 2**33, 2**63}:
        if to in TYPES and not ends(to)[0] <= value <= ends(to)[1]:
            assert "stay within their type" in found[value] or "beyond int64" in found[value]


# Files that would wrap, hang or end the process


def constant_nodes(*nodes):
    return [*nodes, ("Cast", ["c"], ["e"], {"to": DOUBLE}), ADDED]


MILLIONS = np.array([10**6, 10**6])
LONG = np.array([2**14, 1, 1])
HOSTILE = {
    "least int64 / -1": (
        constant_nodes(("Div", ["a", "b"], ["c"], {})), {"a": np.int64(-(2**63)), "b": np.int64(-1)}, "stay within"
    ),
    "least int32 / -1": (
        constant_nodes(("Div", ["a", "b"], ["c"], {})), {"a": np.int32(-(2**31)), "b": np.int32(-1)}, "stay within"
    ),
    "a division by 0": (constant_nodes(("Div", ["a", "a"], ["c"], {})), {"a": np.int64(0)}, "division by 0"),
    "uint64": (constant_nodes(("Identity", ["a"], ["c"], {})), {"a": np.uint64(2**63)}, "beyond int64"),
    "Expand": (constant_nodes(("Expand", ["a", "s"], ["c"], {})), {"a": 1.0, "s": MILLIONS}, "at most 50000000"),
    "Expand of what moves": (
        [("Expand", ["x", "s"], ["c"], {}), ("ReduceSum", ["c"], ["y"], {})], {"s": [10**6, 1]}, "at most 50000 "
    ),
    "ConstantOfShape": (constant_nodes(("ConstantOfShape", ["s"], ["c"], {})), {"s": MILLIONS}, "at most 50000000"),
    "a shape beyond int64": (
        constant_nodes(("ConstantOfShape", ["s"], ["c"], {})), {"s": np.array([2**40, 2**40])}, "Expected ConstantOf"
    ),
    "a negative shape": (
        constant_nodes(("ConstantOfShape", ["s"], ["c"], {})), {"s": np.array([-3])}, "Expected ConstantOfShape"
    ),
    "an outer product": (
        constant_nodes(
            ("ConstantOfShape", ["s"], ["a"], {}), ("Transpose", ["a"], ["b"], {}), ("Mul", ["a", "b"], ["c"], {})
        ),
        {"s": np.array([10**5, 1])}, "at most 50000000",
    ),
    "a product of matrices": (
        constant_nodes(
            ("ConstantOfShape", ["s"], ["a"], {}), ("Transpose", ["a"], ["b"], {}), ("MatMul", ["a", "b"], ["c"], {})
        ),
        {"s": np.array([10**5, 1])}, "at most 50000000",
    ),
    "doubled again and again": (
        constant_nodes(
            ("ConstantOfShape", ["s"], ["c0"], {}),
            *((("Concat", [f"c{k}"] * 2, [f"c{k + 1}"], {"axis": 0})) for k in range(60)),
            ("Identity", ["c60"], ["c"], {}),
        ),
        {"s": np.array([1])}, "at most 50000000",
    ),
    "Reshape to a negative": (
        [("Reshape", ["x", "s"], ["y"], {})], {"s": np.array([-1, -1])}, "Expected Reshape"
    ),
    "indices beyond": ([("Gather", ["x", "i"], ["y"], {"axis": 1})], {"i": np.array([7])}, "Expected Gather"),
    "many indices": (
        [("Gather", ["x", "i"], ["y"], {"axis": 1})], {"i": np.zeros(10**6, dtype=np.int64)}, "at most 10000 indices"
    ),
    "strings": (constant_nodes(("Identity", ["a"], ["c"], {})), {"a": np.array(["1.0"], dtype=object)}, "another type"),
    "a string as a value": ([("Constant", [], ["c"], {"value_string": "1"}), ADDED], {}, "numbers as attributes"),
    "complex numbers": (constant_nodes(("Identity", ["a"], ["c"], {})), {"a": np.complex128(1j)}, "another type"),
    "half precision": (constant_nodes(("Identity", ["a"], ["c"], {})), {"a": np.float16(1).view()}, "another type"),
    "a cast to bfloat16": (constant_nodes(("Cast", ["a"], ["c"], {"to": 16})), {"a": 1.0}, "another type in Cast"),
    "a cast to a string": (constant_nodes(("Cast", ["a"], ["c"], {"to": 8})), {"a": 1.0}, "another type in Cast"),
    "a cast to float8": (constant_nodes(("Cast", ["a"], ["c"], {"to": 17})), {"a": 1.0}, "another type in Cast"),
    "what moves as a whole number": (
        [("Cast", ["x"], ["c"], {"to": 7}), ("Cast", ["c"], ["y"], {"to": DOUBLE})], {}, "whole numbers from Cast"
    ),
    "truths as whole numbers": (
        [("Greater", ["x", "a"], ["t"], {}), ("Cast", ["t"], ["c"], {"to": 6}), ("Cast", ["c"], ["y"], {"to": DOUBLE})],
        {"a": 0.0}, "whole numbers from Cast",
    ),
    "a power of whole numbers": (
        constant_nodes(("Pow", ["a", "a"], ["c"], {})), {"a": np.int64(3)}, "real numbers for Pow"
    ),
    "a sum of many whole numbers": (
        constant_nodes(("ReduceSum", ["a"], ["c"], {})), {"a": np.array([2**31 - 1, 1], dtype=np.int32)},
        "real numbers for ReduceSum",
    ),
    "a mean of no numbers": ([("ReduceMean", ["a"], ["e"], {}), ADDED], {"a": np.zeros(0)}, None),
    "a sum of no numbers": (
        [("Slice", ["x", "k", "k"], ["s"], {}), ("ReduceSum", ["s"], ["e"], {}), ADDED], {"k": np.array([1])}, None
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_are_refused_in_a_line(name):
    nodes, constants, expected = HOSTILE[name]
    model = plain_model(nodes, constants)
    found = outcome(model, states=STATES[:2])
    assert (found is None) if expected is None else (expected in (found or "")), found


def plain_model(nodes, constants):
    """A model without inferred shapes, which would take as long as what it describes."""
    tensors = []
    for name, each in constants.items():
        array = np.asarray(each)
        tensors.append(
            helper.make_tensor(name, TENSOR.STRING, array.shape, [b"1.0"])
            if array.dtype == object
            else onnx.numpy_helper.from_array(array, name)
        )
    made = [helper.make_node(operator, given, found, **options) for operator, given, found, options in nodes]
    x, y = (helper.make_tensor_value_info(each, DOUBLE, shape) for each, shape in (("x", ["batch", N]), ("y", None)))
    graph = helper.make_graph(made, "function", [x], [y], tensors)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    model.graph.output[0].type.tensor_type.shape.SetInParent()
    return model


# Rounding that decides


def law(*nodes, kind=FLOAT, **constants):
    return model_of(list(nodes), {name: np.asarray(each) for name, each in constants.items()}, 2, kind=kind)


K = np.array([[-1.0], [-1.7]])


def chain(*steps):
    """Nodes that make u = xK, and of what each makes the next: (operator, its second input), or what a cast is to."""
    nodes = [("MatMul", ["x", "K"], ["r0"], {})]
    for k, step in enumerate(steps):
        operator, second, options = ("Cast", [], {"to": step}) if isinstance(step, int) else (step[0], [step[1]], {})
        nodes.append((operator, [f"r{k}", *second], [f"r{k + 1}"], options))
    operator, given, _, options = nodes[-1]
    return [*nodes[:-1], (operator, given, ["y"], options)]


LOST = chain(("Mul", "small"), ("Add", "one"), ("Sub", "one"), ("Mul", "large"))
CAST = chain(("Mul", "small"), ("Add", "one"), FLOAT, DOUBLE, ("Sub", "one"), ("Mul", "large"))
BEYOND = chain(("Mul", "large"), ("Mul", "large"), ("Div", "large"), ("Div", "large"))
FALSE = {  # in real numbers all of them are u = xK; what onnxruntime computes is another law, and it is not
    "float32 loses u": [law(*LOST, K=K, small=1 / k, one=1.0, large=k) for k in (2.0**30, 2.0**7)],
    "float64 loses u": [law(*LOST, K=K, small=1 / k, one=1.0, large=k, kind=DOUBLE) for k in (2.0**60, 2.0**20)],
    "a cast loses u": [law(*CAST, K=K, small=1 / k, one=1.0, large=k, kind=DOUBLE) for k in (2.0**30, 2.0**7)],
    "products overflow": [law(*BEYOND, K=K, large=k) for k in (1e25, 1e3)],
    "products underflow": [law(*BEYOND, K=K, large=k) for k in (1e-25, 1e-3)],
    "a huge summand": [law(*chain(("Add", "k"), ("Sub", "k")), K=K, k=k) for k in (1e9, 8.0)],
    "a huge summand in float64": [law(*chain(("Add", "k"), ("Sub", "k")), K=K, k=k, kind=DOUBLE) for k in (1e18, 8.0)],
}


def true_u(model, states):
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    kind = np.float32 if model.graph.input[0].type.tensor_type.elem_type == FLOAT else np.float64
    return session.run(None, {"x": states.astype(kind)})[0][:, 0]


@pytest.mark.parametrize("name", FALSE)
def test_what_rounding_decides_is_not_read_as_real_numbers(name):
    x = np.random.default_rng(0).uniform([-2.0, -2.0], [2.0, 2.0], (200, 2))
    for model, honest in zip(FALSE[name], (False, True), strict=True):
        computed = true_u(model, x)
        apart = np.abs(computed - (x @ K)[:, 0])
        assert bool(apart.max() < 1e-3) is honest
        function = OnnxFunction(model, 2, "u.onnx", rounds=True)
        low, high = (side[:, 0].numpy() for side in bounds_at(function, torch.from_numpy(x)))
        assert ((low <= computed) & (computed <= high) | ~np.isfinite(low)).all()
        assert bool((high - low).max() < 1e-2) is honest
        assert function.precision == (
            "float32 and float64" if "cast" in name else "float64" if "64" in name else "float32"
        )


@pytest.mark.gate
def test_no_region_of_a_law_that_rounding_makes_another(tmp_path):
    false, honest = (
        claimed(imported_controller(*files(tmp_path, u=model)), boxes, seconds)
        for model, boxes, seconds in zip(FALSE["float32 loses u"], (100, 300), (3.0, 60.0), strict=True)
    )
    assert false.rho == -np.inf
    assert false.verdict != "certified"
    assert honest.verdict == "certified"
    assert 0 < honest.distance_left < 1e-2
    assert honest.precision == "float32"
