"""lyapnet trim."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from lyapnet.cli.options import Debug, make_stages


def trim(
    config: Annotated[Path, typer.Argument(help="The experiment, a YAML file with target.")],
    overrides: Annotated[list[str] | None, typer.Argument(help="Changes to it, as in 'target={voltage: 15}'.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    debug: Debug = False,
) -> None:
    """Print the operating point of a task: the state x* that its target asks for, and the control u* that holds it."""
    from lyapnet.base.errors import UsageError
    from lyapnet.experiment.assembly import operating_point, parts_of
    from lyapnet.experiment.config import load_config

    resolved = load_config(config, overrides or [])
    if resolved.family:
        raise UsageError("Expected one task to trim, got a family; give its parameters in system.parameters instead.")
    if resolved.target is None:
        raise UsageError("Expected a target to trim, got none; add 'target={STATE: VALUE}' with names of states.")
    if resolved.target_control is not None:
        raise UsageError(
            "Expected a target whose control is solved for, got target_control; add target_control=null to the command."
        )
    with make_stages("trim") as report:
        report("solving for the operating point")
        system, found = operating_point(resolved, parts_of(resolved))
    units = {
        "states": dict(zip(system.state_names, system.state_units, strict=True)),
        "controls": dict(zip(system.control_names, system.control_units, strict=True)),
    }
    if as_json:
        content = {"experiment": resolved.experiment, **_plain(found.point, units), "units": units}
        print(json.dumps({**content, "others": [_plain(other, units) for other in found.others]}, ensure_ascii=False))
        return
    console = Console(highlight=False, markup=False)
    console.print(_table(resolved.experiment, [found.point, *found.others], units))
    if found.note:
        console.print(found.note, soft_wrap=True)


def _plain(point: Any, units: dict[str, dict[str, str]]) -> dict[str, Any]:
    """A point as plain data; + 0.0 makes 0 of −0."""
    return {
        "states": dict(zip(units["states"], (point.x + 0.0).tolist(), strict=True)),
        "controls": dict(zip(units["controls"], (point.u + 0.0).tolist(), strict=True)),
        "residual": float(point.rate.abs().max()),
        "within_limits": point.admitted,
    }


def _table(title: str, points: list[Any], units: dict[str, dict[str, str]]) -> Table:
    """A row for each state and control, and a column for each point; the first point is the target."""
    headers = ["operating point", *(f"another, {k}" for k in range(1, len(points)))]
    table = Table("", *headers, title=title)
    for side in ("states", "controls"):
        for name, unit in units[side].items():
            values = [f"{_plain(point, units)[side][name]:.9g}" for point in points]
            table.add_row(f"{name} ({unit})" if unit else name, *values)
    table.add_row("largest rate left, of those on X₀", *(f"{_plain(p, units)['residual']:.1e}" for p in points))
    table.add_row("within limits", *("yes" if point.admitted else "no" for point in points))
    return table
