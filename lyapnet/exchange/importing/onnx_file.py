"""ONNX files: what they hold, and what onnxruntime makes of it."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lyapnet.base.errors import UsageError, one_line
from lyapnet.base.files import digest_of_file, require_file
from lyapnet.base.types import State
from lyapnet.exchange.importing.onnx_function import DOMAIN, INPUTS, OnnxFunction, library
from lyapnet.prover.bounds import BoundedFunction

OPSET = 18  # whose semantics OPERATORS have; older files are converted to it
CHUNK = 64  # states that are computed together


class OnnxModel(NamedTuple):
    """An ONNX model whose weights are all in it, and the files that it was read from."""

    proto: Any
    digests: dict[str, str]  # name ↦ SHA-256
    written: Any  # the model as it is in the file, which onnxruntime runs


def read_onnx(path: Path) -> OnnxModel:
    """The model of an ONNX file, with weights beside it that it names, in the semantics of OPSET; nothing is run.

    Raises:
        UsageError: no such file, not ONNX, or onnx is missing.
    """
    onnx = library("onnx")
    try:
        require_file(path)
        model = onnx.load(str(path), load_external_data=False)
        tensors = (each for part in (model.graph, *model.functions) for each in _tensors_of(part))
        entries = [entry for each in tensors for entry in each.external_data]
        beside = sorted({entry.value for entry in entries if entry.key == "location"})
        for name in beside:
            require_file(path.parent / name)
        onnx.load_external_data_for_model(model, str(path.parent))
        onnx.checker.check_model(model)
        digests = {name: digest_of_file(path.parent / name) for name in (path.name, *beside)}
    except OSError as error:
        raise UsageError(
            f"Expected an ONNX file, got {str(path)!r} ({error.strerror or error}); export it first."
        ) from error
    except Exception as error:  # of many kinds, with nothing in common
        advice = "export it with torch.onnx.export, or its like"
        if path.suffix in (".pt", ".pt2", ".pth", ".ckpt"):
            advice = "reading a torch file can run code that it holds: export it with torch.onnx.export"
        raise UsageError(f"Expected an ONNX file, got {str(path)!r} ({one_line(error)[:150]}); {advice}.") from error
    return OnnxModel(_modern(model, path), digests, model)


def _tensors_of(graph: Any) -> Iterator[Any]:
    """All tensors of a graph or function, which may lie beside the file: constants, and what nodes hold."""
    yield from getattr(graph, "initializer", ())  # a function has none
    for attribute in (each for node in graph.node for each in node.attribute):
        yield from (attribute.t, *attribute.tensors)
        for inner in (attribute.g, *attribute.graphs):
            yield from _tensors_of(inner)


def _modern(model: Any, path: Path) -> Any:
    """A model without functions of its own, in the semantics of OPSET."""
    inliner, converter = (library(f"onnx.{name}") for name in ("inliner", "version_converter"))
    try:
        model = inliner.inline_local_functions(model)
        version = max((each.version for each in model.opset_import if each.domain in DOMAIN), default=0)
        return converter.convert_version(model, OPSET) if version < OPSET else model
    except Exception as error:  # of many kinds
        raise UsageError(
            f"Expected operators that can be converted to opset {OPSET} in {str(path)!r}, got "
            f"{one_line(error)[:150]}; export it for that opset."
        ) from error


def require_same(function: OnnxFunction, model: Any, states: State) -> float:
    """The largest difference from what onnxruntime makes of a model, state by state, relative to the largest result.

    Args:
        function: with rounding: at each state onnxruntime's result lies within its bounds.

    Raises:
        UsageError: it does not; or onnxruntime does not run it.
    """
    levels = library("onnxruntime").GraphOptimizationLevel
    others = [_computed(model, function, states, level) for level in (levels.ORT_DISABLE_ALL, levels.ORT_ENABLE_ALL)]
    with torch.no_grad():
        own = torch.cat([function(some) for some in states.split(CHUNK)]).numpy()
    if any(own.shape != other.shape for other in others):
        raise UsageError(
            f"Expected results of one shape from {function.name!r}, got another; report this with the file."
        )
    low, high = (side.numpy() for side in bounds_at(function, states))
    apart = []
    for other in others:
        finite = np.isfinite(own) & np.isfinite(other)
        largest = np.abs(other[finite]).max(initial=0.0) or 1.0
        apart.append(np.abs(np.where(finite, own, 0.0) - np.where(finite, other, 0.0)).max(initial=0.0) / largest)
        outside = ~((low <= other) & (other <= high)) & (np.isfinite(other) | np.isfinite(low))
        if bool(outside.any()):
            raise UsageError(
                f"Expected {function.name!r} to be within its rounding of what onnxruntime computes, got another "
                f"result at x = {states[int(outside.any(-1).argmax())].tolist()}; report this with the file."
            )
    return float(apart[0])


def _computed(model: Any, function: OnnxFunction, states: State, level: Any) -> np.ndarray:
    """What onnxruntime makes of states, one by one, with some of its optimisations of a graph."""
    runtime = library("onnxruntime")
    try:
        options = runtime.SessionOptions()
        options.graph_optimization_level = level
        session = runtime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
        with np.errstate(over="ignore"):  # beyond float32 all is infinite
            given = states.numpy().astype(INPUTS[function.kind])
        rows = [session.run(None, {function.input: x[None] if function.batched else x})[0].ravel() for x in given]
        return np.stack(rows).astype(np.float64)
    except Exception as error:  # of many kinds
        raise UsageError(
            f"Expected a file that onnxruntime runs, got {function.name!r}: {one_line(error)[:200]}; export it again."
        ) from error


def bounds_at(function: OnnxFunction, states: State) -> tuple[Tensor, Tensor]:
    """(lower, upper) bounds of a function at each of some states, which its rounding parts."""
    at = torch.cat([torch.zeros(len(states), 1, dtype=torch.float64), states], 1)
    bounded = BoundedFunction(lambda t, x: (function(x[None])[0],), (at.amin(0), at.amax(0)), degree=1)
    bounds = [bounded.bounds(some, some)[0] for some in at.split(CHUNK)]
    return torch.cat([low for low, _ in bounds]), torch.cat([high for _, high in bounds])
