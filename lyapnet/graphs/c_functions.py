"""Functions of tensors as C99: their traces written again as loops over arrays, operation by operation.

torch computes operations on constants; their results become tables. Views, such as a transposition or a slice, produce
no code: an array is a place in memory with strides. All other operations become loops, whose inner line is in RULES;
identical loops are written once. Memory is allocated on the stack only.
"""

import copy
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.fx import GraphModule, Interpreter, Node
from torch.utils._pytree import tree_leaves, tree_map

from lyapnet.base.errors import ExportError, one_line
from lyapnet.graphs.c_rules import RULES
from lyapnet.graphs.c_text import Array, Tables, Text
from lyapnet.graphs.tracing import SHAPED, is_view, name_of

aten = torch.ops.aten
STACK = 1_000_000  # bytes of arrays in one function, at the most


def c_function(
    signature: str, graph: GraphModule, arguments: dict[str, Tensor], results: Sequence[str], tables: Tables
) -> tuple[str, int]:
    """A trace as the text of a C function, and the bytes of its arrays on the stack.

    Args:
        signature: of the function, without its body, as in `void f(const double *x, double *y)`.
        graph: of `core_trace`, on one state.
        arguments: the names of the arrays that it takes, and tensors of their shapes.
        results: the names of the arrays that take its results.
        tables: takes the constants.

    Raises:
        ExportError: an operator has no rule; names it. Or its arrays take more than STACK bytes.
    """
    text = Text(tables)
    for name in arguments:  # not all functions need all of them
        text.unused(name)
    write_body(text, graph, arguments, results)
    if text.bytes > STACK:
        raise ExportError(
            f"Expected a law whose arrays fit on a stack, got {text.bytes / 1e6:.3g} MB; take --to torch or onnx."
        )
    return f"{signature}\n{{\n" + "".join(f"    {line}\n" for line in text.lines) + "}\n", text.bytes


def write_body(text: Text, graph: GraphModule, arguments: dict[str, Tensor], results: Sequence[str]) -> None:
    """Write what a trace does: from the arrays of its arguments to those of its results.

    Raises:
        ExportError: an operator has no rule; names it.
    """
    graph = _without_shapes_alone(graph)
    inputs = [Array(name, torch.empty(tensor.shape, device="meta")) for name, tensor in arguments.items()]
    outputs = _Reader(graph, text).run(*inputs)
    for name, output in zip(results, outputs, strict=True):
        text.copy(output, Array(name, torch.empty(tuple(output.shape), device="meta")))
    text.excuse_unread()


def _without_shapes_alone(graph: GraphModule) -> GraphModule:
    """Remove operations of which only the shape is used, as x.sin() in torch.zeros_like(x.sin())."""
    nodes = copy.deepcopy(graph.graph)
    for node in list(nodes.nodes):
        if node.op == "call_function" and name_of(node.target) in SHAPED:
            with nodes.inserting_before(node):
                for source in node.all_input_nodes:
                    shape = list(source.meta["val"].shape)
                    blank = nodes.call_function(aten.zeros.default, (shape,), {"dtype": torch.float64})
                    node.replace_input_with(source, blank)
    nodes.eliminate_dead_code()
    return GraphModule(graph, nodes)


def helpers(code: str) -> list[str]:
    """The functions that some functions call, as text."""
    return [text for call, text in HELPERS.items() if call in code]


HELPERS = {
    "remainder_of(": """/* a - b floor(a / b), of the sign of b */
static double remainder_of(double a, double b)
{
    double r = fmod(a, b);
    return r != 0 && (r < 0) != (b < 0) ? r + b : r;
}
""",
    "larger(": "static double larger(double a, double b) { return a > b || a != a ? a : b; }\n",
    "smaller(": "static double smaller(double a, double b) { return a < b || a != a ? a : b; }\n",
    "solve(": """static void exchange(int n, double *a, double *b)
{
    for (int i = 0; i < n; i++) {
        double kept = a[i];
        a[i] = b[i];
        b[i] = kept;
    }
}

/* b = A^-1 b by Gaussian elimination with rows exchanged, in A (n, n) and b (n, k); returns det A. */
static double solve(int n, int k, double *A, double *b)
{
    double determinant = 1.0;
    for (int p = 0; p < n; p++) {
        int best = p;
        for (int i = p + 1; i < n; i++)
            if (fabs(A[i * n + p]) > fabs(A[best * n + p])) best = i;
        if (best != p) {
            exchange(n, A + p * n, A + best * n);
            exchange(k, b + p * k, b + best * k);
            determinant = -determinant;
        }
        determinant *= A[p * n + p];
        if (k == 0 && determinant == 0) return 0.0;
        for (int i = p + 1; i < n; i++) {
            double factor = A[i * n + p] / A[p * n + p];
            for (int j = p; j < n; j++) A[i * n + j] -= factor * A[p * n + j];
            for (int j = 0; j < k; j++) b[i * k + j] -= factor * b[p * k + j];
        }
    }
    for (int j = 0; j < k; j++)
        for (int p = n - 1; p >= 0; p--) {
            for (int i = p + 1; i < n; i++) b[p * k + j] -= A[p * n + i] * b[i * k + j];
            b[p * k + j] /= A[p * n + p];
        }
    return determinant;
}
""",
}


class _Reader(Interpreter):
    """Runs a trace on values that are tensors where they are constant, else Arrays, and writes down what it does."""

    def __init__(self, graph: GraphModule, text: Text):
        super().__init__(graph)
        self.extra_traceback = False  # the messages below are for users
        self.text, self.logical = text, False

    def get_attr(self, target: Any, args: tuple, kwargs: dict[str, Any]) -> Any:
        return _in_double(super().get_attr(target, args, kwargs))

    def run_node(self, n: Node) -> Any:
        value = n.meta.get("val")
        self.logical = isinstance(value, Tensor) and value.dtype == torch.bool
        return super().run_node(n)

    def call_function(self, target: Any, args: tuple, kwargs: dict[str, Any]) -> Any:
        if not any(isinstance(leaf, Array) for leaf in tree_leaves((args, kwargs))):
            return tree_map(_in_double, target(*args, **kwargs))
        name = name_of(target)
        if name in SHAPED:
            return _in_double(target(*tree_map(_of_shape, args), **kwargs))
        try:
            if name == "as_strided" or (self.logical and name in ("add", "sub")):
                raise NotImplementedError
            if is_view(target):
                return self.text.once(lambda: self.text.viewed(target, *args, **kwargs))
            if name not in RULES:
                raise NotImplementedError
            return self.text.once(lambda: RULES[name](self.text, *args, **kwargs))
        except (TypeError, NotImplementedError) as error:  # no rule, or not for these options
            raise ExportError(
                f"Expected operations that can be written in {self.text.language}, got {target}; write f, g, the cost "
                f"or V in others, add it to the table of operators (docs/operators.md), or {self.text.otherwise}."
            ) from error
        except Exception as error:  # of any kind: shapes that no rule expected
            raise ExportError(
                f"Expected operations that can be written in {self.text.language}, got {target}, and "
                f"{type(error).__name__}: {one_line(error)[:200]}; {self.text.otherwise}."
            ) from error


def _in_double(value: Any) -> Any:
    """A constant as C has it."""
    return value.double() if isinstance(value, Tensor) and value.is_floating_point() else value


def _of_shape(leaf: Any) -> Any:
    return torch.zeros(leaf.shape, dtype=torch.float64) if isinstance(leaf, Array) else leaf
