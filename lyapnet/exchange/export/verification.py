"""Compares an export with its controller at many states."""

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

STATES = 10_000  # number of states for the comparison
LOOPS = 100  # number of closed loops on which half of these states are
AROUND = 0.2  # margin of the box of the other states around those of closed loops, relative to its widths
AFTER = 1.25  # latest time of the other states, relative to T
TOLERANCES = {torch.float64: 1e-9, torch.float32: 1e-3}  # largest difference, relative to the largest |u| and |V|
COMPARED_COSTS_FACTOR = (
    1e3  # factor of the tolerance for laws that compare costs, as rounding decides between equal costs
)
LARGEST_TOLERANCE = 0.05  # largest tolerance of all laws and precisions

Evaluate = Callable[[NDArray, NDArray], tuple[NDArray, NDArray]]  # t (k,), x (k, n) ↦ u (k, m), V (k,)


class Points(NamedTuple):
    """The times and states at which exports are compared, and the box that contains the states."""

    t: Tensor  # (k,)
    x: Tensor  # (k, n)
    lower: Tensor  # (n,)
    upper: Tensor  # (n,)

    def every(self, step: int) -> "Points":
        """Each point of which the number is a multiple of step, with the same box."""
        return self._replace(t=self.t[::step], x=self.x[::step])


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
    loop: LoopAgreement | None = None  # those of the loop with an estimator, if it was exported too

    def __str__(self) -> str:
        law = (
            f"on {self.states} states u is within {self.control:.1e} of the largest |u|, and V within "
            f"{self.value:.1e} of the largest |V|"
        )
        return law if self.loop is None else f"{law}; {self.loop}"


def verify(
    controller: Controller, evaluate: Evaluate, tried: Points | None = None, dtype: torch.dtype = torch.float64
) -> Agreement:
    """Compare an export with its controller at states of closed loops and around them, up to T and after it.

    Args:
        tried: `points` of the controller, if they exist already.
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
    """The largest relative difference from a law that counts as rounding, for the coarsest of some precisions."""
    looser = COMPARED_COSTS_FACTOR if isinstance(law.policy, LookaheadPolicy) else 1
    return min(LARGEST_TOLERANCE, looser * max(TOLERANCES[each] for each in precisions))


def points(controller: Controller) -> Points:
    """The states at which exports are compared: half of them on closed loops, the others around these."""
    generator = stream(0, TEST, 1)
    x0 = controller.initial_states.sample(LOOPS, generator).to(controller.initial_states.lower)
    loops = controller.rollout(x0)
    nodes = len(loops.t)
    chosen = torch.randint(nodes * LOOPS, (STATES // 2,), generator=generator)
    visited, when = loops.x.reshape(-1, x0.shape[-1])[chosen], loops.t[chosen // LOOPS]
    lower, upper = visited.amin(0), visited.amax(0)
    share = torch.rand(STATES - len(chosen), x0.shape[-1], generator=generator, dtype=torch.float64).to(x0)
    low, high = lower - AROUND * (upper - lower), upper + AROUND * (upper - lower)
    constants = list(controller.system.constants)  # V was trained for parameters of X₀ only
    low[constants] = controller.initial_states.lower[constants]
    high[constants] = controller.initial_states.upper[constants]
    around = (lower + (upper - lower) * ((1 + 2 * AROUND) * share - AROUND)).clamp(low, high)
    until = AFTER * controller.horizon.duration
    then = until * torch.rand(len(around), generator=generator, dtype=torch.float64).to(x0)
    return Points(torch.cat([when, then]), torch.cat([visited, around]), low, high)


def _difference(own: Tensor, other: NDArray) -> float:
    """The largest difference, relative to the largest entry; ∞ if one is finite where the other is not."""
    expected, found = own.double().cpu().numpy(), np.asarray(other, dtype=np.float64).reshape(own.shape)
    if not np.array_equal(np.isfinite(expected), np.isfinite(found)):
        return float("inf")
    finite = np.isfinite(expected)
    largest = float(np.abs(expected[finite]).max(initial=0.0)) or 1.0
    return float(np.abs(expected - found)[finite].max(initial=0.0)) / largest
