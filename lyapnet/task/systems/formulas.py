"""Formulas as text, such as `der(rate) = -9.81/length*sin(angle)`, parsed into torch operations, never executed.

A text has one assignment in each line: `name = expression` for an intermediate result, `der(state) = expression` for
the derivative of a state. Expressions have numbers, names, + - * / **, comparisons, and, or, not, and the functions
in FUNCTIONS; `where(condition, a, b)` is a where the condition holds and b elsewhere. `#` begins a comment.
"""

import ast
import functools
import math
import operator
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lyapnet.base.errors import UsageError, did_you_mean
from lyapnet.base.files import LARGEST_TEXT
from lyapnet.task.systems.contact import Number, friction_force, normal_force

MOST_OPERATIONS = 100_000  # largest number of operations of a text


class Operation(NamedTuple):
    """An operation on numbers.

    Args:
        of_tensors: its function in torch.
        of_numbers: its function in NumPy, for operands that are all numbers.
        operands: number of operands.
        tensors: number of operands, from the first one, that have to be tensors; None: all.
    """

    of_tensors: Callable[..., Any]
    of_numbers: Callable[..., Any]
    operands: int = 1
    tensors: int | None = None


def _copysign(a: Tensor, b: Tensor) -> Tensor:
    return torch.where(b < 0, -a.abs(), a.abs())


def _on_numbers(function: Callable[..., Tensor]) -> Callable[..., float]:
    """A function of two tensors and of parameters, as a function of numbers."""
    return lambda first, second, *rest: float(function(torch.tensor(first), torch.tensor(second), *map(float, rest)))


FUNCTIONS: dict[str, Operation] = {
    **{
        name: Operation(getattr(torch, name), getattr(np, name))
        for name in (
            "sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "expm1", "log", "log1p", "sqrt", "abs", "sign",
            "floor", "ceil", "round",
        )
    },
    **{
        name: Operation(getattr(torch, name), getattr(np, name.replace("a", "arc", 1)))
        for name in ("asin", "acos", "atan", "asinh", "acosh", "atanh")
    },
    "erf": Operation(torch.erf, math.erf),
    "atan2": Operation(torch.atan2, np.arctan2, 2),
    "hypot": Operation(torch.hypot, np.hypot, 2),
    "min": Operation(torch.minimum, np.minimum, 2),
    "max": Operation(torch.maximum, np.maximum, 2),
    "fmod": Operation(torch.fmod, np.fmod, 2),
    "copysign": Operation(_copysign, np.copysign, 2),
    "where": Operation(torch.where, np.where, 3),
    "normal_force": Operation(normal_force, _on_numbers(normal_force), 5, tensors=2),
    "friction_force": Operation(friction_force, _on_numbers(friction_force), 4, tensors=2),
}  # fmt: skip
CONSTANTS = {"pi": math.pi}

_SIGNS: dict[type, str] = {
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "**", ast.USub: "negative",
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=",
    ast.And: "and", ast.Or: "or", ast.Not: "not",
}  # fmt: skip
_COMPARISONS: dict[str, Operation] = {
    sign: Operation(function, function, 2)
    for sign, function in (
        ("<", operator.lt), ("<=", operator.le), (">", operator.gt), (">=", operator.ge), ("==", operator.eq),
        ("!=", operator.ne),
    )
}  # fmt: skip
_LOGICAL: dict[str, Operation] = {
    "and": Operation(torch.logical_and, np.logical_and, 2),
    "or": Operation(torch.logical_or, np.logical_or, 2),
    "not": Operation(torch.logical_not, np.logical_not, 1),
}
_ARITHMETIC: dict[str, Operation] = {
    "+": Operation(operator.add, np.add, 2),
    "-": Operation(operator.sub, np.subtract, 2),
    "*": Operation(operator.mul, np.multiply, 2),
    "/": Operation(operator.truediv, np.divide, 2),
    "**": Operation(operator.pow, np.power, 2),
    "negative": Operation(operator.neg, np.negative),
}
_OPERATIONS: dict[str, Operation] = {**FUNCTIONS, **_COMPARISONS, **_LOGICAL, **_ARITHMETIC}


class Instruction(NamedTuple):
    """An operation; its operands are the places of earlier results."""

    operation: str
    operands: tuple[int, ...]


