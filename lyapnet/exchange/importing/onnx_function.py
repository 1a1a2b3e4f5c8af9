"""The function of an ONNX model as torch operations in float64."""

import importlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from lyapnet.base.errors import UsageError, one_line
from lyapnet.base.types import State
from lyapnet.exchange.importing.arithmetic import (
    BOOL,
    DOUBLE,
    EXACT,
    FLOAT,
    FORMATS,
    INT64,
    NAMES,
    REPRESENTED,
    WHOLE,
    Numbers,
)
from lyapnet.exchange.importing.operators import OPERATORS, OnnxOperator

DOMAIN = ("", "ai.onnx")
INPUTS = {FLOAT: np.float32, DOUBLE: np.float64}
# largest numbers of entries: of all constants together, of a value that depends on x, and of a list of indices
MOST, MOST_OF_ONE, MOST_INDICES = 50_000_000, 50_000, 10_000
MOST_NODES = 10_000  # largest number of nodes of a graph
TRUTHS = ("Less", "LessOrEqual", "Greater", "GreaterOrEqual", "Equal", "Not", "And", "Or")


class Moving(NamedTuple):
    """The name of a value that depends on x, or that is rounded."""

    name: str


class Weight(NamedTuple):
    """The index of a constant tensor among the weights."""

    index: int


class Step(NamedTuple):
    """A node that depends on x, or rounds."""

    operator: str
    arguments: list[Any]  # each a Moving, a Weight, or a plain value
    attributes: dict[str, Any]
    results: list[str]  # their names
    kind: int  # type of the results
    weight: float  # as in Numbers

    @property
    def moving(self) -> list[bool]:
        """Whether each argument moves."""
        return [isinstance(argument, Moving) for argument in self.arguments]


