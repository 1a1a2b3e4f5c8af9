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
from lyapnet.value.calculus import (
    ValueFunction,
    drift_lie_derivative,
    gradients,
    input_lie_derivative,
    time_derivative,
)
from lyapnet.value.policy import ValuePolicy


class DecreaseCondition(nn.Module):
    """c(t, x) = V_t + V_xᵀ(f + g u) + Σ_i w_i |∂V/∂x_i| + α ℓ(x, u) − δ with u = policy(t, x).

    Where c ≤ 0, V̇ ≤ δ − α ℓ for every disturbance d of ẋ with |d_i| ≤ w_i, since V_xᵀd ≤ Σ_i w_i |∂V/∂x_i|.

    Args:
        closed_loop: the system, its cost, and a control law that V defines.
        alpha: α in (0, 1], the share of the running cost by which V must fall.
        delta: δ ≥ 0, in cost per second. Near the goal all other terms tend to 0; δ > 0 leaves room for bounds.
        constraints: h; c ≤ 0 is required only where h(x) ≤ 0.
        disturbance: w ≥ 0, (n,), in the units of ẋ; None means no disturbance.
    """

    proves: ClassVar[str] = "above"  # the name of its proof in a file of kept proofs
    partial: ClassVar[bool] = False  # whether a proof up to a lower level than the wanted one is useful
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
            raise UsageError(f"Expected delta ≥ 0, got {delta}; give a rate of cost, in cost per second.")
        if closed_loop.V is None:
            raise UsageError(
                "Expected a control law that a V defines, got one without V; certify a law from a value function."
            )
        self.closed_loop, self.V, self.alpha, self.delta = closed_loop, closed_loop.V, alpha, delta
        self.constraints = constraints
        self.register_buffer("disturbance", disturbance)

    @property
    def facts(self) -> dict[str, Any]:
        """The numbers that define the condition for a given closed loop, as plain data."""
        w = None if self.disturbance is None else self.disturbance.tolist()
        return {"alpha": self.alpha, "delta": self.delta, "disturbance": w}

    def forward(self, t: Time, x: State) -> PerState:
        return self.parts(t, x)[0]

    def parts(self, t: Time, x: State) -> tuple[PerState, PerState, PerState]:
        """(c, W, Ẇ) with Ẇ = V_t + V_xᵀ(f + g u) + Σ_i w_i |∂V/∂x_i| − δ = c − α ℓ; so c ≤ 0 implies Ẇ ≤ 0 if ℓ ≥ 0.

        Where u is known as a minimum, the third part may be larger than Ẇ.
        """
        paid, fall = self.decrease(t, x)
        return paid - self.delta, self.height(t, x), fall - self.delta

    def decrease(self, t: Time, x: State) -> tuple[PerState, PerState]:
        """(V̇ + αℓ, V̇ or more) with V̇ = V_t + V_xᵀ(f + g u) + Σ_i w_i |∂V/∂x_i|.

        If u minimises ℓ + bᵀu, then ℓ = q + h − bᵀu with the minimum h, a concave function of b whose slope is u. So

            V̇ + αℓ = V_t + V_xᵀf + (gᵀV_x − αb)ᵀu + α(q + h),     V̇ ≤ V_t + V_xᵀf + (gᵀV_x − b)ᵀu + h,

        as ℓ ≥ q. The law's b is gᵀV_x, so that errors of u in bounds hardly count.
        """
        loop = self.closed_loop
        least = None
        if isinstance(loop.policy, ValuePolicy) and loop.policy.cost is loop.cost:  # u may be made for another ℓ
            least = loop.policy.least(t, x)
        if least is None:
            u = loop.policy(t, x)
            fall = self._pushed(time_derivative(self.V, loop.system, t, x, u), t, x)
            return fall + self.alpha * loop.cost.running(x, u), fall
        V_x = self.V.value_and_state_gradient(t, x)[1]
        drift = self._pushed(gradients(self.V, t, x)[0] + drift_lie_derivative(loop.system, x, V_x), t, x)
        slope, (u, b, value) = input_lie_derivative(loop.system, x, V_x), least
        paid = drift + ((slope - self.alpha * b) * u).sum(-1) + self.alpha * (loop.cost.state(x) + value)
        return paid, drift + ((slope - b) * u).sum(-1) + value

    def _pushed(self, fall: PerState, t: Time, x: State) -> PerState:
        return fall if self.disturbance is None else fall + self.worst_push(self.V.value_and_state_gradient(t, x)[1])

    def worst_push(self, slope: State) -> PerState:
        """Σ_i w_i |∂V/∂x_i|, the most that a disturbance adds to V̇."""
        assert self.disturbance is not None
        return (self.disturbance * slope.abs()).sum(-1)

    def excluded(self, x: State) -> Bool[Tensor, "*batch"]:
        """Whether a constraint excludes a state."""
        if self.constraints is None:
            return torch.zeros(x.shape[:-1], dtype=torch.bool)
        return self.constraints.worst(x) > 0

    def height(self, t: Time, x: State) -> PerState:
        """W(t, x) = V(t, x) − δt; trajectories stay in a sublevel set of W on which Ẇ ≤ 0."""
        return self.V(t, x) - self.delta * t


