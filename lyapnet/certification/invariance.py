"""States that a closed loop does not see: its certificate need not bound them."""

import torch

from lyapnet.certification.branches import JUMPS
from lyapnet.closed_loop import ClosedLoop
from lyapnet.policy import ValuePolicy
from lyapnet.tracing import trace


def unseen_states(closed_loop: ClosedLoop) -> list[int]:
    """The indices of states on which neither f, g, ℓ, φ nor V and u depend.

    A state that is not a number makes nan of everything computed with it, so what stays finite does not see it. A jump
    would hide it, as nan > 0 is false and the sign of nan is 0: a closed loop with jumps is taken to see every state.
    """
    if _has_jumps(closed_loop):
        return []
    return [i for i in range(closed_loop.system.n) if not _sees(closed_loop, i)]


def _sees(closed_loop: ClosedLoop, i: int) -> bool:
    cost = closed_loop.cost
    weighted = [*cost.Q[i], *cost.Q[:, i], *cost.Q_T[i], *cost.Q_T[:, i]]
    t, x = _some_point(closed_loop)
    x[i] = torch.nan
    return any(weighted) or any(bool(y.isnan().any()) for y in _ingredients(closed_loop, t, x))


def _has_jumps(closed_loop: ClosedLoop) -> bool:
    try:
        graph = trace(lambda t, x: _ingredients(closed_loop, t, x), _some_point(closed_loop)).graph
    except Exception:  # of any kind: what cannot be traced is refused where it is bounded, with the reason
        return True
    results = [node.meta.get("val") for node in graph.nodes]
    truths = any(isinstance(value, torch.Tensor) and value.dtype == torch.bool for value in results)
    return truths or any(node.target in JUMPS for node in graph.nodes)


def _some_point(closed_loop: ClosedLoop) -> tuple[torch.Tensor, torch.Tensor]:
    """A (t, x) at which nothing vanishes by chance: a zero might let a solver skip what stands beside it."""
    x = 0.1 + 0.01 * torch.arange(closed_loop.system.n, dtype=closed_loop.cost.Q.dtype).sqrt()
    return x.new_tensor(0.01), x


def _ingredients(closed_loop: ClosedLoop, t: torch.Tensor, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """What the condition, V and the cost are made of; of the cost its R(x), as Q and Q_T are matrices."""
    system, policy = closed_loop.system, closed_loop.policy
    assert isinstance(policy, ValuePolicy)
    return system.f(x), system.g(x), closed_loop.cost.R(x), policy.V(t, x), policy(t, x)
