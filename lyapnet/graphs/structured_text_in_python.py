"""Translates structured text, as lyapnet writes it, to Python, so that a text can be compared with its source.

Numbers are float, or float32 of NumPy. Arrays are NaN before they are assigned to.
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any


def standard_functions(number: Callable[[Any], Any]) -> dict[str, Any]:
    """Name ↦ standard function in Python, and the type of numbers, for the texts of `in_python`."""
    of_math = {
        "ACOS": math.acos, "ASIN": math.asin, "ATAN": math.atan, "COS": math.cos, "EXP": math.exp, "EXPT": math.pow,
        "LN": math.log, "LOG": math.log10, "SIN": math.sin, "SQRT": math.sqrt, "TAN": math.tan,
    }  # fmt: skip
    exact = {"ABS": abs, "MAX": max, "MIN": min, "number": number}
    for real_type in ("LREAL", "REAL"):
        exact |= {f"{real_type}_TO_DINT": lambda a: round(float(a)), f"DINT_TO_{real_type}": number}
    return exact | {name: _rounded(function, number) for name, function in of_math.items()}


def _rounded(function: Callable[..., float], number: Callable[[Any], Any]) -> Callable[..., Any]:
    return function if number is float else lambda *operands: number(function(*operands))


def in_python(text: str) -> str:
    """Structured text as `structured_text` writes it, in Python: a function for each function and block."""
    sizes, lines, routine = dict[str, int](), list[str](), _Routine()
    text = re.sub(r"\(\*.*?\*\)", "", text, flags=re.DOTALL)
    text = re.sub(r"\[\n(.*?)\n\]", lambda table: f"[{table[1]}]".replace("\n", " "), text, flags=re.DOTALL)
    text = re.sub(r",\n", ", ", text)
    for line in filter(None, map(str.strip, text.splitlines())):
        if found := re.fullmatch(r"FUNCTION(?:_BLOCK)? (\w+).*", line):
            routine = _Routine(found[1])
        elif line in ("TYPE", "END_TYPE", "END_VAR") or line.startswith("VAR"):
            routine.section = line
        elif line.startswith("END_FUNCTION"):
            lines += routine.in_python()
        elif routine.section != "END_VAR":
            _declare(line, routine, sizes)
        else:
            routine.add(line)
    return "\n".join(lines)


@dataclass
class _Routine:
    """A function or block that is read line by line."""

    name: str = ""
    section: str = ""
    inputs: list[str] = field(default_factory=list)
    outputs: list[str] = field(default_factory=list)
    tables: list[str] = field(default_factory=list)
    first: list[str] = field(default_factory=list)  # lines that make the arrays
    body: list[str] = field(default_factory=list)
    depth: int = 1

    def add(self, line: str) -> None:
        """Take a statement."""
        if line in ("END_IF;", "END_FOR;"):
            self.depth -= 1
        elif found := re.fullmatch(r"FOR (\w+) := (.+) TO (.+?)( BY -1)? DO", line):
            counter, first, last, back = found.groups()
            ends = f"{first}, {last} - 1, -1" if back else f"{first}, {last} + 1"
            self._open(f"for {counter} in range({ends}):")
        elif found := re.fullmatch(r"(IF|ELSIF) (.+) THEN", line):
            self.depth -= found[1] == "ELSIF"
            self._open(f"{'if' if found[1] == 'IF' else 'elif'} {_condition_in_python(found[2])}:")
        elif line == "ELSE":
            self.depth -= 1
            self._open("else:")
        else:
            self.body.append("    " * self.depth + line.removesuffix(";").replace(":=", "=", 1))

    def _open(self, line: str) -> None:
        self.body.append("    " * self.depth + line)
        self.depth += 1

    def in_python(self) -> list[str]:
        """The lines of a Python function."""
        head = f"def {self.name}({', '.join(self.inputs)}):"
        return [*self.tables, head, *self.first, *self.body, f"    return {', '.join(self.outputs) or self.name}"]


def _declare(line: str, routine: _Routine, sizes: dict[str, int]) -> None:
    """Take a line of declarations."""
    names, kind = line.removesuffix(";").split(" : ", 1)
    size = sizes.get(kind, 0)
    if found := re.match(r"ARRAY \[0\.\.(\d+)\] OF L?REAL", kind):
        size = int(found[1]) + 1
    if routine.section == "TYPE":
        sizes[names] = size
    elif routine.section == "VAR CONSTANT":
        routine.tables.append(f"{names} = [number(entry) for entry in {kind.partition(' := ')[2]}]")
    elif routine.section == "VAR_INPUT":
        routine.inputs += names.split(", ")
    else:
        if routine.section == "VAR_OUTPUT":
            routine.outputs.append(names)
        if size:
            routine.first.append(f"    {names} = [number('nan')] * {size}")  # nothing may be read before it is set


def _condition_in_python(condition: str) -> str:
    # & and |, since compilers may compute both sides of AND and OR
    for sign, written in (("<>", "!="), (" = ", " == "), ("AND", "&"), ("OR", "|"), ("NOT", "not")):
        condition = condition.replace(sign, written)
    return condition
