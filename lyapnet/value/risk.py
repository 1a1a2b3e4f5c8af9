"""The certainty equivalent of V under noise, for a cost with risk: (1/θ) log E exp(θ V(x + σΔW)).

It is the certain number that is equivalent to the random V: for small θ the mean plus θ/2 times the variance, for large
θ almost the largest value. For a quadratic function, c + pᵀδ + ½ δᵀHδ with S = I − θΔt σᵀHσ positive definite,
it is again quadratic:

    c̃ = c + ½ pᵀGp − log det S / (2θ),   p̃ = p + HGp,   H̃ = H + HGH,   with G = θΔt σS⁻¹σᵀ.

If S is not positive definite, exp(θV) has no mean: no law keeps the risk finite ("breakdown").

Source: Jacobson, "Optimal stochastic linear systems with exponential performance criteria and their relation to
deterministic differential games", IEEE Transactions on Automatic Control 1973.
"""

import math

import torch
from torch import Tensor

from lyapnet.base.linear_algebra import apply, multiply, solve
from lyapnet.base.types import Noise as NoiseMatrix
from lyapnet.base.types import State


def risk_matrix(H: Tensor, sigma: NoiseMatrix, dt: float, risk: float) -> Tensor:
    """S = I − θΔt σᵀHσ, (*batch, k, k), for H (*batch, n, n) and σ (*batch, n, k)."""
    return torch.eye(sigma.shape[-1]).to(sigma) - risk * dt * multiply(sigma.mT, multiply(H, sigma))


def risk_gain(H: Tensor, sigma: NoiseMatrix, dt: float, risk: float) -> Tensor:
    """G = θΔt σS⁻¹σᵀ, (*batch, n, n)."""
    return risk * dt * multiply(sigma, solve(risk_matrix(H, sigma, dt, risk), sigma.mT))


def equivalent_derivatives(p: State, H: Tensor, sigma: NoiseMatrix, dt: float, risk: float) -> tuple[State, Tensor]:
    """(p̃, H̃), the gradient and the curvature of the certainty equivalent, from p (*batch, n) and H (*batch, n, n)."""
    G = risk_gain(H, sigma, dt, risk)
    return p + apply(H, apply(G, p)), H + multiply(H, multiply(G, H))


def with_risk(W: Tensor, sigma: NoiseMatrix, dt: float, risk: float) -> Tensor:
    """W of the certainty equivalent less the mean ½Δt tr(σᵀHσ), for W = [[2c, pᵀ], [p, H]] (*batch, 1 + n, 1 + n).

    It is not finite where S is not positive definite.
    """
    H = W[..., 1:, 1:]
    root, failed = torch.linalg.cholesky_ex(risk_matrix(H, sigma, dt, risk))
    half = torch.linalg.solve_triangular(root, sigma.mT @ W[..., 1:, :], upper=False)
    equivalent = W + risk * dt * half.mT @ half
    mean = dt * (sigma.mT * multiply(sigma.mT, H)).sum((-2, -1))
    equivalent[..., 0, 0] -= 2 / risk * root.diagonal(0, -2, -1).log().sum(-1) + mean
    return equivalent.where((failed == 0)[..., None, None], torch.inf)


def mean_with_risk(samples: Tensor, risk: float) -> Tensor:
    """(1/θ) log of the mean of exp(θ J) over the first axis; with θ = 0 the mean of J."""
    if not risk:
        return samples.mean(0)
    return (torch.logsumexp(risk * samples, 0) - math.log(len(samples))) / risk
