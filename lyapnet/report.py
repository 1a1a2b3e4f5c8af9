"""Reports of certificates: the claim in words and formulas, its figures, and what it is about; JSON and Markdown."""

import hashlib
import inspect
import io
import json
import platform
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure

from lyapnet import __version__, certificate_figures
from lyapnet.atomic import write_atomically
from lyapnet.certificates import Certificate
from lyapnet.certification import SoundClaim
from lyapnet.config import Config
from lyapnet.errors import UsageError
from lyapnet.systems import SYSTEMS, ControlAffineSystem
from lyapnet.tables import certificate_rows, floored

NAMES = {"sampled": "states.png", "statistical": "states.png", "sound": "funnel.png"}  # of each kind's figure


def require_writable(figure: Path | None, folder: Path | None, keep: str | None = None) -> None:
    """Refuse what could not be written after the work; make the report's folder.

    Raises:
        UsageError: no folder for the figure or the kept proof, a format that cannot be drawn, or no report folder.
    """
    if keep is not None and not Path(keep).parent.is_dir():
        raise UsageError(
            f"Expected --keep in a folder that exists, got {keep!r}; make {str(Path(keep).parent)!r} first."
        )
    if figure is not None:
        formats = Figure().canvas.get_supported_filetypes()
        if figure.suffix.removeprefix(".") not in formats:
            known = ", ".join(sorted(formats))
            raise UsageError(f"Expected --figure as a file of {known}, got {str(figure)!r}; for example claim.png.")
        if not figure.parent.is_dir():
            raise UsageError(
                f"Expected --figure in a folder that exists, got {str(figure)!r}; make {str(figure.parent)!r} first."
            )
    if folder is not None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(
                f"Expected --report as a folder, got {str(folder)!r} ({error.strerror}); choose another."
            ) from error


def write_outputs(
    certificate: Certificate, checkpoint: Path, command: str, figure: Path | None, folder: Path | None
) -> Iterator[Path]:
    """Write the figure and the report that are asked for, each whole or not at all; their paths, as they are written.

    Args:
        command: that makes the certificate again.
    """
    targets = [path for path in (figure, folder and folder / NAMES[certificate.kind]) if path]
    picture = drawn(certificate) if targets else None
    for path in targets:
        buffer = io.BytesIO()
        assert picture is not None
        picture.savefig(buffer, dpi=150, format=path.suffix.removeprefix("."))
        write_atomically(path, buffer.getbuffer())
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


def drawn(certificate: Certificate) -> Figure:
    """The figure of a certificate's kind."""
    controller, claim = certificate.controller, certificate.claim
    labels = controller.system.state_labels
    if isinstance(claim, SoundClaim):
        return certificate_figures.funnel(claim, controller.V, controller.initial_states, labels)
    return certificate_figures.sampled_states(claim, controller.initial_states, labels)


def report_of(certificate: Certificate, checkpoint: Path, command: str) -> dict[str, Any]:
    """Everything about a certificate as plain data."""
    controller, result = certificate.controller, certificate.result
    config, box, horizon = controller.config, controller.initial_states, controller.horizon
    return {
        "kind": certificate.kind,
        "verdict": result["verdict"],
        "claim": {"words": in_words(result), "formula": in_formulas(result), "verdict": of_the_verdict(result)},
        "certificate": result,
        "options": dict(certificate.options),
        "checkpoint": {"path": str(checkpoint), "sha256": hashlib.sha256(checkpoint.read_bytes()).hexdigest()},
        "experiment": config.experiment,
        "system": {"name": _name(controller.system), "parameters": _parameters(controller.system, config)},
        "states": controller.system.state_labels,
        "initial_states": {"lower": box.lower.tolist(), "upper": box.upper.tolist()},
        "cost": {"Q": config.cost.Q, "R": config.cost.R, "Q_T": config.cost.Q_T},
        "horizon": {"steps": horizon.steps, "dt": horizon.dt, "duration": horizon.duration},
        "rollout": {"policy": config.rollout.policy, "method": config.rollout.method},
        "network": {"name": config.network.name, "parameters": sum(p.numel() for p in controller.V.parameters())},
        "command": command,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": {
            "lyapnet": __version__, "torch": torch.__version__, "python": platform.python_version(),
            "platform": platform.platform(),
        },
        "figure": NAMES[certificate.kind],
    }  # fmt: skip


# The claims in words and formulas, from what `lyapnet certify --json` prints


def in_words(result: dict[str, Any]) -> str:
    """What is claimed, with its numbers."""
    if result["kind"] == "sound":
        return _sound_in_words(result)
    successes, samples = round(result["all_share"] * result["samples"]), result["samples"]
    drawn = f"{samples} states drawn uniformly from X₀ (seed {result['seed']})"
    if result["kind"] == "sampled":
        return (
            f"Of {drawn}, {successes} succeed: their closed loops keep the conditions below on the nodes of the "
            "horizon. About the other states of X₀ this proves nothing."
        )
    return (
        f"With confidence 1 − {1 - result['confidence']:.2g}, at least {floored(result['probability_lower_bound'])} of "
        f"X₀ by volume succeeds: the closed loop keeps the conditions below on the nodes of the horizon. It is the "
        f"exact one-sided Clopper-Pearson bound of {successes} successes in {drawn}. The confidence is over the draw. "
        "Like the rollouts the claim speaks of this model, this Δt and this integrator."
    )


def _sound_in_words(result: dict[str, Any]) -> str:
    if result["rho"] is None:
        return "No level ρ was proved: nothing is claimed. The conditions below were sought."
    return (
        f"{{V(0, ·) ≤ ρ}} with ρ = {result['rho']!r} is the mouth of a funnel, proved in continuous time for this "
        f"model: no closed loop that starts in it leaves the funnel, or D, up to T = {result['duration']:g} s, and its "
        f"cost is bounded as below. It holds at least {floored(result['volume_share'])} of X₀ by volume."
    )


