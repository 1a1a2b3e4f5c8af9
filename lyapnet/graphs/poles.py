"""Poles: where a function divides by what goes through zero, and its size grows beyond bounds.

A step of some length jumps over a pole, to states that no trajectory reaches: a stock of fish below zero, from which
every catch is paid for again. Logarithms and roots need no such care: beyond their end they are no numbers.
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

HALVINGS = 50  # of the step in which a denominator changes its sign
GROWTH = 1e3  # by which the function is larger there than at both ends of the step, if that is a pole


class Poles:
    """The poles of a function of one state, of which paths may be asked whether a step jumps over one."""

    def __init__(self, values: GraphModule, denominators: GraphModule):
        self._values, self._denominators = vmap(values), vmap(denominators)

    def __deepcopy__(self, memo: dict[int, Any]) -> "Poles":
        return self  # nothing in it changes

    def crossed(self, x: StatePath) -> Bool[Tensor, "*batch"]:
        """Whether a path (nodes, *batch, n) jumps over a pole between two of its nodes.

        Where a denominator changes its sign, the place at which it vanishes is sought by halving; what is guarded
        there, as in torch.where(x == 0, …), does not grow, and is no pole.
        """
        flat = x.reshape(len(x), -1, x.shape[-1])
        signs = self._sides(flat) > 0
        step, member = torch.nonzero((signs[1:] != signs[:-1]).any(-1), as_tuple=True)
        crossed = torch.zeros(flat.shape[1], dtype=torch.bool)
        if len(step):
            found = self._is_pole(flat[step, member], flat[step + 1, member])
            crossed[member[found]] = True
        return crossed.reshape(x.shape[1:-1])

    def _sides(self, x: Tensor) -> Float[Tensor, "*batch k"]:
        return torch.cat(self._denominators(x.reshape(-1, x.shape[-1])), -1).reshape(*x.shape[:-1], -1)

    def _is_pole(self, start: State, end: State) -> Bool[Tensor, " b"]:
        """Whether the function grows without bounds between two states, in which some denominator has two signs."""
        sizes, found = self._sizes(start).maximum(self._sizes(end)), torch.zeros(len(start), dtype=torch.bool)
        first, last = self._sides(start) > 0, self._sides(end) > 0
        for k in torch.nonzero((first != last).any(0)).flatten().tolist():
            low, high = torch.zeros(len(start)).to(start), torch.ones(len(start)).to(start)
            for _ in range(HALVINGS):
                middle = (low + high) / 2
                same = (self._sides(start + middle[:, None] * (end - start))[:, k] > 0) == first[:, k]
                low, high = torch.where(same, middle, low), torch.where(same, high, middle)
            near = [self._sizes(start + share[:, None] * (end - start)) for share in (low, high)]
            grown = (torch.stack(near).amax(0) > GROWTH * sizes).any(-1)
            found |= grown & (first[:, k] != last[:, k])
        return found

    def _sizes(self, x: State) -> Float[Tensor, "b outputs"]:
        """The size of each result; of what is no number, infinity."""
        results = [result.reshape(len(x), -1).abs().amax(-1) for result in self._values(x)]
        return torch.stack(results, -1).nan_to_num(torch.inf, torch.inf) + torch.finfo(x.dtype).tiny


def poles_of(function: Callable[[State], Tensors], example: State) -> Poles | None:
    """The poles of a function of a state (n,); None where it divides by nothing that depends on the state.

    Also None where the function cannot be traced, which its own gate tells.
    """
    try:
        values = core_trace(function, [example], "a function of states", UntraceableError)
    except LyapnetError:
        return None
    moving, denominators = set[Node](), list[Node]()
    for node in values.graph.nodes:
        if node.op == "placeholder" or moving.intersection(node.all_input_nodes):
            moving.add(node)
        divisor = _divisor(node)
        if divisor in moving and divisor not in denominators:
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
    """What an operation divides by, if it is one of a state's numbers."""
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
