"""The condition that a sound certificate proves, as a function of (t, x), and its bounds."""

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from jaxtyping import Bool
from torch import Tensor, nn

from lyapnet.base.errors import UsageError
from lyapnet.base.types import Control, Corner, PerState, Points, State, Time
from lyapnet.loop.rollout import ClosedLoop
from lyapnet.prover.bounded_readings import BoundedReadings
from lyapnet.prover.bounds import BoundedFunction, Bounds
from lyapnet.prover.boxes import random_points
from lyapnet.prover.readings import Readings, Run, simulate_runs
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

    c ≤ 0 implies V̇ ≤ δ − α ℓ for every disturbance d of ẋ with |d_i| ≤ w_i, since V_xᵀd ≤ Σ_i w_i |∂V/∂x_i|.

    Args:
        closed_loop: the system, its cost, and a control law that V defines.
        alpha: α in (0, 1], the share of the running cost by which V must fall.
        delta: δ ≥ 0, in cost per second. Near the goal all other terms tend to 0, and bounds of them prove c ≤ 0 only
            with δ > 0.
        constraints: h; c ≤ 0 is required only where h(x) ≤ 0.
        disturbance: w ≥ 0, (n,), in the units of ẋ; None means no disturbance.
        readings: at which times u is computed and then held; None: u = policy(t, x) at every t.
    """

    proves: ClassVar[str] = "above"  # name of its proof in a file of kept proofs
    partial: ClassVar[bool] = False  # whether a proof is of use that ends below the wanted level
    disturbance: State | None

    def __init__(
        self,
        closed_loop: ClosedLoop,
        alpha: float,
        delta: float,
        constraints: Constraints | None = None,
        disturbance: State | None = None,
        readings: Readings | None = None,
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
        sizes = (closed_loop.system.n, closed_loop.system.m)
        if readings is not None and (len(readings.errors), len(readings.control_errors)) != sizes:
            raise UsageError(
                f"Expected errors of {sizes[0]} states and {sizes[1]} controls, got {len(readings.errors)} and "
                f"{len(readings.control_errors)}; give one for each, or 0."
            )
        self.closed_loop, self.V, self.alpha, self.delta = closed_loop, closed_loop.V, alpha, delta
        self.constraints, self.readings = constraints, readings
        self.register_buffer("disturbance", disturbance)

    @property
    def n(self) -> int:
        """The number of states."""
        return self.closed_loop.system.n

    @property
    def facts(self) -> dict[str, Any]:
        """The numbers that define the condition for a given closed loop, as plain data."""
        w = None if self.disturbance is None else self.disturbance.tolist()
        return {"alpha": self.alpha, "delta": self.delta, "disturbance": w, **self.facts_of_readings}

    @property
    def facts_of_readings(self) -> dict[str, Any]:
        """The numbers that define the readings; none if u is read at every t."""
        return {} if self.readings is None else {"readings": self.readings.facts}

    def forward(self, t: Time, x: State) -> PerState:
        return self.parts(t, x)[0]

    def parts(self, t: Time, x: State) -> tuple[PerState, PerState, PerState]:
        """(c, W, Ẇ) with Ẇ = V_t + V_xᵀ(f + g u) + Σ_i w_i |∂V/∂x_i| − δ = c − α ℓ; so c ≤ 0 implies Ẇ ≤ 0 if ℓ ≥ 0.

        If u minimises a cost, the third part may be larger than Ẇ; see `decrease`.
        """
        paid, fall = self.decrease(t, x)
        return paid - self.delta, self.height(t, x), fall - self.delta

    def parts_under(self, t: Time, x: State, u: Control) -> tuple[PerState, PerState, PerState]:
        """(c, W, Ẇ) as in `parts`, for another control than policy(t, x)."""
        paid, fall = self._decrease_under(t, x, u)
        return paid - self.delta, self.height(t, x), fall - self.delta

    def decrease(self, t: Time, x: State) -> tuple[PerState, PerState]:
        """(V̇ + αℓ, an upper bound of V̇) with V̇ = V_t + V_xᵀ(f + g u) + Σ_i w_i |∂V/∂x_i|.

        If u minimises ℓ + bᵀu, then ℓ = q + h − bᵀu with the minimum h, a concave function of b whose slope is u. So

            V̇ + αℓ = V_t + V_xᵀf + (gᵀV_x − αb)ᵀu + α(q + h),     V̇ ≤ V_t + V_xᵀf + (gᵀV_x − b)ᵀu + h,

        since ℓ ≥ q. The law's b is gᵀV_x, so the factors of u nearly vanish (for α = 1), and the width of the bounds of
        u hardly matters.
        """
        loop = self.closed_loop
        least = None
        if isinstance(loop.policy, ValuePolicy) and loop.policy.cost is loop.cost:  # else u may minimise another cost
            least = loop.policy.least(t, x)
        if least is None:
            return self._decrease_under(t, x, loop.policy(t, x))
        V_x = self.V.value_and_state_gradient(t, x)[1]
        drift = self._add_disturbance(gradients(self.V, t, x)[0] + drift_lie_derivative(loop.system, x, V_x), t, x)
        slope, (u, b, value) = input_lie_derivative(loop.system, x, V_x), least
        paid = drift + ((slope - self.alpha * b) * u).sum(-1) + self.alpha * (loop.cost.state(x) + value)
        return paid, drift + ((slope - b) * u).sum(-1) + value

    def _decrease_under(self, t: Time, x: State, u: Control) -> tuple[PerState, PerState]:
        """(V̇ + αℓ, V̇) for a given control."""
        loop = self.closed_loop
        fall = self._add_disturbance(time_derivative(self.V, loop.system, t, x, u), t, x)
        return fall + self.alpha * loop.cost.running(x, u), fall

    def _add_disturbance(self, fall: PerState, t: Time, x: State) -> PerState:
        return fall if self.disturbance is None else fall + self.worst_push(self.V.value_and_state_gradient(t, x)[1])

    def worst_push(self, slope: State) -> PerState:
        """Σ_i w_i |∂V/∂x_i| with the slope ∂V/∂x, the most that a disturbance adds to V̇."""
        assert self.disturbance is not None
        return (self.disturbance * slope.abs()).sum(-1)

    def search_box(self, domain: tuple[Corner, Corner]) -> tuple[Tensor, Tensor]:
        """The box of the points of `values`: the domain of (t, x); if u is held, with the axis a/span ∈ [0, 1]."""
        if self.readings is None:
            return domain
        lower, upper = domain
        return torch.cat([lower, lower.new_zeros(1)]), torch.cat([upper, upper.new_ones(1)])

    def values(self, points: Points) -> tuple[PerState, PerState]:
        """(c, W) at points (t, x); c is −∞ at states that a constraint excludes.

        If u is held, the points are (t̂, x̂, a/span): u is read at (t̂, x̂), c is the largest of some closed loops at
        t̂ + a, where 0 ≤ a ≤ Readings.span(t̂), and W is that at (t̂, x̂).
        """
        t, x, now = points[:, 0], points[:, 1:], points[:, 1:]
        if self.readings is None:
            c = self(t, x)
        else:
            c, run = self.after_reading(self.readings, points)
            x, now = x[:, :-1], run.x
        return torch.where(self.excluded(now), -torch.inf, c), self.height(t, x)

    def point_of(self, t: float, x: Sequence[float], after: float) -> Points:
        """The point of `values` at (t, x), `after` seconds after the reading there if u is held; (1, …)."""
        point = torch.tensor([t, *x], dtype=torch.float64)
        if self.readings is None:
            return point[None]
        return torch.cat([point, after / self.readings.span(point[:1]).clamp_min(1e-9)])[None]

    def parts_of_point(self, point: Corner) -> tuple[float, list[float], float]:
        """(t, x, seconds after the reading) of a point of `values`: the inverse of `point_of`."""
        t, x = point[:1], point[1 : 1 + self.n].tolist()
        return float(t), x, 0.0 if self.readings is None else float(point[-1:] * self.readings.span(t))

    def after_reading(self, readings: Readings, points: Points) -> tuple[PerState, Run]:
        """At points (t̂, x̂, a/span): c at t̂ + a, and the run, of the closed loop of simulate_runs with the largest c."""
        run = simulate_runs(self.closed_loop, readings, points[:, 0], points[:, 1:-1], points[:, -1])
        c = self.parts_under(run.t, run.x, run.u)[0]
        worst = c.argmax(0, keepdim=True)
        return c.gather(0, worst)[0], Run(*(
            each.gather(0, worst.reshape(*worst.shape, *(1,) * (each.ndim - c.ndim)).expand(1, *each.shape[1:]))[0]
            for each in run
        ))  # fmt: skip

    def excluded(self, x: State) -> Bool[Tensor, "*batch"]:
        """Whether a constraint excludes a state."""
        if self.constraints is None:
            return torch.zeros(x.shape[:-1], dtype=torch.bool)
        return self.constraints.worst(x) > 0

    def height(self, t: Time, x: State) -> PerState:
        """W(t, x) = V(t, x) − δt; closed loops stay in a sublevel set of W on which Ẇ ≤ 0."""
        return self.V(t, x) - self.delta * t


class OwnOperations(ValueFunction):
    """V as the torch operations that it performs at one (t, x), traced once; its gradient is their derivative.

    The gradient that V declares has no effect here: the trace of V's value contains no backward pass of an
    autograd.Function, no hooks, no `detach` and no `no_grad`, and `value_and_state_gradient` of V is not called. On
    batches, which proofs do not use, this is the declared V.
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


