"""The condition that a sound certificate proves, as a function of (t, x)."""

from typing import Any, ClassVar

import torch
from jaxtyping import Bool
from torch import Tensor, nn

from lyapnet.base.errors import UsageError
from lyapnet.base.types import Corner, PerState, State, Time
from lyapnet.loop.rollout import ClosedLoop
from lyapnet.prover.bounds import BoundedFunction
from lyapnet.task.constraints import Constraints
from lyapnet.value.calculus import ValueFunction, gradients, time_derivative


class DecreaseCondition(nn.Module):
    """c(t, x) = V_t + V_xᵀ(f + g u) + Σ_i w_i |∂V/∂x_i| + α ℓ(x, u) − δ with u = policy(t, x): V falls where c ≤ 0, up
    to δ, whatever else, of at most w_i, pushes each ẋ_i.

    Args:
        closed_loop: the system, its cost, and a control law that V defines.
        alpha: α in (0, 1], the share of the running cost that V pays for.
        delta: δ ≥ 0, in cost per second; with δ > 0 there is room around the goal, where all else vanishes.
        constraints: h; c ≤ 0 is asked for where h(x) ≤ 0 alone.
        disturbance: w ≥ 0, (n,), in the units of ẋ; none if None.
    """

    proves: ClassVar[str] = "above"  # what a kept proof of it is called
    partial: ClassVar[bool] = False  # whether each level that is proved is a claim, not only the one that is wanted
    disturbance: State | None

    def __init__(
        self,
        closed_loop: ClosedLoop,
        alpha: float,
        delta: float,
        constraints: Constraints | None = None,
        disturbance: State | None = None,
    ):
        super().__init__()
        if not 0 < alpha <= 1:
            raise UsageError(f"Expected 0 < alpha ≤ 1, got {alpha}; V can pay for no more than the whole running cost.")
        if not 0 <= delta < float("inf"):
            raise UsageError(f"Expected delta ≥ 0, got {delta}; give it in cost per second.")
        if closed_loop.V is None:
            raise UsageError("Expected a control law that a V defines, got another one; there is nothing to certify.")
        self.closed_loop, self.V, self.alpha, self.delta = closed_loop, closed_loop.V, alpha, delta
        self.constraints = constraints
        self.register_buffer("disturbance", disturbance)

    @property
    def facts(self) -> dict[str, Any]:
        """By what numbers it can be built again for the same closed loop; plain data."""
        w = None if self.disturbance is None else self.disturbance.tolist()
        return {"alpha": self.alpha, "delta": self.delta, "disturbance": w}

    def forward(self, t: Time, x: State) -> PerState:
        return self.parts(t, x)[0]

    def parts(self, t: Time, x: State) -> tuple[PerState, PerState, PerState]:
        """(c, W, Ẇ), where Ẇ = V_t + V_xᵀ(f + g u) − δ is below 0 where c is, unless the cost is negative."""
        loop, u = self.closed_loop, self.closed_loop.policy(t, x)
        fall = time_derivative(self.V, loop.system, t, x, u)
        if self.disturbance is not None:
            fall = fall + self.worst_push(self.V.value_and_state_gradient(t, x)[1])
        return fall + self.alpha * loop.cost.running(x, u) - self.delta, self.height(t, x), fall - self.delta

    def worst_push(self, slope: State) -> PerState:
        """Σ_i w_i |∂V/∂x_i|, by which pushes lift V̇ at most."""
        assert self.disturbance is not None
        return (self.disturbance * slope.abs()).sum(-1)

    def excluded(self, x: State) -> Bool[Tensor, "*batch"]:
        """Whether a constraint excludes a state."""
        if self.constraints is None:
            return torch.zeros(x.shape[:-1], dtype=torch.bool)
        return self.constraints.worst(x) > 0

    def height(self, t: Time, x: State) -> PerState:
        """W(t, x) = V(t, x) − δt: where Ẇ ≤ 0, sublevel sets of W hold what starts in them."""
        return self.V(t, x) - self.delta * t


