"""Traced functions as machine code, kept on disk from run to run (torch.export and AOTInductor)."""

import copy
import hashlib
import logging
import os
import platform
import stat
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.fx import GraphModule

from lyapnet.errors import CompilationError, LyapnetError, one_line
from lyapnet.files import digest_of_file, write_atomically


class Scan(nn.Module):
    """(*state, *columns, x₀) ↦ what step(*state, *columns at n, x_n, *prepare(*state)) keeps at each step, over time.

    Args:
        prepare: what all steps share.
        step: returns the next x and, after it, what is kept, and at last what is summed over the steps.
        tensors: number of tensors in `state`.
        sums: number of results that are summed.
    """

    def __init__(
        self,
        prepare: Callable[..., Sequence[Tensor]],
        step: Callable[..., Sequence[Tensor]],
        tensors: int,
        sums: int = 0,
    ):
        super().__init__()
        self.prepare, self.step, self.tensors, self.sums = prepare, step, tensors, sums

    def loop(self, *arguments: Tensor) -> list[Tensor]:
        """The scan as a loop, for a step of any kind."""
        state, (*columns, x) = arguments[: self.tensors], arguments[self.tensors :]
        shared, kept = self.prepare(*state), []
        for now in zip(*columns, strict=True):
            x, *node = self.step(*state, *now, x, *shared)
            kept.append(node)
        columns = [torch.stack(column) for column in zip(*kept, strict=True)]
        first = len(columns) - self.sums
        return [*columns[:first], *(column.sum(0) for column in columns[first:])]

    def forward(self, *arguments: Tensor) -> list[Tensor]:
        """The scan as one operation, for the compiler."""
        from torch._higher_order_ops.scan import scan

        state, (*columns, x0) = arguments[: self.tensors], arguments[self.tensors :]
        shared = self.prepare(*state)

        def body(x: Tensor, now: tuple[Tensor, ...]) -> tuple[Tensor, tuple[Tensor, ...]]:
            following, *kept = self.step(*state, *now, x, *shared)
            return following, tuple(kept)

        return list(scan(body, x0, tuple(columns))[1])


def compiled(module: nn.Module, arguments: Sequence[Tensor]) -> Callable[..., Sequence[Tensor]]:
    """The function of a traced module for arguments like these, from disk, or compiled now.

    What is on disk is run only where nobody else can have written it, and where its digest holds.

    Raises:
        CompilationError: there is no C++ compiler; or the cache is not the user's own.
        Exception: of torch or the compiler, of any kind.
    """
    from torch._inductor import aoti_compile_and_package, aoti_load_package

    path = file_of(module, arguments)
    digest = path.with_suffix(".sha256")
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    require_own(path.parent)
    if path.is_file():
        try:
            require_own(path)
            if digest.read_text(encoding="ascii") == digest_of_file(path):
                return aoti_load_package(str(path))
            reason = "another digest than what was compiled"
        except Exception as error:  # of any kind: a file that was cut short or exchanged
            reason = one_line(error)[:200]
        logging.getLogger(__name__).warning("note: compiling again what is in %s: got %s.", path, reason)
        path.unlink(missing_ok=True)
    if not has_compiler():
        raise CompilationError("Expected a C++ compiler ($CXX, g++ or clang++), got none")
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".new_") as draft, torch.no_grad():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch's, about itself
            program = torch.export.export(one_number_at_a_time(module), tuple(arguments))
            package = aoti_compile_and_package(program, package_path=f"{draft}/function.pt2")
        Path(package).chmod(0o600)
        write_atomically(digest, digest_of_file(Path(package)).encode())
        Path(package).replace(path)
    return aoti_load_package(str(path))


def one_number_at_a_time(module: nn.Module) -> nn.Module:
    """A copy with torch.where for g[2, 0] = 1, which the compiler refuses for a single number."""
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


def require_own(path: Path) -> None:
    """Refuse a folder or file of machine code that another user owns or may write."""
    if sys.platform == "win32":  # its access rights are not in these bits
        return
    facts = path.stat()
    if facts.st_uid != os.getuid() or facts.st_mode & 0o022:
        raise CompilationError(
            f"Expected machine code that only you can write, got {str(path)!r} with {stat.filemode(facts.st_mode)} of "
            f"user {facts.st_uid}; run chmod go-w on it, or choose another folder with LYAPNET_CACHE"
        )


@contextmanager
def compilation_errors() -> Iterator[None]:
    """Turn whatever compiling raises into a CompilationError; what lyapnet itself says stays as it is."""
    try:
        yield
    except LyapnetError:
        raise
    except Exception as error:
        line = one_line(error)[:200]
        raise CompilationError(f"Expected a closed loop to compile, got {type(error).__name__}: {line}") from error


def has_compiler() -> bool:
    """Whether there is a C++ compiler: $CXX, g++ or clang++."""
    from torch._inductor.cpp_builder import get_cpp_compiler
    from torch._inductor.exc import InvalidCxxCompiler

    try:
        get_cpp_compiler()
    except (InvalidCxxCompiler, OSError):
        return False
    return True


def cache_folder() -> Path:
    """Where compiled functions are kept: $LYAPNET_CACHE, else lyapnet in the user's cache folder."""
    chosen = os.environ.get("LYAPNET_CACHE")
    return Path(chosen) if chosen else Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "lyapnet"


def constants_of(graph: GraphModule) -> list[tuple[str, Any]]:
    """Name and entries of every tensor that a graph holds."""
    constants = {**vars(graph), **dict(graph.named_buffers())}
    return [(key, value.tolist()) for key, value in sorted(constants.items()) if isinstance(value, Tensor)]


def file_of(module: nn.Module, arguments: Sequence[Tensor]) -> Path:
    """Where machine code is kept: one file for each function, shapes of arguments, machine and torch."""
    parts = [
        torch.__version__, platform.machine(), _processors(arguments), torch.get_num_threads(), type(module).__name__,
        *((tuple(a.shape), a.stride(), a.dtype, a.device.type) for a in arguments),
    ]  # fmt: skip
    for graph in module.modules():
        if isinstance(graph, GraphModule):
            parts += [graph.code, *constants_of(graph)]
    return cache_folder() / f"{hashlib.sha256(repr(parts).encode()).hexdigest()[:32]}.pt2"


def _processors(arguments: Sequence[Tensor]) -> list[Any]:
    """What machine code is written for: the instructions of the CPU, and of each GPU that holds an argument."""
    devices = {argument.device for argument in arguments if argument.device.type == "cuda"}
    return [sorted(torch.cpu.get_capabilities().items()), *map(torch.cuda.get_device_capability, devices)]
