"""lyapnet bench gradient | certify | law | optima."""

import json
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from typer.core import TyperGroup

from lyapnet.base.errors import UsageError
from lyapnet.base.files import plain
from lyapnet.base.sizes import THREADS
from lyapnet.cli.options import Debug, Given, make_stages, with_controller_options

DEFAULT = "gradient"


class WithDefault(TyperGroup):
    """A group of commands with a default command."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        named = args and (args[0] in self.commands or args[0] == "--help")
        return super().parse_args(ctx, args if named else [DEFAULT, *args])


app = typer.Typer(cls=WithDefault)

Overrides = Annotated[list[str] | None, typer.Argument(help="Changes to every task's config, as key.sub=value.")]
Tasks = Annotated[
    list[str] | None,
    typer.Option(help="NAME in conf/NAME.yaml, a YAML file, or chain:N for N integrators; double_integrator if none."),
]


@app.callback()
def bench() -> None:
    """Measure gradients of a loss (the default), bounds, one control, or optima, each against alternatives.

    See lyapnet bench gradient --help, and likewise certify, law and optima.
    """


@app.command(DEFAULT)
def gradient(
    overrides: Overrides = None,
    task: Tasks = None,
    batch: Annotated[list[str] | None, typer.Option(help="Numbers of initial states; 12,64,512 if none.")] = None,
    routes: Annotated[
        list[str] | None, typer.Option(help="Some of the routes above; all that can run here if none.")
    ] = None,
    repeats: Annotated[int, typer.Option(min=1, help="Number of timings; their median counts.")] = 7,
    threads: Annotated[int, typer.Option(min=1, max=THREADS, help="CPU threads.")] = 1,
    as_json: Annotated[bool, typer.Option("--json", help="Print a list of objects, one for each row.")] = False,
    figures: Annotated[Path | None, typer.Option(help="Write figures into this folder.", metavar="FOLDER")] = None,
    debug: Debug = False,
) -> None:
    """Time the routes to the gradient of a training loss; measure their memory and error.

    Routes, of which the starred ones appear twice, eager and compiled:

    rollout *            the closed loop without a gradient: the floor
    adjoint              odeint_adjoint, V_x by the network's formula
    adjoint-autograd     odeint_adjoint, V_x by autograd
    backprop             backpropagation through the steps
    discrete *           the exact discrete adjoint
    jax, jax-checkpoint  the same loss jitted in JAX, where it is installed
    jax-rollout          and its closed loop alone

    All routes of one task and batch are warmed up, then timed in turns.
    Memory is the peak beyond the model; errors are relative, against
    backprop in float64. % of peak: multiply-adds of V and V_x at each step,
    three times for a gradient, per second, beside those in products of
    large matrices. Compiled is by lyapnet's kernel on a CPU, and by
    CUDA graphs on a GPU; rollout.compile=off leaves it out.

    lyapnet bench --task double_integrator,reacher --batch 12,64 --json
    lyapnet bench --batch 1,8,64,512,4096 --routes rollout,discrete --figures out
    lyapnet bench --task chain:2,chain:8,chain:32 --batch 64 --figures out
    lyapnet bench network.name=fcn program.name=value training.precision=float32
    """
    from lyapnet.graphs.compilation import has_compiler
    from lyapnet.lab import bench as benchmark
    from lyapnet.lab.bench.tables import bench_table

    benchmark.use_threads(threads)
    cases = [benchmark.load_case(name, overrides or []) for name in _items(task) or ["double_integrator"]]
    chosen = [(case, benchmark.routes_for(case, _items(routes))) for case in cases]
    batches = [_count("--batch", text) for text in _items(batch) or ["12", "64", "512"]]
    if figures is not None:
        figures.mkdir(parents=True, exist_ok=True)
    console, report = Console(highlight=False, markup=False), make_stages("gradient")
    say, rows = partial(report.console.print, soft_wrap=True), []
    if not has_compiler():
        say("No C++ compiler ($CXX, g++ or clang++): compiled rows are left out.")
    with report:
        for case, names in chosen:
            for size in batches:
                report(f"{case.name}, batch {size}: {', '.join(names)}")
                rows += benchmark.time_routes(case, size, names, repeats, say)
            report.rest()
            if not as_json:
                console.print(bench_table(case, [row for row in rows if row.task == case.name], repeats, threads))
    if as_json:
        print(json.dumps([asdict(row) for row in rows]))
    if figures is not None:
        for path in _write_figures(figures, cases[0], rows):
            say(f"wrote {path}")


@app.command()
def certify(
    checkpoint: Annotated[
        Path | None,
        typer.Argument(help="The controller whose condition is bounded; a new tanh network if none.", metavar="[CKPT]"),
    ] = None,
    dimensions: Annotated[str, typer.Option(help="Lengths of the chains of integrators.")] = "2,3,4,5",
    seconds: Annotated[float, typer.Option(min=0, help="Time limit of each proof.")] = 60.0,
    boxes: Annotated[int, typer.Option(min=1, help="Boxes of each size, for medians.")] = 200,
    repeats: Annotated[int, typer.Option(min=1, help="Number of timings; their median counts.")] = 7,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    figures: Annotated[Path | None, typer.Option(help="Write certify_bench.png there.", metavar="FOLDER")] = None,
    debug: Debug = False,
) -> None:
    """Compare the bounds of the prover with plain interval arithmetic and mean-value forms.

    Tightness: c = V̇ + αℓ − δ on random boxes in [0, T] × X₀, by sides as
    shares of the axes. The factor is the width of the enclosure over that
    of the range, which samples and ascent find; the order is that of the
    difference of these widths. Boxes per second are timed in turns.

    Proofs: V of the Riccati equation on chains of 2 to 5 integrators, for
    which c ≤ 0 is true, and a twin for which it is false, by the prover and
    by plain bisection with each enclosure. A method that finds no verdict
    is not tried on longer chains.

    lyapnet bench certify --figures out
    lyapnet bench certify logs/double_integrator/version_0/checkpoints/best.ckpt --dimensions 2 --json
    """
    from lyapnet.controller.loading import load
    from lyapnet.lab.bench.conditions import condition_of_controller, condition_of_network
    from lyapnet.lab.bench.enclosures import enclosures_of
    from lyapnet.lab.bench.proofs import growth
    from lyapnet.lab.bench.tables import proofs_table, tightness_table
    from lyapnet.lab.bench.tightness import tightness

    lengths = [_count("--dimensions", text) for text in _items([dimensions])]
    if figures is not None:
        figures.mkdir(parents=True, exist_ok=True)
    console, report = Console(highlight=False, markup=False), make_stages("certify")
    notes, proofs = report.console, []
    case = condition_of_network() if checkpoint is None else condition_of_controller(load(checkpoint))
    with report:
        enclosures = enclosures_of(case.condition, (case.lower, case.upper), partial(notes.print, soft_wrap=True))
        report(f"{case.name}: {', '.join(enclosures)}")
        bounds = tightness(case, enclosures, boxes, repeats)
        report("chains of integrators")
        for proof in growth(lengths, seconds):
            proofs.append(proof)
            last = f"{proof.case}, {proof.method}: {proof.verdict} after {proof.seconds:.3g} s"
            report("chains of integrators", detail=last)
    if as_json:
        print(
            json.dumps(
                {"tightness": plain([asdict(row) for row in bounds]), "proofs": plain([asdict(row) for row in proofs])}
            )
        )
    else:
        console.print(tightness_table(bounds, boxes), proofs_table(proofs, seconds))
    if figures is not None:
        from lyapnet.lab.bench.figures import certify_bench

        certify_bench(bounds, proofs).savefig(figures / "certify_bench.png", dpi=130)
        notes.print(f"wrote {figures / 'certify_bench.png'}", soft_wrap=True)


@app.command()
@with_controller_options
def law(
    given: Given,
    seconds: Annotated[float, typer.Option(min=0.01, help="For each way.")] = 10.0,
    beside: Annotated[bool, typer.Option("--beside", help="Time MPC and a policy of SB3 too.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print a list of objects, one for each row.")] = False,
    debug: Debug = False,
) -> None:
    """Time one control in a loop of 1 kHz: in C as `lyapnet export` writes it, and in Python.

    --beside needs the extras oracle and baselines: MPC over all of T, warm-started by its last plan, and PPO's policy,
    both along closed loops.

    lyapnet bench law logs/double_integrator/version_0/checkpoints/best.ckpt --seconds 60
    """
    from lyapnet.lab.bench.latency import latencies
    from lyapnet.lab.bench.tables import latency_table

    controller, others = given.load(), None
    if beside:
        from lyapnet.lab.comparison.timing import alternatives

        others = alternatives(controller)
    given.report("writing, compiling, timing")
    rows = latencies(controller, seconds, others)
    given.report.rest()
    if as_json:
        print(json.dumps([asdict(row) for row in rows]))
    else:
        Console(highlight=False, markup=False).print(latency_table(rows, given.title))


@app.command()
def optima(
    overrides: Overrides = None,
    task: Tasks = None,
    compared: Annotated[int, typer.Option(min=0, help="Optima that the oracle finds too.")] = 64,
    as_json: Annotated[bool, typer.Option("--json", help="Print a list of objects, one for each row.")] = False,
    debug: Debug = False,
) -> None:
    """Time the optima from which a training starts; compare their costs with the oracle's, of the extra oracle.

    lyapnet bench optima --task pendulum_swingup,quadrotor
    """
    from lyapnet.lab.bench import load_case, use_threads
    from lyapnet.lab.bench.optima import time_optima
    from lyapnet.lab.bench.tables import optima_table

    use_threads(1)
    with make_stages("optima") as report:
        cases = [load_case(name, overrides or []) for name in _items(task) or ["double_integrator"]]
        rows = [time_optima(case, compared, report) for case in cases]
        report.rest()
    if as_json:
        print(json.dumps([plain(asdict(row)) for row in rows]))
    else:
        Console(highlight=False, markup=False).print(optima_table(rows))


def _items(values: list[str] | None) -> list[str]:
    """The entries of a repeated option, each of which may hold several between commas."""
    return list(dict.fromkeys(item.strip() for value in values or [] for item in value.split(",")))


def _count(option: str, text: str) -> int:
    if not (text.isdecimal() and int(text) > 0):
        raise UsageError(f"Expected {option} as numbers ≥ 1, got {text!r}; for example {option} 2,5.")
    return int(text)


def _write_figures(folder: Path, first: Any, rows: list[Any]) -> list[Path]:
    """Write the figures for which there are rows, and that of the gradient errors of the first task."""
    from lyapnet.lab.bench import figures, gradient_accuracy, is_chain

    horizon = first.problem.horizon
    title = (
        f"{first.name}: ∂J/∂θ of the mean trajectory cost over {horizon.duration:g} s, "
        f"in {horizon.steps}/16 to {horizon.steps}/2 steps; dopri5 by its tolerance"
    )
    drawn = {"gradient_error": figures.gradient_error(gradient_accuracy(first), title)}
    chains = [row for row in rows if is_chain(row.task)]
    if others := [row for row in rows if row not in chains]:
        drawn["gradient_time"] = figures.gradient_time(others)
    if chains:
        drawn["steps_per_second_against_n"] = figures.steps_per_second_against_n(chains)
    for name, figure in drawn.items():
        figure.savefig(folder / f"{name}.png", dpi=150)
    return [folder / f"{name}.png" for name in drawn]
