"""Measures of a controller for each initial state, and their summary."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch

from lyapnet.base.errors import DivergenceError, OracleError
from lyapnet.base.files import plain
from lyapnet.base.random_streams import SEARCH, TEST, stream
from lyapnet.base.sizes import require_memory, size_of_loops
from lyapnet.base.tables import csv_text
from lyapnet.base.types import PerState, State
from lyapnet.controller.controller import Controller
from lyapnet.controller.output_feedback import OutputFeedback
from lyapnet.evaluation.after_horizon import share_at_goal
from lyapnet.evaluation.on_plants import OnPlants, measure_on_plants
from lyapnet.evaluation.optimality import in_spreads, ratio_of_means
from lyapnet.evaluation.oracles import Report, RiccatiOracle, oracle_of, silent
from lyapnet.evaluation.references import costs_of_lqr, costs_of_plant
from lyapnet.evaluation.states import StateTable, cost_within_domain, measure
from lyapnet.evaluation.under_noise import NoiseMeasures, measure_under_noise
from lyapnet.evaluation.with_estimator import EstimatorMeasures, loops_with_estimator, measure_with_estimator
from lyapnet.evaluation.worst_states import excess, search_near_worst
from lyapnet.task.constraints import names_of
from lyapnet.task.problem import Problem
from lyapnet.task.systems import moving_states
from lyapnet.value.after_horizon import LOOPS

PAPER_STATES = 100  # K, the number of states on which the paper counts satisfied conditions
PATHS = 32  # paths of the noise from each state
NOT_ASKED = "The optimum was not requested"
TOO_MUCH_SPREAD = "log E exp(θJ)/θ is not measured, because too few of these paths count in it; costs are E J"
CORNER_AXES = 8  # axes of X₀ whose corners are tested, at most 2⁸ = 256


class Dearest(NamedTuple):
    """The state with the most expensive closed loop of some chosen ones, which random states hardly ever come near."""

    count: int  # number of tested states
    x0: list[float]
    cost: float | None  # J; None if one of these closed loops is not finite
    value: float  # V(0, x₀)


class Evaluation(NamedTuple):
    """The measures of a controller on new states of X₀."""

    table: StateTable
    paper: StateTable  # K = 100 further states
    notes: Sequence[str]  # the reason why J* is missing for each row of the table; empty if it is known
    seed: int
    problem: Problem
    corner: Dearest  # of the corners of X₀
    found: Dearest | None  # by a search near the states that cost most relative to V; None if none is lost
    held_cost: PerState | None  # cost from each state in continuous time with u held; infinite if it diverges
    lqr_cost: PerState | None  # cost from each state under LQR; None if there is no such law
    at_goal: float | None  # share of closed loops that the law after T keeps near the goal; None: see share_at_goal
    after: str  # name of the law after T
    optimum_of: str = ""  # model of the optimum: its steps, or continuous time; empty if none was computed
    noise: NoiseMeasures | None = None  # with noise; costs are then expectations
    plants: OnPlants | None = None  # with random plants; all other measures are those on the model
    estimated: EstimatorMeasures | None = None  # with outputs; all other measures are those with known state
    program: str = ""  # name of the class by which V was trained

    def result(self) -> dict[str, Any]:
        """The summary, as `lyapnet evaluate --json` prints it.

        The satisfied shares are over the K further states, all other measures over the table.
        """
        paper = {key: value for key, value in self.paper.summary().items() if key.startswith("satisfied_fraction")}
        system = self.problem.system
        counts = {"satisfied_states": len(self.paper.cost), "samples": len(self.table.cost), "seed": self.seed}
        limits = self.table.use_of_limits(system.control_names)
        used: dict[str, Any] = {"at_limits": limits} if limits else {}
        if (border := self.table.at_border) is not None:
            used["at_border"] = {"steps": float(border.mean()), "states": float((border > 0).double().mean())}
        if self.table.violated is not None:
            used["violated_fraction"] = float(self.table.violated.double().mean())
            used["constraints"] = self.table.violations(names_of(self.problem.constraints))
        if self.table.left is not None:
            used["left_domain_fraction"] = float(self.table.left.double().mean())
        return {
            **plain(self.table.summary()),
            **plain(paper),
            **self._references(),
            **({"terminal_errors": self._terminal_errors()} if self.problem.has_goal else {}),
            **used,
            **counts,
            **({} if self.noise is None else {"noise": plain(self.noise._asdict())}),
            **({} if self.plants is None else {"plants": plain(self.plants.summary())}),
            **({} if self.estimated is None else {"outputs": plain(self.estimated._asdict())}),
            **({} if self.at_goal is None else {"at_goal_fraction": self.at_goal, "after_T": self.after}),
            **({"optimum_of": self.optimum_of} if self.optimum_of else {}),
            **self._note(),
            "program": self.program,
            "worst_corner": self.corner._asdict(),
            **({} if self.found is None else {"worst_found": self.found._asdict()}),
        }

    def _terminal_errors(self) -> dict[str, float]:
        """The mean distance of each state from its goal at T."""
        system, errors = self.problem.system, self.problem.cost.from_goal(self.table.terminal_state).abs().mean(0)
        return {system.state_labels[i]: float(errors[i]) for i in moving_states(system)}

    def write(self, path: Path) -> None:
        """Write the table as CSV with a header line of names and units.

        Raises:
            OSError: the file cannot be written.
        """
        table, states = self.table, self.problem.system.state_labels
        optimal = torch.full_like(table.cost, torch.nan) if table.optimal_cost is None else table.optimal_cost
        columns = {
            **dict(zip(states, table.x0.unbind(-1), strict=True)),
            "cost": table.cost, "optimal_cost": optimal, "cost_ratio": table.cost / optimal, "value": table.value,
            "value_error": (table.value - optimal) / optimal, "constraint_loss": table.constraint_loss,
            "hinge": table.hinge, "decreasing": table.decreasing.int(), "falling": table.falling.int(),
            "largest_rise": table.largest_rise, "terminal_error": table.terminal_error,
            **{f"terminal {name}": x for name, x in zip(states, table.terminal_state.unbind(-1), strict=True)},
        }  # fmt: skip
        if table.worst is not None:
            names = names_of(self.problem.constraints)
            columns |= dict(zip((f"worst h, {name}" for name in names), table.worst.unbind(-1), strict=True))
        values = zip(*(column.tolist() for column in columns.values()), self.notes, strict=True)
        rows = [dict(zip([*columns, "no_optimum"], row, strict=True)) for row in values]
        path.write_text(csv_text(rows), encoding="utf-8")

    def _references(self) -> dict[str, float | None]:
        """Mean costs in continuous time and of LQR, and their ratios to the optimum; None if not finite."""
        optimal = torch.full_like(self.table.cost, torch.nan)
        optimal = optimal if self.table.optimal_cost is None else self.table.optimal_cost
        measures = dict[str, float | None]()
        for name, cost in (("held", self.held_cost), ("lqr", self.lqr_cost)):
            if cost is not None:
                measures[f"{name}_cost_mean"] = float(cost.mean())
                if self.problem.has_goal:
                    measures[f"{name}_cost_ratio"] = ratio_of_means(cost, optimal)
                else:
                    measures[f"{name}_regret"] = in_spreads(cost - optimal, optimal)
        return plain(measures)

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
    controller: Controller,
    samples: int = 256,
    seed: int = 0,
    optimum: bool = True,
    progress: Report = silent,
    paths: int = PATHS,
    estimator: OutputFeedback | None = None,
) -> dict[str, Any]:
    """The summary of a controller on new states of X₀; see Evaluation.result.

    Raises:
        ValueError: fewer than one sample, or than two paths.
        DivergenceError: a closed loop is not finite.
    """
    return evaluation(controller, samples, seed, optimum, progress, paths, estimator).result()


def evaluation(
    controller: Controller,
    samples: int = 256,
    seed: int = 0,
    optimum: bool = True,
    progress: Report = silent,
    paths: int = PATHS,
    estimator: OutputFeedback | None = None,
) -> Evaluation:
    """The measures of a controller on new states of X₀; with noise, expectations over paths from each of them.

    Args:
        samples: number of states; K = 100 further states are drawn for the satisfied shares.
        optimum: whether costs are compared with the optimum, if there is an oracle.
        progress: progress callback of the oracle.
        paths: paths of the noise from each state, if the task has noise.
        estimator: the controller with an estimator, which is measured besides; None: an extended Kalman filter if the
            config has outputs.

    Raises:
        ValueError: fewer than one sample.
        DivergenceError: a closed loop is not finite.
    """
    if samples < 1:
        raise ValueError(f"Expected samples ≥ 1, got {samples}; choose how many initial states to draw.")
    size = size_of_loops(samples, controller.horizon.steps, controller.system.n)
    require_memory("samples", samples, size, "draw fewer")
    x0 = controller.initial_states.sample(samples + PAPER_STATES, stream(seed, TEST))
    if estimator is None and controller.measures_outputs:
        estimator = controller.with_estimator()
    estimated, program = None, type(controller.program).__name__
    if estimator is not None:
        estimated = measure_with_estimator(loops_with_estimator(controller, estimator, x0[:samples], seed), estimator)
    if controller.problem.noise is not None:
        under_noise = _evaluation_under_noise(controller, x0, samples, seed, optimum, progress, paths)
        return under_noise._replace(estimated=estimated, program=program)
    plants = controller.plants
    on_plants = None if plants is None else measure_on_plants(plants, x0[:samples], seed, optimum, progress)
    on_model = _evaluation_on_model(controller, x0, samples, seed, optimum, progress)
    return on_model._replace(plants=on_plants, estimated=estimated, program=program)


def _evaluation_on_model(
    controller: Controller, x0: State, samples: int, seed: int, optimum: bool, progress: Report
) -> Evaluation:
    """The measures without noise, on the model."""
    trajectory = controller.closed_loops(x0)  # with controls as elements of U, like those of optima
    with torch.no_grad():
        table = measure(controller.problem, controller.program, trajectory)
    cost, left = cost_within_domain(controller.problem, trajectory)
    table = dataclasses.replace(table, cost=cost, left=left)
    first, paper = table.rows(slice(0, samples)), table.rows(slice(samples, None))
    problem, corner = controller.problem, dearest_corner(controller)
    found = _dearest_near_worst(controller, first, seed)
    held = costs_of_plant(problem, controller.closed_loop.policy, first.x0)
    later = share_at_goal(controller, first.x0[:LOOPS]), controller.law.beyond
    further = (seed, problem, corner, found, held, costs_of_lqr(problem, first.x0), *later)
    if not optimum:
        return Evaluation(first, paper, [NOT_ASKED] * samples, *further)
    try:
        oracle = oracle_of(problem, controller.method)
        optima = oracle.solve(first.x0, trajectory.u[:, :samples], progress)  # the controller's u are initial guesses
    except OracleError as reason:
        return Evaluation(first, paper, [str(reason)] * samples, *further)
    exact = isinstance(oracle, RiccatiOracle) and controller.method != "euler"
    about = "continuous time" if exact else f"steps of {problem.horizon.dt:g} s ({controller.method}) with u held"
    return Evaluation(dataclasses.replace(first, optimal_cost=optima.cost), paper, optima.reasons, *further, about)


def _evaluation_under_noise(
    controller: Controller, x0: State, samples: int, seed: int, optimum: bool, progress: Report, paths: int
) -> Evaluation:
    """The measures under noise; there is no reference in continuous time, and nothing is said of the time after T."""
    if paths < 2:
        raise ValueError(f"Expected paths ≥ 2 for an interval, got {paths}; choose how many to draw from each state.")
    problem = controller.problem
    table, noise, lqr = measure_under_noise(controller, x0, paths, samples, seed, progress)
    first, paper = table.rows(slice(0, samples)), table.rows(slice(samples, None))
    lqr, after = None if lqr is None else lqr[:samples], controller.law.beyond
    further = (seed, problem, dearest_corner(controller, noise=seed), None, None, lqr, None, after)
    about, notes = "", [""] * samples
    if noise.risk and noise.with_risk is None:
        notes = [TOO_MUCH_SPREAD] * samples
    elif optimum:
        try:
            first = dataclasses.replace(first, optimal_cost=oracle_of(problem, controller.method)(first.x0))
            about = f"steps of {problem.horizon.dt:g} s ({controller.method}) with u held, in expectation"
        except OracleError as reason:
            notes = [str(reason)] * samples
    else:
        notes = [NOT_ASKED] * samples
    return Evaluation(first, paper, notes, *further, about, noise)


def _dearest_near_worst(controller: Controller, table: StateTable, seed: int) -> Dearest | None:
    """The most expensive state of a search near those of a table that cost most relative to V; None if none is lost."""
    has_goal, tested = controller.problem.has_goal, list[tuple[State, PerState, PerState]]()

    def excesses_from(x0: State) -> PerState:
        cost, value = _cost_and_value(controller, x0)
        tested.append((x0, cost, value))
        return excess(cost, value, has_goal, table.cost)

    excesses, generator = excess(table.cost, table.value, has_goal), stream(seed, TEST, SEARCH)
    search_near_worst(controller.initial_states, table.x0, excesses, excesses_from, generator)
    return _dearest(*(torch.cat(column) for column in zip(*tested, strict=True))) if tested else None


def _cost_and_value(controller: Controller, x0: State, noise: int | None = None) -> tuple[PerState, PerState]:
    """J and V(0, x₀) from some states; J is infinite for all if a closed loop is not finite."""
    with torch.no_grad():
        value = controller.value(0.0, x0)
        try:
            return cost_within_domain(controller.problem, controller.rollout(x0, noise=noise))[0], value
        except DivergenceError:
            return torch.full_like(value, torch.inf), value


def _dearest(x0: State, cost: PerState, value: PerState) -> Dearest:
    i = int(cost.argmax())
    return Dearest(len(x0), x0[i].tolist(), float(cost[i]) if bool(cost[i].isfinite()) else None, float(value[i]))


def dearest_corner(controller: Controller, noise: int | None = None) -> Dearest:
    """The corner of X₀ with the most expensive closed loop, among the corners along its first CORNER_AXES axes.

    Args:
        noise: seed of one path of the noise from each corner; None: without noise.
    """
    x0 = controller.initial_states.corners(CORNER_AXES)
    return _dearest(x0, *_cost_and_value(controller, x0, noise))
