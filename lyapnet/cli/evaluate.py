"""lyapnet evaluate."""

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from lyapnet.base.errors import UsageError
from lyapnet.cli.options import Debug, Delay, FirstDeviation, Given, Measured, add_estimator, with_controller_options

if TYPE_CHECKING:
    from lyapnet.controller.controller import Controller
    from lyapnet.controller.output_feedback import OutputFeedback
    from lyapnet.evaluation.after_horizon import LoopsAfterHorizon
    from lyapnet.evaluation.measurement import Evaluation


@with_controller_options
def evaluate(
    given: Given,
    samples: Annotated[int, typer.Option(min=1, help="Initial states to draw.")] = 256,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the draw.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    optimum: Annotated[bool, typer.Option(help="Compare with the optimum, where there is an oracle.")] = True,
    table: Annotated[Path | None, typer.Option(help="Write a row for each state.", metavar="FILE.csv")] = None,
    figures: Annotated[Path | None, typer.Option(help="Write figures into this folder.", metavar="FOLDER")] = None,
    disturbed: Annotated[
        bool, typer.Option("--robustness", help="Also outside X₀, on other plants, under noise, with half the Δt.")
    ] = False,
    until: Annotated[
        float | None,
        typer.Option(help="Also under each law that can follow T, up to this multiple of T.", metavar="MULTIPLE"),
    ] = None,
    plant: Annotated[
        Path | None,
        typer.Option(help="Also in MuJoCo's simulator, with the plant of this MJCF or URDF file.", metavar="FILE.xml"),
    ] = None,
    animation: Annotated[
        Path | None,
        typer.Option(help="With --plant: the first of these closed loops as MuJoCo draws it.", metavar="FILE.gif"),
    ] = None,
    paths: Annotated[int, typer.Option(min=2, help="Paths of the noise from each state, if the task has noise.")] = 32,
    outputs: Measured = None,
    estimator: Annotated[
        str, typer.Option(help="The estimator, if outputs are measured: ekf or ukf, Kalman filters.")
    ] = "ekf",
    deviation: FirstDeviation = None,
    delay: Delay = None,
    debug: Debug = False,
) -> None:
    """Measure a controller on fresh initial states of X₀; of a family, on fresh states and parameters.

    The optimum of a linear task follows from the Riccati equation; that of any other needs CasADi, the extra oracle.
    Optima are computed once for each state and kept for later evaluations of the task.
    """
    from lyapnet.evaluation.after_horizon import check_multiple, loops_after_horizon, to_plain_data
    from lyapnet.evaluation.in_simulator import read_plant, simulate
    from lyapnet.evaluation.measurement import evaluation
    from lyapnet.evaluation.movie import require_ending
    from lyapnet.evaluation.robustness import not_varied, robustness
    from lyapnet.evaluation.simulator_movie import SimulatorMovie, renderer_of
    from lyapnet.evaluation.tables import evaluation_table

    for option, file in (("--table", table), ("--animation", animation)):
        if file is not None and not file.parent.is_dir():
            raise UsageError(
                f"Expected {option} in a folder that exists, got {str(file)!r}; make {str(file.parent)!r} first."
            )
    if animation is not None:
        require_ending(animation)
        if plant is None:
            raise UsageError("Expected --plant with --animation, got none; without a plant write lyapnet animate.")
    controller = given.load()
    filtered = add_estimator(controller, outputs or [], estimator, deviation, delay)
    count = min(samples, 64)
    simulated = None if plant is None else read_plant(plant, controller, animation is not None)
    renderer = None if simulated is None or animation is None else renderer_of(simulated)
    if until is not None:
        check_multiple(controller, until, count)
    report, notes = given.report, Console(stderr=True, highlight=False, markup=False)
    report(f"closed loops from {samples:,} states of X₀")
    stage = "optima of states" if controller.problem.noise is None else "paths of the noise"
    measured = evaluation(controller, samples, seed, optimum, partial(report, stage), paths, filtered)
    result = measured.result()
    if not as_json:
        report.rest()
        Console(highlight=False, markup=False).print(evaluation_table(given.title, result))
    if disturbed:
        rows = robustness(controller, count, seed, optimum, lambda name: report(f"disturbance: {name}"))
        result["robustness"] = [row._asdict() for row in rows]
        result["robustness_unchanged"] = not_varied(controller)
    later = []
    if until is not None:
        report(f"closed loops up to {until:g} T")
        later = loops_after_horizon(controller, measured.table.x0[:count], until)
        result["afterwards"] = to_plain_data(later, controller, until)
    if simulated is not None:
        report(f"closed loops in MuJoCo from {count} states")
        loops = simulate(controller, simulated, measured.table.x0[:count])
        result["simulator"] = loops.summary()
        if renderer is not None and animation is not None:
            SimulatorMovie(simulated, renderer, loops.positions, controller.horizon.duration).write(animation)
    report.rest()
    if as_json:
        print(json.dumps(result))
    else:
        _print_further_tables(result, controller, count, "" if plant is None else plant.name)
    if table is not None:
        measured.write(table)
        notes.print(f"wrote {table}", soft_wrap=True)
    if animation is not None:
        notes.print(f"wrote {animation}", soft_wrap=True)
    if figures is not None:
        report("drawing")
        wrote = _write_figures(figures, controller, measured, later, filtered)
        report.rest()
        notes.print(wrote, soft_wrap=True)


