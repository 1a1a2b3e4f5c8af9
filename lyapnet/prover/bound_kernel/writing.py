"""Translates a graph into a program of bounds, node by node.

Graphs with an operator that has no rule here are bounded by the interpreter of lyapnet.prover.bounds.
"""

import operator
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.fx.node import map_arg
from torch.utils._pytree import tree_map_only

from lyapnet.prover.bound_kernel import branch_rules, minima, rules
from lyapnet.prover.bound_kernel.program import Forms, Program
from lyapnet.prover.bound_kernel.rules import as_forms
from lyapnet.prover.bound_rules import ARRANGEMENTS, OF_SHAPE

aten = torch.ops.aten
RULES = {**rules.RULES, **branch_rules.RULES, **minima.RULES}


def write_graph(program: Program, nodes: Sequence[Any], constants: dict[Any, Any]) -> list[Forms]:
    """Write the operations of a graph into a program; returns the results of the graph.

    Raises:
        NotImplementedError: an operation has no rule, or its rule does not cover the arguments.
    """
    inputs = iter([Forms(torch.tensor(program.inputs[0])), Forms(torch.tensor(program.inputs[1:]))])
    values = dict(constants)
    for node in nodes:
        if node.op == "placeholder":
            values[node] = next(inputs)
        elif node.op == "output":
            return [as_forms(program, y) for y in map_arg(node.args[0], values.__getitem__)]
        elif node not in values:
            arguments, keywords = map_arg((node.args, node.kwargs), values.__getitem__)
            values[node] = _result(program, node, values, arguments, keywords)
    raise AssertionError("a graph ends with its output")


def _result(program: Program, node: Any, values: dict[Any, Any], arguments: Any, keywords: Any) -> Any:
    if not any(isinstance(values[source], Forms | list) for source in node.all_input_nodes):
        return node.target(*arguments, **keywords)
    if node.target in OF_SHAPE:
        x, *others = arguments
        return node.target(torch.zeros(x.shape, dtype=torch.float64), *others, **keywords).to(node.meta["val"].dtype)
    if node.target in RULES:
        return RULES[node.target](program, *arguments, **keywords)
    if node.target in ARRANGEMENTS:
        return _arrange(program, node.target, *arguments, **keywords)
    raise NotImplementedError(node.target)


def _arrange(program: Program, target: Any, *arguments: Any, **keywords: Any) -> Any:
    """Apply an operator that arranges entries to the indices of forms; constants become forms first."""
    if target is operator.getitem:
        return target(*arguments)
    if target in (aten.cat.default, aten.stack.default):
        arguments = ([as_forms(program, item) for item in arguments[0]], *arguments[1:])
    target = {aten.view.default: aten.reshape.default, aten._unsafe_view.default: aten.reshape.default}.get(
        target, target
    )
    arguments, keywords = tree_map_only(Forms, lambda y: y.entries, (arguments, keywords))
    return tree_map_only(Tensor, Forms, target(*arguments, **keywords))
