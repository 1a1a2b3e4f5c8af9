"""Bounds over boxes of the difference between a program in floating-point numbers and the function that it computes.

The program runs the operations of a graph (t, x) ↦ u one after another, each with an error: ỹ_k = f_k(ỹ) + d_k. The
errors s d with 0 ≤ s ≤ 1 lead from the exact values (s = 0) to those of the program (s = 1), so that

    ũ_j − u_j = Σ_k d_k ∫ ∂u_j/∂y_k ds,     |ũ_j − u_j| ≤ S_j(t, x) = Σ_k |∂u_j/∂y_k| |d_k|,

with each factor at its largest under all errors. S is bounded like other functions: its derivatives are those of
autograd, `mark_rounded` makes bounds hold for all errors at once, and boxes are cut until the largest S is known. Kinks
are covered: for almost all d the path crosses them at isolated s, and bounds enclose the derivatives on both sides. So
are truth values that rounding may change: the error of where(c, a, b) is |a − b| on boxes on which c may be both.

Errors |d_k|, with u = 2⁻²⁴ in float32 and 2⁻⁵³ in float64 (Higham, "Accuracy and Stability of Numerical Algorithms",
chapters 2 to 4), plus the smallest normal number for underflow:

* + − · / and √, the rounding of t and x, and that of each constant: u |y|. A product by a power of two is exact.
* Sums of n products, in any order: γ Σ |a_i b_i| with γ = k u/(1 − k u), k = n, or n + 1 with rounded constants.
* Functions of the C library: 2 · ULPS · u |y|, on the assumption that they err by at most ULPS units in the last place.

A compiler may fuse a product with the sum that uses it, which leaves the rounding of the product out. If other
operations use the product too, they may take its rounded value; the sum is then given the error of the product once
more. A compiler may also compute in a wider format and round twice, for which DOUBLE_ROUNDING enlarges u. Arithmetic in
another order, as with -ffast-math, is not covered.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.fx import GraphModule, Interpreter, Node
from torch.fx.node import map_arg
from torch.utils._pytree import tree_map

from lyapnet.base.errors import UsageError
from lyapnet.base.types import Corner, PerState, State, Time
from lyapnet.graphs.c_functions import without_shape_sources
from lyapnet.graphs.tracing import is_view, name_of
from lyapnet.prover.bounds import BoundedFunction
from lyapnet.prover.boxes import divide_box
from lyapnet.prover.branch_and_bound import Budget, minimum
from lyapnet.prover.readings import Computed
from lyapnet.prover.rounding import mark_rounded
from lyapnet.prover.simplification import with_limited_arguments
from lyapnet.prover.taylor import EPSILON

aten = torch.ops.aten

ULPS = 4
"""Largest error of functions of the C library that is assumed, in units in the last place."""
UNBOUNDED_STATE_LIMIT = 1e6
"""Assumed largest |x_i|, in its unit, of states that nothing depends on and that sets of states do not bound."""
DOUBLE_ROUNDING = 1 + 2.0**-10
"""Factor of u for results that are first rounded to a format with at least 11 more bits."""
FOLDED_UNITS = 4.0
"""Error in float64, in units of rounding, of constants that torch computed: the claim may use other operators."""
TOLERANCE = 0.2  # relative difference between the bound of S and a value of S at which a search ends
START, BOXES = 4096, 200_000  # number of boxes at the start of a search, about, and largest number of bounded boxes


class Format(NamedTuple):
    """A format of floating-point numbers."""

    name: str
    unit: float  # u, the largest relative rounding error
    least: float  # the smallest normal number
    largest: float  # the largest number


FORMATS = {
    torch.float32: Format("float32", DOUBLE_ROUNDING * 2.0**-24, 2.0**-126, 3.4e38),
    torch.float64: Format("float64", DOUBLE_ROUNDING * 2.0**-53, 2.0**-1022, 1.79e308),
}


@dataclass(frozen=True)
class FloatLaw:
    """A control law as a program in floating-point numbers computes it.

    Args:
        graph: (t (), *parts of x) ↦ (u (m,),), the operations of the program in real numbers, in their order.
        sizes: sizes of the parts of x: (n,), or (n, k) with k parameters of a family.
        dtype: the format in which it computes.
        moved: distance by which each limit of u is moved inwards, in the unit of u, (m,).
        latest: the program computes this graph for 0 ≤ t ≤ latest, in s.
        sha256: hash of the program's file.
        path: path of that file.
        claimed: the claim that the file states; empty without one.
    """

    graph: GraphModule
    sizes: Sequence[int]
    dtype: torch.dtype
    moved: Sequence[float]
    latest: float
    sha256: str
    path: str
    claimed: str = ""

    def __fspath__(self) -> str:
        return self.path

    def computed_on(self, states: tuple[Corner, Corner]) -> Computed:
        """The program with its `errors` at states of a box, rounded upwards to two digits; raises as `errors` does."""
        errors = tuple(_round_up(error) for error in self.errors(states))
        return Computed(self.sha256, FORMATS[self.dtype].name, errors, self.latest)

    def errors(self, states: tuple[Corner, Corner], boxes: int = BOXES) -> list[float]:
        """Bounds of |ũ_j − u_j| over all 0 ≤ t ≤ latest and states of a box, (m,), in the units of u.

        Args:
            boxes: largest number of bounded boxes, for each control.

        Raises:
            UsageError: an operation has no rule for its error; or no bound is found.
        """
        ends = zip((0.0, self.latest), states, strict=True)
        lower, upper = (torch.cat([side.new_tensor([t]), side]) for t, side in ends)
        found = [self._error(j, lower, upper, boxes) + moved * (1 + 8 * EPSILON) for j, moved in enumerate(self.moved)]
        if not all(error < float("inf") for error in found):
            raise UsageError(
                f"Expected errors of the C that have a bound on D, got none; it may leave the range of "
                f"{FORMATS[self.dtype].name} there: choose a smaller set."
            )
        return found

    def _error(self, j: int, lower: Corner, upper: Corner, boxes: int) -> float:
        """An upper bound of S_j over a box of (t, x)."""
        graph = with_limited_arguments(without_shape_sources(self.graph))
        numbers = FORMATS[self.dtype]
        known, ends = _constants(graph, numbers), list(accumulate(self.sizes))

        def total(t: Time, x: State) -> PerState:
            """S_j at one (t, x)."""
            with torch.enable_grad():
                t, x = (each.detach().requires_grad_() for each in (t, x))
                program = _Program(graph, known, numbers, t)
                (u,) = program.run(t, *(x[end - size : end] for size, end in zip(self.sizes, ends, strict=True)))
                values, errors = zip(*program.errors, strict=True)
                slopes = torch.autograd.grad(u[j], values, allow_unused=True)
            found = [(slope.abs() * e).sum() for slope, e in zip(slopes, errors, strict=True) if slope is not None]
            return torch.stack(found).sum()

        bounded = BoundedFunction(lambda t, x: (-total(t, x),) * 2, (lower, upper))
        at_points = torch.vmap(lambda t, x: bounded.graph(t, x)[0])
        search = Budget(float("inf"), boxes=boxes)
        # Many boxes at the start: on a wide box, bounds of S improve only by cuts across several axes together, and a
        # search from one box compares cuts across single axes.
        start = divide_box(lower, upper, range(len(lower)), START)
        return -minimum(at_points, *start, search, tolerance=TOLERANCE, bounded=bounded)


def _round_up(error: float) -> float:
    """A number of two digits that is not smaller."""
    digit = 10.0 ** (math.floor(math.log10(error)) - 1) if error else 1.0
    rounded = float(f"{math.ceil(error / digit * (1 - 1e-9)) * digit:.1e}")
    return rounded if rounded >= error else float(f"{rounded + digit:.1e}")


@dataclass(frozen=True)
class _Constant:
    """A value that does not depend on (t, x), with the error that it has in a program."""

    value: Any
    units: float = 0.0  # largest relative error of the program's number, in units of rounding
    scales: bool = False  # whether it is an exact power of two, so that products with it are exact


def _constant(value: Any, numbers: Format, computed: bool = False) -> _Constant:
    """A constant; `computed` means by torch's operators, and so with the error FOLDED_UNITS in float64."""
    if not isinstance(value, Tensor | int | float):
        return _Constant(value)
    y = torch.as_tensor(value).double()
    folded = FOLDED_UNITS * (computed and isinstance(value, Tensor) and value.is_floating_point())
    units = folded if numbers.name == "float64" else 1.0 - bool((y.float().double() == y).all())
    return _Constant(value, units, not units and bool((y.frexp().mantissa.abs() == 0.5).all()))


