"""Poles: states at which a denominator of a function vanishes and the function is unbounded.

An integration step may jump over a pole to states that no trajectory reaches, such as a negative stock of fish.
Logarithms and roots need no such check, since they are nan outside of their domain.
"""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.func import vmap
from torch.fx import GraphModule, Node

from lyapnet.base.errors import LyapnetError, UntraceableError
from lyapnet.base.types import State, StatePath
from lyapnet.graphs.tracing import Tensors, core_trace, name_of

HALVINGS = 50  # number of bisections of a step in which a denominator changes its sign
GROWTH = 1e3  # factor by which a function must grow from both ends of a step to a zero of a denominator at a pole


class Poles:
    """The poles of a function of one state; `crossed` tells whether a path jumps over one."""

    def __init__(self, values: GraphModule, denominators: GraphModule):
        self._values, self._denominators = vmap(values), vmap(denominators)

    def __deepcopy__(self, memo: dict[int, Any]) -> "Poles":
        return self  # it is immutable

    def crossed(self, x: StatePath) -> Bool[Tensor, "*batch"]:
        """Whether a path (nodes, *batch, n) jumps over a pole between two of its nodes.

        The zero of a denominator that changes its sign is found by bisection. A function with a guard at the zero, such
        as torch.where(x == 0, …), does not grow there, and has no pole.
        """
        if not x.numel():  # without paths torch cannot map over them
            return torch.zeros(x.shape[1:-1], dtype=torch.bool)
        flat = x.reshape(len(x), -1, x.shape[-1])
        signs = self._denominators_at(flat) > 0
        step, member = torch.nonzero((signs[1:] != signs[:-1]).any(-1), as_tuple=True)
        crossed = torch.zeros(flat.shape[1], dtype=torch.bool)
        if len(step):
            found = self._is_pole(flat[step, member], flat[step + 1, member])
            crossed[member[found]] = True
        return crossed.reshape(x.shape[1:-1])

    def _denominators_at(self, x: Tensor) -> Float[Tensor, "*batch k"]:
        return torch.cat(self._denominators(x.reshape(-1, x.shape[-1])), -1).reshape(*x.shape[:-1], -1)

    def _is_pole(self, start: State, end: State) -> Bool[Tensor, " b"]:
        """Whether the function has a pole between two states, at which some denominator has different signs."""
        sizes, found = self._sizes(start).maximum(self._sizes(end)), torch.zeros(len(start), dtype=torch.bool)
        first, last = self._denominators_at(start) > 0, self._denominators_at(end) > 0
        for k in torch.nonzero((first != last).any(0)).flatten().tolist():
            low, high = torch.zeros(len(start)).to(start), torch.ones(len(start)).to(start)
            for _ in range(HALVINGS):
                middle = (low + high) / 2
                same = (self._denominators_at(start + middle[:, None] * (end - start))[:, k] > 0) == first[:, k]
                low, high = torch.where(same, middle, low), torch.where(same, high, middle)
            near = [self._sizes(start + share[:, None] * (end - start)) for share in (low, high)]
            grown = (torch.stack(near).amax(0) > GROWTH * sizes).any(-1)
            found |= grown & (first[:, k] != last[:, k])
        return found

    def _sizes(self, x: State) -> Float[Tensor, "b outputs"]:
        """The largest absolute value of each result; ∞ for nan."""
        results = [result.reshape(len(x), -1).abs().amax(-1) for result in self._values(x)]
        return torch.stack(results, -1).nan_to_num(torch.inf, torch.inf) + torch.finfo(x.dtype).tiny


def poles_of(function: Callable[[State], Tensors], example: State) -> Poles | None:
    """The poles of a function of a state (n,); None if no denominator depends on the state.

    Also None if the function cannot be traced; other checks report that.
    """
    try:
        values = core_trace(function, [example], "a function of states", UntraceableError)
    except LyapnetError:
        return None
    dependent, denominators = set[Node](), list[Node]()
    for node in values.graph.nodes:
        if node.op == "placeholder" or dependent.intersection(node.all_input_nodes):
            dependent.add(node)
        divisor = _divisor(node)
        if divisor in dependent and divisor not in denominators:
            denominators.append(divisor)
    if not denominators:
        return None
    graph = torch.fx.Graph()
    copies: dict[Node, Node] = {}
    for node in values.graph.nodes:
        if node.op != "output":
            copies[node] = graph.node_copy(node, copies.__getitem__)
    flat = [graph.call_function(torch.ops.aten.reshape.default, (copies[node], [-1])) for node in denominators]
    graph.output(tuple(flat))
    graph.eliminate_dead_code()
    return Poles(values, GraphModule(values, graph))


def _divisor(node: Node) -> Node | None:
    """The node by which an operation divides, or None."""
    if node.op != "call_function":
        return None
    name, (first, second, *_) = name_of(node.target), (*node.args, None, None)
    negative = isinstance(second, int | float) and second < 0
    if name == "div":
        divisor = second
    elif name in ("reciprocal", "rsqrt") or (name == "pow" and negative):
        divisor = first
    else:
        return None
    return divisor if isinstance(divisor, Node) else None
