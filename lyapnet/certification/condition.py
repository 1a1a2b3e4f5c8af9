"""The condition that a sound certificate proves, as a function of (t, x)."""

from torch import nn

from lyapnet.calculus import time_derivative
from lyapnet.errors import UsageError
from lyapnet.rollout import ClosedLoop
from lyapnet.types import PerState, State, Time


class DecreaseCondition(nn.Module):
    """c(t, x) = V_t + V_xᵀ(f + g u) + α ℓ(x, u) − δ with u = policy(t, x): V falls where c ≤ 0, up to δ.

    Args:
        closed_loop: the system, its cost, and a control law that V defines.
        alpha: α in (0, 1], the share of the running cost that V pays for.
        delta: δ ≥ 0, in cost per second; with δ > 0 there is room around the goal, where all else vanishes.
    """

    def __init__(self, closed_loop: ClosedLoop, alpha: float, delta: float):
        super().__init__()
        if not 0 < alpha <= 1:
            raise UsageError(f"Expected 0 < alpha ≤ 1, got {alpha}; V can pay for no more than the whole running cost.")
        if not 0 <= delta < float("inf"):
            raise UsageError(f"Expected delta ≥ 0, got {delta}; give it in cost per second.")
        if closed_loop.V is None:
            raise UsageError("Expected a control law that a V defines, got another one; there is nothing to certify.")
        self.closed_loop, self.V, self.alpha, self.delta = closed_loop, closed_loop.V, alpha, delta

    def forward(self, t: Time, x: State) -> PerState:
        loop, u = self.closed_loop, self.closed_loop.policy(t, x)
        return time_derivative(self.V, loop.system, t, x, u) + self.alpha * loop.cost.running(x, u) - self.delta

    def height(self, t: Time, x: State) -> PerState:
        """W(t, x) = V(t, x) − δt: where c ≤ 0, Ẇ ≤ −αℓ ≤ 0, so that sublevel sets of W hold what starts in them."""
        return self.V(t, x) - self.delta * t
