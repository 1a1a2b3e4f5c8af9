"""Polynomials p(τ, ε) near the closed loops from a box of initial states, by simulation; proofs do not rely on them."""

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.base.types import Terms
from lyapnet.prover.taylor import monomials

DEGREE = 3  # of p in (τ, ε)
SUBSTEPS = 2  # Runge-Kutta steps within one step of a tube

Slope = Callable[[float, Tensor], Tensor]  # (t, x) ↦ (ẋ, ℓ) in plain arithmetic, (*batch, n + 1)


class Flow(NamedTuple):
    """y = (x, ∫ℓ) and ẏ at one time, as polynomials of degree two in ε, (terms, cells, n + 1) each.

    The terms are in the order of `monomials(e, 2)`.
    """

    y: Tensor
    rate: Tensor


def stencil(e: int) -> Tensor:
    """The ε at which closed loops are simulated, (points, e): 0, ±1 on each axis, and (1, 1) on each pair of axes."""
    points = [[0.0] * e]
    for i in range(e):
        points += [[sign * (k == i) for k in range(e)] for sign in (1.0, -1.0)]
    for i, j in _pairs(e):
        points.append([float(k in (i, j)) for k in range(e)])
    return torch.tensor(points, dtype=torch.float64).reshape(len(points), e)


def flow(slope: Slope, t: float, y: Tensor, e: int) -> Flow:
    """The polynomials through the values y at the stencil, (points, cells, n + 1), and through their derivatives."""
    return Flow(_interpolate(y, e), _interpolate(slope(t, y[..., :-1]), e))


def integrate(slope: Slope, t: float, h: float, y: Tensor) -> Tensor:
    """y = (x, ∫ℓ) after h seconds, by steps of the classical Runge-Kutta method."""
    h = h / SUBSTEPS
    for k in range(SUBSTEPS):
        at = t + k * h
        k1 = slope(at, y[..., :-1])
        k2 = slope(at + h / 2, (y + h / 2 * k1)[..., :-1])
        k3 = slope(at + h / 2, (y + h / 2 * k2)[..., :-1])
        k4 = slope(at + h, (y + h * k3)[..., :-1])
        y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return y


def interpolate_step(before: Flow, after: Flow, h: float, e: int) -> Tensor:
    """The polynomial p(τ, ε), −1 ≤ τ ≤ 1, of a step of h seconds from its values and rates at both ends.

    Coefficients of ε⁰, ε¹ and ε² are polynomials in τ of degree 3, 2 and 1, so p is continuous from step to step up to
    rounding. The terms, (terms, cells, n + 1), are in the order of `monomials(1 + e, DEGREE)`.
    """
    place, known = places(1 + e, DEGREE), monomials(e, 2)
    terms = before.y.new_zeros(len(place), *before.y.shape[1:])
    for k, axes in enumerate(known):
        y0, y1, d0, d1 = before.y[k], after.y[k], before.rate[k] * h / 2, after.rate[k] * h / 2
        cubic = ((d0 + d1) / 2 - (y1 - y0) / 2) / 2 if len(axes) == 0 else torch.zeros_like(y0)
        square = (d1 - d0) / 4 if len(axes) < 2 else torch.zeros_like(y0)
        in_time = [(y0 + y1) / 2 - square, (y1 - y0) / 2 - cubic, square, cubic]
        for power, value in enumerate(in_time[: DEGREE + 1 - len(axes)]):
            terms[place[(0,) * power + tuple(axis + 1 for axis in axes)]] = value
    return terms


def derivative(terms: Terms, e: int) -> Tensor:
    """∂p/∂τ, with terms in the same order."""
    place, found = places(1 + e, DEGREE), torch.zeros_like(terms)
    for axes, k in place.items():
        if power := axes.count(0):
            found[place[axes[1:]]] = power * terms[k]
    return found


def at_step_end(terms: Terms, e: int, tau: int) -> Tensor:
    """p(τ, ε) at τ = ±1, with terms in the order of `monomials(e, DEGREE)`; each is a sum of up to four."""
    place = places(e, DEGREE)
    found = terms.new_zeros(len(place), *terms.shape[1:])
    for axes, k in places(1 + e, DEGREE).items():
        power = axes.count(0)
        found[place[tuple(axis - 1 for axis in axes[power:])]] += float(tau) ** power * terms[k]
    return found


@cache
def places(dimension: int, degree: int) -> dict[tuple[int, ...], int]:
    """The index of each monomial."""
    return {axes: k for k, axes in enumerate(monomials(dimension, degree))}


def _interpolate(values: Tensor, e: int) -> Tensor:
    """The polynomial of degree two through values at the stencil, (points, cells, …)."""
    middle, linear, squares = values[0], [], {}
    for i in range(e):
        plus, minus = values[1 + 2 * i], values[2 + 2 * i]
        linear.append((plus - minus) / 2)
        squares[i, i] = (plus + minus) / 2 - middle
    for both, (i, j) in zip(values[1 + 2 * e :], _pairs(e), strict=True):
        squares[i, j] = both - middle - linear[i] - linear[j] - squares[i, i] - squares[j, j]
    return torch.stack([middle, *linear, *(squares[axes] for axes in monomials(e, 2)[1 + e :])])


def _pairs(e: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(e) for j in range(i + 1, e)]
