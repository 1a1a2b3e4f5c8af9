"""Measurements of a controller, one number for each initial state, and their summary."""

import csv
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lyapnet.build import build_program
from lyapnet.controller import Controller
from lyapnet.errors import OracleError
from lyapnet.oracles import Optima, Report, oracle_of, silent
from lyapnet.programs import Program
from lyapnet.programs.terms import hinge, satisfied
from lyapnet.randomness import TEST, stream
from lyapnet.rollout import Trajectory
from lyapnet.systems import ControlAffineSystem
from lyapnet.types import ControlPath, PerState, State

PAPER_STATES = 100  # K, the number of states on which the paper counts satisfied conditions


@dataclass(frozen=True)
class StateTable:
    """One row for each initial state."""

    x0: State
    cost: PerState  # J_N(x₀)
    value: PerState  # V(0, x₀)
    optimal_cost: PerState | None  # J*(x₀), where there is an oracle; NaN where it found none
    constraint_loss: PerState  # the program's sum along the trajectory
    hinge: PerState  # Σ_n max(V_{n+1} − V_n + Δt ℓ_n, 0)
    decreasing: Tensor  # bool: V_{n+1} ≤ V_n at every step
    terminal_state: State  # x_N

    @property
    def terminal_error(self) -> PerState:
        """‖x_N‖."""
        return torch.linalg.vector_norm(self.terminal_state, dim=-1)

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
        return {
            "cost_mean": float(self.cost.mean()),
            "cost_max": float(self.cost.max()),
            **self.against_optimum(),
            "value_mean": float(self.value.mean()),
            "value_to_cost": float(self.value.mean() / self.cost.mean()),
            "constraint_loss": float(self.constraint_loss.mean()),
            "terminal_error": float(self.terminal_error.mean()),
            "bounded_fraction": _share(self.cost <= self.value),
            "decreasing_fraction": _share(self.decreasing),
            "satisfied_fraction": _share(self.satisfied(1e-2)),
            "satisfied_fraction_1e-3": _share(self.satisfied(1e-3)),
            "satisfied_fraction_1e-6": _share(self.satisfied(1e-6)),
        }

    def against_optimum(self) -> dict[str, float | None]:
        """Ratio of the mean costs, J / J*, and mean |V(0, x₀) − J*| / mean J*: over the states whose J* is known."""
        optimal = torch.full_like(self.cost, torch.nan) if self.optimal_cost is None else self.optimal_cost
        known = torch.isfinite(optimal)
        mean, count = optimal[known].mean(), int(known.sum())
        measured = {
            "optimal_cost_mean": mean,
            "cost_ratio": self.cost[known].mean() / mean,
            "value_error": (self.value - optimal)[known].abs().mean() / mean,
        }
        failures = None if self.optimal_cost is None else len(known) - count
        numbers = {key: float(number) if count else None for key, number in measured.items()}
        return {**numbers, "optimum_failures": failures}


def measure(trajectory: Trajectory, program: Program, optimal_cost: PerState | None = None) -> StateTable:
    """The table of a batch (b,) of trajectories under the control law of a V.

    Args:
        optimal_cost: J* of each, where it is known.
    """
    values = trajectory.require_value()
    return StateTable(
        x0=trajectory.x[0],
        cost=trajectory.cost,
        value=values[0],
        optimal_cost=optimal_cost,
        constraint_loss=program.constraint_loss(values, trajectory),
        hinge=hinge(values, trajectory.step_cost),
        decreasing=(values.diff(dim=0) <= 0).all(0),
        terminal_state=trajectory.x[-1],
    )


