"""Operator graphs rewritten for bounds: the same function, with tighter bounds."""

from operator import attrgetter
from typing import Any

import torch
from torch import Tensor
from torch.fx import Graph, Node

from lyapnet.graphs.tracing import without_repetitions

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
