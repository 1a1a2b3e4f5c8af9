"""lyapnet check."""

import dataclasses
import json
import shlex
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Column, Table

from lyapnet.cli.options import Debug


def check(
    config: Annotated[Path, typer.Argument(help="The experiment, a YAML file.")],
    overrides: Annotated[list[str] | None, typer.Argument(help="Changes to the config, as key.sub=value.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    debug: Debug = False,
) -> None:
    """Say what can be said of a task before training it: its goal, its modes, how stiff it is, and where to start."""
    import torch

    from lyapnet.build import parts_of
    from lyapnet.config import load_config
    from lyapnet.training.build import build_learner, build_problem
    from lyapnet.training.facts import facts_of

    resolved = dataclasses.replace(load_config(config, overrides or []), seeds=1)
    torch.set_num_threads(resolved.training.threads)
    parts = parts_of(resolved)
    learner = build_learner(resolved, build_problem(resolved, parts).relaxed(), parts)
    with Console(stderr=True).status("start …") as status:
        facts = facts_of(learner, lambda stage: status.update(f"start: {stage} …"))
    console = Console(highlight=False, markup=False)
    if as_json:
        rows = [{"fact": fact.name, "found": fact.found, "advice": fact.advice or None} for fact in facts]
        print(json.dumps({"experiment": resolved.experiment, "facts": rows}, ensure_ascii=False))
        return
    advice = Column("what to do", overflow="fold")
    table = Table("fact", Column("found", overflow="fold"), advice, title=f"{resolved.experiment}, before training")
    for fact in facts:
        table.add_row(*fact)
    console.print(table)
    command = shlex.join(["lyapnet", "train", "--config", str(config), *(overrides or [])])
    console.print(f"train     {command}", soft_wrap=True)
