"""The base class of programs, losses made of named, weighted terms of V along the closed loop."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import EllipsisType
from typing import ClassVar, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from lyapnet.base.errors import DivergenceError, UsageError
from lyapnet.base.types import PerState, ValuePath
from lyapnet.loop.programs.tolerances import Tolerances
from lyapnet.loop.rollout import Trajectory


class ProgramOutput(NamedTuple):
    """The value of a program on a batch; every entry is a mean over the batch."""

    loss: Float[Tensor, ""]  # weighted sum of the terms
    terms: dict[str, Float[Tensor, ""]]  # each term without its weight
    constraint_loss: Float[Tensor, ""]  # mean of the paper's sum, without weight, margin or normalisation
    trajectory_cost: Float[Tensor, ""]  # mean J_N


@dataclass(frozen=True)
class Program(ABC):
    """loss = constraint · C + terminal · B + trajectory_cost · J, a weighted sum of terms.

    C is the program's condition along the trajectory, B the condition at t = T, J the cost of the closed loop; a
    program may have further terms. A weight of zero removes a term. The paper's program has constraint = 1 only, and no
    normalisation.

    With `normalise` the weights have no unit: each term is divided by its `unit`, by default the batch's mean cost J̄ to
    the power of its degree (detached; C as the mean over time). J enters as log J̄, with gradient ∇J̄/J̄. In tasks
    without a goal, where costs may have any sign, the spread of costs replaces J̄.
    """

    degree: ClassVar[int]  # degree of all terms except J in units of cost
    weighted: ClassVar[tuple[str, ...]] = ("constraint", "terminal", "trajectory_cost")  # names of terms and weights
    recommended: ClassVar[Mapping[str, float | bool]] = {}  # arguments in the standard recipe
    needs_goal: ClassVar[bool] = False  # whether V has to decrease towards a goal
    pointwise: ClassVar[float] = 0.0  # default weight of the condition at points off the closed loops

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
        on_model: slice | EllipsisType = ...,
        weights: PerState | None = None,
    ) -> ProgramOutput:
        """Evaluate the program on a batch of trajectories under the control law of a V.

        Args:
            trajectory: the batch.
            mean_over_processes: the mean of a number over all processes that share the batch. With it they use the same
                normalisation, so that the mean of their gradients is the gradient on the joint batch.
            spread_of_costs: replaces the mean cost in a task without a goal; None for a task with a goal.
            on_model: the trajectories of the model. Those on other plants count only by their cost J, because V is the
                value function of the model.
            weights: weights of the trajectories in the mean of J, with mean one; None: all one; all zero: J has no
                derivative.

        Raises:
            ValueError: no V defines the control law.
            DivergenceError: a term is not finite; names the term and the initial state.
        """
        values = trajectory.require_value()
        J = trajectory.cost.mean()
        if weights is not None:
            weighted = (weights * trajectory.cost).mean()
            J = weighted if bool((weights > 0).any()) else J.detach()
        per_state = self.per_state(values, trajectory)
        for name, term in per_state.items():
            _require_finite(name, term, trajectory)
        terms = {name: term[on_model].mean() for name, term in per_state.items()}
        if self.normalise:
            cost = trajectory.cost.detach()
            has_goal = spread_of_costs is None
            size = mean_over_processes(cost.mean()) if has_goal else spread_of_costs
            each = cost if has_goal else size.expand_as(cost)
            terms = {name: (term / self.unit(name, each, size))[on_model].mean() for name, term in per_state.items()}
            # N Σ (ΔV + Δtℓ)² / J̄² is the mean over time of ((V̇ + ℓ) / (J̄/T))²; for degree one the factor is 1
            terms["constraint"] = terms["constraint"] * len(trajectory.step_cost) ** (self.degree - 1)
            # log J̄, or J̄ in units of the spread, with J̄ over all processes but the gradient of this batch
            mean = size if has_goal and weights is None else mean_over_processes(J.detach())
            mean = torch.log(mean) if has_goal else mean / size
            terms["trajectory_cost"] = mean + (J - J.detach()) / size
        else:
            terms["trajectory_cost"] = J
        loss = torch.stack([weight * terms[name] for name, weight in self.weights.items() if weight]).sum()
        return ProgramOutput(loss, terms, self.constraint_loss(values, trajectory)[on_model].mean(), J)

    def unit(self, name: str, cost: PerState, mean_cost: Tensor) -> Tensor:
        """The unit of a term: J̄ to the power of the degree.

        Args:
            name: name of the term.
            cost: J of each trajectory; without a goal the spread of costs.
            mean_cost: J̄; without a goal the spread of costs.
        """
        return mean_cost**self.degree

    def tolerances(self, radius: float | None = None, cost: float = 0.05) -> Tolerances:
        """The success criteria of a closed loop: by default J ≤ 1.05 V(0, x₀), and ‖x(T) − goal‖ ≤ radius if given."""
        return Tolerances(radius, None, cost)

    def excess(self, rate: Tensor, running: Tensor) -> Tensor:
        """The violation of the condition for a rate V̇ and a running cost ℓ: V̇ + ℓ; or for their sums over a step."""
        return rate + running

    @abstractmethod
    def penalty(self, excess: Tensor) -> Tensor:
        """The loss of an excess; zero where the condition holds."""

    def without_goal(self, reason: str) -> "Program":
        """The program for a task without a goal.

        Args:
            reason: the reason why there is no goal, for messages.

        Raises:
            UsageError: the program needs a goal.
        """
        if self.needs_goal:
            raise UsageError(
                f"Expected a task with a goal, to which V falls, got none: {reason}; take program.name=value, or name "
                "target: in the config."
            )
        return self

    def check_terminal(self, exact: bool) -> None:  # noqa: B027  (most programs accept both)
        """Check that the weights suit the terminal condition of V.

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
        """C for each trajectory; by default the paper's sum."""
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
