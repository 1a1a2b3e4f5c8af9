"""All of torch's operators with all their arguments: each is refused by name, or its bounds contain its values."""

import faulthandler
import itertools
import json
import math
import os
import warnings
import zlib

import pytest
import torch
from torch.nn import functional

from lyapnet.base.errors import UsageError
from lyapnet.prover.bounds import BoundedFunction
from lyapnet.task.sets import ControlBox

aten = torch.ops.aten
LOWER, UPPER = torch.tensor([0.0, -1.0, -1.0]).double(), torch.tensor([1.0, 1.0, 1.0]).double()


def outside(function, boxes=12, points=12):
    """How many values of a function lie outside its bounds on boxes; None where it is refused.

    Raises:
        Exception: it cannot be evaluated, or is refused in another way.
    """
    generator = torch.Generator().manual_seed(0)
    sides = torch.rand(2, boxes, 3, generator=generator) * 10.0 ** -torch.arange(boxes).remainder(4)[:, None]
    lower = LOWER + (UPPER - LOWER) * 0.9 * torch.rand(boxes, 3, generator=generator)
    upper = torch.minimum(lower + sides[0], UPPER)
    try:
        bounds = BoundedFunction(function, (LOWER, UPPER)).bounds(lower, upper)
    except UsageError:
        return None
    count = 0
    for k in range(boxes):
        for point in lower[k] + (upper[k] - lower[k]) * torch.rand(points, 3, generator=generator).double():
            try:
                values = function(point[0], point[1:])
            except RuntimeError:  # a singular matrix
                continue
            for (low, high), value in zip(bounds, values, strict=True):
                known = low[k].isfinite() & high[k].isfinite()
                dense = value.to_dense()
                count += int((known & ~((low[k] <= dense) & (dense <= high[k]))).sum())
    return count


# Every operator of aten, by its schema

VALUES = {  # values of arguments of each type, used in turn
    "number": (0.3, -1.5, 2, 3.0, True), "float": (0.3, -2.0, 1.0), "int": (0, 1, -1, 2), "bool": (False, True),
    "List[int]": ([0], [3], [1, 0], []), "str": ("none", "floor", "trunc", "tanh"),
    "dtype": (torch.float32, torch.int64, torch.float64, torch.bool),
}  # fmt: skip
SHAPES = ((3,), (3, 3), (1, 3, 3), (), (3,), (3, 3), (3, 1))


def operators():
    """The operators of torch's public functions, methods and modules that take tensors and change none."""
    spaces = (torch, torch.Tensor, functional)
    for name in dir(aten):
        public = name.startswith(("linalg_", "special_")) or any(hasattr(space, name) for space in spaces)
        for overload in getattr(aten, name).overloads() if public and hasattr(getattr(aten, name), "overloads") else ():
            operator = getattr(getattr(aten, name), overload)
            random = torch.Tag.nondeterministic_seeded in operator.tags
            tensors = any("Tensor" in str(argument.type) for argument in operator._schema.arguments)
            if name[0] != "_" and "backward" not in name and tensors and not random and not operator._schema.is_mutable:
                yield operator


def value_of(argument, turn, tensors):
    kind = str(argument.type)
    kind = kind.removeprefix("Optional[").removesuffix("]") if kind.startswith("Optional[") else kind
    if kind == "Tensor":
        return next(tensors)
    if kind in ("List[Tensor]", "List[Optional[Tensor]]"):
        return [next(tensors), next(tensors)]
    values = VALUES["dtype" if argument.name == "dtype" else kind]
    return values[turn % len(values)]


def calls(operator, tries):
    """Functions of (t, x) that call the operator on the point, some with one optional argument."""
    arguments = operator._schema.arguments
    optional = [a for a in arguments if a.has_default_value() and not str(a.type).startswith("Optional[Generator")]
    generator = torch.Generator().manual_seed(zlib.crc32(str(operator).encode()))
    for k in range(tries):
        extra = optional[k % len(optional)].name if optional and k % 2 else ""
        turns = torch.randint(12, (len(arguments),), generator=generator).tolist()
        yield calling(operator, SHAPES[k % len(SHAPES)], extra, turns, constant=k % 4 == 2)


