"""What a controller does after T, for which V was not trained."""

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


class Sequel(nn.Module):
    """What follows T: a law's name, and the regulator where it is riccati.

    Args:
        problem: whose T it is.
        beyond: a key of BEYOND; None: what `choose` finds, when it is first asked for.
        noted: whether it was said already what that is.

    Raises:
        ValueError: another `beyond`; or riccati, and the goal is no equilibrium that a linear law can stabilise.
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
        if beyond is None and problem.horizon.stationary:  # then nothing changes at T
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
        """The law's name; where nobody chose one, it is chosen now."""
        if self._beyond is None:
            self._follow(self._choose().beyond)
        assert self._beyond is not None
        return self._beyond

    def note_once(self) -> None:
        """Say in a log what follows T, where nobody chose it."""
        if not self._noted:
            self._noted = True
            logging.getLogger(__name__).warning(
                "note: the control law is for %g s; %s; %s.", self.duration, self._choose(), REMEDY
            )

    def _follow(self, beyond: str) -> None:
        self._beyond, self.regulator = beyond, Regulator(self.problem, spread=True) if beyond == "riccati" else None


class ContinuedValue(ValueFunction):
    """V(t, x) up to T, and after it what goes with the law."""

    V: ValueFunction
    sequel: Sequel

    def __init__(self, V: ValueFunction, sequel: Sequel):
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
        """The same by one course for all t, to be traced."""
        beyond, late = self.sequel.beyond, is_after(t, self.sequel.duration)
        value, regulator = self.V(_within(t, late, self.sequel.duration, beyond), x), self.sequel.regulator
        return value if regulator is None else torch.where(late, regulator.cost(x), value)


class ContinuedPolicy(ValuePolicy):
    """u(t, x) = policy(t, x) before T, and from T on what `beyond` says; its V is continued likewise after T.

    Args:
        problem, policy: what is continued.
        beyond: a key of BEYOND; None: what `choose` finds, when it is first asked for, and a note when it counts.
        noted: whether it was said already what that is.

    Raises:
        ValueError: another `beyond`; or riccati, and the goal is no equilibrium that a linear law can stabilise.
    """

    V: ContinuedValue
    policy: ValuePolicy
    sequel: Sequel
    held: bool

    def __init__(self, problem: Problem, policy: ValuePolicy, beyond: str | None, choose: Chooser, noted: bool = False):
        sequel = Sequel(problem, beyond, choose, noted)
        super().__init__(problem, ContinuedValue(policy.V, sequel))
        self.policy, self.sequel, self.held = policy, sequel, policy.held

    @property
    def beyond(self) -> str:
        """The name of the law after T; where nobody chose one, it is chosen now."""
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
        """The same by one course for all t, to be traced; without a word on what follows T."""
        beyond, late = self.beyond, is_at_end(t, self.sequel.duration)
        u, regulator = self.policy(_within(t, late, self.sequel.duration, beyond), x), self.sequel.regulator
        return u if regulator is None else torch.where(late[..., None], regulator(x), u)


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


def is_after(t: Time, duration: float) -> Bool[Tensor, "*batch"]:
    """Whether a time is after T.

    Differences are compared, as the exporter to ONNX rounds numbers that are compared to float32.
    """
    return t - duration > slack(t, duration)


def is_at_end(t: Time, duration: float) -> Bool[Tensor, "*batch"]:
    """Whether a time is T or after it."""
    return t - duration >= -slack(t, duration)


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
    if beyond == "error" and bool(is_after(t, duration).any()):
        raise ValueError(
            f"Expected t within the horizon of {duration:g} s, got {float(t.max()):g}; load the controller with "
            "beyond=hold, receding or riccati."
        )
    return t.clamp(max=duration)
