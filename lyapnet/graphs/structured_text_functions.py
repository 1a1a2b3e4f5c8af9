"""Translates C, as c_functions writes it, to structured text of IEC 61131-3, for programmable logic controllers.

pycparser reads the C. Conditional expressions become IF statements, so that only the chosen side is computed; pointers
become the arrays in which they begin.
"""

import math
import re
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from torch import Tensor

from lyapnet.base.errors import ExportError
from lyapnet.graphs.c_text import Tables, Text
from lyapnet.graphs.structured_text_library import (
    ELIMINATE_B,
    ELIMINATION,
    EXCHANGE_B,
    FURTHER,
    LARGEST_EXPONENT,
    STANDARD,
    SUBSTITUTE,
)

LEAST, LARGEST = 1.2e-38, 1e38  # sizes of literals; some compilers read them as REAL first
PRECEDENCE = {"||": 1, "&&": 2, "==": 3, "!=": 3, "<": 4, ">": 4, "<=": 4, ">=": 4, "+": 5, "-": 5, "*": 6, "/": 6}
LITERAL = re.compile(r"(?<![\w.])\d+\.\d+(?:E-?\d+)?(?![\w.])")
SIGNS = {"||": "OR", "&&": "AND", "==": "=", "!=": "<>"}  # operators that are written otherwise than in C


class StructuredText(Text):
    """The C of a law that will be written in structured text; for error messages."""

    language, otherwise = "structured text", "export it to c"


class ArrayTables(Tables):
    """The constants of a function block as declarations of arrays."""

    def format_table(self, name: str, numbers: Tensor) -> str:
        entries = textwrap.fill(", ".join(map(real, numbers.flatten().tolist() or [0.0])), 108)
        return f"{name} : ARRAY [0..{max(1, numbers.numel()) - 1}] OF LREAL := [\n{entries}\n];"


def real(number: float) -> str:
    """A number as a literal that keeps every bit.

    Sizes are moved into [LEAST, LARGEST]; infinity and NaN are LARGEST.
    """
    if math.isnan(number):
        number = LARGEST
    elif number != 0:
        number = math.copysign(min(max(abs(number), LEAST), LARGEST), number)
    digits, e, exponent = repr(float(number)).partition("e")
    return f"{digits if '.' in digits else digits + '.0'}{'E' if e else ''}{exponent.removeprefix('+')}"


def in_single_precision(text: str) -> str:
    """Structured text with REAL instead of LREAL, and with literals that are float32 numbers.

    Some compilers take a literal as LREAL beside a REAL; then 0.1 would not be the REAL nearest to it.
    """
    text = text.replace(f"MIN(a, {LARGEST_EXPONENT['LREAL']})", f"MIN(a, {LARGEST_EXPONENT['REAL']})")
    parts = re.split(r"(\(\*.*?\*\))", text, flags=re.DOTALL)  # every second one is a comment
    parts[::2] = [LITERAL.sub(lambda literal: real(float(np.float32(literal[0]))), part) for part in parts[::2]]
    return "".join(parts).replace("LREAL", "REAL")


@dataclass
class Block:
    """Lines of structured text, and the variables that they need."""

    lines: list[str] = field(default_factory=list)
    arrays: dict[str, int] = field(default_factory=dict)  # name ↦ number of entries
    numbers: set[str] = field(default_factory=set)
    counters: set[str] = field(default_factory=set)
    functions: set[str] = field(default_factory=set)
    depth: int = 0  # of the indentation
    conditions: int = 0  # results of conditional expressions

    def add(self, line: str) -> None:
        self.lines.append("    " * self.depth + line)

    def within(self, head: str, end: str, write: Callable[[], None]) -> None:
        """A statement with others inside."""
        self.add(head)
        self.depth += 1
        write()
        self.depth -= 1
        self.add(end)

    def choose(self, condition: str, then: Callable[[], None], otherwise: Callable[[], None] | None = None) -> None:
        """An IF statement."""
        self.within(f"IF {condition} THEN", "END_IF;" if otherwise is None else "ELSE", then)
        if otherwise is not None:
            self.depth += 1
            otherwise()
            self.depth -= 1
            self.add("END_IF;")