class Formulas:
    """Functions of named numbers, as a list of operations in which equal expressions occur once.

    Names, constants and results of operations have places: consecutive integers.

    Args:
        text: the lines of assignments.
        names: names of states, controls and parameters.
        results: names that the text has to define, such as `der(state)`, in the order of the results.
        controls: the names among these for which `affine` is whether the results are affine in them.
        where: the name of the text in messages.

    Raises:
        UsageError: a line is no such assignment, or a name is unknown, or missing, or assigned twice.
    """

    def __init__(
        self, text: str, names: Sequence[str], results: Sequence[str], controls: Sequence[str],
        where: str = "equations",
    ):  # fmt: skip
        self.where: str = where
        self.names: tuple[str, ...] = tuple(names)
        self.constants: dict[int, float] = {}
        self.instructions: dict[int, Instruction] = {}
        self._known: dict[Any, int] = {}
        _require_names(names, where)
        self._places = {name: place for place, name in enumerate(names)}
        self._size = len(self._places)
        self._read(text, results)
        self.results: list[int] = [self._places[name] for name in results]
        del self._known, self._places
        self.controls: tuple[str, ...] = tuple(controls)
        self.affine: bool
        self._moved, self._factors, self.affine = self._find_dependence()

    def __call__(self, values: Mapping[str, Number], like: Tensor, only: Collection[int] | None = None) -> list[Tensor]:
        """The results as tensors (*batch,).

        Args:
            values: name ↦ number or tensor (*batch,).
            like: a tensor of the shape, type and device of the results.
            only: indices of the results to compute; None: all.
        """
        chosen = [place for k, place in enumerate(self.results) if only is None or k in only]
        found = self._compute(values, chosen, like)
        return [_fill(found[place], like) for place in chosen]

    def names_at(self, places: Mapping[str, int]) -> set[str]:
        """The names that are themselves an operand of some operations; places: operation ↦ operand, from 0."""
        used = {operands[places[each]] for each, operands in self.instructions.values() if each in places}
        return {self.names[place] for place in used if place < len(self.names)}

    def slopes(self, values: Mapping[str, Number], like: Tensor) -> list[list[Tensor]]:
        """[b_1, …, b_m] of each result c + Σ_j b_j u_j, if they are affine; computes only what b depends on."""
        slopes: dict[int, dict[int, Number]] = {self.names.index(u): {j: 1.0} for j, u in enumerate(self.controls)}
        found = self._compute({k: v for k, v in values.items() if k not in self.controls}, self._factors, like)
        for place in self._moved:
            operation, operands = self.instructions[place]
            slopes[place] = _slopes(
                operation, [slopes.get(k, {}) for k in operands], [found.get(k, 0.0) for k in operands], like
            )
        columns = range(len(self.controls))
        return [[_fill(slopes.get(place, {}).get(j, 0.0), like) for j in columns] for place in self.results]

    def _find_dependence(self) -> tuple[list[int], set[int], bool]:
        """(places of instructions that depend on u, places of their factors, whether all results are affine in u).

        This follows from the operations alone, for all values.
        """
        moved, factors = list[int](), set[int]()
        depends = {self.names.index(u) for u in self.controls}
        for place in self._find_needed(self.results):
            operation, operands = self.instructions[place]
            if depends.isdisjoint(operands):
                continue
            scales = _factors(operation, [k in depends for k in operands])
            if scales is None:
                return [], set(), False
            factors.update(operands[i] for i in scales)
            depends.add(place)
            moved.append(place)
        return moved, factors, True

    def _compute(self, values: Mapping[str, Number], places: Iterable[int], like: Tensor) -> dict[int, Number]:
        """Place ↦ value for some places, and for those on which they depend."""
        given = {k: values[name] for k, name in enumerate(self.names) if name in values}
        found: dict[int, Number] = {**self.constants, **given}
        for place in self._find_needed(places):
            operation, operands = self.instructions[place]
            found[place] = _compute(operation, [found[k] for k in operands], like)
        return found

    def _find_needed(self, results: Iterable[int]) -> list[int]:
        """The places of the instructions on which results depend, in the order of computation."""
        needed, waiting = set[int](), list(results)
        while waiting:
            place = waiting.pop()
            if place in self.instructions and place not in needed:
                needed.add(place)
                waiting += self.instructions[place].operands
        return sorted(needed)

    def _read(self, text: str, results: Sequence[str]) -> None:
        if len(text) > LARGEST_TEXT:
            raise UsageError(f"Expected {self.where} below {LARGEST_TEXT} letters, got {len(text)}; simplify them.")
        for number, written in enumerate(text.splitlines(), 1):
            line = written.partition("#")[0].strip()
            place = f"line {number} of {self.where}"
            try:
                if line:
                    self._read_line(line, place, results)
            except (RecursionError, MemoryError, OverflowError) as error:
                raise UsageError(
                    f"Expected shorter expressions and numbers in {place}, got {len(line)} letters; divide it into "
                    "lines."
                ) from error
        if missing := [name for name in results if name not in self._places]:
            raise UsageError(
                f"Expected {self.where} with {missing[0]} = …, got none; write one for each of {', '.join(results)}."
            )

    def _read_line(self, line: str, place: str, results: Sequence[str]) -> None:
        name, expression = _assignment(line, place)
        if name.startswith("der(") and name not in results:
            states = [each[4:-1] for each in results]
            hint = did_you_mean(name[4:-1], states, f"the states are {', '.join(states)}.")
            raise UsageError(f"Expected derivatives of states in {place}, got {name}; {hint}")
        if name in self._places or name in FUNCTIONS or name in CONSTANTS:
            raise UsageError(f"Expected a new name before = in {place}, got {name}, which is taken; use another.")
        self._places[name] = self._place_of(expression, place)

    def _place_of(self, node: ast.AST, where: str) -> int:
        """The place of an expression's result; adds the instructions for it."""
        match node:
            case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
                return self._constant(float(value))
            case ast.Name(id=name) if name in self._places:
                return self._places[name]
            case ast.Name(id=name) if name in CONSTANTS:
                return self._constant(CONSTANTS[name])
            case ast.Name(id=name):
                hint = did_you_mean(name, [*self._places, *CONSTANTS], "define it in a line before.")
                raise UsageError(
                    f"Expected a state, control, parameter or an earlier name in {where}, got {name}; {hint}"
                )
            case ast.UnaryOp(op=ast.UAdd(), operand=operand):
                return self._place_of(operand, where)
            case ast.UnaryOp(op=op, operand=operand) if type(op) in _SIGNS:
                return self._instruction(_SIGNS[type(op)], [operand], where)
            case ast.BinOp(left=left, op=op, right=right) if type(op) in _SIGNS:
                return self._instruction(_SIGNS[type(op)], [left, right], where)
            case ast.BoolOp(op=op, values=[first, *others]):
                place = self._place_of(first, where)
                for other in others:
                    place = self._add(_SIGNS[type(op)], (place, self._place_of(other, where)))
                return place
            case ast.Compare(left=left, ops=[op], comparators=[right]) if type(op) in _SIGNS:
                return self._instruction(_SIGNS[type(op)], [left, right], where)
            case ast.IfExp(test=condition, body=body, orelse=otherwise):
                return self._instruction("where", [condition, body, otherwise], where)
            case ast.Call(func=ast.Name(id=name), args=operands, keywords=[]):
                return self._call(name, operands, where)
        written = ast.unparse(node)[:60]
        hint = "write a**b for a power" if "^" in written else "write it with + - * / ** and functions"
        raise UsageError(f"Expected an expression of numbers in {where}, got {written!r}; {hint}.")

    def _call(self, name: str, operands: Sequence[ast.AST], where: str) -> int:
        if name not in FUNCTIONS:
            hint = did_you_mean(name, FUNCTIONS, f"there are {', '.join(FUNCTIONS)}.")
            raise UsageError(f"Expected a known function in {where}, got {name}; {hint}")
        count = FUNCTIONS[name].operands
        if name in ("min", "max") and len(operands) > count:
            places = [self._place_of(each, where) for each in operands]
            return functools.reduce(lambda a, b: self._add(name, (a, b)), places)
        if len(operands) != count:
            raise UsageError(f"Expected {name} of {count} numbers in {where}, got {len(operands)}; correct the line.")
        return self._instruction(name, operands, where)

    def _instruction(self, operation: str, operands: Sequence[ast.AST], where: str) -> int:
        return self._add(operation, tuple(self._place_of(each, where) for each in operands))

    def _constant(self, value: float) -> int:
        place = self._known.setdefault(value, self._size)
        if place == self._size:
            self.constants[place] = value
            self._size += 1
        return place

    def _add(self, operation: str, operands: tuple[int, ...]) -> int:
        if len(self.instructions) >= MOST_OPERATIONS:
            raise UsageError(f"Expected {self.where} of at most {MOST_OPERATIONS} operations, got more; simplify them.")
        place = self._known.setdefault((operation, operands), self._size)
        if place == self._size:
            self.instructions[place] = Instruction(operation, operands)
            self._size += 1
        return place


