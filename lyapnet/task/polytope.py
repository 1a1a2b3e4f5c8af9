"""A polytope as a set of controls: joint limits of several controls."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lyapnet.base.linear_algebra import apply, multiply, solve
from lyapnet.base.types import Control, ControlMatrix, State
from lyapnet.task.sets import ControlSet, finite_numbers, passed_through

MOST_CONTROLS = 4  # largest number of controls
MOST_COMBINATIONS = 2000  # largest number of sets of rows; each takes a linear system for each state
INWARDS = 16  # units of rounding by which controls are moved inside, relative to the sum of sizes of a row's terms
LEAST_WIDTH = 1e-4  # least radius of the largest ball in U, relative to U's size: far above rounding in float32
SINGULAR = 1e-9  # singular value below which unit rows count as dependent
ACTIVE = 1e-9  # distance of a control from a row, relative to the sum of sizes, below which the row is active


class ControlPolytope(ControlSet):
    """U = {u : Au ≤ b}, bounded: joint limits of controls, such as a limit of their total power.

    To minimise uᵀRu + bᵀu, every set of at most m independent rows is taken as equations. The minimiser is the result
    that satisfies the optimality conditions best: u ∈ U and multipliers ≥ 0. Controls are rounded inwards, also in
    float32.

    Args:
        A: rows (k, m).
        b: (k,).

    Raises:
        ValueError: other shapes; a set that is empty, flat or unbounded; or more than MOST_CONTROLS controls, or
            MOST_COMBINATIONS combinations of rows.
    """

    A: Float[Tensor, "k m"]  # rows of length 1
    b: Float[Tensor, " k"]
    lower: Float[Tensor, " m"]  # corners of the smallest box around U
    upper: Float[Tensor, " m"]
    inner: Float[Tensor, " m"]  # centre of a largest ball in U
    rows: Int[Tensor, "s m"]  # indices of rows in each of s sets, filled up with k for none

    def __init__(self, A: Sequence[Any], b: Sequence[float]):
        super().__init__()
        normals, sides = finite_numbers("A", A), finite_numbers("b", b)
        if normals.ndim != 2 or sides.shape != normals.shape[:1] or not bool(normals.any(-1).all()):
            raise ValueError(
                f"Expected A as rows that are not zero and b with a number for each, got {A!r} and {b!r}; correct them."
            )
        size = torch.linalg.vector_norm(normals, dim=-1)
        normals, sides = normals / size[:, None], sides / size
        m = normals.shape[1]
        if m > MOST_CONTROLS:
            raise ValueError(
                f"Expected at most {MOST_CONTROLS} controls in a polytope, got {m}; take limits or a ball."
            )
        lower, upper, inner = _box_around(normals, sides)
        rows = _combinations(normals)
        if len(rows) > MOST_COMBINATIONS:
            raise ValueError(
                f"Expected at most {MOST_COMBINATIONS} combinations of rows of A, got {len(rows)} of {len(normals)} "
                "rows; leave some out."
            )
        for name, part in {"A": normals, "b": sides, "lower": lower, "upper": upper, "inner": inner}.items():
            self.register_buffer(name, part.to(torch.get_default_dtype()), persistent=False)
        self.register_buffer("rows", rows, persistent=False)

    @property
    def limits(self) -> tuple[Tensor, Tensor]:
        return self.lower, self.upper

    @property
    def is_box(self) -> bool:
        return False

    @property
    def sizes(self) -> Float[Tensor, " k"]:
        """A bound of the sum of sizes of each row's terms: |A| max |u| + |b|."""
        return self.A.abs() @ torch.maximum(self.lower.abs(), self.upper.abs()) + self.b.abs()

    @property
    def within(self) -> Float[Tensor, " k"]:
        """b, rounded inwards, in float64."""
        return self.b.double() - INWARDS * self.rounding * self.sizes.double()

    def rounded_for(self, dtype: torch.dtype) -> "ControlPolytope":
        return passed_through(self, dtype)

    def applied(self, x: State, u: Control) -> Control:
        return self._pull_inside(u.double()).to(u) if self.rounding > torch.finfo(u.dtype).eps else u

    def excess(self, u: Control) -> Tensor:
        return (apply(self.A, u) - self.b) / self.sizes

    def minimise(self, R: ControlMatrix, b: Control) -> Control:
        given, R, b = b, R.double(), b.double()
        A, sides, sizes = self.A.double(), self.within, self.sizes.double()
        m, known = b.shape[-1], R.isfinite().all((-2, -1)) & b.isfinite().all(-1)
        if m != A.shape[1]:
            raise ValueError(
                f"Expected controls of {A.shape[1]}, the number of columns of A, got {m}; give one for each."
            )
        each = (slice(None), *[None] * (b.ndim - 1))  # the first axis is that of the s sets of rows
        chosen = torch.cat([A, torch.zeros_like(A[:1])])[self.rows][each]  # (s, *1, m, m)
        held = torch.cat([sides, torch.zeros_like(sides[:1])])[self.rows][each]
        none = torch.diag_embed((self.rows == len(A)).to(b))[each]
        inverse = solve(2 * R, torch.eye(m).to(b).expand(*b.shape, m))
        free = -apply(inverse, b)
        multiplier = solve(
            multiply(chosen, multiply(inverse, chosen.mT)) + none, (apply(chosen, free) - held)[..., None]
        )[..., 0]
        u = free - apply(inverse, apply(chosen.mT, multiplier))
        steep = (b.abs() + apply(R.abs(), u.detach().abs())).amax(-1, keepdim=True)
        outside = ((apply(A, u) - sides) / sizes).amax(-1)
        off = torch.maximum(outside, (-multiplier / steep.where(steep > 0, 1.0)).amax(-1))
        best = off.where(off.isfinite(), torch.inf).argmin(0)
        u = u.gather(0, best[None, ..., None].expand(1, *b.shape))[0]
        return torch.where(known[..., None], self._pull_inside(u), torch.nan).to(given)

    def _pull_inside(self, u: Control) -> Control:
        """u, moved towards the inner point if rounding put it outside, in float64."""
        A, room = self.A.double(), self.within - self.A.double() @ self.inner.double()
        beyond = apply(A, u.detach() - self.inner.double())
        share = (room / torch.maximum(beyond, room)).amin(-1, keepdim=True)
        return torch.where(share < 1, self.inner.double() + share * (u - self.inner.double()), u)

    def contains(self, u: Control) -> Bool[Tensor, "*batch"]:
        return (apply(self.A.double(), u.double()) <= self.b.double()).all(-1)

    def project(self, u: Control) -> Control:
        one = torch.eye(u.shape[-1]).to(u)
        return torch.where(self.contains(u)[..., None], u, self.minimise(one.expand(*u.shape, u.shape[-1]), -2 * u))

    def tangents(self, u: Control) -> Float[Tensor, "*batch m m"]:
        """Projections onto the directions that are orthogonal to the active rows."""
        A = self.A.to(u)
        holds = apply(A, u) >= (self.within - ACTIVE * self.sizes).to(u)
        normals = holds[..., None].to(u) * A
        return torch.eye(u.shape[-1]).to(u) - multiply(torch.linalg.pinv(normals, rtol=SINGULAR), normals)

    def extra_repr(self) -> str:
        return f"A={self.A.tolist()}, b={self.b.tolist()}"


