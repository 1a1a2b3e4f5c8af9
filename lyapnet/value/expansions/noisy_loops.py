"""An expansion of V around closed loops under noise, instead of around one trajectory without noise.

If loops spread far, their mean may be a state that no loop visits, such as the top of a hill, and derivatives there say
little about the loops. For a normal z with mean z̄ and covariance Σ, the best approximations in the mean square, of l(z)
by a quadratic and of F(z) by an affine function, are

    E l − ½ tr(E l_zz Σ) + E l_zᵀ(z − z̄) + ½ (z − z̄)ᵀ E l_zz (z − z̄)   and   E F + E F_z (z − z̄),

and the recursion of differential dynamic programming uses them instead of Taylor polynomials. The error F − F̂ of the
affine function costs ½ E (F − F̂)ᵀH(F − F̂). Loops under the law of V then give new means, and so on. For a
linear-quadratic task the result is exact.

Such an expansion describes one way to the goal. Under noise another may be better that costs more without noise:
`expansion_of_another_way` starts with loops of other laws. At first it leaves out the negative part of E l_zz, as the
Gauss–Newton method does, and includes it for the best expansion found.

Source: Gelb (ed.), Applied Optimal Estimation, 1974, ch. 6 (statistical linearisation).
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from lyapnet.base.linear_algebra import apply
from lyapnet.base.types import Control, State
from lyapnet.task.problem import Problem
from lyapnet.value.derivatives import StepDerivatives, Steps, jacobian
from lyapnet.value.expansions.dynamic_programming import backward_recursion
from lyapnet.value.expansions.laws import Expansion, at_rest, greedy_law
from lyapnet.value.expansions.paths import Path, in_float64, path_under

SWEEPS = 8  # largest number of expansions, each around closed loops of the one before
ENOUGH_GAIN = 1e-3  # relative decrease of the mean cost below which the sweeps end
MAX_LOOPS, MIN_LOOPS = 256, 32  # largest and least number of loops in a sweep, in pairs with ΔW and −ΔW
MAX_ENTRIES = 40_000_000  # largest number of entries in all second derivatives of a sweep; it limits the loops
LOOPS_OF_A_WAY = 64  # number of loops of each guess at another way
MIN_GAIN_OF_A_WAY = 5e-3  # least decrease of the mean cost by another way, relative to it
ENTRIES_AT_ONCE = 4_000_000  # largest number of entries in second derivatives that are computed at once


def expansion_under_noise(
    problem: Problem,
    law: Expansion | None,
    generator: torch.Generator,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Expansion | None:
    """The cheapest expansion around loops under noise from random states of X₀; None if one of them is not finite.

    Args:
        law: an expansion whose law gives the first loops, unless u* costs less; None: take u*.
        generator: draws the states and the noise.
    """
    loops = _Loops(problem, MAX_LOOPS, generator)
    first = loops.under([at_rest(loops.problem)])
    if law is not None:
        other = loops.under([greedy_law(loops.problem, law)])
        if not loops.costs(first) < loops.costs(other):
            first = other
        else:
            law = None
    best, least = loops.descend(first, None if law is None else _batch(law), progress=progress)
    return best.member(0) if best is not None and least.isfinite() else None


def expansion_of_another_way(
    problem: Problem,
    known: Expansion,
    guesses: Sequence[Callable[[int, State], Control]],
    generator: torch.Generator,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Expansion | None:
    """The cheapest expansion under noise that begins with loops of some laws; None if it saves too little.

    Under noise a way may be the best one that costs more without noise. None is searched for if derivatives of the
    loops have more than MAX_ENTRIES entries.

    Args:
        known: an expansion; the result costs less than its law under the same noise, by MIN_GAIN_OF_A_WAY.
        guesses: laws (n, x_n) ↦ u_n, each for another way.
        generator: draws the states and the noise, which are the same for all guesses.
    """
    loops = _Loops(problem, LOOPS_OF_A_WAY, generator)
    if len(guesses) * loops.entries > MAX_ENTRIES:
        return None
    limit = (1 - MIN_GAIN_OF_A_WAY) * float(loops.costs(loops.under([greedy_law(loops.problem, known)])))
    found, costs = loops.descend(loops.under(guesses), convex=True, progress=progress)
    if found is None or not float(costs.min()) < limit:
        return None
    best = found.member(costs.argmin(0, keepdim=True))
    exact, cost = loops.descend(loops.under([greedy_law(loops.problem, best.member(0))]), best)
    return exact.member(0) if exact is not None and float(cost) < limit else best.member(0)


class _Loops:
    """Closed loops under noise from random states of X₀, in pairs with ΔW and −ΔW: a group of loops for each law.

    Args:
        most: largest number in a group; less if derivatives would have more than MAX_ENTRIES entries.
    """

    def __init__(self, problem: Problem, most: int, generator: torch.Generator):
        self.problem, (N, dt) = in_float64(problem), (problem.horizon.steps, problem.horizon.dt)
        assert self.problem.noise is not None
        size = N * (problem.system.n + problem.system.m) ** 2
        pairs = max(MIN_LOOPS, min(most, MAX_ENTRIES // size)) // 2
        self.entries = 2 * pairs * size  # numbers in all second derivatives of a group
        self.x0 = problem.initial_states.sample(pairs, generator).double().cpu().repeat(2, 1)
        half = self.problem.noise.draw(N, dt, self.x0[:pairs], generator)
        self.increments = torch.cat([half, -half], 1)

    def under(self, laws: Sequence[Callable[[int, State], Control]]) -> Path:
        """The loops of some laws (n, x_n) ↦ u_n, one group after the other."""

        def law(n: int, x: State) -> Control:
            return torch.cat([law(n, part) for law, part in zip(laws, x.chunk(len(laws)), strict=True)])

        return self._run(law, len(laws))

    def _run(self, law: Callable[[int, State], Control], groups: int) -> Path:
        """The loops of some groups under a law for the states of all groups."""
        return path_under(self.problem, law, self.x0.repeat(groups, 1), self.increments.repeat(1, groups, 1))

    def costs(self, path: Path) -> Tensor:
        """The mean cost of each group."""
        return path.cost.unflatten(0, (-1, len(self.x0))).mean(1)

    def descend(
        self,
        path: Path,
        law: Expansion | None = None,
        convex: bool = False,
        progress: Callable[[int, int], None] = lambda done, total: None,
    ) -> tuple[Expansion | None, Tensor]:
        """The cheapest expansion of each group, each around loops of the one before; and the mean costs of their laws.

        The cost is infinite where loops are not finite.

        Args:
            path: the first loops of each group.
            law: the expansions whose laws gave these loops, one for each group; None: other laws gave them.
            convex: whether to leave out the negative part of E l_zz. V is then less exact, but its law is reasonable
                for any loops, whereas the law of the exact V may lead far away.
        """
        cost, size = self.costs(path), len(self.x0)
        going, least = torch.arange(len(cost)), torch.full_like(cost, torch.inf)
        best = law
        for sweep in range(SWEEPS):
            progress(sweep, SWEEPS)
            finite = cost.isfinite()
            going, path = going[finite], path.member(finite.repeat_interleave(size))
            if not len(going):
                break
            law = _around(self.problem, path, size, None if law is None else law.member(finite), convex)
            each = law.member(torch.arange(len(going)).repeat_interleave(size))
            path = self._run(greedy_law(self.problem, each), len(going))
            cost = self.costs(path)
            gain = least[going] - cost
            better = gain > 0
            rows, least = going[better], least.index_copy(0, going[better], cost[better])
            if best is None:
                best = Expansion(*(new.new_zeros(len(new), len(least), *new.shape[2:]) for new in law))
            best = Expansion(*(part.index_copy(1, rows, new[:, better]) for part, new in zip(best, law, strict=True)))
            further = better & (gain > ENOUGH_GAIN * cost.abs())
            going, cost, path = going[further], cost[further], path.member(further.repeat_interleave(size))
            law = law.member(further)
        return best, least


def _batch(expansion: Expansion) -> Expansion:
    """A batch of one expansion."""
    return Expansion(*(part[:, None] for part in expansion))


def _around(problem: Problem, path: Path, size: int, later: Expansion | None, convex: bool) -> Expansion:
    """The expansion around each group of loops.

    Args:
        size: number of loops in a group.
        later: expansions, one for each group, whose H weighs the error F − F̂; None: the error has no weight.
        convex: see `descend`.
    """
    derivatives = StepDerivatives(problem.step, problem.system.n)
    z = torch.cat([path.x[:-1], path.u], -1).unflatten(1, (-1, size))
    nodes = max(1, ENTRIES_AT_ONCE // (z.shape[1] * size * z.shape[-1] ** 2))
    means = list[list[Tensor]]()
    for k in range(0, len(z), nodes):
        block = z[k : k + nodes]
        F, paid, F_z, l_z, l_zz = (
            part.unflatten(0, block.shape[:3]) for part in derivatives.first(block.flatten(0, 2))
        )
        middle = block.mean(2, keepdim=True)
        spread = (block - middle).mT @ (block - middle) / size
        mean = [part.mean(2) for part in (F, paid, F_z, l_z, l_zz)]
        mean[1] = mean[1] - (mean[4] * spread).sum((-2, -1)) / 2
        if later is not None:
            left = F - mean[0][:, :, None] - apply(mean[2][:, :, None], block - middle)
            H = later.hessian[k + 1 : k + 1 + len(block), :, None]
            mean[1] = mean[1] + (apply(H, left) * left).sum(-1).mean(2) / 2
        means.append(mean)
    F, paid, F_z, l_z, l_zz = (torch.cat(parts) for parts in zip(*means, strict=True))
    if convex:
        values, vectors = torch.linalg.eigh(l_zz)
        l_zz = (vectors * values.clamp_min(0)[..., None, :]) @ vectors.mT
    x = path.x.unflatten(1, (-1, size))
    phi, slope, bend = (torch.cat(parts) for parts in zip(*(_end(problem, group) for group in x[-1]), strict=True))
    middle, mean_x = z.mean(2), x.mean(2)
    replaced = torch.zeros(mean_x.shape[:2]).bool()
    steps = Steps(middle, F, F_z, paid, l_z, l_zz, (phi, slope, bend), replaced, z[0, 0, 0])
    return backward_recursion(problem, mean_x, middle[..., problem.system.n :], steps, None, problem.noise).expansion


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
