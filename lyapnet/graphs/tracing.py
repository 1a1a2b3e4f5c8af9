"""Traces functions of tensors to flat graphs of tensor operations, and cuts graphs where late arguments enter."""

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import cache
from traceback import FrameSummary
from typing import Any

import torch
from torch import Tensor
from torch._decomp import core_aten_decompositions, get_decompositions
from torch.func import functionalize
from torch.fx import Graph, GraphModule, Node
from torch.fx.experimental.proxy_tensor import make_fx
from torch.fx.node import map_arg
from torch.overrides import TorchFunctionMode

from lyapnet.base.errors import LyapnetError, UntraceableError, UsageError, one_line, own_line, place_of, running_line
from lyapnet.base.operators import WHOLE, as_operators
from lyapnet.graphs.agreement import are_close
from lyapnet.graphs.operators import OPERATORS

Tensors = tuple[Tensor, ...]


def trace(
    function: Callable[..., Tensors],
    arguments: Sequence[Tensor],
    elsewhere: Sequence[Sequence[Tensor]] = (),
    decompositions: Mapping[Any, Any] | None = None,
    whole: bool = False,
) -> GraphModule:
    """The tensor operations that `function` runs for arguments of these shapes, including derivatives inside it.

    The result contains no Python code of the function and computes each expression once. It records no autograd graph,
    so run it under no_grad. Tensors have no values during tracing. Code that reads values (x.numpy(), float(x),
    if x > 0) raises an error, because its result would be frozen at these arguments. Everything else that the function
    reads is frozen at its present value.

    Args:
        elsewhere: other values of the last arguments, at which the trace is compared with the function.
        decompositions: operator ↦ its implementation in simpler operators, for a reader that knows only these.
        whole: whether lyapnet's own operators stay in the graph, for a reader that knows them.

    Raises:
        UsageError: the function draws random numbers, writes to tensors that outlive the call, or reads memory that was
            never written.
        UntraceableError: it reads the values of a tensor; the message names the line.
        Exception: any other exception of the function.
    """
    options = {"decomposition_table": decompositions, "tracing_mode": "fake", "_allow_non_fake_inputs": True}
    with as_operators() if whole else nullcontext(), _value_errors(), _Monitor() as monitor:
        graph_module = make_fx(function, **options)(*arguments)
    written = next((node for node in graph_module.graph.nodes if _mutates(node) and _writes_outside(node)), None)
    if written is not None:
        raise UsageError(
            f"Expected f, g, the cost, U, V and u to be functions that remember nothing, got {name_of(written.target)} "
            f"on a tensor that outlives the call{place_of(monitor.written)}; fill constants in __init__, keep counters "
            "and logs outside, and call .eval() where there is a BatchNorm."
        )
    # torch squeezes products with a vector in place; a new trace without mutations would take as long as the first one
    for node in graph_module.graph.nodes:
        if node.target is torch.ops.aten.squeeze_.dim and len(node.args[0].users) == 1:
            node.target = torch.ops.aten.squeeze.dim
    if any(_mutates(node) for node in graph_module.graph.nodes):  # `cut` could separate a tensor from its assignments
        graph_module = make_fx(functionalize(graph_module), **options)(*arguments)
    if any(_depends_on_values(node) for node in graph_module.graph.nodes):
        raise UntraceableError(
            "Expected torch operations whose shapes do not depend on values, got one that reads values (x.item(), "
            "x[mask], nonzero); use torch.where."
        )
    for node in list(graph_module.graph.nodes):
        if torch.Tag.nondeterministic_seeded in getattr(node.target, "tags", ()):
            raise UsageError(
                f"Expected f, g, the cost and V without random numbers, got {node.target}; leave dropout and noise "
                "out, or train with rollout.gradient=backprop."
            )
        if node.op == "call_function" and node.target is torch.ops.aten.detach.default:
            node.replace_all_uses_with(node.args[0])
            graph_module.graph.erase_node(node)
    graph_module = _simplify(graph_module, graph_module.graph)
    _require_written_memory(graph_module.graph)
    if not WHOLE.isdisjoint(node.target for node in graph_module.graph.nodes):
        # lyapnet's operators differ from torch's for arguments outside of their domain
        _require_same(graph_module, function, arguments)
    for others in elsewhere:
        _require_same(graph_module, function, [*arguments[: -len(others)], *others])
    return graph_module


