"""Ignorable states: no function in a certificate depends on them, so a claim need not bound them."""

import torch

from lyapnet.claims.control_sets import reads_as_written
from lyapnet.graphs.tracing import trace
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.prover.branches import JUMPS
from lyapnet.task.constraints import Constraints
from lyapnet.task.cost import innermost, is_quadratic
from lyapnet.value.policy import ValuePolicy


def ignorable_states(closed_loop: ClosedLoop, constraints: Constraints | None = None) -> list[int]:
    """The indices of the states on which none of f, g, ℓ, φ, V, u, h and σ depends.

    A state is set to nan; results without nan do not depend on it. Jumps would hide the nan, since nan > 0 is false and
    the sign of nan is 0; if there are jumps, no state counts as ignorable.
    """
    if has_jumps(closed_loop):
        return []
    n = closed_loop.system.n
    found = [i for i in range(n) if not _depends_on(closed_loop, i)]
    found = [i for i in found if constraints is None or constraints.ignores(i, n)]
    return found if len(found) < n else []  # a funnel needs at least one state


def _depends_on(closed_loop: ClosedLoop, i: int) -> bool:
    by_matrices = is_quadratic(innermost(closed_loop.cost))
    if by_matrices and not closed_loop.cost.ignores(i, closed_loop.system.n):
        return True
    t, x = _generic_point(closed_loop)
    x[i] = torch.nan
    parts = _parts_without_cost(closed_loop, t, x) if by_matrices else _all_parts(closed_loop, t, x)
    return any(bool(y.isnan().any()) for y in parts)


def has_jumps(closed_loop: ClosedLoop) -> bool:
    """Whether f, g, ℓ, φ, V or u may jump: one of their operators jumps or compares, or they cannot be traced.

    A u that is no closed form counts as one that jumps, because Newton's method compares numbers.
    """
    policy = closed_loop.policy
    if isinstance(policy, ValuePolicy) and not reads_as_written(policy):
        return True
    try:
        graph = trace(lambda t, x: _all_parts(closed_loop, t, x), _generic_point(closed_loop)).graph
    except Exception:  # user code may raise anything; the proof refuses it later, with the reason
        return True
    results = [node.meta.get("val") for node in graph.nodes]
    truths = any(isinstance(value, torch.Tensor) and value.dtype == torch.bool for value in results)
    return truths or any(node.target in JUMPS for node in graph.nodes)


def _generic_point(closed_loop: ClosedLoop) -> tuple[torch.Tensor, torch.Tensor]:
    """A point (t, x) without zeros."""
    x = 0.1 + 0.01 * torch.arange(closed_loop.system.n, dtype=torch.float64).sqrt()
    return x.new_tensor(0.01), x


def _parts_without_cost(closed_loop: ClosedLoop, t: torch.Tensor, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """σ, f, g, f + gu, R, V and u at a point; without q and φ, as a quadratic cost is checked by its matrices."""
    system, V, u = closed_loop.system, closed_loop.V, closed_loop.policy(t, x)
    assert V is not None
    noise = [] if closed_loop.noise is None else [closed_loop.noise(x)]
    return *noise, system.f(x), system.g(x), system.dynamics(x, u), closed_loop.cost.R(x), V(t, x), u


def _all_parts(closed_loop: ClosedLoop, t: torch.Tensor, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
    cost, parts = closed_loop.cost, _parts_without_cost(closed_loop, t, x)
    return cost.running(x, parts[-1]), cost.terminal(x), *parts
