"""The command line: lyapnet train | evaluate | systems."""

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Column, Table

from lyapnet.errors import LyapnetError

app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
)
Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]
Checkpoint = Annotated[Path, typer.Argument(help="A checkpoint of a run.", metavar="CKPT")]


@app.callback(invoke_without_command=True)
def lyapnet(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """Learn time-varying value functions and Lyapunov functions, and measure what they are worth."""
    if version:
        from lyapnet import __version__

        print(__version__)


@app.command()
def train(
    overrides: Annotated[list[str] | None, typer.Argument(help="Changes to the config, as key.sub=value.")] = None,
    config: Annotated[Path | None, typer.Option(help="The experiment, a YAML file.")] = None,
    resume: Annotated[
        str | None, typer.Option(help="Continue a run: last, or a checkpoint.", metavar="last|PATH")
    ] = None,
    finetune: Annotated[Path | None, typer.Option(help="Start a new run from the weights of a checkpoint.")] = None,
    debug: Debug = False,
) -> None:
    """Train one experiment; python train.py is the same command."""
    from lyapnet.experiment import fit, plan_run  # Lightning takes seconds to import: only where it is needed

    console = Console(highlight=False)
    plan = plan_run(config, overrides or [], resume, finetune)
    if plan.resume_from and plan.run.finished and _reached_end(plan):
        console.print(f"{plan.run.folder} is finished: nothing to resume. Raise training.iterations to train longer.")
        return
    result = fit(plan, console)
    if result:
        _print_result(console, plan, result)


@app.command()
def evaluate(
    checkpoint: Checkpoint,
    samples: Annotated[int, typer.Option(min=1, help="Initial states to draw.")] = 256,
    seed: Annotated[int, typer.Option(min=0, help="Of the draw.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    system: Annotated[str | None, typer.Option(help="module:Class of a system of your own.")] = None,
    network: Annotated[str | None, typer.Option(help="module:Class of a network of your own.")] = None,
    debug: Debug = False,
) -> None:
    """Measure a controller on fresh initial states of X₀."""
    import torch
    from torch import nn

    from lyapnet.build import build_system, resolve
    from lyapnet.checkpoint import read_checkpoint
    from lyapnet.config import SystemConfig
    from lyapnet.controller import config_of, load
    from lyapnet.evaluation import evaluate as measure
    from lyapnet.networks import NETWORKS

    own = None
    if system is not None:
        parameters = config_of(read_checkpoint(checkpoint), checkpoint).system.parameters
        own = build_system(SystemConfig(name=system, parameters=parameters))
    own_network = None if network is None else resolve(network, NETWORKS, "--network", nn.Module)
    controller = load(checkpoint, system=own, network=own_network)
    torch.set_num_threads(controller.config.training.threads)
    result = measure(controller, samples, seed)
    if as_json:
        print(json.dumps(result))
    else:
        Console(highlight=False).print(_table(str(checkpoint), result))


@app.command()
def systems(debug: Debug = False) -> None:
    """List the registered systems with their states, controls and parameters."""
    import inspect

    from lyapnet.systems import SYSTEMS

    parameters_column = Column("parameters (default)", overflow="fold")
    table = Table("system", "states", "controls", parameters_column, title="system.name in a config")
    for name, cls in SYSTEMS.items():
        parameters = inspect.signature(cls).parameters.values()
        shown = [p.name if p.default is p.empty else f"{p.name}={p.default}" for p in parameters]
        required = any(p.default is p.empty for p in parameters)
        instance = None if required else cls()
        table.add_row(
            name,
            "any number" if instance is None else _with_units(instance.state_names, instance.state_units),
            "any number" if instance is None else _with_units(instance.control_names, instance.control_units),
            ", ".join(shown),
        )
    console = Console(highlight=False)
    console.print(table)
    console.print("A system of your own: system.name=module:Class; see the README.")


def main(arguments: list[str] | None = None) -> int:
    """Run a command; the exit status: 0 done or cleanly interrupted, 1 failed, 2 asked wrongly."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        return app(arguments or ["--help"], prog_name="lyapnet", standalone_mode=False) or 0
    except Exception as error:  # the outermost frame: one line for the user, whatever happened
        if "--debug" in arguments:
            raise
        line, status = _explain(error)
        print(line, file=sys.stderr)
        return status
    except KeyboardInterrupt:
        print("Interrupted; whatever was saved is kept.", file=sys.stderr)
        return 130


def _explain(error: Exception) -> tuple[str, int]:
    """One line and the exit status for an exception that reached the user."""
    if isinstance(error, LyapnetError):
        status = error.exit_status
        return (f"error: {error}" if status else str(error)), status
    if isinstance(error, typer.TyperException):
        return f"error: {error.format_message().rstrip('.')}. See lyapnet --help.", error.exit_code
    if isinstance(error, OSError):
        return (
            f"error: {error.strerror or error}: {error.filename or 'a file of the run'}; check space and permissions.",
            1,
        )
    message = " ".join(str(error).split())
    return f"error: {type(error).__name__}: {message}; run again with --debug for the traceback.", 1


def _reached_end(plan: Any) -> bool:
    from lyapnet.checkpoint import read_checkpoint

    return read_checkpoint(plan.resume_from)["global_step"] >= plan.config.training.iterations


def _print_result(console: Console, plan: Any, result: dict[str, Any]) -> None:
    console.print(_table(f"{plan.config.experiment}, best checkpoint", result))
    best = plan.run.best
    for what, command in (
        ("run", plan.run.folder),
        ("watch", f"tensorboard --logdir {plan.config.logs}"),
        ("measure", f"lyapnet evaluate {best}"),
        ("fine-tune", f"{plan.command} --finetune {best}"),
        ("use", f'lyapnet.load("{best}")'),
    ):
        console.print(f"{what:<10}{command}", soft_wrap=True)


ROWS = {
    "cost_mean": "cost J, mean",
    "cost_max": "cost J, worst",
    "optimal_cost_mean": "optimal cost, mean",
    "cost_ratio": "cost / optimum",
    "value_mean": "V(0, x₀), mean",
    "value_to_cost": "V(0, x₀) / cost J, ratio of the means",
    "value_error": "value error, mean |V(0, x₀) − J*| / mean J*",
    "constraint_loss": "constraint loss, mean",
    "terminal_error": "terminal error, mean ‖x(T)‖",
    "bounded_fraction": "cost J ≤ V(0, x₀), share of states",
    "decreasing_fraction": "V decreases at every step, share of states",
    "satisfied_fraction": "condition holds within 1 % of V(0, x₀), share of K = 100",
    "satisfied_fraction_1e-3": "… within 0.1 %",
    "satisfied_fraction_1e-6": "… within 1e-6",
}


def _table(title: str, result: dict[str, Any]) -> Table:
    table = Table("measure", "value", title=f"{title}\n{result['samples']} unseen states of X₀, seed {result['seed']}")
    for key, label in ROWS.items():
        value = result[key]
        if value is None:
            table.add_row(label, "–")
            table.caption = "–: no oracle knows the optimum of this task"
        else:
            table.add_row(label, f"{value:.1%}" if key.split("_1e")[0].endswith("fraction") else f"{value:.4g}")
    return table


def _with_units(names: Any, units: Any) -> str:
    return ", ".join(f"{name} ({unit})" if unit else name for name, unit in zip(names, units, strict=True))
