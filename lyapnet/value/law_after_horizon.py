"""The control laws and value functions that can continue after T, where V was not trained; see after_horizon."""

import logging
from collections.abc import Callable

import torch
from jaxtyping import Bool
from torch import Tensor, nn

from lyapnet.base.types import Control, PerState, State, Time
from lyapnet.task.problem import Problem
from lyapnet.value.after_horizon import LAWS, REMEDY, AfterHorizon
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.policy import ValuePolicy
from lyapnet.value.regulator import Regulator

BEYOND = {**LAWS, "error": "a ValueError"}
Chooser = Callable[[], AfterHorizon]


class LawAfterHorizon(nn.Module):
    """The law after T: its name, and the regulator if it is riccati.

    Args:
        problem: the problem with T.
        beyond: a key of BEYOND; None: the result of `choose`, which is called on first use.
        noted: whether the law after T was already logged.

    Raises:
        ValueError: unknown `beyond`; or riccati, and the goal is no equilibrium that a linear law can stabilise.
    """

    problem: Problem
    regulator: Regulator | None
    _beyond: str | None

    def __init__(self, problem: Problem, beyond: str | None, choose: Chooser, noted: bool):
        super().__init__()
        if beyond not in (None, *BEYOND):
            raise ValueError(f"Expected beyond as one of {', '.join(BEYOND)}, got {beyond!r}; choose one of them.")
        self.problem, self._choose = problem, choose
        self._beyond, self.regulator = None, None
        if beyond is None and problem.horizon.stationary:  # the law does not change at T
            beyond = "hold"
        if beyond is not None:
            self._follow(beyond)
        self._noted = noted or beyond is not None

    @property
    def duration(self) -> float:
        """T, in s."""
        return self.problem.horizon.duration

    @property
    def beyond(self) -> str:
        """The name of the law; it is chosen on first use."""
        if self._beyond is None:
            self._follow(self._choose().beyond)
        assert self._beyond is not None
        return self._beyond

    def state_within(self, x: State, late: Tensor) -> State:
        """The state at which V and its law are evaluated if the horizon restarts at each step."""
        again = self.problem.system.recurring(x) if self.beyond == "receding" else x
        return x if again is x else torch.where(late[..., None], again, x)

    def note_once(self) -> None:
        """Log once which law follows T, if it was chosen automatically."""
        if not self._noted:
            self._noted = True
            logging.getLogger(__name__).warning(
                "note: the control law is for %g s; %s; %s.", self.duration, self._choose(), REMEDY
            )

    def _follow(self, beyond: str) -> None:
        self._beyond, self.regulator = beyond, Regulator(self.problem, spread=True) if beyond == "riccati" else None


class ContinuedValue(ValueFunction):
    """V(t, x) up to T, then the value of the law after T."""

    V: ValueFunction
    sequel: LawAfterHorizon

    def __init__(self, V: ValueFunction, sequel: LawAfterHorizon):
        super().__init__()
        self.V, self.sequel = V, sequel

    def forward(self, t: Time, x: State) -> PerState:
        late = is_after(t, self.sequel.duration)
        if not late.any():
            return self.V(t, x)
        if late.all() and self.sequel.beyond == "riccati":
            assert self.sequel.regulator is not None
            return self.sequel.regulator.cost(x)
        return self.at_any_time(t, x)

    def at_any_time(self, t: Time, x: State) -> PerState:
        """The same without branches on t, for tracing."""
        beyond, late = self.sequel.beyond, is_after(t, self.sequel.duration)
        t, x = _time_within(t, late, self.sequel.duration, beyond), self.sequel.state_within(x, late)
        value, regulator = self.V(t, x), self.sequel.regulator
        return value if regulator is None else torch.where(late, regulator.cost(x), value)


class ContinuedPolicy(ValuePolicy):
    """u(t, x) = policy(t, x) before T, and the law `beyond` from T on; V is continued after T in the same way.

    Args:
        problem, policy: the problem, and its law up to T.
        beyond: a key of BEYOND; None: the result of `choose`, which is called on first use and logged.
        noted: whether the law after T was already logged.

    Raises:
        ValueError: unknown `beyond`; or riccati, and the goal is no equilibrium that a linear law can stabilise.
    """

    V: ContinuedValue
    policy: ValuePolicy
    sequel: LawAfterHorizon
    held: bool

    def __init__(self, problem: Problem, policy: ValuePolicy, beyond: str | None, choose: Chooser, noted: bool = False):
        sequel = LawAfterHorizon(problem, beyond, choose, noted)
        super().__init__(problem, ContinuedValue(policy.V, sequel))
        self.policy, self.sequel, self.held = policy, sequel, policy.held

    @property
    def beyond(self) -> str:
        """The name of the law after T; it is chosen on first use."""
        return self.sequel.beyond

    def forward(self, t: Time, x: State) -> Control:
        late = is_at_end(t, self.sequel.duration)
        if not late.any():
            return self.policy(t, x)
        if bool(is_after(t, self.sequel.duration).any()):
            self.sequel.note_once()
        if late.all() and self.beyond == "riccati":
            assert self.sequel.regulator is not None
            return self.sequel.regulator(x)
        return self.at_any_time(t, x)

    def at_any_time(self, t: Time, x: State) -> Control:
        """The same without branches on t, for tracing; does not log the law after T."""
        beyond, late = self.beyond, is_at_end(t, self.sequel.duration)
        t, x = _time_within(t, late, self.sequel.duration, beyond), self.sequel.state_within(x, late)
        u, regulator = self.policy(t, x), self.sequel.regulator
        return u if regulator is None else torch.where(late[..., None], regulator(x), u)


class LaterPolicy(ValuePolicy):
    """A law and its V with shifted time: policy(t + start, x)."""

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


def is_after(t: Time, duration: float) -> Bool[Tensor, "*batch"]:
    """Whether a time is after T.

    The difference is compared, because the ONNX exporter rounds compared numbers to float32.
    """
    return t - duration > slack(t, duration)


def is_at_end(t: Time, duration: float) -> Bool[Tensor, "*batch"]:
    """Whether a time is T or after it."""
    return t - duration >= -slack(t, duration)


def slack(t: Time, duration: float) -> float:
    """Tolerance at the ends of the horizon for the rounding of summed times."""
    return max(1e-9, 4 * torch.finfo(t.dtype).eps) * duration


def _time_within(t: Time, late: Tensor, duration: float, beyond: str | None) -> Time:
    """The time at which V and its law are evaluated, within the horizon.

    Raises:
        ValueError: a time is after T, and `beyond` is error.
    """
    if beyond == "receding":
        return torch.where(late, 0.0, t)
    if beyond == "error" and bool(is_after(t, duration).any()):
        raise ValueError(
            f"Expected t within the horizon of {duration:g} s, got {float(t.max()):g}; load the controller with "
            "beyond=hold, receding or riccati."
        )
    return t.clamp(max=duration)