def core_trace(
    function: Callable[..., Tensors], arguments: Sequence[Tensor], what: str, refusal: type[LyapnetError]
) -> GraphModule:
    """The trace of a function in torch's core operators, for a reader that translates them to another language.

    Args:
        what: the name of the function in messages.
        refusal: the class of the error if it cannot be traced.
    """
    # not cached, as an operator may have been registered since the last trace
    simpler = {target: others for target, others in _core_decompositions().items() if not _has_row(target)}
    try:
        with torch.no_grad():  # in a lambda, because make_fx would count `self` as an argument
            return trace(lambda *a: function(*a), arguments, decompositions=simpler)
    except LyapnetError as error:
        raise refusal(str(error)) from error
    except Exception as error:  # user code may raise anything
        line = one_line(error)[:200]
        raise refusal(
            f"Expected {what} that torch can trace, got {type(error).__name__}: {line}; write them in torch "
            "operations, with torch.where for branches that depend on values."
        ) from error


@cache
def _core_decompositions() -> Mapping[Any, Any]:
    """Operator ↦ its implementation in core operators; cached, since torch goes through all operators to make it."""
    return {**core_aten_decompositions(), **get_decompositions(NOT_CORE)}


def _has_row(target: Any) -> bool:
    """Whether the table of operators has this overload, which takes only tensors, in C and CasADi."""
    row = OPERATORS.get(name_of(target))
    return row is not None and row.c is not None and row.casadi is not None and target is row.overloads[0]


# core operators that torch can also decompose into simpler ones
NOT_CORE = [getattr(torch.ops.aten, name) for name in ("addmm", "elu", "gelu", "hardtanh", "leaky_relu")]

# operators that create constants with the shape of an argument
SHAPED = {"empty_like", "full_like", "new_empty", "new_full", "new_ones", "new_zeros", "ones_like", "zeros_like"}


def _require_written_memory(graph: Graph) -> None:
    for node in graph.nodes:
        if name_of(node.target) in UNINITIALISED and not all(_overwrites(user, node) for user in node.users):
            raise UsageError(
                f"Expected f, g, the cost and V without uninitialised memory, got {node.target}; use zeros or full."
            )


def _overwrites(node: Node, memory: Node) -> bool:
    """Whether a node overwrites all of some memory."""
    return name_of(node.target) in ("fill", "copy") and node.args[0] is memory and memory not in node.args[1:]


class _Monitor(TorchFunctionMode):
    """Raises an error if code reads values of a traced tensor, also if the code catches torch's error.

    Converting a tensor to text counts as reading, although torch raises no error for it.
    """

    refusal: Exception | None = None
    written: FrameSummary | None = None  # the first line that writes to a tensor from outside of the function

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        target = (kwargs or {}).get("out", args[0] if args and WRITES.search(func.__name__) else None)
        if type(target) is Tensor and self.written is None:
            self.written = running_line()
        try:
            if func in (Tensor.__repr__, Tensor.__format__, Tensor.__reduce_ex__):
                raise RuntimeError("FakeTensor as text")
            return func(*args, **(kwargs or {}))
        except Exception as error:
            self.refusal = self.refusal or (error if NO_VALUES.search(str(error)) else None)
            raise

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        super().__exit__(kind, error, trace)
        if error is None and self.refusal is not None:
            raise self.refusal


