"""The files of a report: Markdown, LaTeX, comma-separated values, figures, and TensorBoard."""

import io
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

from matplotlib.figure import Figure
from torch.utils.tensorboard.writer import SummaryWriter

from lyapnet.base.drawing import pixels
from lyapnet.base.errors import UsageError
from lyapnet.base.files import write_atomically
from lyapnet.base.machine import usable_cores
from lyapnet.base.provenance import versions
from lyapnet.base.tables import Table, csv_text, latex, markdown
from lyapnet.controller.controller import Controller
from lyapnet.lab.comparison.report.alternatives import alternatives
from lyapnet.lab.comparison.report.details import details, overview, tasks_table
from lyapnet.lab.comparison.report.figures import caption, figure3, final, pictures
from lyapnet.lab.comparison.report.mean_costs import mean_costs
from lyapnet.lab.comparison.report.notes import NOTES
from lyapnet.lab.comparison.report.rows import curve_rows, missing, result_rows
from lyapnet.lab.comparison.report.table1 import table1
from lyapnet.lab.comparison.results import PLANNED, Result
from lyapnet.lab.comparison.statistics import Comparison, compared

TITLE = "Ours against others"
PACKAGES = ("torch", "numpy", "stable-baselines3", "gymnasium")
DPI = 200


def write_report(
    results: Iterable[Result],
    folder: Path,
    *,
    command: str = "lyapnet compare",
    planned: Iterable[tuple[str, str, int]] = (),
    controllers: Mapping[str, Controller] | None = None,
) -> list[Path]:
    """Write what the results show, replacing an earlier report in the same folder; the paths, report.md first.

    Args:
        command: that makes the results again.
        planned: (task, method, seed) of every job, so that the report can say which of them are missing; without it,
            every seed of a method on every task that there is.
        controllers: task ↦ a learned controller, for the figures of closed loops.

    Raises:
        UsageError: there are no results, two of one seed, or some of other evaluation states.
        OSError: the folder cannot be written.
    """
    comparison = compared(results)
    if not comparison.groups:
        raise UsageError("Expected at least one finished job to report on, got none; run lyapnet compare first.")
    learned, figures, tables = comparison.without(PLANNED), {}, {"alternatives": [alternatives(comparison)]}
    if (noisy := mean_costs(comparison)) is not None:
        tables["mean_costs"] = [noisy]
    if learned.groups:
        figures = {"figure3": figure3(learned), "final": final(learned), **pictures(controllers or {})}
        tables |= {"table1": table1(learned), "details": [tasks_table(learned), details(learned)]}
    text = report_text(comparison, tables, list(figures), command, missing(comparison, planned))
    files = {
        "report.md": text.encode(),
        **_table_files(tables),
        "results.csv": csv_text(result_rows(comparison)).encode(),
        "curves.csv": csv_text(curve_rows(comparison)).encode(),
    }
    for name, figure in figures.items():
        files |= {f"{name}.{form}": _drawn(figure, form) for form in ("png", "pdf")}
    for name, content in files.items():
        write_atomically(folder / name, content)
    return [*(folder / name for name in files), *_write_tensorboard(folder / "tensorboard", text, figures)]


def _table_files(tables: Mapping[str, Sequence[Table]]) -> dict[str, bytes]:
    """Each name's tables one below the other; a CSV file has the rows of the last of details alone, the methods'."""
    files = {}
    for name, several in tables.items():
        rows = several[-1].rows if name == "details" else [row for table in several for row in table.rows]
        files |= {
            f"{name}.md": "\n\n".join([*map(markdown, several), *_notes()]) + "\n",
            f"{name}.csv": csv_text(rows),
            f"{name}.tex": "\n\n".join(map(latex, several)) + "\n",
        }
    return {name: text.encode() for name, text in files.items()}


def _drawn(figure: Figure, form: str) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=DPI, format=form)
    return buffer.getvalue()


# report.md


def report_text(
    comparison: Comparison,
    tables: Mapping[str, Sequence[Table]],
    figures: Sequence[str],
    command: str,
    lacking: Sequence[str],
) -> str:
    """The report for a reader."""
    counted = sum(len(group.results) for group in comparison.groups.values())
    sections = [
        f"# {TITLE}",
        f"{counted} results of {len(comparison.tasks)} tasks and {len(comparison.methods)} methods.",
        f"```bash\n{command}\n```",
        "\n".join([f"- {fact}" for fact in _facts()]),
        *(["**Missing so far**", "\n".join(f"- {line}" for line in lacking)] if lacking else []),
        *map(markdown, [*tables["alternatives"], *tables.get("mean_costs", ())]),
        *_of_learning(comparison.without(PLANNED), tables, figures),
        *_notes(),
        "Every result: [results.csv](results.csv); every validation: [curves.csv](curves.csv).",
    ]
    return "\n\n".join(sections) + "\n"


def _of_learning(learned: Comparison, tables: Mapping[str, Sequence[Table]], figures: Sequence[str]) -> list[str]:
    """What is to be said of methods that learn, if there are any."""
    if not learned.groups:
        return []
    return [
        markdown(overview(learned)),
        "## Costs",
        *map(markdown, tables["table1"]),
        "## Figures",
        *(part for name in figures for part in (f"![{name}]({name}.png)", caption(name, learned))),
        "## Details",
        *map(markdown, tables["details"]),
    ]


def _notes() -> list[str]:
    return ["**What the numbers are**", "\n".join(f"- {note}" for note in NOTES)]


def _facts() -> list[str]:
    """When and with what the report was written."""
    made = versions(*PACKAGES)
    python, platform = made.pop("python"), made.pop("platform")
    return [
        f"written {datetime.now(UTC).isoformat(timespec='seconds')}",
        f"{', '.join(f'{name} {version}' for name, version in made.items())}, Python {python}",
        f"{platform}, {usable_cores()} cores for this process",
    ]


# TensorBoard


def _write_tensorboard(folder: Path, text: str, figures: Mapping[str, Figure]) -> list[Path]:
    """The report's text and figures; the event files of an earlier one go once the new one is whole."""
    earlier = list(_event_files(folder))
    with SummaryWriter(str(folder)) as writer:
        writer.add_text("comparison/report", text)
        for name, figure in figures.items():
            writer.add_image(f"comparison/{name}", pixels(figure), dataformats="HWC")
    for path in earlier:
        path.unlink()
    return [path for path in _event_files(folder) if path not in earlier]


def _event_files(folder: Path) -> list[Path]:
    """TensorBoard's files in a folder, oldest first."""
    return sorted(folder.glob("events.out.tfevents.*"))
