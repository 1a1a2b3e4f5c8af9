"""Translates traced functions of tensors to C99: each operation becomes a loop over arrays.

torch computes operations on constants, and their results become tables. Views, such as a transposition or a slice,
need no code, as an Array has strides. All other operations become loops around a line from RULES; identical loops are
written once. At the end the loops are arranged (c_loops). Memory is allocated only on the stack.
"""

import copy
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.fx import GraphModule, Interpreter, Node
from torch.utils._pytree import tree_leaves, tree_map

from lyapnet.base.errors import ExportError, one_line
from lyapnet.graphs.c_loops import arrange_statements
from lyapnet.graphs.c_rules import RULES
from lyapnet.graphs.c_text import Array, Tables, Text
from lyapnet.graphs.tracing import SHAPED, is_view, name_of

aten = torch.ops.aten
STACK = 1_000_000  # largest size of the arrays of one function, in bytes; stacks often have a few megabytes


def c_function(
    signature: str,
    graph: GraphModule,
    arguments: dict[str, Tensor],
    results: Sequence[str],
    tables: Tables,
    language: type[Text] = Text,
) -> tuple[str, int]:
    """(the text of a C function for a trace, the number of entries of its arrays on the stack).

    Args:
        signature: the head of the function, such as `void f(const double *x, double *y)`.
        graph: a trace by `core_trace`, for one state.
        arguments: name of each array argument ↦ a tensor of its shape.
        results: the names of the arrays for the results.
        tables: collects the constants.
        language: what the C will be translated to, for error messages.

    Raises:
        ExportError: an operator has no rule, or the arrays need more than STACK bytes.
    """
    text = language(tables)
    write_body(text, graph, arguments, results)
    lines, size = arrange_statements(text.statements, text.arrays)
    if 8 * size > STACK:
        raise ExportError(
            f"Expected a law whose arrays fit on a stack, got {8 * size / 1e6:.3g} MB; export it to torch or onnx."
        )
    unused = [f"(void){name};" for name in arguments]  # a function may not use all of its arguments
    return f"{signature}\n{{\n" + "".join(f"    {line}\n" for line in [*unused, *lines]) + "}\n", size


def write_body(text: Text, graph: GraphModule, arguments: dict[str, Tensor], results: Sequence[str]) -> None:
    """Write the operations of a trace, from the arrays of its arguments to those of its results.

    Raises:
        ExportError: an operator has no rule.
    """
    graph = without_shape_sources(graph)
    inputs = [Array(name, torch.empty(tensor.shape, device="meta")) for name, tensor in arguments.items()]
    outputs = _Translator(graph, text).run(*inputs)
    for name, output in zip(results, outputs, strict=True):
        text.copy(output, Array(name, torch.empty(tuple(output.shape), device="meta")))


def without_shape_sources(graph: GraphModule) -> GraphModule:
    """The trace without operations whose result is used for its shape only, as x.sin() in torch.zeros_like(x.sin())."""
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
    """The text of each helper function that the code calls."""
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
    "sum_products(": """/* y[i] = sum over j < n of a[j] b[step i + j], for i < k; eight sums at a time */
static void sum_products(int k, int n, int step, const double *a, const double *b, double *y)
{
    for (int i = 0; i < k; i++, b += step) {
        double s0 = 0.0, s1 = 0.0, s2 = 0.0, s3 = 0.0, s4 = 0.0, s5 = 0.0, s6 = 0.0, s7 = 0.0;
        int j = 0;
        for (; j + 8 <= n; j += 8) {
            s0 += a[j] * b[j];
            s1 += a[j + 1] * b[j + 1];
            s2 += a[j + 2] * b[j + 2];
            s3 += a[j + 3] * b[j + 3];
            s4 += a[j + 4] * b[j + 4];
            s5 += a[j + 5] * b[j + 5];
            s6 += a[j + 6] * b[j + 6];
            s7 += a[j + 7] * b[j + 7];
        }
        for (; j < n; j++) s0 += a[j] * b[j];
        y[i] = ((s0 + s4) + (s1 + s5)) + ((s2 + s6) + (s3 + s7));
    }
}
""",
    "solve(": """static void exchange(int n, double *a, double *b)
{
    for (int i = 0; i < n; i++) {
        double old = a[i];
        a[i] = b[i];
        b[i] = old;
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


class _Translator(Interpreter):
    """Runs a trace with tensors for constants and Arrays for all other values, and writes its operations as text."""

    def __init__(self, graph: GraphModule, text: Text):
        super().__init__(graph)
        self.extra_traceback = False  # error messages below are for users
        self.text, self.logical = text, False

    def get_attr(self, target: Any, args: tuple, kwargs: dict[str, Any]) -> Any:
        return _to_double(super().get_attr(target, args, kwargs))

    def run_node(self, n: Node) -> Any:
        value = n.meta.get("val")
        self.logical = isinstance(value, Tensor) and value.dtype == torch.bool
        return super().run_node(n)

    def call_function(self, target: Any, args: tuple, kwargs: dict[str, Any]) -> Any:
        if not any(isinstance(leaf, Array) for leaf in tree_leaves((args, kwargs))):
            return tree_map(_to_double, target(*args, **kwargs))
        name = name_of(target)
        if name in SHAPED:
            return _to_double(target(*tree_map(_zeros_of_shape, args), **kwargs))
        try:
            if name == "as_strided" or (self.logical and name in ("add", "sub")):
                raise NotImplementedError
            if is_view(target):
                return self.text.once(lambda: self.text.view(target, *args, **kwargs))
            if name not in RULES:
                raise NotImplementedError
            return self.text.once(lambda: RULES[name](self.text, *args, **kwargs))
        except (TypeError, NotImplementedError) as error:  # no rule, or no rule for these options
            raise ExportError(
                f"Expected operations that can be written in {self.text.language}, got {target}; write f, g, the cost "
                f"or V in others, add it to the table of operators (docs/operators.md), or {self.text.otherwise}."
            ) from error
        except Exception as error:  # rules may raise anything for shapes that they do not expect
            raise ExportError(
                f"Expected operations that can be written in {self.text.language}, got {target}, and "
                f"{type(error).__name__}: {one_line(error)[:200]}; {self.text.otherwise}."
            ) from error


def _to_double(value: Any) -> Any:
    """A constant in double precision."""
    return value.double() if isinstance(value, Tensor) and value.is_floating_point() else value


def _zeros_of_shape(leaf: Any) -> Any:
    return torch.zeros(leaf.shape, dtype=torch.float64) if isinstance(leaf, Array) else leaf
