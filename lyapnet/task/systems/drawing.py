"""Drawings of systems of equations: the shapes for a state, from text that is parsed and never executed."""

import ast
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import torch

from lyapnet.base.errors import UsageError
from lyapnet.base.shapes import Arrow, Disk, Line, Polygon, Shape
from lyapnet.task.systems.formulas import Formulas


class Kind(NamedTuple):
    """A kind of shape.

    Args:
        make: makes a shape from points (x, y), for a disk followed by its radius.
        points: least number of points.
        more: whether more points are allowed.
        radius: whether a radius follows the points.
    """

    make: Callable[..., Shape]
    points: int
    more: bool = False
    radius: bool = False


KINDS = {
    "line": Kind(lambda *points: Line(points), 2, more=True),
    "faint": Kind(lambda *points: Line(points, width=1.0, faint=True), 2, more=True),
    "polygon": Kind(lambda *points: Polygon(points), 3, more=True),
    "disk": Kind(Disk, 1, radius=True),
    "arrow": Kind(Arrow, 2),
}


class Drawing(Formulas):
    """The shapes for a state, from lines `NAME = expression` and lines of the form

        line(x, y, x, y, …)  faint(x, y, x, y, …)  polygon(x, y, x, y, x, y, …)  disk(x, y, radius)  arrow(x, y, x, y)

    where all numbers are expressions.

    Args:
        text: these lines.
        names: names of states, controls and parameters.

    Raises:
        UsageError: a line has neither form, or a shape has a wrong count of numbers.
    """

    def __init__(self, text: str, names: Sequence[str]):
        self.shapes: list[tuple[str, list[int]]] = []  # (kind, places of its numbers among the results of formulas)
        super().__init__(text, names, (), (), "drawing")

    def shapes_at(self, values: Mapping[str, float]) -> list[Shape]:
        """The shapes, in metres, for values of the names."""
        found = self._compute(values, {place for _, each in self.shapes for place in each}, torch.tensor(0.0))
        return [_shape(KINDS[kind], [float(found[place]) for place in each]) for kind, each in self.shapes]

    def _read_line(self, line: str, place: str, results: Sequence[str]) -> None:
        try:
            call = ast.parse(line, mode="eval").body
        except (SyntaxError, ValueError):  # an assignment, or neither
            super()._read_line(line, place, results)
            return
        match call:
            case ast.Call(func=ast.Name(id=name), args=numbers, keywords=[]) if name in KINDS:
                _require_count(name, len(numbers), place)
                self.shapes.append((name, [self._place_of(each, place) for each in numbers]))
            case _:
                raise UsageError(
                    f"Expected a shape ({', '.join(KINDS)}) or name = expression in {place}, got {line[:60]!r}; "
                    "correct the line."
                )


def _require_count(name: str, count: int, place: str) -> None:
    kind = KINDS[name]
    least = 2 * kind.points + kind.radius
    if count < least or (count > least and not kind.more) or (count - kind.radius) % 2:
        more = " or more, in pairs x, y," if kind.more else ""
        raise UsageError(f"Expected {least} numbers{more} for {name} in {place}, got {count}; correct the line.")


def _shape(kind: Kind, numbers: Sequence[float]) -> Shape:
    radius = numbers[-1:] if kind.radius else []
    return kind.make(*([x, y] for x, y in zip(numbers[::2], numbers[1::2], strict=False)), *radius)
