"""Finds the parameters and initial states whose trajectories are closest to the readings.

scipy.optimize.least_squares minimises Σ ‖(ŷ_k(p, x₀) − y_k)/σ‖² over the parameters p and the initial state x₀ of each
piece, with exact derivatives. The residuals and Jacobian of a piece, thousands of rows, are replaced by the triangular
factor of their QR decomposition, which has n + k + 1 rows.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from lyapnet.lab.identification.shooting import Array, Path, Shooting

MOST_EVALUATIONS = 60  # largest number of evaluations in a minimisation
TOLERANCE = 1e-11  # tolerance of least_squares for relative changes of the sum and the unknowns, and for the gradient
# Standard deviation of a parameter around its start, in units of its size. It is so wide that it does not influence
# what the readings determine, but keeps parameters near their start in the other directions.
ANCHOR = 100.0
FAINT = 1e-6  # change of readings, in units of noise, by a change of x₀ by 100 %, below which x₀ is undetermined


@dataclass(frozen=True)
class Point:
    """Parameters, initial states of the pieces, and states at the beginning of their segments."""

    p: Float[Array, " k"]
    x0: Float[Array, "pieces n"]
    nodes: Float[Array, "segments n"]  # at the beginning of segments


@dataclass(frozen=True)
class Solution:
    """A minimum, with the numbers from which its uncertainty follows."""

    point: Point
    path: Path
    residuals: Float[Array, "samples q"]  # (ŷ − y) in the unit of each reading
    leverage: Float[Array, " q"]  # sum of the diagonal entries of the hat matrix for each reading
    root: Float[Array, "rows k"]  # M, where MᵀM is the information on p with unknown x₀
    scores: Sequence[Float[Array, "_ k"]]  # for each piece, the gradient in p by samples, with unknown x₀
    size: Float[Array, " k"]  # ‖∂ŷ/∂p_i‖ in units of the noise, with known x₀
    evaluations: int


class _Evaluation(NamedTuple):
    """Trajectories for some unknowns w = (p, x₀), and (residuals, Jacobian); None if there are no trajectories."""

    w: Array
    path: Path | None
    rows: tuple[Array, Array] | None


class Fit:
    """The minimisation for some pieces.

    Args:
        shooting: (p, x₀) ↦ readings.
        sigma: standard deviation of each reading, (q,).
        bounds: least and greatest value of each parameter.
        anchor: parameters that undetermined directions stay close to; None: p is known, and only x₀ is unknown.
        spread: standard deviation of parameters around the anchor; None: ANCHOR times their size.
    """

    def __init__(
        self,
        shooting: Shooting,
        sigma: Float[Array, " q"],
        bounds: tuple[Array, Array],
        anchor: Float[Array, " k"] | None,
        spread: Float[Array, " k"] | None = None,
    ):
        self.shooting, self.sigma, self.bounds, self.anchor = shooting, sigma, bounds, anchor
        self._anchored: Array | float = 0.0  # 1/spread
        if anchor is not None:
            usual = ANCHOR * np.where(anchor == 0, np.inf, np.abs(anchor))
            self._anchored = 1 / (usual if spread is None else spread)
        self.k = 0 if anchor is None else shooting.k
        self._start: Point | None = None
        self._last: _Evaluation | None = None
        self._accepted: _Evaluation | None = None  # the last one whose derivatives least_squares used

    def minimise(self, start: Point) -> Solution | None:
        """The minimum from a start; None if there are no trajectories from it."""
        from scipy.optimize import least_squares  # imported here because it takes 0.25 s

        free = np.full(start.x0.size, np.inf)
        lower, upper = (
            np.concatenate([side[: self.k], sign * free]) for side, sign in zip(self.bounds, (-1, 1), strict=True)
        )
        self._start, self._last, self._accepted = start, None, None
        w = np.clip(np.concatenate([start.p[: self.k], start.x0.ravel()]), lower, upper)
        if self._at(w).path is None:
            return None
        self._accepted = self._at(w)
        found = least_squares(
            self._residuals, w, self._jacobian, (lower, upper), x_scale="jac",  # pyright: ignore[reportArgumentType]
            ftol=TOLERANCE, xtol=TOLERANCE, gtol=TOLERANCE, max_nfev=MOST_EVALUATIONS,
        )  # fmt: skip
        path = self._at(found.x).path
        return None if path is None else self._solution(found.x, path, int(found.nfev))

    def _split(self, w: Array) -> tuple[Array, Array]:
        """(p, x₀) of the unknowns."""
        assert self._start is not None
        p = w[: self.k] if self.k else self._start.p
        return p, w[self.k :].reshape(-1, self.shooting.n)

    def _at(self, w: Array) -> "_Evaluation":
        """The evaluation at some unknowns; segments begin at their last nodes, moved to first order."""
        for known in (self._last, self._accepted):
            if known is not None and np.array_equal(known.w, w):
                return known
        assert self._start is not None
        (p, x0), path, tried = self._split(w), None, [self._start.nodes]
        if self._accepted is not None and self._accepted.path is not None:
            near = self._accepted.path
            step = np.concatenate(self._change(w - self._accepted.w), -1)
            way = near.of_nodes @ np.repeat(step, self.shooting.counts, 0)[..., None]
            tried = [near.nodes + way[..., 0], near.nodes]
        for nodes in tried:
            if (path := self.shooting(p, x0, nodes)) is not None:
                break
        rows = None if path is None else self._rows(p, path)
        self._last = _Evaluation(w.copy(), path, rows)
        return self._last

    def _change(self, w: Array) -> tuple[Array, Array]:
        """(Δx₀, Δp) of a change of the unknowns, for each piece."""
        pieces = len(self.shooting.pieces)
        p = w[: self.k] if self.k else np.zeros(self.shooting.k)
        return w[self.k :].reshape(pieces, -1), np.tile(p, (pieces, 1))

    def _weighted(self, path: Path) -> tuple[Array, Array]:
        """(ŷ − y)/σ and its derivatives by (x₀, p), (samples, q) and (samples, q, n + k)."""
        readings = self.shooting.model.readings
        away = readings.surprise(torch.from_numpy(path.y), torch.from_numpy(self.shooting.y)).numpy()
        return away / self.sigma, path.of_y / self.sigma[:, None]

    def _rows(self, p: Array, path: Path) -> tuple[Array, Array]:
        """(residuals, Jacobian), with the readings of each piece reduced to n + k + 1 rows by QR."""
        n, k, (r, J) = self.shooting.n, self.k, self._weighted(path)
        pieces, width = len(self.shooting.pieces), n + k + 1
        residuals, jacobian = np.zeros(pieces * width + k), np.zeros((pieces * width + k, k + pieces * n))
        for i, part in enumerate(self._by_piece(np.concatenate([J[..., : n + k], r[..., None]], -1))):
            R = _triangle(part)
            at = slice(i * width, i * width + len(R))
            residuals[at] = R[:, -1]
            jacobian[at, k + i * n : k + (i + 1) * n], jacobian[at, :k] = R[:, :n], R[:, n : n + k]
        if self.anchor is not None:
            rows = np.arange(k)
            residuals[pieces * width + rows] = self._anchored * (p - self.anchor)
            jacobian[pieces * width + rows, rows] = self._anchored
        return residuals, jacobian

    def _by_piece(self, rows: Array) -> list[Array]:
        """The rows of each piece, (samples · q, c), from those of all pieces, (samples, q, c)."""
        ends = np.cumsum([len(piece) for piece in self.shooting.pieces])[:-1]
        return [part.reshape(-1, part.shape[-1]) for part in np.split(rows, ends)]

    def _residuals(self, w: Array) -> Array:
        rows = self._at(w).rows
        if rows is None:
            return np.full(len(self.shooting.pieces) * (self.shooting.n + self.k + 1) + self.k, np.inf)
        return rows[0]

    def _jacobian(self, w: Array) -> Array:
        """The Jacobian; least_squares asks for it after an accepted step."""
        self._accepted = self._at(w)
        assert self._accepted.rows is not None
        return self._accepted.rows[1]

    def _solution(self, w: Array, path: Path, evaluations: int) -> Solution:
        n, k, q, (p, x0) = self.shooting.n, self.k, len(self.sigma), self._split(w)
        r, J = self._weighted(path)
        parts, left = self._by_piece(J[..., : n + k]), self._by_piece(r[..., None])
        faint = np.diag(FAINT / np.maximum(np.abs(path.nodes).max(0), 1e-12))
        bases, alone = list[Array](), list[Array]()
        for part in parts:  # `faint` is a weak prior on x₀: undetermined directions then take no information from p
            Q = np.linalg.qr(np.concatenate([part[:, :n], faint]))[0]
            of_p = np.concatenate([part[:, n:], np.zeros((n, k))])
            bases.append(Q[: len(part)])
            alone.append((of_p - Q @ (Q.T @ of_p))[: len(part)])
        root = np.concatenate([_triangle(each) for each in alone])
        inverse = np.linalg.pinv(root, rcond=1e-9)  # (MᵀM)⁻¹ is its product with its transpose
        hat = [(Q**2).sum(-1) + ((of_p @ inverse) ** 2).sum(-1) for Q, of_p in zip(bases, alone, strict=True)]
        return Solution(
            point=Point(p, x0, path.nodes),
            path=path,
            residuals=r * self.sigma,
            leverage=np.concatenate(hat).reshape(-1, q).sum(0),
            root=root,
            scores=[(of_p * e).reshape(len(e) // q, q, k).sum(1) for of_p, e in zip(alone, left, strict=True)],
            size=np.linalg.norm(np.concatenate(parts)[:, n:], axis=0),
            evaluations=evaluations,
        )


def _triangle(rows: Array) -> Array:
    """R of rows = QR."""
    return np.asarray(np.linalg.qr(rows, mode="r"))