def _constants(graph: GraphModule, numbers: Format) -> dict[Node, _Constant]:
    """The values in a graph that do not depend on (t, x)."""
    values = dict[Node, Any]()
    for node in graph.graph.nodes:
        if node.op == "get_attr":
            values[node] = getattr(graph, str(node.target)).detach()
        elif node.op == "call_function" and all(source in values for source in node.all_input_nodes):
            args, kwargs = (map_arg(each, values.__getitem__) for each in (node.args, node.kwargs))
            values[node] = node.target(*args, **kwargs)
    computed = {node for node in values if node.op == "call_function" and not is_view(node.target)}
    return {node: _constant(value, numbers, node in computed) for node, value in values.items()}


class _Program(Interpreter):
    """Runs a graph in real numbers, marks the errors of a program for bounds, and collects (y_k, a bound of |d_k|).

    Args:
        known: the values that do not depend on the point (t, x).
        at: t.
    """

    def __init__(self, graph: GraphModule, known: Mapping[Node, _Constant], numbers: Format, at: Tensor):
        super().__init__(graph)
        self.extra_traceback = False  # messages are for users
        self.errors = list[tuple[Tensor, Tensor]]()
        self.fused = list[bool]()  # for each argument of an operation: whether it may be a product with other uses
        self.numbers, self._known, self._at = numbers, known, at

    def run_node(self, n: Node) -> Any:
        if n in self._known:
            return self._known[n]
        if n.op == "placeholder":
            return self.rounded(super().run_node(n))
        if n.op != "call_function" or is_view(n.target):
            return super().run_node(n)
        if name_of(n.target) not in RULES:
            raise UsageError(
                f"Expected operations whose errors in C are known, got {n.target}; certify the law without --file, or "
                "write it in others."
            )
        arguments, keywords = self.fetch_args_kwargs_from_env(n)
        self.fused = [isinstance(source, Node) and _is_shared_product(source) for source in n.args]
        return RULES[name_of(n.target)](self, n.target, *arguments, **keywords)

    def rounded(self, y: Tensor, units: float = 1.0, more: Any = 0.0) -> Tensor:
        """y with an error of units · u |y| + u · more + the smallest normal number."""
        _, unit, least, largest = self.numbers
        marked = mark_rounded(y, self._at, units * unit, least, largest)
        return self.with_error(marked, units * unit * y.detach().abs() + least + unit * more)

    def with_error(self, y: Tensor, error: Tensor) -> Tensor:
        """y, with a bound of its error |d|, whose influence on u is part of S."""
        y = y if y.requires_grad else y.detach().requires_grad_()
        self.errors.append((y, error))
        return y

    def plain(self, value: Any) -> Any:
        """A value whose constants are replaced by the program's numbers, with their errors."""
        return tree_map(lambda leaf: self._as_held(leaf) if isinstance(leaf, _Constant) else leaf, value)

    def _as_held(self, constant: _Constant) -> Any:
        if not constant.units:
            return constant.value
        return self.rounded(torch.as_tensor(constant.value, dtype=torch.float64), constant.units)

    def constant(self, value: Any) -> Any:
        """A plain number as a _Constant; other values unchanged."""
        return _constant(value, self.numbers) if isinstance(value, int | float) else value

    def gamma(self, roundings: float) -> float:
        """γ = k u/(1 − k u), the largest relative error after k roundings."""
        return roundings * self.numbers.unit / (1 - roundings * self.numbers.unit)

    def mark(self, y: Tensor, roundings: float, error: float = 0.0) -> Tensor:
        """y, whose bounds hold after so many roundings and an absolute error; infinite where y may overflow."""
        return mark_rounded(y, self._at, self.gamma(roundings), error, self.numbers.largest / 2)


