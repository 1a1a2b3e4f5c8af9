"""Measures of a controller on a task with noise: expectations over many paths from each initial state."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lyapnet.base.random_streams import NOISE, TEST, stream
from lyapnet.base.types import PerState, State
from lyapnet.controller.controller import Controller
from lyapnet.evaluation.intervals import half_width_of_mean
from lyapnet.evaluation.oracles import Report, silent
from lyapnet.evaluation.references import costs_of_lqr
from lyapnet.evaluation.states import StateTable, cost_within_domain, measure
from lyapnet.loop.rollout import NoisyTrajectory
from lyapnet.value.risk import mean_with_risk

QUANTILES = (0.05, 0.5, 0.95)  # probabilities of the reported quantiles of the costs of all paths
ENOUGH_PATHS, FEWEST_PATHS = 0.2, 8  # share and number of paths that have to count in a mean of exponentials
FAR_FROM_ONE = 0.1  # distance from 1 of a sample mean with expectation 1, above which the sample is too small
DEAREST = 0.05  # share of the most expensive paths from a state, whose mean cost measures its risk
LOST_EXCESS = 0.5  # (J − M − V(0, x₀)) / V(0, x₀), V at least its mean on X₀, above which a path counts as lost


class NoiseMeasures(NamedTuple):
    """The measures of many paths of noise.

    E J is estimated by the mean of J − M, with M the martingale of V (see lyapnet.loop.rollout.expectations): it has
    the mean of J for any V, and varies less if V is close to the cost to go. For a risk θ see
    NoisyTrajectory.exponentials; if θ times the spread of J is large, hardly any path counts in the mean of an
    exponential, and it is not measured.
    """

    paths: int  # number of paths from each initial state
    mean: float  # mean of J − M, an estimate of E J
    half_width: float  # half-width of the 95 % interval of E J, averaged over the states
    plain_mean: float  # mean of J itself
    plain_half_width: float  # half-width of its 95 % interval
    quantiles: dict[str, float]  # quantiles of J over all states and paths, by probability
    dearest_mean: float  # mean of J over the 5 % of paths of highest cost from a state, averaged over the states
    lost_fraction: float  # share of paths whose J − M exceeds V(0, x₀) by LOST_EXCESS
    risk: float  # θ
    with_risk: float | None  # mean over the states of (1/θ) log E exp(θJ); None if θ = 0 or it cannot be measured
    with_risk_half_width: float | None  # half-width of its 95 % interval


@torch.no_grad()
def measure_under_noise(
    controller: Controller, x0: State, paths: int, counted: int, seed: int = 0, progress: Report = silent
) -> tuple[StateTable, NoiseMeasures, PerState | None]:
    """(table with one row for each state, measures of the noise, E J under LQR or None if there is no such law).

    LQR is rolled out on the same paths; its E J is that of the controller plus the mean difference of both costs. With
    a risk, the costs of the table and of LQR are certainty equivalents, where these can be measured.

    Args:
        counted: the measures are about this number of first states.
    """
    problem, horizon = controller.problem, controller.horizon
    assert problem.noise is not None
    controller.compile_for(x0)
    tables, plain, lqr, growths, checks = (
        list[StateTable](),
        list[Tensor](),
        list[Tensor](),
        list[Tensor](),
        list[Tensor](),
    )
    for path in range(paths):
        progress(path, paths)
        noise = problem.noise.draw(horizon.steps, horizon.dt, x0, stream(seed, TEST, NOISE, path))
        trajectory = controller.closed_loops(x0, noise, with_surprises=path == 0)
        expected, left = cost_within_domain(problem, trajectory)
        tables.append(replace(measure(problem, controller.program, trajectory), cost=expected, left=left))
        plain.append(trajectory.cost.where(expected.isfinite(), torch.inf))
        assert isinstance(trajectory, NoisyTrajectory)
        if problem.risk:
            growth, check = trajectory.exponentials
            growths.append(growth.where(expected.isfinite(), torch.inf))
            checks.append(check)
        other = costs_of_lqr(problem, x0, noise)
        lqr += [] if other is None else [other]
    table = average(tables)
    cost, J = torch.stack([each.cost for each in tables])[:, :counted], torch.stack(plain)[:, :counted]
    value, with_risk, half_width = table.value[:counted], None, None
    if problem.risk and _enough_paths_count(torch.stack(checks)):
        growth = torch.stack(growths)
        factor = 1 + growth.mean(0)
        if (factor > 0).all():
            equivalent = table.value + (factor.log() / problem.risk).to(table.value)
            table, with_risk = replace(table, cost=equivalent), float(equivalent[:counted].mean())
            half_width = half_width_of_mean((growth / (problem.risk * factor))[:, :counted])
    levels = np.quantile(
        J.double().numpy(force=True), QUANTILES, method="inverted_cdf"
    ).tolist()  # of finite costs or not
    measures = NoiseMeasures(
        paths, float(cost.mean()), half_width_of_mean(cost), float(J.mean()), half_width_of_mean(J),
        {f"{q:.0%}": level for q, level in zip(QUANTILES, levels, strict=True)},
        float(_mean_of_dearest(J).mean()),
        float((cost - value > LOST_EXCESS * value.maximum(value.mean())).double().mean()),
        problem.risk, with_risk, half_width,
    )  # fmt: skip
    risk = 0.0 if with_risk is None else problem.risk
    return table, measures, _cost_on_same_paths(table.cost, plain, lqr, risk) if lqr else None


def _enough_paths_count(exponentials: Tensor) -> bool:
    """Whether enough of some exponentials (paths, states) of mean one count: ENOUGH_PATHS of all, and FEWEST_PATHS.

    Paths count by the effective sample size (Σz)²/Σz² of each state, averaged over the states. The mean of all samples
    also has to be near one: it is far below one if the sample lacks the rare paths that count most.
    """
    size = exponentials.sum(0).square() / exponentials.square().sum(0)
    mean = float(exponentials.mean())
    return float(size.mean()) >= max(ENOUGH_PATHS * len(exponentials), FEWEST_PATHS) and abs(mean - 1) < FAR_FROM_ONE


def _cost_on_same_paths(cost: PerState, J: list[Tensor], others: list[Tensor], risk: float) -> PerState:
    """E J of another law, from an estimate of E J of this one and the costs of both on the same paths.

    With a risk both are certainty equivalents.
    """
    own, other = (mean_with_risk(torch.stack(each), risk) for each in (J, others))
    difference = other - own
    return torch.where(difference.isfinite(), cost + difference, other)


def _mean_of_dearest(J: Tensor) -> PerState:
    """The conditional value at risk of each state: the mean J of the DEAREST share of its paths, for J (paths, states).

    A path that belongs to this share only in part counts in part.
    """
    count = DEAREST * len(J)
    share = (count - torch.arange(len(J)).to(J)).clamp(0, 1)[: math.ceil(count)]
    return (J.sort(0, descending=True).values[: len(share)] * share[:, None]).sum(0) / count


# columns of a table that are averaged over paths
AVERAGED = ("cost", "terminal_state", "terminal_error", "at_limits", "at_border")


def average(tables: Sequence[StateTable]) -> StateTable:
    """The table that summarises several of the same states: means of AVERAGED columns, the largest h, else the first.

    A state has left the domain if one of its paths has.
    """
    first = tables[0]

    def stacked(name: str) -> Tensor:
        return torch.stack([getattr(each, name) for each in tables])

    merged: dict[str, Any] = {name: stacked(name).mean(0) for name in AVERAGED if getattr(first, name) is not None}
    if first.worst is not None:
        merged["worst"], at = stacked("worst").max(0)
        merged["worst_time"] = stacked("worst_time").gather(0, at[None])[0]
    if first.left is not None:
        merged["left"] = stacked("left").any(0)
    return replace(first, **merged)
