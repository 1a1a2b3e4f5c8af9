"""Bounds of a function on boxes: the graph of its operators, evaluated on Taylor forms.

The function is the one that training and control use, traced at one point (t, x). Each operator has a rule in
lyapnet.prover.bound_rules that encloses its result; an operator without a rule is refused by name. The arithmetic of
forms and its rounding errors are in lyapnet.prover.taylor. Numbers that do not depend on the point (weights,
W → softplus(W), a constant mass matrix) are computed once, by torch; the bounds are those of the function with these
numbers.

All operators go through one function, _apply. It refuses a result that depends on the point and is neither float64 nor
a truth value, since the rules do not cover the rounding of float32, the overflow of integers and the arithmetic of
truth values (1 + 1 = 1). It also refuses bounds of another shape than the trace recorded.
"""

import copy
import hashlib
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.fx import Node
from torch.fx.node import map_arg
from torch.utils._pytree import tree_map_only

from lyapnet.base.errors import LyapnetError, UsageError, one_line
from lyapnet.base.operators import MINIMA, as_operators
from lyapnet.base.types import Corner, Corners, OnBoxes
from lyapnet.graphs.tracing import trace
from lyapnet.prover import taylor
from lyapnet.prover.bound_kernel.kernel import BoundKernel, kernel_of
from lyapnet.prover.bound_kernel.program import Support, supports_of_boxes
from lyapnet.prover.bound_rules import ARRANGEMENTS, BOOLEAN_OPERATORS, RULES
from lyapnet.prover.boxes import random_points
from lyapnet.prover.rounding import rounding
from lyapnet.prover.simplification import with_known_truths, without_copies
from lyapnet.prover.taylor import TaylorForm, box_form, wide_axes

MANY = 4000  # number of boxes after which machine code is used; torch bounds as many while a kernel is compiled
TRACE_POINTS = 32  # random points of the box at which the trace is compared with the function


class Bounds(ABC):
    """Bounds on boxes of (t, x) of tensors that depend on (t, x)."""

    degree: int

    @abstractmethod
    def forms(self, lower: Corners, upper: Corners) -> list[TaylorForm]:
        """The tensors on boxes with these corners, (boxes, axes), as forms in the coordinates of each box."""

    @abstractmethod
    def on(self, device: torch.device) -> "Bounds":
        """The same, for boxes on another device."""

    @property
    @abstractmethod
    def fingerprint(self) -> str:
        """A hash of all that is bounded."""


