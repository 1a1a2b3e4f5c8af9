"""Enclosures of a traced function on boxes: the certifier's, and others to compare them with."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from lyapnet.base.errors import UsageError
from lyapnet.base.types import Value
from lyapnet.prover.bounds import BoundedFunction
from lyapnet.prover.taylor import box_form, interval_form
from lyapnet.value.calculus import gradients

MEAN_VALUE, COMPILED = "mean value", "quadratic, compiled"
Sides = tuple[Tensor, Tensor]
Enclosure = Callable[[Tensor, Tensor], Sides]
"""Boxes (lower, upper) of (t, x), (boxes, 1 + n) each ↦ (lower, upper) bounds of c on them, (boxes,) each."""


def affine(bounded: BoundedFunction, c: Value, sample: Sides) -> Enclosure:
    """Forms of first degree; their excess is of second order in the sides of the box."""
    return lambda lower, upper: bounded.image(box_form(lower, upper))[0].interval()


def quadratic(bounded: BoundedFunction, c: Value, sample: Sides) -> Enclosure:
    """Forms of second degree, as in the certifier: terms up to second order that cancel also cancel in the bounds."""
    return lambda lower, upper: bounded.image(box_form(lower, upper, bounded.degree))[0].interval()


def compiled(bounded: BoundedFunction, sample: Sides) -> Enclosure | None:
    """The same by machine code, as in the certifier's long searches; None if there is none."""
    kernel = bounded.kernel(*(side[None] for side in sample))
    return None if kernel is None else lambda lower, upper: kernel.forms(lower, upper)[0].interval()


def interval(bounded: BoundedFunction, c: Value, sample: Sides) -> Enclosure:
    """Interval arithmetic: exact ranges of single operations; the excess of their composition is of first order."""
    return lambda lower, upper: bounded.image(interval_form(lower, upper))[0].interval()


def mean_value(bounded: BoundedFunction, c: Value, sample: Sides) -> Enclosure:
    """c(m) + Σ_k [∂c/∂y_k] (y_k − m_k), m the middle of the box, with the gradient on the box by interval arithmetic.

    Its excess is of second order, proportional to that of the gradient.
    """
    slopes = BoundedFunction(lambda t, x: gradients(c, t, x), sample)

    def enclose(lower: Tensor, upper: Tensor) -> Sides:
        middle = (lower + upper) / 2
        reach = torch.maximum(upper - middle, middle - lower)
        c_t, c_x = slopes.image(interval_form(lower, upper))
        steepest = torch.cat([c_t.magnitude[:, None], c_x.magnitude], -1)
        at = bounded.image(interval_form(middle, middle))[0]
        return (
            at.with_parts(at.terms, at.radius + (steepest * reach).sum(-1)).with_rounding(len(lower[0]) + 2).interval()
        )

    return enclose


ENCLOSURES: dict[str, Callable[[BoundedFunction, Value, Sides], Enclosure]] = {
    "quadratic": quadratic,
    "affine": affine,
    "interval": interval,
    MEAN_VALUE: mean_value,
}


def enclosure(name: str, c: Value, sample: Sides) -> Enclosure:
    """The enclosure of that name, of c traced in a box of (t, x).

    Raises:
        UsageError: there is none; or c, or its gradient, has an operator without a rule.
    """
    if name not in ENCLOSURES:
        raise UsageError(f"Expected an enclosure among {', '.join(ENCLOSURES)}, got {name!r}; choose one of them.")
    return ENCLOSURES[name](_traced(c, sample), c, sample)


def enclosures_of(c: Value, sample: Sides, say: Callable[[str], Any]) -> dict[str, Enclosure]:
    """All enclosures of c, which is traced once, as far as its gradient has bounds and machine code is available.

    Args:
        say: called with the reason why one is left out: training never needs the gradient of c.

    Raises:
        UsageError: c itself has an operator without a rule.
    """
    bounded, found = _traced(c, sample), {}
    for name, build in ENCLOSURES.items():
        try:
            found[name] = build(bounded, c, sample)
        except UsageError as error:
            say(f"{name} is left out, for the gradient of c: {error}")
    machine_code = compiled(bounded, sample)
    return found if machine_code is None else {**found, COMPILED: machine_code}


def _traced(c: Value, sample: Sides) -> BoundedFunction:
    return BoundedFunction(lambda t, x: (c(t, x),), sample)
