"""What a program is: named, weighted terms of V along the closed loop."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from lyapnet.base.errors import DivergenceError, UsageError
from lyapnet.base.types import PerState, ValuePath
from lyapnet.loop.programs.tolerances import Tolerances
from lyapnet.loop.rollout import Trajectory


class ProgramOutput(NamedTuple):
    """One evaluation of a program on a batch; every entry is a mean over the batch."""

    loss: Float[Tensor, ""]  # what is minimised
    terms: dict[str, Float[Tensor, ""]]  # each term before its weight
    constraint_loss: Float[Tensor, ""]  # the paper's mean sum, without weight, margin or normalisation
    trajectory_cost: Float[Tensor, ""]  # mean J_N


@dataclass(frozen=True)
class Program(ABC):
    """loss = constraint · C + terminal · B + trajectory_cost · J: the weighted terms of one program.

    C is the program's condition along the trajectory, B the condition at t = T, J the cost of the closed loop; a
    program may add further terms. A weight of zero leaves a term out; constraint = 1 alone, without normalisation, is
    the paper's program.

    With `normalise`, the weights are numbers without units: every term is measured against its `unit`, the batch's mean
    cost J̄ (detached; C as the mean over time) unless told otherwise, but J, which enters as log J̄, whose gradient is
    ∇J̄/J̄. Where costs may be of any sign, as of a task without a goal, they are measured against their spread.
    """

    degree: ClassVar[int]  # all terms but J are of this degree in units of cost
    weighted: ClassVar[tuple[str, ...]] = ("constraint", "terminal", "trajectory_cost")  # the terms, and their weights
    recommended: ClassVar[Mapping[str, float | bool]] = {}  # arguments in the standard recipe
    needs_goal: ClassVar[bool] = False  # whether V is a distance to a goal, towards which it falls
    pointwise: ClassVar[float] = 0.0  # the weight of its condition at points off the closed loops, unless it is given

    constraint: float = 1.0
    terminal: float = 0.0
    trajectory_cost: float = 0.0
    normalise: bool = True

    def __post_init__(self) -> None:
        for name, weight in self.weights.items():
            if not weight >= 0:
                raise ValueError(f"Expected weight {name} ≥ 0, got {weight}; terms are minimised.")
        if not any(self.weights.values()):
            raise ValueError("Expected at least one positive weight, got none; nothing would be learned.")

    @property
    def weights(self) -> dict[str, float]:
        """The weight of each term."""
        return {name: getattr(self, name) for name in self.weighted}

    def __call__(
        self,
        trajectory: Trajectory,
        mean_over_processes: Callable[[Tensor], Tensor] = lambda value: value,
        spread_of_costs: Float[Tensor, ""] | None = None,
    ) -> ProgramOutput:
        """The program on one batch of trajectories under the control law of a V.

        Args:
            trajectory: the batch.
            mean_over_processes: takes a number of this process to its mean over all that share the batch, so that
                they normalise alike and the mean of their gradients is the gradient on the joint batch.
            spread_of_costs: of a task without a goal, what stands for the mean cost; None where there is one.

        Raises:
            ValueError: no V defines the control law.
            DivergenceError: a term is not finite; names it and the initial state.
        """
        values = trajectory.require_value()
        J = trajectory.cost.mean()
        per_state = self.per_state(values, trajectory)
        for name, term in per_state.items():
            _require_finite(name, term, trajectory)
        terms = {name: term.mean() for name, term in per_state.items()}
        if self.normalise:
            cost = trajectory.cost.detach()
            has_goal = spread_of_costs is None
            size = mean_over_processes(cost.mean()) if has_goal else spread_of_costs
            each = cost if has_goal else size.expand_as(cost)
            terms = {name: (term / self.unit(name, each, size)).mean() for name, term in per_state.items()}
            # N Σ (ΔV + Δtℓ)² / J̄² is the mean over time of ((V̇ + ℓ) / (J̄/T))²; a sum of degree one needs no N
            terms["constraint"] = terms["constraint"] * len(trajectory.step_cost) ** (self.degree - 1)
            # log J̄, or J̄ in units of the spread, and its gradient; J̄ is the joint mean, and this batch a part of it
            mean = torch.log(size) if has_goal else mean_over_processes(J.detach()) / size
            terms["trajectory_cost"] = mean + (J - J.detach()) / size
        loss = torch.stack([weight * terms[name] for name, weight in self.weights.items() if weight]).sum()
        return ProgramOutput(loss, terms, self.constraint_loss(values, trajectory).mean(), J)

    def unit(self, name: str, cost: PerState, mean_cost: Tensor) -> Tensor:
        """What a term of trajectories of some cost J is measured against: J̄ to the power of its degree.

        Without a goal both are the spread of costs.
        """
        return mean_cost**self.degree

    def tolerances(self, radius: float | None = None, cost: float = 0.05) -> Tolerances:
        """What this program promises of one closed loop, by default: J within 5 % of V(0, x₀), and ‖x(T) − goal‖
        within a radius, if one is given."""
        return Tolerances(radius, None, cost)

    def excess(self, rate: Tensor, running: Tensor) -> Tensor:
        """By how much the condition fails where V changes by `rate` while `running` accrues: V̇ + ℓ, or the same over
        a step."""
        return rate + running

    @abstractmethod
    def penalty(self, excess: Tensor) -> Tensor:
        """What an excess costs: zero where the condition holds."""

    def without_goal(self, reason: str) -> "Program":
        """The program for a task that has no goal.

        Args:
            reason: why it has none.

        Raises:
            UsageError: it needs one.
        """
        if self.needs_goal:
            raise UsageError(
                f"Expected a task with a goal, to which V falls, got none: {reason}; take program.name=value, or name "
                "target: in the config."
            )
        return self

    def check_terminal(self, exact: bool) -> None:  # noqa: B027  (most programs have nothing to refuse)
        """Refuse weights that do not suit how V ends.

        Args:
            exact: whether V(T, ·) = φ by construction.

        Raises:
            ValueError: they do not.
        """

    def per_state(self, values: ValuePath, trajectory: Trajectory) -> dict[str, PerState]:
        """Each term of `weighted` for each trajectory."""
        return {
            "constraint": self.constraint_term(values, trajectory),
            "terminal": self.terminal_term(values, trajectory),
            "trajectory_cost": trajectory.cost,
        }

    @abstractmethod
    def constraint_loss(self, values: ValuePath, trajectory: Trajectory) -> PerState:
        """The paper's sum over the steps of each trajectory."""

    @abstractmethod
    def terminal_term(self, values: ValuePath, trajectory: Trajectory) -> PerState:
        """B for each trajectory."""

    def constraint_term(self, values: ValuePath, trajectory: Trajectory) -> PerState:
        """C for each trajectory: the paper's sum, unless the program asks for more."""
        return self.constraint_loss(values, trajectory)


def _require_finite(name: str, term: PerState, trajectory: Trajectory) -> None:
    broken = torch.nonzero(~torch.isfinite(term.flatten())).flatten()
    if len(broken):
        first = int(broken[0])
        x0 = trajectory.x[0].reshape(-1, trajectory.x.shape[-1])[first].tolist()
        raise DivergenceError(
            f"Expected a finite loss, got {float(term.detach().flatten()[first])} in term {name} from x0 = {x0}; lower "
            "training.learning_rate or the term's weight."
        )