def calling(operator, shape, extra, turns, constant):
    """A call on tensors of a shape; all but the first are constant, or none is."""
    grid = torch.linspace(0.1, 0.9, torch.Size(shape).numel(), dtype=torch.float64).reshape(shape)
    middle, slope = 0.5 + grid, 1 - grid  # computed before tracing, so that the trace has few other operators
    slopes = slope, 0 * slope if constant else slope

    def call(t, x):
        point, positional, named = torch.cat([t[None], x]), [], {}
        tensors = (middle + slopes[min(i, 1)] * point[i % 3] for i in itertools.count())
        for argument, turn in zip(operator._schema.arguments, turns, strict=True):
            given = argument.name == extra or not argument.has_default_value()
            value = value_of(argument, turn, tensors) if given else argument.default_value
            if not argument.kwarg_only:
                positional.append(value)
            elif given:
                named[argument.name] = value
        result = operator(*positional, **named)
        results = result if isinstance(result, tuple | list) else [result]
        return tuple(y.to(torch.float64) for y in results if y is not None)

    return call


def examined(operator, tries=2):
    """(calls that torch accepts, calls that were bounded, values outside)."""
    accepted, bounded, wrong = 0, 0, 0
    for function in calls(operator, tries):
        try:
            function(LOWER[0], LOWER[1:])
        except Exception:  # torch does not accept the call
            continue
        count = outside(function)
        accepted, bounded, wrong = accepted + 1, bounded + (count is not None), wrong + (count or 0)
    return accepted, bounded, wrong


def test_whether_torch_finds_a_matrix_singular_is_not_known():
    """The matrices here are singular up to rounding: torch then returns a code other than 0."""
    assert examined(aten.linalg_solve_ex.default, 8) == (3, 0, 0)


def in_children(function, items):
    """The results of a function for all items, in child processes; None for an item that crashes its process.

    A few of torch's operators crash on unsuitable arguments. A child handles the items until one crashes it; the next
    child starts with that item. If the first item of a child crashes it, its result is None.
    """
    answers = []
    while len(answers) < len(items):
        found = in_a_child(function, items[len(answers) :])
        answers += found or [None]
    return answers


def in_a_child(function, items):
    """The results for the first items, in a child process: for all of them, unless one crashes it."""
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        status = 1
        faulthandler.disable()  # a crash is an answer here
        try:
            for item in items:
                os.write(writer, json.dumps(function(item)).encode() + b"\n")
            status = 0
        finally:
            os._exit(status)
    os.close(writer)
    with os.fdopen(reader) as lines:
        found = [json.loads(line) for line in lines]
    _, status = os.waitpid(child, 0)
    assert os.WIFSIGNALED(status) or status == 0, "an exception of its own"
    assert os.WIFSIGNALED(status) == (len(found) < len(items))
    return found


def ending(number):
    """Abort the process, unless the number is 1."""
    return number if number == 1 else os.abort()


def test_a_process_that_ends_is_noticed():
    (found,) = in_children(lambda operator: examined(operator, 4), [aten.sin.default])
    assert found == list(examined(aten.sin.default, 4))
    assert in_children(ending, [0, 1, 2, 3]) == [None, 1, None, None]


@pytest.mark.gate
def test_each_operator_is_refused_or_bounded():
    """test_operators_at_length.py calls each on tensors of all SHAPES."""
    require_refused_or_bounded(examined)


def require_refused_or_bounded(examine):
    every = list(operators())
    assert len(every) > 400
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # deprecations in torch's own operators
        examined_ones = zip(every, in_children(examine, every), strict=True)
    counts = {operator: count for operator, count in examined_ones if count is not None}
    assert len(every) - len(counts) < 10, sorted(map(str, set(every) - set(counts)))
    assert not [operator for operator, (_, _, wrong) in counts.items() if wrong]
    assert sum(bounded > 0 for _, bounded, _ in counts.values()) > 60


# Parameters of operators

