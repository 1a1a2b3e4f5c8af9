"""lyapnet train."""

import json
import shlex
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from lyapnet.base.errors import Interrupted, UsageError
from lyapnet.cli.options import Debug, make_stages


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
    if config is None:
        raise UsageError("Expected --config PATH, got none; for example --config conf/double_integrator.yaml.")
    from lyapnet.experiment.config import load_config, outline

    outline(config, overrides or [])  # refuses misspelt keys before torch is imported
    console = Console(highlight=False, markup=False)
    command = shlex.join([*_find_command(sys.argv[0]), "--config", str(config), *(overrides or [])])
    try:
        with make_stages("train") as report:
            report(f"importing torch and Lightning for {config}")
            from lyapnet.experiment.assembly import default_of  # takes seconds
            from lyapnet.training.experiment import fit
            from lyapnet.training.plan import plan_run

            report("checking f, g, the cost and V")
            resolved = load_config(config, overrides or [])
            with default_of(resolved):
                plan = plan_run(resolved, resume, finetune)
    except Interrupted as stop:
        raise Interrupted(f"{stop} The training had not begun.", stop.exit_status) from None
    if plan.finished:
        finished = f"{plan.run.folder} is finished: nothing to resume."
        console.print(f"{finished} {plan.to_train_longer} to train longer.", soft_wrap=True)
        return
    with default_of(resolved):
        result = fit(plan, console, f"{command} --resume last")
    if result:
        _print_result(console, plan, result, command)


def _find_command(script: str) -> list[str]:
    """The command that was typed instead of `lyapnet train`, from the name of the running script."""
    typed = {"train.py": ["python", script], "__main__.py": ["python", "-m", "lyapnet", "train"]}
    return typed.get(Path(script).name, ["lyapnet", "train"])


def _print_result(console: Console, plan: Any, result: dict[str, Any], command: str) -> None:
    from lyapnet.evaluation.tables import evaluation_table, table_over_seeds
    from lyapnet.experiment.assembly import own_parts
    from lyapnet.experiment.assembly.named_parts import python_expression

    title, members = f"{plan.config.experiment}, best checkpoint", plan.run.members(plan.config)
    console.print(
        evaluation_table(title, result) if len(members) == 1 else table_over_seeds(f"{title} of each seed", result)
    )
    best, own = members[0].best, own_parts(plan.config)
    quoted = shlex.quote(str(best))
    options = "".join(f" --{part} {shlex.quote(name)}" for part, name in own.items())
    kind = _choose_claim(plan.config) if plan.module.members[0].problem.has_goal else "tube"
    modules = ", ".join(["lyapnet", *dict.fromkeys(name.partition(":")[0] for name in own.values())])
    arguments = "".join(f", {part}={python_expression(plan.config, part)}" for part in own)
    estimator = " --estimator ekf" if plan.config.outputs.noise is not None else ""
    path = json.dumps(str(best), ensure_ascii=False)
    for what, shown in (
        ("run", plan.run.folder),
        ("watch", shlex.join(["tensorboard", "--logdir", str(plan.config.logs)])),
        ("measure", f"lyapnet evaluate {quoted}{options}"),
        ("animate", f"lyapnet animate {quoted}{options} --out closed_loops.gif"),
        ("certify", f"lyapnet certify {kind} {quoted}{options}"),
        ("export", f"lyapnet export {quoted}{options} --to c --out law{estimator}"),
        ("fine-tune", f"{command} --finetune {quoted}"),
        ("use", f"import {modules}; controller = lyapnet.load({path}{arguments})"),
    ):
        console.print(f"{what:<10}{shown}", soft_wrap=True)


def _choose_claim(config: Any) -> str:
    """The kind of claim for a trained V: sound if it was trained as a bound on all of a set D, else statistical."""
    return "sound" if config.pointwise.region and config.program.name == "lyapunov" else "statistical"
