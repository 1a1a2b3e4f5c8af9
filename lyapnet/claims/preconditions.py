"""Checks of a closed loop and V before a proof; and conversions between boxes of states and boxes of (t, x)."""

import logging
from collections.abc import Callable, Iterable, Sequence

import torch
from torch import Tensor, nn

from lyapnet.base.contracts import Memory, call_checked, check_function, check_memory, reaches_own_code
from lyapnet.base.contracts.batch_sizes import check_batch_sizes
from lyapnet.base.errors import UsageError
from lyapnet.base.linear_algebra import apply
from lyapnet.base.types import Corner, Corners, State, Time, Value
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.prover.bounds import BoundedFunction
from lyapnet.prover.boxes import random_points
from lyapnet.prover.branches import JUMPS
from lyapnet.prover.condition import DecreaseCondition, OwnOperations, own_constraints
from lyapnet.task.problem import TEST_STATES, Problem
from lyapnet.task.sets import Box
from lyapnet.value.calculus import ValueFunction

ROUNDING_OF_ZERO = 1e-200  # largest bound of a rate that counts as 0; bounds of 0 have a tiny margin for rounding


def freeze(condition: DecreaseCondition, sample: tuple[Corner, Corner]) -> Memory:
    """Check the closed loop, and replace V and h of a condition by their traces, for all later bounds.

    Returns:
        A record of the closed loop's attributes; its `check` refuses a loop that later calls have changed.
    """
    loop, h = condition.closed_loop, condition.constraints
    memory = check_loop(loop, h, sample)
    own = OwnOperations(condition.V, sample)
    if h is not None:
        condition.constraints = own_constraints(h, sample)
    check_states(condition, sample)
    memory.check()
    condition.V = own
    return memory


def check_loop(loop: ClosedLoop, constraints: nn.Module | None, domain: tuple[Corner, Corner]) -> Memory:
    """Refuse a closed loop that remembers calls, or whose results depend on the size of the batch.

    The loop must not be traced before: these calls make its lazily computed attributes.
    """
    lower, upper = domain
    points = random_points(lower, upper, TEST_STATES, torch.Generator().manual_seed(0))
    ends = Box(lower, upper).ends(TEST_STATES)

    def everything(t: Tensor, x: Tensor) -> tuple[Tensor, ...]:
        policy, V = loop.policy, loop.V
        results = [loop.slope(x, policy(t, x)), loop.cost.terminal(x)]
        results += [] if V is None else [V(t, x)]
        results += [] if constraints is None else [constraints(x)]
        results += [] if loop.noise is None else [loop.noise(x)]
        # methods inherited from the base class follow from V(t, x) and policy(t, x)
        if V is not None and type(V).value_and_state_gradient is not ValueFunction.value_and_state_gradient:
            results.append(V.value_and_state_gradient(t, x)[1])
        if reaches_own_code(getattr(type(policy), "with_value", None)):
            results.append(loop.control(t, x).u)
        return tuple(results)

    def call(points: Tensor) -> None:
        call_checked("f, g, the cost, V and u", everything, [points[:, 0], points[:, 1:]])

    parts = [loop.system, loop.cost, loop.V, constraints, loop.policy, loop.noise]
    named = {type(part).__name__: part for part in parts if part is not None}
    memory = check_memory(named, lambda: call(points), lambda: call(ends))
    if reaches_own_code(named):
        why = check_batch_sizes("f, g, the cost, V and u", everything, [points[:, 0], points[:, 1:]])
        if why is not None:
            logging.getLogger(__name__).warning(
                "note: only batches of 1, 2 and %d states are tested: %s", TEST_STATES, why
            )
    return memory


def check_states(condition: DecreaseCondition, domain: tuple[Corner, Corner]) -> None:
    """Refuse a condition whose values on batches, which closed loops use, differ from those at single points."""
    lower, upper = domain
    _require_constant(condition.closed_loop, domain)
    points = random_points(lower, upper, TEST_STATES, torch.Generator().manual_seed(0))

    def all_three(t: Tensor, x: Tensor) -> Tensor:
        return torch.stack([condition(t, x), condition.height(t, x), condition.closed_loop.cost.terminal(x)], -1)

    t, x = points[:, 0], points[:, 1:]
    check_function("the condition, V and φ", all_three, [t, x], (3,), differentiable=False, any_size=False)
    if condition.constraints is not None:
        k = len(condition.constraints.names)
        check_function(
            "h(x) with a number for each name", condition.constraints, [x], (k,), differentiable=False, any_size=False
        )
    with torch.no_grad():
        own = torch.stack([condition.V(*point) for point in zip(t, x, strict=True)])
        if not _close(own, condition.V(t, x)):
            raise UsageError(
                "Expected V to be a function of (t, x) alone, got other values than at first; let it read nothing else."
            )
        check_parts(condition.closed_loop, t, x)


def check_parts(loop: ClosedLoop, t: Tensor, x: Tensor) -> None:
    """Refuse a closed loop that differs from its parts f, g, ℓ and u, and a cost ℓ < 0, at some states."""
    system, u = loop.system, loop.policy(t, x)
    parts = torch.cat([system.f(x) + apply(system.g(x), u), loop.cost.running(x, u)[..., None]], -1)
    if not _close(loop.slope(x, u), parts) or not _close(loop.control(t, x).u, u):
        raise UsageError(
            f"Expected a closed loop that runs by ẋ = f(x) + g(x)u, ℓ and u = policy(t, x), got another one; make "
            f"{type(system).__name__}.dynamics, {type(loop.policy).__name__}.with_value and "
            f"{type(loop).__name__}.slope agree with these each time."
        )
    cost = parts[..., -1]
    least = int(cost.argmin())
    if cost[least] < -1e-9 * cost.abs().max():
        raise UsageError(
            f"Expected ℓ(x, u) ≥ 0, got {float(cost[least]):.6g} at x = {x[least].tolist()}; V need not fall there; "
            "correct the cost, or choose a smaller set."
        )


