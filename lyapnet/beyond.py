"""What a controller does after T, for which V was not trained."""

import logging

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from lyapnet.calculus import ValueFunction
from lyapnet.cost.base import quadratic_form
from lyapnet.expansions import in_float64
from lyapnet.linear_algebra import apply
from lyapnet.policy import ValuePolicy
from lyapnet.problem import Problem
from lyapnet.types import Control, Matrix, PerState, State, Time

BEYOND = {
    "hold": "V(T, x) and its law",
    "receding": "V(0, x) and its law, as if the horizon began at every step",
    "riccati": "the linear-quadratic regulator of the goal, for an infinite horizon",
    "error": "a ValueError",
}
STILL = 1e-9  # by which a mode has to decay in each step


class ContinuedValue(ValueFunction):
    """V(t, x) up to T, and after it what goes with the law."""

    V: ValueFunction
    duration: float
    beyond: str | None
    regulator: "Regulator | None"

    def __init__(self, V: ValueFunction, duration: float, beyond: str | None, regulator: "Regulator | None"):
        super().__init__()
        self.V, self.duration, self.beyond, self.regulator = V, duration, beyond, regulator

    def forward(self, t: Time, x: State) -> PerState:
        late = t > self.duration + slack(t, self.duration)
        return self.at_any_time(t, x) if late.any() else self.V(t, x)

    def at_any_time(self, t: Time, x: State) -> PerState:
        """The same by one course for all t, to be traced."""
        late = t > self.duration + slack(t, self.duration)
        value = self.V(_within(t, late, self.duration, self.beyond), x)
        return value if self.regulator is None else torch.where(late, self.regulator.cost(x), value)


class ContinuedPolicy(ValuePolicy):
    """u(t, x) = policy(t, x) before T, and from T on what `beyond` says; its V is continued likewise after T.

    Args:
        problem, policy: what is continued.
        beyond: a key of BEYOND; None: hold, and a note when it first counts.

    Raises:
        ValueError: another `beyond`; or riccati, and the goal is no equilibrium that a linear law can stabilise.
    """

    V: ContinuedValue
    policy: ValuePolicy
    beyond: str | None
    regulator: "Regulator | None"
    duration: float
    stationary: bool

    def __init__(self, problem: Problem, policy: ValuePolicy, beyond: str | None = None):
        if beyond not in (None, *BEYOND):
            raise ValueError(f"Expected beyond as one of {', '.join(BEYOND)}, got {beyond!r}; choose one of them.")
        regulator = Regulator(problem, spread=True) if beyond == "riccati" else None
        super().__init__(problem, ContinuedValue(policy.V, problem.horizon.duration, beyond, regulator))
        self.policy, self.beyond, self.regulator, self.duration = policy, beyond, regulator, problem.horizon.duration
        self.held: bool = policy.held
        self.stationary = problem.horizon.stationary  # then nothing changes at T

    def forward(self, t: Time, x: State) -> Control:
        late = t >= self.duration - slack(t, self.duration)
        if not late.any():
            return self.policy(t, x)
        if self.beyond is None and not self.stationary and bool((t > self.duration + slack(t, self.duration)).any()):
            logging.getLogger(__name__).warning(
                "note: the control law is for %g s; after that it holds the law of t = T. Load with "
                "beyond=hold, receding, riccati or error to choose.",
                self.duration,
            )
            self.beyond = "hold"
        return self.at_any_time(t, x)

    def at_any_time(self, t: Time, x: State) -> Control:
        """The same by one course for all t, to be traced; without a word on what follows T."""
        late = t >= self.duration - slack(t, self.duration)
        u = self.policy(_within(t, late, self.duration, self.beyond), x)
        return u if self.regulator is None else torch.where(late[..., None], self.regulator(x), u)


