"""Where closed loops at one instant's law converge exponentially: a box on which the linearised law contracts."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
import torch
from scipy.linalg import solve_continuous_lyapunov
from torch import Tensor
from torch.fx import GraphModule, Node

from lyapnet.calculus import gradients
from lyapnet.certification.branch_and_bound import Budget, minimum
from lyapnet.certification.preconditions import at_time
from lyapnet.graphs.bounds import BoundedFunction
from lyapnet.graphs.branches import JUMPS
from lyapnet.rollout.closed_loop import ClosedLoop
from lyapnet.sets import Box
from lyapnet.types import PerState, State, Time

BOXES, SAMPLES = 2000, 200  # that are bounded, and states that are tried, for one size of the box
GROWTH, SIZES = 1.6, 20  # sizes of the box that are tried, as long as they do, up to half of D
LEAST = 0.2  # of the linearised law's own rate, that is enough


@dataclass(frozen=True)
class Contraction:
    """With F(x) = f(x) + g(x)u(0, x), J its Jacobian and y = Y(x − x*): on all of a box around x*

        ½(M + Mᵀ) ≤ −κ,   M = Y J(x) Y⁻¹,

    so that ‖y‖ falls at the rate κ along each closed loop in the box, up to what F(x*) ≠ 0 leaves:
    d/dt ‖y‖ ≤ −κ‖y‖ + ‖Y F(x*)‖, by the mean value theorem on the segment from x* to x.

    Source: Lohmiller, Slotine, "On contraction analysis for non-linear systems", Automatica 1998.
    """

    box: Box
    rate: float  # κ in 1/s
    remainder: float  # ‖x − x*‖ that is left as t → ∞, at most: rounding, where x* is an equilibrium


class _Law:
    """F(0, x), as its own operations at one x, so that its derivative is theirs; as it is on batches."""

    def __init__(self, loop: ClosedLoop, lower: State, upper: State):
        self.loop = loop
        (low,), (high,) = at_time(0.0, lower, upper)
        self.domain = low, high
        self.bounded = BoundedFunction(lambda t, x: (self._declared(t, x),), self.domain)

        jumps = _jumps(self.bounded.graph)
        self.decisions = None if jumps is None else BoundedFunction(jumps, self.domain)

    def is_continuous_on(self, box: Box) -> bool:
        """Whether nothing that jumps does so in a box: its bounds there are one number."""
        if self.decisions is None:
            return True
        return all(
            bool((low == high).all()) for low, high in self.decisions.bounds(*at_time(0.0, box.lower, box.upper))
        )

    def _declared(self, t: Time, x: State) -> State:
        return self.loop.system.dynamics(x, self.loop.policy(t, x))

    def __call__(self, t: Time, x: State) -> State:
        return self.bounded.graph(t, x)[0] if x.ndim == 1 else self._declared(t, x)

    def jacobian(self, t: Time, x: State, seen: Sequence[int]) -> Tensor:
        """∂F_i/∂x_j for the states i, j that are seen, (*batch, k, k)."""
        rows = [gradients(lambda t, x, i=i: self(t, x)[..., i], t, x)[1][..., list(seen)] for i in seen]
        return torch.stack(rows, -2)


def contraction_around(
    loop: ClosedLoop, goal: State, states: Box, seen: Sequence[int], seconds: float = 60.0
) -> tuple[Contraction | None, float]:
    """(contraction, slowest): on the largest box around the goal on which the law contracts, of sizes that grow in the
    shape of D; and the largest real part among the eigenvalues of the linearised law, in 1/s.

    Args:
        states: D; no box is larger than half of it.
        seen: the indices of the states that the law depends on.
        seconds: when to stop.

    Returns:
        None for the contraction where the linearised law is not stable, or contracts on no box that was tried.
    """
    law, reach = _Law(loop, states.lower, states.upper), torch.minimum(goal - states.lower, states.upper - goal)
    A = law.jacobian(goal.new_zeros(()), goal, seen).detach().numpy()
    slowest = float(np.linalg.eigvals(A).real.max())
    if not slowest < 0:
        return None, slowest
    own = -slowest / 2
    Y, inverse = (torch.from_numpy(each) for each in _coordinates(A, reach[list(seen)].numpy(), own))

    def contracted(t: Time, x: State) -> PerState:
        """A lower bound of the least eigenvalue of −½(M + Mᵀ), by Gershgorin's discs."""
        M = Y @ law.jacobian(t, x, seen) @ inverse
        S = -(M + M.mT) / 2
        rows = range(len(seen))
        discs = [S[..., i, i] - sum((S[..., i, j].abs() for j in rows if j != i), 0 * S[..., i, i]) for i in rows]
        return reduce(torch.minimum, discs)

    counts, found = torch.isin(torch.arange(len(goal)), torch.tensor(list(seen))), None
    bounded = BoundedFunction(lambda t, x: (contracted(t, x),) * 2, law.domain)
    budget = Budget(seconds)
    for k in range(SIZES):
        radii = torch.where(counts, reach / 2 * GROWTH ** (k + 1 - SIZES), 0.0)
        box = Box(goal - radii, goal + radii)
        x = torch.cat([box.sample(SAMPLES, torch.Generator().manual_seed(0)), box.corners()])
        with torch.no_grad():
            hopeless = bool((contracted(x.new_zeros(()), x) < LEAST * own).any())
        if hopeless or not budget.left or not law.is_continuous_on(box):
            break
        tried = Budget(budget.left, boxes=BOXES)
        rate = minimum(contracted, *at_time(0.0, box.lower, box.upper), tried, enough=LEAST * own, bounded=bounded)
        if rate < LEAST * own * (1 - 1e-6):
            break
        found = Contraction(box, rate, _remainder(law, goal, seen, Y, inverse, rate))
    return found, slowest


