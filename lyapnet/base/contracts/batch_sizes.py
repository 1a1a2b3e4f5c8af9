"""Functions of states, held against batches of every size: traced once, for a size that has no value.

Code that asks for the size (len(x), x.shape[0] > 300, a loop over the batch) makes torch decide on a value, and that is
noticed where it happens. What is left is a graph whose operators are held against the same on each state alone, one by
one: torch's operators know no size at which they begin to mix states.
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

HINT = 67  # states of the batch in torch's books: no other axis has so many
FEW = 101  # states on which an operator is held against …
ALONE = (0, 3, 100)  # … each of these alone
ALIKE = 1e-9  # relative: sums of the same numbers in another order
REMEDY = (
    "use x[..., i], x.shape[:-1] for the shape of a result alone, sums over the last axis, and no number of states or "
    "of axes"
)


def check_batch_sizes(
    name: str, function: Callable[..., tuple[Tensor, ...]], arguments: Sequence[Tensor]
) -> str | None:
    """Refuse a function of states whose results depend on the size of the batch, or on its other states.

    Args:
        name: as messages say it.
        function: of tensors (b, …) in float64, with tensors (b, …) as results.
        arguments: whose shapes count, but for b.

    Returns:
        Why the function has no such trace, where torch has a reason of its own; None where it was held.

    Raises:
        UsageError: it does; names the line.
    """
    sizes = _Sizes()
    try:
        graph_module = _traced(function, arguments, sizes)
    except UsageError:
        raise
    except Exception as error:  # of any kind: the function is the user's
        if OF_SIZES.search(str(error)):
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
    mixing = _mixing(graph_module.graph)
    if mixing:
        first = next((node for node in mixing if sizes.lines.get(node.name)), mixing[0])
        raise UsageError(
            f"Expected {name} to be a function of each state by itself, got {_name(first)} over the states of a batch "
            f"or of their number{place_of(sizes.lines.get(first.name))}; {REMEDY}."
        )
    return None


OF_SIZES = re.compile(r"\bSym(Int|Bool|Float)\b|'s\d+'")  # what Python says of a size where it takes no such thing


class _Sizes(ShapeEnv):
    """Sizes without values, the places where code asked for one, and the lines that its operators come from."""

    def __init__(self):
        super().__init__()
        self.asked = list[str]()
        self.lines = dict[str, FrameSummary | None]()

    def evaluate_expr(self, *arguments: Any, **options: Any) -> Any:
        decided = len(self.guards)
        result = super().evaluate_expr(*arguments, **options)
        frame, by_python = sys._getframe(1), False
        while frame.f_back is not None and not frame.f_code.co_filename.endswith(BOOKS):  # what checks types in tests
            frame = frame.f_back
        while frame.f_back is not None and frame.f_code.co_filename.endswith(BOOKS):
            by_python |= frame.f_code.co_filename.endswith(BOOKS[0])
            frame = frame.f_back
        # torch's operators ask too, and need no answer: they know what is true of all sizes beyond 1
        if len(self.guards) > decided or (by_python and is_own_file(frame.f_code.co_filename)):
            self.asked.append(place_of(running_line(frame)))
        return result


# files of torch that keep the books of sizes; the first one is what Python's int() and bool() of a size run
BOOKS = ("torch/__init__.py", "symbolic_shapes.py", "sym_node.py", "recording.py")


class _Lines(TorchFunctionMode):
    """Note which line of the user's own each operator comes from, and where one asks how many axes a tensor has."""

    def __init__(self, sizes: _Sizes):
        super().__init__()
        self.sizes = sizes

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        caller = sys._getframe(1)
        if func in DIMENSIONS and is_own_file(caller.f_code.co_filename):
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


DIMENSIONS = (Tensor.dim, Tensor.ndim.__get__, Tensor.ndimension)  # pyright: ignore[reportAttributeAccessIssue]


def _traced(function: Callable[..., tuple[Tensor, ...]], arguments: Sequence[Tensor], sizes: _Sizes) -> GraphModule:
    """The operators of a function of batches, whose first axes have a size without a value."""
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
    traced = make_fx(  # of a function of its own: make_fx would count self
        lambda *each: function(*each),
        tracing_mode="fake", _allow_non_fake_inputs=True, _disable_torch_fn_metadata_mode=True,
    )  # fmt: skip
    with torch.no_grad(), _Lines(sizes), _no_log():
        graph_module = traced(*batches)
    graph_module.graph.eliminate_dead_code()
    return graph_module


@contextmanager
def _no_log() -> Iterator[None]:
    """Keep torch from writing the stack of what an operator refuses on the terminal: it is raised as well."""
    log = logging.getLogger("torch._subclasses.fake_tensor")
    before, log.disabled = log.disabled, True
    try:
        yield
    finally:
        log.disabled = before


def _mixing(graph: Graph) -> list[Node]:
    """The operators whose results are not those of the same operator on each state alone."""
    inner = set[Node]()  # in whose flattened axes, of k·b entries, the states of the batch change fastest
    return [node for node in graph.nodes if node.op == "call_function" and _mixes(node, inner)]


