"""ONNX files: their models, and a comparison of our results with those of onnxruntime."""

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

OPSET = 18  # the version of ONNX's operators that OPERATORS implement; older files are converted to it
CHUNK = 64  # number of states that are computed together


class OnnxModel(NamedTuple):
    """An ONNX model with all its weights, and the files from which it was read."""

    proto: Any  # the model with the operators of OPSET
    digests: dict[str, str]  # name of a file ↦ SHA-256
    written: Any  # the model as the file has it, for onnxruntime


def read_onnx(path: Path) -> OnnxModel:
    """The model of an ONNX file, with the weights in files that it names, and operators of OPSET; nothing is run.

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
    except Exception as error:  # onnx raises many kinds
        advice = "export it with torch.onnx.export, or its like"
        if path.suffix in (".pt", ".pt2", ".pth", ".ckpt"):
            advice = "reading a torch file can run code that it holds: export it with torch.onnx.export"
        raise UsageError(f"Expected an ONNX file, got {str(path)!r} ({one_line(error)[:150]}); {advice}.") from error
    return OnnxModel(_modern(model, path), digests, model)


def _tensors_of(graph: Any) -> Iterator[Any]:
    """All tensors of a graph or function whose data may be in another file: constants and attributes of nodes."""
    yield from getattr(graph, "initializer", ())  # functions have no initializer
    for attribute in (each for node in graph.node for each in node.attribute):
        yield from (attribute.t, *attribute.tensors)
        for inner in (attribute.g, *attribute.graphs):
            yield from _tensors_of(inner)


def _modern(model: Any, path: Path) -> Any:
    """The model without functions of its own, with the operators of OPSET."""
    inliner, converter = (library(f"onnx.{name}") for name in ("inliner", "version_converter"))
    try:
        model = inliner.inline_local_functions(model)
        version = max((each.version for each in model.opset_import if each.domain in DOMAIN), default=0)
        return converter.convert_version(model, OPSET) if version < OPSET else model
    except Exception as error:  # torch and onnx raise many kinds
        raise UsageError(
            f"Expected operators that can be converted to opset {OPSET} in {str(path)!r}, got "
            f"{one_line(error)[:150]}; export it for that opset."
        ) from error


def require_same(function: OnnxFunction, model: Any, states: State) -> float:
    """The largest difference of a function from onnxruntime's results, relative to the largest result.

    Args:
        function: the function, with rounding.
        model: the model that onnxruntime runs, one state at a time.

    Raises:
        UsageError: at some state onnxruntime's result lies outside of the bounds of the function; or it does not run.
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
    """The results of onnxruntime at states, one by one, with graph optimisations of some level."""
    runtime = library("onnxruntime")
    try:
        options = runtime.SessionOptions()
        options.graph_optimization_level = level
        session = runtime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
        with np.errstate(over="ignore"):  # numbers beyond float32 become infinite
            given = states.numpy().astype(INPUTS[function.kind])
        rows = [session.run(None, {function.input: x[None] if function.batched else x})[0].ravel() for x in given]
        return np.stack(rows).astype(np.float64)
    except Exception as error:  # torch and onnx raise many kinds
        raise UsageError(
            f"Expected a file that onnxruntime runs, got {function.name!r}: {one_line(error)[:200]}; export it again."
        ) from error


def bounds_at(function: OnnxFunction, states: State) -> tuple[Tensor, Tensor]:
    """(lower, upper) bounds of a function at each of some states; they differ by its rounding."""
    at = torch.cat([torch.zeros(len(states), 1, dtype=torch.float64), states], 1)
    bounded = BoundedFunction(lambda t, x: (function(x[None])[0],), (at.amin(0), at.amax(0)), degree=1)
    bounds = [bounded.bounds(some, some)[0] for some in at.split(CHUNK)]
    return torch.cat([low for low, _ in bounds]), torch.cat([high for _, high in bounds])
