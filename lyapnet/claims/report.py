"""Reports of certificates in JSON and Markdown: the claim in words and formulas, its figure, and its subject."""

import io
import json
import math
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from lyapnet.base.errors import UsageError
from lyapnet.base.files import digest_of_file, write_atomically
from lyapnet.base.provenance import versions
from lyapnet.controller.controller import Controller, parameters_of
from lyapnet.experiment.config import Config
from lyapnet.task.constraints import names_of
from lyapnet.task.cost import CostWrapper, QuadraticCost
from lyapnet.task.family import PREFIX, FamilyCost, FamilySystem
from lyapnet.task.systems import SYSTEMS, ControlSystem, EquationSystem


def require_writable(figure: Path | None, folder: Path | None, keep: str | None = None) -> None:
    """Check before the work that outputs can be written; create the folder of the report.

    Raises:
        UsageError: a folder does not exist or cannot be created, or the format of the figure is unknown.
    """
    if keep is not None and not Path(keep).parent.is_dir():
        raise UsageError(f"Expected keep in a folder that exists, got {keep!r}; make {str(Path(keep).parent)!r} first.")
    if figure is not None:
        formats = Figure().canvas.get_supported_filetypes()
        if figure.suffix.removeprefix(".") not in formats:
            known = ", ".join(sorted(formats))
            raise UsageError(f"Expected figure as a file of {known}, got {str(figure)!r}; for example claim.png.")
        if not figure.parent.is_dir():
            raise UsageError(
                f"Expected figure in a folder that exists, got {str(figure)!r}; make {str(figure.parent)!r} first."
            )
    if folder is not None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(
                f"Expected report as a folder, got {str(folder)!r} ({error.strerror}); choose another."
            ) from error


def write_outputs(
    certificate: Any, checkpoint: Path | None, command: str, figure: Path | None, folder: Path | None
) -> Iterator[Path]:
    """Write the figure and the report, each file completely or not at all; yield the path of each file.

    Args:
        certificate: a lyapnet.Certificate.
        checkpoint: of the controller; None if it has none.
        command: the command line or the Python call that repeats the certificate.
    """
    targets = [path for path in (figure, folder and folder / certificate.picture) if path]
    picture = certificate.figure() if targets else Figure()
    for path in targets:
        write_figure(picture, path)
        yield path
    if folder is None:
        return
    content = report_of(certificate, checkpoint, command)
    for name, text in (
        ("report.json", json.dumps(content, indent=2, allow_nan=False)),
        ("report.md", markdown(content)),
    ):
        write_atomically(folder / name, (text.rstrip() + "\n").encode())
        yield folder / name


def write_figure(picture: Figure, path: Path) -> None:
    """Write a figure completely or not at all, in the format of the file name's suffix."""
    buffer = io.BytesIO()
    picture.savefig(buffer, dpi=150, format=path.suffix.removeprefix("."))
    write_atomically(path, buffer.getbuffer())


def report_of(certificate: Any, checkpoint: Path | None, command: str) -> dict[str, Any]:
    """The content of a report as plain data."""
    controller, result = certificate.controller, certificate.result
    box, horizon = controller.initial_states, controller.horizon
    return {
        "kind": certificate.kind,
        "verdict": result["verdict"],
        "claim": {
            "words": certificate.in_words(), "formula": certificate.in_formulas(),
            "verdict": certificate.verdict_text(),
        },
        "certificate": result,
        "numbers": certificate.rows,
        "options": dict(certificate.options),
        "checkpoint": checkpoint and {"path": str(checkpoint), "sha256": digest_of_file(checkpoint)},
        "states": controller.system.state_labels,
        "initial_states": {"lower": box.lower.tolist(), "upper": box.upper.tolist()},
        "constraints": list(names_of(controller.problem.constraints)),
        "horizon": {"steps": horizon.steps, "dt": horizon.dt, "duration": horizon.duration},
        **_parts(controller),
        "command": command,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": versions("torch"),
        "figure": certificate.picture,
    }  # fmt: skip


def _parts(controller: Controller) -> dict[str, Any]:
    """System, cost, controls and network of a controller, from its config; without a config, their classes."""
    try:
        config = controller.config
    except UsageError:
        system, law = controller.system, controller.closed_loop.policy
        return {
            "experiment": type(system).__name__,
            "system": {"name": _name(system), "parameters": {}},
            "cost": {"name": type(controller.cost).__name__},
            "controls": {"name": type(controller.controls).__name__},
            "rollout": {"policy": type(law).__name__, "method": controller.method},
            "network": {"name": type(controller.V).__name__},
        }
    return {
        "experiment": config.experiment,
        "system": _system(controller, config),
        "cost": _cost(controller, config),
        "controls": _controls(controller, config),
        "program": {name: value for name, value in vars(config.program).items() if value not in (None, {})},
        "rollout": {"policy": config.rollout.policy, "method": config.rollout.method},
        "network": {"name": config.network.name, "parameters": sum(p.numel() for p in controller.V.parameters())},
    }


# Markdown


