"""A task as CasADi functions, for nonlinear programming: its step, its terminal cost and its constraints."""

from collections.abc import Callable, Sequence

import casadi
import torch
from torch import Tensor
from torch.fx import GraphModule

from lyapnet.base.types import Control, PerState, State
from lyapnet.graphs.casadi_functions import require_equal, symbolic, traced
from lyapnet.graphs.tracing import Tensors
from lyapnet.task.problem import Problem


class CasadiTask:
    """The torch functions translated to CasADi: (x_n, u_n) ↦ (x_{n+1}, ∫ℓ), x_N ↦ φ and x ↦ h.

    Attributes:
        graphs: the torch traces of these functions.
        step, end, inside: the CasADi functions; inside is None without constraints.

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

    def step_in_torch(self, x: State, u: Control) -> tuple[State, PerState]:
        """(x_{n+1}, ∫ℓ over the step); with Euler (x_n + Δt(f + gu), Δt ℓ(x_n, u_n))."""
        return self.problem.step(x, u)

    def end_in_torch(self, x: State) -> tuple[PerState]:
        """(φ(x_N),)."""
        return (self.problem.cost.terminal(x),)

    def inside_in_torch(self, x: State) -> tuple[Tensor]:
        """(h(x_n),)."""
        assert self.problem.constraints is not None
        return (self.problem.constraints(x),)

    def _translate(self, function: Callable[..., Tensors], arguments: Sequence[Tensor]) -> casadi.Function:
        self.graphs.append(traced(function, arguments))
        translated = symbolic(self.graphs[-1], arguments)
        require_equal(translated, function, arguments)
        return translated