def bounded_condition(
    condition: DecreaseCondition, domain: tuple[Corner, Corner], degree: int = 2, level: float = float("inf")
) -> Bounds:
    """(c, W, Ẇ), and h if there are constraints, with bounds on boxes of `DecreaseCondition.search_box`.

    V̇ is the derivative of V's traced operations, so that c ≤ 0 proves that V falls even if V declares a wrong gradient.
    The control law is the one that runs, with the declared gradient. If u is held, the bounds hold for all controls
    that the readings allow.

    Args:
        level: closed loops have been in {W ≤ level} since t = 0; of use if u is held.
    """
    declared = condition.V
    try:
        condition.V = own_operations(declared, domain)
        h = None if condition.constraints is None else own_constraints(condition.constraints, domain)
        if condition.readings is None:
            return BoundedFunction(
                lambda t, x: (*condition.parts(t, x), *([] if h is None else [h(x)])), domain, degree
            )  # fmt: skip
        loop, (lower, upper) = condition.closed_loop, domain
        no_width = torch.nonzero((upper == lower)[1:]).flatten().tolist()  # ignorable states and constants
        return BoundedReadings(
            lambda t, x, u: (*condition.parts_under(t, x, u), *([] if h is None else [h(x)])), loop, condition.readings,
            domain, condition.height, level, [*loop.system.constants, *no_width], condition.disturbance, degree,
        )  # fmt: skip
    finally:
        condition.V = declared


def require_own_gradient(V: ValueFunction, domain: tuple[Corner, Corner], points: int = 500) -> None:
    """Refuse a V whose declared gradient, which training and control use, is not the derivative of its operations.

    The difference of the two is bounded, including rounding, at random points of the domain, so a difference in a small
    part of the domain can be missed. Proofs do not depend on this check, as bounded_condition uses the derivative.

    Raises:
        UsageError: at a point, the bounds of the difference exclude 0.
    """
    own = own_operations(V, domain)
    V = own.declared

    def difference(t: Time, x: State) -> tuple[Tensor, Tensor, Tensor]:
        (V_t, V_x), true = gradients(V, t, x), torch.hstack(gradients(own, t, x))
        declared = torch.stack([torch.hstack([V_t, V_x]), torch.hstack([V_t, V.value_and_state_gradient(t, x)[1]])])
        return declared - true, declared, true

    at = random_points(*domain, points, torch.Generator().manual_seed(0))
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
