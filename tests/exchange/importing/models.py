"""ONNX models of the tests, written node by node."""

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")
helper, FLOAT, DOUBLE = onnx.helper, onnx.TensorProto.FLOAT, onnx.TensorProto.DOUBLE


def model_of(nodes, constants, n=2, shape=None, kind=DOUBLE, opset=18, inputs=("x",), outputs=("y",)):
    """A model x ↦ y of nodes (operator, inputs, outputs, attributes) and constants by their names."""
    numbers = {DOUBLE: np.float64, FLOAT: np.float32}.get(kind, np.float32)
    arrays = {name: np.asarray(each) for name, each in constants.items()}
    tensors = [
        onnx.numpy_helper.from_array(each.astype(numbers) if each.dtype.kind == "f" else each, name)
        for name, each in arrays.items()
    ]
    made = [helper.make_node(operator, given, found, **options) for operator, given, found, options in nodes]
    graph = helper.make_graph(
        made,
        "function",
        [helper.make_tensor_value_info(each, kind, shape or ["batch", n]) for each in inputs],
        [helper.make_tensor_value_info(each, kind, None) for each in outputs],
        tensors,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=9)
    model = onnx.shape_inference.infer_shapes(model, data_prop=True)
    for each in model.graph.output:  # a shape that is not known is one
        each.type.tensor_type.shape.SetInParent()
    return model


def quadratic(P, extra=(), constants=None, **options):
    """V = xᵀPx, and whatever other nodes make of it: v ↦ y."""
    nodes = [
        ("MatMul", ["x", "P"], ["Px"], {}),
        ("Mul", ["x", "Px"], ["parts"], {}),
        ("ReduceSum", ["parts", "axis"], ["v" if extra else "y"], {"keepdims": 1}),
        *extra,
    ]
    given = {"P": np.asarray(P, dtype=float), "axis": np.array([1]), **(constants or {})}
    return model_of(nodes, given, len(P), **options)


def linear(K, extra=(), constants=None, **options):
    """u = −xKᵀ, and whatever other nodes make of it: u ↦ y."""
    K = np.atleast_2d(np.asarray(K, dtype=float))
    nodes = [("Gemm", ["x", "K"], ["u" if extra else "y"], {"alpha": -1.0, "transB": 1}), *extra]
    return model_of(nodes, {"K": K, **(constants or {})}, K.shape[1], **options)


def saved(model, path):
    onnx.save(model, str(path))
    return path
