"""The optimal control problem, the common argument of optima, rollouts, certificates and environments."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from lyapnet.base.contracts import check_function, check_memory, check_result, copied
from lyapnet.base.errors import UsageError
from lyapnet.base.findings import Findings
from lyapnet.base.linear_algebra import apply, convex_or
from lyapnet.base.types import Control, PerState, State
from lyapnet.task.constraints import Constraints
from lyapnet.task.contracts import (
    check_shapes_of_controls,
    check_shapes_of_cost,
    check_shapes_of_system,
    contracts_of_cost,
    contracts_of_system,
)
from lyapnet.task.cost import Cost, PenaltyCost, reason_for_no_goal
from lyapnet.task.domain import Border, Domain, DomainCost, as_written, find_borders, size_of, within
from lyapnet.task.horizon import TABLEAUX, Horizon, weighted_sum
from lyapnet.task.mapped_controls import MappedControls, mapped, written_system
from lyapnet.task.noise import Noise, SystemNoise
from lyapnet.task.sets import Box, ControlSet
from lyapnet.task.systems import ControlSystem, functions_of_state

GOAL_TEST_STEPS = 200  # largest number of steps in the test whether a task has a goal
TEST_STATES = 64  # number of states at which users' functions are tested
LIMITS = {"lower limits": -1, "upper limits": 1}  # keys in a record ↦ sign of the infinity that means no limit
RECORD_TOLERANCE = 1e-4  # relative to a component's largest entry: difference below which recorded numbers agree


class Response(NamedTuple):
    """One step with u held: F to first order in u, and ℓ to second order, around some u."""

    x: State  # F(x, u), the next state
    by_control: Tensor  # F_u/Δt (*batch, n, m); with Euler g(x)
    slope: Control  # ℓ_u of the mean ℓ over the step
    curvature: Tensor  # ℓ_uu (*batch, m, m), symmetric positive definite; with Euler 2R
    u: Tensor | None  # (*batch, m), the control around which it is; None: zero


class Problem(nn.Module):
    """minimise J(x₀) = ∫₀ᵀ ℓ(x, u) dt + φ(x(T)) over u(t) ∈ U subject to ẋ = f(x) + g(x)u, h(x) ≤ 0, for all x₀ ∈ X₀.

    With noise σ, dx = (f + gu) dt + σ(x) dW, and the expectation E J(x₀) is minimised; with a risk θ > 0 it is (1/θ)
    log E exp(θ J(x₀)), for which expensive paths count more. Methods about a step, such as `step` and `response`, are
    about the step without noise.

    Args:
        system: f and g.
        cost: ℓ and φ.
        controls: U.
        initial_states: X₀.
        horizon: T, its steps, and their integrator with u held.
        constraints: h; None: there are none.
        noise: σ; None: that of the system, if it has a method `noise(x)`.
        risk: θ in 1/(unit of the cost); 0: the mean cost counts.

    Raises:
        ValueError: the dimension of X₀, or of the cost's goal or rest, differs from that of the system; or the risk is
            negative or not finite.
    """

    system: ControlSystem
    cost: Cost
    controls: ControlSet
    initial_states: Box
    horizon: Horizon
    constraints: Constraints | None
    noise: Noise | None
    risk: float
    findings: Findings

    def __init__(
        self,
        system: ControlSystem,
        cost: Cost,
        controls: ControlSet,
        initial_states: Box,
        horizon: Horizon,
        constraints: Constraints | None = None,
        noise: Noise | None = None,
        risk: float = 0.0,
    ):
        super().__init__()
        if initial_states.dimension != system.n:
            raise ValueError(
                f"Expected initial_states with {system.n} entries ({', '.join(system.state_names)}), got "
                f"{initial_states.dimension}; give one for each."
            )
        for name, expected in (("goal", system.n), ("rest", system.m)):
            given = getattr(cost, name)
            if given is not None and given.shape != (expected,):
                raise UsageError(
                    f"Expected {name} of {type(cost).__name__} of shape ({expected},), got {tuple(given.shape)}; give "
                    "one number for each."
                )
        if isinstance(controls, MappedControls):
            controls = controls.of(written_system(system))
            system, cost = mapped(system, cost, controls, torch.zeros_like(initial_states.lower))
        if not (system.affine or (controls.is_box and controls.limits is not None)):
            raise UsageError(
                f"Expected limits of each control, or none, for a system that is not control-affine, got "
                f"{type(controls).__name__}; take controls.lower and controls.upper for {system.title}."
            )
        self.system, self.cost, self.controls = system, cost, controls
        self.initial_states, self.horizon, self.constraints = initial_states, horizon, constraints
        self.noise = SystemNoise(system, initial_states.center) if noise is None and system.noisy else noise
        if not 0 <= risk < math.inf:
            raise ValueError(f"Expected a finite risk ≥ 0, got {risk}; 0 is the mean cost.")
        self.risk = float(risk)
        self.findings = Findings()

    @property
    def goal(self) -> State:
        """The state (n,) at which q and φ vanish; without a goal the centre of X₀, as a typical state."""
        like = self.initial_states.lower
        if not self.has_goal:
            return self.initial_states.center
        return torch.zeros_like(like) if self.cost.goal is None else self.cost.goal.to(like)

    @property
    def has_goal(self) -> bool:
        """Whether q and φ vanish at the cost's goal, or else at the origin, and are nowhere negative."""
        return not self.no_goal

    @property
    def follows_reference(self) -> bool:
        """Whether the goal moves along a reference; the time on it is then a state."""
        return self.system.reference_time is not None

    @property
    def no_goal(self) -> str:
        """The reason why there is no goal; empty if there is one."""
        if "no_goal" not in self.findings:
            try:
                own = copied(self)
                cost = as_written(own.cost)
                goal = torch.zeros_like(own.initial_states.lower) if cost.goal is None else cost.goal
                self.findings["no_goal"] = reason_for_no_goal(cost, goal, own._typical_states())
            except Exception:  # a user's cost fails; `check` reports that
                return ""
        return self.findings["no_goal"]

    @torch.no_grad()
    def _typical_states(self) -> State:
        """States (b, n) of X₀, and states reached from there by random constant controls in GOAL_TEST_STEPS steps."""
        generator = torch.Generator().manual_seed(0)
        x = self.initial_states.sample(TEST_STATES, generator)
        self.check_shapes(x)  # wrong shapes may broadcast, and then grow in each step
        u = self.controls.project(self.rest_at(x) + torch.randn(TEST_STATES, self.system.m, generator=generator).to(x))
        states, N = [x], min(self.horizon.steps, GOAL_TEST_STEPS)
        for n in range(1, N + 1):
            x = self.step(x, u)[0]
            if n in (N // 2, N):
                states.append(x)
        every = torch.cat(states)
        kept = every.isfinite().all(-1)
        return every[kept if self.domain is None else kept & ~self.domain.left(every[None])]

    @property
    def domain(self) -> Domain | None:
        """The states at which f, g, q and φ are defined; None if all are, or if no domain was determined."""
        domain = getattr(self.system, "domain", None)
        return domain if isinstance(domain, Domain) else None

    @property
    def rest(self) -> Control:
        """The control at rest u* (m,) at the goal, which costs nothing; zero without a target."""
        rest, like = self.cost.rest, self.initial_states.lower
        return like.new_zeros(self.system.m) if rest is None else rest.to(like)

    def rest_at(self, x: State) -> Control:
        """The control at rest at each state, (*batch, m)."""
        rest = self.cost.rest_at(x)
        return (x.new_zeros(self.system.m) if rest is None else rest.to(x)).expand(*x.shape[:-1], -1)

    def nominal_at(self, x: State) -> Control:
        """The control about which dynamics that are not affine are linearised: that at rest, projected onto U."""
        rest = self.rest_at(x)
        return rest if self.system.affine else self.controls.project(rest)

    @property
    def functions_of_state(self) -> dict[str, Callable[[State], Tensor]]:
        """f(x) and g(x) by their names; of a system that is not control-affine, ẋ under the nominal control."""
        return functions_of_state(self.system, self.nominal_at(self.goal))

    def rates(self, x: State, u: Control) -> tuple[State, PerState]:
        """The means of ẋ and ℓ over one step from x with u held, by the integrator of the horizon."""
        rate, cost = self.smooth_rates(x, u)
        return rate, cost if self.cost.nonquadratic is None else cost + self.cost.beside(u)

    def smooth_rates(self, x: State, u: Control) -> tuple[State, PerState]:
        """The same without s(u), the cost of controls beside uᵀRu."""
        own = self.cost.nonquadratic is None  # a user's cost may override `running`
        running = self.cost.running if own else self.cost.smooth_running
        tableau, slopes, costs = TABLEAUX[self.horizon.method], [], []
        for row in tableau.a:
            X = x + self.horizon.dt * weighted_sum(row, slopes) if any(row) else x
            slopes.append(self.system.dynamics(X, u))
            costs.append(running(X, u))
        return weighted_sum(tableau.b, slopes), weighted_sum(tableau.b, costs)

    def step(self, x: State, u: Control) -> tuple[State, PerState]:
        """(F(x, u), ∫ℓ), the next state and the cost of one step with u held; with Euler (x + Δt(f + gu), Δt ℓ)."""
        rate, cost = self.rates(x, u)
        return x + self.horizon.dt * rate, self.horizon.dt * cost

    def smooth_step(self, x: State, u: Control) -> tuple[State, PerState]:
        """The same without s(u), the cost of controls beside uᵀRu, which may have kinks."""
        rate, cost = self.smooth_rates(x, u)
        return x + self.horizon.dt * rate, self.horizon.dt * cost

    def best_control(self, W: Tensor, b: Control) -> Control:
        """argmin over u ∈ U of uᵀWu + bᵀu + s(u), (*batch, m), for W (*batch, m, m) and b (*batch, m)."""
        return self.cost.best_control(self.controls, W, b)

    @property
    def has_linear_law(self) -> bool:
        """Whether argmin over u ∈ U of uᵀWu + bᵀu + s(u) is −½W⁻¹b: U = ℝᵐ and s = 0."""
        return not self.controls.limited and self.cost.nonquadratic is None

    def response(self, x: State, u: Control | None = None) -> Response:
        """The derivatives of one step from x by u, without s(u), the cost of controls beside uᵀRu.

        Args:
            u: the control at which they are taken; None: u*, the control at rest.
        """
        if self.horizon.method == "euler":
            return self._euler_response(x, u)
        n, recording = self.system.n, torch.is_grad_enabled()
        around = self.cost.rest_at(x) if u is None else u
        if u is None:
            u = self.nominal_at(x)
            around = around if self.system.affine else u
        with torch.enable_grad():
            u = u if recording and u.requires_grad else u.detach().requires_grad_()
            # one copy of u for each component of ẋ: all rows of the Jacobian in one backward pass
            copies = u.expand(n, *u.shape)
            rate = self.smooth_rates(x.expand(n, *x.shape), copies)[0]
            rows = (
                torch.eye(n, dtype=rate.dtype, device=rate.device).reshape(n, *[1] * (rate.ndim - 2), n).expand_as(rate)
            )
            (by_control,) = torch.autograd.grad(rate, copies, rows, create_graph=recording)
            (slope,) = torch.autograd.grad(self.smooth_rates(x, u)[1].sum(), u, create_graph=True)
            bends = [torch.autograd.grad(s.sum(), u, create_graph=True)[0] for s in slope.unbind(-1)]
        parts = (
            x + self.horizon.dt * rate[0],
            by_control.movedim(0, -2),
            slope,
            self._convex_curvature(torch.stack(bends, -2), x),
        )
        after, by_control, slope, curvature = (part if recording else part.detach() for part in parts)
        return Response(after, by_control, slope, curvature, around)

    def _convex_curvature(self, curvature: Tensor, x: State) -> Tensor:
        """ℓ_uu, or 2R if ℓ_uu is not clearly positive definite."""
        least = 2 * self.cost.R(x)
        return convex_or((curvature + curvature.mT) / 2, least, least)

    def _euler_response(self, x: State, u: Control | None) -> Response:
        rest = self.cost.rest_at(x)
        if not self.system.affine:
            u, R2 = self.nominal_at(x) if u is None else u, 2 * self.cost.R(x)
            after, by_control = x + self.horizon.dt * self.system.dynamics(x, u), self.system.affine_model(x, u)[1]
            return Response(after, by_control, apply(R2, u if rest is None else u - rest), R2, u)
        if u is None:
            rest = None if rest is None else rest.expand(*x.shape[:-1], -1)
            rate = self.system.f(x) if rest is None else self.system.dynamics(x, rest)
            zero = x.new_zeros(self.system.m).expand(*x.shape[:-1], -1)
            return Response(x + self.horizon.dt * rate, self.system.g(x), zero, 2 * self.cost.R(x), rest)
        after, R2 = x + self.horizon.dt * self.system.dynamics(x, u), 2 * self.cost.R(x)
        return Response(after, self.system.g(x), apply(R2, u if rest is None else u - rest), R2, u)

    def replaced(self, **parts: Any) -> "Problem":
        """The problem with some of its parts replaced; noise that a system declares is replaced with the system."""
        names = ("system", "cost", "controls", "initial_states", "horizon", "constraints")
        other = Problem(**{**{name: getattr(self, name) for name in names}, **parts})
        if "noise" not in parts and not ("system" in parts and isinstance(self.noise, SystemNoise)):
            other.noise = self.noise
        if "risk" not in parts:
            other.risk = self.risk
        if parts.keys().isdisjoint(("cost", "system")):
            other.findings = self.findings
        if "initial_states" in parts:
            other.findings = Findings({name: found for name, found in other.findings.items() if name != "no_goal"})
        return other

    def without_noise(self) -> "Problem":
        """The deterministic problem with the same f and g; the problem itself if it has no noise."""
        if self.noise is None:
            return self
        other = self.replaced()
        other.noise = None
        return other

    def in_steps(self, **changes: Any) -> "Problem":
        """The problem with some of its horizon's steps, dt and method replaced."""
        return self.replaced(horizon=replace(self.horizon, **changes))

    def relaxed(self, weight: float = 0.0) -> "Problem":
        """The problem that training solves, with a penalty for the constraints; the problem itself without constraints.

        Args:
            weight: penalty weight, in cost per second at h = 0; training from a config chooses it.
        """
        if self.constraints is None:
            return self
        cost = PenaltyCost(self.cost, self.constraints, self.constraints.margin, weight, self.horizon.dt)
        return self.replaced(cost=cost.to(self.initial_states.lower))

    def borders(self) -> list[Border]:
        """The borders of each state beyond which f, g, q or φ are undefined; empty if they are finite everywhere."""
        own = copied(self)
        system, cost = own.system, own.cost
        functions = {name.removesuffix("(x)"): function for name, function in own.functions_of_state.items()}
        functions |= {"q": cost.state, "φ": cost.terminal}
        try:
            return find_borders(functions, own.initial_states, system.state_names)
        except Exception:  # a user's function may raise an error at such states
            return []

    @torch.no_grad()
    def within(self, borders: Sequence[Border]) -> "Problem":
        """The problem with the domain between some borders.

        Beyond them functions are evaluated at the nearest state just inside, and a step at a distance of a state's size
        costs about as much as a whole closed loop.
        """
        if not borders:
            return self
        box, horizon = self.initial_states, self.horizon
        domain = Domain(self.system.state_names, size_of(box), borders)
        x = box.sample(TEST_STATES, torch.Generator().manual_seed(0))
        running, terminal = (part.abs().mean() for part in (self.cost.state(x), self.cost.terminal(x)))
        price = float(horizon.duration * running + terminal) or 1.0
        cost = DomainCost(self.cost, domain, price, horizon.dt)
        return self.replaced(system=within(self.system, domain), cost=cost.to(box.lower))

    def check(self) -> None:
        """Check the contracts of f, g, the cost and the controls on states of X₀, in float64.

        Raises:
            UsageError: a contract is broken; says which one, and where.
        """
        own = copied(self)
        system, cost, n, m = own.system, own.cost, own.system.n, own.system.m
        system.check_coordinates()
        name = type(system).__name__
        generator = torch.Generator().manual_seed(0)
        x = own.initial_states.sample(256, generator)
        if isinstance(own.controls, MappedControls):
            own.controls.check(x, m)
        own.check_shapes(x[:TEST_STATES])
        for contract in (*contracts_of_system(system), *contracts_of_cost(cost, m)):
            check_function(contract.name, contract.function, [x[:TEST_STATES]], contract.shape)
        if own.noise is not None:
            check_function(f"{name}.noise(x)", own.noise, [x[:TEST_STATES]], (n, own.noise.sources))
        cost.check(x)
        own._check_constraints(x)
        b = torch.randn(len(x), m, generator=generator, dtype=torch.float64)
        if not system.affine:
            u = own.controls.project(b[:TEST_STATES])
            check_function(f"{name}.dynamics(x, u)", system.dynamics, [x[:TEST_STATES], u], (n,))
        elif not torch.allclose(system.dynamics(x, b), system.f(x) + apply(system.g(x), b), rtol=1e-6):
            raise UsageError(
                f"Expected {name}.dynamics(x, u) = f(x) + g(x)u, got another sum; a class that overrides f or g of "
                "another system may have to override its dynamics too."
            )
        u = own.best_control(cost.R(x), 100 * b)
        if not torch.allclose(u, own.controls.project(u), rtol=1e-6, atol=1e-9):
            raise UsageError(
                f"Expected {type(own.controls).__name__}.minimise(R, b) in the set, got a control outside, which "
                "project(u) moves; correct one of them."
            )
        check_memory(
            own.parts, lambda: own.call(x[:TEST_STATES]), lambda: own.call(own.initial_states.ends(TEST_STATES))
        )

    def check_shapes(self, x: State) -> None:
        """Check the shapes of f, g, ẋ, q, φ, R and of U's functions at states (b, n), in their precision, on the CPU.

        Raises:
            UsageError: one is wrong; says which one, and its shape.
        """
        check_shapes_of_system(self.system, x)
        check_shapes_of_cost(self.cost, self.system.m, x)
        check_shapes_of_controls(self.controls, x.new_ones(len(x), self.system.m))

    @property
    def parts(self) -> dict[str, nn.Module]:
        """The parts that users may have written, by their names in messages."""
        parts = (self.system, self.cost, self.controls, self.constraints)
        return {type(part).__name__: part for part in parts if part is not None}

    def call(self, x: State) -> None:
        """Call all functions of the parts at some states, to detect side effects."""
        system, cost = self.system, self.cost
        R, u = cost.R(x), torch.ones_like(x[..., :1]).expand(*x.shape[:-1], system.m)
        u = self.controls.project(self.best_control(R, u))
        _ = system.dynamics(x, u), cost.running(x, u), cost.terminal(x), self.controls.contains(u), self.rates(x, u)
        if self.constraints is not None:
            self.constraints(x)
        if self.noise is not None:
            self.noise(x)

    def _check_constraints(self, x: State) -> None:
        """Check the contract of h, and that states of X₀ satisfy h ≤ 0."""
        if self.constraints is None:
            return
        constraints, name = self.constraints, type(self.constraints).__name__
        if not constraints.names:
            raise UsageError(f"Expected {name}.names with a name for each component of h(x), got none; declare them.")
        check_function(f"h(x) of {name}", constraints, [x[:TEST_STATES]], (len(constraints.names),))
        h = constraints(x)
        outside = (h > 0).any(-1)
        if bool(outside.any()):
            first = int(torch.nonzero(outside)[0])
            raise UsageError(
                f"Expected X₀ within the constraints, got {float(outside.double().mean()):.1%} of its states outside, "
                f"as {x[first].tolist()}, which violates {constraints.names[int(h[first].argmax())]!r}; shrink "
                "initial_states, or widen the constraints."
            )

    def check_value_function(self, V: nn.Module) -> None:
        """Check the contracts of V and V_x at times and states of the problem, in float64.

        Raises:
            UsageError: a contract is broken; says which one, and where.
        """
        name, generator = type(V).__name__, torch.Generator().manual_seed(0)
        own: Any = copied(V).eval()
        x = self.initial_states.sample(TEST_STATES, generator).double().cpu()
        t = self.horizon.duration * torch.rand(TEST_STATES, generator=generator, dtype=torch.float64)
        check_function(f"{name}.forward(t, x)", own, [t, x], ())
        both = f"{name}.value_and_state_gradient(t, x)"
        value, V_x = (
            check_result(f"{both}[{i}]", lambda t, x, i=i: own.value_and_state_gradient(t, x)[i], [t, x], shape)
            for i, shape in enumerate([(), (self.system.n,)])
        )
        leaf = x.clone().requires_grad_()
        with torch.enable_grad():
            (expected,) = torch.autograd.grad(own(t, leaf).sum(), leaf, materialize_grads=True)
        ends = self.initial_states.ends(TEST_STATES).double().cpu()
        check_memory(
            {name: own},
            lambda: own.value_and_state_gradient(t, x),
            lambda: own.value_and_state_gradient(t.flip(0), ends),
        )
        same = torch.allclose(V_x, expected, rtol=1e-6, atol=1e-6 * float(expected.abs().max()))
        if not same or not torch.allclose(value, own(t, x), rtol=1e-6):
            raise UsageError(
                f"Expected {both} as V and its gradient in x, got others than autograd's: correct it, or leave it out."
            )

    def record(self) -> dict[str, list[Any]]:
        """Plain data that identifies the problem in a checkpoint: state names, and values of f, g, the cost and U.

        They are evaluated in float64 at 3 fixed states of X₀. Components that are fixed in X₀ are varied too, so that,
        for example, friction is recorded even if all initial velocities are zero.
        """
        own = copied(self)
        box, m = own.initial_states, own.system.m
        cost = as_written(own.cost)  # without the penalties that lyapnet adds
        generator = torch.Generator().manual_seed(0)
        x = box.sample(3, generator)
        thin = torch.where(box.widths > 0, 0.0, torch.where(box.center == 0, 1.0, box.center.abs()))
        x = x + 0.1 * thin * torch.rand(x.shape, generator=generator, dtype=x.dtype)
        b = torch.tensor([[1e4], [-1e4], [1.0]], dtype=x.dtype).expand(-1, m)  # beyond the limits of bounded sets
        with torch.no_grad():
            numbers = {
                "x": x, **own._recorded_dynamics(x), "q": cost.state(x), "R": cost.R(x),
                "φ": cost.terminal(x), "U": own.controls.minimise(torch.eye(m, dtype=x.dtype).expand(3, m, m), b),
            }  # fmt: skip
        if (rest := cost.rest_at(x)) is not None:
            numbers["u*"] = rest.expand(3, m)
        if cost.nonquadratic is not None:
            numbers["s"] = cost.beside(cost.nonquadratic.distinguishing_controls(m))
        if own.constraints is not None:
            numbers["h"] = own.constraints(x)
        if own.noise is not None:
            at = torch.cat([x, own.goal.to(x)[None], own.goal + 2 * (x - own.goal)]) if own.has_goal else x
            sigma = own.noise(at)  # outside of X₀ too, where it may be larger
            numbers["σσᵀ"] = sigma @ sigma.mT
        if own.risk:
            numbers["risk"] = x.new_tensor([own.risk])
        if own.controls.limits is not None:
            for side, limit in zip(LIMITS, own.controls.limits, strict=True):
                numbers[side] = limit.to(x).expand(1, m)
        return {"state names": list(own.system.state_names)} | {name: v.tolist() for name, v in numbers.items()}

    def _recorded_dynamics(self, x: State) -> dict[str, Tensor]:
        """f and g at some states; or ẋ under the control at rest and under neighbouring controls."""
        if self.system.affine:
            return {"f": self.system.f(x), "g": self.system.g(x)}
        rest = self.nominal_at(x)
        others = [self.controls.project(rest + side) for side in (0.0, 0.3, -0.3)]
        return {"ẋ": torch.stack([self.system.dynamics(x, u) for u in others], 1)}

    def differences(self, record: Any) -> list[str]:
        """The parts in which the problem differs from a record; empty if there is no record for this X₀."""
        own = self.record()
        if not isinstance(record, dict) or not _agree(record.get("x"), own.pop("x")):
            return []
        m = self.system.m
        unsaid = {side: [[sign * math.inf] * m] for side, sign in LIMITS.items()}
        unsaid |= {"u*": [[0.0] * m] * 3, "risk": [0.0]}
        if "u*" in record:
            own = {"u*": unsaid["u*"], **own}
        if "σσᵀ" in record or "σσᵀ" in own:
            none = torch.zeros_like(torch.as_tensor(own.get("σσᵀ", record.get("σσᵀ")))).tolist()
            unsaid["σσᵀ"], own = none, {"σσᵀ": none, **own}
        if "h" in record:
            own = {"h": [[0.0]] * 3, **own}
        unsaid["s"] = [0.0] * 2 * m
        if "s" in record:
            own = {"s": unsaid["s"], **own}
        if "risk" in record:
            own = {"risk": [0.0], **own}
        return [name for name, value in own.items() if not _agree(record.get(name, unsaid.get(name)), value)]


def _agree(recorded: Any, own: list[Any]) -> bool:
    """Whether two recorded entries have equal names, or equal numbers up to rounding."""
    if isinstance(own[0], str):
        return recorded == own
    try:
        one, other = (torch.tensor(numbers, dtype=torch.float64) for numbers in (recorded, own))
    except Exception:  # the record comes from a file
        return False
    if one.shape != other.shape:
        return False
    size = other.nan_to_num(0.0, 0.0, 0.0).abs()
    tolerance = RECORD_TOLERANCE * size.amax(0) + 1e-7 * size.max()  # the rounding of terms that cancel
    return bool(((one == other) | (one.isnan() & other.isnan()) | ((one - other).abs() <= tolerance)).all())
