"""Tasks without end: what a regulator goes on to pay after T, as the terminal cost."""

import torch
from scipy.linalg import LinAlgError, solve_discrete_are
from torch import Tensor

from lyapnet.cost import RegulatorTail
from lyapnet.errors import UsageError
from lyapnet.expansions import in_float64, jacobian
from lyapnet.problem import Problem


def without_end(problem: Problem) -> Problem:
    """The problem with φ = (x − x*)ᵀP(x − x*), the infinite-horizon cost of the regulator linearised at the goal.

    ½ ∂²φ = P solves the discrete algebraic Riccati equation of the horizon's step, so that V of the linearised problem
    is φ at every t, whatever T is. Limits must not be met at the goal.

    Raises:
        UsageError: no control holds the goal, a limit is met there, or no regulator brings the state there.
    """
    n = problem.system.n
    exact = in_float64(problem.replaced(cost=RegulatorTail(problem.cost, torch.zeros(n, n))))
    goal, rest = exact.goal, exact.rest
    if problem.controls.limits is None:
        raise UsageError(
            f"Expected controls without limits, or a set that tells its `limits`, for horizon.stationary, got "
            f"{type(problem.controls).__name__}; choose another, or stationary: false."
        )
    lower, upper = (side.to(rest) for side in problem.controls.limits)
    if not bool((lower < rest).all() and (rest < upper).all()):
        raise UsageError(
            f"Expected limits around the control at the goal, {rest.tolist()}, for horizon.stationary, got "
            f"{lower.tolist()} to {upper.tolist()}; widen controls, or choose another target."
        )
    drift = exact.system.dynamics(goal, rest).abs()
    if float(drift.max()) > 1e-6:
        raise UsageError(
            f"Expected a goal that some control holds for horizon.stationary, got {float(drift.max()):.3g} for the "
            f"rate of {exact.system.state_names[int(drift.argmax())]} there; name a target with its target_control."
        )
    return problem.replaced(cost=RegulatorTail(problem.cost, _regulator(exact, goal, rest)))


def _regulator(problem: Problem, goal: Tensor, rest: Tensor) -> Tensor:
    """P, zero in the states that nothing depends on."""
    n = len(goal)
    with torch.enable_grad():
        z = torch.cat([goal, rest]).requires_grad_()
        F, paid = problem.step(z[:n], z[n:])
        F_z = jacobian(F, z).detach()
        l_zz = jacobian(jacobian(paid[None], z)[0], z).detach()
    A, B, own = F_z[:, :n], F_z[:, n:], torch.eye(n).to(F_z)
    seen = [i for i in range(n) if bool((A[:, i] != own[:, i]).any() or l_zz[i].any())]
    Q, S, R = l_zz[:n, :n], l_zz[:n, n:], l_zz[n:, n:]
    P = torch.zeros(n, n).to(F_z)
    try:
        solution = solve_discrete_are(A[seen][:, seen], B[seen], Q[seen][:, seen], R, s=S[seen])
    except (LinAlgError, ValueError) as error:
        raise UsageError(
            "Expected a goal that a linear-quadratic regulator reaches for horizon.stationary, got one that it does "
            f"not ({error}); weigh every state that drifts, in cost.Q, or choose another goal."
        ) from error
    P[torch.tensor(seen)[:, None], torch.tensor(seen)] = torch.as_tensor(solution).to(P) / 2
    return (P + P.mT) / 2