def _is_shared_product(node: Node, shared: bool = False) -> bool:
    """Whether a value may be a product, or a copy of products, that other operations use too."""
    shared = shared or len(node.users) > 1
    if name_of(node.target) in ("mul", "pow"):
        return shared
    copied = node.op == "call_function" and (is_view(node.target) or name_of(node.target) in COPIES)
    return copied and any(_is_shared_product(source, shared) for source in node.all_input_nodes)


Rule = Callable[..., Any]


def _exact(program: _Program, target: Any, *arguments: Any, **keywords: Any) -> Any:
    """An operation without rounding; its constants may be rounded."""
    return target(*program.plain(arguments), **program.plain(keywords))


def _elementwise(units: float) -> Rule:
    def rule(program: _Program, target: Any, *arguments: Any) -> Tensor:
        return program.rounded(target(*program.plain(arguments)), units)

    return rule


def _sum_of_two(program: _Program, target: Any, a: Any, b: Any, *, alpha: float = 1) -> Tensor:
    """a ± alpha · b."""
    fused = program.fused
    if alpha != 1:
        b, fused = _product_of_two(program, aten.mul.Tensor, b, alpha), [fused[0], False]
    a, b = program.plain([program.constant(a), program.constant(b)])
    more = 0.0
    if fused[0]:
        a, more = program.mark(a, 1), more + a.detach().abs()
    if fused[1]:
        b, more = program.mark(b, 1), more + b.detach().abs()
    return program.rounded(getattr(aten, name_of(target)).Tensor(a, b), more=more)


