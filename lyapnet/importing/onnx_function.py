"""A function that an ONNX file holds, as torch operations in float64, held against onnxruntime."""

import importlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from lyapnet.errors import UsageError, one_line
from lyapnet.files import digest_of_file, require_file
from lyapnet.importing.operators import OPERATORS
from lyapnet.types import State

DOMAIN = ("", "ai.onnx")
OPSET = 18  # whose semantics OPERATORS have; older files are converted to it
KINDS = {1: np.float32, 11: np.float64}  # onnx.TensorProto: what the input of a file may be
TOLERANCES = {np.float32: 1e-5, np.float64: 1e-10}  # relative to the largest result


class Moving(NamedTuple):
    """The name of a value that depends on x."""

    name: str


class Weight(NamedTuple):
    """The place of a constant tensor among the weights."""

    index: int


class Step(NamedTuple):
    """One node that depends on x."""

    operator: str
    arguments: list[Any]  # each Moving, a Weight, or anything else as it is
    attributes: dict[str, Any]
    results: list[str]


class OnnxFunction(nn.Module):
    """x (k, n) ↦ y (k, …): what the file says of one state at a time, in real numbers.

    Weights are the numbers that the file holds, as float64; what they are combined to is computed in float64 too. All
    that does not depend on x is computed once.

    Args:
        model: an onnx.ModelProto with one input x of shape (n,), or (batch, n) with a batch that is free or 1.
        n: states.
        name: of the file, for messages.

    Raises:
        UsageError: it is no such model, or has an operator that is not known here.
    """

    def __init__(self, model: Any, n: int, name: str):
        super().__init__()
        self.name, self.batched, self.kind = name, *_input_of(model, n, name)
        self.steps, self.weights = list[Step](), nn.ParameterList()
        (self.input,), (self.output,) = ([each.name for each in _inputs(model)], [y.name for y in model.graph.output])
        self._unfold(model.graph, torch.zeros((1, n) if self.batched else (n,), dtype=torch.float64))

    def forward(self, x: State) -> Tensor:
        return self._of_one(x[0])[None] if len(x) == 1 else torch.vmap(self._of_one)(x)

    def _of_one(self, x: State) -> Tensor:
        values = {self.input: x[None] if self.batched else x}
        for step in self.steps:
            given = [self._given(argument, values) for argument in step.arguments]
            values |= _named(step.results, OPERATORS[step.operator].function(*given, **step.attributes))
        return values[self.output].flatten()

    def _given(self, argument: Any, values: Mapping[str, Tensor]) -> Any:
        if isinstance(argument, Moving):
            return values[argument.name]
        return self.weights[argument.index] if isinstance(argument, Weight) else argument

    def _unfold(self, graph: Any, x: Tensor) -> None:
        """Compute what is constant, and list the steps of what is not, by their results at one x."""
        constants = {each.name: tensor_of(each) for each in graph.initializer}
        moving = {self.input: x}
        for node in graph.node:
            operator = OPERATORS.get(node.op_type) if node.domain in DOMAIN else None
            if operator is None:
                raise UsageError(
                    f"Expected operators of {', '.join(OPERATORS)} in {self.name!r}, got {node.op_type}; write the "
                    "function with these."
                )
            attributes = {each.name: _attribute(each) for each in node.attribute}
            names = [*node.input]
            for place in operator.plain:
                if place < len(names) and names[place] in moving:
                    raise UsageError(
                        f"Expected input {place} of {node.op_type} in {self.name!r} as a constant, got one that "
                        "depends on x; write it with other operators."
                    )
            given = [moving.get(each, constants.get(each)) for each in names]
            given = [y.tolist() if k in operator.plain and y is not None else y for k, y in enumerate(given)]
            results = self._results(node, operator.function, given, attributes)
            if node.op_type == "Shape" or not any(each in moving for each in names):
                constants |= results
                continue
            moving |= results
            arguments = [
                Moving(each) if each in moving else self._kept(y) for each, y in zip(names, given, strict=True)
            ]
            self.steps.append(Step(node.op_type, arguments, attributes, [*node.output]))
        if self.output not in moving:
            raise UsageError(f"Expected a function of x in {self.name!r}, got a constant; export another one.")

    def _results(
        self, node: Any, function: Callable[..., Any], given: Sequence[Any], attributes: Mapping[str, Any]
    ) -> dict[str, Tensor]:
        """Those of a node at one x."""
        try:
            return _named([*node.output], function(*given, **attributes))
        except Exception as error:  # of any kind: what is asked comes from a file
            shape = "(1, n)" if self.batched else "(n,)"
            raise UsageError(
                f"Expected {node.op_type} in {self.name!r} of one state of shape {shape}, got {one_line(error)}; "
                "export it with a batch that is free."
            ) from error

    def _kept(self, value: Any) -> Any:
        """A constant argument: a floating-point tensor among the weights, anything else as it is."""
        if not isinstance(value, Tensor) or not value.is_floating_point():
            return value
        self.weights.append(nn.Parameter(value, requires_grad=False))
        return Weight(len(self.weights) - 1)


