"""Weights of a quadratic cost that differ from state to state, as of the members of a family."""

import copy
from collections.abc import Mapping, Sequence

from jaxtyping import Float
from torch import Tensor, nn

from lyapnet.task.cost.base import Cost
from lyapnet.task.cost.quadratic import QuadraticCost
from lyapnet.task.cost.wrappers import CostWrapper

MATRICES = {"Q": "Q", "R": "R_constant", "Q_T": "Q_T"}  # matrix of a quadratic cost ↦ its buffer


class DiagonalWeights(nn.Module):
    """Q(w) = Q₀ + Σ_k w_k e_i e_iᵀ over the weights w_k of entries Q_ii, and likewise R(w) and Q_T(w).

    Args:
        cost: a quadratic cost with a constant R; its entries at the places of weights are replaced.
        places: matrix (Q, R or Q_T) and i of each weight.
        least: the smallest value of each weight, (k,); the matrices are definite for all larger ones too.

    Raises:
        ValueError: with the smallest weights, Q or Q_T is not positive semidefinite, or R not positive definite.
    """

    def __init__(self, cost: QuadraticCost, places: Sequence[tuple[str, int]], least: Float[Tensor, " k"]):
        super().__init__()
        self.matrices = [name for name in MATRICES if any(name == matrix for matrix, _ in places)]
        for name in self.matrices:
            fixed = getattr(cost, MATRICES[name]).clone()
            units = fixed.new_zeros(len(places), *fixed.shape)
            for k, (matrix, i) in enumerate(places):
                if matrix == name:
                    fixed[i, i], units[k, i, i] = 0, 1
            self.register_buffer(f"fixed_{name}", fixed, persistent=False)
            self.register_buffer(f"units_{name}", units, persistent=False)
        smallest = {name: getattr(cost, buffer) for name, buffer in MATRICES.items()} | self(least)
        QuadraticCost(**smallest)  # raises an error for wrong matrices

    def forward(self, w: Float[Tensor, "*batch k"]) -> dict[str, Tensor]:
        """The matrices that have weights, by name, (*batch, n, n) or (*batch, m, m)."""
        return {
            name: getattr(self, f"fixed_{name}") + (w[..., None, None] * getattr(self, f"units_{name}")).sum(-3)
            for name in self.matrices
        }


def with_matrices(cost: Cost, matrices: Mapping[str, Tensor]) -> Cost:
    """A shallow copy of a quadratic cost, or of a wrapper of one, with some of its matrices replaced.

    Args:
        matrices: Q, R or Q_T, each a matrix, or a batch with one for each state at which the copy is evaluated.
    """
    other = copy.copy(cost)
    other._buffers = {**cost._buffers, "R_inverse": None if "R" in matrices else cost.R_inverse}
    if isinstance(cost, CostWrapper):
        if "R" in matrices:
            other._buffers["R_constant"] = None
        other._modules = {**cost._modules, "cost": with_matrices(cost.cost, matrices)}
    else:
        other._buffers |= {MATRICES[name]: matrix for name, matrix in matrices.items()}
    return other