def _mixes(node: Node, inner: set[Node]) -> bool:
    """Whether an operator mixes states; one that does not is counted among `inner` if its result is of that kind."""
    name = _name(node)
    tags = getattr(node.target, "tags", ())
    if name in ("sym_size", "sym_numel") or "empty" in name or torch.Tag.nondeterministic_seeded in tags:
        return False  # random numbers and memory that nothing was written to are refused elsewhere
    inputs = [value for source in node.all_input_nodes for value in tree_leaves(source.meta.get("val"))]
    outputs = [value for value in tree_leaves(node.meta.get("val")) if value is not None]
    if any(_axis(value) is MANY for value in (*inputs, *outputs)):
        return True
    if not outputs or not any(_depends(value) for value in (*inputs, *outputs)):
        return False
    if isinstance(outputs[0], SymInt):
        return False  # held where it is used
    if any(
        not _depends(value) and value.numel() for value in outputs
    ):  # what is no batch any more, or reads no more than a dtype
        # autograd's seed is one beside a sum over the batch, of which it takes the shape
        return not name.startswith(SHAPED) and not all(_name(user).endswith("_like") for user in node.users)
    flat = [source for source in node.all_input_nodes if _flat(tree_leaves(source.meta.get("val")))]
    pointwise = torch.Tag.pointwise in tags
    if name == "getitem" or (pointwise and not any(isinstance(value, SymInt) for value in inputs)):
        if flat and flat[0] in inner:
            inner.add(node)
        return len({source in inner for source in flat}) > 1
    for fastest in (False, True) if _flat(outputs) else (False,):
        if any(_each_alone(node, inner, fastest, draw) for draw in (_any_numbers, _positive_definite)):
            inner.update([node] * fastest)
            return False
    return True


def _flat(values: Sequence[Any]) -> bool:
    """Whether the axis of the batch is flattened with another one."""
    found = [_axis(value) for value in values]
    return any(axis not in (None, MANY) and axis[1] > 1 for axis in found)


SHAPED = ("new_", "zeros", "ones", "full")  # how constants begin


def _name(node: Node) -> str:
    """Its operator's, without the overload."""
    return getattr(node.target, "__name__", "").split(".")[0]


MANY = object()  # where a size has more than one place in a shape, or is computed with


def _axis(value: Any) -> Any:
    """(axis, states' share of it) of a batch's tensor; None where it has none; MANY where there is no such axis."""
    if isinstance(value, SymInt):
        return (0, _share(value)) if _depends(value) and _share(value) else MANY if _depends(value) else None
    if not isinstance(value, Tensor):
        return None if value is None or isinstance(value, int | float | bool) else MANY
    found = [(axis, _share(size)) for axis, size in enumerate(value.shape) if isinstance(size, SymInt)]
    if not found:
        return None
    return found[0] if len(found) == 1 and found[0][1] else MANY


def _depends(value: Any) -> bool:
    if isinstance(value, SymInt):
        return True
    return isinstance(value, Tensor) and any(isinstance(size, SymInt) for size in value.shape)


def _share(size: Any) -> int:
    """k of a size k·b; 0 where it is another function of b, or of values: the number of those that a mask takes."""
    expression = size.node.expr
    (symbol, *others) = expression.free_symbols
    share = expression / symbol
    return int(share) if not others and not symbol.name.startswith("u") and share.is_Integer and share > 0 else 0


def _each_alone(
    node: Node, inner: set[Node], fastest: bool, draw: Callable[[list[int], torch.Generator], Tensor]
) -> bool:
    """Whether an operator gives on a few states what it gives on each of them alone, from numbers at random."""
    generator = torch.Generator().manual_seed(0)
    together, alone = dict[Node, Any](), [dict[Node, Any]() for _ in ALONE]
    for source in node.all_input_nodes:
        value = source.meta["val"]
        if isinstance(value, SymInt):
            together[source], parts = FEW * _share(value), [_share(value)] * len(ALONE)
        else:
            together[source] = _numbers(value, draw, generator)
            parts = _states_of(together[source], value, source in inner)
        for each, part in zip(alone, parts, strict=True):
            each[source] = part
    try:
        whole, parts = _run(node, together), [_run(node, each) for each in alone]
    except Exception:  # of any kind: an operator that these numbers do not suit
        return False
    return all(
        piece.shape == part.shape and torch.allclose(piece, part.to(piece), ALIKE, ALIKE, equal_nan=True)
        for k, (result, value) in enumerate(zip(whole, tree_leaves(node.meta["val"]), strict=True))
        for piece, part in zip(_states_of(result, value, fastest), (each[k] for each in parts), strict=True)
    )


def _run(node: Node, values: dict[Node, Any]) -> list[Tensor]:
    # copies: an operator may write to what it is given
    given = {key: value.clone() if isinstance(value, Tensor) else value for key, value in values.items()}
    arguments, keywords = (map_arg(each, given.__getitem__) for each in (node.args, node.kwargs))
    return tree_leaves(node.target(*arguments, **keywords))  # pyright: ignore


def _numbers(value: Tensor, draw: Callable[[list[int], torch.Generator], Tensor], generator: torch.Generator) -> Tensor:
    """A tensor of the shape and kind of a batch of a few states."""
    shape = [FEW * _share(size) if isinstance(size, SymInt) else int(size) for size in value.shape]
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
    """The part of each of a few states in a tensor, whose axis they may share with another one."""
    axis = _axis(recorded)
    if axis is None:
        return [tensor] * len(ALONE)
    axis, share = axis
    if fastest:
        return [tensor.unflatten(axis, (share, FEW)).select(axis + 1, i) for i in ALONE]
    return [tensor.unflatten(axis, (FEW, share)).select(axis, i) for i in ALONE]