def _jumps(graph: GraphModule) -> GraphModule | None:
    """(t, x) ↦ what each operator that jumps gives in a graph, as numbers; None where there is none."""
    nodes, found = copy.deepcopy(graph.graph), list[Node]()
    for node in list(nodes.nodes):
        if node.op == "call_function" and node.target in JUMPS:
            with nodes.inserting_after(node):
                found.append(nodes.call_function(torch.ops.aten.mul.Tensor, (node, 1.0)))
    if not found:
        return None
    next(node for node in nodes.nodes if node.op == "output").args = (tuple(found),)
    nodes.eliminate_dead_code()
    return GraphModule(graph, nodes)


def _coordinates(A: np.ndarray, reach: np.ndarray, own: float) -> tuple[np.ndarray, np.ndarray]:
    """(Y, Y⁻¹) with ½(M + Mᵀ) diagonal and at most −own for M = Y A Y⁻¹, where A's eigenvalues have less than that."""
    scaled, eye = A * reach / reach[:, None], np.eye(len(A))
    P = solve_continuous_lyapunov((scaled + own * eye).T, -eye)
    L = np.linalg.cholesky((P + P.T) / 2)
    M = L.T @ scaled @ np.linalg.inv(L.T)
    _, turn = np.linalg.eigh((M + M.T) / 2)
    Y = turn.T @ L.T / reach
    return Y, np.linalg.inv(Y)


def _remainder(law: _Law, goal: State, seen: Sequence[int], Y: Tensor, inverse: Tensor, rate: float) -> float:
    """‖Y⁻¹‖ ‖Y F(x*)‖ / κ, with the bounds of F(x*)."""
    ((low, high),) = law.bounded.bounds(*at_time(0.0, goal, goal))
    size = torch.maximum(low.abs(), high.abs())[0, list(seen)]
    return float(torch.linalg.matrix_norm(inverse, 2) * torch.linalg.vector_norm(Y.abs() @ size) / rate)