class _Translator:
    """Writes the body of one C function into a block.

    Args:
        block: takes the statements.
        scalars: arrays of one entry that are plain variables in the block.
        name: the first part of the names of further functions.
    """

    def __init__(self, block: Block, scalars: Sequence[str], name: str):
        self.block, self.scalars, self.name = block, scalars, name
        self.places: dict[str, str] = {}  # pointer ↦ the array in which it begins

    def statement(self, node: Any) -> None:
        """Write a statement."""
        kind = type(node).__name__
        if kind == "Cast":  # (void)t: an argument that is not used
            return
        getattr(self, f"_write_{kind.lower()}")(node)

    def _write_compound(self, node: Any) -> None:
        for item in node.block_items or []:
            self.statement(item)

    def _write_decl(self, node: Any) -> None:
        kind = type(node.type).__name__
        if kind == "ArrayDecl":
            size = int(node.type.dim.value)
            self.block.arrays[node.name] = max(size, self.block.arrays.get(node.name, 0))
        elif kind == "PtrDecl":
            self.places[node.name] = node.init.name
        else:
            self.block.numbers.add(node.name)
            self._assign(node.name, node.init)

    def _write_for(self, node: Any) -> None:
        counter, count = node.init.decls[0].name, int(node.cond.right.value)
        self.block.counters.add(counter)
        head = f"FOR {counter} := 0 TO {count - 1} DO"
        self.block.within(head, "END_FOR;", lambda: self.statement(node.stmt))

    def _write_if(self, node: Any) -> None:
        otherwise = None if node.iffalse is None else lambda: self.statement(node.iffalse)
        self.block.choose(self._condition(node.cond), lambda: self.statement(node.iftrue), otherwise)

    def _write_assignment(self, node: Any) -> None:
        into = self._number(node.lvalue)
        if node.op == "=":
            self._assign(into, node.rvalue)
        else:
            sign = node.op[0]
            self.block.add(f"{into} := {into} {sign} {self._operand(node.rvalue, PRECEDENCE[sign] + 1)};")

    def _write_funccall(self, node: Any) -> None:
        if node.name.name == "solve":
            self._solve(node.args.exprs)
            return
        rows, count, step = (int(each.value) for each in node.args.exprs[:3])  # of sum_products
        a, b, y = (self._place_of(each) for each in node.args.exprs[3:])
        self.block.counters |= {"j0", "j1"}

        def sum_of_row() -> None:
            self.block.numbers.add("total")
            self.block.add("total := 0.0;")
            self.block.within(
                f"FOR j1 := 0 TO {count - 1} DO",
                "END_FOR;",
                lambda: self.block.add(f"total := total + {_entry(*a, 'j1')} * {_entry(*b, f'{step} * j0 + j1')};"),
            )
            self.block.add(f"{_entry(*y, 'j0')} := total;")

        self.block.within(f"FOR j0 := 0 TO {rows - 1} DO", "END_FOR;", sum_of_row)

    def _solve(self, given: Sequence[Any]) -> None:
        """Gaussian elimination: b = A⁻¹b in A (n, n) and b (n, k), and the variable determinant."""
        n, k = (int(each.value) for each in given[:2])
        A, b = (self._array(each.name) for each in given[2:])
        self.block.numbers |= {"determinant", "factor"}
        self.block.counters |= {"j0", "j1", "j2", "best"}
        exchange_b, eliminate_b, substitute = (text if k else "" for text in (EXCHANGE_B, ELIMINATE_B, SUBSTITUTE))
        text = ELIMINATION.replace("@exchange_b", exchange_b).replace("@eliminate_b", eliminate_b) + substitute
        for line in text.format(n=n, A=A, b=b, rows=n - 1, columns=k - 1, k=k).splitlines():
            if line.strip():
                self.block.add(line)

    def _array(self, pointer: str) -> str:
        """The array in which a pointer begins, or the array of that name."""
        return self.places.get(pointer, pointer)

    def _place_of(self, node: Any) -> tuple[str, str]:
        """(array, index) of &array[index]."""
        reference = node.expr
        return self._array(reference.name.name), self._index(reference.subscript)

    def _assign(self, into: str, node: Any) -> None:
        """Write into := node, with IF statements for conditional expressions and truth values."""
        kind = type(node).__name__
        if kind == "TernaryOp":
            self.block.choose(
                self._condition(node.cond),
                lambda: self._assign(into, node.iftrue),
                lambda: self._assign(into, node.iffalse),
            )
        elif self._is_truth(node):
            self.block.choose(
                self._condition(node),
                lambda: self.block.add(f"{into} := 1.0;"),
                lambda: self.block.add(f"{into} := 0.0;"),
            )
        else:
            self.block.add(f"{into} := {self._number(node)};")

    @staticmethod
    def _is_truth(node: Any) -> bool:
        kind = type(node).__name__
        return (kind == "BinaryOp" and PRECEDENCE[node.op] < PRECEDENCE["+"]) or (kind == "UnaryOp" and node.op == "!")

    def _condition(self, node: Any) -> str:
        """A condition, of type BOOL."""
        if not self._is_truth(node):
            return f"{self._operand(node, PRECEDENCE['<'])} <> 0.0"
        if type(node).__name__ == "UnaryOp":
            return f"NOT ({self._condition(node.expr)})"
        own, sign = PRECEDENCE[node.op], SIGNS.get(node.op, node.op)
        if node.op in ("&&", "||"):
            sides = [self._condition(side) for side in (node.left, node.right)]
            return f" {sign} ".join(f"({side})" for side in sides)
        return f"{self._operand(node.left, own)} {sign} {self._operand(node.right, own + 1)}"

    def _operand(self, node: Any, least: int) -> str:
        """A number beside an operator, in parentheses if it binds less than `least`."""
        text, kind = self._number(node), type(node).__name__
        loose = text.startswith("-") or (kind == "BinaryOp" and PRECEDENCE[node.op] < least)
        return f"({text})" if loose else text

    def _number(self, node: Any) -> str:
        """An expression of type LREAL."""
        kind = type(node).__name__
        if kind == "TernaryOp" or self._is_truth(node):
            result = f"c{self.block.conditions}"
            self.block.conditions += 1
            self.block.numbers.add(result)
            self._assign(result, node)
            return result
        if kind == "Constant":
            return real(float(node.value))
        if kind == "ID":
            if node.name in ("INFINITY", "NAN"):
                return real(math.inf if node.name == "INFINITY" else math.nan)
            if node.name not in self.block.numbers:
                raise ExportError(
                    f"Expected numbers and functions in the C of operators, got {node.name}; write it out."
                )
            return node.name
        if kind == "ArrayRef":
            name = self._array(node.name.name)
            return name if name in self.scalars else f"{name}[{self._index(node.subscript)}]"
        if kind == "UnaryOp" and node.op == "-":
            return f"-{self._operand(node.expr, PRECEDENCE['*'])}"
        if kind == "BinaryOp":
            own = PRECEDENCE[node.op]
            return f"{self._operand(node.left, own)} {node.op} {self._operand(node.right, own + 1)}"
        if kind == "FuncCall":
            return self._call(node)
        raise ExportError(f"Expected C that structured text can express, got {kind}; export it to c.")

    def _call(self, node: Any) -> str:
        name = node.name.name
        if name == "solve":
            self._solve(node.args.exprs)
            return "determinant"
        given = ", ".join(self._number(each) for each in node.args.exprs)
        if name in STANDARD:
            return f"{STANDARD[name]}({given})"
        if name not in FURTHER:
            raise ExportError(
                f"Expected functions that can be written in structured text, got {name}; write f, g, the cost or V in "
                "others, or export it to c."
            )
        self.block.functions.add(name)
        return f"{self.name}_{name}({given})"

    def _index(self, node: Any) -> str:
        """An expression of type DINT."""
        kind = type(node).__name__
        if kind == "Constant":
            return str(node.value)
        if kind == "ID":
            return node.name
        if kind == "Cast":
            return f"LREAL_TO_DINT({self._number(node.expr)})"
        return f"{self._index(node.left)} {node.op} {self._index(node.right)}"  # sums of products, without parentheses


def _entry(array: str, start: str, further: str) -> str:
    return f"{array}[{further if start == '0' else f'{start} + {further}'}]"


def translate(code: str, block: Block, scalars: Sequence[str], name: str) -> None:
    """Write the body of a C function into a block.

    Args:
        code: the text of the function.
        block: takes the statements.
        scalars: arrays of one entry that are plain variables in the block.
        name: the first part of the names of further functions.

    Raises:
        ExportError: pycparser is missing; or a function does not exist in structured text.
    """
    try:
        from pycparser.c_parser import CParser  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ExportError(f"Expected pycparser, got {error}; pip install 'lyapnet[plc]'.") from error
    function = CParser().parse(re.sub(r"/\*.*?\*/", "", code, flags=re.DOTALL)).ext[0]
    _Translator(block, scalars, name).statement(function.body)


def declarations(names: set[str], kind: str) -> list[str]:
    """Variables of one type."""
    if not names:
        return []
    ordered = sorted(names, key=lambda name: (re.sub(r"\d", "", name), int(re.sub(r"\D", "", name) or 0)))
    return f"{textwrap.fill(', '.join(ordered), 100)} : {kind};".splitlines()