class OnnxFunction(nn.Module):
    """x (k, n) ↦ y (k, …), the function of the model for one state at a time, in real numbers.

    Weights are the numbers of the file as float64. Values that do not depend on x are computed once, in float64. If the
    function rounds, its bounds hold for the results of onnxruntime, with each operation in its type in the file.

    Args:
        model: an onnx.ModelProto with one input x of shape (n,), or (batch, n) with a batch that is free or 1.
        n: the number of states.
        name: the name of the file, for messages.
        rounds: whether bounds include the rounding of the types in the file, also of x to the type of the input.

    Attributes:
        precision: the types in which it computes.

    Raises:
        UsageError: the model has other inputs, an unknown operator or type, or whole numbers that leave their type.
    """

    def __init__(self, model: Any, n: int, name: str, rounds: bool = False):
        super().__init__()
        self.name, self.rounds, self.batched, self.kind = name, rounds, *_input_of(model, n, name)
        self.steps, self.weights = list[Step](), nn.ParameterList()
        (self.input,), (self.output,) = ([each.name for each in _inputs(model)], [y.name for y in model.graph.output])
        self._made, self._kinds = 0, {self.input: self.kind}
        self._unfold(model.graph, torch.zeros((1, n) if self.batched else (n,), dtype=torch.float64))
        kinds = {self.kind, *(step.kind for step in self.steps if OPERATORS[step.operator].rounds)}
        self.precision = " and ".join(NAMES[kind] for kind in sorted(kinds & NAMES.keys()))

    def forward(self, x: State) -> Tensor:
        is_one = isinstance(x.shape[0], int) and len(x) == 1  # sizes without a value (in traces) stand for many
        return self._of_one(x[0])[None] if is_one else torch.vmap(self._of_one)(x)

    def _of_one(self, x: State) -> Tensor:
        x = x[None] if self.batched else x
        values = {self.input: self._numbers(self.kind, x).rounded(x)}
        for step in self.steps:
            operator = OPERATORS[step.operator]
            given = [self._given(argument, values) for argument in step.arguments]
            arithmetic = [self._numbers(step.kind, x, step)] if operator.rounds else []
            values |= _named(step.results, operator.function(*arithmetic, *given, **step.attributes))
        return values[self.output].flatten()

    def _numbers(self, kind: int, x: Tensor, step: Step | None = None) -> Numbers:
        """The arithmetic of a step at x."""
        if not self.rounds:
            return Numbers()
        return Numbers(FORMATS.get(kind), x, *([] if step is None else [step.moving, step.weight]))

    def _given(self, argument: Any, values: Mapping[str, Tensor]) -> Any:
        if isinstance(argument, Moving):
            return values[argument.name]
        return self.weights[argument.index] if isinstance(argument, Weight) else argument

    def _unfold(self, graph: Any, x: Tensor) -> None:
        """Compute the constants, and list the steps that depend on x; their sizes are found with an example x."""
        constants = {each.name: self._tensor(each) for each in graph.initializer}
        self._kinds |= {each.name: each.data_type for each in graph.initializer}
        moving = {self.input: x}
        if len(graph.node) > MOST_NODES:
            raise UsageError(
                f"Expected at most {MOST_NODES} nodes in {self.name!r}, got {len(graph.node)}; write it smaller."
            )
        for node in graph.node:
            operator = OPERATORS.get(node.op_type) if node.domain in DOMAIN else None
            if operator is None:
                raise UsageError(
                    f"Expected operators of {', '.join(OPERATORS)} in {self.name!r}, got {node.op_type}; write the "
                    "function with these."
                )
            attributes = {each.name: self._attribute(node, each) for each in node.attribute}
            names = [*node.input]
            given = [moving.get(each, constants.get(each)) for each in names]
            kind = self._kind_of(node, attributes)
            for place in operator.plain:
                if place < len(names) and names[place] in moving:
                    raise UsageError(
                        f"Expected input {place} of {node.op_type} in {self.name!r} as a constant, got one that "
                        "depends on x or is rounded; write it with other operators."
                    )
            self._require_whole(node, operator, kind, given)
            plain = [_plain(y) if k in operator.plain and y is not None else y for k, y in enumerate(given)]
            results = self._results(node, operator, plain, attributes)
            self._kinds |= dict.fromkeys(results, kind)
            if node.op_type == "Shape" or not self._moves(node, operator, kind, names, moving, results):
                constants |= self._counted(node, results)
                continue
            moving |= results
            self._require_moving(node, kind, results, given if all(each in moving for each in names) else [])
            weight = sum(float(y.abs().sum()) for y in given if isinstance(y, Tensor) and y.is_floating_point())
            arguments = [
                Moving(each) if each in moving else self._kept(y) for each, y in zip(names, plain, strict=True)
            ]
            self.steps.append(Step(node.op_type, arguments, attributes, [*node.output], kind, weight))
        if self.output not in moving:
            raise UsageError(f"Expected a function of x in {self.name!r}, got a constant; export another one.")
        if self._kinds[self.output] not in FORMATS:
            raise UsageError(f"Expected an output in float32 or float64 in {self.name!r}, got another; cast it.")

    def _moves(
        self, node: Any, operator: OnnxOperator, kind: int, names: Sequence[str], moving: Mapping[str, Tensor],
        results: Mapping[str, Tensor],
    ) -> bool:  # fmt: skip
        """Whether the results of a node depend on x, or on the rounding of constants."""
        if any(each in moving for each in names):
            return True
        if not (self.rounds and operator.rounds and kind in FORMATS):
            return False
        (y,) = results.values()
        return not (node.op_type == "Cast" and (kind == DOUBLE or torch.equal(y.float().double(), y)))

    def _results(
        self, node: Any, operator: OnnxOperator, given: Sequence[Any], attributes: Mapping[str, Any]
    ) -> dict[str, Tensor]:
        """The results of a node at one x; their sizes are tested before they are computed."""
        arithmetic = [Numbers()] if operator.rounds else []

        def computed(*given: Any) -> dict[str, Tensor]:
            return _named([*node.output], operator.function(*arithmetic, *given, **attributes))

        try:
            without_values = [y.to("meta") if isinstance(y, Tensor) else y for y in given]
            size = sum(y.numel() for y in computed(*without_values).values())
            if size <= MOST:
                return computed(*given)
        except Exception as error:  # operators of a file may fail in any way
            shape = "(1, n)" if self.batched else "(n,)"
            raise UsageError(
                f"Expected {node.op_type} in {self.name!r} of one state of shape {shape}, got {one_line(error)}; "
                "export it with a batch that is free."
            ) from error
        raise self._too_large(node, size, MOST)

    def _too_large(self, node: Any, size: int, most: int) -> UsageError:
        return UsageError(
            f"Expected at most {most} numbers from {node.op_type} in {self.name!r}, got {size}; write it smaller."
        )

    def _counted(self, node: Any, results: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
        """The constant results; refused if all constants together have too many entries."""
        self._made += sum(y.numel() for y in results.values())
        if self._made > MOST:
            raise self._too_large(node, self._made, MOST)
        return results

    def _require_moving(
        self, node: Any, kind: int, results: Mapping[str, Tensor], factors: Sequence[Tensor | None]
    ) -> None:
        """Refuse values that depend on x and have too many entries or products, or are whole numbers."""
        size = max(y.numel() for y in results.values())
        if node.op_type in ("MatMul", "Gemm") and factors and factors[0] is not None:
            size *= max(1, max(factors[0].shape, default=1))
        if size > MOST_OF_ONE:
            raise self._too_large(node, size, MOST_OF_ONE)
        if kind in WHOLE:
            raise UsageError(
                f"Expected real numbers and truths that depend on x in {self.name!r}, got whole numbers from "
                f"{node.op_type}; stay in the type of x."
            )

    def _kind_of(self, node: Any, attributes: Mapping[str, Any]) -> int:
        """The type of a node's results."""
        kinds = [self._kinds.get(each, 0) for each in node.input]
        if node.op_type in TRUTHS:
            return BOOL
        if node.op_type == "Shape":
            return INT64
        if node.op_type == "Cast":
            kind = attributes.get("to", 0)
        elif node.op_type in ("Constant", "ConstantOfShape"):
            (given,) = node.attribute or [None]
            named = {"value_float": FLOAT, "value_floats": FLOAT, "value_int": INT64, "value_ints": INT64}
            kind = FLOAT if given is None else given.t.data_type if given.name == "value" else named.get(given.name, 0)
        else:
            kind = next(iter(kinds[node.op_type == "Where" :]), 0)
        if kind not in REPRESENTED:
            raise self._unknown_type(node.op_type)
        return kind

    def _require_whole(self, node: Any, operator: OnnxOperator, kind: int, given: Sequence[Any]) -> None:
        """Refuse an operation on whole numbers that leaves their type or divides by 0, or that has no rule here."""
        numbers = [y for k, y in enumerate(given) if isinstance(y, Tensor) and k not in operator.plain]
        if all(y.is_floating_point() or y.dtype == torch.bool for y in numbers) and kind not in WHOLE:
            return
        if not operator.whole:
            raise UsageError(
                f"Expected real numbers for {node.op_type} in {self.name!r}, got whole ones; cast them to float first."
            )
        if node.op_type == "Cast":
            if kind == INT64 and not numbers[0].is_floating_point():
                return
            (y,) = (each.double().trunc() for each in numbers)
            low, high = WHOLE.get(kind, (-(2**24), 2**24) if kind == FLOAT else (-EXACT, EXACT))
            y = y if kind != BOOL else y.clamp(low, high)
        elif node.op_type in ("Add", "Sub", "Mul", "Div", "Neg", "Abs"):
            if node.op_type == "Div" and bool((numbers[1] == 0).any()):
                raise self._wraps(node, "a division by 0")
            if any(bool((each.double().abs() > EXACT).any()) for each in numbers):
                raise self._wraps(node, f"more than {EXACT}")
            of_double = [each.double() for each in numbers]
            y = operator.function(*([Numbers()] if operator.rounds else []), *of_double)
            low, high = WHOLE[kind]
        else:
            return
        low, high = max(low, -EXACT), min(high, EXACT)
        wrong = ~((y >= low) & (y <= high))
        if bool(wrong.any()):
            raise self._wraps(node, f"{float(y[wrong].flatten()[0]):g}")

    def _wraps(self, node: Any, found: str) -> UsageError:
        return UsageError(
            f"Expected whole numbers that stay within their type, and within {EXACT}, in {node.op_type} of "
            f"{self.name!r}, got {found}; write them in a larger type."
        )

    def _unknown_type(self, where: str) -> UsageError:
        return UsageError(
            f"Expected float32, float64, whole numbers and truths in {self.name!r}, got another type in {where}; "
            "export it in float32 or float64."
        )

    def _tensor(self, proto: Any) -> Tensor:
        """A constant of the file."""
        if proto.data_type not in REPRESENTED:
            raise self._unknown_type(proto.name or "a constant")
        try:
            return tensor_of(proto)
        except Exception as error:  # of any kind
            raise UsageError(
                f"Expected numbers for {proto.name!r} in {self.name!r}, got {one_line(error)}; export it again."
            ) from error

    def _attribute(self, node: Any, proto: Any) -> Any:
        """An attribute as a number, a list of numbers or a tensor."""
        kinds = proto.AttributeType
        if proto.type == kinds.TENSOR:
            return self._tensor(proto.t)
        if proto.type not in (kinds.FLOAT, kinds.INT, kinds.FLOATS, kinds.INTS):
            raise UsageError(
                f"Expected numbers as attributes of {node.op_type} in {self.name!r}, got another {proto.name}; export "
                "it without."
            )
        value = library("onnx").helper.get_attribute_value(proto)
        return value if isinstance(value, int | float) else list(value)

    def _kept(self, value: Any) -> Any:
        """A constant argument: the Weight of a floating-point tensor, added to the weights, or a plain value."""
        if not isinstance(value, Tensor) or not value.is_floating_point():
            return value
        self.weights.append(nn.Parameter(value, requires_grad=False))
        return Weight(len(self.weights) - 1)


def _plain(y: Tensor) -> Any:
    """A constant as plain numbers."""
    if y.numel() > MOST_INDICES:
        raise UsageError(f"Expected at most {MOST_INDICES} indices, axes or sizes, got {y.numel()}; write fewer.")
    return y.tolist()


def tensor_of(proto: Any) -> Tensor:
    """An onnx.TensorProto as a tensor of float64, int64 or booleans."""
    array = np.asarray(library("onnx.numpy_helper").to_array(proto))
    if array.dtype != np.bool_:
        array = array.astype(np.float64) if proto.data_type in FORMATS else _whole(array)
    return torch.from_numpy(array.copy())


def _whole(array: np.ndarray) -> np.ndarray:
    if array.size and int(array.max()) > WHOLE[INT64][1]:
        raise ValueError(f"{int(array.max())}, which is beyond int64")
    return array.astype(np.int64)


def _named(names: Sequence[str], results: Any) -> dict[str, Tensor]:
    """The results of a node by their names."""
    return dict(zip(names, [results] if isinstance(results, Tensor) else results, strict=True))


def _inputs(model: Any) -> list[Any]:
    """The inputs without a value in the file."""
    known = {each.name for each in model.graph.initializer}
    return [each for each in model.graph.input if each.name not in known]


def _input_of(model: Any, n: int, name: str) -> tuple[bool, int]:
    """(whether x has a batch axis, its type)."""
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
    if kind.elem_type not in INPUTS:
        raise UsageError(f"Expected an input in float32 or float64 in {name!r}, got another type; export it so.")
    return len(sizes) == 2, kind.elem_type


def library(name: str) -> Any:
    """An optional module, imported now."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise UsageError(f"Expected onnx and onnxruntime, got {error}; pip install 'lyapnet[onnx]'.") from error
