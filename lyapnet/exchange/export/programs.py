"""The law as one graph (t, x[, p]) ↦ (u, V): an ONNX model, a program of torch.export, or a CasADi function."""

import copy
import importlib
import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.fx import GraphModule, Node

from lyapnet.base.errors import ExportError, LyapnetError, OracleError, one_line
from lyapnet.exchange.export.law import Law
from lyapnet.exchange.export.verification import Evaluate
from lyapnet.graphs.tracing import name_of

RESULTS = ["u", "V"]
aten = torch.ops.aten
FILLED = ("full", "full_like", "new_full")
WITH_TENSORS = {  # operator ↦ the one that takes tensors instead of numbers
    **{
        getattr(operator, kind): operator.Tensor
        for operator in (aten.add, aten.sub, aten.mul, aten.div, aten.remainder)
        for kind in ("Tensor", "Scalar")
    },
    aten.clamp.default: aten.clamp.Tensor,
}
SIMPLER: dict[Any, Any] = {aten.tan.default: lambda v: v.sin() / v.cos()}  # onnxruntime has no tan of float64
ABOUT = "lyapnet.json"  # the file of facts in a program of torch.export


def program_of(law: Law) -> torch.export.ExportedProgram:
    """The law as a program of torch.export.

    Raises:
        ExportError: torch.export does not support one of its operations.
    """
    with _quiet("torch.export does not take"), torch.no_grad():
        graph = _one_number_at_a_time(_with_exact_numbers(law.both, law.arguments["x"].dtype))
        return torch.export.export(graph, tuple(law.arguments.values()))


@contextmanager
def _quiet(what: str) -> Iterator[None]:
    """A context without torch's log and warnings, in which its exceptions become an ExportError of one line."""
    log = logging.getLogger("torch")
    level = log.level
    log.setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except LyapnetError:
        raise
    except Exception as error:  # torch and onnx raise many kinds
        line = one_line(error)[:200]
        raise ExportError(
            f"Expected a law without operations that {what}, got {type(error).__name__}: {line}; choose another --to."
        ) from error
    finally:
        log.setLevel(level)


def _with_exact_numbers(graph: GraphModule, dtype: torch.dtype) -> GraphModule:
    """A copy with tensors instead of the numbers in its arithmetic, which ONNX would round to float32."""
    graph = copy.deepcopy(graph)
    for node in [node for node in graph.graph.nodes if node.op == "call_function"]:
        if node.target is aten.slice_scatter.default:
            _end_within(node)
        value = node.meta.get("val")
        if not isinstance(value, torch.Tensor) or not value.is_floating_point():
            continue
        if name_of(node.target) in FILLED:
            filled = _constant_before(node, graph, torch.full(value.shape, float(node.args[1]), dtype=value.dtype))
            node.replace_all_uses_with(filled)
            graph.graph.erase_node(node)
        elif node.target in WITH_TENSORS and not node.kwargs:
            for place, number in enumerate(node.args):
                if isinstance(number, int | float):
                    node.update_arg(place, _constant_before(node, graph, torch.tensor(number, dtype=dtype), place))
            node.target = WITH_TENSORS[node.target]
    graph.recompile()
    return graph


def _end_within(node: Node) -> None:
    """Replace a missing end of a slice_scatter by the size of its axis, since torch.vmap overflows at its default."""
    given: dict[str, Any] = dict(zip(("whole", "part", "axis", "start", "end"), node.args, strict=False))
    if given.get("end") is not None:
        node.update_arg(4, min(given["end"], given["whole"].meta["val"].shape[given["axis"]]))


def _constant_before(node: Node, graph: GraphModule, value: torch.Tensor, place: int = 0) -> Node:
    name = f"number_{node.name}_{place}"
    graph.register_buffer(name, value)
    with graph.graph.inserting_before(node):
        constant = graph.graph.get_attr(name)
    constant.meta["val"] = value
    return constant


def write_torch(program: torch.export.ExportedProgram, path: Path, about: dict[str, Any]) -> None:
    """Write a file for `torch.export.load`, with the facts in its extra file ABOUT."""
    torch.export.save(program, path, extra_files={ABOUT: json.dumps(about)})


def run_torch(path: Path, law: Law) -> Evaluate:
    """The results of a saved program for many states."""
    module, like = torch.export.load(path).module(), law.arguments["x"]

    def evaluate(t: NDArray, x: NDArray) -> tuple[NDArray, NDArray]:
        with torch.no_grad():
            u, V = torch.vmap(module)(*law.given(*(torch.as_tensor(part).to(like) for part in (t, x))))
        return u.cpu().numpy(), V.cpu().numpy()

    return evaluate


