"""Bounds of each ONNX operator against its values; test_precision.py holds it against onnxruntime."""

import numpy as np
import pytest
import torch

from lyapnet.base.errors import UsageError
from lyapnet.exchange.importing.onnx_function import OnnxFunction
from lyapnet.exchange.importing.operators import OPERATORS
from lyapnet.prover.bounds import BoundedFunction
from tests.exchange.importing.models import FLOAT, helper, model_of, onnx
from tests.marks import sample

pytest.importorskip("onnxruntime")
N = 3
ROWS, W = [0.5, -1.0, 2.0], np.array([[0.3, -0.2], [1.0, 0.5], [-0.7, 0.1]])
INTS = np.array
PLAIN = [
    "Identity",
    "Neg",
    "Abs",
    "Exp",
    "Sin",
    "Cos",
    "Tan",
    "Tanh",
    "Sigmoid",
    "Relu",
    "Softplus",
    "Sign",
    "Floor",
    "Ceil",
]
TWO = ["Add", "Sub", "Mul", "Div", "Max", "Min", "Sum", "Mean"]
COMPARED = ["Less", "LessOrEqual", "Greater", "GreaterOrEqual", "Equal"]
POSITIVE = [("Exp", ["x"], ["p"], {})]
TRUTHS = [("Greater", ["x", "c"], ["a"], {}), ("Less", ["x", "d"], ["b"], {})]
AS_NUMBERS = [("Cast", ["t"], ["y"], {"to": FLOAT})]
FLAT = [("Reshape", ["r", "flat"], ["y"], {})]
EXAMPLES = {  # operator ↦ nodes, constants
    **{name: [([(name, ["x"], ["y"], {})], {})] for name in PLAIN},
    **{
        name: [([(name, ["x", "c"], ["y"], {})], {"c": ROWS}), ([(name, ["c", "x"], ["y"], {})], {"c": ROWS})]
        for name in TWO[:3] + TWO[4:]
    },
    "Div": [
        ([("Div", ["x", "c"], ["y"], {})], {"c": ROWS}),
        ([*POSITIVE, ("Div", ["c", "p"], ["y"], {})], {"c": ROWS}),
        (
            [
                ("Shape", ["x"], ["s"], {}),
                ("Div", ["s", "two"], ["h"], {}),
                ("Cast", ["h"], ["f"], {"to": FLOAT}),
                ("Slice", ["f", "from", "to"], ["l"], {}),
                ("Mul", ["x", "l"], ["y"], {}),
            ],
            {"two": INTS([2, 2]), "from": INTS([1]), "to": INTS([2])},
        ),
    ],
    **{name: [([*POSITIVE, (name, ["p"], ["y"], {})], {})] for name in ("Log", "Sqrt", "Reciprocal")},
    **{name: [([(name, ["x", "c"], ["t"], {}), *AS_NUMBERS], {"c": 0.1})] for name in COMPARED},
    **{name: [([*TRUTHS, (name, ["a", "b"], ["t"], {}), *AS_NUMBERS], {"c": 0.1, "d": 1.0})] for name in ("And", "Or")},
    "Not": [([*TRUTHS, ("Not", ["a"], ["t"], {}), *AS_NUMBERS], {"c": 0.1, "d": 1.0})],
    "Where": [([*TRUTHS, ("Where", ["a", "x", "d"], ["y"], {})], {"c": 0.1, "d": 1.0})],
    "Cast": [([("Cast", ["x"], ["d"], {"to": 11}), ("Cast", ["d"], ["y"], {"to": FLOAT})], {})],
    "LeakyRelu": [([("LeakyRelu", ["x"], ["y"], {"alpha": 0.2})], {}), ([("LeakyRelu", ["x"], ["y"], {})], {})],
    "Elu": [([("Elu", ["x"], ["y"], {"alpha": 0.7})], {})],
    "Pow": [([("Pow", ["x", "p"], ["y"], {})], {"p": p}) for p in (2.0, 3.0, [2.0], np.array(2))],
    "Clip": [
        ([("Clip", ["x", "low", "high"], ["y"], {})], {"low": -0.5, "high": 0.7}),
        ([("Clip", ["x", "", "high"], ["y"], {})], {"high": 0.7}),
        ([("Clip", ["x"], ["y"], {})], {}),
    ],
    "MatMul": [([("MatMul", ["x", "W"], ["y"], {})], {"W": W})],
    "Gemm": [
        ([("Gemm", ["x", "W", "c"], ["y"], {"alpha": 0.5, "beta": 2.0})], {"W": W, "c": [1.0, 2.0]}),
        ([("Gemm", ["x", "W"], ["y"], {"transB": 1})], {"W": W.T}),
        ([("Transpose", ["x"], ["xt"], {}), ("Gemm", ["xt", "W"], ["y"], {"transA": 1})], {"W": W}),
    ],
    "Constant": [
        ([("Constant", [], ["c"], option), ("Mul", ["x", "c"], ["y"], {})], {})
        for option in (
            {"value": helper.make_tensor("c", FLOAT, [3], ROWS)},
            {"value_float": 0.3},
            {"value_floats": ROWS},
        )
    ],
    "Concat": [([("Concat", ["x", "c", "x"], ["y"], {"axis": -1})], {"c": [ROWS]})],
    "Shape": [
        (
            [("Shape", ["x"], ["s"], {"start": 1}), ("Expand", ["c", "s"], ["e"], {}), ("Add", ["x", "e"], ["y"], {})],
            {"c": [1.0]},
        )
    ],
    "ConstantOfShape": [
        ([("Shape", ["x"], ["s"], {}), ("ConstantOfShape", ["s"], ["e"], option), ("Add", ["x", "e"], ["y"], {})], {})
        for option in ({}, {"value": helper.make_tensor("one", FLOAT, [1], [1.0])})
    ],
    "Expand": [
        ([("Expand", ["x", "s"], ["y"], {})], {"s": INTS([2, 1, N])}),
        ([("Expand", ["x", "s"], ["y"], {})], {"s": INTS([4, 1])}),
    ],
    "Reshape": [([("Reshape", ["x", "s"], ["y"], {})], {"s": INTS(s)}) for s in ([-1], [0, N, 1])],
    "Flatten": [([("Flatten", ["x"], ["y"], {"axis": axis})], {}) for axis in (0, 1, -1)],
    "Squeeze": [([("Squeeze", ["x", "axis"], ["y"], {})], {"axis": INTS([0])}), ([("Squeeze", ["x"], ["y"], {})], {})],
    "Unsqueeze": [([("Unsqueeze", ["x", "axis"], ["y"], {})], {"axis": INTS([0, -1])})],
    "Transpose": [([("Transpose", ["x"], ["y"], option)], {}) for option in ({}, {"perm": [1, 0]})],
    "Slice": [
        (
            [("Slice", ["x", "from", "to", "axes", "by"], ["y"], {})],
            {"from": INTS([a]), "to": INTS([b]), "axes": INTS([1]), "by": INTS([step])},
        )
        for a, b, step in (
            (0, 2, 1),
            (1, 2**60, 1),
            (-2, 2**31, 1),
            (0, 3, 2),
            (-1, -(2**60), -1),
            (2, 0, -1),
            (2, -9, -2),
        )
    ],
    "Gather": [
        ([("Gather", ["x", "i"], ["y"], {"axis": 1})], {"i": INTS(i)})
        for i in (1, -1, [1, 2], [2, 0], [-1], [[0, 2], [1, 1]])
    ],
    "Split": [
        (
            [("Split", ["x", "s"], ["a", "b"], {"axis": 1}), ("Concat", ["b", "a"], ["y"], {"axis": 1})],
            {"s": INTS([1, 2])},
        ),
        ([("Split", ["x"], ["a", "b"], {"axis": 1, "num_outputs": 2}), ("Concat", ["b", "a"], ["y"], {"axis": 1})], {}),
    ],
    **{
        name: [
            ([(name, ["x", "axes"], ["y"], {"keepdims": keep})], {"axes": INTS(axes)})
            for axes in ([1], [-1])
            for keep in (0, 1)
        ]
        + [([(name, ["x"], ["y"], {})], {}), ([(name, ["x"], ["y"], {"noop_with_empty_axes": 1})], {})]
        for name in ("ReduceSum", "ReduceMean")
    },
    **{
        name: [([(name, ["x", "axes"], ["y"], {})], {"axes": INTS([1])}), ([(name, ["x"], ["y"], {})], {})]
        for name in ("ReduceSumSquare", "ReduceL2")
    },
}
UNBOUNDED = {"Floor", "Ceil"}  # without a rule for bounds