class OnnxModel(NamedTuple):
    """An ONNX model whose weights are all in it, and the files that it was read from."""

    proto: Any
    digests: dict[str, str]  # name ↦ SHA-256


def read_onnx(path: Path) -> OnnxModel:
    """The model of an ONNX file, with weights beside it that it names, in the semantics of OPSET; nothing is run.

    Raises:
        UsageError: no such file, not ONNX, or onnx is missing.
    """
    onnx = _library("onnx")
    try:
        require_file(path)
        model = onnx.load(str(path), load_external_data=False)
        tensors = (each for part in (model.graph, *model.functions) for each in _tensors_of(part))
        entries = [entry for each in tensors for entry in each.external_data]
        beside = sorted({entry.value for entry in entries if entry.key == "location"})
        for name in beside:
            require_file(path.parent / name)
        onnx.load_external_data_for_model(model, str(path.parent))
        onnx.checker.check_model(model)
        digests = {name: digest_of_file(path.parent / name) for name in (path.name, *beside)}
    except OSError as error:
        raise UsageError(
            f"Expected an ONNX file, got {str(path)!r} ({error.strerror or error}); export it first."
        ) from error
    except Exception as error:  # of many kinds, with nothing in common
        advice = "export it with torch.onnx.export, or its like"
        if path.suffix in (".pt", ".pt2", ".pth", ".ckpt"):
            advice = "reading a torch file can run code that it holds: export it with torch.onnx.export"
        raise UsageError(f"Expected an ONNX file, got {str(path)!r} ({one_line(error)[:150]}); {advice}.") from error
    return OnnxModel(_modern(model, path), digests)


def _tensors_of(graph: Any) -> Iterator[Any]:
    """All tensors of a graph or function, which may lie beside the file: constants, and what nodes hold."""
    yield from getattr(graph, "initializer", ())  # a function has none
    for attribute in (each for node in graph.node for each in node.attribute):
        yield from (attribute.t, *attribute.tensors)
        for inner in (attribute.g, *attribute.graphs):
            yield from _tensors_of(inner)


def _modern(model: Any, path: Path) -> Any:
    """A model without functions of its own, in the semantics of OPSET."""
    inliner, converter = (_library(f"onnx.{name}") for name in ("inliner", "version_converter"))
    try:
        model = inliner.inline_local_functions(model)
        version = max((each.version for each in model.opset_import if each.domain in DOMAIN), default=0)
        return converter.convert_version(model, OPSET) if version < OPSET else model
    except Exception as error:  # of many kinds
        raise UsageError(
            f"Expected operators that can be converted to opset {OPSET} in {str(path)!r}, got "
            f"{one_line(error)[:150]}; export it for that opset."
        ) from error


