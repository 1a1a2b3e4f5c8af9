"""What a problem charges: a running cost and a terminal cost."""

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import TypeGuard

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lyapnet.errors import UsageError
from lyapnet.linear_algebra import apply, solve
from lyapnet.types import Control, ControlMatrix, Matrix, PerState, State


class Cost(nn.Module, ABC):
    """ℓ(x, u) = q(x) + uᵀR(x)u in cost per second along the way, and φ(x) at the end.

    q and φ are smooth and nonnegative, R(x) is symmetric positive definite. A subclass writes `state`, `R` and
    `terminal` with torch operations on tensors of any leading shape. About a target, u is counted from what holds it
    there (TargetCost).
    """

    goal: Float[Tensor, " n"] | None  # where q and φ vanish; None: the origin
    rest: Float[Tensor, " m"] | None  # u*, the control that costs nothing; None: zero
    R_constant: Matrix | None  # R and R⁻¹, where they are the same at every state
    R_inverse: Matrix | None

    # Not persistent, here and in sets and systems: facts of the problem come from its config, never from a checkpoint.
    def __init__(self):
        super().__init__()
        for name in ("goal", "rest", "R_constant", "R_inverse"):
            self.register_buffer(name, None, persistent=False)

    @abstractmethod
    def state(self, x: State) -> PerState:
        """q(x)."""

    @abstractmethod
    def R(self, x: State) -> ControlMatrix:
        """The control weight at each state, (*batch, m, m)."""

    @abstractmethod
    def terminal(self, x: State) -> PerState:
        """φ(x)."""

    def terminal_gradient(self, x: State) -> State:
        """φ_x(x); by automatic differentiation unless a subclass knows better."""
        recording = torch.is_grad_enabled()
        with torch.enable_grad():
            x = x if recording and x.requires_grad else x.detach().requires_grad_()
            (gradient,) = torch.autograd.grad(self.terminal(x).sum(), x, create_graph=recording, materialize_grads=True)
        return gradient

    def control(self, x: State, u: Control) -> PerState:
        """uᵀR(x)u, or (u − u*)ᵀR(x)(u − u*)."""
        return _quadratic(self.R(x), u if self.rest is None else u - self.rest)

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
            rounding = 100 * torch.finfo(value.dtype).eps * float(torch.nan_to_num(value).abs().max())
            bad = torch.nonzero(~(value >= -rounding)).flatten()
            if len(bad):
                i = int(bad[0])
                raise UsageError(f"Expected {name} ≥ 0, got {float(value[i]):.6g} at x = {x[i].tolist()}; correct it.")
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


class QuadraticCost(Cost):
    """q(x) = xᵀQx, R constant or a function of the state, and φ(x) = xᵀQ_T x.

    Args:
        Q: (n, n), symmetric positive semidefinite.
        R: (m, m), symmetric positive definite, or a function x ↦ (*batch, m, m) that gives such a matrix.
        Q_T: (n, n), symmetric positive semidefinite.

    Raises:
        ValueError: a matrix has the wrong shape or definiteness.
    """

    Q: Matrix
    Q_T: Matrix

    def __init__(
        self,
        Q: Sequence[Sequence[float]] | Tensor,
        R: Sequence[Sequence[float]] | Tensor | Callable[[State], ControlMatrix],
        Q_T: Sequence[Sequence[float]] | Tensor,
    ):
        super().__init__()
        self.register_buffer("Q", _symmetric("Q", Q, definite=False), persistent=False)
        self.register_buffer("Q_T", _symmetric("Q_T", Q_T, definite=False), persistent=False)
        if self.Q.shape != self.Q_T.shape:
            raise ValueError(
                f"Expected Q and Q_T of the same shape, got {tuple(self.Q.shape)} and {tuple(self.Q_T.shape)}; "
                "give one row for each state."
            )
        self.R_of_state = R if callable(R) else None
        constant = None if callable(R) else _symmetric("R", R, definite=True)
        inverse = None if constant is None else torch.linalg.inv(constant)
        self.register_buffer("R_constant", constant, persistent=False)
        self.register_buffer("R_inverse", inverse, persistent=False)

    def R(self, x: State) -> ControlMatrix:
        if self.R_of_state is not None:
            return self.R_of_state(x)
        assert self.R_constant is not None
        return self.R_constant.expand(*x.shape[:-1], *self.R_constant.shape)

    def state(self, x: State) -> PerState:
        return _quadratic(self.Q, x)

    def terminal(self, x: State) -> PerState:
        return _quadratic(self.Q_T, x)

    def terminal_gradient(self, x: State) -> State:
        return 2 * apply(self.Q_T, x)

    def __init_subclass__(cls) -> None:
        """Refuse another q, R or φ: much is known of a quadratic cost by its matrices alone."""
        super().__init_subclass__()
        changed = [name for name in ("state", "R", "terminal") if name in vars(cls)]
        if changed:
            raise TypeError(
                f"Expected the {changed[0]} of QuadraticCost in {cls.__name__}, got another; derive from Cost."
            )

    def ignores(self, i: int, n: int) -> bool:
        return not any((*self.Q[i], *self.Q_T[i]))  # both are symmetric

    def ignores_at_end(self, i: int, n: int) -> bool:
        return not any(self.Q_T[i])

    def restricted_to(self, kept: Sequence[int], n: int) -> "QuadraticCost":
        kept = list(kept)
        return QuadraticCost(self.Q[kept][:, kept], torch.eye(1), self.Q_T[kept][:, kept])