class BoundedFunction(Bounds):
    """A function (t, x) ↦ tensors, with bounds of each entry on boxes of (t, x).

    Args:
        function: a function of t () and x (n,) that returns tensors of any shape; float64 torch operations whose
            control flow does not depend on values.
        sample: a box (lower, upper) of (t, x), (1 + n,) each; the trace is checked at points of it.
        degree: degree of the forms; 2 costs about (n + 3)/2 times the arithmetic of 1, and needs far fewer boxes.
        exact: ignore mark_rounded (lyapnet.prover.rounding), so that the bounds hold in real arithmetic only, and trace
            minima over controls by their operations. As a single operator, they have tighter bounds but no derivative.

    Attributes:
        graph: the torch operations of the function at one (t, x).

    Raises:
        UsageError: the function cannot be traced, or has an operator without a rule; the message names it.
    """

    def __init__(
        self,
        function: Callable[[Tensor, Tensor], tuple[Tensor, ...]],
        sample: tuple[Corner, Corner],
        degree: int = 2,
        exact: bool = False,
    ):
        self.degree = degree
        points = random_points(*sample, TRACE_POINTS, torch.Generator().manual_seed(0))
        first, *others = [(point[0].clone(), point[1:].clone()) for point in points]
        try:
            with rounding(counted=not exact), as_operators(MINIMA, not exact):
                graph = trace(function, first, others)
            self.graph = copy.deepcopy(graph)  # a copy, so that nobody else changes its constants
        except LyapnetError as error:
            raise UsageError(str(error)) from error
        except (Exception, SystemExit) as error:
            line = one_line(error)
            raise UsageError(
                f"Expected f, g, the cost and V in torch operations, each state's result its own, got {line}"
            ) from error
        self._nodes = list(with_known_truths(without_copies(self.graph.graph)).nodes)
        self._fold_constants()
        self._last_use = {source: node for node in self._nodes for source in node.all_input_nodes}
        self._seen: Counter[Hashable] = Counter()  # number of boxes so far, by the key of their kernel
        self._kernels: dict[Hashable, BoundKernel | None] = {}
        self.forms(*(side[None] for side in sample))  # finds an operator without a rule

    def forms(self, lower: Corners, upper: Corners) -> list[TaylorForm]:
        """The results on boxes of (t, x), (boxes, 1 + n) each, as Taylor forms in the coordinates of the box.

        After MANY boxes with the same wide axes, machine code bounds them on the CPU, if it can be compiled.
        """
        if lower.device.type == "cpu":
            wide = tuple(wide_axes(lower, upper).tolist())
            self._seen[wide] += len(lower)
            kernel = self.kernel(lower, upper) if self._seen[wide] > MANY else None
            if kernel is not None:
                return kernel.forms(lower, upper)
        return self.image(box_form(lower, upper, self.degree))

    def kernel(self, lower: Corners, upper: Corners) -> BoundKernel | None:
        """Machine code for boxes with a width along the same axes as these; None if it cannot be compiled."""
        wide = tuple(wide_axes(lower, upper).tolist())
        if wide not in self._kernels:
            self._kernels[wide] = self._kernel_of(supports_of_boxes(lower.shape[-1], wide), len(wide))
        return self._kernels[wide]

    def _kernel_of(self, inputs: Sequence[Support], dimension: int) -> BoundKernel | None:
        return kernel_of(self._nodes, self._constants, inputs, dimension, self.degree)

    def image(self, box: TaylorForm, supports: Sequence[Support] | None = None) -> list[TaylorForm]:
        """The results for all (t, x) in a form of shape (1 + n,), as forms in the same ε.

        Args:
            supports: for each entry of the form, the indices of the terms that may be nonzero, in increasing order.
                If given, machine code is used on the CPU after MANY boxes with these supports.
        """
        if supports is not None and box.radius.device.type == "cpu":
            key = (box.dimension, *supports)
            self._seen[key] += len(box.radius)
            if self._seen[key] > MANY:
                if key not in self._kernels:
                    self._kernels[key] = self._kernel_of(supports, box.dimension)
                if (kernel := self._kernels[key]) is not None:
                    return kernel.image(box)
        inputs = iter([_rows(box, 0), _rows(box, slice(1, None))])
        values: dict[Node, Any] = dict(self._constants)
        for node in self._nodes:
            if node.op == "placeholder":
                values[node] = next(inputs)
            elif node.op == "output":
                results: Any = map_arg(node.args[0], values.__getitem__)
                return [y if isinstance(y, TaylorForm) else taylor.constant_form(y, box) for y in results]
            elif node not in values:
                values[node] = _apply(node, values)
            for source in node.all_input_nodes:
                if self._last_use[source] is node and source not in self._constants:
                    del values[source]
        raise AssertionError("a graph ends with its output")

    def on(self, device: torch.device) -> "BoundedFunction":
        """The same function, for boxes on another device; its constants are copied there."""
        other = copy.copy(self)
        other._constants = {
            node: tree_map_only(Tensor, lambda value: value.to(device), value)
            for node, value in self._constants.items()
        }
        return other

    @property
    def fingerprint(self) -> str:
        """A hash of the function: its operations and all their constants."""
        found = hashlib.sha256(str(self.graph.graph).encode())
        for node in self._nodes:
            if node.op == "get_attr":
                value = self._constants[node]
                found.update(f"{value.dtype} {tuple(value.shape)}".encode())
                found.update((value.double() if value.is_floating_point() else value).contiguous().numpy().tobytes())
        return found.hexdigest()

    def bounds(self, lower: Corners, upper: Corners) -> list[tuple[OnBoxes, OnBoxes]]:
        """(lower, upper) bounds of each result on each box, (boxes, *shape); infinite where no bound is known."""
        return [form.interval() for form in self.forms(lower, upper)]

    @property
    def operators(self) -> set[Any]:
        """The operators whose results depend on the point; all others have been evaluated to constants."""
        return {node.target for node in self._nodes if node.op == "call_function" and node not in self._constants}

    def _fold_constants(self) -> None:
        self._constants: dict[Node, Any] = {}
        for node in self._nodes:
            if node.op == "get_attr":
                self._constants[node] = _attribute(self.graph, str(node.target))
            elif node.op == "call_function" and all(source in self._constants for source in node.all_input_nodes):
                arguments, keywords = _values(node, self._constants)
                self._constants[node] = node.target(*arguments, **keywords)  # pyright: ignore[reportCallIssue]