def require_goal(problem: Problem, claim: str) -> None:
    """Refuse a task without a goal.

    Args:
        claim: the kind of the certificate, for the message.

    Raises:
        UsageError: the task has no goal; with the reason.
    """
    if not problem.has_goal:
        raise UsageError(
            f"Expected a task with a goal, towards which V falls, for a {claim} certificate, got none: "
            f"{problem.no_goal}; lyapnet certify tube bounds the cost of such a task."
        )


def require_no_noise(problem: Problem, claim: str) -> None:
    """Refuse a claim about the closed loop without noise, for a task that has some.

    Args:
        claim: the name of the certificate, for the message.

    Raises:
        UsageError: the task has noise.
    """
    if problem.noise is not None:
        raise UsageError(
            f"Expected a task without noise for a {claim} certificate, got one with noise, under which nothing is "
            "sure; lyapnet certify statistical draws the noise too."
        )


def _close(one: Tensor, other: Tensor) -> bool:
    return one.shape == other.shape and torch.allclose(one, other, rtol=1e-6, atol=1e-6 * float(other.abs().max()))


def require_continuous(V: Value, x_low: State, x_high: State) -> None:
    """Refuse a V that may jump: W could rise at a jump although c ≤ 0, since the gradient does not show it."""
    lower, upper = at_time(0.0, x_low, x_high)
    jumps = BoundedFunction(lambda t, x: (V(t, x),), (lower[0], upper[0])).operators & JUMPS.keys()
    if jumps:
        raise UsageError(
            f"Expected a continuous V, got {' and '.join(sorted(map(str, jumps)))}, which may jump; write V with "
            "relu, abs, maximum, minimum or clamp."
        )


def at_time(t: float, lower: State, upper: State) -> tuple[Corners, Corners]:
    """The box {t} × [lower, upper]."""
    time = torch.tensor([t], dtype=lower.dtype)
    return torch.cat([time, lower])[None], torch.cat([time, upper])[None]


def slice_at_zero(states: Box, left_out: Sequence[int]) -> Box:
    """The slice of a box at which the states left_out are 0, in float64."""
    lower, upper = states.lower.double(), states.upper.double()
    seen = torch.tensor([i not in left_out for i in range(states.dimension)])
    return Box(torch.where(seen, lower, 0.0), torch.where(seen, upper, 0.0))


def at_centre(states: Box, axes: Iterable[int]) -> Box:
    """The slice of a box in the middle along some axes."""
    chosen = torch.tensor([i in axes for i in range(states.dimension)])
    return Box(*(torch.where(chosen, states.center, side) for side in (states.lower, states.upper)))


def first_states(states: Box, n: int) -> Box:
    """A box projected onto its first n states."""
    return Box(states.lower[:n], states.upper[:n])


def append_constants(box: Box, states: Box) -> Box:
    """A box of the first n states, extended by the bounds of `states` along the constants that follow."""
    n = box.dimension
    return Box(torch.cat([box.lower, states.lower[n:]]), torch.cat([box.upper, states.upper[n:]]))


def _require_constant(loop: ClosedLoop, domain: tuple[Corner, Corner]) -> None:
    """Refuse constants that change under the control law."""
    constants = list(loop.system.constants)
    if constants:
        require_still(lambda t, x: (loop.system.dynamics(x, loop.policy(t, x))[constants],), domain)


def require_still(
    rates: Callable[[Time, State], tuple[Tensor, ...]], domain: tuple[Corner, Corner], under: str = ""
) -> None:
    """Refuse constants whose rates are not 0, since claims assume that no closed loop leaves D along them.

    Args:
        under: the controls for which this is tested, in words.
    """
    bounds = BoundedFunction(rates, domain).bounds(*(end[None] for end in domain))
    if not all(bool(torch.maximum(-low, high).max() <= ROUNDING_OF_ZERO) for low, high in bounds):
        raise UsageError(
            f"Expected ẋ = 0 for the constants of a system{under}, got other rates; declare only constant states."
        )


def require_dimension(states: Box, initial_states: Box) -> None:
    """Refuse a set D with another number of states than X₀."""
    if states.dimension != initial_states.dimension:
        raise UsageError(
            f"Expected a set of {initial_states.dimension} states, got {states.dimension}; give bounds for each state."
        )


def domain_around(
    states: Box, initial_states: Box, duration: float, left_out: Sequence[int], constants: Sequence[int]
) -> tuple[Corner, Corner]:
    """[0, T] × D as (lower, upper).

    Raises:
        UsageError: D does not contain X₀ in its interior.
    """
    require_dimension(states, initial_states)
    outside = (states.lower >= initial_states.lower) | (states.upper <= initial_states.upper)
    for i in constants:
        outside[i] = states.lower[i] > initial_states.lower[i] or states.upper[i] < initial_states.upper[i]
    outside[left_out] = False
    if outside.any():
        i = int(torch.nonzero(outside)[0])
        raise UsageError(
            f"Expected a set around X₀, got [{states.lower[i]:g}, {states.upper[i]:g}] around "
            f"[{initial_states.lower[i]:g}, {initial_states.upper[i]:g}] at index {i}; choose a larger one."
        )
    return over_time(states, duration)


def over_time(states: Box, duration: float) -> tuple[Corner, Corner]:
    """[0, T] × states as (lower, upper)."""
    time = torch.tensor([0.0, duration], dtype=torch.float64)
    return torch.cat([time[:1], states.lower.double()]), torch.cat([time[1:], states.upper.double()])
