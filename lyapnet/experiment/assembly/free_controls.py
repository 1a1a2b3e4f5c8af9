"""Controls without a weight in R: suggests a small weight and states how much it adds to the cost."""

import math

import torch
from torch import Tensor

from lyapnet.base.errors import UsageError
from lyapnet.task.problem import Problem

COST_STATES = 256  # random states of X₀ that give the size of the cost
MAX_COST_SHARE = 0.01  # largest increase of the cost by the suggested weight


def refuse_free_controls(problem: Problem, R: Tensor) -> None:
    """Refuse an R that is only positive semidefinite if controls have limits; the error suggests another R.

    The optimum is then bang-bang, and its V has kinks, which no control law here supports. A weight r on the free
    controls adds at most r T Σ max u² to the cost. The suggested r makes this MAX_COST_SHARE of the mean of T |q| + |φ|
    over X₀.

    Args:
        problem: the problem; only q, φ, U, X₀ and T are used.
        R: (m, m), or one for each of some states (b, m, m).

    Raises:
        UsageError: R is only positive semidefinite; suggests a weight and states what it adds to the cost.
    """
    with torch.no_grad():
        diagonal = R.diagonal(dim1=-2, dim2=-1).reshape(-1, problem.system.m)
        values = torch.linalg.eigvalsh(R) if R.isfinite().all() and torch.equal(R, R.mT) else R.new_ones(1)
        free = [i for i in range(problem.system.m) if not diagonal[:, i].any()] or [*range(problem.system.m)]
        limits = problem.controls.limits
        rounding = 1e-12 * float(values.abs().max())
        if limits is None or not -rounding <= float(values.min()) <= rounding:
            return
        x = problem.initial_states.sample(COST_STATES, torch.Generator().manual_seed(0))
        q, end = (float(function(x).abs().mean()) for function in (problem.cost.state, problem.cost.terminal))
    most = torch.stack([(side - problem.rest).abs() for side in limits]).amax(0)[free]
    T = problem.horizon.duration
    cost, size = T * q + end, float((most**2).sum())
    if not (math.isfinite(size) and cost * size > 0):
        return
    r = MAX_COST_SHARE * cost / (T * size)
    r = math.floor(r / 10 ** (power := math.floor(math.log10(r)))) * 10.0**power  # rounded down to one digit
    price, names = r * T * size, ", ".join(problem.system.control_names[i] for i in free)
    own = [f"{r:.9g}" if i in free else f"{float(diagonal[0, i]):g}" for i in range(problem.system.m)]
    to_write = f"cost.R={own[0]}" if len(free) == len(own) else f"'cost.R=[{', '.join(own)}]'"
    if R.ndim > 2 or (R - R.diagonal().diag()).any():
        to_write = f"{r:.9g} more on the diagonal of R"
    raise UsageError(
        f"Expected a weight in R for every control, got none for {names}, whose optimum jumps between limits; write "
        f"{to_write}, about the least that works, which adds at most {price:.2g} to costs of {cost:.3g} "
        f"({price / cost:.1%})."
    )
