"""Operator graphs rewritten for bounds: the same function, with tighter bounds."""

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
    """The graph without nodes that return their argument, and without repeated computations."""
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
    """The graph with c = 1 inside x and c = 0 inside y for each where(c, x, y) with a scalar c: the same function.

    Differentiable code guards its branches, as in where(c, p/where(c, d, 1), y). On a box that does not decide c, the
    inner result would enclose both d and 1, however small the box is.
    """
    for node in list(graph.nodes):
        if node.target is aten.where.self and isinstance(node.args[0], Node) and _shape(node.args[0]) == ():
            truth, *branches = node.args
            known = [
                _assuming(graph, truth, value, y, before=node) for value, y in zip((True, False), branches, strict=True)
            ]
            node.args = (truth, *known)
    graph.eliminate_dead_code()
    return graph


def _assuming(graph: Graph, truth: Node, value: bool, result: Any, before: Node) -> Any:
    """The result, from copies of the nodes between a truth and it, in which the truth has a known value."""
    copies: dict[Node, Any] = {}
    with graph.inserting_before(before):
        for node in _between(truth, result):
            if not copies:
                copies[truth] = graph.call_function(aten.full.default, ([], value), {"dtype": torch.bool})
            copies[node] = graph.node_copy(node, lambda source: copies.get(source, source))
    return copies.get(result, result)


def _between(start: Node, end: Any) -> list[Node]:
    """The nodes that depend on the start and on which the end depends, in the order of the graph."""
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
    """The graph with y(min(x, c)) in the place of y(x) in each where(x > c, …, y(x)): the same function.

    Softplus is written so. Without the limit the bounds of eˣ overflow where the result is x.
    """
    graph = copy.deepcopy(module.graph)
    for node in list(graph.nodes):
        truth = next(iter(node.args), None)
        if node.target is aten.where.self and isinstance(truth, Node) and truth.target is aten.gt.Scalar:
            x: Any = truth.args[0]
            with graph.inserting_before(node):
                copies: dict[Any, Any] = {x: graph.call_function(aten.clamp.default, (x, None, truth.args[1]))}
                copies[x].meta = dict(x.meta)
                for each in _between(x, node.args[2]):
                    copies[each] = graph.node_copy(each, lambda source, known=copies: known.get(source, source))
            node.args = (*node.args[:2], copies.get(node.args[2], node.args[2]))
    graph.eliminate_dead_code()
    return GraphModule(module, graph)


DECIDED = 2.0**-22
"""Distance from a threshold, relative to the numbers that were added, beyond which float32 comes to the same truth."""


def with_known_times(module: GraphModule, latest: float) -> GraphModule:
    """The graph for 0 ≤ t ≤ latest, t its first argument: clamps that keep t are gone, and so are choices that its
    truths about t decide. Programs in float32 or float64 keep t and choose likewise.

    Followed are t plus numbers, which rise with t: what holds at both ends of its range holds between them.
    """
    graph, ends, truths = copy.deepcopy(module.graph), dict[Node, list[float]](), dict[Node, bool]()
    sizes = dict[Node, float]()  # of the numbers that were added
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
            room = DECIDED * (sizes[source] + abs(node.args[-1]))
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
    """A key that equal constants share: dtype, shape and bits of a tensor; else the name."""
    value = attrgetter(str(node.target))(graph.owning_module) if graph.owning_module is not None else None
    if not isinstance(value, Tensor):
        return str(node.target)
    try:
        return value.dtype, tuple(value.shape), value.detach().cpu().contiguous().numpy().tobytes()
    except (TypeError, RuntimeError):  # a dtype that NumPy lacks
        return str(node.target)


def _shape(node: Any) -> Any:
    """The shape of the node's value; if it was not recorded, the node itself, which equals no other."""
    return node.meta["val"].shape if isinstance(node.meta.get("val"), Tensor) else node
