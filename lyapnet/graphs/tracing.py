"""Functions of tensors as flat graphs of tensor operations: traced once, cut where late arguments enter."""

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import contextmanager, nullcontext
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
    """The operations that `function` runs on tensors of these shapes, derivatives taken inside it included.

    No Python of the function is left, nothing is computed twice, and nothing records a graph: run it under no_grad.
    The tensors that it is traced on have no values: code that reads them, and so would be frozen at these arguments
    (x.numpy(), float(x), if x > 0), fails where it does. What it reads besides its arguments is frozen as it is now.

    Args:
        elsewhere: other values of its last arguments, on which the trace is held against the function.
        decompositions: operator ↦ the same in simpler operators, for a reader that knows only those.
        whole: whether lyapnet's own operators stay in it, for a reader that has them.

    Raises:
        UsageError: the function draws random numbers.
        UntraceableError: it reads the values of a tensor; names the line.
        Exception: of any other kind that the function raises.
    """
    options = {"decomposition_table": decompositions, "tracing_mode": "fake", "_allow_non_fake_inputs": True}
    with as_operators() if whole else nullcontext(), _reading_values(), _Watch() as watch:
        graph_module = make_fx(function, **options)(*arguments)
    written = next((node for node in graph_module.graph.nodes if _mutates(node) and _writes_outside(node)), None)
    if written is not None:
        raise UsageError(
            f"Expected f, g, the cost, U, V and u to be functions that remember nothing, got {name_of(written.target)} "
            f"on a tensor that outlives the call{place_of(watch.written)}; fill constants in __init__, keep counters "
            "and logs outside, and call .eval() where there is a BatchNorm."
        )
    for node in graph_module.graph.nodes:  # what a product with a vector is to torch; to be traced again takes as long
        if node.target is torch.ops.aten.squeeze_.dim and len(node.args[0].users) == 1:
            node.target = torch.ops.aten.squeeze.dim
    if any(_mutates(node) for node in graph_module.graph.nodes):  # a cut would separate a tensor from its assignments
        graph_module = make_fx(functionalize(graph_module), **options)(*arguments)
    if any(_depends_on_values(node) for node in graph_module.graph.nodes):
        raise UntraceableError(
            "Expected torch operations whose shapes do not depend on values, got one that reads them (x.item(), "
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
    graph_module = _tidied(graph_module, graph_module.graph)
    _require_written_memory(graph_module.graph)
    if not WHOLE.isdisjoint(node.target for node in graph_module.graph.nodes):
        _require_same(graph_module, function, arguments)  # an operator may be another function of wrong arguments
    for others in elsewhere:
        _require_same(graph_module, function, [*arguments[: -len(others)], *others])
    return graph_module


def core_trace(
    function: Callable[..., Tensors], arguments: Sequence[Tensor], what: str, refusal: type[LyapnetError]
) -> GraphModule:
    """The trace of a function in torch's few core operators, for a reader that writes them in another language.

    Args:
        what: the function is, for messages.
        refusal: raised where there is no trace.
    """
    simpler = {**core_aten_decompositions(), **get_decompositions(NOT_CORE)}
    simpler = {target: others for target, others in simpler.items() if not _has_row(target)}
    try:
        with torch.no_grad():
            return trace(lambda *a: function(*a), arguments, decompositions=simpler)  # lambda: make_fx would count self
    except LyapnetError as error:
        raise refusal(str(error)) from error
    except Exception as error:  # any kind: the function is the user's
        line = one_line(error)[:200]
        raise refusal(
            f"Expected {what} that torch can trace, got {type(error).__name__}: {line}; write them in torch "
            "operations, with torch.where for a course that depends on values."
        ) from error


def _has_row(target: Any) -> bool:
    """Whether the table of operators has C and CasADi for an operator of tensors alone."""
    row = OPERATORS.get(name_of(target))
    return row is not None and row.c is not None and row.casadi is not None and target is row.overloads[0]


# torch counts them among its core, but has them in simpler operators too
NOT_CORE = [getattr(torch.ops.aten, name) for name in ("addmm", "elu", "gelu", "hardtanh", "leaky_relu")]

# constants that take their shape from an argument
SHAPED = {"empty_like", "full_like", "new_empty", "new_full", "new_ones", "new_zeros", "ones_like", "zeros_like"}


def _require_written_memory(graph: Graph) -> None:
    for node in graph.nodes:
        if name_of(node.target) in UNINITIALISED and not all(_overwrites(user, node) for user in node.users):
            raise UsageError(
                f"Expected f, g, the cost and V without memory that nothing was written to, got {node.target}; use "
                "zeros or full."
            )


def _overwrites(node: Node, memory: Node) -> bool:
    """Whether nothing of what is in some memory reaches a node's result."""
    return name_of(node.target) in ("fill", "copy") and node.args[0] is memory and memory not in node.args[1:]


class _Watch(TorchFunctionMode):
    """Hold what code asks of tensors without values against it, even where it makes something else of the answer.

    It may write such a tensor as text, in which no number stands, or take whatever torch raises for a reason to go on.
    """

    refusal: Exception | None = None
    written: FrameSummary | None = (
        None  # where a tensor with values, which is none of the function's own, is written to
    )

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
def _reading_values():
    """Say in one line which code read the values of a tensor, where torch says it in its own terms."""
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


WRITES = re.compile(r"[a-z0-9]_$|^__(setitem|i[a-z]+)__$")  # names of what writes to its first argument

UNINITIALISED = ("empty", "empty_like", "empty_strided", "empty_permuted", "new_empty", "new_empty_strided")

NO_VALUES = re.compile(r"tensor subclasses|data pointer|'meta' device|Cannot copy out of meta|FakeTensor")
"""What torch says of code that asks a tensor without values for them."""


def cut(
    graph_module: GraphModule, late: int, early_outputs: int, repeat: bool = True
) -> tuple[GraphModule, GraphModule]:
    """(early, rest): a graph cut where its last `late` arguments enter.

    early(*arguments[:-late]) gives the first `early_outputs` results, which must not need the late arguments, and after
    them the intermediate results that the rest needs; rest(*arguments, *intermediate) gives the other results.

    Args:
        repeat: whether the rest repeats arithmetic that is cheaper than to hand its result over.
    """
    nodes = list(graph_module.graph.nodes)
    arguments, results = [node for node in nodes if node.op == "placeholder"], _results(graph_module.graph)
    after = set(arguments[-late:])
    for node in nodes:
        if after.intersection(node.all_input_nodes):
            after.add(node)
    repeated = after | _repeatable(nodes, POINTWISE if repeat else set())  # what the rest computes itself

    wanted = set(results[early_outputs:])
    for node in reversed(nodes):
        if node in wanted and node in repeated:
            wanted.update(node.all_input_nodes)
    handed = [node for node in nodes if node in wanted and node not in repeated]

    early, rest = Graph(), Graph()
    copies = {node: early.placeholder(node.name) for node in arguments[:-late]}
    for node in nodes:
        if node.op in COMPUTED and node not in after:
            copies[node] = early.node_copy(node, copies.__getitem__)
    early.output(tuple(copies[node] for node in (*results[:early_outputs], *handed)))

    copies = {node: rest.placeholder(node.name) for node in (*arguments, *handed)}
    for node in nodes:
        if node in wanted and node not in copies:
            copies[node] = rest.node_copy(node, copies.__getitem__)
    rest.output(tuple(copies[node] for node in results[early_outputs:]))
    return _tidied(graph_module, early), _tidied(graph_module, rest)


COMPUTED = ("call_function", "get_attr")


# cheap enough to be computed again: what they give is as large as what they take
POINTWISE = {"add", "sub", "rsub", "neg", "mul", "div", "pow", "sigmoid_backward", "tanh_backward"}


def _repeatable(nodes: Sequence[Node], cheap: set[str]) -> set[Node]:
    """What is cheaper to compute again than to hand over: arguments, constants, views, and what is called cheap."""
    return {
        node
        for node in nodes
        if node.op in ("placeholder", "get_attr")
        or (node.op == "call_function" and (is_view(node.target) or name_of(node.target) in cheap))
    }


def _require_same(graph_module: GraphModule, function: Callable[..., Tensors], arguments: Sequence[Tensor]) -> None:
    """Hold a trace against its function, up to half the digits: they may add in another order."""
    with torch.no_grad():
        results, expected = graph_module(*arguments), function(*arguments)
    for result, value in zip(results, expected, strict=True):
        if not are_close(result, value):
            raise ValueError(
                "Expected f, g, the cost and V to be functions of t and x alone, got code that leaves torch or "
                "computes something else each time."
            )


def name_of(target: Any) -> str:
    """An operator's name without its overload."""
    return getattr(target, "__name__", "").split(".")[0]


def _depends_on_values(node: Node) -> bool:
    """Whether the values of its arguments decide the shape of its result: nonzero, or indexing by a mask."""
    if node.target is torch.ops.aten.index.Tensor:  # by integers it does not
        return any(source.meta["val"].dtype == torch.bool for source in node.all_input_nodes[1:])
    return node.target is torch.ops.aten._local_scalar_dense.default or (
        torch.Tag.dynamic_output_shape in getattr(node.target, "tags", ())
    )


def _mutates(node: Node) -> bool:
    schema = getattr(node.target, "_schema", None)
    return schema is not None and schema.is_mutable


def _writes_outside(node: Node) -> bool:
    """Whether an operator writes to a tensor that was not made in the function: a buffer, say, or a part of one."""
    schema: Any = node.target._schema  # pyright: ignore[reportFunctionMemberAccess, reportAttributeAccessIssue]
    given = [*node.args, *(node.kwargs.get(each.name) for each in schema.arguments[len(node.args) :])]
    for argument, value in zip(schema.arguments, given, strict=True):
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
    """A copy of the graph with each expression computed once; results stay tensors of their own.

    torch's own fx_graph_cse does the same, but imports its compiler for it, for about a second.
    """
    once, copies, found = Graph(), dict[Node, Node](), dict[Any, Node]()
    memory = {_memory(node) for node in _results(graph) if isinstance(node, Node)}
    for node in graph.nodes:
        if not _can_be_shared(node) or _memory(node) in memory:
            copies[node] = once.node_copy(node, copies.__getitem__)
            continue
        arguments = map_arg((node.args, node.kwargs), copies.__getitem__)
        key = node.target, _told_apart(arguments)
        if key not in found:
            found[key] = once.node_copy(node, copies.__getitem__)
        copies[node] = found[key]
    return once


def _can_be_shared(node: Node) -> bool:
    """Whether a node computes the same wherever it stands, of the same arguments."""
    random = torch.Tag.nondeterministic_seeded in getattr(node.target, "tags", ())
    return (
        node.op == "call_function" and name_of(node.target) not in UNINITIALISED and not random and not _mutates(node)
    )


def _memory(node: Node) -> Any:
    """What tells the memory of a node's tensor from that of others; the node where it has none of its own."""
    value = node.meta.get("val")
    try:
        return value.untyped_storage()._cdata if isinstance(value, Tensor) else node
    except NotImplementedError:
        return node


def _told_apart(value: Any) -> Any:
    """What two arguments have in common if they are the same: 1, 1.0 and True are not, nor are 0.0 and −0.0."""
    if isinstance(value, tuple | list):
        return type(value), *map(_told_apart, value)
    if isinstance(value, dict):
        return dict, *((name, _told_apart(each)) for name, each in value.items())
    if isinstance(value, slice):
        return slice, *map(_told_apart, (value.start, value.stop, value.step))
    return type(value), repr(value) if isinstance(value, float | complex) else value


def _tidied(root: GraphModule, graph: Graph) -> GraphModule:
    graph = without_repetitions(graph)
    graph.eliminate_dead_code()
    return GraphModule(root, graph)
