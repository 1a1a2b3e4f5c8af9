"""Bounds of A⁻¹B for small matrices that depend on the point."""

from typing import Any

import torch
from torch import Tensor

from lyapnet.base.errors import UsageError
from lyapnet.prover import elementary_functions, taylor
from lyapnet.prover.taylor import TaylorForm

aten = torch.ops.aten


def solve(A: TaylorForm, B: TaylorForm) -> TaylorForm:
    """A⁻¹B for A of shape (n, n) and B of shape (n, k).

    Let K be the computed inverse of A at the middle of the box. KA is then close to the identity, and KA y = KB is
    solved by Gauss-Jordan elimination without pivoting, in Taylor forms. The result encloses A⁻¹B for any K: A y = B
    implies KA y = KB, and if no pivot contains 0, KA is regular, hence A is. If a pivot contains 0, no bound is known.
    """
    K = torch.linalg.inv_ex(A.center).inverse
    system = _from_left(K, A.with_parts(torch.cat([A.terms, B.terms], -1), torch.cat([A.radius, B.radius], -1)))
    rows = [system.with_parts(system.terms[..., i, :], system.radius[..., i, :]) for i in range(A.shape[0])]
    for i in range(len(rows)):
        rows[i] = taylor.multiply(rows[i], elementary_functions.reciprocal(_columns(rows[i], slice(i, i + 1))))
        for j in (j for j in range(len(rows)) if j != i):
            eliminated = taylor.multiply(_columns(rows[j], slice(i, i + 1)), taylor.negate(rows[i]))
            rows[j] = taylor.add(rows[j], eliminated)
    solution = [_columns(row, slice(len(rows), None)) for row in rows]
    return A.with_parts(torch.stack([y.terms for y in solution], -2), torch.stack([y.radius for y in solution], -2))


def _from_left(K: Tensor, x: TaylorForm) -> TaylorForm:
    """K x with a constant matrix K for each box, (boxes, n, n): the terms by K, the remainder by |K|."""
    x = x.with_rounding(2 * K.shape[-1])  # as in taylor.matrix_product
    return x.with_parts(K @ x.terms, K.abs() @ x.radius + taylor.TINY)


def _columns(x: TaylorForm, columns: slice) -> TaylorForm:
    return x.with_parts(x.terms[..., columns], x.radius[..., columns])


def _solve_rule(A: Any, B: Any, left: bool = True, check_errors: bool = False) -> list[Any]:
    """A⁻¹B; the other results of torch (LU factors, pivots, the code for a singular A) have no bounds."""
    if not left:
        raise UsageError("Expected a linear system A y = b, got y A = b; transpose it.")
    A, B = _forms(A, B)
    if len(B.shape) == 1:
        solution = solve(A, B.with_parts(B.terms[..., None], B.radius[..., None]))
        solution = solution.with_parts(solution.terms[..., 0], solution.radius[..., 0])
    else:
        solution = solve(A, B)
    return [solution, None, None, None]


def _inverse_rule(A: TaylorForm, check_errors: bool = False) -> list[Any]:
    """A⁻¹; the code for a singular A has no bounds."""
    identity = taylor.constant_form(torch.eye(A.shape[0]).to(A.radius), A)
    return [solve(A, identity), None]


def _forms(A: Any, B: Any) -> tuple[TaylorForm, TaylorForm]:
    like = A if isinstance(A, TaylorForm) else B
    A, B = (value if isinstance(value, TaylorForm) else taylor.constant_form(value, like) for value in (A, B))
    return A, B


LINEAR_SYSTEMS = {aten._linalg_solve_ex.default: _solve_rule, aten.linalg_inv_ex.default: _inverse_rule}
