"""lyapnet check."""

import dataclasses
import gc
import json
import shlex
import signal
import sys
import textwrap
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.text import Text

from lyapnet.base.errors import Interrupted, signals_taken
from lyapnet.cli.options import Debug

NAMES = 14  # width of the column of names, in characters
WIDEST = 120  # largest width of the output, in characters
# names of facts in the order in which they become known
ORDER = ("horizon", "X₀", "system", "goal", "modes", "controllable", "step gain", "start")


def check(
    config: Annotated[Path, typer.Argument(help="The experiment, a YAML file.")],
    overrides: Annotated[list[str] | None, typer.Argument(help="Changes to the config, as key.sub=value.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    debug: Debug = False,
) -> None:
    """Print facts about a task before training: its goal, its modes, how stiff it is, and how to start.

    Each fact is printed as soon as it is known, so that Ctrl-C loses none of them.
    """
    from lyapnet.training.stage_messages import StageMessages

    output = Console(highlight=False, markup=False)
    notes = Console(file=sys.stderr, highlight=False, markup=False)
    shown = output if output.is_terminal and not as_json else notes
    facts, began, stops = list[Any](), time.monotonic(), list[Interrupted]()

    def stop(number: int, frame: Any) -> None:
        stops.append(Interrupted(signal.Signals(number).name, 130))
        raise stops[-1]

    def add_fact(fact: Any) -> None:
        if stops:  # a module that was being imported caught the exception
            raise stops[-1]
        facts.append(fact)
        if not as_json:
            print_fact(output, fact)

    if config.is_file() and not as_json:
        output.print(Text(f"{config.name}, before training", "bold"), soft_wrap=True)
    stages, experiment = StageMessages(shown, "check"), config.stem
    try:
        with signals_taken(stop), stages:
            stages("reading the task")
            experiment = _report_config_facts(config, overrides or [], add_fact)
            _report_task_facts(config, overrides or [], stages, add_fact)
    except BaseException as error:
        if not stops and not isinstance(error, Interrupted):
            raise
        if as_json:
            _print_json(experiment, facts, _find_missing_facts(facts))
        seconds = time.monotonic() - began
        raise Interrupted(
            f"Stopped after {seconds:.1f} s ({stages.now}); not reached: {', '.join(_find_missing_facts(facts))}.", 130
        ) from error
    if as_json:
        _print_json(experiment, facts, [])
        return
    command = shlex.join(["lyapnet", "train", "--config", str(config), *(overrides or [])])
    output.print(f"{'train':{NAMES}}{command}", soft_wrap=True)


def _report_config_facts(config: Path, overrides: list[str], add_fact: Any) -> str:
    """Report the facts that need no torch; return the name of the experiment."""
    from lyapnet.experiment.config import outline
    from lyapnet.training.config_facts import facts_of_config

    written = outline(config, overrides)
    for fact in facts_of_config(written):
        add_fact(fact)
    return written.experiment


def _report_task_facts(config: Path, overrides: list[str], report: Any, add_fact: Any) -> None:
    """Report the facts of the problem and of its start."""
    gc.disable()  # imports leave no garbage, and the search for it takes a seventh of their time
    try:
        from lyapnet.base.threads import use_threads
        from lyapnet.experiment.assembly import default_of, parts_of
        from lyapnet.experiment.config import load_config
        from lyapnet.training.build_learner import build_learner, build_problem_to_train
        from lyapnet.training.task_facts import facts_of
    finally:
        gc.enable()
    resolved = dataclasses.replace(load_config(config, overrides), seeds=1)
    use_threads(resolved.training.threads)
    parts = parts_of(resolved)
    with default_of(resolved):
        learner = build_learner(resolved, build_problem_to_train(resolved, parts), parts)
        facts_of(learner, report, add_fact, resolved.rollout.choose_policy, resolved.outputs)


def print_fact(console: Console, fact: Any) -> None:
    """Print a fact in two columns, its name and what was found, with the advice below."""
    width = max(40, min(console.width, WIDEST)) - NAMES
    name, lines = fact.name, textwrap.wrap(fact.found, width, break_on_hyphens=False)
    if fact.advice:
        lines += textwrap.wrap(fact.advice, width, initial_indent="→ ", subsequent_indent="  ", break_on_hyphens=False)
    for line in lines:
        console.print(Text(f"{name:{NAMES}}", "bold").append(line, "not bold"), soft_wrap=True)
        name = ""


def _find_missing_facts(facts: list[Any]) -> list[str]:
    """The names of the facts after the last known one."""
    from lyapnet.training.config_facts import OBSERVABLE, OUTPUTS

    last = max((ORDER.index(fact.name) for fact in facts if fact.name in ORDER), default=-1)
    observable = [OBSERVABLE] if OUTPUTS in [fact.name for fact in facts] else []
    return (list(ORDER[last + 1 :]) or ["the best start"]) + observable


def _print_json(experiment: str, facts: list[Any], not_reached: list[str]) -> None:
    rows = [{"fact": fact.name, "found": fact.found, "advice": fact.advice or None} for fact in facts]
    content = {"experiment": experiment, "complete": not not_reached, "not_reached": not_reached, "facts": rows}
    print(json.dumps(content, ensure_ascii=False))
