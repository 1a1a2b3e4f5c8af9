"""Functions on a GPU whose kernels are recorded once, and then launched together (CUDA graphs)."""

from collections.abc import Callable, Sequence
from threading import Lock

import torch
from torch import Tensor

Replay = Callable[[], None]
WARM_UP = 3  # runs before the recording, in which libraries initialise themselves


def record(run: Callable[[], None]) -> Replay:
    """A function that launches all kernels of `run` again, on the same memory.

    Raises:
        RuntimeError: torch cannot record an operation, for example one that waits for a value.
    """
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(WARM_UP):
            run()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        run()
    return graph.replay


class RecordedFunction:
    """(*arguments) ↦ results, by replaying the kernels that a function launched when it was recorded.

    This is faster for thousands of small kernels, as launching them one by one takes longer than running them.

    Args:
        function: of tensors; it launches the same kernels for all values.
        arguments: examples; the arguments of a call must have the same shapes, and are copied to their memory.
        record: returns a function that launches the kernels again.

    Raises:
        RuntimeError: as record.
    """

    def __init__(
        self,
        function: Callable[..., Sequence[Tensor]],
        arguments: Sequence[Tensor],
        record: Callable[[Callable[[], None]], Replay] = record,
    ):
        self._arguments = [each.detach().clone() for each in arguments]
        self._results = list[Tensor]()
        self._lock = Lock()  # all calls share one memory

        def run() -> None:
            self._results = [*function(*self._arguments)]

        with torch.no_grad():
            self._replay = record(run)

    def __call__(self, *arguments: Tensor) -> list[Tensor]:
        """The results.

        Raises:
            ValueError: the arguments have other shapes.
        """
        shapes, expected = ([tuple(each.shape) for each in given] for given in (arguments, self._arguments))
        if shapes != expected:
            raise ValueError(f"Expected arguments {expected}, got {shapes}; record the function anew.")
        with torch.no_grad(), self._lock:
            for own, given in zip(self._arguments, arguments, strict=True):
                own.copy_(given)
            self._replay()
            return [each.clone() for each in self._results]
