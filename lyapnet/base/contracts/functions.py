"""Checks of users' functions of states: f, g, the cost and V have to fulfil their contracts.

They are tested on random states, so that a contract may still be broken at other states; certificates do not rely on
these checks (docs/trust.md).
"""

import copy
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from lyapnet.base.contracts.derivatives import at_state, check_derivative
from lyapnet.base.contracts.memory import reaches_own_code
from lyapnet.base.errors import UsageError, describe_error

REMEDIES = {  # text in an error of torch ↦ what to do
    "before Module.__init__() call": "call super().__init__() first in __init__",
    "' already exists": "give that attribute of your class another name than that of a buffer",
    "has no setter": "n, m, title and the like are reserved names of every system: give that attribute another one",
    "object is not callable": "an attribute may hide a function of that name: give it another one",
    "Boolean value of Tensor": "write torch.where(x > 0, a, b) in the place of an if",
    "converted to Python scalars": "stay in torch: no float(x) and no x.item()",
    "numpy": "stay in torch: torch.sin for np.sin, and lyapnet.Table for np.interp",
}


def _advice(got: tuple[int, ...] | str, batch: int, expected: tuple[int, ...]) -> str:
    """Advice on a result whose shape is not (batch, *expected)."""
    if got == expected:
        return f"append .expand({', '.join(['*x.shape[:-1]', *map(str, expected)])}), which gives it to each state"
    if expected and expected[-1] == 1 and got == (batch, *expected[:-1]):
        return "append [..., None], which adds the last axis"
    if len(got) == 1 + len(expected) and got[0] == batch:
        axis = next(k for k, (one, other) in enumerate(zip(got[1:], expected, strict=True), 1) if one != other)
        return f"give its axis {axis} {expected[axis - 1]} entries, not {got[axis]}"
    return "return one result for each state"


def check_function(
    name: str,
    function: Callable[..., Any],
    arguments: Sequence[Tensor],
    shape: Sequence[int],
    differentiable: bool = True,
    any_size: bool = True,
) -> None:
    """Check the contract of a function of states.

    It returns finite tensors in the precision of its arguments; the result of a state depends on that state only, in
    batches of any shape; it does not change its arguments; and autograd computes its derivative correctly.

    Args:
        name: name of the function in messages, such as "Pendulum.f(x)".
        arguments: batches (b, …) of float64 numbers, b even.
        shape: shape of one state's result.
        differentiable: whether the derivative is checked.
        any_size: whether a user's function is also checked for batches of every size, by a trace.

    Raises:
        UsageError: a condition is broken; names it, and where.
    """
    given = [argument.detach().clone().requires_grad_() for argument in arguments]
    value, batch = check_result(name, function, given, shape), len(given[0])
    if any(not torch.equal(one, before) for one, before in zip(given, arguments, strict=True)):
        raise UsageError(f"Expected {name} to leave its arguments as they are, got others; clone them first.")
    value = value.detach()
    bad = torch.nonzero(~value.isfinite().reshape(batch, -1).all(-1)).flatten()
    if len(bad):
        raise UsageError(
            f"Expected finite {name}, got {_first_bad(value[bad[0]])} at {at_state(arguments, int(bad[0]))}; correct "
            "it, or choose an X₀ that avoids this state."
        )
    if any_size and reaches_own_code(function):
        from lyapnet.base.contracts.batch_sizes import check_batch_sizes  # loads sympy, which takes 1 s

        check_batch_sizes(name, lambda *batches: (function(*batches),), arguments)
    _check_independence(name, function, arguments, value)
    if differentiable:
        check_derivative(name, lambda *batches: call_checked(name, function, batches), arguments)


