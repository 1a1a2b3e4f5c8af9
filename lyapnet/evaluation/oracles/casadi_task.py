"""A task as CasADi functions, for nonlinear programming: its step, its terminal cost, its constraints and controls."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import casadi
import torch
from torch import Tensor
from torch.fx import GraphModule

from lyapnet.base.types import Control, PerState, State
from lyapnet.graphs.casadi_functions import casadi_function, require_equal, trace_for_casadi
from lyapnet.graphs.tracing import Tensors
from lyapnet.task.cost.control_costs import AbsoluteCost, ControlCost, ControlCosts, PowerCost
from lyapnet.task.problem import Problem


class TermsOfControls(NamedTuple):
    """The terms of a nonlinear program for the controls of a plan."""

    cost: casadi.MX  # per second
    variables: casadi.MX  # ≥ 0
    inequalities: casadi.MX  # ≤ 0


class CasadiTask:
    """The torch functions translated to CasADi: (x_n, u_n) ↦ (x_{n+1}, ∫ℓ), x_N ↦ φ and x ↦ h, and those of u.

    Attributes:
        graphs: the torch traces of these functions.
        step, end, inside: the CasADi functions; ∫ℓ is without s(u), and inside is None without constraints.

    Args:
        problem: in float64 on the CPU.

    Raises:
        OracleError: dynamics or cost use torch operations that CasADi lacks.
    """

    def __init__(self, problem: Problem):
        self.problem, self.graphs = problem, list[GraphModule]()
        system = problem.system
        x, u = torch.zeros(1, system.n, dtype=torch.float64), torch.zeros(1, system.m, dtype=torch.float64)
        self.step = self._translate(self.step_in_torch, (x, u))
        self.end = self._translate(self.end_in_torch, (x,))
        self.inside = None if problem.constraints is None else self._translate(self.inside_in_torch, (x,))
        self._excess = None if problem.controls.excess(u) is None else self._translate(self.excess_in_torch, (u,))
        self._smooth, self._kinked = self._costs_of_controls(u)

    def slopes(self) -> casadi.Function:
        """(x_n, u_n) ↦ (∂x_{n+1}/∂x_n, ∂x_{n+1}/∂u_n)."""
        x, u = self.step.mx_in()
        following = self.step(x, u)[0]
        return casadi.Function("slopes", [x, u], [casadi.jacobian(following, x), casadi.jacobian(following, u)])

    def step_in_torch(self, x: State, u: Control) -> tuple[State, PerState]:
        """(x_{n+1}, ∫ℓ over the step) without s(u); with Euler (x_n + Δt(f + gu), Δt (q + uᵀRu))."""
        return self.problem.smooth_step(x, u)

    def end_in_torch(self, x: State) -> tuple[PerState]:
        """(φ(x_N),)."""
        return (self.problem.cost.terminal(x),)

    def inside_in_torch(self, x: State) -> tuple[Tensor]:
        """(h(x_n),)."""
        assert self.problem.constraints is not None
        return (self.problem.constraints(x),)

    def excess_in_torch(self, u: Control) -> tuple[Tensor]:
        """(the functions that are ≤ 0 in U, besides its limits,)."""
        excess = self.problem.controls.excess(u)
        assert excess is not None
        return (excess,)

    @property
    def is_program_of_steps(self) -> bool:
        """Whether `step`, `end`, `inside` and limits of controls are the whole task."""
        return self._excess is None and not self._kinked and self._smooth is None

    def terms_of_controls(self, u: casadi.MX, scale: casadi.MX) -> "TermsOfControls":
        """The cost per second Σ s(u_n) and the inequalities for controls (m, N), whose size is `scale` (m,).

        If their slopes jump or have no bound at 0, |uᵢ| and ‖u‖ are additional variables with values at least as large.
        """
        steps = u.shape[1]
        cost, variables, inequalities = casadi.MX(0), list[casadi.MX](), list[casadi.MX]()
        if self._smooth is not None:
            cost += casadi.sum2(self._smooth.map(steps)(u))
        if self._excess is not None:
            inequalities.append(casadi.vec(self._excess.map(steps)(u)))
        for part in self._kinked:
            weight = part.weight.double()
            if isinstance(part, AbsoluteCost | PowerCost):
                size, p = casadi.MX.sym("size", *u.shape), part.exponent if isinstance(part, PowerCost) else 1.0
                scaled = casadi.diag(1 / scale) @ u
                inequalities += [casadi.vec(scaled - size), casadi.vec(-scaled - size)]
                cost += casadi.sum1(casadi.DM(weight.expand(u.shape[0]).numpy()) * scale**p * casadi.sum2(size**p))
            else:
                size, of_all = casadi.MX.sym("size", 1, steps), casadi.norm_2(scale)
                inequalities.append(casadi.vec(casadi.sum1((u / of_all) ** 2) - size**2))
                cost += float(weight) * of_all * casadi.sum2(size)
            variables.append(casadi.vec(size))
        return TermsOfControls(cost, casadi.veccat(*variables), casadi.veccat(*inequalities))

    def _costs_of_controls(self, u: Control) -> tuple[casadi.Function | None, list[ControlCost]]:
        """The sum of smooth costs of controls translated, and the costs with kinks or an infinite curvature."""
        own = self.problem.cost.nonquadratic
        if own is None:
            return None, []
        self.graphs.append(trace_for_casadi(lambda u: (own(u),), (u,)))  # which identifies the task
        kinked: list[ControlCost] = [
            *own.kinked, *(part for part in own.separable if isinstance(part, PowerCost) and part.exponent < 2)
        ]  # fmt: skip
        smooth = [part for part in own.separable if part not in kinked]
        if not smooth:
            return None, kinked
        return self._translate(lambda u: (ControlCosts(smooth)(u),), (u,)), kinked

    def _translate(self, function: Callable[..., Tensors], arguments: Sequence[Tensor]) -> casadi.Function:
        self.graphs.append(trace_for_casadi(function, arguments))
        translated = casadi_function(self.graphs[-1], arguments)
        require_equal(translated, function, arguments)
        return translated
