"""Tables and progress messages of certificates for a terminal."""

import io
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from rich.console import Console
from rich.table import Table


def progress_reporter(stages: Callable[..., None], kind: str) -> Callable[[Any], None]:
    """A callback that reports the stage of a Progress, and the undecided share of [0, T] × D, D or X₀."""
    domain = {"region": "D", "reach": "D", "tube": "X₀", "two-sided tube": "X₀, then of [0, T] × D,"}.get(
        kind, "[0, T] × D"
    )

    def report(progress: Any) -> None:
        undecided = f"{progress.boxes:,} boxes, {progress.remaining:.2%} of {domain} undecided"
        stages(progress.stage, detail=undecided if progress.boxes else "")

    return report


def table_of(title: str, rows: Iterable[tuple[str, str]]) -> Table:
    """A table of the numbers of a claim."""
    table = Table("", "", title=title, show_header=False)
    for label, value in rows:
        table.add_row(label, value)
    return table


def text_of(table: Table) -> str:
    """A table as text."""
    plain = {"highlight": False, "markup": False, "force_jupyter": False, "color_system": None}
    console = Console(file=io.StringIO(), width=100, **plain)
    with console.capture() as printed:
        console.print(table)
    return printed.get().rstrip()


def rows_of(result: Mapping[str, Any], labels: Mapping[str, str]) -> list[tuple[str, str]]:
    """(label, number as text) for each number of a claim that is known."""
    known = {key: label for key, label in labels.items() if result.get(key) not in (None, [], {})}
    return [(label, _format_value(key, result[key])) for key, label in known.items()]


def _format_value(key: str, value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_format_value('', entry)}" for name, entry in value.items() if entry is not None)
    if isinstance(value, str):
        return value[:16] if key.endswith("fingerprint") else value
    if key == "states_left_out":
        return ", ".join(value)
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, list):
        return f"[{', '.join(_format_value('', entry) for entry in value)}]"
    if key == "ultimate_volume":
        return f"{value:.4g}"
    if key.startswith("confidence"):
        return f"1 − {1 - value:.2g}"
    if key.endswith(("bound", "volume_share")):
        return floored(value)
    return f"{value:.3%}" if key.endswith(("share", "volume", "share_of_search")) else f"{value:.4g}"


def floored(share: float) -> str:
    """A lower bound of a share in percent, rounded down so that it stays a lower bound."""
    return f"{math.floor(1e5 * share) / 1e3:.3f}%"