def _product_of_two(program: _Program, target: Any, a: Any, b: Any, **options: Any) -> Tensor:
    """ab or a/b; the error of an inexact constant is added to that of the operation."""
    if options.get("rounding_mode") is not None:
        raise UsageError(f"Expected operations whose errors in C are known, got {target} with rounding; write others.")
    a, b = program.constant(a), program.constant(b)
    given = [each for each in (a, b) if isinstance(each, _Constant)]
    y = getattr(aten, name_of(target)).Tensor(*(each.value if isinstance(each, _Constant) else each for each in (a, b)))
    scales = any(each.scales for each in ([b] if name_of(target) == "div" else [a, b]) if isinstance(each, _Constant))
    return program.rounded(y, 0.0 if scales else 1.0 + sum(each.units for each in given))


def _power(program: _Program, target: Any, x: Tensor, exponent: float) -> Tensor:
    if program.constant(exponent).units:
        raise UsageError(f"Expected exponents that {program.numbers.name} has, got {exponent}; write it with exp.")
    return program.rounded(target(x, exponent), {2: 1, 1: 0, 3: 2, -1: 1, 0.5: 1}.get(exponent, 2 * ULPS))


def _sum(program: _Program, target: Any, x: Tensor, dim: Any = None, keepdim: bool = False, **options: Any) -> Tensor:
    def total(y: Tensor) -> Tensor:
        return y.sum() if dim is None else y.sum(dim, keepdim)

    terms = x.numel() // max(1, total(x).numel())
    if terms < 2:
        return total(x)
    roundings = terms - 1 + program.fused[0]
    size = program.mark(total(x.detach().abs()), 0)  # bounds all partial sums
    return program.with_error(total(program.mark(x, roundings)), program.gamma(roundings) * size)


