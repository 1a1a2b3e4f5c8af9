"""The effect of noise on V along a path: its unpredicted part in each step, with mean zero."""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from lyapnet.base.errors import DivergenceError
from lyapnet.base.linear_algebra import apply
from lyapnet.base.types import Noise as NoiseMatrix
from lyapnet.base.types import PerState, State, StatePath, StepPath, Time, Times, ValuePath
from lyapnet.task.noise import Increments, Noise, once_if_constant
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.risk import risk_matrix

MOST_SOURCES = 8  # largest number k of sources of noise for expectations by 2k points
DIRECTIONS = 4  # number of pairs of random points for more sources
STATES_PER_BLOCK = 4096  # states at which V is evaluated at once without a gradient; hidden layers then fit a cache


def expected_value(V: ValueFunction, noise: Noise, t: Time, mean: State, x: State, dt: float) -> PerState:
    """E V(t, mean + σ(x)ΔW) over ΔW, by the 2k points mean ± √(k Δt) σ_j, with σ_j the columns of σ(x).

    Exact for a V of third degree in x. Source: Stroud, Approximate Calculation of Multiple Integrals, 1971.
    """
    columns = math.sqrt(noise.sources * dt) * noise(x).movedim(-1, 0)
    return V(t, torch.cat([mean + columns, mean - columns])).mean(0)


def certainty_equivalent(
    V: ValueFunction, noise: Noise, t: Time, mean: State, x: State, dt: float, risk: float
) -> PerState:
    """(1/θ) log E exp(θ V(t, mean + σ(x)ΔW)) over ΔW.

    Let m(δ) = c + pᵀδ + ½ δᵀHδ approximate V(mean + δ), with H the curvature known to V or zero. Let Q be the normal
    distribution whose density is proportional to exp(θm) times that of ΔW; its mean is w = θΔt S⁻¹σᵀp, its covariance
    Δt S⁻¹. Then

        (1/θ) log E exp(θV) = m̃ + (1/θ) log E_Q exp(θ (V − m)),

    where m̃ is the certainty equivalent of m (see lyapnet.value.risk). This holds for any c, p and H, which are
    therefore constants for derivatives. E_Q is the mean over the 2k points w ± √k C_j, with C_j the columns of C and
    CCᵀ = Δt S⁻¹: exact if V = m, else to third order in ΔW.
    """
    with torch.no_grad():
        c, p = (each.double() for each in V.value_and_state_gradient(t, mean))
        H = V.curvature(t)
        H = p.new_zeros(p.shape[-1], p.shape[-1]) if H is None else H.double()
    sigma = once_if_constant(noise(x)).double()  # because results are divided by θ, which may be small
    root, failed = torch.linalg.cholesky_ex(risk_matrix(H, sigma, dt, risk))
    if failed.any():
        raise DivergenceError(
            f"Expected a risk with which E exp(risk · V) is finite over each step, got {risk:g}; choose a smaller risk."
        )
    slope = apply(sigma.mT, p)
    w = risk * dt * torch.cholesky_solve(slope[..., None], root)[..., 0]
    offsets = math.sqrt(noise.sources * dt) * torch.linalg.inv(root).movedim(-2, 0)  # S⁻¹ = root⁻ᵀ root⁻¹
    steps = torch.stack([apply(sigma, w + offset) for each in offsets for offset in (each, -each)])
    model = c + (steps * (p + apply(H, steps) / 2)).sum(-1)
    excess = risk * (V(t, mean + steps.to(mean)).double() - model)
    tilted = c + (w * slope).sum(-1) / 2 - root.diagonal(0, -2, -1).log().sum(-1) / risk
    most = excess.detach().amax(0)
    return (tilted + (most + torch.log1p(torch.expm1(excess - most).mean(0))) / risk).to(mean)