class Evaluation(NamedTuple):
    """What a controller does from fresh states of X₀."""

    table: StateTable
    paper: StateTable  # of K = 100 further states
    notes: Sequence[str]  # why J* is missing, one for each row of the table; empty where it is not
    seed: int
    system: ControlAffineSystem

    def result(self) -> dict[str, Any]:
        """The summary, as `lyapnet evaluate --json` prints it.

        Costs, errors and the decreasing share are over the table; the satisfied shares over the K further states.
        """
        paper = {key: value for key, value in self.paper.summary().items() if key.startswith("satisfied_fraction")}
        terminal = dict(zip(self.system.state_labels, self.table.terminal_state.abs().mean(0).tolist(), strict=True))
        counts = {"satisfied_states": len(self.paper.cost), "samples": len(self.table.cost), "seed": self.seed}
        return {**self.table.summary(), **paper, "terminal_errors": terminal, **counts, **self._note()}

    def write(self, path: Path) -> None:
        """The table as comma-separated values with a line of names and units.

        Raises:
            OSError: the file cannot be written.
        """
        table, states = self.table, self.system.state_labels
        optimal = torch.full_like(table.cost, torch.nan) if table.optimal_cost is None else table.optimal_cost
        columns = {
            **dict(zip(states, table.x0.unbind(-1), strict=True)),
            "cost": table.cost, "optimal_cost": optimal, "cost_ratio": table.cost / optimal, "value": table.value,
            "value_error": (table.value - optimal) / optimal, "constraint_loss": table.constraint_loss,
            "hinge": table.hinge, "decreasing": table.decreasing.int(), "terminal_error": table.terminal_error,
            **{f"terminal {name}": x for name, x in zip(states, table.terminal_state.unbind(-1), strict=True)},
        }  # fmt: skip
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow([*columns, "no_optimum"])
            writer.writerows(zip(*(column.tolist() for column in columns.values()), self.notes, strict=True))

    def _note(self) -> dict[str, str]:
        missing = [note for note in self.notes if note]
        if not missing:
            return {}
        if len(set(missing)) == 1 and len(missing) == len(self.notes):
            return {"no_optimum": missing[0]}
        return {
            "no_optimum": f"{len(missing)} of {len(self.notes)} states have no optimum and are left out: {missing[0]}"
        }


def evaluate(
    controller: Controller, samples: int = 256, seed: int = 0, optimum: bool = True, progress: Report = silent
) -> dict[str, Any]:
    """The summary of a controller on fresh states of X₀; see Evaluation.result.

    Raises:
        ValueError: fewer than one sample.
        DivergenceError: the closed loop leaves the finite numbers.
    """
    return evaluation(controller, samples, seed, optimum, progress).result()


def evaluation(
    controller: Controller, samples: int = 256, seed: int = 0, optimum: bool = True, progress: Report = silent
) -> Evaluation:
    """The measurements of a controller on fresh states of X₀, as many as `samples`, and on K = 100 further ones.

    Args:
        optimum: whether the first ones are compared with the optimum, where there is an oracle.
        progress: of the oracle.

    Raises:
        ValueError: fewer than one sample.
        DivergenceError: the closed loop leaves the finite numbers.
    """
    if samples < 1:
        raise ValueError(f"Expected samples ≥ 1, got {samples}; choose how many initial states to draw.")
    trajectory = controller.rollout(controller.initial_states.sample(samples + PAPER_STATES, stream(seed, TEST)))
    with torch.no_grad():
        table = measure(trajectory, build_program(controller.config))
    first, paper = table.rows(slice(0, samples)), table.rows(slice(samples, None))
    if not optimum:
        return Evaluation(first, paper, ["not asked for"] * samples, seed, controller.system)
    try:
        optima = _optima(controller, first.x0, trajectory.u[:, :samples], progress)
    except OracleError as reason:
        return Evaluation(first, paper, [str(reason)] * samples, seed, controller.system)
    return Evaluation(
        dataclasses.replace(first, optimal_cost=optima.cost), paper, optima.reasons, seed, controller.system
    )


def _optima(controller: Controller, x0: State, known: ControlPath, progress: Report) -> Optima:
    """The optima from the states of X₀; the controller's own controls are starts of the oracle."""
    oracle = oracle_of(controller.system, controller.cost, controller.horizon, controller.config.rollout.method)
    return oracle.solve(x0, known, progress)


def _share(holds: Tensor) -> float:
    return float(holds.double().mean())
