"""An expansion of V around closed loops under noise, instead of one trajectory without it.

Where loops spread far, the derivatives on the trajectory between them are those of states that no loop meets: at the
top of a hill, at the tip of ln(1 + ‖x‖²) in many dimensions. Of a normal z with mean z̄ and covariance Σ, the quadratic
function nearest to l(z) in the mean square, and the affine function nearest to F(z), are

    E l − ½ tr(E l_zz Σ) + E l_zᵀ(z − z̄) + ½ (z − z̄)ᵀ E l_zz (z − z̄)   and   E F + E F_z (z − z̄),

and the recursion of differential dynamic programming takes them in the place of Taylor's. What F̂ leaves of F costs
½ E (F − F̂)ᵀH(F − F̂). Loops of the law of V then give new means, and so on. A linear-quadratic task keeps its solution.

Source: Gelb (ed.), Applied Optimal Estimation, 1974, ch. 6 (statistical linearisation).
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from lyapnet.base.linear_algebra import apply
from lyapnet.base.types import Control, State
from lyapnet.task.problem import Problem
from lyapnet.value.derivatives import StepDerivatives, Steps, jacobian
from lyapnet.value.expansions.dynamic_programming import backward_recursion
from lyapnet.value.expansions.laws import Expansion, at_rest, greedy_law
from lyapnet.value.expansions.paths import Path, in_float64, path_under

SWEEPS = 8  # most expansions, each around loops of the one before
ENOUGH_GAIN = 1e-3  # relative gain of the mean cost below which they end
MAX_LOOPS, MIN_LOOPS = 256, 32  # loops under noise in each sweep, in pairs with ΔW and −ΔW
MAX_ENTRIES = 40_000_000  # numbers in all second derivatives of a sweep, which limits the loops
ENTRIES_AT_ONCE = 4_000_000  # the same for those computed at once


def expansion_under_noise(
    problem: Problem,
    law: Expansion | None,
    generator: torch.Generator,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Expansion | None:
    """The cheapest expansion around loops under noise from random states of X₀; None if one of them is not finite.

    Args:
        law: an expansion whose law gives the first loops, unless the control at rest costs less; None: there is none.
        generator: of the states and of the noise.
    """
    problem, (N, dt) = in_float64(problem), (problem.horizon.steps, problem.horizon.dt)
    size = (problem.system.n + problem.system.m) ** 2
    pairs = max(MIN_LOOPS, min(MAX_LOOPS, MAX_ENTRIES // (N * size))) // 2
    x0 = problem.initial_states.sample(pairs, generator).double().cpu().repeat(2, 1)
    assert problem.noise is not None
    half = problem.noise.draw(N, dt, x0[:pairs], generator)
    increments = torch.cat([half, -half], 1)

    def loops(law: Callable[[int, State], Control]) -> tuple[Path, float]:
        path = path_under(problem, law, x0, increments)
        return path, float(path.cost.mean())

    path, cost = loops(at_rest(problem))
    if law is not None:
        other, cost_of_law = loops(greedy_law(problem, law))
        if not cost < cost_of_law:
            path, cost = other, cost_of_law
        else:
            law = None
    best, least = None, math.inf
    for sweep in range(SWEEPS):
        progress(sweep, SWEEPS)
        if not math.isfinite(cost):
            break
        law = _around(problem, path, law)
        path, cost = loops(greedy_law(problem, law))
        if not cost < least:
            break
        gain, best, least = least - cost, law, cost
        if gain <= ENOUGH_GAIN * abs(cost):
            break
    return best


def _around(problem: Problem, path: Path, later: Expansion | None) -> Expansion:
    """The expansion around some loops.

    Args:
        later: an expansion whose H weighs what F̂ leaves of F; None: nothing does.
    """
    derivatives = StepDerivatives(problem.step, problem.system.n)
    z = torch.cat([path.x[:-1], path.u], -1)
    nodes = max(1, ENTRIES_AT_ONCE // (z.shape[1] * z.shape[2] ** 2))
    means = list[list[Tensor]]()
    for k in range(0, len(z), nodes):
        block = z[k : k + nodes]
        F, paid, F_z, l_z, l_zz = (
            part.unflatten(0, block.shape[:2]) for part in derivatives.first(block.flatten(0, 1))
        )
        middle = block.mean(1, keepdim=True)
        spread = (block - middle).mT @ (block - middle) / block.shape[1]
        mean = [part.mean(1) for part in (F, paid, F_z, l_z, l_zz)]
        mean[1] = mean[1] - (mean[4] * spread).sum((-2, -1)) / 2
        if later is not None:
            left = F - mean[0][:, None] - apply(mean[2][:, None], block - middle)
            H = later.hessian[k + 1 : k + 1 + len(block), None]
            mean[1] = mean[1] + (apply(H, left) * left).sum(-1).mean(1) / 2
        means.append(mean)
    F, paid, F_z, l_z, l_zz = (torch.cat(parts)[:, None] for parts in zip(*means, strict=True))
    middle, x = z.mean(1, keepdim=True), path.x.mean(1, keepdim=True)
    steps = Steps(middle, F, F_z, paid, l_z, l_zz, _end(problem, path.x[-1]), torch.zeros(len(x), 1).bool(), z[0, 0])
    backward = backward_recursion(problem, x, path.u.mean(1, keepdim=True), steps, None, problem.noise)
    return backward.expansion.member(0)


def _end(problem: Problem, x: State) -> tuple[Tensor, Tensor, Tensor]:
    """The parts of φ's nearest quadratic function for the states x (b, n), each with a batch of one."""
    with torch.enable_grad():
        x = x.detach().requires_grad_()
        phi = problem.cost.terminal(x)
        slope = jacobian(phi[..., None], x)[..., 0, :]
        bend = jacobian(slope, x)
    x, (phi, slope, bend) = x.detach(), (part.detach().mean(0, keepdim=True) for part in (phi, slope, bend))
    spread = (x - x.mean(0)).mT @ (x - x.mean(0)) / len(x)
    return phi - (bend * spread).sum((-2, -1)) / 2, slope, bend