REFUSED = {
    "sum in float32": lambda x: x.sum(dtype=torch.float32),
    "mean in float32": lambda x: x.mean(dtype=torch.float32),
    "float32 in between": lambda x: x.float().double(),
    "integers": lambda x: (3 * x).long().double(),
    "a sum of truths": lambda x: (x > 0).sum().double(),
    "truths added": lambda x: (torch.ones_like(x > 0) + (x > 0)) * x,
    "truths times a number": lambda x: ((x > 0) * 2).double(),
    "prod": lambda x: x.prod(), "cumsum": lambda x: x.cumsum(0), "var": lambda x: x.var(correction=0),
    "floor": lambda x: x.div(0.3, rounding_mode="floor"), "celu": lambda x: functional.celu(x, 0.5),
    "elu": lambda x: functional.elu(x, -0.5), "selu": functional.selu, "gelu": lambda x: functional.gelu(x, "tanh"),
    "hardtanh": lambda x: functional.hardtanh(x, -0.3, 0.4), "logit": lambda x: torch.logit(x, 1e-3),
    "1.5th power": lambda x: (x + 2) ** -1.5, "argmax": lambda x: x.argmax().double(),
    "infinite power": lambda x: x ** float("inf"), "complex": lambda x: torch.complex(x, x).abs(),
    "a softplus of β = 0": lambda x: functional.softplus(x, 0.0),
}  # fmt: skip
BOUNDED = {
    "softplus, β < 0": lambda x: functional.softplus(x, -3.0, 1.0),
    "softplus, β < 0, steep": lambda x: functional.softplus(30 * x, -2.0),
    "softplus, low threshold": lambda x: functional.softplus(x, 2.0, -1.0),
    "its derivative": lambda x: aten.softplus_backward(x, 4 * x, -2.0, 0.5),
    "leaky relu, slope < 0": lambda x: functional.leaky_relu(x, -0.5),
    "clamp, low > high": lambda x: x.clamp(0.5, -0.5), "hardly": lambda x: x.clamp(min=-0.2),
    "sum over no axes": lambda x: x.sum([]), "small integers": lambda x: x - torch.tensor(3, dtype=torch.uint8),
    "α of integers": lambda x: torch.add(x, torch.tensor([1, 2]), alpha=0.3),
    "truths of one shape": lambda x: torch.ones_like(x > 0) * x, "negative powers": lambda x: (x + 2) ** -3,
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_no_rule_covers_is_refused(name):
    assert outside(lambda t, x: (REFUSED[name](x),)) is None


@pytest.mark.parametrize("name", BOUNDED)
def test_parameters_are_in_the_bounds(name):
    assert outside(lambda t, x: (BOUNDED[name](x),)) == 0


@pytest.mark.parametrize("sides", [(-0.3, math.inf), (-math.inf, 0.2), (-math.inf, math.inf)])
def test_a_limit_on_one_side_is_bounded(sides):
    """An infinite limit is left out, because ∞ − ∞ is undefined."""
    low, high = torch.tensor(sides).double()
    assert outside(lambda t, x: (x.clamp(low, high),)) == 0
    ends = BoundedFunction(lambda t, x: (x.clamp(low, high),), (LOWER, UPPER)).bounds(LOWER[None], UPPER[None])
    assert torch.stack(ends[0]).isfinite().all()


@pytest.mark.parametrize("m", [1, 2])
def test_the_law_within_limits_is_bounded_by_them(m):
    """Also on boxes so wide that the limits are the only bounds."""
    limits = [-1.03, -0.37][:m], [0.9, 0.5][:m]
    controls, factor = ControlBox(*limits), torch.tensor([[1.0, 0.3], [-0.4, 0.8]])[:m, :m].double()

    def law(t, x):
        b = torch.stack([20 * x[..., 0] - 9 * x[..., 1] ** 2, torch.exp(3 * x[..., 1]) - 4 * x[..., 0]], -1)[..., :m]
        return (controls.minimise((factor @ factor.mT).expand(*x.shape[:-1], m, m), b),)

    assert outside(law, boxes=200) == 0
    ((least, most),) = BoundedFunction(law, (LOWER, UPPER)).bounds(LOWER[None], UPPER[None])
    low, high = (torch.tensor(side).double() for side in limits)
    assert ((low - 1e-12 <= least) & (most <= high + 1e-12)).all()
    assert (law(0, 2 * torch.rand(500, 2).double() - 1)[0].amin(0) == low).any()


@pytest.mark.parametrize("name", ["scalars", "comparisons", "α"])
def test_numbers_are_float64_where_torch_makes_float32_ones(name):
    """With float32 as the default, as users have it: 0.1 is not rounded to 0.10000000149."""
    functions = {
        "scalars": lambda x: 0.1 * x + 0.3,
        "comparisons": lambda x: (x > 0.1).to(x.dtype) * x + functional.leaky_relu(x, 0.1),
        "α": lambda x: torch.add(x, torch.tensor([1, 2]), alpha=0.3),
    }
    torch.set_default_dtype(torch.float32)
    try:
        point = torch.tensor([[0.5, 0.1 + 1e-9, 0.7]], dtype=torch.float64)
        ((low, high),) = BoundedFunction(lambda t, x: (functions[name](x),), (LOWER, UPPER)).bounds(point, point)
        value = functions[name](point[0, 1:])
    finally:
        torch.set_default_dtype(torch.float64)
    assert ((low[0] <= value) & (value <= high[0])).all()
    assert (high - low).max() < 1e-12
