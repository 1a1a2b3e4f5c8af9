"""Systems whose dynamics are given as equations in text, from a config or converted from a model in another format."""

import functools
import inspect
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from lyapnet.base.errors import UsageError, did_you_mean
from lyapnet.base.names import identifier, with_underscores
from lyapnet.base.shapes import Shape
from lyapnet.base.types import Control, InputMatrix, State
from lyapnet.task.systems.base import ControlSystem
from lyapnet.task.systems.drawing import Drawing
from lyapnet.task.systems.formulas import Formulas, Number


class Definition(NamedTuple):
    """Equations with the names in them.

    Args:
        equations: a line `der(state) = expression` for each state, and lines `name = expression` before them.
        states, controls: (name, unit) of each, in order; equations write _ for spaces in names.
        parameters: their names.
        angles: names of the states that are angles in rad.
        title: the name of the system in tables.
        drawing: text for lyapnet.task.systems.drawing.Drawing; empty: no drawing.
    """

    equations: str
    states: tuple[tuple[str, str], ...]
    controls: tuple[tuple[str, str], ...]
    parameters: tuple[str, ...] = ()
    angles: tuple[str, ...] = ()
    title: str = "Equations"
    drawing: str = ""

    @property
    def names(self) -> list[str]:
        """The names of states, controls and parameters, as equations write them."""
        return [with_underscores(name) for name in (*dict(self.states), *dict(self.controls), *self.parameters)]


class EquationSystem(ControlSystem):
    """ẋ = F(x, u; p) by equations; `system_class` makes the class of a definition, whose arguments are p.

    It is control-affine if this follows from the operations: ẋ = c + Σ b_j u_j, where c and b_j do not depend on u.
    Then f = c and g = b, from the same equations. Parameters are attributes, so they may vary as for other systems.

    Args:
        parameters: p by name, in SI units.

    Raises:
        UsageError: a parameter is no number, or an angle is no state.
    """

    definition: Definition
    formulas: Formulas
    drawing: Drawing

    def __init__(self, **parameters: float):
        super().__init__()
        definition = self.definition
        self.state_names: list[str] = [name for name, _ in definition.states]
        self.state_units: list[str] = [unit for _, unit in definition.states]
        self.control_names: list[str] = [name for name, _ in definition.controls]
        self.control_units: list[str] = [unit for _, unit in definition.controls]
        self.angles: list[int] = [_index_of(name, self.state_names) for name in definition.angles]
        for name in definition.parameters:
            if isinstance(parameters[name], bool) or not isinstance(parameters[name], int | float):
                raise UsageError(f"Expected a number for system.parameters.{name}, got {parameters[name]!r}; give one.")
            setattr(self, self.attribute_of(name), parameters[name])
        lengths = self.formulas.names_at({"normal_force": 4, "friction_force": 3})
        self.contact_lengths: list[str] = [
            self.attribute_of(name) for name in definition.parameters if with_underscores(name) in lengths
        ]

    @property
    def affine(self) -> bool:
        return self.formulas.affine

    @property
    def title(self) -> str:
        return self.definition.title

    def attribute_of(self, parameter: str) -> str:
        taken = hasattr(ControlSystem, parameter) or parameter in EquationSystem.__annotations__
        return f"value_of_{parameter}" if taken else parameter

    def dynamics(self, x: State, u: Control) -> State:
        x, u = _same_batch(x, u)
        return torch.stack(self.formulas(self._values(x, u.unbind(-1)), x[..., 0]), -1)

    def f(self, x: State) -> State:
        if not self.affine:
            return super().f(x)
        return torch.stack(self.formulas(self._values(x, [0.0] * self.m), x[..., 0]), -1)

    def g(self, x: State) -> InputMatrix:
        if not self.affine:
            return super().g(x)
        rows = self.formulas.slopes(self._values(x, [0.0] * self.m), x[..., 0])
        return torch.stack([torch.stack(row, -1) for row in rows], -2)

    def draw(self, x: np.ndarray, u: np.ndarray) -> Sequence[Shape]:
        parameters = (getattr(self, self.attribute_of(name)) for name in self.definition.parameters)
        values = (float(each) for each in (*x, *u, *parameters))
        return self.drawing.shapes_at(dict(zip(self.definition.names, values, strict=True)))

    def _values(self, x: State, u: Sequence[Number]) -> dict[str, Number]:
        """The value of each name in the equations."""
        parameters = (getattr(self, self.attribute_of(name)) for name in self.definition.parameters)
        return dict(zip(self.definition.names, (*x.unbind(-1), *u, *parameters), strict=True))

    def __reduce__(self) -> Any:
        """Support pickling: another process makes the class from its definition."""
        return _without_init, (self.definition,), self.__dict__


@functools.cache
def system_class(definition: Definition) -> type[EquationSystem]:
    """The class of systems with these equations; its constructor takes the parameters by name.

    Raises:
        UsageError: there are no states or controls, the equations cannot be read, or a state has none.
    """
    for kind, entries in (("states", definition.states), ("controls", definition.controls)):
        if not entries:
            raise UsageError(f"Expected system.{kind} as {{name: unit}} for the equations, got none; name them.")
    results = [f"der({with_underscores(name)})" for name, _ in definition.states]
    controls = [with_underscores(name) for name, _ in definition.controls]
    own = {
        "definition": definition, "__doc__": EquationSystem.__doc__,
        "formulas": Formulas(definition.equations, definition.names, results, controls),
        "drawing": Drawing(definition.drawing, definition.names),
    }  # fmt: skip
    cls = type(identifier(definition.title, "system"), (EquationSystem,), own)
    keyword = inspect.Parameter.KEYWORD_ONLY
    cls.__signature__ = inspect.Signature(  # pyright: ignore[reportAttributeAccessIssue]
        [inspect.Parameter(name, keyword, annotation=float) for name in definition.parameters]
    )
    return cls


def defined(
    equations: str, states: Mapping[str, str], controls: Mapping[str, str], parameters: Sequence[str] = (),
    angles: Sequence[str] = (), title: str = "Equations", drawing: str = "",
) -> type[EquationSystem]:  # fmt: skip
    """The class of systems with these equations; states and controls map names to units."""
    named = [tuple((name, unit or "") for name, unit in entries.items()) for entries in (states, controls)]
    return system_class(Definition(equations, named[0], named[1], tuple(parameters), tuple(angles), title, drawing))


def _without_init(definition: Definition) -> EquationSystem:
    cls = system_class(definition)
    return cls.__new__(cls)


def _index_of(name: str, states: Sequence[str]) -> int:
    if name not in states:
        hint = did_you_mean(name, states, f"the states are {', '.join(states)}.")
        raise UsageError(f"Expected system.angles among the states, got {name!r}; {hint}")
    return list(states).index(name)


def _same_batch(x: State, u: Control) -> tuple[State, Control]:
    """x and u with the same leading axes."""
    batch = torch.broadcast_shapes(x.shape[:-1], u.shape[:-1])
    return x.expand(*batch, x.shape[-1]), u.expand(*batch, u.shape[-1])
