"""Measures of a controller that reads noisy outputs, against the same controller that knows the state."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from lyapnet.base.random_streams import NOISE, OUTPUTS, PLANTS, TEST, stream
from lyapnet.base.types import PerState, State, StatePath, Times
from lyapnet.controller.controller import Controller
from lyapnet.controller.output_feedback import OutputFeedback
from lyapnet.evaluation.intervals import CONFIDENCE, half_width_of_mean
from lyapnet.evaluation.under_noise import LOST_EXCESS
from lyapnet.loop.estimation.kalman import Belief
from lyapnet.loop.random_plants import RandomPlants
from lyapnet.task.systems import ControlSystem
from lyapnet.value.expansions import path_under

RARE = 0.999  # errors beyond this quantile count as rare, if P is right
MOST_OUTLIERS = 0.01  # largest share of runs with rare errors for an estimator to count as consistent


class EstimatedLoops(NamedTuple):
    """Closed loops with an estimator, and those from the same states, under the same noise, with the state known."""

    t: Times
    x: StatePath  # the states; with random plants (x, p), disturbances of controls last
    y: Tensor  # the readings (N + 1, b, p)
    x_hat: StatePath  # the estimates after the readings
    P: Float[Tensor, "nodes *batch n n"]
    cost: PerState  # J; infinite where a closed loop is not finite
    known_cost: PerState  # J with the state known

    @property
    def squared_error(self) -> Float[Tensor, "nodes *batch"]:
        """The normalised estimation error squared (NEES), (x − x̂)ᵀP⁻¹(x − x̂): its expectation is n if P is right."""
        error = self.x - self.x_hat
        return (error * torch.linalg.solve(self.P, error)).sum(-1)

    def estimated(self, system: ControlSystem) -> "EstimatedLoops":
        """The loops without the settings of a family, which are known."""
        kept = [i for i in range(system.n) if i not in system.settings]
        return self._replace(x=self.x[..., kept], x_hat=self.x_hat[..., kept], P=self.P[..., kept, :][..., kept])


class EstimatorMeasures(NamedTuple):
    """The measures of a controller with an estimator, one closed loop from each state."""

    estimator: str  # ekf or ukf
    runs: int
    readings: dict[str, float]  # name ↦ standard deviation of its noise
    known_cost_mean: float  # E J with the state known
    cost_mean: float  # E J with the estimator
    cost_ratio: float | None  # ratio of these means; None if the first is not positive
    half_width: float | None  # half-width of its 95 % interval
    lost_fraction: float  # share of loops that cost LOST_EXCESS more than with the state known, or are not finite
    nees: float  # (x − x̂)ᵀP⁻¹(x − x̂)/n, averaged over steps and runs: 1 if P is right, above 1 if it is too small
    nees_half_width: float  # half-width of its 95 % interval, from the spread of the runs
    nees_band: tuple[float, float]  # interval that contains the mean over the runs at a step with 95 % if P is right
    nees_inside: float  # share of the steps at which that mean is within the band
    delay: int  # steps after its readings at which a control acts
    outlier_fraction: float  # share of runs with (x − x̂)ᵀP⁻¹(x − x̂) at T above its 99.9 % quantile if P is right
    errors: dict[str, tuple[float, float]]  # state ↦ (its root mean square error at T, √P there), in its unit

    @property
    def consistent(self) -> bool:
        """Whether 1 is in the 95 % interval of `nees`, and few errors are rare; diverging loops widen the interval."""
        return abs(self.nees - 1) <= self.nees_half_width and self.outlier_fraction <= MOST_OUTLIERS


@torch.no_grad()
def loops_with_estimator(controller: Controller, estimator: OutputFeedback, x0: State, seed: int = 0) -> EstimatedLoops:
    """Closed loops from a batch of states, with the estimator and with the state known.

    First estimates are those of `OutputFeedback.draw_first`.

    Args:
        seed: seed of the readings' noise, of the noise of the task and of random plants.
    """
    problem, outputs, plants = estimator.problem, estimator.outputs, controller.plants
    draws = stream(seed, TEST, OUTPUTS)
    z0 = _on_plants(plants, x0, seed).double().cpu()
    if further := problem.system.n - z0.shape[-1]:  # disturbances of controls
        z0 = torch.cat([z0, problem.initial_states.sample(len(z0), draws)[:, -further:]], -1)
    horizon, increments = problem.horizon, None
    if problem.noise is not None:
        increments = problem.noise.draw(horizon.steps, horizon.dt, z0, stream(seed, TEST, NOISE))
    times, like = horizon.times(z0), x0
    known = path_under(
        problem, lambda k, z: controller.law(like.new_tensor(float(times[k])), z[..., : x0.shape[-1]].to(like)).to(z),
        z0, increments,
    )  # fmt: skip
    estimator.reset(estimator.draw_first(z0, draws))
    readings, beliefs = list[Tensor](), list[Belief]()

    def law(k: int, z: State) -> Tensor:
        readings.append(outputs.draw(z, draws))
        estimator.step(readings[-1])
        beliefs.append(estimator.belief)
        return estimator.acting.to(z)

    path = path_under(problem, law, z0, increments)
    readings.append(outputs.draw(path.x[-1], draws))
    estimator.observe(readings[-1])
    beliefs.append(estimator.belief)
    x_hat, P = (torch.stack(parts) for parts in zip(*beliefs, strict=True))
    return EstimatedLoops(times, path.x, torch.stack(readings), x_hat, P, path.cost, known.cost)


def measure_with_estimator(loops: EstimatedLoops, estimator: OutputFeedback) -> EstimatorMeasures:
    """The measures of some closed loops."""
    from scipy.stats import chi2  # imported here because it takes 0.3 s

    system, outputs = estimator.problem.system, estimator.outputs
    loops, labels = (
        loops.estimated(system),
        [label for i, label in enumerate(system.state_labels) if i not in system.settings],
    )
    runs, n = loops.x.shape[1:]
    J, known = loops.cost, loops.known_cost
    ratio, half_width = _ratio_of_means(J, known)
    lost = ~(J - known <= LOST_EXCESS * known.abs().maximum(known.mean().abs()))
    nees = loops.squared_error / n
    tails = ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2)
    low, high = (float(chi2.ppf(q, runs * n)) / (runs * n) for q in tails)
    each, per_step = nees.mean(0), nees.mean(1)
    inside = (low <= per_step) & (per_step <= high)
    error, deviation = loops.x[-1] - loops.x_hat[-1], loops.P[-1].diagonal(dim1=-2, dim2=-1).mean(0).sqrt().tolist()
    rms = error.square().mean(0).sqrt()
    return EstimatorMeasures(
        estimator.kind, runs,
        dict(zip(outputs.names, outputs.noise.tolist(), strict=True)),
        float(known.mean()), float(J.mean()), ratio, half_width, float(lost.double().mean()),
        float(each.mean()), half_width_of_mean(each[:, None]), (low, high), float(inside.double().mean()),
        estimator.delay, float((~(n * nees[-1] <= float(chi2.ppf(RARE, n)))).double().mean()),
        dict(zip(labels, zip(rms.tolist(), deviation, strict=True), strict=True)),
    )  # fmt: skip


def _on_plants(plants: RandomPlants | None, x0: State, seed: int) -> Tensor:
    """(x₀, p) of random plants; x₀ without random plants."""
    return x0 if plants is None else plants.draw(x0, stream(seed, PLANTS, TEST))


def _ratio_of_means(J: PerState, known: PerState) -> tuple[float | None, float | None]:
    """mean J / mean J with the state known and the half-width of its 95 % interval, from pairs of the same state."""
    if not float(known.mean()) > 0:
        return None, None
    ratio = float(J.mean() / known.mean())
    if not math.isfinite(ratio):
        return None, None
    return ratio, half_width_of_mean(((J - ratio * known) / known.mean())[:, None])
