"""Rewrites traced graphs: replaces several operations by one that the kernel has."""

from collections.abc import Iterator
from typing import Any

import torch
from torch.fx import Graph, GraphModule, Node

aten = torch.ops.aten


def rewrite(graph_module: GraphModule) -> GraphModule:
    """The same function, with tanh a instead of 2σ(2a) − 1, which lyapnet's networks use, and x instead of x¹."""
    graph = Graph()
    graph.output(graph.graph_copy(graph_module.graph, {}))
    for power in graph.find_nodes(op="call_function", target=aten.pow.Tensor_Scalar):
        if power.args[1] == 1:
            power.replace_all_uses_with(power.args[0])
    for sigmoid in graph.find_nodes(op="call_function", target=aten.sigmoid.default):
        a = _half_of(sigmoid.args[0])
        if a is not None:
            with graph.inserting_after(sigmoid):
                _insert_tanh(graph, sigmoid, graph.call_function(aten.tanh.default, (a,)))
    graph.eliminate_dead_code()
    return GraphModule(graph_module, graph)


def _insert_tanh(graph: Graph, sigmoid: Node, tanh: Node) -> None:
    """Replace 2σ − 1 by tanh a, and its derivative 2(2g)σ(1 − σ) by g(1 − tanh² a), where σ = σ(2a)."""
    for doubled in _doubles_of(sigmoid):
        for node in list(doubled.users):
            if node.target is aten.sub.Tensor and node.args == (doubled, 1) and not node.kwargs:
                node.replace_all_uses_with(tanh)
    for slope in list(sigmoid.users):
        if slope.target is aten.sigmoid_backward.default and slope.args[1] is sigmoid:
            g = _half_of(slope.args[0])
            for node in _doubles_of(slope) if g is not None else ():
                with graph.inserting_after(node):
                    node.replace_all_uses_with(graph.call_function(aten.tanh_backward.default, (g, tanh)))


def _doubles_of(x: Node) -> Iterator[Node]:
    """The nodes that are 2x."""
    return (node for node in list(x.users) if _half_of(node) is x)


def _half_of(node: Any) -> Node | None:
    """x if a node is 2x, else None."""
    if not isinstance(node, Node) or node.target not in (aten.mul.Tensor, aten.mul.Scalar):
        return None
    x, factor = node.args[:2]
    return x if isinstance(x, Node) and not isinstance(factor, Node) and factor == 2 else None
