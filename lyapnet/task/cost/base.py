"""The base class of costs: a running cost and a terminal cost."""

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lyapnet.base.errors import UsageError
from lyapnet.base.linear_algebra import apply, solve
from lyapnet.base.types import Control, ControlMatrix, Matrix, PerState, State
from lyapnet.task.cost.control_costs import ControlCosts
from lyapnet.task.cost.minimum import (
    Minimum,
    best_control,
    is_quadratic_between_limits,
    least_over,
    traced_minimum,
)
from lyapnet.task.sets import ControlSet

BUFFERS = ("goal", "rest", "R_constant", "R_inverse")  # properties of a cost; each may be None


class Cost(nn.Module, ABC):
    """The running cost ℓ(x, u) = q(x) + uᵀR(x)u + s(u) in cost per second, and the terminal cost φ(x).

    q and φ are smooth, R(x) is symmetric positive definite, s is convex and usually absent, see ControlCosts. A
    subclass implements `state`, `R` and `terminal` with torch operations on tensors of any leading shape. It may set
    `goal` and the other properties below in its body, as in `goal = [1.0, 0.0]`, or in `__init__`. With a target,
    u − u* replaces u in uᵀRu, see TargetCost. If q and φ vanish at a goal and are nowhere negative, V measures the
    distance to it; a profit or a harvest has no goal.
    """

    goal: Float[Tensor, " n"] | None  # state at which q and φ vanish, if there is one; None: the origin
    rest: Float[Tensor, " m"] | None  # u*, the control that costs nothing (at the goal, see rest_at); None: zero
    R_constant: Matrix | None  # R, if it is the same at every state
    R_inverse: Matrix | None  # its inverse
    nonquadratic: ControlCosts | None  # s, the cost of controls beside uᵀRu; None: there is none

    _declared: ClassVar[Mapping[str, Any]] = {}  # values of these buffers that are set in the body of a class

    def __init_subclass__(cls, **options: Any) -> None:
        """Turn `goal = torch.tensor(…)` in the body of a class into the value of that buffer."""
        super().__init_subclass__(**options)
        values = {name: vars(cls)[name] for name in BUFFERS if name in vars(cls)}
        values = {name: value for name, value in values.items() if not hasattr(value, "__get__")}  # no property
        for name in values:
            delattr(cls, name)
        cls._declared = {**cls._declared, **values}

    # Buffers of costs, sets and systems are not persistent: the problem comes from the config, not from a checkpoint.
    def __init__(self):
        super().__init__()
        for name in BUFFERS:
            if not hasattr(type(self), name):  # unless it is a property
                value = self._declared.get(name)
                as_tensor = None if value is None else torch.as_tensor(value, dtype=torch.get_default_dtype()).clone()
                self.register_buffer(name, as_tensor, persistent=False)
        self.nonquadratic = None

    @abstractmethod
    def state(self, x: State) -> PerState:
        """q(x)."""

    @abstractmethod
    def R(self, x: State) -> ControlMatrix:
        """The control weight at each state, (*batch, m, m)."""

    @abstractmethod
    def terminal(self, x: State) -> PerState:
        """φ(x)."""

    def from_goal(self, x: State) -> State:
        """x − x*; in a family x* is the target of each member, and the parameters' entries are zero."""
        return x if self.goal is None else x - self.goal.to(x)

    def rest_at(self, x: State) -> Tensor | None:
        """u* at each state, (*batch, m) or (m,); in a family it is the u* of each member. None: zero."""
        return self.rest

    def terminal_gradient(self, x: State) -> State:
        """φ_x(x), by automatic differentiation unless a subclass overrides it."""
        recording = torch.is_grad_enabled()
        with torch.enable_grad():
            x = x if recording and x.requires_grad else x.detach().requires_grad_()
            (gradient,) = torch.autograd.grad(self.terminal(x).sum(), x, create_graph=recording, materialize_grads=True)
        return gradient

    def control(self, x: State, u: Control) -> PerState:
        """uᵀR(x)u, or (u − u*)ᵀR(x)(u − u*); without s(u)."""
        rest = self.rest_at(x)
        return quadratic_form(self.R(x), u if rest is None else u - rest)

    def smooth_running(self, x: State, u: Control) -> PerState:
        """q(x) + uᵀR(x)u, the running cost without s(u)."""
        return self.state(x) + self.control(x, u)

    def running(self, x: State, u: Control) -> PerState:
        """ℓ(x, u) = q(x) + uᵀR(x)u + s(u), in cost per second."""
        cost = self.smooth_running(x, u)
        return cost if self.nonquadratic is None else cost + self.nonquadratic(u)

    def beside(self, u: Control) -> PerState:
        """s(u), the cost of controls beside uᵀRu, (*batch,)."""
        return torch.zeros_like(u[..., 0]) if self.nonquadratic is None else self.nonquadratic(u)

    def best_control(self, controls: ControlSet, W: ControlMatrix, b: Control) -> Control:
        """argmin over u ∈ U of uᵀWu + bᵀu + s(u), (*batch, m).

        Args:
            controls: U.
            W: (*batch, m, m), symmetric positive definite.
            b: (*batch, m).
        """
        minimum = traced_minimum(self.nonquadratic, controls, W, b)
        return best_control(self.nonquadratic, controls, W, b) if minimum is None else minimum.u

    def least(self, controls: ControlSet, W: ControlMatrix, b: Control) -> Minimum | None:
        """The same control and the minimum, for bounds; None if these need no special rule for the control.

        None is returned without s and without a ball, and if a class has methods that differ from ℓ = q + uᵀWu + s(u).
        """
        if is_quadratic_between_limits(self.nonquadratic, controls) or self.has_methods_of_its_own:
            return None
        minimum = traced_minimum(self.nonquadratic, controls, W, b)
        return least_over(self.nonquadratic, controls, W, b) if minimum is None else minimum

    @property
    def has_methods_of_its_own(self) -> bool:
        """Whether a subclass overrides methods that follow from q, R and s."""
        methods = ("running", "smooth_running", "beside", "best_control", "control")
        return any(getattr(getattr(self, name), "__func__", None) is not getattr(Cost, name) for name in methods)

    def solve_R(self, x: State, v: Control) -> Control:
        """R(x)⁻¹v."""
        return solve(self.R(x), v[..., None])[..., 0] if self.R_inverse is None else apply(self.R_inverse, v)

    def ignores(self, i: int, n: int) -> bool:
        """Whether neither q nor φ depends on x_i, of n states; R may depend on it.

        This is tested with NaN as x_i, which makes every result NaN that depends on it, unless q or φ jumps.
        """
        own, x = copy.deepcopy(self).double().cpu(), _nan_at(i, n)
        return not bool(own.state(x).isnan() | own.terminal(x).isnan())

    def ignores_at_end(self, i: int, n: int) -> bool:
        """Whether φ does not depend on x_i, of n states."""
        return not bool(copy.deepcopy(self).double().cpu().terminal(_nan_at(i, n)).isnan())

    def restricted_to(self, kept: Sequence[int], n: int) -> "Cost":
        """The cost as a function of some of the n states, with the others at zero; for q and φ only."""
        return _RestrictedCost(self, kept, n)

    def check(self, x: State) -> None:
        """Check the contract of the cost at a batch of states (b, n).

        Raises:
            UsageError: q or φ is not finite, or R(x) is not symmetric positive definite; names the first such state.
        """
        for name, value in (("q(x)", self.state(x)), ("φ(x)", self.terminal(x))):
            bad = torch.nonzero(~value.isfinite()).flatten()
            if len(bad):
                at = x[bad[0]].tolist()
                raise UsageError(f"Expected finite {name}, got {float(value[bad[0]]):.6g} at x = {at}; correct it.")
        R = self.R(x)
        asymmetry = (R - R.mT).abs().amax((-2, -1))
        smallest = torch.linalg.eigvalsh(torch.nan_to_num(R, nan=-1.0, posinf=-1.0, neginf=-1.0))[..., 0]
        rounding = max(1e-9, 100 * torch.finfo(R.dtype).eps)
        bad = torch.nonzero(~((smallest > 0) & (asymmetry <= rounding * R.abs().amax((-2, -1))))).flatten()
        if len(bad):
            i = int(bad[0])
            raise UsageError(
                f"Expected R(x) symmetric positive definite, got smallest eigenvalue {smallest[i]:.3g} and asymmetry "
                f"{asymmetry[i]:.3g} at x = {x[i].tolist()}; choose another R, or an X₀ that avoids this state."
            )


class _RestrictedCost(Cost):
    """A cost as a function of some states, with the others at zero; for q and φ only."""

    kept: Tensor

    def __init__(self, cost: Cost, kept: Sequence[int], n: int):
        super().__init__()
        self.cost, self.n = cost, n
        self.register_buffer("kept", torch.tensor(list(kept), dtype=torch.long), persistent=False)

    def _all(self, x: Tensor) -> Tensor:
        return x.new_zeros(*x.shape[:-1], self.n).index_add(-1, self.kept, x)

    def state(self, x: State) -> PerState:
        return self.cost.state(self._all(x))

    def R(self, x: State) -> ControlMatrix:
        return self.cost.R(self._all(x))

    def terminal(self, x: State) -> PerState:
        return self.cost.terminal(self._all(x))


def _nan_at(i: int, n: int) -> State:
    x = 0.1 + 0.01 * torch.arange(n, dtype=torch.float64).sqrt()
    x[i] = torch.nan
    return x


def quadratic_form(weight: Tensor, v: Tensor) -> Tensor:
    """vᵀWv."""
    return (apply(weight, v) * v).sum(-1)
