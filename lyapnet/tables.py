"""What the command line shows in the terminal: one table for each kind of measurement."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.box import SIMPLE
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Column, Table
from rich.text import Text

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


def evaluation_table(title: str, result: dict[str, Any]) -> Table:
    """What a controller reaches, as evaluation.Evaluation.result has it."""
    table = Table("measure", "value", title=f"{title}\n{result['samples']} unseen states of X₀, seed {result['seed']}")
    for key, label in ROWS.items():
        if result[key] is None:
            table.add_row(label, "–")
        else:
            table.add_row(label, _measured(key, result[key]))
    for name, error in result["terminal_errors"].items():
        table.add_row(f"terminal error, mean |{name}|", f"{error:.4g}")
    table.caption = _caption([result])
    return table


def table_over_seeds(title: str, result: dict[str, Any]) -> Table:
    """What several seeds reach, as experiment.over_seeds has it: mean, spread and both ends."""
    seeds = result["seeds"]
    table = Table("measure", *(Column(name, no_wrap=True) for name in ("mean ± spread", "least (seed)", "most (seed)")))
    table.title = f"{title}\n{len(seeds)} seeds, {seeds[0]['samples']} unseen states of X₀ each"
    for key, label in ROWS.items():
        if key not in result["mean"]:
            table.add_row(label, "–", "–", "–")
            continue
        ends = [choose(seeds, key=lambda one, key=key: one[key]) for choose in (min, max)]
        mean, spread = (_measured(key, result[name][key]) for name in ("mean", "spread"))
        table.add_row(label, f"{mean} ± {spread}", *(f"{_measured(key, end[key])} ({end['seed']})" for end in ends))
    table.caption = _caption(seeds)
    return table


def _caption(results: list[dict[str, Any]]) -> Text | None:
    """Why some optimum is missing."""
    notes = dict.fromkeys(result["no_optimum"] for result in results if "no_optimum" in result)
    return Text("; ".join(notes)) if notes else None  # Text: a plain string's [oracle] would be read as markup


def robustness_table(rows: list[dict[str, Any]], samples: int) -> Table:
    """What a controller costs where its assumptions fail."""
    headings = ("cost J", "optimum J*", "J / J*", "‖x(T)‖")
    columns = [Column(heading, justify="right") for heading in headings]
    table = Table("disturbance", *columns, title=f"what the controller does not know of\n{samples} states each")
    for row in rows:
        keys = ("cost_mean", "optimal_cost_mean", "cost_ratio", "terminal_error")
        cost, *others = (_measured_or_not(key, row[key]) for key in keys)
        table.add_row(row["disturbance"], "diverged" if row["cost_mean"] is None else cost, *others)
    table.caption = "J*: of the disturbed task, without noise"
    return table


SWEEP_COLUMNS = {
    "cost_mean": "cost J",
    "cost_ratio": "J / J*",
    "value_error": "value\nerror",
    "value_to_cost": "V / J",
    "satisfied_fraction": "condition\nholds",
    "terminal_error": "‖x(T)‖",
}


def sweep_table(config: str, rows: list[Any]) -> Table:
    """A line for each seed of a config's runs, and after several seeds their mean and their worst."""
    names = [rows[0].key.split(".")[-1]] if rows[0].key else []
    headings = [*names, "seed", *SWEEP_COLUMNS.values(), "s to\n1.02", "min", "MB"]
    table = Table(*(Column(heading, justify="right", no_wrap=True) for heading in headings), box=SIMPLE, padding=0)
    table.title = f"{config}: best checkpoints on unseen states of X₀"
    table.caption = "s to 1.02: until J / J* of the validation states; min, MB: of a run with all its seeds"
    for value in dict.fromkeys(row.value for row in rows):
        chosen, label = [row for row in rows if row.value == value], [value] if names else []
        took = f"{chosen[0].training_seconds / 60:.1f}", f"{chosen[0].peak_bytes / 1e6:.0f}"
        for row in chosen:
            shown = [_measured_or_not(key, row.measures[key]) for key in SWEEP_COLUMNS]
            near = "–" if row.seconds_to_near is None else f"{row.seconds_to_near:.0f}"
            table.add_row(*label, str(row.seed), *shown, near, *took)
        if len(chosen) > 1:
            for name, summarise in (("mean", _mean), ("worst", _worst)):
                columns = ([row.measures[key] for row in chosen] for key in SWEEP_COLUMNS)
                shown = [summarise(key, values) for key, values in zip(SWEEP_COLUMNS, columns, strict=True)]
                table.add_row(*label, name, *shown, "", "", "")
            table.add_section()
    return table