def _apply(node: Node, values: dict[Node, Any]) -> Any:
    """The result of a node: by the operator's rule if an argument depends on the point, else by torch.

    Raises:
        UsageError: the operator has no rule; or its rule does not cover these arguments or this result.
    """
    arguments, keywords = _values(node, values)
    rule = node.target
    if any(isinstance(values[source], TaylorForm | list) for source in node.all_input_nodes):
        rule = RULES.get(node.target) or ARRANGEMENTS.get(node.target)
    if rule is None:
        raise UsageError(
            f"Expected operators with a rule for bounds, got {node.target}; use other operators, or add it to the "
            "table of operators (docs/operators.md)."
        )
    try:
        result = rule(*arguments, **keywords)  # pyright: ignore[reportCallIssue]
    except LyapnetError:
        raise
    except Exception as error:
        raise UsageError(
            f"Expected arguments that the rule for bounds of {node.target} covers, got {one_line(error)}; "
            "write it with other operators."
        ) from error
    recorded = node.meta.get("val")
    if isinstance(result, Tensor) and isinstance(recorded, Tensor):  # a constant
        return result.to(torch.get_default_device(), recorded.dtype)
    for form, value in zip(*((y if isinstance(y, list | tuple) else [y]) for y in (result, recorded)), strict=True):
        if isinstance(form, TaylorForm):
            truth = value.dtype == torch.bool and node.target in BOOLEAN_OPERATORS and _compares_unrounded(node, values)
            real = value.dtype == torch.float64 or truth
            if not real or form.shape != value.shape:
                raise UsageError(
                    f"Expected operators with a rule for bounds, got {node.target} in {value.dtype} of shape "
                    f"{tuple(value.shape)}; keep x.dtype, convert comparisons to it, or use other operators."
                )
    return result


def _compares_unrounded(node: Node, values: dict[Node, Any]) -> bool:
    """Whether torch compares two numbers without rounding one of them to float32, as a 0-dimensional one may be."""
    sources = node.all_input_nodes
    both = [values[source] if isinstance(values[source], Tensor) else source.meta["val"] for source in sources]
    return len(both) != 2 or torch.result_type(*both) in (torch.float64, torch.bool)


def _values(node: Node, values: dict[Node, Any]) -> tuple[Any, Any]:
    return map_arg(node.args, values.__getitem__), map_arg(node.kwargs, values.__getitem__)


def _rows(form: TaylorForm, rows: int | slice) -> TaylorForm:
    return form.with_parts(form.terms[:, :, rows], form.radius[:, rows])


def _attribute(module: Any, path: str) -> Tensor:
    for name in path.split("."):
        module = getattr(module, name)
    return module.detach()
