"""Compiling in another process while the start is sought: python -m lyapnet.training.compiling_ahead < ORDER.

What it compiles goes to the folder of machine code, from where the run takes it; nothing else passes between the two.
So a run computes the same with it and without.
"""

import pickle
import signal
import subprocess
import sys
from typing import Any

import torch

from lyapnet.errors import LyapnetError
from lyapnet.machine import usable_cores

PATIENCE = 10  # seconds in which it may end by itself


class CompilingAhead:
    """A process that compiles a module for batches of a size; none where there is no core for it.

    Args:
        module: a TrainingModule, which has to be picklable; its classes have to be found by a new interpreter.
    """

    def __init__(self, module: Any, batch_size: int):
        self._process: subprocess.Popen[bytes] | None = None
        if usable_cores() <= torch.get_num_threads():
            return
        try:
            order = pickle.dumps((sys.path, torch.get_num_threads(), torch.get_default_dtype()))
            order += pickle.dumps((module, batch_size))
        except Exception:  # of any kind: what cannot be pickled is the user's; the run compiles it itself
            return
        command = [sys.executable, "-m", __name__]
        quiet = subprocess.DEVNULL  # the run compiles itself what fails here, and says why that fails
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=quiet, stderr=quiet)
        assert self._process.stdin is not None
        try:
            with self._process.stdin as pipe:
                pipe.write(order)
        except OSError:  # it is gone already
            return

    def wait(self) -> None:
        """Until it has compiled, or failed."""
        if self._process is not None:
            self._process.wait()

    def stop(self) -> None:
        """End it, if it is not done, and its compiler with it."""
        if self._process is not None:
            self._process.terminate()
            try:
                self._process.wait(PATIENCE)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()


def _compile_ordered() -> None:
    sys.path[:], threads, dtype = pickle.load(sys.stdin.buffer)
    torch.set_num_threads(threads)
    torch.set_default_dtype(dtype)
    module, batch_size = pickle.load(sys.stdin.buffer)
    if not module.compiled_before(batch_size):
        module.compile_for(batch_size)


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # as an exception, which takes drafts and the compiler along
    try:
        _compile_ordered()
    except LyapnetError:
        sys.exit(1)
