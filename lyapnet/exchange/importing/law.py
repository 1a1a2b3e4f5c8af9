"""V(x) and a law u(x) of other tools as a controller."""

import copy
import logging
from typing import cast

import torch
from torch import Tensor, nn

from lyapnet.base.contracts import call_checked, check_memory, copied, reaches_own_code
from lyapnet.base.contracts.batch_sizes import check_batch_sizes
from lyapnet.base.errors import UsageError
from lyapnet.base.random_streams import TEST, stream
from lyapnet.base.types import Control, PerState, State, Time
from lyapnet.controller.controller import Controller
from lyapnet.experiment.config import Config
from lyapnet.loop.rollout import Rollout
from lyapnet.task.mapped_controls import MappedControls
from lyapnet.task.problem import TEST_STATES, Problem
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.policy import ValuePolicy

STATES = 1000  # number of states at which V(x) and u(x) are tested
IN_PYTHON = "functions from Python, read in real numbers"
LEAVES = 1e-6  # largest distance of u from U that counts as rounding in float32, relative to the largest |u|


class GivenValue(ValueFunction):
    """V(t, x) = v(x) − v(x*) for every t.

    Args:
        function: v, (k, n) ↦ (k,) or (k, 1).
        goal: x*.
    """

    at_goal: Tensor

    def __init__(self, function: nn.Module, goal: State):
        super().__init__()
        self.function = function
        with torch.no_grad():
            self.register_buffer("at_goal", self._of(goal))

    def forward(self, t: Time, x: State) -> PerState:
        return self._of(x) - self.at_goal

    def _of(self, x: State) -> PerState:
        return self.function(x.reshape(-1, x.shape[-1])).reshape(x.shape[:-1])


class GivenLaw(ValuePolicy):
    """u(t, x) = the point of U closest to k(x), for every t; it does not depend on V.

    Args:
        function: k, (batch, n) ↦ (batch, m).
        origin: where v and k come from, in words.
        precision: the number type in which k is computed, whose rounding its bounds include; None for real numbers.
    """

    def __init__(
        self, problem: Problem, V: GivenValue, function: nn.Module, origin: str = IN_PYTHON,
        precision: str | None = None,
    ):  # fmt: skip
        super().__init__(problem, V)
        self.function, self.precision = function, precision
        limits = " clamped to U" if self.controls.limited else ""
        self.origin = (
            f"V(0, x) is V(x) − V(x*) with V(x*) = {float(V.at_goal)!r}, u(0, x) is u(x){limits}, and V and u are "
            f"{origin}."
        )

    def forward(self, t: Time, x: State) -> Control:
        return self.controls.project(self.unlimited(x))

    def unlimited(self, x: State) -> Control:
        """k(x), (*batch, m)."""
        return self.function(x.reshape(-1, x.shape[-1])).reshape(*x.shape[:-1], self.system.m)


def controller_of(
    problem: Problem,
    value: nn.Module,
    law: nn.Module,
    origin: str = IN_PYTHON,
    config: Config | None = None,
    precision: str | None = None,
) -> Controller:
    """A controller of V(x) and u(x) of other tools, for certificates such as `certify region`.

    It has copies of both in float64, which later training does not change.

    Args:
        problem: its system, X₀, goal and controls are used; u(x) is clamped to U, and V(x*) is subtracted from V.
        value: V, (k, n) ↦ (k,) or (k, 1).
        law: u, (k, n) ↦ (k, m).
        origin: where both come from, in words for certificates.
        config: the config of the problem, for reports.
        precision: as in GivenLaw.

    Raises:
        UsageError: the system is a family, or V or u has another shape.
    """
    require_one_system(problem)
    if isinstance(problem.controls, MappedControls):
        raise UsageError(
            f"Expected constant limits of controls for a network of others, got {problem.controls.words}; take "
            "constant ones."
        )
    problem = copied(problem)
    v, k = (copy.deepcopy(each).double().cpu().eval().requires_grad_(False) for each in (value, law))
    for name, function, size in (("V(x)", v, 1), ("u(x)", k, problem.system.m)):
        _require_size(name, function, problem.goal, size)
        _require_function(name, function, problem)
    V = GivenValue(v, problem.goal)
    policy = GivenLaw(problem, V, k, origin, precision)
    _note_where_it_leaves(policy, problem)
    return Controller(problem, V, Rollout(problem, policy, gradient="backprop"), config=config)


def require_one_system(problem: Problem) -> None:
    """Refuse a family."""
    if problem.system.constants:
        raise UsageError("Expected one system, got a family; V(x) and u(x) are of a single one.")


def states_around(problem: Problem) -> State:
    """States at which V(x) and u(x) are tested: half of them in X₀, half in a box three times as wide."""
    box, generator = problem.initial_states, stream(0, TEST, 2)
    near, wide = (box.sample(STATES // 2, generator).double() for _ in range(2))
    return torch.cat([near, box.center + 3 * (wide - box.center)])


def _note_where_it_leaves(policy: GivenLaw, problem: Problem) -> None:
    """Log a note if u(x) is not in U at some state."""
    x = states_around(problem)
    with torch.no_grad():
        u = policy.unlimited(x)
    apart = (u - policy.controls.project(u)).abs().amax(-1) > LEAVES * u.abs().amax()
    if bool(apart.any()):
        first = int(apart.int().argmax())
        logging.getLogger(__name__).warning(
            "note: u(x) leaves U, as at x = %s with u = %s: what is certified is u(x) clamped to U.",
            [round(each, 6) for each in x[first].tolist()], [round(each, 6) for each in u[first].tolist()],
        )  # fmt: skip


def _require_function(name: str, function: nn.Module, problem: Problem) -> None:
    """Refuse a function that remembers calls, or whose results depend on the size of the batch."""
    x, ends = states_around(problem)[:TEST_STATES], problem.initial_states.ends(TEST_STATES).double()

    def call(x: State) -> None:
        with torch.no_grad():
            call_checked(name, function, [x])

    check_memory({name: function}, lambda: call(x), lambda: call(ends))
    if reaches_own_code(function):
        check_batch_sizes(name, lambda x: (function(x),), [x])


def _require_size(name: str, function: nn.Module, goal: State, size: int) -> None:
    """Refuse a function that does not return `size` finite numbers at x*."""
    with torch.no_grad():
        found = call_checked(name, function, [goal[None]])
    if not isinstance(found, Tensor) or found.numel() != size:
        got = f"{found.numel()}" if isinstance(found, Tensor) else type(found).__name__
        raise UsageError(
            f"Expected {name} with {size} number{'s' * (size != 1)} for a state, got {got}; look whether V and u are "
            "swapped, and whether they are about this system."
        )
    if not bool(cast(Tensor, found).isfinite().all()):
        raise UsageError(f"Expected finite {name} at the goal, got {found.flatten().tolist()}; correct it.")