def markdown(report: dict[str, Any]) -> str:
    """The report as Markdown."""
    claim, horizon = report["claim"], report["horizon"]
    parameters = ", ".join(f"{name} = {value}" for name, value in report["system"]["parameters"].items())
    given, network = report["checkpoint"], report["network"]
    weights = f", {network['parameters']} parameters" if "parameters" in network else ""
    about = {
        **({"checkpoint": f"`{given['path']}`", "sha256": f"`{given['sha256']}`"} if given else {}),
        "experiment": report["experiment"],
        "system": f"{report['system']['name']}{f': {parameters}' if parameters else ''}",
        "cost": ", ".join(f"{name} = {value}" for name, value in report["cost"].items()),
        "controls": ", ".join(f"{name} = {value}" for name, value in report["controls"].items()) or "without limits",
        **({"constraints": "; ".join(report["constraints"])} if report["constraints"] else {}),
        "horizon": f"{horizon['steps']} steps of {horizon['dt']:g} s, T = {horizon['duration']:g} s",
        "closed loop": f"policy {report['rollout']['policy']}, integrator {report['rollout']['method']}",
        "network": f"{network['name']}{weights}",
        **report["versions"],
        "date": report["date"],
    }
    sections = [
        f"# Certificate of {report['experiment']}: {report['kind']}, {report['verdict']}",
        claim["words"],
        "\n".join(["```text", *claim["formula"], "```"]),
        f"**{report['verdict'].capitalize()}.** {claim['verdict']}",
        f"![Figure of the claim]({report['figure']})",
        "## Numbers",
        "Rounded to nearest, shares downwards; in full in [report.json](report.json).",
        _table(("", ""), report["numbers"]),
        "## States",
        _table(*_boxes(report)),
        "## Subject",
        _table(("", ""), list(about.items())),
        "## To repeat it",
        f"```bash\n{report['command']}\n```",
    ]
    return "\n\n".join(sections)


def _boxes(report: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """The heading and rows of a table of X₀, and of D if there is one; a row for each state."""
    boxes = {"X₀": list(report["initial_states"].values())}
    D = report["certificate"].get("set")
    if D is not None and len(D[0]) == len(report["states"]):
        boxes["D"] = D
    rows = [
        [label, *(f"[{lower[i]!r}, {upper[i]!r}]" for lower, upper in boxes.values())]
        for i, label in enumerate(report["states"])
    ]
    return ["state", *boxes], rows


def _table(heading: Any, rows: Any) -> str:
    """A Markdown table."""
    lines = [heading, ["---"] * len(heading), *rows]
    return "\n".join(f"| {' | '.join(str(cell).replace('|', chr(92) + '|') for cell in line)} |" for line in lines)


def _system(controller: Controller, config: Config) -> dict[str, Any]:
    """Name and parameters of the system, without the parameters of a family."""
    system = controller.system
    if not isinstance(system, FamilySystem):
        return {"name": _name(system), "parameters": controller.parameters, **_equations(system)}
    parameters = parameters_of(system.system, config.system)
    fixed = {name: value for name, value in parameters.items() if name not in config.family}
    return {"name": f"family of {_name(system.system)}", "parameters": fixed, **_equations(system.system)}


def _equations(system: ControlSystem) -> dict[str, str]:
    """The equations of a system that has some."""
    return {"equations": system.definition.equations} if isinstance(system, EquationSystem) else {}


def _name(system: ControlSystem) -> str:
    """The name of a registered system, else module:Class."""
    if isinstance(system, EquationSystem):
        return system.title
    cls = type(system)
    return next((name for name, known in SYSTEMS.items() if known is cls), f"{cls.__module__}:{cls.__qualname__}")


def _controls(controller: Controller, config: Config) -> dict[str, Any]:
    """The limits of U with None for ∞; the class and parameters of another set; empty if U = ℝᵐ."""
    controls = controller.controls
    limits = controls.fixed_limits
    if limits is None or not controls.is_box:
        numbers = {name: each.tolist() for name, each in controls.named_buffers()}
        name = f"{type(controls).__module__}:{type(controls).__qualname__}"
        return {"name": name, **numbers, **config.controls.parameters}
    if not controls.limited:
        return {}
    sides = (side.expand(controller.system.m).tolist() for side in limits)
    finite = ([limit if math.isfinite(limit) else None for limit in side] for side in sides)
    return dict(zip(("lower", "upper"), finite, strict=True))


def _family_cost_words(system: ControlSystem) -> list[str]:
    """Descriptions of what differs between the costs of a family's members."""
    assert isinstance(system, FamilySystem)
    moving = ", ".join(name for name in system.names if name.startswith(PREFIX))
    weights = ", ".join(name for name in system.names if name in system.weights)
    return [*([f"x* moved by {moving}"] if moving else []), *([f"weights {weights} of the family"] if weights else [])]


def _cost(controller: Controller, config: Config) -> dict[str, Any]:
    """The matrices of the cost in the config, or its class and parameters; and its target, in words."""
    cost, words = controller.cost, list[str]()
    while isinstance(cost, CostWrapper | FamilyCost):
        words.extend([cost.words] if isinstance(cost, CostWrapper) else _family_cost_words(controller.system))
        cost = cost.cost
    about = {"with": "; ".join(filter(None, words))} if any(words) else {}
    if isinstance(cost, QuadraticCost):
        return {"Q": config.cost.Q, "R": config.cost.R, "Q_T": config.cost.Q_T, **_control_costs(cost), **about}
    cls = type(cost)
    own = {"name": f"{cls.__module__}:{cls.__qualname__}", **config.cost.parameters}
    return {**own, **_control_costs(cost), **about}


def _control_costs(cost: Any) -> dict[str, Any]:
    """The costs of controls beside uᵀRu, with their numbers."""
    if cost.nonquadratic is None:
        return {}
    parts = [
        {"name": type(part).__name__, **{name: numbers.tolist() for name, numbers in part.named_buffers()}}
        | {name: value for name, value in vars(part).items() if name in ("exponent", "width")}
        for part in cost.nonquadratic.costs
    ]
    return {"control_costs": parts}
