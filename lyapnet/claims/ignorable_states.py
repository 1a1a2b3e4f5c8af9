"""States on which nothing depends that a certificate is about: it need not bound them."""

import torch

from lyapnet.graphs.tracing import trace
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.prover.branches import JUMPS
from lyapnet.task.constraints import Constraints
from lyapnet.task.cost import innermost, is_quadratic


def ignorable_states(closed_loop: ClosedLoop, constraints: Constraints | None = None) -> list[int]:
    """The indices of states on which neither f, g, ℓ, φ nor V and u depend, nor h.

    A state that is not a number makes nan of everything computed with it, so what stays finite does not depend on it. A
    jump would hide it, as nan > 0 is false and the sign of nan is 0: with jumps, no state is taken for ignorable.
    """
    if has_jumps(closed_loop):
        return []
    n = closed_loop.system.n
    found = [i for i in range(n) if not _depends_on(closed_loop, i)]
    found = [i for i in found if constraints is None or constraints.ignores(i, n)]
    return found if len(found) < n else []  # something has to bound a funnel


def _depends_on(closed_loop: ClosedLoop, i: int) -> bool:
    by_matrices = is_quadratic(innermost(closed_loop.cost))
    if by_matrices and not closed_loop.cost.ignores(i, closed_loop.system.n):
        return True
    t, x = _some_point(closed_loop)
    x[i] = torch.nan
    parts = _ingredients(closed_loop, t, x) if by_matrices else _all_ingredients(closed_loop, t, x)
    return any(bool(y.isnan().any()) for y in parts)


def has_jumps(closed_loop: ClosedLoop) -> bool:
    """Whether an operator of f, g, ℓ, φ, V or u jumps, or compares; so it seems where they cannot be traced."""
    try:
        graph = trace(lambda t, x: _all_ingredients(closed_loop, t, x), _some_point(closed_loop)).graph
    except Exception:  # of any kind: what cannot be traced is refused where it is bounded, with the reason
        return True
    results = [node.meta.get("val") for node in graph.nodes]
    truths = any(isinstance(value, torch.Tensor) and value.dtype == torch.bool for value in results)
    return truths or any(node.target in JUMPS for node in graph.nodes)


def _some_point(closed_loop: ClosedLoop) -> tuple[torch.Tensor, torch.Tensor]:
    """A (t, x) at which nothing vanishes by chance: a zero might let a solver skip what stands beside it."""
    x = 0.1 + 0.01 * torch.arange(closed_loop.system.n, dtype=torch.float64).sqrt()
    return x.new_tensor(0.01), x


def _ingredients(closed_loop: ClosedLoop, t: torch.Tensor, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """What the condition and V are made of, but for q and φ, of which the matrices of a quadratic cost tell."""
    system, V, u = closed_loop.system, closed_loop.V, closed_loop.policy(t, x)
    assert V is not None
    return system.f(x), system.g(x), system.dynamics(x, u), closed_loop.cost.R(x), V(t, x), u


def _all_ingredients(closed_loop: ClosedLoop, t: torch.Tensor, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
    cost, parts = closed_loop.cost, _ingredients(closed_loop, t, x)
    return cost.running(x, parts[-1]), cost.terminal(x), *parts
