"""The error of gradients: against backpropagation in float64, and against continuous time."""

import copy
import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lyapnet.base.types import State
from lyapnet.lab.bench.cases import Case, derivatives, flat, trained
from lyapnet.lab.bench.routes import EXACT, REFERENCE
from lyapnet.loop.programs import ValueProgram
from lyapnet.loop.rollout import ADAPTIVE_METHODS
from lyapnet.task.horizon import TABLEAUX

SLICE = 256  # number of states whose graph the reference stores at once
READ_AXES = {"x": 1, "running_cost": 1, "terminal_cost": 0, "value": 1}  # tensor that a loss may use ↦ axis of states


def reference_gradient(case: Case, x0: State) -> Tensor:
    """∂loss/∂θ by backpropagation in float64, of V and the task as they are: one float64 vector.

    So that memory need only hold the graph of a slice of the batch: first all trajectories, and the loss's derivatives
    by them; then the derivatives of the trajectories, slice by slice.
    """
    rollout, slices = copy.deepcopy(case.rollout(REFERENCE)).double(), x0.double().split(SLICE)
    theta = trained(rollout.get_submodule("closed_loop.policy.V"))
    with torch.no_grad():
        parts = [rollout(part) for part in slices]
    whole = {key: torch.cat([getattr(part, key) for part in parts], axis) for key, axis in READ_AXES.items()}
    columns = [column.requires_grad_() for column in whole.values()]
    bars = derivatives([case.program(parts[0]._replace(**whole)).loss], columns)
    sliced_bars = [bar.split(SLICE, axis) for bar, axis in zip(bars, READ_AXES.values(), strict=True)]
    shares = []
    for part, *part_bars in zip(slices, *sliced_bars, strict=True):
        trajectory = rollout(part)
        shares.append(flat(derivatives([getattr(trajectory, key) for key in whole], theta, part_bars)))
    return torch.stack(shares).sum(0)


def relative_error(gradient: Tensor, reference: Tensor) -> float:
    """‖gradient − reference‖ / ‖reference‖."""
    return float((gradient - reference).norm() / reference.norm())


class Accuracy(NamedTuple):
    """The error of one gradient, and its work."""

    route: str
    method: str
    evaluations: int  # calls of the closed loop f + gu for each trajectory, forward and backward
    discretisation_error: float  # against backpropagation through the same steps
    continuous_error: float  # against the gradient as Δt → 0


def gradient_accuracy(case: Case, batch: int = 4, halvings: int = 4) -> list[Accuracy]:
    """Gradients of the mean trajectory cost J over the same T, in ever more steps or at ever tighter tolerances.

    The steps are the task's, halved `halvings` times to once. J alone, since its gradient has a limit as Δt → 0 under
    any program; the limit is taken from rk4 in the task's own number of steps. The law is read at every t, which is the
    limit of those that are held over a step. Evaluations are counted where torchdiffeq makes them; discrete evaluates s
    stages at N + 1 nodes and linearises each of them once: 2s(N + 1).
    """
    case = case._replace(program=ValueProgram(constraint=0.0, trajectory_cost=1.0, normalise=False))
    x0, N = case.sample(batch), case.problem.horizon.steps
    limit, _ = _counted(case, x0, REFERENCE, method="rk4")
    refinements = sorted({math.ceil(N / 2**k) for k in range(1, halvings + 1)})
    settings: list[tuple[int, dict[str, Any]]] = [
        (steps, {"method": method}) for method in ("euler", "rk4") for steps in refinements
    ]
    settings += [
        (refinements[0], {"method": "dopri5", "rtol": rtol, "atol": 1e-2 * rtol}) for rtol in (1e-3, 1e-5, 1e-7, 1e-9)
    ]
    points = []
    for steps, options in settings:
        routes = [REFERENCE, "adjoint", *([EXACT] if options["method"] not in ADAPTIVE_METHODS else [])]
        results = [_counted(case.in_steps(steps), x0, route, **options) for route in routes]
        for route, (gradient, evaluations) in zip(routes, results, strict=True):
            errors = relative_error(gradient, results[0][0]), relative_error(gradient, limit)
            points.append(Accuracy(route, options["method"], evaluations, *errors))
    return points


def _counted(case: Case, x0: State, route: str, **options: Any) -> tuple[Tensor, int]:
    """The gradient by a route, and its evaluations of the closed loop."""
    rollout = case.rollout(route, policy="hjb", **options)
    calls: list[None] = []
    rollout.closed_loop.register_forward_hook(lambda *_: calls.append(None))
    gradient = flat(case.gradient(rollout, x0))
    if route == EXACT:
        return gradient, 2 * len(TABLEAUX[rollout.method].b) * (rollout.horizon.steps + 1)
    return gradient, len(calls)
