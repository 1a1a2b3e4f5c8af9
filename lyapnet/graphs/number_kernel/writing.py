"""Writes traced graphs as programs on tensors, node by node.

torch runs each node once, on example arguments. A result that shares memory with an argument is a view and needs no
instruction. The program stores all results with torch's strides.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch._decomp import decomposition_table
from torch.fx import GraphModule, Node
from torch.fx.experimental.proxy_tensor import make_fx
from torch.fx.node import map_arg
from torch.utils._pytree import tree_leaves, tree_map_only

from lyapnet.graphs.number_kernel.program import Place, Program
from lyapnet.graphs.tracing import SHAPED, name_of

Number = Tensor | float


class Writer:
    """Writes graphs into one program.

    Args:
        program: receives the instructions.
        width: numbers in a row of a panel of packed columns.
        rules: operator name ↦ a function (writer, result, *arguments) that writes instructions.
    """

    def __init__(self, program: Program, width: int, rules: Mapping[str, Callable[..., None]]):
        self.program, self.width, self.rules = program, width, rules
        self._buffers = dict[int, int]()  # address of a tensor's memory ↦ buffer
        self._constants = dict[Any, int]()
        self._alive: list[Any] = []  # keeps tensors alive, so that no other tensor gets their address

    def argument(self, example: Tensor, varies: bool) -> int:
        """The buffer of an argument of numbers or booleans, with the strides of the example."""
        return self._new_buffer(example, varies, given=True)

    def write(self, graph: GraphModule, arguments: Sequence[Any]) -> list[Tensor]:
        """Write the operations of a graph; return its results for these arguments, as torch computes them.

        Raises:
            NotImplementedError: an operation has no rule, or no rule for its arguments.
        """
        values, given = dict[Node, Any](), iter(arguments)
        for node in graph.graph.nodes:
            if node.op == "placeholder":
                values[node] = next(given)
            elif node.op == "get_attr":
                values[node] = getattr(graph, node.target).detach()
            elif node.op == "output":
                self._alive.append(values)
                results = map_arg(node.args[0], values.__getitem__)
                return list(results) if isinstance(results, list | tuple) else [results]
            else:
                inputs, keywords = map_arg((node.args, node.kwargs), values.__getitem__)
                values[node] = self._result(node.target, inputs, keywords)
        raise AssertionError("a graph ends with its output")

    def _result(self, target: Any, inputs: Any, keywords: Any) -> Any:
        if target is torch.ops.aten.view.default:  # arguments are contiguous here, but perhaps not in the trace
            target = torch.ops.aten.reshape.default
        result = target(*inputs, **keywords)
        sources = [each for each in tree_leaves((inputs, keywords)) if isinstance(each, Tensor)]
        known = [each for each in sources if self.is_written(each)]
        if not known or name_of(target) in SHAPED:
            return result
        results = [each for each in tree_leaves(result) if isinstance(each, Tensor)]
        if any(self.is_written(each) and each.dtype not in {source.dtype for source in known} for each in results):
            raise NotImplementedError("the bits of numbers as another type")
        if all(self.is_written(each) or not each.numel() for each in results):
            return result
        rule = self.rules.get(name_of(target))
        if rule is None:
            return self._in_simpler_operators(target, inputs, keywords)
        for out in results:
            self._new_buffer(out, any(self.varies(each) for each in known))
        rule(self, results[0] if len(results) == 1 else results, *inputs, **keywords)
        return result

    def _in_simpler_operators(self, target: Any, inputs: Any, keywords: Any) -> Any:
        simpler = decomposition_table.get(target)
        if simpler is None:
            raise NotImplementedError(str(target))
        tensors = [each for each in tree_leaves((inputs, keywords)) if isinstance(each, Tensor)]

        def function(*replaced: Tensor) -> Any:
            by_place = iter(replaced)
            put = tree_map_only(Tensor, lambda _: next(by_place), (inputs, keywords))
            return simpler(*put[0], **put[1])

        graph = make_fx(function)(*tensors)
        results = self.write(graph, tensors)
        return results[0] if len(results) == 1 else results

    # --- For rules ---

    def is_written(self, tensor: Tensor) -> bool:
        """Whether a tensor depends on arguments, and so has a buffer; otherwise it is a constant."""
        return tensor.untyped_storage().data_ptr() in self._buffers and tensor.numel() > 0

    def varies(self, tensor: Tensor) -> bool:
        return self.program.buffers[self._buffers[tensor.untyped_storage().data_ptr()]].varies

    def place(self, value: Number, shape: Sequence[int] | None = None) -> Place:
        """The place of a tensor or a number in the program, expanded to a shape."""
        if not isinstance(value, Tensor):
            value = torch.tensor(float(value), dtype=self.program.dtype)
            buffer = self._constant(("number", float(value), math.copysign(1, value)), value)
        elif self.is_written(value):
            buffer = self._buffers[value.untyped_storage().data_ptr()]
        else:
            whole = torch.empty(0, dtype=value.dtype).set_(value.untyped_storage())
            buffer = self._constant((whole.data_ptr(), len(whole)), whole)
        repeated = value if shape is None else value.expand(tuple(shape))
        return Place(buffer, int(value.storage_offset()), repeated.stride())

    def new_tensor(self, like: Tensor) -> Tensor:
        """A tensor for an intermediate result of a rule."""
        tensor = torch.zeros(like.shape, dtype=self.program.dtype)
        self._new_buffer(tensor, self.varies(like))
        return tensor

    def elementwise(self, operation: str, out: Tensor, *inputs: Number) -> None:
        """out = operation(inputs), with the inputs expanded to the shape of out."""
        places = [self.place(each, out.shape) for each in inputs]
        self.program.elementwise(operation, out.shape, self.place(out), places)

    def _new_buffer(self, tensor: Tensor, varies: bool, given: bool = False) -> int:
        if tensor.dtype not in (self.program.dtype, torch.bool, torch.int64):
            raise NotImplementedError(f"numbers of {tensor.dtype} that depend on arguments")
        self._alive.append(tensor)
        numbers = tensor.untyped_storage().nbytes() // tensor.itemsize
        buffer = self.program.new_buffer(numbers, varies, given=given)
        self._buffers[tensor.untyped_storage().data_ptr()] = buffer
        return buffer

    def _constant(self, key: Any, whole: Tensor) -> int:
        if key not in self._constants:
            self._alive.append(whole)
            copy = whole.to(self.program.dtype).clone().contiguous()
            self._constants[key] = self.program.new_buffer(copy.numel(), False, constant=copy)
        return self._constants[key]