class Regulator(nn.Module):
    """u = u* − K(x − x*), kept to U: optimal for the problem linearised at its goal, over an infinite horizon.

    P solves the discrete algebraic Riccati equation of one step with u held; δᵀPδ, δ = x − x*, is what is left to pay.
    States that neither the rates nor q depend on, such as a cart's position, have no part in it.

    Args:
        purpose, instead: what asks for it, and what else can be done, for messages.
        spread: where q does not see every mode that has to be stabilised, pay φ's Hessian besides q, an Nth of it in
            each of the N steps of T, as a task that weighs its end alone asks to be held there.

    Raises:
        ValueError: the goal is no equilibrium, or no linear law stabilises it.
    """

    P: Matrix
    K: Float[Tensor, "m n"]

    def __init__(
        self, problem: Problem, purpose: str = "beyond=riccati", instead: str = "take hold", spread: bool = False
    ):
        super().__init__()
        if problem.system.constants:
            raise ValueError(f"Expected a single problem for {purpose}, got a family; {instead} or receding.")
        exact = in_float64(problem)
        x, u = exact.goal, exact.rest
        if float(exact.system.dynamics(x, u).abs().max()) > 1e-6:
            raise ValueError(f"Expected a goal that is an equilibrium for {purpose}, got another; {instead}.")
        jacobian, hessian = torch.autograd.functional.jacobian, torch.autograd.functional.hessian
        A, B = (np.asarray(part) for part in jacobian(lambda *z: exact.step(*z)[0], (x, u)))
        (Q, S), (_, R) = (
            [np.asarray(part) / 2 for part in row] for row in hessian(lambda *z: exact.step(*z)[1], (x, u))
        )
        of_end = np.asarray(hessian(exact.cost.terminal, x)) / 2 / exact.horizon.steps
        reason: Exception | None = None
        for weights in (Q, Q + of_end) if spread else (Q,):
            try:
                P, K = _stabilising(A, B, weights, S, R)
                break
            except (ValueError, np.linalg.LinAlgError) as error:
                reason = error
        else:
            raise ValueError(
                f"Expected a goal that a linear law stabilises, and a cost q that sees every mode which does not "
                f"decay, for {purpose}, got others ({reason}); give Q more weights, or {instead}."
            ) from reason
        self.problem = problem
        self.register_buffer("P", torch.as_tensor(P).to(problem.goal), persistent=False)
        self.register_buffer("K", torch.as_tensor(K).to(problem.goal), persistent=False)

    def forward(self, x: State) -> Control:
        return self.problem.controls.project(self.problem.rest - apply(self.K, x - self.problem.goal))

    def cost(self, x: State) -> PerState:
        """What is left to pay, without limits."""
        return quadratic_form(self.P, x - self.problem.goal)


def _stabilising(
    A: np.ndarray, B: np.ndarray, Q: np.ndarray, S: np.ndarray, R: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """P and K of a step x' = Ax + Bu that costs xᵀQx + 2xᵀSu + uᵀRu.

    Raises:
        ValueError, LinAlgError: there is none under which all states that count decay.
    """
    counts = (np.eye(len(A)) != A).any(0) | Q.any(0) | S.any(1)
    if not counts.any():
        raise ValueError("no state has a part in it")
    A, B, Q, S = A[counts][:, counts], B[counts], Q[counts][:, counts], S[counts]
    from scipy.linalg import solve_discrete_are  # loaded where it is asked for: it takes a tenth of a second

    P = solve_discrete_are(A, B, Q, R, s=S)
    K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A + S.T)
    slowest = float(np.abs(np.linalg.eigvals(A - B @ K)).max())
    if slowest >= 1 - STILL:
        raise ValueError(f"a regulator with a factor of {slowest:.9g} in each step")
    among_all = np.eye(len(counts))[counts]
    return among_all.T @ P @ among_all, K @ among_all


class LaterPolicy(ValuePolicy):
    """A law, and its V, on a clock that starts late: policy(t + start, x)."""

    policy: ValuePolicy
    start: float
    held: bool

    def __init__(self, problem: Problem, policy: ValuePolicy, start: float):
        super().__init__(problem, _LaterValue(policy.V, start))
        self.policy, self.start, self.held = policy, start, policy.held

    def forward(self, t: Time, x: State) -> Control:
        return self.policy(t + self.start, x)


class _LaterValue(ValueFunction):
    """V(t + start, x)."""

    def __init__(self, V: ValueFunction, start: float):
        super().__init__()
        self.V, self.start = V, start

    def forward(self, t: Time, x: State) -> PerState:
        return self.V(t + self.start, x)


def slack(t: Time, duration: float) -> float:
    """By how much a time that was added up may miss the ends of the horizon."""
    return max(1e-9, 4 * torch.finfo(t.dtype).eps) * duration


def _within(t: Time, late: Tensor, duration: float, beyond: str | None) -> Time:
    """A time within the horizon for each that is late.

    Raises:
        ValueError: it is an error.
    """
    if beyond == "receding":
        return torch.where(late, 0.0, t)
    if beyond == "error" and bool((t > duration + slack(t, duration)).any()):
        raise ValueError(
            f"Expected t within the horizon of {duration:g} s, got {float(t.max()):g}; load the controller with "
            "beyond=hold, receding or riccati."
        )
    return t.clamp(max=duration)
