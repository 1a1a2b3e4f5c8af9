"""Observability of the state along closed loops: the observability Gramian, and the covariance of the filter."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from lyapnet.base.types import ControlPath, StatePath
from lyapnet.loop.estimation.kalman import Deviations, ExtendedKalmanFilter

SEEN = 1e-6  # least change of all readings, in units of their noise, by a direction of x₀ that counts as seen


class Observability(NamedTuple):
    """Observability of the system linearised along some closed loops.

    W = Σ_k Φ_kᵀH_kᵀR⁻¹H_kΦ_k is the observability Gramian, with x₀ in units of its initial standard deviation. In a
    direction with an eigenvalue above 1 the readings of the horizon determine x₀ better than this. For control the
    present state matters, and directions that decay need no reading: therefore the uncertainty at T is given too.
    """

    rank: int  # least rank of W over the loops
    condition: float  # largest ratio of the extreme eigenvalues of W; infinite if not all of x₀ is seen
    deviation: Deviations  # √P of each state after the last reading, root mean square over the loops
    of_first: Deviations  # the same without process noise: the part by the uncertainty of x₀


def observability(
    kalman: ExtendedKalmanFilter, x: StatePath, u: ControlPath, deviation: Float[Tensor, " n"]
) -> Observability:
    """The observability along closed loops x (N + 1, b, n), u (N, b, m).

    Args:
        deviation: standard deviation of each component of x₀ before any reading; 0 for known components, which do
            not count in rank and condition.
    """
    A = kalman.step_jacobian(x[:-1], u)
    H, Q = kalman.output_jacobian(x), kalman.process_noise(x[:-1])
    first = torch.diag(deviation)
    P, with_noise = first.expand(2, x.shape[1], -1, -1).square(), Q.new_tensor([1.0, 0.0])[:, None, None, None]
    phi, seen = first[:, deviation > 0].expand(x.shape[1], -1, -1), list[Tensor]()
    for k in range(len(x)):
        if k:
            phi, P = A[k - 1] @ phi, A[k - 1] @ P @ A[k - 1].mT + with_noise * Q[k - 1]
        seen.append(H[k] @ phi / kalman.outputs.noise[:, None])
        P = kalman.corrected(P, H[k].expand(2, -1, -1, -1))[0]
    roots = torch.linalg.svdvals(torch.cat(seen, -2))  # √ of the eigenvalues of W, (b, n)
    rounding = torch.finfo(roots.dtype).eps * roots.shape[-1] * roots[:, :1]
    rank = (roots > rounding.clamp_min(SEEN)).sum(-1)
    condition = (roots[:, 0] / roots[:, -1].where(rank == roots.shape[-1], 0.0)).square()
    left = P.diagonal(dim1=-2, dim2=-1).mean(1).sqrt()
    return Observability(int(rank.min()), float(condition.max()), left[0], left[1])
