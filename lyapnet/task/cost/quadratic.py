"""The quadratic cost, which is determined by its matrices."""

from collections.abc import Callable, Sequence
from typing import TypeGuard

import torch
from torch import Tensor

from lyapnet.base.linear_algebra import apply
from lyapnet.base.types import ControlMatrix, Matrix, PerState, State
from lyapnet.task.cost.base import Cost, quadratic_form


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
        self.R_of_state: Callable[[State], ControlMatrix] | None = R if callable(R) else None
        constant = None if callable(R) else _symmetric("R", R, definite=True)
        inverse = None if constant is None else torch.linalg.inv(constant)
        self.register_buffer("R_constant", constant, persistent=False)
        self.register_buffer("R_inverse", inverse, persistent=False)

    def R(self, x: State) -> ControlMatrix:
        if self.R_of_state is not None:
            return self.R_of_state(x)
        assert self.R_constant is not None
        return self.R_constant.expand(*x.shape[:-1], *self.R_constant.shape[-2:])

    def state(self, x: State) -> PerState:
        return quadratic_form(self.Q, x)

    def terminal(self, x: State) -> PerState:
        return quadratic_form(self.Q_T, x)

    def terminal_gradient(self, x: State) -> State:
        return 2 * apply(self.Q_T, x)

    def __init_subclass__(cls) -> None:
        """Refuse a subclass with another q, R or φ, because other code relies on the matrices alone."""
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
    """Whether a cost is determined by its matrices: no function is overridden, and controls cost uᵀRu alone."""
    own = ("state", "R", "terminal", "control", "running", "smooth_running", "beside", "best_control", "ignores")
    own_functions = all(getattr(getattr(cost, name), "__func__", None) is getattr(QuadraticCost, name) for name in own)
    return own_functions and cost.nonquadratic is None


def _symmetric(name: str, rows: Sequence[Sequence[float]] | Tensor, *, definite: bool) -> Tensor:
    """The matrix as a tensor; raises ValueError if it is not symmetric and (semi)definite."""
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
