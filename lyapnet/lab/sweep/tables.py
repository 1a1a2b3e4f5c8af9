"""The table of a sweep for the terminal."""

from collections.abc import Sequence

from rich.box import SIMPLE
from rich.table import Column, Table

from lyapnet.evaluation.tables import measured_or_not
from lyapnet.lab.sweep.runs import SweepRow

SWEEP_COLUMNS = {
    "cost_mean": "cost J",
    "cost_ratio": "J / J*",
    "value_error": "value\nerror",
    "value_to_cost": "V / J",
    "satisfied_fraction": "condition\nholds",
    "terminal_error": "‖x(T)‖",
}


def sweep_table(config: str, rows: Sequence[SweepRow]) -> Table:
    """A line for each seed of a config's runs; for several seeds also their mean and worst."""
    key = rows[0].key
    names = [key.split(".")[-1]] if key else []
    headings = [*names, "seed", *SWEEP_COLUMNS.values(), "s to\n1.02", "min", "MB"]
    table = Table(*(Column(heading, justify="right", no_wrap=True) for heading in headings), box=SIMPLE, padding=0)
    table.title = f"{config}: best checkpoints on unseen states of X₀"
    table.caption = "s to 1.02: until J / J* of the validation states; min, MB: of a run with all its seeds"
    for value in dict.fromkeys(row.value for row in rows):
        chosen, label = [row for row in rows if row.value == value], [value or ""] if names else []
        took = f"{chosen[0].training_seconds / 60:.1f}", f"{chosen[0].peak_bytes / 1e6:.0f}"
        for row in chosen:
            shown = [measured_or_not(key, row.measures[key]) for key in SWEEP_COLUMNS]
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
    return measured_or_not(key, sum(known) / len(known) if len(known) == len(values) else None)


def _worst(key: str, values: list[float | None]) -> str:
    known = [value for value in values if value is not None]
    choose = min if key.endswith("fraction") else max
    return measured_or_not(key, choose(known) if len(known) == len(values) else None)