@contextmanager
def _value_errors():
    """Convert torch's errors about values of traced tensors to an UntraceableError that names the line."""
    try:
        yield
    except (RuntimeError, NotImplementedError) as error:
        known = type(error).__module__.startswith("torch.") or NO_VALUES.search(str(error))
        if not known:
            raise
        raise UntraceableError(
            f"Expected torch operations, with control flow that does not depend on values, got code that reads the "
            f"values of a tensor{place_of(own_line(error))}; use torch.where, or lyapnet.Table for a table."
        ) from error


WRITES = re.compile(r"[a-z0-9]_$|^__(setitem|i[a-z]+)__$")  # names of functions that write to their first argument

UNINITIALISED = ("empty", "empty_like", "empty_strided", "empty_permuted", "new_empty", "new_empty_strided")

NO_VALUES = re.compile(r"tensor subclasses|data pointer|'meta' device|Cannot copy out of meta|FakeTensor")
"""Parts of torch's error messages for code that reads values of a tensor without values."""


def cut(
    graph_module: GraphModule, late: int, early_outputs: int, repeat: bool = True
) -> tuple[GraphModule, GraphModule]:
    """Cut a graph into (early, rest) where its last `late` arguments enter.

    early(*arguments[:-late]) returns the first `early_outputs` results, which must not depend on the late arguments,
    and then the intermediate results that the rest needs. rest(*arguments, *intermediate) returns the other results.

    Args:
        repeat: whether the rest repeats cheap arithmetic instead of receiving its results.
    """
    nodes = list(graph_module.graph.nodes)
    arguments, results = [node for node in nodes if node.op == "placeholder"], _results(graph_module.graph)
    after = set(arguments[-late:])
    for node in nodes:
        if after.intersection(node.all_input_nodes):
            after.add(node)
    repeated = after | _repeatable(nodes, POINTWISE if repeat else set())  # computed by the rest

    wanted = set(results[early_outputs:])
    for node in reversed(nodes):
        if node in wanted and node in repeated:
            wanted.update(node.all_input_nodes)
    passed = [node for node in nodes if node in wanted and node not in repeated]

    early, rest = Graph(), Graph()
    copies = {node: early.placeholder(node.name) for node in arguments[:-late]}
    for node in nodes:
        if node.op in COMPUTED and node not in after:
            copies[node] = early.node_copy(node, copies.__getitem__)
    early.output(tuple(copies[node] for node in (*results[:early_outputs], *passed)))

    copies = {node: rest.placeholder(node.name) for node in (*arguments, *passed)}
    for node in nodes:
        if node in wanted and node not in copies:
            copies[node] = rest.node_copy(node, copies.__getitem__)
    rest.output(tuple(copies[node] for node in results[early_outputs:]))
    return _simplify(graph_module, early), _simplify(graph_module, rest)


COMPUTED = ("call_function", "get_attr")


# operators that are cheap enough to be computed again: their results are as large as their arguments
POINTWISE = {"add", "sub", "rsub", "neg", "mul", "div", "pow", "sigmoid_backward", "tanh_backward"}


def _repeatable(nodes: Sequence[Node], cheap: set[str]) -> set[Node]:
    """The nodes that the rest computes again instead of receiving them: arguments, constants, views, cheap ones."""
    return {
        node
        for node in nodes
        if node.op in ("placeholder", "get_attr")
        or (node.op == "call_function" and (is_view(node.target) or name_of(node.target) in cheap))
    }


def _require_same(graph_module: GraphModule, function: Callable[..., Tensors], arguments: Sequence[Tensor]) -> None:
    """Refuse a trace that differs from its function in the first half of the digits; sums may be in another order."""
    with torch.no_grad():
        results, expected = graph_module(*arguments), function(*arguments)
    for result, value in zip(results, expected, strict=True):
        if not are_close(result, value):
            raise ValueError(
                "Expected f, g, the cost and V to be functions of t and x alone, got code that leaves torch or "
                "computes something else each time; use torch operations and no hidden state."
            )


def name_of(target: Any) -> str:
    """An operator's name without its overload."""
    return getattr(target, "__name__", "").split(".")[0]


