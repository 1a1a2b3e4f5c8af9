"""Tables as Markdown, LaTeX, CSV and terminal output, and the formatting of their numbers."""

import csv
import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from rich.box import SIMPLE
from rich.table import Column as RichColumn
from rich.table import Table as RichTable

NOTHING = "–"
DIVERGED = "diverged"

# characters that pdflatex cannot print directly
LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "_": r"\_", "#": r"\#", "$": r"\$", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "–": "--", "−": "$-$", "±": r"$\pm$", "×": r"$\times$",
    "∞": r"$\infty$", "≥": r"$\geq$", "≤": r"$\leq$", ">": "$>$", "<": "$<$", "Σ": r"$\Sigma$", "Δ": r"$\Delta$",
    "₀": "$_0$", "ℓ": r"$\ell$", "φ": r"$\varphi$", "ₙ": "$_n$", "→": r"$\to$", "…": r"\dots{}", "·": r"$\cdot$",
}  # fmt: skip


@dataclass(frozen=True)
class Column:
    """A heading, and the formatting of a row's values for some keys."""

    heading: str
    keys: Sequence[str]
    show: Callable[..., str] = str

    def cell(self, row: Mapping[str, Any]) -> str:
        """The text of a cell; a dash if the first key's value is missing."""
        values = [row[key] for key in self.keys]
        return NOTHING if values[0] is None else self.show(*values)


@dataclass(frozen=True)
class Table:
    """Rows of numbers and the columns that show them; the CSV contains the rows without rounding."""

    title: str
    columns: Sequence[Column]
    rows: Sequence[Mapping[str, Any]]
    section: str | None = None  # key of the sections: a rule separates rows with different values

    def cells(self) -> list[list[str]]:
        """The texts of all cells, row by row."""
        return [[column.cell(row) for column in self.columns] for row in self.rows]

    def breaks(self) -> list[bool]:
        """For each row, whether a section ends with it."""
        if self.section is None:
            return [False] * len(self.rows)
        names = [row[self.section] for row in self.rows]
        return [*(name != following for name, following in pairwise(names)), False][: len(names)]


def markdown(table: Table) -> str:
    """The table as Markdown with its title; the first column is left-aligned, numbers are right-aligned."""
    heading = [column.heading for column in table.columns]
    rule = ["---", *["---:"] * (len(heading) - 1)]
    lines = (" | ".join(cell.replace("|", "\\|") for cell in line) for line in [heading, rule, *table.cells()])
    return "\n".join([f"**{table.title}**", "", *(f"| {line} |" for line in lines)])


def latex(table: Table) -> str:
    r"""The table as a table* environment, in ASCII; needs \usepackage{booktabs}, and graphicx if it is wide."""
    wide, body = len(table.columns) > 9, []
    for cells, ends in zip(table.cells(), table.breaks(), strict=True):
        body += [_latex_row(cells), *([r"\midrule"] if ends else [])]
    return "\n".join(
        [
            r"\begin{table*}", r"\centering", r"\scriptsize", r"\setlength{\tabcolsep}{3pt}",
            rf"\caption{{{escaped(table.title)}}}", *([r"\resizebox{\textwidth}{!}{%"] if wide else []),
            rf"\begin{{tabular}}{{l{'r' * (len(table.columns) - 1)}}}",
            r"\toprule", _latex_row([column.heading for column in table.columns]), r"\midrule", *body, r"\bottomrule",
            r"\end{tabular}}" if wide else r"\end{tabular}", r"\end{table*}",
        ]
    )  # fmt: skip


def escaped(text: str) -> str:
    """Escape text for LaTeX."""
    return "".join(LATEX.get(letter, letter) for letter in text)


def _latex_row(cells: Sequence[str]) -> str:
    return f"{' & '.join(map(escaped, cells))} \\\\"


def csv_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows with the same keys as CSV in full precision; empty for a missing value, inf for a diverged closed loop."""
    text = io.StringIO()
    if rows:
        writer = csv.DictWriter(text, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return text.getvalue()


def terminal(table: Table) -> RichTable:
    """The table for `rich`."""
    first, *others = (column.heading for column in table.columns)
    columns = [RichColumn(first, no_wrap=True), *(RichColumn(name, justify="right", no_wrap=True) for name in others)]
    shown = RichTable(*columns, title=table.title, box=SIMPLE, padding=0)
    for cells, ends in zip(table.cells(), table.breaks(), strict=True):
        shown.add_row(*cells, end_section=ends)
    return shown


# Numbers


def number(value: float) -> str:
    """Format a number: at least four significant digits from 0.001 to ten million, else three and an exponent."""
    if math.isinf(value):
        return "∞"
    if value and not 1e-3 <= abs(value) < 1e7:
        return f"{value:.3g}"
    return f"{value:,.{_decimals(value)}f}"


def cost(value: float) -> str:
    """Format a cost; inf means a diverged closed loop."""
    return DIVERGED if math.isinf(value) else number(value)


def ratio(value: float) -> str:
    """Format a ratio of costs: four decimals below 10."""
    return f"{value:.4f}" if value < 10 else cost(value)


def mean_and_std(mean: float, std: float | None, diverged: int = 0, seeds: int = 0) -> str:
    """Format mean ± std: std with two digits, mean with the same decimals (at most five digits); or diverged seeds."""
    if math.isinf(mean):
        return f"{DIVERGED} ({diverged} of {seeds})"
    if not std:
        return number(mean) if std is None else f"{number(mean)} ± 0"
    if max(abs(mean), std) >= 1e7 or max(abs(mean), std) < 1e-3:
        return f"{mean:.3g} ± {std:.2g}"
    decimals = min(_decimals(std, 2), _decimals(mean, 5) if mean else 9)
    return f"{mean:,.{decimals}f} ± {f'{std:,.{decimals}f}' if round(std, decimals) else f'{std:.1g}'}"


def with_interval(middle: float, low: float | None, high: float | None) -> str:
    """Format a number with its interval, if there is one."""
    return cost(middle) if low is None or high is None else f"{cost(middle)} [{cost(low)}, {cost(high)}]"


def factor(value: float, at_least: bool = False) -> str:
    """Format a ratio of two costs or times; a lower bound is marked by >."""
    digits = ",.0f" if 100 <= value < 1e7 else ".3f" if 0.9 < value < 1.1 else ".3g"
    return f"{'> ' if at_least else ''}{value:{digits}}".replace("inf", "∞")


def share(value: float) -> str:
    """Format a share in percent."""
    return f"{value:.1%}"


def steps(value: float) -> str:
    """Format a number of environment steps."""
    return f"{value:,.0f}"


def _decimals(value: float, digits: int = 4) -> int:
    """The number of decimals for a number of significant digits."""
    return max(0, digits - 1 - math.floor(math.log10(abs(value)))) if value else 0
