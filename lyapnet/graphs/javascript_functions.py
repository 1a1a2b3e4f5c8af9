"""Translates traced functions to JavaScript: the loops of c_functions, with arrays that are allocated once."""

import base64
from collections.abc import Sequence

from torch import Tensor
from torch.fx import GraphModule

from lyapnet.graphs.c_functions import write_body
from lyapnet.graphs.c_loops import loop_heads
from lyapnet.graphs.c_text import Tables, Text


class JavaScriptTables(Tables):
    """The constants of JavaScript functions, with every bit."""

    shares_transposes = False  # loops along columns of a shared table would be slower

    def format_table(self, name: str, numbers: Tensor) -> str:
        content = base64.b64encode(numbers.numpy().astype("<f8").tobytes()).decode()
        return f'const {name} = table("{content}");\n'


class JavaScriptText(Text):
    """The body of a JavaScript function, line by line; its arrays are declared outside of the function."""

    language, otherwise = "JavaScript", "use lyapnet animate"
    to_index, rows = "", None


def javascript_function(
    name: str, graph: GraphModule, arguments: dict[str, Tensor], results: Sequence[str], tables: JavaScriptTables
) -> str:
    """The text of a JavaScript function for a trace; its parameters are the arrays of arguments, then of results.

    Args:
        name: the name of the function.
        graph: a trace by `core_trace`, for one state.
        arguments: name of each array argument ↦ a tensor of its shape.
        results: the names of the arrays for the results.
        tables: collects the constants.

    Raises:
        ExportError: an operator has no rule.
    """
    text = JavaScriptText(tables)
    write_body(text, graph, arguments, results)
    head = "\n".join(f"const {array} = new Float64Array({size});" for array, size in text.arrays.items())
    body = "\n".join(
        "\n".join([*loop_heads(each.sizes, "let"), "    " * len(each.sizes) + each.line]) for each in text.statements
    )
    parameters = ", ".join([*arguments, *results])
    return f"const {name} = (() => {{\n{head}\nreturn ({parameters}) => {{\n{body}\n}};\n}})();\n"


HELPERS = """"use strict";
const {acos, acosh, asin, asinh, atan, atan2, atanh, ceil, cos, cosh, exp, expm1, floor, hypot, log, log10, log1p, log2,
       pow, sin, sinh, sqrt, tan, tanh, trunc, abs: fabs} = Math;
const INFINITY = Infinity, NAN = NaN;
const exp2 = (a) => pow(2, a), fmod = (a, b) => a % b;
const larger = (a, b) => (a > b || a !== a ? a : b), smaller = (a, b) => (a < b || a !== a ? a : b);
const table = (text) => new Float64Array(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);

// a - b floor(a / b), of the sign of b
function remainder_of(a, b) {
  const r = a % b;
  return r !== 0 && (r < 0) !== (b < 0) ? r + b : r;
}

// 2/sqrt(pi) exp(-a^2) sum of 2^n a^(2n + 1) / (1 3 ... (2n + 1))
function erf(a) {
  if (!(fabs(a) < 6)) return a > 0 ? 1 : a < 0 ? -1 : a;
  let term = a, sum = a;
  for (let n = 1; fabs(term) > 1e-17 * fabs(sum); n++) sum += term *= (2 * a * a) / (2 * n + 1);
  return 2 / sqrt(Math.PI) * exp(-a * a) * sum;
}
const erfc = (a) => 1 - erf(a);

// b = A^-1 b by Gaussian elimination with rows exchanged, in A (n, n) and b (n, k); returns det A.
function solve(n, k, A, b) {
  const exchange = (rows, p, q, count) => {
    for (let j = 0; j < count; j++)
      [rows[p * count + j], rows[q * count + j]] = [rows[q * count + j], rows[p * count + j]];
  };
  let determinant = 1;
  for (let p = 0; p < n; p++) {
    let best = p;
    for (let i = p + 1; i < n; i++) if (fabs(A[i * n + p]) > fabs(A[best * n + p])) best = i;
    if (best !== p) {
      exchange(A, p, best, n);
      exchange(b, p, best, k);
      determinant = -determinant;
    }
    determinant *= A[p * n + p];
    if (k === 0 && determinant === 0) return 0;
    for (let i = p + 1; i < n; i++) {
      const factor = A[i * n + p] / A[p * n + p];
      for (let j = p; j < n; j++) A[i * n + j] -= factor * A[p * n + j];
      for (let j = 0; j < k; j++) b[i * k + j] -= factor * b[p * k + j];
    }
  }
  for (let j = 0; j < k; j++)
    for (let p = n - 1; p >= 0; p--) {
      for (let i = p + 1; i < n; i++) b[p * k + j] -= A[p * n + i] * b[i * k + j];
      b[p * k + j] /= A[p * n + p];
    }
  return determinant;
}
"""
