"""States that a closed loop does not see: its certificate need not bound them."""

import torch

from lyapnet.closed_loop import ClosedLoop
from lyapnet.policy import ValuePolicy
from lyapnet.tracing import trace


def unseen_states(closed_loop: ClosedLoop) -> list[int]:
    """The indices of states on which neither f, g, ℓ, φ nor V and u depend.

    A state that is not a number makes nan of everything computed with it, so what stays finite does not see it. A
    comparison would hide it: a closed loop with branches is taken to see every state.
    """
    if _has_branches(closed_loop):
        return []
    return [i for i in range(closed_loop.system.n) if not _sees(closed_loop, i)]


def _sees(closed_loop: ClosedLoop, i: int) -> bool:
    cost = closed_loop.cost
    weighted = [*cost.Q[i], *cost.Q[:, i], *cost.Q_T[i], *cost.Q_T[:, i]]
    x = torch.full((closed_loop.system.n,), 0.1, dtype=cost.Q.dtype)
    x[i] = torch.nan
    return any(weighted) or any(bool(y.isnan().any()) for y in _ingredients(closed_loop, x.new_zeros(()), x))


def _has_branches(closed_loop: ClosedLoop) -> bool:
    x = torch.full((closed_loop.system.n,), 0.1, dtype=closed_loop.cost.Q.dtype)
    try:
        graph = trace(lambda t, x: _ingredients(closed_loop, t, x), (x.new_zeros(()), x)).graph
    except Exception:  # of any kind: what cannot be traced is refused where it is bounded, with the reason
        return True
    results = [node.meta.get("val") for node in graph.nodes]
    return any(isinstance(value, torch.Tensor) and value.dtype == torch.bool for value in results)


def _ingredients(closed_loop: ClosedLoop, t: torch.Tensor, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """What the condition, V and the cost are made of; of the cost its R(x), as Q and Q_T are matrices."""
    system, policy = closed_loop.system, closed_loop.policy
    assert isinstance(policy, ValuePolicy)
    return system.f(x), system.g(x), closed_loop.cost.R(x), policy.V(t, x), policy(t, x)
