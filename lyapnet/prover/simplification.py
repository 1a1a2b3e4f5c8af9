"""Rewrites graphs of operators: the function stays the same, and its bounds become tighter."""

import copy
from operator import attrgetter
from typing import Any

import torch
from torch import Tensor
from torch.fx import Graph, GraphModule, Node

from lyapnet.graphs.tracing import is_view, name_of, without_repetitions

aten = torch.ops.aten

COPIES = {aten.alias.default, aten.clone.default, aten.expand.default, aten.view.default, aten.reshape.default}


def without_copies(graph: Graph) -> Graph:
    """The graph without nodes that only return their argument, and without repeated computations."""
    constants: dict[Any, Node] = {}
    for node in list(graph.nodes):
        if node.op == "get_attr":  # without_repetitions does not merge constants
            node.replace_all_uses_with(constants.setdefault(_content(graph, node), node))
        elif node.target in COPIES and _shape(node) == _shape(node.args[0]):
            node.replace_all_uses_with(node.args[0])
            graph.erase_node(node)
    graph = without_repetitions(graph)
    graph.eliminate_dead_code()
    return graph


def with_known_truths(graph: Graph) -> Graph:
    """The same function with c = 1 inside x and c = 0 inside y, for each where(c, x, y) with a scalar c.

    Differentiable code often has such conditions twice, as in where(c, p/where(c, d, 1), y). On a box on which c is
    neither true nor false throughout, the bounds of the inner where would enclose both d and 1, on small boxes too.
    """
    for node in list(graph.nodes):
        if node.target is aten.where.self and isinstance(node.args[0], Node) and _shape(node.args[0]) == ():
            truth, *branches = node.args
            known = [
                _copy_with_truth(graph, truth, value, y, before=node)
                for value, y in zip((True, False), branches, strict=True)
            ]
            node.args = (truth, *known)
    graph.eliminate_dead_code()
    return graph


def _copy_with_truth(graph: Graph, truth: Node, value: bool, result: Any, before: Node) -> Any:
    """A copy of the result, with copies of all nodes between the truth and it in which the truth has a known value."""
    copies: dict[Node, Any] = {}
    with graph.inserting_before(before):
        for node in _nodes_between(truth, result):
            if not copies:
                copies[truth] = graph.call_function(aten.full.default, ([], value), {"dtype": torch.bool})
            copies[node] = graph.node_copy(node, lambda source: copies.get(source, source))
    return copies.get(result, result)


def _nodes_between(start: Node, end: Any) -> list[Node]:
    """The nodes that depend on the start and on which the end depends, the end included, in the order of the graph."""
    if not isinstance(end, Node):
        return []
    below, above = {start}, {end}
    nodes = list(start.graph.nodes)
    for node in nodes:
        if below.intersection(node.all_input_nodes):
            below.add(node)
    for node in reversed(nodes):
        if node in above:
            above.update(node.all_input_nodes)
    return [node for node in nodes if node in below & above and node is not start]


def with_limited_arguments(module: GraphModule) -> GraphModule:
    """The same function with y(min(x, c)) instead of y(x) in each where(x > c, …, y(x)), as softplus is written.

    Without this limit the bounds of eˣ in a softplus overflow for large x, where the result is x.
    """
    graph = copy.deepcopy(module.graph)
    for node in list(graph.nodes):
        truth = next(iter(node.args), None)
        if node.target is aten.where.self and isinstance(truth, Node) and truth.target is aten.gt.Scalar:
            x: Any = truth.args[0]
            with graph.inserting_before(node):
                copies: dict[Any, Any] = {x: graph.call_function(aten.clamp.default, (x, None, truth.args[1]))}
                copies[x].meta = dict(x.meta)
                for each in _nodes_between(x, node.args[2]):
                    copies[each] = graph.node_copy(each, lambda source, known=copies: known.get(source, source))
            node.args = (*node.args[:2], copies.get(node.args[2], node.args[2]))
    graph.eliminate_dead_code()
    return GraphModule(module, graph)


SAFE_DISTANCE = 2.0**-22
"""Least distance of t from a threshold at which float32 surely compares them like real numbers do; relative to the sum
of the sizes of all numbers in the comparison. It is 4 units of float32, 2⁻²⁴ each.
"""


def with_known_times(module: GraphModule, latest: float) -> GraphModule:
    """The same function for 0 ≤ t ≤ latest, where t is its first argument, without operations that do nothing there.

    These are clamps that do not change t, and where(truth, x, y) with a truth about t that is the same for all these t.
    Only t plus or minus constants is considered, which rises with t, so that what holds at both ends of its range
    holds between them. Programs in float32 and float64 come to the same truths.
    """
    graph = copy.deepcopy(module.graph)
    ends = dict[Node, list[float]]()  # values at t = 0 and at t = latest
    truths = dict[Node, bool]()  # known truths about t
    sizes = dict[Node, float]()  # Σ |summands|, for the rounding of float32
    for node in list(graph.nodes):
        source, name = next(iter(node.args), None), name_of(node.target)
        if node.op == "placeholder" and not ends:
            ends[node], sizes[node] = [0.0, latest], latest
        elif source in truths and is_view(node.target):
            truths[node] = truths[source]
        elif name == "where" and source in truths:
            chosen = node.args[1 if truths[source] else 2]
            if _shape(chosen) == _shape(node):
                node.replace_all_uses_with(chosen)
        elif source in ends and isinstance(node.args[-1], int | float) and not node.kwargs:
            at = [float(node.target(torch.tensor(end, dtype=torch.float64), *node.args[1:])) for end in ends[source]]
            room = SAFE_DISTANCE * (sizes[source] + abs(node.args[-1]))
            if name in ("add", "sub"):
                ends[node], sizes[node] = at, sizes[source] + abs(node.args[-1])
            elif name == "clamp" and at == ends[source] == [0.0, latest] and not 0 < abs(node.args[-1] - latest) < room:
                node.replace_all_uses_with(source)
            elif name in ("ge", "gt", "le", "lt") and at[0] == at[1]:
                near = any(abs(end - node.args[1]) <= room for end in ends[source])
                truths.update({} if near else {node: bool(at[0])})
    graph.eliminate_dead_code()
    return GraphModule(module, graph)


def _content(graph: Graph, node: Node) -> Any:
    """A key that equal constants share: dtype, shape and bits of a tensor; the name of other constants."""
    value = attrgetter(str(node.target))(graph.owning_module) if graph.owning_module is not None else None
    if not isinstance(value, Tensor):
        return str(node.target)
    try:
        return value.dtype, tuple(value.shape), value.detach().cpu().contiguous().numpy().tobytes()
    except (TypeError, RuntimeError):  # a dtype that NumPy lacks
        return str(node.target)


def _shape(node: Any) -> Any:
    """The shape of the node's value; if it was not recorded, the node itself, which equals no shape."""
    return node.meta["val"].shape if isinstance(node.meta.get("val"), Tensor) else node