def _depends_on_values(node: Node) -> bool:
    """Whether the shape of the result depends on values of the arguments, as for nonzero or x[mask]."""
    if node.target is torch.ops.aten.index.Tensor:  # indexing by integers does not
        return any(source.meta["val"].dtype == torch.bool for source in node.all_input_nodes[1:])
    return node.target is torch.ops.aten._local_scalar_dense.default or (
        torch.Tag.dynamic_output_shape in getattr(node.target, "tags", ())
    )


def _mutates(node: Node) -> bool:
    schema = getattr(node.target, "_schema", None)
    return schema is not None and schema.is_mutable


def _writes_outside(node: Node) -> bool:
    """Whether an operator writes to a tensor that was not created in the function, such as a buffer or its view."""
    schema: Any = node.target._schema  # pyright: ignore[reportFunctionMemberAccess, reportAttributeAccessIssue]
    values = [*node.args, *(node.kwargs.get(each.name) for each in schema.arguments[len(node.args) :])]
    for argument, value in zip(schema.arguments, values, strict=True):
        if argument.alias_info is not None and argument.alias_info.is_write and isinstance(value, Node):
            while value.op == "call_function" and is_view(value.target):
                value = value.all_input_nodes[0]
            if value.op == "get_attr":
                return True
    return False


def is_view(target: Any) -> bool:
    """Whether an operator's result shares its argument's memory."""
    schema = getattr(target, "_schema", None)
    return schema is not None and any(result.alias_info is not None for result in schema.returns)


def _results(graph: Graph) -> tuple[Node, ...]:
    (output,) = (node for node in graph.nodes if node.op == "output")
    result = output.args[0]
    return tuple(result) if isinstance(result, list | tuple) else (result,)  # pyright: ignore


def without_repetitions(graph: Graph) -> Graph:
    """A copy of the graph that computes each expression once; results do not share memory.

    torch's fx_graph_cse does the same, but needs about a second to import the compiler.
    """
    shorter, copies, known = Graph(), dict[Node, Node](), dict[Any, Node]()
    memory = {_memory(node) for node in _results(graph) if isinstance(node, Node)}
    for node in graph.nodes:
        if not _can_be_shared(node) or _memory(node) in memory:
            copies[node] = shorter.node_copy(node, copies.__getitem__)
            continue
        arguments = map_arg((node.args, node.kwargs), copies.__getitem__)
        key = node.target, _key_of(arguments)
        if key not in known:
            known[key] = shorter.node_copy(node, copies.__getitem__)
        copies[node] = known[key]
    return shorter


def _can_be_shared(node: Node) -> bool:
    """Whether a node always computes the same result from the same arguments."""
    random = torch.Tag.nondeterministic_seeded in getattr(node.target, "tags", ())
    return (
        node.op == "call_function" and name_of(node.target) not in UNINITIALISED and not random and not _mutates(node)
    )


def _memory(node: Node) -> Any:
    """A key of the memory of a node's tensor; the node itself if its value is no tensor with memory."""
    value = node.meta.get("val")
    try:
        return value.untyped_storage()._cdata if isinstance(value, Tensor) else node
    except NotImplementedError:
        return node


def _key_of(value: Any) -> Any:
    """A key that is equal for identical arguments only: 1, 1.0 and True differ, and so do 0.0 and −0.0."""
    if isinstance(value, tuple | list):
        return type(value), *map(_key_of, value)
    if isinstance(value, dict):
        return dict, *((name, _key_of(each)) for name, each in value.items())
    if isinstance(value, slice):
        return slice, *map(_key_of, (value.start, value.stop, value.step))
    return type(value), repr(value) if isinstance(value, float | complex) else value


def _simplify(root: GraphModule, graph: Graph) -> GraphModule:
    graph = without_repetitions(graph)
    graph.eliminate_dead_code()
    return GraphModule(root, graph)
