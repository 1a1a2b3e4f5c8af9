"""What was written, held against the controller on many states."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lyapnet.base.errors import ExportError
from lyapnet.base.random_streams import TEST, stream
from lyapnet.controller.controller import Controller
from lyapnet.value.law_after_horizon import ContinuedPolicy
from lyapnet.value.policy import LookaheadPolicy

STATES = 10_000
LOOPS = 100  # closed loops, of whose states half of them are
AROUND = 0.2  # of the widths of the box of those states, by which the others may leave it
AFTER = 1.25  # of T: their latest time
TOLERANCES = {torch.float64: 1e-9, torch.float32: 1e-3}  # relative to the largest |u| and |V|
LOOSER = 1e3  # for a law that compares costs: rounding decides between controls that cost the same
MOST = 0.05  # tolerance that no law and no precision may pass

Evaluate = Callable[[NDArray, NDArray], tuple[NDArray, NDArray]]  # t (k,), x (k, n) ↦ u (k, m), V (k,)


class Points(NamedTuple):
    """What exports are held against: times, states, and the box that these states are in."""

    t: Tensor  # (k,)
    x: Tensor  # (k, n)
    lower: Tensor  # (n,)
    upper: Tensor  # (n,)


class LoopAgreement(NamedTuple):
    """The largest differences of an exported loop from the loop in Python, over closed loops from noisy readings."""

    steps: int
    control: float  # of u, relative to the largest |u|
    estimate: float  # of x̂, relative to the largest of each state
    covariance: float  # of P, relative to the largest of its entries

    def __str__(self) -> str:
        return (
            f"over {self.steps} steps of closed loops u is within {self.control:.1e} of the largest |u|, the estimate "
            f"within {self.estimate:.1e}, and its covariance within {self.covariance:.1e}"
        )


class Agreement(NamedTuple):
    """The largest differences of an export from its controller."""

    states: int
    control: float  # of |u − u'|, relative to the largest |u|
    value: float  # of |V − V'|, relative to the largest |V|
    loop: LoopAgreement | None = None  # of the loop with an estimator, where that was exported too

    def __str__(self) -> str:
        law = (
            f"on {self.states} states u is within {self.control:.1e} of the largest |u|, and V within "
            f"{self.value:.1e} of the largest |V|"
        )
        return law if self.loop is None else f"{law}; {self.loop}"


def verify(
    controller: Controller, evaluate: Evaluate, tried: Points | None = None, dtype: torch.dtype = torch.float64
) -> Agreement:
    """Hold an export against its controller: on states of closed loops, and around them, up to and after T.

    Args:
        tried: `points` of the controller, if they are known.
        dtype: the precision of the export.

    Raises:
        ExportError: they differ by more than rounding.
    """
    t, x, *_ = points(controller) if tried is None else tried
    law = controller.law
    with torch.no_grad():
        expected = controller.controls.applied(x, law.at_any_time(t, x)), law.V.at_any_time(t, x)
    found = evaluate(t.double().cpu().numpy(), x.double().cpu().numpy())
    differences = [_difference(own, other) for own, other in zip(expected, found, strict=True)]
    agreement = Agreement(len(t), differences[0], differences[1])
    if not max(differences) <= tolerance_of(law, x.dtype, dtype):
        raise ExportError(
            f"Expected the controller's own u and V, got others: {agreement}; report this with f, g, the cost and the "
            "network. Nothing was written."
        )
    return agreement


def tolerance_of(law: ContinuedPolicy, *precisions: torch.dtype) -> float:
    """The largest relative difference from a law that counts as rounding, in the coarsest of some precisions."""
    looser = LOOSER if isinstance(law.policy, LookaheadPolicy) else 1
    return min(MOST, looser * max(TOLERANCES[each] for each in precisions))


def points(controller: Controller) -> Points:
    """The states that exports are held against: half of them of closed loops, the others around these."""
    generator = stream(0, TEST, 1)
    x0 = controller.initial_states.sample(LOOPS, generator).to(controller.initial_states.lower)
    loops = controller.rollout(x0)
    nodes = len(loops.t)
    chosen = torch.randint(nodes * LOOPS, (STATES // 2,), generator=generator)
    visited, when = loops.x.reshape(-1, x0.shape[-1])[chosen], loops.t[chosen // LOOPS]
    lower, upper = visited.amin(0), visited.amax(0)
    share = torch.rand(STATES - len(chosen), x0.shape[-1], generator=generator, dtype=torch.float64).to(x0)
    low, high = lower - AROUND * (upper - lower), upper + AROUND * (upper - lower)
    constants = list(controller.system.constants)  # what V was told of
    low[constants] = controller.initial_states.lower[constants]
    high[constants] = controller.initial_states.upper[constants]
    around = (lower + (upper - lower) * ((1 + 2 * AROUND) * share - AROUND)).clamp(low, high)
    until = AFTER * controller.horizon.duration
    then = until * torch.rand(len(around), generator=generator, dtype=torch.float64).to(x0)
    return Points(torch.cat([when, then]), torch.cat([visited, around]), low, high)


def _difference(own: Tensor, other: NDArray) -> float:
    """The largest difference, relative to the largest entry; infinite where one has no number and the other has."""
    expected, found = own.double().cpu().numpy(), np.asarray(other, dtype=np.float64).reshape(own.shape)
    if not np.array_equal(np.isfinite(expected), np.isfinite(found)):
        return float("inf")
    finite = np.isfinite(expected)
    largest = float(np.abs(expected[finite]).max(initial=0.0)) or 1.0
    return float(np.abs(expected - found)[finite].max(initial=0.0)) / largest