def _require_names(names: Sequence[str], where: str) -> None:
    for name in names:
        if not name.isidentifier() or name in FUNCTIONS or name in CONSTANTS or name in ("der", "and", "or", "not"):
            raise UsageError(
                f"Expected names that {where} can use, of letters, digits and _, got {name!r}; give it another one."
            )
    if twice := [name for k, name in enumerate(names) if name in names[:k]]:
        raise UsageError(f"Expected different names in {where}, got {twice[0]} twice; rename one.")


def _assignment(line: str, place: str) -> tuple[str, ast.AST]:
    """The name before =, `der(state)` included, and the expression after it."""
    left, equals, right = line.partition("=")
    left, right = "".join(left.split()), right.strip()
    state = left[4:-1] if left.startswith("der(") and left.endswith(")") else left
    try:
        if not equals or not state.isidentifier():
            raise SyntaxError
        return left, ast.parse(right, mode="eval").body
    except (SyntaxError, ValueError) as error:
        raise UsageError(
            f"Expected name = expression, or der(state) = expression, in {place}, got {line[:60]!r}; correct the line."
        ) from error


def _compute(operation: str, operands: Sequence[Number], like: Tensor) -> Number:
    """The result of an operation: a float if all operands are floats."""
    if not any(isinstance(each, Tensor) for each in operands):
        with np.errstate(all="ignore"):
            return float(_OPERATIONS[operation].of_numbers(*map(np.float64, operands)))
    if operation == "**" and isinstance(operands[1], float):
        exponent = operands[1]
        return _as_number(operands[0], like) ** (int(exponent) if exponent.is_integer() else exponent)
    if operation in _ARITHMETIC or operation in _COMPARISONS:
        return _OPERATIONS[operation].of_tensors(*(_as_number(each, like) for each in operands))
    if operation in _LOGICAL:
        return _OPERATIONS[operation].of_tensors(*(_as_condition(each, like) for each in operands))
    if operation == "where":
        condition, *values = operands
        return torch.where(_as_condition(condition, like), *(_tensor(_as_number(each, like), like) for each in values))
    found = _OPERATIONS[operation]
    numbers = [_as_number(each, like) for each in operands]
    count = len(numbers) if found.tensors is None else found.tensors
    return found.of_tensors(*(_tensor(each, like) for each in numbers[:count]), *numbers[count:])