def sampled_value(
    V: ValueFunction, noise: Noise, t: Time, mean: State, x: State, increments: Sequence[Tensor], dt: float
) -> PerState:
    """An unbiased estimate of E V(t, mean + σ(x)ΔW) over ΔW, for noise with many sources.

    It is the mean over some ΔW_i of ½ V(mean + σΔW_i) + ½ V(mean − σΔW_i) − ½ (σΔW_i)ᵀH(σΔW_i), plus ½ Δt tr(σᵀHσ),
    with H the curvature known to V, or 0: it is exact for a V with this curvature.

    Args:
        increments: some ΔW_i, each (*batch, k).
    """
    sigma = noise(x)
    steps = torch.stack([apply(sigma, each) for each in increments])
    return V(t, torch.cat([mean + steps, mean - steps])).mean(0) - _sampling_error(V, t, sigma, steps, dt)


@torch.no_grad()
def _sampling_error(V: ValueFunction, t: Time, sigma: NoiseMatrix, steps: Tensor, dt: float) -> Tensor:
    """Mean of ½ ΔᵀHΔ over sampled displacements Δ (r, *batch, n), less its expectation ½ Δt tr(σᵀHσ)."""
    H = V.curvature(t)
    if H is None:
        return torch.zeros_like(steps[0, ..., 0])
    one = once_if_constant(sigma)
    return ((apply(H, steps) * steps).sum(-1).mean(0) - dt * ((H @ one) * one).sum((-2, -1))) / 2


def surprises(
    V: ValueFunction, noise: Noise, t: Times, x: StatePath, value: ValuePath, increments: Increments, risk: float = 0.0
) -> StepPath:
    """D_n = V(t_{n+1}, x_{n+1}) − E[V(t_{n+1}, x_{n+1}) | x_n] of each step, of mean zero, with its gradient.

    With a risk θ > 0 the certainty equivalent replaces the expectation, and exp(θD_n) has mean one.

    With more than MOST_SOURCES sources the expectation is estimated from the increments in the same step of DIRECTIONS
    paths of the batch, its own and those of the next ones; they are independent of the state.
    """
    dt = float(t[1] - t[0])

    def expected(later: Tensor, x: State, following: State, increments: Tensor, *others: Tensor) -> Tensor:
        mean = following - noise.displacement(x, increments)
        if risk:
            return certainty_equivalent(V, noise, later, mean, x, dt, risk)
        if not others:
            return expected_value(V, noise, later, mean, x, dt)
        return sampled_value(V, noise, later, mean, x, others, dt)

    later = t[1:].reshape(-1, *[1] * (x.ndim - 2))
    others = list[Tensor]()
    if noise.sources > MOST_SOURCES:
        flat = increments.flatten(1, -2)
        others = [flat.roll(i, 1).reshape(increments.shape) for i in range(min(DIRECTIONS, flat.shape[1]))]
    return value[1:] - _in_blocks(expected, later, x[:-1], x[1:], increments, *others)


@torch.no_grad()
def martingale(
    V: ValueFunction, noise: Noise, t: Times, x: StatePath, increments: Increments
) -> tuple[PerState, PerState]:
    """(M, ⟨M⟩), M = Σ_n V_x(t_n, x_n)ᵀσ(x_n)ΔW_n, which has mean zero for any V, and ⟨M⟩ = Σ_n Δt |σᵀV_x|².

    If V is the cost to go of its law, J − M = V(0, x₀) up to errors of the step: M is a control variate for E J. So is
    exp(θM − ½θ²⟨M⟩), which has mean one for any V, for E exp(θJ).
    """
    dt = float(t[1] - t[0])

    def terms(t: Tensor, x: State, increments: Tensor) -> Tensor:
        slope = apply(noise(x).mT, V.value_and_state_gradient(t, x)[1])
        return torch.stack([(slope * increments).sum(-1), dt * slope.square().sum(-1)], -1)

    both = _in_blocks(terms, t[:-1].reshape(-1, *[1] * (x.ndim - 2)), x[:-1], increments).sum(0)
    return both[..., 0], both[..., 1]


def _in_blocks(function: Callable[..., Tensor], *columns: Tensor) -> Tensor:
    """Evaluate a function of columns over the steps, without a gradient in blocks of STATES_PER_BLOCK states."""
    if torch.is_grad_enabled():
        return function(*columns)
    steps = max(1, STATES_PER_BLOCK // max(1, columns[1][0, ..., 0].numel()))
    return torch.cat([function(*block) for block in zip(*(column.split(steps) for column in columns), strict=True)])
