"""The quadratic cost of every task."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from lyapnet.linear_algebra import apply, solve
from lyapnet.types import Control, ControlMatrix, Matrix, PerState, State


class QuadraticCost(nn.Module):
    """ℓ(x, u) = xᵀQx + uᵀR(x)u along the way and φ(x) = xᵀQ_T x at the end.

    Args:
        Q: (n, n), symmetric positive semidefinite.
        R: (m, m), symmetric positive definite, or a function x ↦ (*batch, m, m) that gives such a matrix.
        Q_T: (n, n), symmetric positive semidefinite.

    Raises:
        ValueError: a matrix has the wrong shape or definiteness.
    """

    Q: Matrix
    Q_T: Matrix
    R_constant: Matrix | None

    # Not persistent, here and in sets and systems: facts of the task come from its config, never from a checkpoint.
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
        self._R_of_state = R if callable(R) else None
        self.register_buffer("R_constant", None if callable(R) else _symmetric("R", R, definite=True), persistent=False)

    def R(self, x: State) -> ControlMatrix:
        """The control weight at each state, (*batch, m, m)."""
        if self._R_of_state is not None:
            return self._R_of_state(x)
        assert self.R_constant is not None
        return self.R_constant.expand(*x.shape[:-1], *self.R_constant.shape)

    def state(self, x: State) -> PerState:
        """q(x) = xᵀQx."""
        return _quadratic(self.Q, x)

    def control(self, x: State, u: Control) -> PerState:
        """uᵀR(x)u."""
        return _quadratic(self.R(x), u)

    def running(self, x: State, u: Control) -> PerState:
        """ℓ(x, u) = xᵀQx + uᵀR(x)u, in cost per second."""
        return self.state(x) + self.control(x, u)

    def terminal(self, x: State) -> PerState:
        """φ(x) = xᵀQ_T x."""
        return _quadratic(self.Q_T, x)

    def solve_R(self, x: State, v: Control) -> Control:
        """R(x)⁻¹v."""
        return solve(self.R(x), v[..., None])[..., 0]

    def check(self, x: State) -> None:
        """Refuse an R(x) that is not symmetric positive definite at some state of a batch (b, n).

        Raises:
            ValueError: naming the first such state.
        """
        R = self.R(x)
        asymmetry = (R - R.mT).abs().amax((-2, -1))
        smallest = torch.linalg.eigvalsh(torch.nan_to_num(R, nan=-1.0, posinf=-1.0, neginf=-1.0))[..., 0]
        bad = torch.nonzero(~((smallest > 0) & (asymmetry <= 1e-9 * R.abs().amax((-2, -1))))).flatten()
        if len(bad):
            i = int(bad[0])
            raise ValueError(
                f"Expected R(x) symmetric positive definite, got smallest eigenvalue {smallest[i]:.3g} and asymmetry "
                f"{asymmetry[i]:.3g} at x = {x[i].tolist()}; choose another R, or an X₀ that avoids this state."
            )


def _quadratic(weight: Tensor, v: Tensor) -> Tensor:
    return (apply(weight, v) * v).sum(-1)


def _symmetric(name: str, rows: Sequence[Sequence[float]] | Tensor, *, definite: bool) -> Tensor:
    """The matrix as a tensor, or a ValueError that says what is wrong with it."""
    try:
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