def _factors(operation: str, depends: Sequence[bool]) -> list[int] | None:
    """Indices of operands that are factors of the result's slopes, or conditions; None if it is not affine in u."""
    match operation, *depends:
        case ("+" | "-" | "negative", *_):
            return []
        case ("*", True, False):
            return [1]
        case ("*", False, True):
            return [0]
        case ("/", True, False):
            return [1]
        case ("where", False, *_):
            return [0]
    return None


def _slopes(
    operation: str, slopes: Sequence[Mapping[int, Number]], numbers: Sequence[Number], like: Tensor
) -> dict[int, Number]:
    """Control ↦ slope of a result, from the slopes and values of its operands."""
    columns = {j: None for each in slopes for j in each}

    def of(k: int, j: int) -> Number:
        return slopes[k].get(j, 0.0)

    match operation:
        case "negative":
            return {j: _compute("negative", [of(0, j)], like) for j in columns}
        case "+" | "-":
            first = dict(slopes[0])
            return first | {j: _compute(operation, [of(0, j), of(1, j)], like) for j in slopes[1]}
        case "where":
            return {j: _compute("where", [numbers[0], of(1, j), of(2, j)], like) for j in columns}
        case _:
            k = 0 if slopes[0] else 1
            return {j: _compute(operation, [slope, numbers[1 - k]], like) for j, slope in slopes[k].items()}


def _tensor(value: Number, like: Tensor) -> Tensor:
    return value if isinstance(value, Tensor) else torch.full_like(like, value)


def _fill(value: Number, like: Tensor) -> Tensor:
    """A number as a tensor of the whole batch."""
    value = _as_number(value, like)
    return value.expand_as(like) if isinstance(value, Tensor) else torch.full_like(like, value)


def _as_number(value: Number, like: Tensor) -> Number:
    """1 and 0 for a condition that holds or does not; other numbers as they are."""
    return value.to(like.dtype) if isinstance(value, Tensor) and value.dtype == torch.bool else value


def _as_condition(value: Number, like: Tensor) -> Tensor:
    """Whether a number is not 0."""
    value = _tensor(value, like)
    return value if value.dtype == torch.bool else value != 0