def in_formulas(result: dict[str, Any]) -> list[str]:
    """The conditions of a claim, one a line, with their numbers; rounded to six digits."""
    if result["kind"] == "sound":
        return _sound_in_formulas(result)
    limits = result["tolerances"]
    lines = {
        "decrease": "Σₙ max(Vₙ₊₁ − Vₙ + Δt ℓₙ, 0) ≤ {:g} V(0, x₀)",
        "radius": "‖x(T)‖ ≤ {:g}",
        "cost": "J(x₀) ≤ {:g} V(0, x₀)",
    }
    numbers = {**limits, "cost": 1 + limits["cost"]}
    conditions = [line.format(numbers[name]) for name, line in lines.items() if limits[name] is not None]
    if result["kind"] == "sampled":
        return conditions
    return [*conditions, f"P(x₀ succeeds) ≥ {floored(result['probability_lower_bound'])}  for x₀ uniform on X₀"]


def _sound_in_formulas(result: dict[str, Any]) -> list[str]:
    # unrounded, as proved
    alpha, delta, T = (f"{result[key]!r}".removesuffix(".0") for key in ("alpha", "delta", "duration"))
    rho = "ρ" if result["rho"] is None else repr(result["rho"])
    kappa = "κ" if result["terminal_excess"] is None else repr(result["terminal_excess"])
    return [
        f"V_t + V_xᵀ(f + g u) + {alpha} ℓ(x, u) ≤ {delta}  "
        f"at each (t, x) ∈ [0, {T}] × D with V(t, x) ≤ {rho} + {delta} t",
        f"V(t, x(t)) ≤ {rho} + {delta} t  and  x(t) ∈ D  from each x₀ ∈ D with V(0, x₀) ≤ {rho}",
        f"J(x₀) ≤ (V(0, x₀) + {delta} · {T}) / {alpha} + {kappa}  from the same x₀",
    ]


def of_the_verdict(result: dict[str, Any]) -> str:
    """What the verdict is about, and why it is what it is."""
    verdict = result["verdict"]
    if result["kind"] == "sampled":
        why = "one that fails was found" if verdict == "falsified" else "no sample fails, which proves nothing"
        return f"The verdict is on the claim that every state of X₀ succeeds: {why}."
    if result["kind"] == "statistical":
        why = {
            "certified": "the bound is not below it",
            "falsified": "the share is below it at the same confidence",
            "unknown": "these samples do not tell",
        }[verdict]
        return f"The verdict is on the claim that at least {result['required_share']:.6g} of X₀ succeeds: {why}."
    found = result["counterexample"]
    why = {
        "certified": "it does",
        "falsified": "the condition fails inside the funnel that this would take",
        "unknown": "undecided within the budget",
    }[verdict]
    where = (
        f" At t = {found['t']:.6g} s, x = {_vector(found['x'])} it fails by {found['condition']:.3g}." if found else ""
    )
    return f"The verdict is on the claim that a funnel holds all of X₀: {why}.{where}"


# Markdown


def markdown(report: dict[str, Any]) -> str:
    """The report for a reader."""
    claim, result, horizon = report["claim"], report["certificate"], report["horizon"]
    parameters = ", ".join(f"{name} = {value}" for name, value in report["system"]["parameters"].items())
    about = {
        "checkpoint": f"`{report['checkpoint']['path']}`",
        "sha256": f"`{report['checkpoint']['sha256']}`",
        "experiment": report["experiment"],
        "system": f"{report['system']['name']}{f': {parameters}' if parameters else ''}",
        "cost": ", ".join(f"{name} = {value}" for name, value in report["cost"].items()),
        "horizon": f"{horizon['steps']} steps of {horizon['dt']:g} s, T = {horizon['duration']:g} s",
        "closed loop": f"policy {report['rollout']['policy']}, integrator {report['rollout']['method']}",
        "network": f"{report['network']['name']}, {report['network']['parameters']} parameters",
        **report["versions"],
        "date": report["date"],
    }
    sections = [
        f"# Certificate of {report['experiment']}: {report['kind']}, {report['verdict']}",
        claim["words"],
        "\n".join(["```text", *claim["formula"], "```"]),
        f"**{report['verdict'].capitalize()}.** {claim['verdict']}",
        f"![The claim, drawn]({report['figure']})",
        "## Numbers",
        "Rounded to nearest, shares downwards; in full in [report.json](report.json).",
        _table(("", ""), certificate_rows(result)),
        "## States",
        _table(*_boxes(report)),
        "## What it is about",
        _table(("", ""), list(about.items())),
        "## Again",
        f"```bash\n{report['command']}\n```",
    ]
    return "\n\n".join(sections)


def _boxes(report: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """X₀, and D where there is one, state by state."""
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


def _vector(x: list[float]) -> str:
    return f"({', '.join(f'{entry:.6g}' for entry in x)})"


def _name(system: ControlAffineSystem) -> str:
    """The name of a registered system, module:Class of any other."""
    cls = type(system)
    return next((name for name, known in SYSTEMS.items() if known is cls), f"{cls.__module__}:{cls.__qualname__}")


def _parameters(system: ControlAffineSystem, config: Config) -> dict[str, Any]:
    """The arguments of the system's constructor, defaults written out."""
    signature = inspect.signature(type(system)).parameters.values()
    defaults = {p.name: p.default for p in signature if p.default is not p.empty}
    return {**defaults, **config.system.parameters}