def check_result(
    name: str,
    function: Callable[..., Any],
    arguments: Sequence[Tensor],
    shape: Sequence[int],
    dtype: torch.dtype | None = None,
) -> Tensor:
    """Call a user's function, check its result, one entry of a given shape for each state, and return it.

    Args:
        name: name of the function in messages, such as "Pendulum.f(x)".
        arguments: batches (b, …).
        shape: shape of one state's result.
        dtype: dtype of the result; None: that of the arguments.

    Raises:
        UsageError: the function fails, or its result has another type, shape or dtype.
    """
    value = call_checked(name, function, arguments)
    batch, dtype = len(arguments[0]), dtype or arguments[0].dtype
    got = (tuple(value.shape), value.dtype) if isinstance(value, Tensor) else type(value).__name__
    if got != ((batch, *shape), dtype):
        shapes = " and ".join(str(tuple(argument.shape)) for argument in arguments)
        precision = "return a comparison" if dtype == torch.bool else "append .to(x), which gives it the precision of x"
        advice = precision if got[0] == (batch, *shape) else _advice(got[0], batch, tuple(shape))
        raise UsageError(
            f"Expected {name} as a tensor of {(batch, *shape)} and {dtype} for arguments of shape {shapes}, got {got}; "
            f"{advice}."
        )
    return value


def call_checked(name: str, function: Callable[..., Any], arguments: Sequence[Tensor]) -> Any:
    """Call a user's function; converts any error, also sys.exit(), to a UsageError of one line."""
    try:
        return function(*arguments)
    except (Exception, SystemExit) as error:
        shapes = " and ".join(str(tuple(argument.shape)) for argument in arguments)
        raise UsageError(
            f"Expected {name} for arguments of shape {shapes}, got {describe_error(error)}; {remedy(error)}."
        ) from error


def remedy(error: BaseException) -> str:
    """Advice on an error of a user's function."""
    return next((advice for words, advice in REMEDIES.items() if words in str(error)), "correct it there")


def require_initialised(part: Any) -> Any:
    """Check that the __init__ of a part of a problem has called super().__init__(), and return the part.

    Raises:
        UsageError: it did not.
    """
    if isinstance(part, nn.Module) and "_modules" not in vars(part):
        raise UsageError(
            f"Expected {type(part).__name__}.__init__ to call super().__init__(), got one that does not; call it first."
        )
    return part


def copied(module: nn.Module) -> Any:
    """A float64 copy of a module on the CPU.

    Raises:
        UsageError: it contains something that cannot be copied.
    """
    try:
        return copy.deepcopy(module).double().cpu()
    except Exception as error:
        raise UsageError(
            f"Expected a {type(module).__name__} that can be copied, got {describe_error(error)}; call what it "
            "holds there by its global name."
        ) from error


def _check_independence(name: str, function: Callable[..., Any], arguments: Sequence[Tensor], value: Tensor) -> None:
    """Raise UsageError if results depend on other states of a batch, on its shape, or on random numbers."""
    tolerance = torch.finfo(value.dtype).eps ** 0.5
    folded = call_checked(name, function, [argument.reshape(2, -1, *argument.shape[1:]) for argument in arguments])
    first = call_checked(name, function, [argument[:1] for argument in arguments])
    alone = [call_checked(name, function, [argument[i] for argument in arguments]) for i in range(3)]
    batches = (folded, value.reshape(2, -1, *value.shape[1:])), (first, value[:1])
    for some, expected in (*batches, *zip(alone, value[:3], strict=True)):
        if (
            not isinstance(some, Tensor)
            or some.shape != expected.shape
            or not torch.allclose(some, expected, rtol=tolerance, atol=tolerance * float(value.abs().max()))
        ):
            raise UsageError(
                f"Expected {name} to be a function of each state by itself, in batches of any shape, got another "
                f"result for a batch of {tuple(expected.shape[: expected.ndim - value.ndim + 1]) or 'one state'}; use "
                "x[..., i], sums over the last axis alone, torch.where in the place of an if, and no random numbers."
            )


def _first_bad(result: Tensor) -> float:
    return float(result[~result.isfinite()][0])
