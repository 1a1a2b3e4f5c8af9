"""Parameters and initial states under which trajectories are nearest to the readings, and how well these tell them.

What is minimised is Σ ‖(ŷ_k(p, x₀) − y_k)/σ‖² over the parameters p and the initial state of each piece, by
scipy.optimize.least_squares with exact derivatives. In (p, x₀) the readings of a piece count through an orthogonal
factor of their Jacobian alone, n + k + 1 rows in the place of thousands.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from lyapnet.lab.identification.shooting import Array, Path, Shooting

MOST_EVALUATIONS = 60  # of one minimisation
TOLERANCE = 1e-11  # of least_squares: relative changes of what is minimised and of its arguments, and the gradient
# Standard deviation of a parameter around its start in units of its size. It is that wide so that it decides nothing
# that readings tell, and keeps directions that they do not tell where they are.
ANCHOR = 100.0
FAINT = 1e-6  # a displacement of x₀ by its size that moves readings by less than so much of their noise is not told


@dataclass(frozen=True)
class Point:
    """Parameters, initial states of pieces, and where their segments begin."""

    p: Float[Array, " k"]
    x0: Float[Array, "pieces n"]
    nodes: Float[Array, "segments n"]


@dataclass(frozen=True)
class Solution:
    """A minimum, and what the readings say about it."""

    point: Point
    path: Path
    residuals: Float[Array, "samples q"]  # (ŷ − y) in the unit of each reading
    leverage: Float[Array, " q"]  # how many unknowns the readings of each kind determine, together p and all x₀
    root: Float[Array, "rows k"]  # M with the information MᵀM on p, whatever x₀
    size: Float[Array, " k"]  # ‖∂ŷ/∂p_i‖ in units of the noise, with x₀ known
    evaluations: int


class Fit:
    """The minimisation for some pieces.

    Args:
        shooting: (p, x₀) ↦ readings.
        sigma: standard deviation of each reading, (q,).
        bounds: least and greatest value of each parameter.
        anchor: parameters near which directions stay that readings do not tell; None: p is known, and x₀ is sought.
    """

    def __init__(
        self,
        shooting: Shooting,
        sigma: Float[Array, " q"],
        bounds: tuple[Array, Array],
        anchor: Float[Array, " k"] | None,
    ):
        self.shooting, self.sigma, self.bounds, self.anchor = shooting, sigma, bounds, anchor
        self.k = 0 if anchor is None else shooting.k
        self._last: tuple[Array, Path | None, Any] | None = None
        self._near: Point | None = None  # the last point with a path, and ∂ξ/∂(x₀, p) there
        self._slope: Array | None = None

    def minimise(self, start: Point) -> Solution | None:
        """The minimum from a start; None if there are no trajectories from it."""
        from scipy.optimize import least_squares  # imported here because it takes 0.25 s

        self._near, self._slope, self._last, self._p = start, None, None, start.p
        w = np.concatenate([start.p[: self.k], start.x0.ravel()])
        if self._at(w)[0] is None:
            return None
        free = np.full(start.x0.size, np.inf)
        lower, upper = (
            np.concatenate([side[: self.k], sign * free]) for side, sign in zip(self.bounds, (-1, 1), strict=True)
        )
        found = least_squares(
            self._residuals, np.clip(w, lower, upper), self._jacobian, (lower, upper), x_scale="jac",  # pyright: ignore
            ftol=TOLERANCE, xtol=TOLERANCE, gtol=TOLERANCE, max_nfev=MOST_EVALUATIONS,
        )  # fmt: skip
        path = self._at(found.x)[0]
        assert path is not None
        return self._solution(found.x, path, int(found.nfev))

    def _split(self, w: Array) -> tuple[Array, Array]:
        """(p, x₀) of the unknowns."""
        p = w[: self.k] if self.k else self._p
        return p, w[self.k :].reshape(-1, self.shooting.n)

    def _at(self, w: Array) -> tuple[Path | None, Any]:
        """The path at some unknowns, and the rows of all readings."""
        if self._last is not None and np.array_equal(self._last[0], w):
            return self._last[1:]
        p, x0 = self._split(w)
        near, nodes = self._near, None
        assert near is not None
        if self._slope is not None:  # the segments begin where they did, moved to first order
            step = np.concatenate([x0 - near.x0, np.broadcast_to(p - near.p, (len(x0), self.shooting.k))], -1)
            moved = np.repeat(step, self.shooting.counts, 0)
            nodes = near.nodes + (self._slope @ moved[..., None])[..., 0]
        path = self.shooting(p, x0, near.nodes if nodes is None else nodes)
        rows = None
        if path is not None:
            self._near, self._slope = Point(p, x0, path.nodes), path.of_nodes
            rows = self._rows(p, path)
        self._last = (w.copy(), path, rows)
        return path, rows

    def _weighted(self, path: Path) -> tuple[Array, Array]:
        """(ŷ − y)/σ and its derivatives by (x₀, p), (samples, q) and (samples, q, n + k)."""
        readings = self.shooting.model.readings
        away = readings.surprise(torch.from_numpy(path.y), torch.from_numpy(self.shooting.y)).numpy()
        return away / self.sigma, path.of_y / self.sigma[:, None]

    def _rows(self, p: Array, path: Path) -> tuple[Array, Array]:
        """Residuals and their Jacobian, with the readings of each piece turned into n + k + 1 rows."""
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
            weight = 1 / (ANCHOR * np.where(self.anchor == 0, np.inf, np.abs(self.anchor)))
            residuals[pieces * width + rows] = weight * (p - self.anchor)
            jacobian[pieces * width + rows, rows] = weight
        return residuals, jacobian

    def _by_piece(self, rows: Array) -> list[Array]:
        """The rows (samples, q, c) of each piece, one below another."""
        ends = np.cumsum([len(piece) for piece in self.shooting.pieces])[:-1]
        return [part.reshape(-1, part.shape[-1]) for part in np.split(rows, ends)]

    def _residuals(self, w: Array) -> Array:
        path, rows = self._at(w)
        if path is None:
            return np.full(len(self.shooting.pieces) * (self.shooting.n + self.k + 1) + self.k, np.inf)
        return rows[0]

    def _jacobian(self, w: Array) -> Array:
        return self._at(w)[1][1]

    def _solution(self, w: Array, path: Path, evaluations: int) -> Solution:
        n, k, (p, x0) = self.shooting.n, self.k, self._split(w)
        r, J = self._weighted(path)
        parts, roots = self._by_piece(J[..., : n + k]), list[Array]()
        faint = FAINT / np.maximum(np.abs(path.nodes).max(0), 1e-12)
        for part in parts:  # with x₀ known a little, so that directions that readings do not tell take nothing away
            whole = np.concatenate([part, np.eye(n, n + k) * faint[:, None]])
            roots.append(_triangle(whole)[n:, n:])
        root = np.concatenate(roots)
        size = np.linalg.norm(np.concatenate(parts)[:, n:], axis=0)
        return Solution(
            Point(p, x0, path.nodes), path, r * self.sigma, self._leverage(parts, root, faint), root, size, evaluations
        )

    def _leverage(self, parts: Sequence[Array], root: Array, faint: Array) -> Array:
        """The sum of the diagonal entries of the hat matrix that belong to each reading."""
        n, k, q = self.shooting.n, self.k, len(self.sigma)
        own = np.zeros(q)
        of_p = np.linalg.pinv(root, rcond=1e-9)  # (root)⁺, so that of_p of_pᵀ is the covariance of p
        for part in parts:
            whole = np.concatenate([part[:, :n], np.diag(faint)])
            Q = np.linalg.qr(whole)[0]
            projected = np.concatenate([part[:, n:], np.zeros((n, k))])
            projected = projected - Q @ (Q.T @ projected)
            share = (Q**2).sum(-1) + ((projected @ of_p) ** 2).sum(-1)
            own += share[: len(part)].reshape(-1, q).sum(0)
        return own


def _triangle(rows: Array) -> Array:
    """R of rows = QR."""
    return np.asarray(np.linalg.qr(rows, mode="r"))
