"""Checks that functions of states do not depend on the batch size, by a trace with a symbolic size.

Code that uses the size (len(x), x.shape[0] > 300, a loop over the batch) forces torch to choose a value, which is
detected with its line. The remaining graph is checked operator by operator: on a batch each has to give the same as on
each state alone. This covers all sizes, because torch's operators do not change their behaviour with the size.
"""

import logging
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from traceback import FrameSummary
from typing import Any

import torch
from torch import SymInt, Tensor
from torch._dynamo.source import ConstantSource
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.fx import Graph, GraphModule, Node
from torch.fx.experimental.proxy_tensor import get_proxy_mode, make_fx
from torch.fx.experimental.symbolic_shapes import DimDynamic, ShapeEnv, StatelessSymbolicContext
from torch.fx.node import map_arg
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves

from lyapnet.base.errors import UsageError, is_own_file, one_line, own_line, place_of, running_line
from lyapnet.base.operators import MINIMA, as_operators

HINT = 67  # batch size that torch uses internally, different from all other sizes
TEST_STATES = 101  # states of the batch on which each operator is tested
SINGLE_STATES = (0, 3, 100)  # its states on which the operator is also applied separately
TOLERANCE = 1e-9  # relative difference allowed for sums in another order
REMEDY = (
    "use x[..., i], x.shape[:-1] for the shape of a result alone, sums over the last axis, and no number of states or "
    "of axes"
)


def check_batch_sizes(
    name: str, function: Callable[..., tuple[Tensor, ...]], arguments: Sequence[Tensor]
) -> str | None:
    """Check that the results of a function of states do not depend on the batch size or on other states.

    Args:
        name: name of the function in messages.
        function: tensors (b, …) in float64 ↦ tensors (b, …).
        arguments: example arguments; only their shapes without b are used.

    Returns:
        The reason why torch cannot trace the function, which is then not checked; None if it was checked.

    Raises:
        UsageError: the results depend on them; names the line.
    """
    sizes = _Sizes()
    try:
        graph_module = _traced(function, arguments, sizes)
    except UsageError:
        raise
    except Exception as error:  # the function is the user's
        if SYMBOLIC_SIZE_ERROR.search(str(error)):
            sizes.asked.append(place_of(own_line(error)))
        if not sizes.asked:
            return f"{type(error).__name__}: {one_line(error)}"
        graph_module = None
    if sizes.asked:
        raise UsageError(
            f"Expected {name} to be a function of each state by itself, got code that asks for the size of a batch"
            f"{sizes.asked[0]}; {REMEDY}."
        )
    assert graph_module is not None
    mixing = _mixing_operators(graph_module.graph)
    if mixing:
        first = next((node for node in mixing if sizes.lines.get(node.name)), mixing[0])
        raise UsageError(
            f"Expected {name} to be a function of each state by itself, got {_name(first)} over the states of a batch "
            f"or of their number{place_of(sizes.lines.get(first.name))}; {REMEDY}."
        )
    return None


SYMBOLIC_SIZE_ERROR = re.compile(
    r"\bSym(Int|Bool|Float)\b|'s\d+'"
)  # errors of Python functions that do not accept a symbolic size


class _Sizes(ShapeEnv):
    """Symbolic sizes; records where code asked for their values, and the line of each operator."""

    def __init__(self):
        super().__init__()
        self.asked = list[str]()
        self.lines = dict[str, FrameSummary | None]()

    def evaluate_expr(self, *arguments: Any, **options: Any) -> Any:
        decided = len(self.guards)
        result = super().evaluate_expr(*arguments, **options)
        frame, by_python = sys._getframe(1), False
        while frame.f_back is not None and not frame.f_code.co_filename.endswith(
            BOOKKEEPING_FILES
        ):  # skips type checkers in tests
            frame = frame.f_back
        while frame.f_back is not None and frame.f_code.co_filename.endswith(BOOKKEEPING_FILES):
            by_python |= frame.f_code.co_filename.endswith(BOOKKEEPING_FILES[0])
            frame = frame.f_back
        # torch's operators ask too, but only for facts that hold for all sizes above 1
        if len(self.guards) > decided or (by_python and is_own_file(frame.f_code.co_filename)):
            self.asked.append(place_of(running_line(frame)))
        return result


# torch's files for symbolic sizes; the first one implements int() and bool() of a size
BOOKKEEPING_FILES = ("torch/__init__.py", "symbolic_shapes.py", "sym_node.py", "recording.py")


