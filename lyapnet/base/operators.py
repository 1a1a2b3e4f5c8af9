"""Functions of tensors that can be single operators in a trace, for programs that have an instruction for them."""

import functools
import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import torch
from torch import Tensor
from torch.library import custom_op

NUMBERS, BOUNDS, MINIMA = "numbers", "bounds", "minima"
"""The readers that have instructions or rules of their own for some functions."""

_READERS = ContextVar("readers for which their functions are traced as operators", default=frozenset[str]())
WHOLE = set[Any]()
"""What `operator` makes, as it stands in a trace."""


@contextmanager
def as_operators(reader: str = NUMBERS, on: bool = True) -> Iterator[None]:
    """A context in which each function of a reader is traced as one operator (on=True) or by its operations (default).

    The functions of the kernel for numbers are made by `operator`; those of bounds are lyapnet.prover.rounding.rounded
    and lyapnet.task.cost.minimum.traced_minimum.
    """
    token = _READERS.set(_READERS.get() | {reader} if on else _READERS.get() - {reader})
    try:
        yield
    finally:
        _READERS.reset(token)


def are_operators(reader: str = NUMBERS) -> bool:
    """Whether each function of a reader is traced as one operator."""
    return reader in _READERS.get()


def is_transformed(x: Tensor) -> bool:
    """Whether a tensor is wrapped by torch.func, under vmap or grad."""
    return torch._C._functorch.is_functorch_wrapped_tensor(x)  # pyright: ignore[reportAttributeAccessIssue]


def operator(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """Also register a function as the torch operator lyapnet::NAME, which is called within `as_operators`.

    Its arguments are tensors, its result has the shape and the type of the first one, and no gradient runs through it.
    Under torch.func's transforms the function itself is called.
    """
    named = ", ".join(f"Tensor {name}" for name in inspect.signature(function).parameters)
    whole = custom_op(f"lyapnet::{function.__name__}", function, mutates_args=(), schema=f"({named}) -> Tensor")
    whole.register_fake(lambda first, *_: first.new_empty(first.shape))
    WHOLE.add(whole._opoverload)

    @functools.wraps(function)
    def called(*tensors: Tensor) -> Tensor:
        return whole(*tensors) if are_operators() and not any(map(is_transformed, tensors)) else function(*tensors)

    return called