class OwnOperations(ValueFunction):
    """V as the torch operations that it performs at one (t, x); its gradient is the derivative of these operations.

    The operations are traced once, when this object is made. On batches, which proofs do not use, it is the declared V.

    The gradient that V declares has no effect here: the trace of V's value contains no custom backward pass of an
    autograd.Function, no hooks, no `detach` and no `no_grad`, and `value_and_state_gradient` of V is not called.
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
    """Constraints as the torch operations that they perform at one x, traced once; on batches, the declared ones."""

    def __init__(self, constraints: Constraints, domain: tuple[Corner, Corner]):
        super().__init__()
        traced = BoundedFunction(lambda t, x: (constraints(x),), domain)
        self.declared, self.graph, self.operators = constraints, traced.graph, traced.operators
        self.names = constraints.names

    def forward(self, x: State) -> Tensor:
        return self.graph(x.new_zeros(()), x)[0] if x.ndim == 1 else self.declared(x)


def own_operations(V: ValueFunction, domain: tuple[Corner, Corner]) -> OwnOperations:
    """V as its traced operations; V itself if it is traced already."""
    return V if isinstance(V, OwnOperations) else OwnOperations(V, domain)


def own_constraints(constraints: Constraints, domain: tuple[Corner, Corner]) -> OwnConstraints:
    """Constraints as their traced operations; the constraints themselves if they are traced already."""
    return constraints if isinstance(constraints, OwnConstraints) else OwnConstraints(constraints, domain)


def bounded_condition(condition: DecreaseCondition, domain: tuple[Corner, Corner], degree: int = 2) -> BoundedFunction:
    """(c, W, Ẇ), and h if there are constraints, with bounds on boxes.

    V̇ is the derivative of V's traced operations, so that c ≤ 0 proves that V falls even if V declares a wrong gradient.
    The control law is the one that runs, with the declared gradient.
    """
    declared = condition.V
    try:
        condition.V = own_operations(declared, domain)
        h = None if condition.constraints is None else own_constraints(condition.constraints, domain)
        return BoundedFunction(lambda t, x: (*condition.parts(t, x), *([] if h is None else [h(x)])), domain, degree)
    finally:
        condition.V = declared


def require_own_gradient(V: ValueFunction, domain: tuple[Corner, Corner], points: int = 500) -> None:
    """Refuse a V whose declared gradient, which training and control use, is not the derivative of its operations.

    The difference of the two is bounded, including rounding, at random points of the domain. A difference in a small
    part of the domain can be missed. Proofs do not depend on this check: bounded_condition uses the derivative.

    Raises:
        UsageError: at a point, the bounds of the difference exclude 0.
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