def _mean(key: str, values: list[float | None]) -> str:
    known = [value for value in values if value is not None]
    return _measured_or_not(key, sum(known) / len(known) if len(known) == len(values) else None)


def _worst(key: str, values: list[float | None]) -> str:
    known = [value for value in values if value is not None]
    choose = min if key.endswith("fraction") else max
    return _measured_or_not(key, choose(known) if len(known) == len(values) else None)


CERTIFICATE_ROWS = {
    "samples": "states",
    "tolerances": "tolerances",
    "decrease_share": "condition holds along the closed loop",
    "terminal_share": "‖x(T)‖ within the radius",
    "cost_share": "cost ≤ V(0, x₀), up to the tolerance",
    "all_share": "all that is asked for",
    "confidence": "confidence",
    "decrease_lower_bound": "condition holds on at least",
    "terminal_lower_bound": "‖x(T)‖ within the radius on at least",
    "cost_lower_bound": "cost ≤ V(0, x₀) on at least",
    "probability_lower_bound": "all that is asked for on at least",
    "required_share": "share of X₀ that the verdict is about",
    "failure": "a state that fails",
    "reason": "why",
    "alpha": "α",
    "delta": "δ, cost per second",
    "set": "D",
    "states_left_out": "states that nothing depends on",
    "rho_wanted": "ρ for all of X₀",
    "rho": "largest ρ proved",
    "volume_share": "share of X₀ in that funnel, at least",
    "terminal_excess": "κ, cost at T beyond V(T, ·)/α, at most",
    "guaranteed_cost_ratio": "guaranteed cost there / optimum, ratio of the means",
    "counterexample": "counterexample of lowest V − δt",
    "remaining_volume": "share of [0, T] × D undecided",
    "boxes": "boxes",
    "seconds": "seconds",
}


@contextmanager
def proof_progress(console: Console, kind: str) -> Iterator[Callable[[Any], None]]:
    """A bar in a terminal: how much of [0, T] × D a proof has decided. It hears of lyapnet.certification.Progress."""
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[state]}"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(f"certifying, {kind}", total=None, state="")

        def report(progress: Any) -> None:
            state = f"{progress.boxes} boxes, {progress.remaining:.2%} of [0, T] × D undecided"
            bar.update(task, total=1.0, completed=1 - progress.remaining, state=state)

        yield report


def certificate_table(title: str, result: dict[str, Any]) -> Table:
    """A claim, its verdict and its figures."""
    table = Table("", "", title=f"{title}\n{result['kind']}: {result['verdict']}", show_header=False)
    for label, value in certificate_rows(result):
        table.add_row(label, value)
    return table


def certificate_rows(result: dict[str, Any]) -> list[tuple[str, str]]:
    """What the figures of a claim are called, and the figures."""
    known = {key: label for key, label in CERTIFICATE_ROWS.items() if result.get(key) not in (None, [])}
    return [(label, _certified(key, result[key])) for key, label in known.items()]


def _certified(key: str, value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_certified('', entry)}" for name, entry in value.items() if entry is not None)
    if isinstance(value, str):
        return value
    if key == "states_left_out":
        return ", ".join(value)
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, list):
        return f"[{', '.join(_certified('', entry) for entry in value)}]"
    if key == "confidence":
        return f"1 − {1 - value:.2g}"
    if key.endswith(("bound", "volume_share")):
        return floored(value)
    return f"{value:.3%}" if key.endswith(("share", "volume")) else f"{value:.4g}"


def floored(share: float) -> str:
    """A lower bound of a share in percent, rounded down so that it stays one."""
    return f"{math.floor(1e5 * share) / 1e3:.3f}%"


def _measured_or_not(key: str, value: float | None) -> str:
    return "–" if value is None else _measured(key, value)


def _measured(key: str, value: float) -> str:
    if key == "cost_ratio":
        return f"{value:.4f}"
    return f"{value:.1%}" if key.split("_1e")[0].endswith("fraction") else f"{value:.4g}"
