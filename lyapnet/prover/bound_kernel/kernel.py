"""Bounds of one function on many boxes by machine code: compiled C++ that runs a program on Taylor forms."""

import ctypes
import logging
import multiprocessing
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lyapnet.base.errors import CompilationError
from lyapnet.base.types import Corners
from lyapnet.graphs.compilation import library_of
from lyapnet.prover.bound_kernel.program import Entry, Program, Support
from lyapnet.prover.bound_kernel.writing import write_graph
from lyapnet.prover.taylor import TaylorForm

SOURCES = tuple(Path(__file__).with_name(name) for name in ("functions.h", "forms.h", "program.cpp"))
MOST_AXES = 16  # the same constant as in forms.h


class BoundKernel:
    """Machine code for the results of a graph, on boxes with the same wide axes or on forms with the same supports.

    Args:
        nodes, constants: the nodes of the graph, and the values of those that do not depend on the point.
        inputs, dimension, degree: those of Program.

    Raises:
        NotImplementedError: an operation has no rule for machine code.
        CompilationError: the C++ code cannot be compiled.
    """

    def __init__(
        self, nodes: Sequence[Any], constants: dict[Any, Any], inputs: Sequence[Support], dimension: int, degree: int
    ):
        if dimension > MOST_AXES:
            raise NotImplementedError(f"more than {MOST_AXES} axes")
        program = Program(inputs, dimension, degree)
        results = write_graph(program, nodes, constants)
        self._program = program.assembled([Entry(k) for y in results for k in y.entries.flatten().tolist()])
        self._shapes = [y.shape for y in results]
        self._terms, self._dimension = len(program.monomials), program.dimension

    def forms(self, lower: Corners, upper: Corners) -> list[TaylorForm]:
        """The results on boxes (boxes, 1 + n), as forms."""
        return self._run(len(lower), lower.contiguous(), upper.contiguous())

    def image(self, given: TaylorForm) -> list[TaylorForm]:
        """The results for all inputs in a form of shape (inputs,); its terms outside the supports must be 0."""
        parts = torch.cat([given.terms.movedim(0, -1), given.radius[..., None]], -1)
        return self._run(len(parts), parts.contiguous(), None)

    def _run(self, boxes: int, lower: Tensor, upper: Tensor | None) -> list[TaylorForm]:
        program = self._program
        sizes = [shape.numel() for shape in self._shapes]
        results = torch.zeros(sum(sizes), self._terms + 1, boxes, dtype=torch.float64)
        failed = library().lyapnet_bound(
            *(_address(part) for part in (program.tables, program.code, program.numbers)),
            *(ctypes.c_void_p(side.data_ptr() if side is not None else None) for side in (lower, upper)),
            *map(ctypes.c_long, (boxes, program.arena, program.spare)), ctypes.c_void_p(results.data_ptr()),
        )  # fmt: skip
        if failed:
            raise MemoryError("Expected memory for a block of boxes, got none.")
        forms = []
        for part, shape in zip(results.split(sizes), self._shapes, strict=True):
            every = part.permute(1, 2, 0).reshape(self._terms + 1, boxes, *shape)
            forms.append(TaylorForm(every[:-1], every[-1], self._dimension))
        return forms


def kernel_of(
    nodes: Sequence[Any], constants: dict[Any, Any], inputs: Sequence[Support], dimension: int, degree: int
) -> BoundKernel | None:
    """The kernel, or None if an operation has no rule for machine code or the C++ code cannot be compiled."""
    try:
        return BoundKernel(nodes, constants, inputs, dimension, degree) if has_library() else None
    except NotImplementedError:
        return None


@cache
def has_library() -> bool:
    """Whether the C++ code can be compiled; if not, a note in the log says why."""
    try:
        library()
    except CompilationError as error:
        if multiprocessing.parent_process() is None:
            logging.getLogger(__name__).warning("note: %s; bounds go on without machine code.", error)
        return False
    return True


@cache
def library() -> ctypes.CDLL:
    """The compiled C++ code of bounds.

    Raises:
        CompilationError: it cannot be compiled; see library_of.
    """
    return library_of("bounds", SOURCES)


def elementary(which: int, points: Tensor) -> Tensor:
    """eˣ (which = 0), eˣ − 1 (1) or log(1 + x) (2) at points, as the C++ code computes them; for tests."""
    values = points.double().clone()
    library().lyapnet_elementary(which, ctypes.c_void_p(values.data_ptr()), ctypes.c_long(values.numel()))
    return values


def _address(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)