def _box_around(A: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(lower, upper) of the smallest box around {u : Au ≤ b}, and the centre of a largest ball in it.

    Raises:
        ValueError: the set is empty, flat or unbounded.
    """
    from scipy.optimize import linprog  # imported here because it takes 0.25 s

    m, free = A.shape[1], (None, None)
    ends = []
    for i in range(m):
        for sign in (1.0, -1.0):
            found = linprog(sign * np.eye(m)[i], A.numpy(), b.numpy(), bounds=free)
            if not found.success:
                raise ValueError(
                    f"Expected a polytope that is bounded and not empty, got A = {A.tolist()} and b = {b.tolist()} in "
                    "unit rows; add limits for each control, or widen them."
                )
            ends.append(float(found.x[i]))
    lower, upper = (torch.tensor(side, dtype=torch.float64) for side in (ends[::2], ends[1::2]))
    ball = linprog(
        np.r_[np.zeros(m), -1.0], np.c_[A.numpy(), np.ones(len(A))], b.numpy(), bounds=[free] * m + [(0, None)]
    )
    size = float(torch.maximum(lower.abs(), upper.abs()).max() + b.abs().max())
    if not ball.success or not ball.x[-1] > LEAST_WIDTH * size:
        raise ValueError(
            f"Expected a polytope with an inside, got one whose largest ball has the radius {float(ball.x[-1]):.3g}; "
            "widen it."
        )
    return lower, upper, torch.from_numpy(ball.x[:-1])


def _combinations(A: Tensor) -> Tensor:
    """All sets of at most m independent rows of A (k, m), as indices (s, m) filled up with k."""
    k, m = A.shape
    found = []
    for count in range(min(k, m) + 1):
        for rows in itertools.combinations(range(k), count):
            if not count or float(torch.linalg.svdvals(A[list(rows)])[-1]) > SINGULAR:
                found.append([*rows, *[k] * (m - count)])
    return torch.tensor(found)
