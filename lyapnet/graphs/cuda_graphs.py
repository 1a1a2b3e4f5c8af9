"""Functions on a GPU whose kernels are recorded once and launched at once (CUDA graphs)."""

from collections.abc import Callable, Sequence
from threading import Lock

import torch
from torch import Tensor

Replay = Callable[[], None]
WARM_UP = 3  # runs before the recording, in which libraries set themselves up


def record(run: Callable[[], None]) -> Replay:
    """What launches again all kernels that a function launches, on the memory that they have now.

    Raises:
        RuntimeError: of torch, where an operation cannot be recorded, as one that waits for a value.
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
    """(*arguments) ↦ results, by the kernels that a function launched when it was recorded.

    Where thousands of small kernels are launched one by one, the launches take longer than the kernels.

    Args:
        function: of tensors; which kernels it launches does not depend on values.
        arguments: examples; each call has others of the same shapes, which are copied to where the kernels read.
        record: makes what launches the kernels again.

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
        self._lock = Lock()  # there is one memory

        def run() -> None:
            self._results = [*function(*self._arguments)]

        with torch.no_grad():
            self._replay = record(run)

    def __call__(self, *arguments: Tensor) -> list[Tensor]:
        """The results.

        Raises:
            ValueError: arguments of other shapes.
        """
        shapes, expected = ([tuple(each.shape) for each in given] for given in (arguments, self._arguments))
        if shapes != expected:
            raise ValueError(f"Expected arguments {expected}, got {shapes}; record the function anew.")
        with torch.no_grad(), self._lock:
            for own, given in zip(self._arguments, arguments, strict=True):
                own.copy_(given)
            self._replay()
            return [each.clone() for each in self._results]
