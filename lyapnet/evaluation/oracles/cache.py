"""A disk cache of optimal controls: one small file for each task and initial state."""

import contextlib
import hashlib
import io
import os
import secrets
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.fx import GraphModule

from lyapnet.base.types import Control
from lyapnet.graphs.compilation import cache_folder, constants_of
from lyapnet.task.sets import ControlSet


class OptimaCache:
    """(task, x₀) ↦ the best controls found so far, (N, m).

    A task is identified by the traced operations and constants of its dynamics, cost and Δt, by N, and by the control
    set. Files that cannot be read or written are ignored.
    """

    def __init__(self, graphs: Sequence[GraphModule], steps: int, m: int, controls: ControlSet):
        parts: list[Any] = [(graph.code, constants_of(graph)) for graph in graphs]
        facts = [(name, buffer.tolist()) for name, buffer in controls.named_buffers()]
        parts.append((f"{type(controls).__module__}:{type(controls).__qualname__}", facts))
        self.shape = steps, m
        self.folder = cache_folder() / "optima" / _hash(repr([self.shape, *parts]).encode())

    def read(self, x0: Tensor) -> Tensor | None:
        """The stored controls of a state (n,); None if there are none."""
        try:
            # the archive's checksums detect damaged files
            with np.load(io.BytesIO(self._file(x0).read_bytes()), allow_pickle=False) as entries:
                u = torch.from_numpy(entries["u"])
        except (OSError, EOFError, KeyError, ValueError, TypeError, RuntimeError, zipfile.BadZipFile):
            return None
        fits = u.dtype == torch.float64 and u.shape == self.shape and bool(torch.isfinite(u).all())
        return u if fits else None

    def write(self, x0: Tensor, u: Control) -> None:
        """Store the controls of a state (n,), replacing earlier ones; checksums find a torn file when it is read."""
        content = io.BytesIO()
        np.savez(content, u=u.numpy())
        with contextlib.suppress(OSError):
            self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            draft = self.folder / f".new_{os.getpid()}_{secrets.token_hex(8)}"
            try:
                draft.write_bytes(content.getvalue())
                draft.replace(self._file(x0))
            finally:
                draft.unlink(missing_ok=True)

    def _file(self, x0: Tensor) -> Path:
        return self.folder / f"{_hash(x0.numpy().tobytes())}.npz"


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:32]