def _mean(program: _Program, target: Any, x: Tensor, dim: Any = None, keepdim: bool = False, **options: Any) -> Tensor:
    total = _sum(program, target, x, dim, keepdim)
    return _product_of_two(program, aten.div.Tensor, total, x.numel() // total.numel())


def _matrix_product(program: _Program, target: Any, a: Any, b: Any) -> Tensor:
    """ab of matrices or vectors."""
    units = sum(each.units for each in (a, b) if isinstance(each, _Constant))
    left, right = (each.value.double() if isinstance(each, _Constant) else each for each in (a, b))
    roundings, lost = left.shape[-1] + units, program.numbers.least * left.shape[-1]
    size = program.mark(target(left.detach().abs(), right.detach().abs()), 0)
    if isinstance(a, _Constant):  # the errors of the summands are marked at the factor that depends on the point
        y = target(left, program.mark(right, roundings))
    else:
        y = target(program.mark(left, roundings), right)
    return program.with_error(program.mark(y, 0, lost), program.gamma(roundings) * size + lost)


def _index_put(program: _Program, target: Any, x: Any, indices: Any, values: Any, accumulate: bool = False) -> Tensor:
    """x with some entries replaced, or with values that are added to them one after another (accumulate)."""
    x, indices, values = program.plain((x, indices, values))
    if not accumulate:
        return target(x, indices, values)
    additions = max(len(each) for each in indices if each is not None)
    size = program.mark(target(x.detach().abs(), indices, values.detach().abs(), True), 0)
    y = target(program.mark(x, additions), indices, program.mark(values, additions), True)
    return program.with_error(y, program.gamma(additions) * size)


def _clamp(program: _Program, target: Any, x: Tensor, low: Any = None, high: Any = None) -> Tensor:
    limits = [program.constant(each) for each in (low, high)]
    if not any(each.units for each in limits if isinstance(each, _Constant)):
        return _exact(program, target, x, low, high)
    return aten.clamp.Tensor(
        x, *(torch.as_tensor(program.plain(each)) if each is not None else None for each in limits)
    )


def _comparison(program: _Program, target: Any, a: Any, b: Any) -> Tensor:
    """The comparison of a − b with 0, so that bounds include the rounding of a constant b."""
    a, b = program.plain([program.constant(a), program.constant(b)])
    return getattr(aten, name_of(target)).Scalar(a - b, 0)


def _may_flip(truth: Tensor) -> Tensor:
    """c (1 − c) of a truth value c: 0 for values; its bounds include 1 on boxes on which c may be both."""
    c = truth.double()
    return c * (1 - c)


def _where(program: _Program, target: Any, truth: Any, a: Any, b: Any) -> Tensor:
    a, b = program.plain([program.constant(a), program.constant(b)])
    if isinstance(truth, _Constant):
        return target(truth.value, a, b)
    a, b = (torch.as_tensor(each, dtype=torch.float64) for each in (a, b))
    return program.with_error(target(truth, a, b), _may_flip(truth) * (a - b).detach().abs())


def _copied(program: _Program, target: Any, x: Tensor, **options: Any) -> Tensor:
    """x in another format; a truth value as a number has an error of 1 where rounding may change it."""
    y = target(x, **options)
    return program.with_error(y, _may_flip(x)) if x.dtype == torch.bool else y


COPIES = ("cat", "stack", "clone", "alias", "lift_fresh_copy", "_unsafe_view", "index", "flip")
"""Operators that only copy numbers."""
RULES: dict[str, Rule] = {
    **dict.fromkeys(("add", "sub"), _sum_of_two),
    **dict.fromkeys(("mul", "div"), _product_of_two),
    "pow": _power,
    "sum": _sum,
    "mean": _mean,
    **dict.fromkeys(("mm", "bmm", "mv", "dot"), _matrix_product),
    **dict.fromkeys(("reciprocal", "sqrt"), _elementwise(1)),
    "rsqrt": _elementwise(2),
    **dict.fromkeys(
        ("exp", "log", "log1p", "expm1", "sin", "cos", "tan", "tanh", "atan", "asin", "acos", "sinh", "cosh"),
        _elementwise(2 * ULPS),
    ),
    "sigmoid": _elementwise(2 * ULPS + 3),  # 1/(1 + exp(−x)): the error of exp, and of a sum and a quotient
    "index_put": _index_put,
    "clamp": _clamp,
    "relu": lambda program, target, x: x.clamp(min=0),  # its derivative compares x with 0
    **dict.fromkeys(("gt", "ge", "lt", "le"), _comparison),
    "where": _where,
    "_to_copy": _copied,
    **dict.fromkeys(
        (
            *COPIES, "neg", "abs", "maximum", "minimum", "logical_and", "logical_or", "logical_not", "bitwise_and",
            "bitwise_or", "bitwise_not",
        ),
        _exact,
    ),
}  # fmt: skip
"""Name of an operator ↦ its rule: (program, operator, *arguments) ↦ the result, with its errors in the program."""
