"""The backward pass along a closed loop, from the loss's derivatives at the nodes to those by x₀ and the parameters.

The stepwise route differentiates one step at a time, without a product with the network's matrices for each state
component. The blockwise route linearises all states of a block at once, with few large operations, which suits GPUs.
"""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lyapnet.base.types import Jacobians, StagePath, State, StatePath, Times, ValuePath

LIMIT_INTERVAL = 4  # nodes between two limitations of the costates; the recipe's limit was tuned with this


class PathWithDerivatives(NamedTuple):
    """A path and the loss's derivatives along it, at its nodes 0 … N."""

    t: Times
    dt: Times  # 0 at the last node
    stages: StagePath
    node_bar: StatePath  # derivative by x
    cost_bar: ValuePath  # derivative by ∫ℓ over the step
    value_bar: ValuePath  # derivative by V
    increments: Tensor | None = None  # ΔW over the step, 0 at the last node; None without noise

    @property
    def columns(self) -> list[Tensor]:
        """The fields that are not None."""
        return [column for column in self if column is not None]


class StepwiseGradient:
    """(state, columns) ↦ (x̄₀, θ̄), one step pulled back at a time.

    Args:
        pull_back: (*state, t, Δt, x, x̄, c̄, V̄, λ'), columns with the latest node first ↦ (λ at the nodes, *θ̄); with
            noise ΔW before λ'.
        limit: largest length of costates, see `limit_costates`; applied at each LIMIT_INTERVAL-th node.
    """

    def __init__(self, pull_back: Callable[..., Sequence[Tensor]], limit: float | None):
        self.pull_back, self.limit = pull_back, limit

    def __call__(self, state: Sequence[Tensor], path: PathWithDerivatives) -> tuple[State, list[Tensor]]:
        nodes = len(path.t)
        t, dt, stages, *derivatives = path.columns
        columns = [column.flip(0) for column in (t, dt, stages[:, 0], *derivatives)]
        ends = (
            [0, nodes]
            if self.limit is None
            else [0, *range((nodes - 1) % LIMIT_INTERVAL + 1, nodes + 1, LIMIT_INTERVAL)]
        )
        costate, gradient = torch.zeros_like(path.node_bar[0]), list[Tensor]()
        for start, end in pairwise(ends):
            costates, *share = self.pull_back(*state, *(column[start:end] for column in columns), costate)
            costate = costates[-1] if self.limit is None else limit_costates(costates[-1], self.limit)
            gradient = [total + part for total, part in zip(gradient, share, strict=True)] if gradient else share
        return costate, gradient


class BlockwiseGradient:
    """(state, columns) ↦ (x̄₀, θ̄), linearised block by block.

    Args:
        linearise: (*state, *block) ↦ (Φᵀ, source, *intermediate).
        product: (*state, *block, costate, *intermediate) ↦ θ̄.
        block: K, the number of nodes in a block.
        limit: as for StepwiseGradient.
    """

    def __init__(
        self,
        linearise: Callable[..., Sequence[Any]],
        product: Callable[..., Sequence[Tensor]],
        block: int,
        limit: float | None,
    ):
        self.linearise, self.product, self.block, self.limit = linearise, product, block, limit

    def __call__(self, state: Sequence[Tensor], path: PathWithDerivatives) -> tuple[State, list[Tensor]]:
        K, nodes = self.block, len(path.t)
        length = K * math.ceil(nodes / K)
        columns = [
            (repeated if name in ("t", "stages") else padded)(column, length).contiguous()
            for name, column in path._asdict().items()
            if column is not None
        ]
        costate, gradient = torch.zeros_like(path.node_bar[0]), list[Tensor]()
        for start in reversed(range(0, length, K)):
            block = [column[start : start + K] for column in columns]
            transition, source, *intermediate = self.linearise(*state, *block)
            costate, after = run_costate(transition, source, costate, start, self.limit)
            share = self.product(*state, *block, after, *intermediate)
            gradient = [total + part for total, part in zip(gradient, share, strict=True)] if gradient else list(share)
        return costate, gradient


def run_costate(
    transition: Jacobians, source: StatePath, costate: State, first: int = 0, limit: float | None = None
) -> tuple[State, StatePath]:
    """λ = Φᵀλ' + source backwards through a block: (λ before its first step, λ' after each of its steps).

    Args:
        first: index of the block's first node.
        limit: as for StepwiseGradient.
    """
    K, n = len(source), source.shape[-1]
    transition, source = transition.reshape(K, -1, n, n), source.reshape(K, -1, n, 1)
    after, running = torch.empty_like(source), costate.reshape(-1, n, 1)
    for k in reversed(range(K)):
        after[k] = running
        running = torch.baddbmm(source[k], transition[k], running)
        if limit is not None and (first + k) % LIMIT_INTERVAL == 0:
            running = limit_costates(running.reshape(costate.shape), limit).reshape(running.shape)
    return running.reshape(costate.shape), after.reshape(K, *costate.shape)


def limit_costates(costate: State, limit: float) -> State:
    """Shorten costates (*members, b, n) to at most `limit` times the median length of their batch.

    If a closed loop is unstable, or a small change of x decides whether it reaches the goal, λ grows exponentially
    backwards in time. A single such trajectory would dominate the gradient of the mean, without useful information. The
    median is the length for trajectories that depend smoothly on x.
    """
    length = torch.linalg.vector_norm(costate, dim=-1, keepdim=True)
    longest = limit * length.median(-2, keepdim=True).values
    return costate * (longest / length).clamp_max(1).where(longest > 0, 1)


def padded(column: Tensor, length: int) -> Tensor:
    """Append zeros to a column: steps on which the loss does not depend."""
    return torch.cat([column, column.new_zeros(length - len(column), *column.shape[1:])])


def repeated(column: Tensor, length: int) -> Tensor:
    """Append copies of the last entry to a column."""
    return torch.cat([column, column[-1:].expand(length - len(column), *column.shape[1:])])
