"""Multiple shooting: readings of a model from given initial states, and their exact derivatives.

A piece of a recording begins in an unknown state x₀. It is divided into segments, which are integrated all at once.
With the state ξ_s at the beginning of segment s, e_s(ξ_s, p) at its end, Φ = ∂e/∂ξ and Γ = ∂e/∂p, Newton's method

    ξ_0 = x₀,   ξ_{s+1} ← e_s + Φ_s (ξ_s⁺ − ξ_s)

joins them. It converges also where one long integration would leave the data, because all segments begin near them. The
derivatives of the joined trajectory follow from N_{s+1} = Φ_s N_s + Γ_s.
Source: Bock, "Recent advances in parameter identification techniques for ODE", 1983; Albersmeyer, Diehl, "The lifted
Newton method and its application in optimization", SIAM Journal on Optimization 2010.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lyapnet.lab.identification.measurements import Measurements, NamedReadings
from lyapnet.task.family import with_attributes
from lyapnet.task.horizon import TABLEAUX, weighted_sum
from lyapnet.task.systems import ControlSystem

SEGMENT = 20  # samples of a segment; steps within a segment follow one another, all segments are done at once
JOINED = 1e-9  # largest gap between joined segments, relative to the largest value of each state
MOST_JOINS = 15  # largest number of Newton steps
LARGEST = 1e60  # largest number on a trajectory and in its derivatives; squares do not overflow
MOST_ROWS = 100_000  # largest number of rows in a batch of derivatives, to limit the memory

Array = np.ndarray


class Model:
    """A system with unknown parameters, and its readings.

    Args:
        system: the system, in float64.
        names: attributes that f and g read, the parameters p.
        readings: x ↦ y.
    """

    def __init__(self, system: ControlSystem, names: Sequence[str], readings: NamedReadings):
        self.system, self.names, self.readings = system, tuple(names), readings
        self.n, self.k = system.n, len(self.names)

    def member(self, p: Sequence[Tensor]) -> ControlSystem:
        """The system with some parameters, each a tensor without axes."""
        return with_attributes(self.system, dict(zip(self.names, p, strict=True)))

    @torch.no_grad()
    def values(self, function: Callable[..., Tensor], x: Tensor, p: Tensor, *others: Tensor) -> Tensor:
        """The values of a function (system, x, *others) ↦ y at states (rows, n)."""
        return function(self.member(p.unbind()), x, *others)

    @torch.enable_grad()
    def derivatives(self, function: Callable[..., Tensor], x: Tensor, p: Tensor, *others: Tensor) -> Tensor:
        """∂y/∂(x, p), (rows, outputs, n + k), of a function (system, x, *others) ↦ y at states (rows, n).

        By vmap, the function is called with one row, in which each parameter is a number. All arguments are copied once
        for each output, so that one backward pass computes all rows of the Jacobian.

        Args:
            others: further arguments of the function, (rows, …).
        """

        def of_row(x: Tensor, p: Tensor, *others: Tensor) -> Tensor:
            return function(self.member(p.unbind()), x, *others)

        outputs = torch.func.vmap(of_row)(x[:1], p[None], *(each[:1] for each in others)).shape[-1]
        copies = [
            each.detach().expand(outputs, *each.shape).flatten(0, 1).clone()
            for each in (x, p.expand(len(x), -1), *others)
        ]
        sought = [each.requires_grad_() for each in copies[:2]]
        y = torch.func.vmap(of_row)(*copies)
        if not y.requires_grad:
            return x.new_zeros(len(x), outputs, self.n + self.k)
        rows = torch.eye(outputs).to(y).repeat_interleave(len(x), 0)
        found = torch.autograd.grad(y, sought, rows, materialize_grads=True)
        return torch.cat(found, -1).reshape(outputs, len(x), -1).movedim(0, 1)


def rk4(system: ControlSystem, x: Tensor, u: Tensor, h: Tensor) -> Tensor:
    """x after one Runge-Kutta step of length h, (…, 1), with u held."""
    tableau, slopes = TABLEAUX["rk4"], list[Tensor]()
    for row in tableau.a:
        stage = x + h * weighted_sum(row, slopes) if any(row) else x
        slopes.append(system.dynamics(stage, u))
    return x + h * weighted_sum(tableau.b, slopes)


class Path(NamedTuple):
    """The trajectories of all pieces for some (p, x₀)."""

    nodes: Float[Array, "segments n"]  # ξ
    of_nodes: Float[Array, "segments n n_plus_k"]  # ∂ξ/∂(x₀, p)
    transitions: Float[Array, "segments n n"]  # Φ
    y: Float[Array, "samples q"]  # readings, piece after piece
    of_y: Float[Array, "samples q n_plus_k"]  # ∂y/∂(x₀ of the piece, p)


@dataclass(frozen=True)
class _Steps:
    """The steps of all segments."""

    h: Float[Tensor, "steps segments one"]  # lengths in s; 0 beyond the end of a piece
    u: Float[Tensor, "steps segments m"]


class Shooting:
    """(p, x₀) ↦ readings of some pieces of recordings, with their derivatives.

    Args:
        model: the system and its readings.
        pieces: pieces of recordings.
        substeps: number of Runge-Kutta steps between two samples, with u held.
    """

    def __init__(self, model: Model, pieces: Sequence[Measurements], substeps: int = 1):
        self.model, self.pieces, self.substeps = model, list(pieces), substeps
        self.n, self.k = model.n, model.k
        self.counts = [-(-len(piece) // SEGMENT) for piece in self.pieces]  # segments of each piece
        self.first = np.cumsum([0, *self.counts])[:-1]  # first segment of each
        lengths = [np.append(np.diff(piece.t), 0.0) for piece in self.pieces]  # the last sample is read, and not left
        h = np.concatenate([_padded(each[:, None], "constant") for each in lengths])
        u = np.concatenate([_padded(piece.u, "edge") for piece in self.pieces])
        h = np.repeat(h.reshape(-1, SEGMENT, 1), substeps, 1) / substeps
        u = np.repeat(u.reshape(len(h), SEGMENT, -1), substeps, 1)
        self._steps = _Steps(*(torch.from_numpy(np.ascontiguousarray(each.swapaxes(0, 1))) for each in (h, u)))
        own = [np.arange(count * SEGMENT) < len(p) for count, p in zip(self.counts, self.pieces, strict=True)]
        self._sampled = np.concatenate(own)  # which steps of all segments begin at a sample
        self.y = np.concatenate([piece.y for piece in self.pieces])

    @np.errstate(over="ignore", invalid="ignore")
    def __call__(self, p: Float[Array, " k"], x0: Float[Array, "pieces n"], nodes: Array) -> Path | None:
        """The trajectories from x₀; None if they are not finite, or segments cannot be joined.

        Args:
            nodes: first values of the states ξ at the beginning of segments.
        """
        nodes = nodes.copy()
        nodes[self.first] = x0
        for _ in range(MOST_JOINS):
            x, sensitivities = self._integrate(nodes, p)
            ends, slopes = x[-1], sensitivities[-1]
            if not (_are_numbers(ends) and _are_numbers(slopes)):
                return None
            phi, gamma = slopes[..., : self.n], slopes[..., self.n :]
            missing = np.zeros_like(nodes)
            missing[:-1] = ends[:-1] - nodes[1:]
            step = self._follow(phi, missing[..., None], np.zeros((len(x0), self.n, 1)))[..., 0]
            gap = np.abs(step).max(0) / np.maximum(np.abs(x).max((0, 1)), 1e-12)
            if not _are_numbers(step):
                return None
            if gap.max() <= JOINED:
                return self._path(nodes, p, x, sensitivities, phi, gamma)
            nodes += step
        return None

    def _follow(self, phi: Array, source: Array, start: Array) -> Array:
        """v with v = start at the first segment of each piece, and v_{s+1} = Φ_s v_s + source_s."""
        v = np.zeros((len(phi), *start.shape[1:]))
        for g in range(max(self.counts)):
            rows = np.array([at + g for at, count in zip(self.first, self.counts, strict=True) if g < count])
            v[rows] = phi[rows - 1] @ v[rows - 1] + source[rows - 1] if g else start
        return v

    def _path(self, nodes: Array, p: Array, x: Array, sensitivities: Array, phi: Array, gamma: Array) -> Path:
        n, k, pieces = self.n, self.k, len(self.pieces)
        source = np.concatenate([np.zeros_like(phi), gamma], -1)
        of_nodes = self._follow(phi, source, np.broadcast_to(np.eye(n, n + k), (pieces, n, n + k)))
        x, sensitivities = x[: -1 : self.substeps], sensitivities[: -1 : self.substeps]
        of_x = sensitivities[..., :n] @ of_nodes
        of_x[..., n:] += sensitivities[..., n:]
        x, of_x = (each.swapaxes(0, 1).reshape(-1, *each.shape[2:])[self._sampled] for each in (x, of_x))
        states, parameters = torch.from_numpy(np.ascontiguousarray(x)), torch.from_numpy(p)
        read = self.model.readings.of
        y, C = (get(read, states, parameters).numpy() for get in (self.model.values, self.model.derivatives))
        of_y = C[..., :n] @ of_x
        of_y[..., n:] += C[..., n:]
        return Path(nodes, of_nodes, phi, y, of_y)

    def _integrate(self, nodes: Array, p: Array) -> tuple[Array, Array]:
        """x (steps + 1, segments, n) of each segment from its node, and ∂x/∂(node, p)."""
        n, k, parameters = self.n, self.k, torch.from_numpy(p)
        path = self._states(nodes, parameters)
        before, u, h = (each.flatten(0, 1) for each in (path[:-1], self._steps.u, self._steps.h))
        parts = [
            self.model.derivatives(rk4, x, parameters, u, h)
            for x, u, h in zip(*(each.split(MOST_ROWS // n) for each in (before, u, h)), strict=True)
        ]
        A = torch.cat(parts).reshape(len(path) - 1, len(nodes), n, n + k).numpy()
        of_x = [np.broadcast_to(np.eye(n, n + k), A.shape[1:])]
        for each in A:
            of_x.append(each[..., :n] @ of_x[-1])
            of_x[-1][..., n:] += each[..., n:]
        return path.numpy(), np.stack(of_x)

    @torch.no_grad()
    def _states(self, nodes: Array, p: Tensor) -> Tensor:
        """x (steps + 1, segments, n)."""
        system, path = self.model.member(p.unbind()), [torch.from_numpy(nodes)]
        for u, h in zip(self._steps.u, self._steps.h, strict=True):
            path.append(rk4(system, path[-1], u, h))
        return torch.stack(path)

    def integration_error(self, path: Path, p: Array) -> Float[Array, " q"]:
        """Change of readings where segments end if steps are halved, summed over a piece; the largest of all pieces."""
        finer = Shooting(self.model, self.pieces, 2 * self.substeps)
        moved = np.abs(finer._read_ends(path.nodes, p) - self._read_ends(path.nodes, p))
        return np.add.reduceat(moved, self.first).max(0)

    def _read_ends(self, nodes: Array, p: Array) -> Array:
        """Readings where segments end, (segments, q)."""
        parameters = torch.from_numpy(p)
        return self.model.values(self.model.readings.of, self._states(nodes, parameters)[-1], parameters).numpy()


def _are_numbers(values: Array) -> bool:
    """Whether values are finite, and so small that their squares are."""
    return bool(np.abs(values).max() < LARGEST)


def _padded(rows: Array, mode: Literal["constant", "edge"]) -> Array:
    """Rows of a piece, with zeros or its last row up to a multiple of SEGMENT."""
    return np.pad(rows, ((0, -len(rows) % SEGMENT), (0, 0)), mode)