def test_every_operator_has_examples():
    assert EXAMPLES.keys() == OPERATORS.keys()


def function_of(nodes, constants):
    model = model_of(nodes, constants, N, kind=FLOAT, opset=20)
    onnx.checker.check_model(model)
    return OnnxFunction(model, N, "function.onnx", rounds=True), model


def bounded(function, box):
    return BoundedFunction(lambda t, x: (function(x[None])[0],), box)


@pytest.mark.parametrize("name", sample(sorted(EXAMPLES.keys() - UNBOUNDED), 4))
def test_its_bounds_hold(name):
    box, generator = (torch.tensor([0.0, 0.2, -0.4, 0.9]), torch.tensor([0.0, 0.5, 0.3, 1.3])), torch.Generator()
    x = (box[0] + (box[1] - box[0]) * torch.rand(200, 1 + N, generator=generator.manual_seed(0))).double()
    box = tuple(side.double() for side in box)
    for nodes, constants in EXAMPLES[name]:
        function, _ = function_of(nodes, constants)
        ((low, high),) = bounded(function, box).bounds(box[0][None], box[1][None])
        values = function(x[:, 1:])
        assert (low <= values).all()
        assert (values <= high).all()
        assert (high - low).max() < 20


@pytest.mark.parametrize("name", sorted(UNBOUNDED))
def test_one_without_bounds_is_named(name):
    function, _ = function_of(*EXAMPLES[name][0])
    box = (torch.zeros(1 + N), torch.ones(1 + N))
    with pytest.raises(UsageError, match=rf"Expected operators with a rule for bounds, got aten\.{name.lower()}"):
        bounded(function, box)