def is_quadratic(cost: Cost) -> TypeGuard[QuadraticCost]:
    """Whether a cost is what its matrices say: no class or object put another function in the place of one of it."""
    own = ("state", "R", "terminal", "control", "running", "ignores")
    return all(getattr(getattr(cost, name), "__func__", None) is getattr(QuadraticCost, name) for name in own)


class TargetCost(Cost):
    """Another cost about a target: q(x − d) + (u − u*)ᵀR(x)(u − u*) and φ(x − d), d = x* − the goal of that cost.

    Args:
        cost: q, R and φ.
        target: x*, (n,).
        rest: u*, (m,), the control that costs nothing; what holds x* where something does.
    """

    shift: Float[Tensor, " n"]

    def __init__(self, cost: Cost, target: Sequence[float] | Tensor, rest: Sequence[float] | Tensor):
        super().__init__()
        self.cost = cost
        goal, u = (torch.as_tensor(entries, dtype=torch.get_default_dtype()) for entries in (target, rest))
        self.register_buffer("goal", goal, persistent=False)
        self.register_buffer("rest", u, persistent=False)
        self.register_buffer("shift", goal - (0 if cost.goal is None else cost.goal), persistent=False)
        for name in ("R_constant", "R_inverse"):
            self.register_buffer(name, getattr(cost, name), persistent=False)

    def state(self, x: State) -> PerState:
        return self.cost.state(x - self.shift)

    def R(self, x: State) -> ControlMatrix:
        return self.cost.R(x)

    def terminal(self, x: State) -> PerState:
        return self.cost.terminal(x - self.shift)

    def terminal_gradient(self, x: State) -> State:
        return self.cost.terminal_gradient(x - self.shift)


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


COSTS: dict[str, type[Cost]] = {"quadratic": QuadraticCost}


def _nan_at(i: int, n: int) -> State:
    x = 0.1 + 0.01 * torch.arange(n, dtype=torch.float64).sqrt()
    x[i] = torch.nan
    return x


def _quadratic(weight: Tensor, v: Tensor) -> Tensor:
    return (apply(weight, v) * v).sum(-1)


def _symmetric(name: str, rows: Sequence[Sequence[float]] | Tensor, *, definite: bool) -> Tensor:
    """The matrix as a tensor, or a ValueError that says what is wrong with it."""
    try:
        if not isinstance(rows, Tensor) and any(type(entry) not in (int, float) for row in rows for entry in row):
            raise TypeError("booleans, or no numbers")
        matrix = torch.as_tensor(rows, dtype=torch.get_default_dtype()).clone()
    except (TypeError, ValueError):
        matrix = torch.empty(0)
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or not matrix.numel():
        raise ValueError(f"Expected {name} as a square matrix (a list of rows), got {rows!r}; write one row per line.")
    if not torch.isfinite(matrix).all() or not torch.allclose(matrix, matrix.mT):
        raise ValueError(f"Expected {name} finite and symmetric, got {matrix.tolist()}; use (M + Mᵀ)/2.")
    smallest = float(torch.linalg.eigvalsh(matrix)[0])
    tolerance = 1e-9 * float(matrix.abs().max())  # eigvalsh rounds a zero eigenvalue to either side
    if smallest <= 0 if definite else smallest < -tolerance:
        kind = "definite" if definite else "semidefinite"
        raise ValueError(
            f"Expected {name} symmetric positive {kind}, got smallest eigenvalue {smallest:.6g} in {matrix.tolist()}; "
            "a cost that rewards distance or control has no minimum."
        )
    return matrix
