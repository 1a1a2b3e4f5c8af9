"""The gradient of a loss in the parameters of a module, by lyapnet's kernel if possible."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from lyapnet.base.threads import in_threads, size_of_parts
from lyapnet.graphs.number_kernel.kernel import NumberKernel, kernel_or_none
from lyapnet.graphs.stateless import state_of, stateless, trained_of
from lyapnet.graphs.tracing import trace

ROWS_PER_PART = 128  # at least


def gradient_of_loss(loss: nn.Module, arguments: Sequence[Tensor]) -> Callable[..., None]:
    """A function (*arguments) that writes the gradient of loss(*arguments) to `grad` of its trained parameters.

    On a CPU the loss and its gradient are traced and run by lyapnet's kernel, with the current parameters and buffers,
    in parts of equal size on several threads. The parts do not depend on the number of threads, nor does the result. A
    loss that cannot be traced, or with an operation that the kernel lacks, is differentiated by torch.

    Args:
        loss: a mean over the rows of its arguments.
        arguments: examples with the shapes and types of every call.
    """
    trained, size = trained_of(loss), size_of_parts(len(arguments[0]), ROWS_PER_PART)
    kernel = _kernel(loss, [column[:size] for column in arguments])

    def differentiate(*arguments: Tensor) -> None:
        if kernel is None:
            gradient = torch.autograd.grad(loss(*arguments), trained, allow_unused=True)
        else:
            gradient = _mean_of_parts(kernel, state_of(loss), arguments, size)
        for parameter, slope in zip(trained, gradient, strict=True):
            parameter.grad = slope

    return differentiate


def _mean_of_parts(
    kernel: NumberKernel, state: Sequence[Tensor], arguments: Sequence[Tensor], size: int
) -> list[Tensor]:
    """The mean of a kernel's results over the parts of its arguments."""
    parts = [*zip(*(column.split(size) for column in arguments), strict=True)]
    results = in_threads(lambda part: kernel(*state, *part), parts)
    return [torch.stack(each).mean(0) for each in zip(*results, strict=True)]


def _kernel(loss: nn.Module, arguments: Sequence[Tensor]) -> NumberKernel | None:
    """The kernel of the gradient; None if there is none."""
    trained, of_state = len(trained_of(loss)), stateless(loss)

    def gradient(*tensors: Tensor) -> tuple[Tensor, ...]:
        leaves = [tensor.detach().requires_grad_() for tensor in tensors[:trained]]
        with torch.enable_grad():
            value = of_state(*leaves, *tensors[trained:])
        return torch.autograd.grad(value, leaves, materialize_grads=True)

    examples = [*state_of(loss), *arguments]
    if any(example.device.type != "cpu" for example in examples):
        return None
    return kernel_or_none(lambda: NumberKernel(trace(gradient, examples, whole=True), examples))
