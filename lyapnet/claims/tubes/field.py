"""The closed loop of a tube, and bounds of the defect of polynomials in its differential equation."""

from collections.abc import Sequence

import torch
from torch import Tensor

from lyapnet.base.contracts import check_function
from lyapnet.base.interpolation import Curve
from lyapnet.base.types import Corner, State
from lyapnet.claims.control_sets import check_controls
from lyapnet.claims.preconditions import check_loop, check_parts
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.prover.bounds import BoundedFunction
from lyapnet.prover.boxes import random_points
from lyapnet.task.constraints import Constraints
from lyapnet.task.problem import TEST_STATES

DEGREE = 3  # of the Taylor forms


class Field:
    """F(t, x) = (f + g u, ℓ) with u = policy(t, x), in the states that are not ignorable.

    Args:
        loop: the closed loop, in float64.
        seen: the indices of these states; the others are set to 0.
        domain: a box of (t, x) with all states, on which functions are traced.
    """

    def __init__(
        self, loop: ClosedLoop, constraints: Constraints | None, seen: Sequence[int], domain: tuple[Corner, Corner]
    ):
        self.loop, self.constraints, self.seen, self.n = loop, constraints, list(seen), len(seen)
        self._embedding = torch.eye(loop.system.n, dtype=torch.float64)[self.seen]
        lower, upper = (torch.cat([end[:1], end[1:][self.seen]]) for end in domain)
        memory = check_loop(loop, constraints, domain)
        check_controls(loop, domain)
        _check(self, lower, upper)
        one = torch.ones(self.n + 1 + self.n**2, dtype=torch.float64)
        self.defect = BoundedFunction(
            lambda t, y: self._defect(t, y), (torch.cat([lower, -one]), torch.cat([upper, one])), DEGREE
        )
        self.end = BoundedFunction(lambda t, x: (self.loop.cost.terminal(self.whole(x)),), (lower, upper), DEGREE)
        memory.check()

    def slope(self, t: float | Tensor, x: State) -> Tensor:
        """(ẋ, ℓ) of the seen states, (*batch, n + 1)."""
        t, whole = torch.as_tensor(t, dtype=x.dtype), self.whole(x)
        slope = self.loop.slope(whole, self.loop.policy(t.expand(x.shape[:-1]), whole))
        return torch.cat([slope[..., self.seen], slope[..., -1:]], -1)

    def kinks(self, duration: float, dt: float) -> list[float]:
        """Times in (0, T) at which a curve in the law has a node, and Δt earlier, when a sampled law reads the node."""
        nodes = {t for module in self.loop.modules() if isinstance(module, Curve) for t in module.nodes.tolist()}
        return sorted(t for t in {*nodes, *(t - dt for t in nodes)} if 0 < t < duration)

    def whole(self, x: Tensor) -> State:
        """All n states from the seen ones (*batch, seen), with 0 for the ignorable ones."""
        return x if self.n == len(self._embedding[0]) else x @ self._embedding

    def _defect(self, t: Tensor, y: Tensor) -> tuple[Tensor, ...]:
        """(Y (F − rate), ℓ − cost rate, h) for y = (x, (rate, cost rate), Y)."""
        n = self.n
        x, rate, Y = y[:n], y[n : 2 * n + 1], y[2 * n + 1 :].reshape(n, n)
        defect = self.slope(t, x) - rate
        h = () if self.constraints is None else (self.constraints(self.whole(x)),)
        return (Y * defect[:n]).sum(-1), defect[n], *h


def _check(field: Field, lower: Corner, upper: Corner) -> None:
    """Refuse a closed loop whose values on batches and at single points differ, or that differs from its parts."""
    points = random_points(lower, upper, TEST_STATES, torch.Generator().manual_seed(0))
    t, x = points[:, 0], points[:, 1:]
    check_function("(f + g u, ℓ)", field.slope, [t, x], (field.n + 1,), differentiable=False, any_size=False)
    with torch.no_grad():
        check_parts(field.loop, t, field.whole(x))
