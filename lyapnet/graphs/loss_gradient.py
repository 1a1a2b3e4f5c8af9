"""The gradient of a loss in the parameters of a module, by lyapnet's kernel if possible."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from lyapnet.graphs.number_kernel.kernel import NumberKernel, kernel_or_none
from lyapnet.graphs.stateless import state_of, stateless, trained_of
from lyapnet.graphs.tracing import trace


def gradient_of_loss(loss: nn.Module, arguments: Sequence[Tensor]) -> Callable[..., None]:
    """A function (*arguments) that writes the gradient of loss(*arguments) to `grad` of its trained parameters.

    On a CPU the loss and its gradient are traced and run by lyapnet's kernel, with the current parameters and buffers.
    A loss that cannot be traced, or with an operation that the kernel lacks, is differentiated by torch.

    Args:
        arguments: examples with the shapes and types of every call.
    """
    trained = trained_of(loss)
    kernel = _kernel(loss, arguments)

    def differentiate(*arguments: Tensor) -> None:
        if kernel is None:
            gradient = torch.autograd.grad(loss(*arguments), trained, allow_unused=True)
        else:
            gradient = kernel(*state_of(loss), *arguments)
        for parameter, slope in zip(trained, gradient, strict=True):
            parameter.grad = slope

    return differentiate


def _kernel(loss: nn.Module, arguments: Sequence[Tensor]) -> NumberKernel | None:
    """The gradient as a kernel; None if it cannot be one."""
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
