"""Control laws that are defined by a value function."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from lyapnet.base.errors import UsageError
from lyapnet.base.interpolation import Curve
from lyapnet.base.linear_algebra import apply, convex_or, multiply
from lyapnet.base.types import Control, PerState, State, Time
from lyapnet.task.cost import Cost
from lyapnet.task.cost.base import quadratic_form
from lyapnet.task.problem import Problem, Response
from lyapnet.task.sets import ControlSet, about_control
from lyapnet.task.systems import ControlSystem
from lyapnet.value.calculus import ValueFunction, drift_lie_derivative, gradients, input_lie_derivative
from lyapnet.value.derivatives import jacobian
from lyapnet.value.expansions import held_control, minimise_over_controls, riccati
from lyapnet.value.risk import equivalent_derivatives

DESCENTS = 3  # Newton steps of the lookahead law
DESCENTS_WITH_CONSTRAINTS = 5  # the same with constraints, near which V is steep
SHARES = (1.0, 0.5, 0.25, 0.1)  # step sizes of the line search in each Newton step


class PolicyOutput(NamedTuple):
    """A control with the value and state gradient of V at the same (t, x)."""

    u: Control
    value: PerState
    state_gradient: State  # V_x


class LeastCost(NamedTuple):
    """A control as a minimum: (u − u*)ᵀR(u − u*) + s(u) is value − bᵀu."""

    u: Control
    b: Control
    value: PerState


class ValuePolicy(nn.Module):
    """u = policy(t, x), a control law that V defines."""

    held: bool = False  # whether the law is for controls that are held for Δt from t on
    origin: str = ""  # where V and u come from, if they were imported
    precision: str | None = None  # floating-point format of u for proofs that include its rounding; None: real numbers
    system: ControlSystem
    cost: Cost
    controls: ControlSet
    V: ValueFunction

    def __init__(self, problem: Problem, V: ValueFunction):
        super().__init__()
        self.system, self.cost, self.controls, self.V = problem.system, problem.cost, problem.controls, V

    def with_value(self, t: Time, x: State) -> PolicyOutput:
        """u, V and V_x; a law that needs V_x for u computes it only once."""
        return PolicyOutput(self(t, x), *self.V.value_and_state_gradient(t, x))

    def least(self, t: Time, x: State) -> LeastCost | None:
        """u and its cost as a minimum, for bounds; None if these need no special rule for u(t, x) and ℓ(x, u)."""
        return None


class HJBPolicy(ValuePolicy):
    """u*(t, x) = argmin over u ∈ U of ℓ(x, u) + V_xᵀ(f + gu); with U = ℝᵐ it is −½ R(x)⁻¹ g(x)ᵀ V_x(t, x).

    Raises:
        UsageError: the system is not control-affine.
    """

    def __init__(self, problem: Problem, V: ValueFunction):
        _require_affine(problem, "hjb")
        super().__init__(problem, V)

    def forward(self, t: Time, x: State) -> Control:
        return self._minimise(x, self.V.value_and_state_gradient(t, x)[1])

    def with_value(self, t: Time, x: State) -> PolicyOutput:
        if type(self).forward is not HJBPolicy.forward:  # a subclass with its own law
            return super().with_value(t, x)
        value, V_x = self.V.value_and_state_gradient(t, x)
        return PolicyOutput(self._minimise(x, V_x), value, V_x)

    def _minimise(self, x: State, V_x: State) -> Control:
        b = input_lie_derivative(self.system, x, V_x)
        rest = self.cost.rest_at(x)
        if self.controls.limited or self.cost.nonquadratic is not None:
            R = self.cost.R(x)
            return self.cost.best_control(self.controls, R, about_control(R, b, rest))
        u = -0.5 * self.cost.solve_R(x, b)  # a constant R is inverted only once
        return u if rest is None else u + rest

    def least(self, t: Time, x: State) -> LeastCost | None:
        if type(self).forward is not HJBPolicy.forward or type(self)._minimise is not HJBPolicy._minimise:
            return None
        rest, R = self.cost.rest_at(x), self.cost.R(x)
        b = input_lie_derivative(self.system, x, self.V.value_and_state_gradient(t, x)[1])
        minimum = self.cost.least(self.controls, R, about_control(R, b, rest))
        if minimum is None:
            return None
        return LeastCost(minimum.u, b, minimum.value if rest is None else minimum.value + quadratic_form(R, rest))


def _require_affine(problem: Problem, law: str) -> None:
    """Refuse a system that is not control-affine, for a law that is a formula of f and g."""
    if not problem.system.affine:
        raise UsageError(
            f"Expected a control-affine system for the law {law}, got {problem.system.title}, which is not; take "
            "sampled or lookahead."
        )


class SontagPolicy(ValuePolicy):
    """Sontag's universal formula, weighted by the cost: with a = V_t + LfV, b = LgV and σ = bᵀR⁻¹b,

        u = −(a + √(a² + qσ))/σ · R⁻¹b,   and 0 where b = 0,

    so that V̇ = −√(a² + qσ) wherever b ≠ 0: V decreases for every control Lyapunov function V, even if it is far from
    the value function. With the true value function it is the HJB policy. Close to the goal a and σ are small
    differences of rounded numbers: in float32, u chatters within about ‖x‖ = 1e-4.

    It requires U = ℝᵐ. With a target, u − u* replaces u, and f + gu* replaces f.

    Raises:
        ValueError: the problem limits its controls.

    Sources: Sontag, "A 'universal' construction of Artstein's theorem on nonlinear stabilization", Systems & Control
    Letters 1989 (σ instead of q); Primbs, Nevistić, Doyle, "Nonlinear optimal control: a control Lyapunov
    function and receding horizon perspective", Asian Journal of Control 1999 (this form).
    """

    def __init__(self, problem: Problem, V: ValueFunction):
        _require_affine(problem, "sontag")
        if problem.controls.limited:
            raise ValueError(
                f"Expected controls without limits for Sontag's formula, got {type(problem.controls).__name__}; take "
                "rollout.policy=hjb or sampled."
            )
        if problem.cost.nonquadratic is not None:
            raise ValueError(
                "Expected controls that cost uᵀRu for Sontag's formula, got more; take rollout.policy=hjb or sampled."
            )
        super().__init__(problem, V)

    def forward(self, t: Time, x: State) -> Control:
        V_t, V_x = gradients(self.V, t, x)
        LgV = input_lie_derivative(self.system, x, V_x)
        direction = self.cost.solve_R(x, LgV)
        a, rest = V_t + drift_lie_derivative(self.system, x, V_x), self.cost.rest_at(x)
        if rest is not None:
            a = a + (LgV * rest).sum(-1)
        q = self.cost.state(x)
        sigma = (LgV * direction).sum(-1)
        # √ has no derivative at 0, its value at the goal: keep the argument positive
        root = torch.sqrt(a**2 + q * sigma + torch.finfo(x.dtype).tiny)
        # For a < 0 the quotient equals q/(root − a), finite as σ → 0; both branches have safe denominators.
        falling = a < 0
        gain_falling = q / torch.where(falling, root - a, 1.0)
        gain_rising = (a + root) / torch.where(falling | (sigma <= 0), 1.0, sigma)
        gain = torch.where(falling, gain_falling, torch.where(sigma > 0, gain_rising, 0.0))
        u = -gain[..., None] * direction
        return u if rest is None else u + rest


class SampledPolicy(ValuePolicy):
    """The law of a controller that holds u for Δt: the minimiser of ∫ℓ + V(t + Δt, F(x, u)) over u ∈ U,

        u = argmin over u ∈ U of ½ uᵀ(ℓ_uu + Δt BᵀHB)u + (BᵀV_x(t + Δt, F(x, 0)) + ℓ_u)ᵀu,

    for a V with curvature H, and B = F_u/Δt. F and ∫ℓ are one step of the horizon's method. With Euler steps
    F = x + Δt(f + gu), B = g, ℓ_u = 0, ℓ_uu = 2R, and with U = ℝᵐ the law is −(2R + Δt gᵀHg)⁻¹ gᵀV_x. With V = xᵀP_n x
    it is the optimal law of a linear problem, and finite at any Δt, whereas −½R⁻¹gᵀV_x is unstable under Euler steps if
    Δt λ_max(R⁻¹gᵀHg)/2 exceeds about 2. Both agree as Δt → 0. H is the curvature known to V, or the Riccati
    solution at the goal, or zero without a goal. With a target, u − u* replaces u, and f + gu* replaces f. In a task
    with risk V is replaced by its certainty equivalent over the step, with curvature H (see lyapnet.value.risk).
    """

    held: bool = True

    def __init__(self, problem: Problem, V: ValueFunction):
        super().__init__(problem, V)
        self.problem = problem
        self.riccati: Curve | None = None
        if V.curvature(torch.zeros(()).to(problem.goal)) is None:
            times, n = problem.horizon.times(problem.goal), problem.system.n
            H = riccati(problem).hessian if problem.has_goal else torch.zeros(len(times), n, n)
            if problem.risk and problem.noise is not None and not H.isfinite().all():
                raise UsageError(
                    f"Expected a risk with which E exp(risk · J) is finite at the goal, got {problem.risk:g}; choose a "
                    "smaller risk."
                )
            self.riccati = Curve(times, H.to(problem.goal))

    def forward(self, t: Time, x: State) -> Control:
        after, free = self._after(t), self.problem.response(x)
        V_x, H = self.V.value_and_state_gradient(after, free.x)[1], self._curvature(after, free.x)
        if self.problem.risk and self.problem.noise is not None:
            sigma, dt = self.problem.noise(x), self.problem.horizon.dt
            V_x, H = equivalent_derivatives(V_x, H, sigma, dt, self.problem.risk)
        return held_control(self.problem, x, free, V_x, H)

    def _after(self, t: Time) -> Time:
        """t + Δt, at most T."""
        return (t + self.problem.horizon.dt).clamp(max=self.problem.horizon.duration)

    def _curvature(self, t: Time, x: State) -> Tensor:
        """H, (*batch, n, n)."""
        H = self.V.curvature_at(t, x) if self.riccati is None else self.riccati(t)
        assert H is not None
        return H


class LookaheadPolicy(SampledPolicy):
    """The one-step lookahead law: it minimises with V itself instead of a quadratic model with curvature H,

        u = argmin over u ∈ U of Q(u) = ∫ℓ + V(t + Δt, F(x, u)).

    It starts from the sampled law and takes DESCENTS Newton steps (DESCENTS_WITH_CONSTRAINTS with constraints) with
    Q_uu/Δt = ℓ_uu + Δt BᵀV_xxB, or with H for V_xx if that is not convex. Each step uses the step size of SHARES that
    lowers Q most, or none. It is meant for a V that is steep within one step, as near constraints, where the sampled
    law overshoots.

    Its derivative is that of the minimiser (implicit function theorem), up to the remaining Q_u and to V_xᵀF_uu, which
    is zero with Euler steps. Where Q_uu/Δt does not exceed CONVEX · ℓ_uu, step and derivative are those of the model H,
    and u may not reach the minimiser. In float32 the accuracy of u is limited by the rounding of V in comparisons of Q.

    Source: Bertsekas, Dynamic Programming and Optimal Control, 2017, vol. 1 ch. 6 (one-step lookahead); Nocedal,
    Wright, Numerical Optimization, 2006, ch. 3 (Newton's method with line search).
    """

    def forward(self, t: Time, x: State) -> Control:
        if not self.problem.system.affine:
            with torch.no_grad():
                start = super().forward(t, x)
            return self._minimise(self._after(t), x, start)
        step = _HeldStep(self.problem, self.V, self._after(t), x)
        H = self._curvature(step.after, x)
        with torch.no_grad():
            u = super().forward(t, x)
            for _ in range(DESCENTS if self.problem.constraints is None else DESCENTS_WITH_CONSTRAINTS):
                u = step.descend(u, H)
        if not torch.is_grad_enabled():
            return u
        moved = step.newton(u, H)
        return u + (moved - moved.detach())

    def _minimise(self, after: Time, x: State, start: Control) -> Control:
        """argmin over u ∈ U of ∫ℓ + V(t + Δt, F(x, u)) of a system that is not affine, from the sampled law."""
        problem, dt = self.problem, self.problem.horizon.dt

        def Q(u: Control) -> PerState:
            rate, cost = problem.smooth_rates(x.expand(*u.shape[:-1], -1), u)
            return cost + self.V(after, x + dt * rate) / dt

        return minimise_over_controls(problem, Q, start[None], 2 * problem.cost.R(x))


class _HeldStep:
    """The objective of one step from x with u held, Q(u) = ∫ℓ + V(t + Δt, F(x, u)), and its Newton steps."""

    def __init__(self, problem: Problem, V: ValueFunction, after: Time, x: State):
        self.problem, self.V, self.after, self.x = problem, V, after, x

    def descend(self, u: Control, H: Tensor) -> Control:
        """The best of u and of the points of a line search along the Newton step."""
        direction = self.newton(u, H) - u
        tried = torch.stack([u, *(self.problem.controls.project(u + share * direction) for share in SHARES)])
        paid = self._step_values(tried)
        best, least = u, paid[0]
        for control, cost in zip(tried[1:], paid[1:], strict=True):
            better = cost < least
            best, least = torch.where(better[..., None], control, best), torch.where(better, cost, least)
        return best

    def newton(self, u: Control, H: Tensor) -> Control:
        """The minimiser over U of the quadratic model of Q around u; the curvature is not differentiated."""
        answer = self.problem.response(self.x, u)
        with torch.enable_grad():
            z = answer.x if answer.x.requires_grad else answer.x.detach().requires_grad_()
            V_x = self.V.value_and_state_gradient(self.after, z)[1]
            curvature = self._curvature(answer, z, V_x, H)
        slope = apply(answer.by_control.mT, V_x) + answer.slope
        return self.problem.best_control(curvature / 2, slope - apply(curvature, u.detach()))

    def _step_values(self, u: Control) -> PerState:
        """Q of controls (k, *batch, m)."""
        following, paid = self.problem.step(self.x.expand(*u.shape[:-1], -1), u)
        return paid + self.V(self.after, following)

    def _curvature(self, answer: Response, z: State, V_x: State, H: Tensor) -> Tensor:
        """Q_uu/Δt if it is convex, else with H for V_xx; a constant, computed from the graph of V_x at z."""
        B, paid, dt = answer.by_control.detach(), answer.curvature.detach(), self.problem.horizon.dt
        own = dt * multiply(jacobian(apply(B.mT, V_x), z).detach(), B)
        own = paid + (own + own.mT) / 2
        model = paid + dt * multiply(B.mT, multiply(H.detach(), B))
        return convex_or(own, paid, model)


def known_law(problem: Problem, V: ValueFunction) -> type[ValuePolicy] | None:
    """The control law for which V was trained; None if it is unknown.

    It is `made_for`, if set. A V with a known curvature is otherwise for a law that holds u: the sampled law, or the
    lookahead law with constraints.
    """
    if V.made_for is not None:
        if not issubclass(V.made_for, ValuePolicy):
            name = getattr(V.made_for, "__name__", V.made_for)
            raise UsageError(f"Expected made_for of {type(V).__name__} as a ValuePolicy, got {name}; name a law of V.")
        return V.made_for
    if V.curvature(torch.zeros(()).to(problem.goal)) is None:
        return None
    return SampledPolicy if problem.constraints is None else LookaheadPolicy


def gain_over_step(problem: Problem, V: ValueFunction) -> float:
    """The largest Δt λ_max(R⁻¹gᵀV_xx g)/2 over some states and times: how much V's HJB and sampled law differ.

    The HJB law is −½R⁻¹gᵀV_x; the sampled law has R + ½Δt gᵀV_xx g instead of R.
    """
    X0, times = problem.initial_states, problem.horizon.times(problem.goal)
    x = torch.stack([X0.center, (X0.center + X0.upper) / 2, problem.goal])
    greatest = 0.0
    for t in (times[0], times[len(times) // 2], times[-2]):
        with torch.enable_grad():
            z = x.detach().requires_grad_()
            g = problem.system.affine_model(x, problem.nominal_at(x))[1]
            bent = jacobian(apply(g.mT, V.value_and_state_gradient(t, z)[1].to(g)), z).detach()
        weighted = torch.linalg.solve(problem.cost.R(x).to(bent), multiply(bent, g.to(bent))).nan_to_num()
        greatest = max(greatest, problem.horizon.dt / 2 * float(torch.linalg.eigvals(weighted).real.max()))
    return greatest


POLICIES: dict[str, type[ValuePolicy]] = {
    "hjb": HJBPolicy, "sontag": SontagPolicy, "sampled": SampledPolicy, "lookahead": LookaheadPolicy,
}  # fmt: skip
