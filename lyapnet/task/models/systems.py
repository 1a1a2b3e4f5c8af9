"""Systems from models: from files that a config names, and from objects in Python."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from lyapnet.base.errors import UsageError, did_you_mean
from lyapnet.task.models.casadi_functions import Model, model_of_function
from lyapnet.task.models.reading import read_model
from lyapnet.task.systems.equations import EquationSystem, defined

TOLERANCE = 1e-12  # largest relative difference between equations and their model


def model_of_file(
    path: Path, kind: str, states: Mapping[str, str], controls: Mapping[str, str], parameters: Mapping[str, Any]
) -> tuple[dict[str, Any], list[list[float]] | None]:
    """The equations, states, controls, angles and drawing of a model's file, as fields of a config's section `system`.

    Args:
        kind: one of lyapnet.task.models.reading.KINDS.
        states, controls: name ↦ unit, which replace those of the model; empty: those of the model.
        parameters: values of all parameters.

    Returns:
        (the section, the least and greatest controls or None if the model has no limits).

    Raises:
        UsageError: the file cannot be read, or a parameter is missing or unknown.
    """
    model = Model(**read_model(path, kind, {"states": list(states), "controls": list(controls)}))
    section = _section(model, states, controls, parameters, path.name)
    return {**section, "angles": list(model.angles), "drawing": model.drawing}, model.limits


def casadi_system(
    function: Any, states: Mapping[str, str] | Sequence[str] = (), controls: Mapping[str, str] | Sequence[str] = (),
    angles: Sequence[str] = (), **parameters: float,
) -> EquationSystem:  # fmt: skip
    """The system ẋ = F(x, u; p) of a CasADi function (x, u, p…) ↦ ẋ, SX or an MX that CasADi can expand.

    It is control-affine if its operations are. x and u are the inputs with these names, or else the first two.

    Args:
        function: a casadi.Function.
        states, controls: names, or name ↦ unit, which replace those of the function's symbols.
        angles: names of the states that are angles in rad.
        parameters: p by name, in SI units.

    Raises:
        UsageError: torch lacks an operation of the function, or the function has other inputs or results.
    """
    x, u = ({name: given[name] if isinstance(given, Mapping) else "" for name in given} for given in (states, controls))
    section = _section(model_of_function(function, list(x), list(u)), x, u, parameters, function.name())
    return defined(**section, parameters=list(parameters), angles=angles, title=function.name())(**parameters)


def _section(
    model: Model, states: Mapping[str, str], controls: Mapping[str, str], parameters: Mapping[str, Any], name: str
) -> dict[str, Any]:
    """The equations, states and controls of a model, after a comparison with its values."""
    _require_parameters(model, parameters, name)
    units, n = model.units or [""] * len([*model.states, *model.controls]), len(model.states)
    x = states or dict(zip(model.states, units[:n], strict=True))
    u = controls or dict(zip(model.controls, units[n:], strict=True))
    _require_equal(model, defined(model.equations, x, u, list(parameters)), name)
    return {"equations": model.equations, "states": x, "controls": u}


def _require_parameters(model: Model, parameters: Mapping[str, Any], name: str) -> None:
    for key in parameters:
        if key not in model.parameters:
            known = ", ".join(model.parameters) or "none"
            hint = did_you_mean(key, model.parameters, "remove it.")
            raise UsageError(f"Expected parameters of {name} ({known}), got {key}; {hint}")
    if missing := [key for key in model.parameters if key not in parameters]:
        raise UsageError(f"Expected values for all parameters of {name}, got none for {', '.join(missing)}; give each.")


def _require_equal(model: Model, cls: type[EquationSystem], name: str) -> None:
    """Refuse equations that differ from the model's values at its points."""
    n, m = len(model.states), len(model.controls)
    for point in model.points:
        numbers = torch.tensor(point, dtype=torch.float64)
        x, u, p, expected = numbers.split([n, m, len(model.parameters), n])
        system = cls(**dict(zip(model.parameters, p.tolist(), strict=True)))
        got = system.dynamics(x, u)
        finite = expected.isfinite()
        same = (got - expected).abs() <= TOLERANCE * (1 + expected.where(finite, 0.0).abs().amax())
        if not bool((same | ~finite).all()):
            raise UsageError(
                f"Expected equations that equal {name}, got ẋ = {got.tolist()} in the place of {expected.tolist()} at "
                f"x = {x.tolist()}; report this with the model."
            )
