"""Checks that the derivatives of users' functions are finite and agree with finite differences, also at kinks."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from lyapnet.base.errors import UsageError

STEP = 1e-6  # step of finite differences, relative to the spread of an argument
DIRECTIONS = 4  # random directions in which derivatives are compared at each state
MIN_SPREAD = 1e-3  # smallest spread of an argument, relative to its size (at least 1)
TOLERANCE = 1e-4  # largest relative difference of two slopes that agree
KINK_OFFSET = 1e-3  # distance from a kink at which derivatives are compared again, relative to the spread
TO_WRITE = (
    "write √(v² + ε²), or lyapnet.norm(v), whose slope at 0 is 0, in the place of √(v²) and |v|, and √(p + ε) in the "
    "place of √p, with a small ε"
)


def check_derivative(name: str, function: Callable[..., Any], arguments: Sequence[Tensor]) -> None:
    """Compare autograd's derivative with finite differences.

    If a function has a kink within a step, differences are unreliable and not used. At a kink, such as that of
    max(−y, 0) if X₀ fixes y = 0, any slope between those of both sides is correct, for each component along each axis;
    the derivative is then also compared a little beside the kink.

    Args:
        name: name of the function in messages, such as "Pendulum.f(x)".
        arguments: batches (b, …) of float64 numbers.

    Raises:
        UsageError: the derivative is not finite, or wrong; says where.
    """
    at_kinks = _compare(name, function, arguments)
    if len(at_kinks):
        generator = torch.Generator().manual_seed(1)
        for _ in range(2):
            aside = [
                a[at_kinks] + KINK_OFFSET * s * torch.randn(a[at_kinks].shape, generator=generator, dtype=a.dtype)
                for a, s in zip(arguments, _spreads(arguments), strict=True)
            ]
            _compare(name, function, aside, _spreads(arguments))


def without_slope(function: Callable[..., Any], arguments: Sequence[Tensor]) -> tuple[int, float, int, int] | None:
    """The first state with a non-finite slope: its index, the slope, and the argument and component; else None."""
    return _first_not_finite(_slopes(function, arguments, torch.Generator().manual_seed(0))[1])


def at_state(arguments: Sequence[Tensor], i: int) -> str:
    """Format the arguments at a state: "x = (1, 2)", or "(t, x) = (0.5, (1, 2))"."""
    shown = ["(" + ", ".join(f"{v:.6g}" for v in a[i].detach().flatten().tolist()) + ")" for a in arguments]
    return f"x = {shown[-1]}" if len(shown) == 1 else f"(t, x) = ({', '.join(shown)})"


def _first_not_finite(slopes: Sequence[Tensor]) -> tuple[int, float, int, int] | None:
    for k, slope in enumerate(slopes):
        bad = torch.nonzero(~slope.reshape(len(slope), -1).isfinite())
        if len(bad):
            i, component = bad[0].tolist()
            return i, float(slope.reshape(len(slope), -1)[i, component]), k, component
    return None


def _spreads(arguments: Sequence[Tensor]) -> list[Tensor]:
    return [a.std(0).maximum(MIN_SPREAD * a.abs().amax(0).clamp_min(1.0)) for a in arguments]


def _slopes(
    function: Callable[..., Any], arguments: Sequence[Tensor], generator: torch.Generator
) -> tuple[Tensor, Sequence[Tensor], Tensor]:
    """Values with random weights, autograd's slopes of their sum, and the weights."""
    leaves = [argument.detach().clone().requires_grad_() for argument in arguments]
    with torch.enable_grad():
        value = function(*leaves)
        weight = torch.randn(value.shape, generator=generator, dtype=value.dtype)
        return (weight * value).detach(), _gradients((weight * value).sum(), leaves), weight


def _gradients(total: Tensor, leaves: Sequence[Tensor]) -> Sequence[Tensor]:
    if not total.requires_grad:
        return [torch.zeros_like(leaf) for leaf in leaves]
    return torch.autograd.grad(total, leaves, allow_unused=True, materialize_grads=True, retain_graph=True)