def onnx_model_of(law: Law) -> Any:
    """The law as an ONNX model, with inputs t, x and, of a family, p.

    Raises:
        ExportError: onnx, onnxscript or onnxruntime is missing; or an operation has no counterpart in ONNX.
    """
    try:
        for name in ("onnx", "onnxscript", "onnxruntime"):
            importlib.import_module(name)
    except ImportError as error:
        raise ExportError(
            f"Expected onnx, onnxscript and onnxruntime, got {error}; pip install 'lyapnet[onnx]'."
        ) from error
    with _quiet("ONNX does not have"):
        program = program_of(law).run_decompositions(SIMPLER)
        return torch.onnx.export(
            program, dynamo=True, input_names=[*law.arguments], output_names=RESULTS, verbose=False
        )


def write_onnx(model: Any, path: Path, about: dict[str, Any]) -> None:
    """Write a model's file, with the facts in its metadata."""
    model.model.metadata_props.update({key: str(value) for key, value in about.items()})
    model.save(path)


def run_onnx(path: Path, law: Law) -> Evaluate:
    """The results of a model in onnxruntime, which runs one state after another.

    Raises:
        ExportError: onnxruntime lacks an operation in this precision.
    """
    import onnxruntime  # pyright: ignore[reportMissingImports]
    from onnxruntime.capi.onnxruntime_pybind11_state import NotImplemented as Lacking

    kind = law.arguments["x"].cpu().numpy().dtype
    try:
        session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    except Lacking as error:
        missing = str(error).split("implementation for ")[-1]
        raise ExportError(
            f"Expected operations that onnxruntime {onnxruntime.__version__} has in {kind}, got {missing}; write it "
            "with --to c or --to torch, or with other functions in f, g and the cost."
        ) from error

    def answer(t: float, state: NDArray) -> Any:
        arguments = (np.asarray(argument, kind) for argument in law.given(t, state))
        return session.run(RESULTS, dict(zip(law.arguments, arguments, strict=True)))

    def evaluate(t: NDArray, x: NDArray) -> tuple[NDArray, NDArray]:
        u, V = zip(*map(answer, t, x), strict=True)
        return np.stack(u), np.stack(V)

    return evaluate


def casadi_function_of(law: Law) -> Any:
    """The law as a CasADi function (t, x[, p]) ↦ (u, V, V_x), where V_x is CasADi's derivative of V.

    Raises:
        ExportError: CasADi is missing, or an operation has no counterpart in it.
    """
    try:
        import casadi

        from lyapnet.graphs.casadi_functions import casadi_function
    except ImportError as error:
        raise ExportError(f"Expected CasADi, got {error}; pip install 'lyapnet[oracle]'.") from error
    try:
        translated = casadi_function(law.both, list(law.arguments.values()))
    except OracleError as error:
        raise ExportError(str(error)) from error
    arguments = [casadi.SX.sym(name, argument.numel()) for name, argument in law.arguments.items()]
    u, V = translated.call(arguments)
    gradient = casadi.gradient(V, arguments[1])
    return casadi.Function("law", arguments, [u, V, gradient], [*law.arguments], [*RESULTS, "V_x"])


def write_casadi(function: Any, path: Path, about: dict[str, Any]) -> None:
    """Write a file for `casadi.Function.load`; this format has no place for facts."""
    function.save(str(path))


def run_casadi(path: Path, law: Law) -> Evaluate:
    """The results of a saved CasADi function for many states."""
    import casadi

    function = casadi.Function.load(str(path))

    def evaluate(t: NDArray, x: NDArray) -> tuple[NDArray, NDArray]:
        u, V, _ = function.map(len(t)).call([np.atleast_2d(part.T) for part in law.given(t, x)])
        return np.asarray(u).T, np.asarray(V).ravel()

    return evaluate


def _one_number_at_a_time(module: nn.Module) -> nn.Module:
    """A copy with torch.where for assignments such as g[2, 0] = 1, which the compiler refuses for single numbers."""
    module, aten = copy.deepcopy(module), torch.ops.aten
    for graph_module in (each for each in module.modules() if isinstance(each, GraphModule)):
        graph = graph_module.graph
        for node in graph.find_nodes(op="call_function", target=aten.select_scatter.default):
            into, number, _, index = node.args
            row = into.meta["val"]
            if row.ndim == 1:
                with graph.inserting_before(node):
                    places = graph.call_function(aten.arange.default, (len(row),), {"device": row.device})
                    chosen = graph.call_function(aten.eq.Scalar, (places, index % len(row)))
                    node.replace_all_uses_with(graph.call_function(aten.where.self, (chosen, number, into)))
                graph.erase_node(node)
        graph_module.recompile()
    return module