class _Lines(TorchFunctionMode):
    """Records the user's line of each operator, and where the user's code asks for the number of axes."""

    def __init__(self, sizes: _Sizes):
        super().__init__()
        self.sizes = sizes

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        caller = sys._getframe(1)
        if func in DIMENSION_QUERIES and is_own_file(caller.f_code.co_filename):
            self.sizes.asked.append(place_of(running_line(caller)))
        proxies = get_proxy_mode()
        if proxies is None:
            return func(*args, **(kwargs or {}))
        last = (nodes := proxies.tracer.graph._root)._prev
        result = func(*args, **(kwargs or {}))
        node, line = nodes._prev, None
        while node is not last:
            line = line or running_line(caller)
            self.sizes.lines.setdefault(node.name, line)
            node = node._prev
        return result


DIMENSION_QUERIES = (Tensor.dim, Tensor.ndim.__get__, Tensor.ndimension)  # pyright: ignore[reportAttributeAccessIssue]


def _traced(function: Callable[..., tuple[Tensor, ...]], arguments: Sequence[Tensor], sizes: _Sizes) -> GraphModule:
    """The graph of a function of batches, traced with a symbolic size of their first axis."""
    mode = FakeTensorMode(allow_non_fake_inputs=True, shape_env=sizes)
    batches = []
    for i, argument in enumerate(arguments):
        shape = argument.shape[1:]
        context = StatelessSymbolicContext(
            dynamic_sizes=[DimDynamic.DUCK, *[DimDynamic.STATIC] * len(shape)],
            constraint_sizes=[None] * (1 + len(shape)),  # pyright: ignore[reportArgumentType]
        )
        example = torch.empty(HINT, *shape, dtype=argument.dtype)
        batches.append(mode.from_tensor(example, symbolic_context=context, source=ConstantSource(f"argument_{i}")))
    traced = make_fx(  # a lambda, because make_fx would count self as an argument
        lambda *each: function(*each),
        tracing_mode="fake", _allow_non_fake_inputs=True, _disable_torch_fn_metadata_mode=True,
    )  # fmt: skip
    with torch.no_grad(), _Lines(sizes), _without_log(), as_operators(MINIMA):
        graph_module = traced(*batches)
    graph_module.graph.eliminate_dead_code()
    return graph_module


@contextmanager
def _without_log() -> Iterator[None]:
    """Suppress torch's log of errors in operators, which are also raised."""
    log = logging.getLogger("torch._subclasses.fake_tensor")
    before, log.disabled = log.disabled, True
    try:
        yield
    finally:
        log.disabled = before


def _mixing_operators(graph: Graph) -> list[Node]:
    """The operators whose results on a batch differ from those on each state alone."""
    inner = set[Node]()  # nodes with a flattened axis of k·b entries in which the batch index varies fastest
    return [node for node in graph.nodes if node.op == "call_function" and _mixes(node, inner)]


def _mixes(node: Node, inner: set[Node]) -> bool:
    """Whether an operator mixes states; updates `inner` by its result."""
    name = _name(node)
    tags = getattr(node.target, "tags", ())
    if name in ("sym_size", "sym_numel") or "empty" in name or torch.Tag.nondeterministic_seeded in tags:
        return False  # random numbers and uninitialised memory are refused elsewhere
    inputs = [value for source in node.all_input_nodes for value in tree_leaves(source.meta.get("val"))]
    outputs = [value for value in tree_leaves(node.meta.get("val")) if value is not None]
    if any(_axis(value) is NO_BATCH_AXIS for value in (*inputs, *outputs)):
        return True
    if not outputs or not any(_depends(value) for value in (*inputs, *outputs)):
        return False
    if isinstance(outputs[0], SymInt):
        return False  # checked where it is used
    if any(
        not _depends(value) and value.numel() for value in outputs
    ):  # no batch axis is left, or only a dtype is read
        # autograd's seed `ones_like` reads only the shape of a sum over the batch
        return not name.startswith(CONSTRUCTOR_PREFIXES) and not all(
            _name(user).endswith("_like") for user in node.users
        )
    flat = [source for source in node.all_input_nodes if _flat(tree_leaves(source.meta.get("val")))]
    pointwise = torch.Tag.pointwise in tags
    if name == "getitem" or (pointwise and not any(isinstance(value, SymInt) for value in inputs)):
        if flat and flat[0] in inner:
            inner.add(node)
        return len({source in inner for source in flat}) > 1
    for fastest in (False, True) if _flat(outputs) else (False,):
        if any(_acts_on_each_state(node, inner, fastest, draw) for draw in (_any_numbers, _positive_definite)):
            inner.update([node] * fastest)
            return False
    return True


def _flat(values: Sequence[Any]) -> bool:
    """Whether the batch axis is flattened together with another axis."""
    found = [_axis(value) for value in values]
    return any(axis not in (None, NO_BATCH_AXIS) and axis[1] > 1 for axis in found)


CONSTRUCTOR_PREFIXES = ("new_", "zeros", "ones", "full")  # names of operators that make constants


