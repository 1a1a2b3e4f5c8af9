"""Tables and sentences of a search for the terminal, and its CSV."""

from typing import Any

import optuna
from optuna.trial import TrialState
from rich.box import SIMPLE
from rich.table import Column, Table

from lyapnet.base.tables import csv_text
from lyapnet.evaluation.tables import measured_or_not
from lyapnet.lab.tuning.search import best_of, verdict
from lyapnet.lab.tuning.trials import Task, Training

STATES = {TrialState.COMPLETE: "complete", TrialState.PRUNED: "pruned", TrialState.FAIL: "failed"}
UNFINISHED = "not finished"
SHOWN = ("cost_ratio", "cost_mean", "value_error", "satisfied_fraction", "violated_fraction")


def search_rows(task: Task, study: optuna.Study) -> list[dict[str, Any]]:
    """A row for each trial: settings, measure at each validation and at the best checkpoint, and state."""
    trials = study.get_trials(deepcopy=False)
    steps = sorted({step for trial in trials for step in trial.intermediate_values})
    return [
        {
            "trial": trial.number,
            **dict(setting.split("=", 1) for setting in task.settings(trial.params)),
            task.measure: trial.value if trial.state == TrialState.COMPLETE else None,
            **{f"{task.measure}_at_{step}": trial.intermediate_values.get(step) for step in steps},
            "seconds": trial.user_attrs.get("seconds"),
            "state": STATES.get(trial.state, UNFINISHED),
            "failure": trial.user_attrs.get("failure", ""),
        }
        for trial in trials
        if trial.state != TrialState.WAITING
    ]


def search_csv(task: Task, study: optuna.Study) -> str:
    """The rows as comma-separated values."""
    return csv_text(search_rows(task, study))


def search_table(task: Task, study: optuna.Study) -> Table:
    """A line for each trial, with its measure half-way, at the end of the training and at its best checkpoint."""
    rows, best, measure = search_rows(task, study), best_of(study), task.measure
    steps = [int(key.rpartition("_")[2]) for key in rows[0] if key.startswith(f"{measure}_at_")] if rows else []
    stages = sorted({steps[(len(steps) - 1) // 2], steps[-1]}) if steps else []
    keys = [one.key for one in task.space]
    headings = ["", *(key.split(".")[-1].replace("_", "\n") for key in keys)]
    headings += [*(f"{measure} at\nstep {step}" for step in stages), f"{measure} of\nbest.ckpt", "s", "state"]
    table = Table(*(Column(heading, justify="right", no_wrap=True) for heading in headings), box=SIMPLE, padding=0)
    table.title = f"{task.config().experiment}: trials, on the validation states; * the best"
    for row in rows:
        numbers = [row[f"{measure}_at_{step}"] for step in stages] + [row[measure]]
        shown = ["–" if number is None else f"{number:.3g}" for number in numbers]
        seconds = "–" if row["seconds"] is None else f"{row['seconds']:.0f}"
        mark = "*" if best is not None and row["trial"] == best.number else ""
        table.add_row(f"{mark}{row['trial']}", *(row.get(key, "") for key in keys), *shown, seconds, row["state"])
    return table


def summary(task: Task, study: optuna.Study) -> list[str]:
    """The best trial, compared with the given config, and a warning about its number."""
    best = best_of(study)
    if best is None:
        return ["no trial came to its end"]
    trials = study.get_trials(deepcopy=False)
    given = next((trial for trial in trials if trial.user_attrs.get("given")), None)
    against = "" if given is None else f"; the given config: {verdict(given, task)}"
    return [
        f"best: trial_{best.number}, {' '.join(task.settings(best.params))}: {verdict(best, task)}{against}",
        "The settings were chosen on the validation states, so the number is too good; other states and another seed "
        "tell what they are worth.",
    ]


def final_line(task: Task, training: Training) -> str:
    """The measures of the best settings, trained from another seed, on states that no trial used."""
    assert training.run is not None
    found = training.run.evaluation
    measures, samples = found.get("mean", found), found.get("seeds", [found])[0]["samples"]
    known = [f"{name.replace('_', ' ')} {measured_or_not(name, measures[name])}" for name in SHOWN if name in measures]
    return f"seed {training.config.seed}, {samples} unseen states: {', '.join(known)}; {training.run.best}"
