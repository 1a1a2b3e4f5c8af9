"""Claims from closed loops of sampled initial states: the share of successes, and an exact bound of it."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from scipy.special import betaincinv
from torch import Tensor

from lyapnet.base.errors import DivergenceError
from lyapnet.base.sizes import NUMBER, require_memory
from lyapnet.base.types import State
from lyapnet.loop.programs import EVENTS, Tolerances
from lyapnet.loop.programs.terms import hinge, satisfied
from lyapnet.loop.rollout import Trajectory
from lyapnet.prover.verdict import Verdict
from lyapnet.task.domain import SLACK
from lyapnet.task.noise import Increments
from lyapnet.task.problem import Problem


@dataclass(frozen=True)
class CountedSuccesses:
    """The closed loop succeeded from `successes["all"]` of `samples` states drawn uniformly from X₀.

    The claim that every state of X₀ succeeds is falsified by one that fails, and otherwise unknown.
    """

    states: State  # the samples, (samples, n)
    held: Bool[Tensor, "samples events"]  # which of EVENTS hold from each of them
    tolerances: Tolerances

    @property
    def samples(self) -> int:
        """The number of states that were drawn."""
        return len(self.states)

    @property
    def successes(self) -> dict[str, int]:
        """The number of samples that succeeded, for each of EVENTS."""
        return {event: int(count) for event, count in zip(EVENTS, self.held.sum(0), strict=True)}

    @property
    def failures(self) -> State:
        """The states that failed in any event, (failures, n), in the order of the draw."""
        return self.states[~self.held[:, -1]]

    @property
    def verdict(self) -> Verdict:
        """The verdict on the claim that every state of X₀ succeeds."""
        return "falsified" if len(self.failures) else "unknown"

    @property
    def shares(self) -> dict[str, float]:
        """The share of the samples that succeeded, for each of EVENTS."""
        return {event: count / self.samples for event, count in self.successes.items()}


@dataclass(frozen=True)
class BoundedShare(CountedSuccesses):
    """With this confidence, at least `probability_lower_bound` of X₀ by volume succeeds.

    The confidence is over the draw of the samples: of many such claims, at most a share 1 − confidence is false. It
    holds for each event separately. Like the rollouts, the claim is about this model, this Δt and this integrator. If
    one of K draws was chosen, the bounds together have only the confidence 1 − K(1 − confidence) (Bonferroni). The
    verdict therefore uses bounds of confidence 1 − (1 − confidence)/K, which together have the given confidence.
    """

    confidence: float
    share: float  # the share of X₀ in the claim of the verdict
    draws: int = 1  # K, including this one

    @property
    def confidence_over_draws(self) -> float:
        """The confidence of the bounds if this draw was chosen among K."""
        return max(0.0, 1 - self.draws * (1 - self.confidence))

    @property
    def lower_bounds(self) -> dict[str, float]:
        """The bound for each of EVENTS."""
        return {e: lower_bound(count, self.samples, self.confidence) for e, count in self.successes.items()}

    @property
    def named_bounds(self) -> dict[str, float]:
        """The bounds by their keys in `result`: of success, and of each event that the tolerances require."""
        bounds = self.lower_bounds
        single = {f"{event}_lower_bound": bounds[event] for event in self.tolerances.asked}
        return {"probability_lower_bound": bounds["all"], **single}

    @property
    def probability_lower_bound(self) -> float:
        """The bound for all events together."""
        return self.lower_bounds["all"]

    @property
    def verdict(self) -> Verdict:
        """The verdict on the claim that at least `share` of X₀ succeeds; certified or falsified with the confidence."""
        each, failures = 1 - (1 - self.confidence) / self.draws, len(self.failures)
        if lower_bound(self.successes["all"], self.samples, each) >= self.share:
            return "certified"
        return "falsified" if 1 - lower_bound(failures, self.samples, each) < self.share else "unknown"


def lower_bound(successes: int, samples: int, confidence: float) -> float:
    """The exact one-sided Clopper-Pearson bound of a probability.

    It is the p for which k = successes or more have probability 1 − confidence. It solves
    P(Binomial(samples, p) ≥ k) = I_p(k, samples − k + 1) = 1 − confidence, where I_p is the regularised incomplete beta
    function. (scipy.stats.binomtest gives the same p by root finding.)

    Raises:
        ValueError: successes are not between 0 and samples, or the confidence is not strictly between 0 and 1.

    Source: Clopper and Pearson, "The use of confidence or fiducial limits illustrated in the case of the binomial",
    Biometrika 1934.
    """
    if not (0 <= successes <= samples and samples >= 1):
        raise ValueError(f"Expected 0 ≤ successes ≤ samples, got {successes} of {samples}; count them again.")
    if not 0 < confidence < 1:
        raise ValueError(f"Expected a confidence between 0 and 1, got {confidence}; for example 0.999999.")
    return float(betaincinv(successes, samples - successes + 1, 1 - confidence)) if successes else 0.0


def count_successes(
    rollout: Callable[..., Trajectory],
    problem: Problem,
    tolerances: Tolerances,
    samples: int = 100,
    generator: torch.Generator | None = None,
    batch: int = 1000,
) -> CountedSuccesses:
    """Count successes among fresh random states of X₀, each with one path of the noise; the paper takes 100.

    Args:
        rollout: closed loops under the control law of a V, from states and the increments of the noise, if any.
        problem: gives X₀, the goal and the constraints.
        batch: the number of states that are rolled out at once, to limit the memory.

    Raises:
        ValueError: less than one sample or state at once.
    """
    if samples < 1 or batch < 1:
        raise ValueError(f"Expected samples and batch ≥ 1, got {samples} and {batch}; choose how many states to draw.")
    require_memory("samples", samples, NUMBER * samples * problem.system.n, "draw fewer")
    x0 = problem.initial_states.sample(samples, generator)
    tolerances = replace(tolerances, constraints=problem.constraints is not None)
    draw = torch.default_generator if generator is None else generator
    held = torch.cat(
        [
            _check_events(rollout, part, _increments(problem, part, draw), tolerances, problem)
            for part in x0.split(batch)
        ]
    )
    return CountedSuccesses(x0.cpu(), held, tolerances)


def _increments(problem: Problem, x0: State, generator: torch.Generator) -> Increments | None:
    """One path of the noise from each state; None without noise."""
    noise, horizon = problem.noise, problem.horizon
    return None if noise is None else noise.draw(horizon.steps, horizon.dt, x0, generator)


def bound_share(
    rollout: Callable[..., Trajectory],
    problem: Problem,
    tolerances: Tolerances,
    samples: int = 10_000,
    confidence: float = 1 - 1e-6,
    share: float = 0.99,
    generator: torch.Generator | None = None,
    batch: int = 1000,
    draws: int = 1,
) -> BoundedShare:
    """Bound the share of X₀ on which the closed loop succeeds, from fresh states.

    The states must be fresh: nothing was trained or chosen on them. Their number must be fixed in advance. If the draw
    is repeated until the bound is good, the bound is invalid, unless all draws are counted.

    Args:
        draws: the number of draws from which this one was chosen, itself included.

    Raises:
        ValueError: as count_successes and lower_bound.
    """
    lower_bound(0, samples, confidence)  # refuse wrong arguments before the work
    sampled = count_successes(rollout, problem, tolerances, samples, generator, batch)
    return BoundedShare(**vars(sampled), confidence=confidence, share=share, draws=draws)


SMALLEST_BATCH = 16  # number of states up to which a batch with a divergent closed loop is not halved any more


def _check_events(
    rollout: Callable[..., Trajectory],
    x0: State,
    increments: Increments | None,
    tolerances: Tolerances,
    problem: Problem,
) -> Bool[Tensor, "samples events"]:
    """Which of EVENTS hold from each state.

    One divergent closed loop stops its whole batch, which is then halved to find it. Up to SMALLEST_BATCH states of its
    batch count as failures too; this can only lower a share.
    """
    try:
        with torch.no_grad():
            trajectory = rollout(x0) if increments is None else rollout(x0, increments)
    except DivergenceError:
        if len(x0) <= SMALLEST_BATCH:
            return torch.zeros(len(x0), len(EVENTS), dtype=torch.bool)
        halves = x0.tensor_split(2)  # each state keeps its path of the noise; a new one would give it a second chance
        paths = (None, None) if increments is None else increments.tensor_split(2, 1)
        return torch.cat(
            [_check_events(rollout, half, path, tolerances, problem) for half, path in zip(halves, paths, strict=True)]
        )
    valid = torch.ones(len(x0), 1, dtype=torch.bool)
    if problem.domain is not None:  # f, g or the cost is not defined outside
        valid = ~problem.domain.left(trajectory.x, SLACK).cpu()[:, None]
    J, trajectory = trajectory.cost, trajectory.compensated()  # V decreases in expectation; a cost is that of a path
    values = trajectory.require_value()
    decrease = terminal = constraints = torch.ones_like(values[0], dtype=torch.bool)
    if tolerances.decrease is not None:
        decrease = satisfied(hinge(values, trajectory.step_cost), values[0], tolerances.decrease)
    if tolerances.radius is not None:
        terminal = torch.linalg.vector_norm(problem.cost.from_goal(trajectory.x[-1]), dim=-1) <= tolerances.radius
    if problem.constraints is not None:
        constraints = problem.constraints.worst(trajectory.x).amax(0) <= 0
    cost = (1 + tolerances.cost) * values[0] >= J
    single = torch.stack([decrease, terminal, cost, constraints], -1).cpu() & valid
    return torch.cat([single, single.all(-1, keepdim=True)], -1)