def _print_further_tables(result: dict[str, Any], controller: "Controller", count: int, plant: str) -> None:
    """Print the tables of further measurements, from `count` states."""
    from lyapnet.evaluation.robustness import nominal
    from lyapnet.evaluation.tables import after_horizon_table, robustness_table, simulator_table

    console, noisy = Console(highlight=False, markup=False), controller.problem.noise is not None
    if "robustness" in result:
        unchanged = result["robustness_unchanged"]
        console.print(robustness_table(result["robustness"], count, nominal(controller), noisy, unchanged))
    if "simulator" in result:
        console.print(simulator_table(result["simulator"], plant, count))
    if "afterwards" in result:
        console.print(after_horizon_table(result["afterwards"], count, noisy))


def _write_figures(
    folder: Path,
    controller: "Controller",
    measured: "Evaluation",
    later: "list[LoopsAfterHorizon]",
    estimator: "OutputFeedback | None",
) -> str:
    """Draw closed loops, V, and cost and V(0, x₀) against the optimum if known; return a sentence about the files."""
    from lyapnet.evaluation import figures
    from lyapnet.evaluation.after_horizon_figure import distances
    from lyapnet.evaluation.estimator_figure import states_and_estimates
    from lyapnet.evaluation.noise_figure import bands, states_to_draw
    from lyapnet.evaluation.path_figure import has_plane, paths
    from lyapnet.evaluation.plants_figure import cost_against_parameters
    from lyapnet.evaluation.with_estimator import loops_with_estimator

    x0, problem = measured.table.x0[:12], controller.problem
    seed = None if problem.noise is None else measured.seed
    trajectory = controller.rollout(x0, noise=seed)
    drawn = {
        "trajectories": figures.trajectories(trajectory, problem),
        "value_slices": figures.value_slices(controller.value, problem),
    }
    if has_plane(problem):
        drawn["paths"] = paths(trajectory, problem)
    if seed is not None:
        drawn["noise"] = bands(controller.rollout(states_to_draw(x0), noise=seed), problem)
    if measured.result()["optimal_cost_mean"] is not None:
        drawn["optimality"] = figures.optimality(measured.table)
    if measured.plants is not None and measured.plants.optimal_cost is not None:
        drawn["plants"] = cost_against_parameters(measured.plants)
    if estimator is not None:
        loops = loops_with_estimator(controller, estimator, measured.table.x0[:1], measured.seed)
        drawn["estimates"] = states_and_estimates(loops, estimator)
    if any(one.distance is not None for one in later):
        drawn["afterwards"] = distances(later, controller)
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in drawn.items():
        figure.savefig(folder / f"{name}.png", dpi=150)
    missing = "" if "optimality" in drawn else "; no optimality.png, because the optimum is not known"
    return f"wrote {', '.join(f'{name}.png' for name in drawn)} into {folder}{missing}"