class OwnOperations(ValueFunction):
    """V as the torch operations that it runs at one (t, x): its gradient is theirs, by torch's derivative of each.

    They are traced once: a V that changes with the calls is what it was then. On batches, where nothing is proved, it
    is the declared V itself.

    What V says of its gradient has no say here: an autograd.Function with another backward pass, hooks, `detach` and
    `no_grad` leave no trace among the operations of V itself, and `value_and_state_gradient` is not asked.
    """

    def __init__(self, V: ValueFunction, domain: tuple[Corner, Corner]):
        super().__init__()
        self.declared, self.graph = V, BoundedFunction(lambda t, x: (V(t, x),), domain).graph

    def forward(self, t: Time, x: State) -> PerState:
        return self.graph(t, x)[0] if x.ndim == 1 else self.declared(t, x)

    def value_and_state_gradient(self, t: Time, x: State) -> tuple[PerState, State]:
        own = x.ndim == 1
        return super().value_and_state_gradient(t, x) if own else self.declared.value_and_state_gradient(t, x)


class OwnConstraints(Constraints):
    """Constraints as the torch operations that they run at one x, traced once; on batches, the declared ones."""

    def __init__(self, constraints: Constraints, domain: tuple[Corner, Corner]):
        super().__init__()
        traced = BoundedFunction(lambda t, x: (constraints(x),), domain)
        self.declared, self.graph, self.operators = constraints, traced.graph, traced.operators
        self.names = constraints.names

    def forward(self, x: State) -> Tensor:
        return self.graph(x.new_zeros(()), x)[0] if x.ndim == 1 else self.declared(x)


def own_operations(V: ValueFunction, domain: tuple[Corner, Corner]) -> OwnOperations:
    """V as its operations, traced unless it is so already."""
    return V if isinstance(V, OwnOperations) else OwnOperations(V, domain)


def own_constraints(constraints: Constraints, domain: tuple[Corner, Corner]) -> OwnConstraints:
    """Constraints as their operations, traced unless they are so already."""
    return constraints if isinstance(constraints, OwnConstraints) else OwnConstraints(constraints, domain)


def bounded_condition(condition: DecreaseCondition, domain: tuple[Corner, Corner], degree: int = 2) -> BoundedFunction:
    """(c, W, Ẇ), and h where there are constraints, with bounds on boxes; V̇ is that of V's own operations.

    So c ≤ 0 proves that V falls, whatever gradient V declares; the control law is the one that runs.
    """
    declared = condition.V
    try:
        condition.V = own_operations(declared, domain)
        h = None if condition.constraints is None else own_constraints(condition.constraints, domain)
        return BoundedFunction(lambda t, x: (*condition.parts(t, x), *([] if h is None else [h(x)])), domain, degree)
    finally:
        condition.V = declared


def require_own_gradient(V: ValueFunction, domain: tuple[Corner, Corner], points: int = 500) -> None:
    """Refuse a V that declares another gradient than that of its own operations: training and control would use it.

    The difference of the two is bounded, rounding included, at random points of the domain. What differs nowhere but
    in a small part of the domain can escape; a proof does not rest on this check, but on bounded_condition.

    Raises:
        UsageError: the bounds at a point exclude 0.
    """
    own = own_operations(V, domain)
    V = own.declared

    def difference(t: Time, x: State) -> tuple[Tensor, Tensor, Tensor]:
        (V_t, V_x), true = gradients(V, t, x), torch.hstack(gradients(own, t, x))
        declared = torch.stack([torch.hstack([V_t, V_x]), torch.hstack([V_t, V.value_and_state_gradient(t, x)[1]])])
        return declared - true, declared, true

    (lower, upper), generator = domain, torch.Generator().manual_seed(0)
    at = lower + (upper - lower) * torch.rand(points, len(lower), generator=generator, dtype=torch.float64)
    (low, high), (declared, _), (true, _) = BoundedFunction(difference, domain, degree=1).bounds(at, at)
    wrong = torch.nonzero((low > 0) | (high < 0)).tolist()
    if wrong:
        k, way, axis = wrong[0]
        raise UsageError(
            f"Expected a V whose gradient is its derivative, got ∂V/∂{f'x[{axis - 1}]' if axis else 't'} = "
            f"{float(declared[k, way, axis]):.6g} where V's own operations give {float(true[k, axis]):.6g}, at "
            f"(t, x) = {[round(y, 6) for y in at[k].tolist()]}; mend its backward pass, detach, hooks or "
            "value_and_state_gradient."
        )
