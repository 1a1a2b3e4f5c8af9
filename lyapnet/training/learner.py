"""The learner of one seed: V in the closed loop of its policy, with its last measures."""

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import torch
from torch import Tensor, nn

from lyapnet.base.errors import CompilationError, UntraceableError, UsageError
from lyapnet.base.random_streams import NOISE, PLANTS, POINTS, VALIDATION, stream
from lyapnet.base.types import PerState, State
from lyapnet.evaluation.states import StateTable, measure
from lyapnet.loop.programs import PointwiseCondition, Program, ProgramOutput, RegionCondition
from lyapnet.loop.random_plants import ON_MODEL, ON_PLANTS, RandomPlants, StateOfPlant
from lyapnet.loop.rollout import NoisyTrajectory, Rollout, Trajectory
from lyapnet.task.cost import PenaltyCost, spread
from lyapnet.task.noise import Increments
from lyapnet.task.problem import Problem
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.expansions import Path, in_float64, path_of, path_under
from lyapnet.value.policy import LookaheadPolicy

MIN_SAMPLE_SIZE = 0.5  # least effective sample size in a cost with risk, as a share of the batch
MOST_HALVINGS = 64  # largest number of halvings of a risk until that size is reached


class Learner(nn.Module):
    """V, the closed loop of its policy, and the program that is minimised.

    Args:
        problem: the optimal control problem.
        V: the network that is trained.
        rollout: the closed loop of the policy that V defines.
        program: the loss.
        pointwise: the program's condition at points off the closed loops, if it is a term of the loss.
        seed: seed of these points.
        label: name of this learner in messages and file names; "" for a single one.
        plants: the plants of half of its closed loops, if they differ from the model.

    Raises:
        UsageError: the problem has constraints but no penalty for them.
    """

    problem: Problem
    V: ValueFunction
    rollout: Rollout
    plants: RandomPlants | None
    program: Program
    pointwise: PointwiseCondition | None
    seed: int
    label: str
    gradient_norm: float
    steps_per_second: float

    def __init__(
        self,
        problem: Problem,
        V: ValueFunction,
        rollout: Rollout,
        program: Program,
        pointwise: PointwiseCondition | None = None,
        seed: int = 0,
        label: str = "",
        plants: RandomPlants | None = None,
    ):
        super().__init__()
        if problem.constraints is not None and not isinstance(problem.cost, PenaltyCost):
            raise UsageError(
                "Expected a relaxed problem for training with constraints, got the problem itself; pass "
                "problem.relaxed(weight=…), w in cost per second, or train from a config, which finds w."
            )
        self.problem, self.V, self.rollout, self.plants = problem, V, rollout, plants
        V.made_for = type(rollout.closed_loop.policy)
        self.program: Program = program if problem.has_goal else program.without_goal(problem.no_goal)
        self.pointwise, self.seed, self.label = pointwise, seed, label
        self.validation_optimum: PerState | None = None  # J* of the validation states, once it is known
        # measures of the last training step and the last validation
        self.gradient_norm = self.steps_per_second = math.nan
        self.output: ProgramOutput | None = None  # also None once its training has ended
        self.validation: StateTable | None = None
        self.validation_loss: float = math.nan
        self.lost_excess: float = 0.0  # largest excess of a gravely lost state that was found at the last validation
        self.measured_at: int = -1  # step of the last validation
        self.rate_share: float = 1.0  # factor of its scheduled learning rate, see ReturnToBest
        self.cooling: tuple[int, int] | None = None  # first and last step of the final decay of its learning rate
        self.region_share: Tensor | None = None  # share of D that is in the region, with the region program
        self.metadata: dict[str, Any] = {}  # plain data for a checkpoint of this member alone

    def looking_ahead(self) -> "Learner":
        """A learner of the same V with the lookahead law."""
        rollout, law = self.rollout, LookaheadPolicy(self.problem, self.V)
        ahead = Rollout(self.problem, law, rollout.method, rollout.gradient)
        if rollout.discrete is not None and ahead.discrete is not None:
            with suppress(UntraceableError, CompilationError):  # otherwise it runs uncompiled
                ahead.discrete.compile_like(rollout.discrete)
        return Learner(self.problem, self.V, ahead, self.program, seed=self.seed, label=self.label)

    @torch.no_grad()
    def path_from(self, x0: State, increments: Increments | None = None) -> Path:
        """The closed loop from x₀ (b, n) in float64, each control held for Δt; it may be non-finite.

        Uses the compiled closed loop if it takes the same steps.

        Args:
            increments: ΔW of each step; None: without noise.
        """
        goal, loop = self.problem.goal, self.rollout.discrete
        exact, policy = in_float64(self.problem), self.rollout.closed_loop.policy
        if loop is not None and self.rollout.takes_steps_of_problem:
            x, running_cost, _, u = loop(x0.to(goal), None if increments is None else increments.to(goal))
            return path_of(exact, x.double().cpu(), u.double().cpu(), running_cost[-1].double().cpu())
        times = self.problem.horizon.times(goal)
        return path_under(exact, lambda n, x: policy(times[n], x.to(goal)).to(x), x0.double().cpu(), increments)

    def roll_out(self, x0: State, *draw: int) -> Trajectory:
        """The closed loops from x₀, under noise if the problem has some; with random plants, half of them on those.

        Args:
            draw: identifies the random stream of both, which also depends on the seed.
        """
        noise, horizon = self.problem.noise, self.problem.horizon
        if self.plants is not None:
            return self.plants(self.with_plants(x0, *draw))
        if noise is None:
            return self.rollout(x0)
        return self.rollout(x0, noise.draw(horizon.steps, horizon.dt, x0, stream(self.seed, NOISE, *draw)))

    def with_plants(self, x0: State, *draw: int) -> StateOfPlant:
        """(x₀, p) of the closed loops that `roll_out` computes from x₀ (b, n); x₀ without random plants."""
        return x0 if self.plants is None else self.plants.draw_beside_model(x0, stream(self.seed, PLANTS, *draw))

    @property
    def problem_of_loops(self) -> Problem:
        """The problem that the closed loops solve: that of the random plants, or that of V."""
        return self.problem if self.plants is None else self.plants.problem

    def train_on(self, trajectory: Trajectory, draw: Sequence[int] = (POINTS,)) -> Tensor:
        """The loss of a training batch; its terms are stored in `output`.

        Args:
            draw: identifies the random stream of the points off the closed loops.
        """
        size = None if self.problem.has_goal else mean_over_processes(spread(trajectory.cost.detach()))
        output = self._evaluate_program(trajectory, draw, size, mean_over_processes)
        terms = {name: term.detach() for name, term in output.terms.items()}
        self.output = ProgramOutput(
            output.loss.detach(), terms, output.constraint_loss.detach(), output.trajectory_cost.detach()
        )
        return output.loss

    @property
    def selection_loss(self) -> float:
        """The loss of which the least chooses the best weights.

        It is the validation loss and, if that contains the relative cost, `lost_excess` divided by the number of
        validation states, about as if the worst state that was found were one of them.
        """
        assert self.validation is not None
        weight = self.program.trajectory_cost if self.program.normalise and self.region_share is None else 0.0
        return self.validation_loss + weight * self.lost_excess / (len(self.validation.cost) + 1)

    def measure_on(self, trajectory: Trajectory) -> Tensor:
        """The validation loss; stored in `validation_loss`, with the table of states in `validation`.

        With the region program it is the sampled share of D outside the region, 1 − `region_share`.
        """
        self.validation = measure(self.problem, self.program, trajectory, self.validation_optimum)
        if isinstance(self.pointwise, RegionCondition):
            self.region_share = self.pointwise.sampled_share(stream(self.seed, VALIDATION, POINTS))
            loss = 1 - self.region_share
        else:
            loss = self._evaluate_program(
                trajectory, (VALIDATION, POINTS), self._spread_of_optima(trajectory.cost)
            ).loss
        self.validation_loss = float(loss)
        return loss

    @torch.no_grad()
    def _weights(self, trajectory: Trajectory) -> PerState:
        """The weights of closed loops in the mean cost with a risk θ, with a mean of one.

        The derivative of (1/θ) log E exp(θJ) from x₀ is the mean of the derivatives of J with weights proportional to
        exp(θJ).
        Under noise they are exp(θ Σ D_n), see Trajectory.compensated. On random plants, of which each x₀ has one, they
        are exp(θ (J − V(0, x₀))), with V of the model: the most expensive pairs of state and plant count most.

        With a large θ a few weights dominate, and the derivative is random. If the effective sample size (Σw)²/Σw² is
        below MIN_SAMPLE_SIZE of the batch, all weights are zero under noise: V then learns from its residuals alone,
        which hold on every path. On random plants θ is halved until the sample size is large enough.
        """
        risk = self.problem.risk
        if isinstance(trajectory, NoisyTrajectory) and trajectory.surprise is not None:
            share = torch.softmax(risk * trajectory.surprise.sum(0), 0)
            return len(share) * share * _counts(share)
        excess = trajectory.cost - trajectory.require_value()[0]
        weights = torch.ones_like(excess)
        share = torch.softmax(risk * excess[ON_PLANTS], 0)
        for _ in range(MOST_HALVINGS):
            if _counts(share):
                break
            risk /= 2
            share = torch.softmax(risk * excess[ON_PLANTS], 0)
        weights[ON_PLANTS] = len(share) * share
        return weights

    def _spread_of_optima(self, cost: PerState) -> Tensor | None:
        """The spread of the optima, which makes losses of different steps comparable; None for a task with a goal.

        If no optimum is known, it is the spread of the costs.
        """
        if self.problem.has_goal:
            return None
        known = cost if self.validation_optimum is None else self.validation_optimum.to(cost)
        known = known[known.isfinite()]
        return spread(known if len(known) > 1 else cost)

    def _evaluate_program(
        self,
        trajectory: Trajectory,
        draw: Sequence[int],
        spread_of_costs: Tensor | None,
        over_processes: Callable[[Tensor], Tensor] = lambda value: value,
    ) -> ProgramOutput:
        """Evaluate the program, with its pointwise condition if there is one."""
        weights = self._weights(trajectory) if self.problem.risk else None
        trajectory = trajectory.compensated()
        on_model = ... if self.plants is None else ON_MODEL
        output = self.program(trajectory, over_processes, spread_of_costs, on_model, weights)
        if self.pointwise is None:
            return output
        values, size = trajectory.require_value(), spread_of_costs
        if size is None:
            size = mean_over_processes(output.trajectory_cost.detach())
        term = self.pointwise(stream(self.seed, *draw), size, values[0].max())
        loss = output.loss + self.pointwise.weight * term
        return output._replace(loss=loss, terms={**output.terms, "pointwise": term})

    def training_scalars(self) -> dict[str, float | Tensor]:
        """The curves' values of the last training step, by name."""
        assert self.output is not None
        return {
            "loss/train": self.output.loss,
            **{f"term/{name}": value for name, value in self.output.terms.items()},
            "constraint_loss/train": self.output.constraint_loss,
            "trajectory_cost/train": self.output.trajectory_cost,
            "gradient_norm": self.gradient_norm,
            "rollout_steps_per_second": self.steps_per_second,
        }

    def validation_scalars(self) -> dict[str, float]:
        """The curves' values of the last validation, by name; unknown ones are left out."""
        assert self.validation is not None
        summary = self.validation.summary()
        ratio, violated = summary["cost_ratio"], self.validation.violated
        scalars = {
            "constraint_loss/val": summary["constraint_loss"],
            "trajectory_cost/val": summary["cost_mean"],
            "optimality_gap/val": None if ratio is None else ratio - 1,
            "region_share/val": None if self.region_share is None else float(self.region_share),
            "violated_fraction/val": None if violated is None else float(violated.double().mean()),
            **{
                f"{name}/val": summary.get(name)
                for name in (
                    "regret", "value_error", "value_to_cost", "satisfied_fraction", "bounded_fraction",
                    "falling_fraction", "decreasing_fraction", "largest_rise", "terminal_error",
                )
            },
        }  # fmt: skip
        return {name: value for name, value in scalars.items() if value is not None}


def _counts(share: Tensor) -> bool:
    """Whether weights that sum to one have an effective sample size of at least MIN_SAMPLE_SIZE of their number."""
    return bool(1 / share.square().sum() >= MIN_SAMPLE_SIZE * len(share))


def mean_over_processes(value: Tensor) -> Tensor:
    """The mean of a number over the processes that train together; the number itself for a single process."""
    if not (torch.distributed.is_available() and torch.distributed.is_initialized()):
        return value
    total = value.clone()
    torch.distributed.all_reduce(total)
    return total / torch.distributed.get_world_size()


def number_over_processes(value: float, device: torch.device) -> float:
    """`mean_over_processes` of a Python number, in double precision."""
    return float(mean_over_processes(torch.tensor(value, dtype=torch.float64, device=device)))
