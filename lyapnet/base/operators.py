"""Functions of tensors that may be a single operator in a trace, for backends with an instruction for them."""

import functools
import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import torch
from torch import Tensor
from torch.library import custom_op

_AS_OPERATORS = ContextVar("functions are traced as operators", default=False)
OPERATORS = set[Any]()  # all of them, as they appear in a trace


@contextmanager
def as_operators() -> Iterator[None]:
    """A context in which functions decorated by `operator` are traced as single operators."""
    token = _AS_OPERATORS.set(True)
    try:
        yield
    finally:
        _AS_OPERATORS.reset(token)


def are_operators() -> bool:
    """Whether functions decorated by `operator` are traced as single operators."""
    return _AS_OPERATORS.get()


def is_transformed(x: Tensor) -> bool:
    """Whether a tensor is a wrapper of torch.func, under vmap or grad."""
    return torch._C._functorch.is_functorch_wrapped_tensor(x)  # pyright: ignore[reportAttributeAccessIssue]


def operator(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """A decorator that registers a function as the torch operator lyapnet::NAME, used inside `as_operators`.

    Its arguments are tensors; its result has the shape and dtype of the first one, and no gradient. Under torch.func
    transforms the Python function is used.
    """
    named = ", ".join(f"Tensor {name}" for name in inspect.signature(function).parameters)
    whole = custom_op(f"lyapnet::{function.__name__}", function, mutates_args=(), schema=f"({named}) -> Tensor")
    whole.register_fake(lambda first, *_: first.new_empty(first.shape))
    OPERATORS.add(whole._opoverload)

    @functools.wraps(function)
    def called(*tensors: Tensor) -> Tensor:
        return whole(*tensors) if are_operators() and not any(map(is_transformed, tensors)) else function(*tensors)

    return called