def _compare(
    name: str, function: Callable[..., Any], arguments: Sequence[Tensor], spreads: Sequence[Tensor] | None = None
) -> Tensor:
    """Raise UsageError for a wrong derivative; return the indices of the states at kinks.

    Args:
        spreads: spreads of the arguments, if these are states beside kinks, where slopes need not be finite.
    """
    generator = torch.Generator().manual_seed(0)
    value, slopes, weight = _slopes(function, arguments, generator)
    if spreads is None:
        _require_finite(name, slopes, arguments)
    spreads = _spreads(arguments) if spreads is None else spreads
    rounding = 1e-13 / STEP * float(value.nan_to_num(0, 0, 0).abs().max())
    at_kinks = torch.zeros(len(value), dtype=torch.bool)

    def along(directions: Sequence[Tensor], step: float) -> Tensor:
        sides = [[a + s * step * d for a, d in zip(arguments, directions, strict=True)] for s in (1, -1)]
        with torch.no_grad():
            ahead, behind = (weight * function(*side) for side in sides)
        return (ahead - behind).reshape(len(value), -1).sum(1) / (2 * step)

    for _ in range(DIRECTIONS):
        directions = [
            torch.randn(a.shape, generator=generator, dtype=a.dtype) * spread
            for a, spread in zip(arguments, spreads, strict=True)
        ]
        parts = [(s * d).reshape(len(value), -1).sum(1) for s, d in zip(slopes, directions, strict=True)]
        slope = torch.stack(parts).sum(0)
        wide, narrow = along(directions, STEP), along(directions, STEP / 2)
        tolerance = TOLERANCE * torch.maximum(wide.abs(), slope.abs()) + rounding
        wrong = ((wide - narrow).abs() <= tolerance) & ~((slope - wide).abs() <= 3 * tolerance)
        off = torch.nonzero(wrong & ~at_kinks).flatten()
        if len(off):
            between = _between_sides(function, [a[off] for a in arguments], spreads)
            at_kinks[off[between]] = True
            if not between.all():
                i = int(off[~between][0])
                raise UsageError(
                    f"Expected {name} with autograd's derivative as its own, got a slope of {float(slope[i]):.4g} "
                    f"where differences have {float(wide[i]):.4g}, at {at_state(arguments, i)}; stay in torch: no "
                    "NumPy, detach or float(x), and lyapnet.Table for a table."
                )
    return torch.nonzero(at_kinks).flatten()


def _require_finite(name: str, slopes: Sequence[Tensor], arguments: Sequence[Tensor]) -> None:
    found = _first_not_finite(slopes)
    if found is not None:
        i, slope, k, component = found
        by = "t" if k < len(arguments) - 1 else f"x[{component}]"
        raise UsageError(
            f"Expected {name} with finite slopes, got {slope} by {by} at {at_state(arguments, i)}; {TO_WRITE}."
        )


def _between_sides(function: Callable[..., Any], arguments: Sequence[Tensor], spreads: Sequence[Tensor]) -> Tensor:
    """Whether autograd's slopes lie between those of both sides, for each component along each axis; (b,).

    If both sides agree, there is no kink, and autograd's slope has to equal them.
    """
    leaves = [argument.detach().clone().requires_grad_() for argument in arguments]
    with torch.enable_grad():
        value = function(*leaves)
        batch = len(value)
        components = value.reshape(batch, -1).unbind(1)
        slopes = [_gradients(component.sum(), leaves) for component in components]
    here, fine = value.detach().reshape(batch, -1), torch.ones(batch, dtype=torch.bool)
    for k, argument in enumerate(arguments):
        spread = spreads[k].reshape(-1)
        for axis in range(max(1, argument[0].numel())):
            step = STEP * float(spread[axis])
            move = torch.zeros_like(argument).reshape(batch, -1)
            move[:, axis] = step
            ahead, behind = (
                function(*[a + sign * move.reshape(a.shape) if j == k else a for j, a in enumerate(arguments)])
                .detach()
                .reshape(batch, -1)
                for sign in (1, -1)
            )
            one, other = (ahead - here) / step, (here - behind) / step
            slope = torch.stack([of_one[k].reshape(batch, -1)[:, axis] for of_one in slopes], 1)
            largest = torch.stack([one.abs(), other.abs(), slope.abs()]).amax(0)
            room = 3 * TOLERANCE * largest + 1e-13 / step * here.nan_to_num(0, 0, 0).abs().amax()
            fine &= ((slope >= torch.minimum(one, other) - room) & (slope <= torch.maximum(one, other) + room)).all(1)
    return fine
