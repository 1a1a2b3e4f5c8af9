"""Measurements of a controller, one number for each initial state, and their summary."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from lyapnet.build import build_program
from lyapnet.controller import Controller
from lyapnet.oracles import optimal_cost
from lyapnet.programs import Program
from lyapnet.programs.terms import hinge, satisfied
from lyapnet.randomness import TEST, stream
from lyapnet.rollout import Trajectory
from lyapnet.types import PerState, State

PAPER_STATES = 100  # K, the number of states on which the paper counts satisfied conditions


@dataclass(frozen=True)
class StateTable:
    """One row for each initial state."""

    cost: PerState  # J_N(x₀)
    value: PerState  # V(0, x₀)
    optimal_cost: PerState | None  # J*(x₀), where an oracle knows it
    constraint_loss: PerState  # the program's sum along the trajectory
    hinge: PerState  # Σ_n max(V_{n+1} − V_n + Δt ℓ_n, 0)
    decreasing: Tensor  # bool: V_{n+1} ≤ V_n at every step
    terminal_error: PerState  # ‖x_N‖

    def rows(self, chosen: slice) -> "StateTable":
        """The table of some of the states."""
        columns: dict[str, Any] = {
            key: None if column is None else column[chosen] for key, column in vars(self).items()
        }
        return StateTable(**columns)

    def satisfied(self, tolerance: float) -> Tensor:
        """Whether the summed hinge is at most `tolerance` · V(0, x₀)."""
        return satisfied(self.hinge, self.value, tolerance)

    def summary(self) -> dict[str, float | None]:
        """The means and shares over the rows, under the names of `lyapnet evaluate --json`."""
        optimal = value_error = None
        if self.optimal_cost is not None:
            optimal = self.optimal_cost.mean()
            value_error = (self.value - self.optimal_cost).abs().mean() / optimal
        return {
            "cost_mean": float(self.cost.mean()),
            "cost_max": float(self.cost.max()),
            "optimal_cost_mean": None if optimal is None else float(optimal),
            "cost_ratio": None if optimal is None else float(self.cost.mean() / optimal),
            "value_mean": float(self.value.mean()),
            "value_to_cost": float(self.value.mean() / self.cost.mean()),
            "value_error": None if value_error is None else float(value_error),
            "constraint_loss": float(self.constraint_loss.mean()),
            "terminal_error": float(self.terminal_error.mean()),
            "bounded_fraction": _share(self.cost <= self.value),
            "decreasing_fraction": _share(self.decreasing),
            "satisfied_fraction": _share(self.satisfied(1e-2)),
            "satisfied_fraction_1e-3": _share(self.satisfied(1e-3)),
            "satisfied_fraction_1e-6": _share(self.satisfied(1e-6)),
        }


def measure(trajectory: Trajectory, program: Program, oracle: Callable[[State], PerState] | None) -> StateTable:
    """The table of a batch (b,) of trajectories under the control law of a V."""
    values = trajectory.require_value()
    return StateTable(
        cost=trajectory.cost,
        value=values[0],
        optimal_cost=None if oracle is None else oracle(trajectory.x[0]),
        constraint_loss=program.constraint_loss(values, trajectory),
        hinge=hinge(values, trajectory.step_cost),
        decreasing=(values.diff(dim=0) <= 0).all(0),
        terminal_error=torch.linalg.vector_norm(trajectory.x[-1], dim=-1),
    )


def evaluate(controller: Controller, samples: int = 256, seed: int = 0) -> dict[str, Any]:
    """The summary of a controller on fresh states of X₀, as `lyapnet evaluate` prints it.

    Costs, errors and the decreasing share are over `samples` states; the satisfied shares over K = 100 further ones.

    Raises:
        ValueError: fewer than one sample.
        DivergenceError: the closed loop leaves the finite numbers.
    """
    if samples < 1:
        raise ValueError(f"Expected samples ≥ 1, got {samples}; choose how many initial states to draw.")
    table = state_table(controller, controller.initial_states.sample(samples + PAPER_STATES, stream(seed, TEST)))
    summary = table.rows(slice(0, samples)).summary()
    paper = table.rows(slice(samples, None)).summary()
    satisfied = {key: value for key, value in paper.items() if key.startswith("satisfied_fraction")}
    return {**summary, **satisfied, "satisfied_states": PAPER_STATES, "samples": samples, "seed": seed}


def state_table(controller: Controller, x0: State) -> StateTable:
    """The table of a controller on given initial states (b, n)."""
    program = build_program(controller.config)
    oracle = optimal_cost(controller.system, controller.cost, controller.horizon, controller.config.rollout.method)
    with torch.no_grad():
        return measure(controller.rollout(x0), program, oracle)


def _share(holds: Tensor) -> float:
    return float(holds.double().mean())