def require_same(function: OnnxFunction, model: Any, states: State) -> float:
    """The largest difference from what onnxruntime makes of a model, state by state, relative to the largest result.

    Raises:
        UsageError: it is more than rounding in the precision of the file; or onnxruntime does not run it.
    """
    runtime = _library("onnxruntime")
    try:
        as_written = runtime.SessionOptions()
        as_written.graph_optimization_level = runtime.GraphOptimizationLevel.ORT_DISABLE_ALL
        session = runtime.InferenceSession(model.SerializeToString(), as_written, providers=["CPUExecutionProvider"])
        given = states.numpy().astype(function.kind)
        rows = [session.run(None, {function.input: x[None] if function.batched else x})[0].ravel() for x in given]
    except Exception as error:  # of many kinds
        raise UsageError(
            f"Expected a file that onnxruntime runs, got {function.name!r}: {one_line(error)[:200]}; export it again."
        ) from error
    with torch.no_grad():
        own = function(torch.from_numpy(given.astype(np.float64))).numpy()
    other = np.stack(rows).astype(np.float64)
    largest = float(np.abs(other[np.isfinite(other)]).max(initial=0.0)) or 1.0
    apart = np.where((own == other) | (np.isnan(own) & np.isnan(other)), 0.0, np.abs(own - other))
    difference = float(np.nan_to_num(apart, nan=np.inf).max()) / largest
    if own.shape != other.shape or not difference <= TOLERANCES[function.kind]:
        raise UsageError(
            f"Expected {function.name!r} to be the same function in float64 as in onnxruntime, got a difference of "
            f"{difference:.2g} of its largest result on {len(states)} states; report this with the file."
        )
    return difference


def tensor_of(proto: Any) -> Tensor:
    """An onnx.TensorProto in float64, or in int64, or as truths."""
    array = np.asarray(_library("onnx.numpy_helper").to_array(proto))
    if array.dtype != np.bool_:
        array = array.astype(np.int64 if np.issubdtype(array.dtype, np.integer) else np.float64)
    return torch.from_numpy(array.copy())


def _named(names: Sequence[str], results: Any) -> dict[str, Tensor]:
    """The results of a node by their names."""
    return dict(zip(names, [results] if isinstance(results, Tensor) else results, strict=True))


def _attribute(proto: Any) -> Any:
    """An attribute as a number, a list of numbers or a tensor."""
    value = _library("onnx").helper.get_attribute_value(proto)
    if hasattr(value, "SerializeToString"):
        return tensor_of(value)
    return list(value) if not isinstance(value, int | float | bytes) else value


def _inputs(model: Any) -> list[Any]:
    """The inputs that have no value in the file."""
    known = {each.name for each in model.graph.initializer}
    return [each for each in model.graph.input if each.name not in known]


def _input_of(model: Any, n: int, name: str) -> tuple[bool, Any]:
    """(whether x has a batch axis, its dtype)."""
    inputs, outputs = _inputs(model), [*model.graph.output]
    if len(inputs) != 1 or len(outputs) != 1:
        raise UsageError(
            f"Expected one input x and one output in {name!r}, got {len(inputs)} ({', '.join(x.name for x in inputs)}) "
            f"and {len(outputs)}; export V(x) and u(x), each in a file of its own."
        )
    kind = inputs[0].type.tensor_type
    sizes = [each.dim_value if each.HasField("dim_value") else None for each in kind.shape.dim]
    if len(sizes) not in (1, 2) or sizes[-1] not in (None, n) or sizes[:-1] not in ([], [None], [1]):
        shown = ", ".join("free" if size is None else str(size) for size in sizes)
        raise UsageError(
            f"Expected an input of {n} states in {name!r}, of shape ({n},) or (batch, {n}) with a batch that is free "
            f"or 1, got ({shown}); export it so, for the states of the config."
        )
    if kind.elem_type not in KINDS:
        raise UsageError(f"Expected an input in float32 or float64 in {name!r}, got another type; export it so.")
    return len(sizes) == 2, KINDS[kind.elem_type]


def _library(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise UsageError(f"Expected onnx and onnxruntime, got {error}; pip install 'lyapnet[onnx]'.") from error