def _name(node: Node) -> str:
    """The name of a node's operator without the overload."""
    return getattr(node.target, "__name__", "").split(".")[0]


NO_BATCH_AXIS = object()  # result of `_axis`: the batch size occurs twice in a shape, or in a computation


def _axis(value: Any) -> Any:
    """(axis, k) of a tensor whose axis has k·b entries; None if it has no batch axis; else NO_BATCH_AXIS."""
    if isinstance(value, SymInt):
        return (0, _share(value)) if _depends(value) and _share(value) else NO_BATCH_AXIS if _depends(value) else None
    if not isinstance(value, Tensor):
        return None if value is None or isinstance(value, int | float | bool) else NO_BATCH_AXIS
    found = [(axis, _share(size)) for axis, size in enumerate(value.shape) if isinstance(size, SymInt)]
    if not found:
        return None
    return found[0] if len(found) == 1 and found[0][1] else NO_BATCH_AXIS


def _depends(value: Any) -> bool:
    if isinstance(value, SymInt):
        return True
    return isinstance(value, Tensor) and any(isinstance(size, SymInt) for size in value.shape)


def _share(size: Any) -> int:
    """k of a size k·b; 0 if the size is another function of b, or depends on values, as for a mask."""
    expression = size.node.expr
    (symbol, *others) = expression.free_symbols
    share = expression / symbol
    return int(share) if not others and not symbol.name.startswith("u") and share.is_Integer and share > 0 else 0


def _acts_on_each_state(
    node: Node, inner: set[Node], fastest: bool, draw: Callable[[list[int], torch.Generator], Tensor]
) -> bool:
    """Whether an operator gives the same on random states together and on each of them alone."""
    generator = torch.Generator().manual_seed(0)
    together, alone = dict[Node, Any](), [dict[Node, Any]() for _ in SINGLE_STATES]
    for source in node.all_input_nodes:
        value = source.meta["val"]
        if isinstance(value, SymInt):
            together[source], parts = TEST_STATES * _share(value), [_share(value)] * len(SINGLE_STATES)
        else:
            together[source] = _numbers(value, draw, generator)
            parts = _states_of(together[source], value, source in inner)
        for each, part in zip(alone, parts, strict=True):
            each[source] = part
    try:
        whole, parts = _run(node, together), [_run(node, each) for each in alone]
    except Exception:  # the operator does not accept these numbers
        return False
    return all(
        piece.shape == part.shape and torch.allclose(piece, part.to(piece), TOLERANCE, TOLERANCE, equal_nan=True)
        for k, (result, value) in enumerate(zip(whole, tree_leaves(node.meta["val"]), strict=True))
        for piece, part in zip(_states_of(result, value, fastest), (each[k] for each in parts), strict=True)
    )


def _run(node: Node, values: dict[Node, Any]) -> list[Tensor]:
    # copies, because an operator may change its arguments
    given = {key: value.clone() if isinstance(value, Tensor) else value for key, value in values.items()}
    arguments, keywords = (map_arg(each, given.__getitem__) for each in (node.args, node.kwargs))
    return tree_leaves(node.target(*arguments, **keywords))  # pyright: ignore


def _numbers(value: Tensor, draw: Callable[[list[int], torch.Generator], Tensor], generator: torch.Generator) -> Tensor:
    """A random tensor with the shape and dtype of a batch of TEST_STATES states."""
    shape = [TEST_STATES * _share(size) if isinstance(size, SymInt) else int(size) for size in value.shape]
    if value.dtype.is_floating_point or value.dtype.is_complex:
        return draw(shape, generator).to(value.dtype)
    return torch.randint(0, 2, shape, generator=generator).to(value.dtype)


def _any_numbers(shape: list[int], generator: torch.Generator) -> Tensor:
    return torch.randn(shape, generator=generator, dtype=torch.float64)


def _positive_definite(shape: list[int], generator: torch.Generator) -> Tensor:
    root = _any_numbers(shape, generator)
    square = len(shape) > 1 and shape[-1] == shape[-2]
    return root @ root.mT + torch.eye(shape[-1], dtype=root.dtype) if square else root


def _states_of(tensor: Tensor, recorded: Tensor, fastest: bool) -> list[Tensor]:
    """The parts of the SINGLE_STATES in a tensor, whose batch axis may be flattened with another one."""
    axis = _axis(recorded)
    if axis is None:
        return [tensor] * len(SINGLE_STATES)
    axis, share = axis
    if fastest:
        return [tensor.unflatten(axis, (share, TEST_STATES)).select(axis + 1, i) for i in SINGLE_STATES]
    return [tensor.unflatten(axis, (TEST_STATES, share)).select(axis, i) for i in SINGLE_STATES]
