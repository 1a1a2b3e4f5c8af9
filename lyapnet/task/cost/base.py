"""What every cost is: a running cost along the way, and a terminal cost."""

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

BUFFERS = ("goal", "rest", "R_constant", "R_inverse")  # facts of a cost, which may be None


class Cost(nn.Module, ABC):
    """ℓ(x, u) = q(x) + uᵀR(x)u in cost per second along the way, and φ(x) at the end.

    q and φ are smooth, R(x) is symmetric positive definite. A subclass writes `state`, `R` and `terminal` with torch
    operations on tensors of any leading shape. What it knows of `goal` and the other facts below it says in its body,
    as in `goal = [1.0, 0.0]`, or in `__init__`. About a target, u is counted from what holds it there (TargetCost).
    Where q and φ vanish at a goal and are nowhere negative, V is a distance to it; a profit or a harvest has none.
    """

    goal: Float[Tensor, " n"] | None  # where q and φ vanish, if they do; None: the origin
    rest: Float[Tensor, " m"] | None  # u*, the control that costs nothing; None: zero
    R_constant: Matrix | None  # R and R⁻¹, where they are the same at every state
    R_inverse: Matrix | None

    _declared: ClassVar[Mapping[str, Any]] = {}  # of the buffers below, what a class says of them in its body

    def __init_subclass__(cls, **options: Any) -> None:
        """Take `goal = torch.tensor(…)` in the body of a class as the value of that buffer, which it would hide."""
        super().__init_subclass__(**options)
        values = {name: vars(cls)[name] for name in BUFFERS if name in vars(cls)}
        values = {name: value for name, value in values.items() if not hasattr(value, "__get__")}  # no property
        for name in values:
            delattr(cls, name)
        cls._declared = {**cls._declared, **values}

    # Not persistent, here and in sets and systems: facts of the problem come from its config, never from a checkpoint.
    def __init__(self):
        super().__init__()
        for name in BUFFERS:
            if not hasattr(type(self), name):  # as a property has it
                value = self._declared.get(name)
                as_tensor = None if value is None else torch.as_tensor(value, dtype=torch.get_default_dtype()).clone()
                self.register_buffer(name, as_tensor, persistent=False)

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
        """x − x*; of a family x* is the target of each member, and its parameters count as zero."""
        return x if self.goal is None else x - self.goal.to(x)

    def terminal_gradient(self, x: State) -> State:
        """φ_x(x); by automatic differentiation unless a subclass knows better."""
        recording = torch.is_grad_enabled()
        with torch.enable_grad():
            x = x if recording and x.requires_grad else x.detach().requires_grad_()
            (gradient,) = torch.autograd.grad(self.terminal(x).sum(), x, create_graph=recording, materialize_grads=True)
        return gradient

    def control(self, x: State, u: Control) -> PerState:
        """uᵀR(x)u, or (u − u*)ᵀR(x)(u − u*)."""
        return quadratic_form(self.R(x), u if self.rest is None else u - self.rest)

    def about_rest(self, R: ControlMatrix, b: Control) -> Control:
        """b − 2Ru*, with which uᵀRu + (b − 2Ru*)ᵀu is (u − u*)ᵀR(u − u*) + bᵀu, but for a constant."""
        return b if self.rest is None else b - 2 * apply(R, self.rest)

    def running(self, x: State, u: Control) -> PerState:
        """ℓ(x, u) = q(x) + uᵀR(x)u, in cost per second."""
        return self.state(x) + self.control(x, u)

    def solve_R(self, x: State, v: Control) -> Control:
        """R(x)⁻¹v."""
        return solve(self.R(x), v[..., None])[..., 0] if self.R_inverse is None else apply(self.R_inverse, v)

    def ignores(self, i: int, n: int) -> bool:
        """Whether neither q nor φ depends on x_i, of n states; R is not asked.

        Not a number in x_i makes nan of all that is computed with it, unless q or φ jumps there.
        """
        own, x = copy.deepcopy(self).double().cpu(), _nan_at(i, n)
        return not bool(own.state(x).isnan() | own.terminal(x).isnan())

    def ignores_at_end(self, i: int, n: int) -> bool:
        """Whether φ does not depend on x_i, of n states."""
        return not bool(copy.deepcopy(self).double().cpu().terminal(_nan_at(i, n)).isnan())

    def restricted_to(self, kept: Sequence[int], n: int) -> "Cost":
        """q and φ as functions of some of n states alone, the others at zero."""
        return _RestrictedCost(self, kept, n)

    def check(self, x: State) -> None:
        """Refuse a cost that breaks its contract at some state of a batch (b, n).

        Raises:
            UsageError: naming the first state at which q, φ or R(x) is not what it has to be.
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
    """A cost of some states, the others at zero; for q and φ alone."""

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
