"""Results of identification as tables, sentences, JSON and a YAML file with the estimates."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import yaml
from omegaconf import OmegaConf
from rich.box import SIMPLE
from rich.table import Table

from lyapnet.base.errors import UsageError, one_line
from lyapnet.base.files import plain
from lyapnet.experiment.assembly.family import members_of
from lyapnet.experiment.config import Config, config_from_plain
from lyapnet.experiment.schema import read_yaml
from lyapnet.lab.identification.residual_network import Residual
from lyapnet.lab.identification.residuals import LEVEL, ResidualTest
from lyapnet.lab.identification.results import Estimate, Identification
from lyapnet.lab.identification.unknown_system import system_of

DIGITS = 6  # significant digits of estimates in tables
WIDTH = 120  # characters in lines of YAML
WIDE = 0.5  # half width of an interval relative to the value, above which a sentence warns


def parameter_table(found: Identification, title: str) -> Table:
    """A row for each parameter."""
    table = Table("parameter", "in the config", "estimate", "95 % interval", "±", title=title, box=SIMPLE)
    for name, one in found.parameters.items():
        table.add_row(name, f"{one.before:.{DIGITS}g}", f"{one.value:.{DIGITS}g}", _interval(one), _half(one))
    return table


def reading_table(found: Identification) -> Table:
    """A row for each reading."""
    table = Table("reading", "noise σ", "fit", "held out", "residuals", box=SIMPLE)
    for test in found.tests:
        name = test.reading
        unit = f" ({found.units[name]})" if found.units[name] else ""
        later = f"{found.fit_held_out[name]:.2%}" if found.fit_held_out else "–"
        table.add_row(f"{name}{unit}", f"{found.noise[name]:.4g}", f"{found.fit[name]:.2%}", later, verdict(test))
    return table


def verdict(test: ResidualTest) -> str:
    """The result of a test in a few words."""
    found = list[str]()
    if test.white < LEVEL:
        found.append(f"correlated over {test.correlated + 1} samples ({_probability(test.white)})")
    if test.controls is not None and test.controls < LEVEL:
        found.append(f"follow the controls ({_probability(test.controls)})")
    if test.size is not None and test.ratio is not None and test.size < LEVEL:
        found.append(f"{test.ratio:.3g} times the noise ({_probability(test.size)})")
    return "; ".join(found) or f"white ({_probability(test.white)})"


def sentences(found: Identification) -> list[str]:
    """Sentences with advice, for below the tables."""
    told = list[str]()
    for direction in found.unknown_directions:
        changes = ", ".join(
            f"{name} {change:+.2%}".replace("-", "−") for name, change in _in_percent(direction).items()
        )
        if len(direction) == 1:
            (name,) = direction
            told.append(f"not told: {name} has no effect on these data; leave it out of --parameters.")
        else:
            told.append(
                f"not told: {changes} together leave these data as they are; leave one of them out of --parameters."
            )
    for name, one in found.parameters.items():
        if one.at_bound:
            told.append(f"{name} is at the end of what the system takes; its interval is rough.")
        elif one.told and one.high - one.low > 2 * WIDE * abs(one.value):
            told.append(f"hardly told: {name}; a motion in which it counts for more would tell it.")
    dynamic = [test.reading for test in found.tests if not test.explained]
    if dynamic:
        told.append(
            f"the model does not explain {', '.join(dynamic)}: a right one leaves noise alone. Intervals count what is "
            "left as coloured noise, and may still be too narrow; free further parameters, or add what is missing "
            "(friction, a delay, a sensor's lag)."
        )
    elif wrong := [test for test in found.tests if not test.passed]:
        listed = ", ".join(f"{found.noise[test.reading] * (test.ratio or 1):.3g} of {test.reading}" for test in wrong)
        told.append(f"the noise is another one than outputs.noise says: {listed}; correct it.")
    if found.pieces > sum(not curve.held_out for curve in found.curves):
        told.append(f"fitted in {found.pieces} pieces, each from a state of its own.")
    return told


def residual_sentences(residual: Residual) -> list[str]:
    """Sentences on whether r(x) is needed, and on its bounds and slopes."""
    if not residual.before or math.isnan(residual.ratio):
        return ["r(x) is left out: nothing was held out to judge it by, or nothing of it is followed; hold some out."]
    pairs = [f"{name} {residual.before[name]:.3g} → {residual.after[name]:.3g}" for name in residual.before]
    told = f"with r(x) errors on held-out data are {residual.ratio:.2g} times as large ({', '.join(pairs)})"
    if not residual.needed:
        return [f"r(x) is not needed, and left out: {told}."]
    network, (largest, slopes) = residual.network, residual.network.bounds()
    lines = [f"r(x) is needed: {told}."]
    for k, i in enumerate(network.rates):
        each = ", ".join(f"{name} {round_up(slope)}" for name, slope in zip(network.states, slopes[k], strict=True))
        lines.append(
            f"r of {network.states[i]}: at most {round_up(largest[k])} on the box of these data, its slopes at most "
            f"{each}; beyond the box it is a guess, at most {round_up(network.everywhere[k])}."
        )
    return lines


def round_up(bound: float) -> str:
    """A number ≥ 0 with three digits, rounded upwards."""
    text = f"{bound:.3g}"
    return text if float(text) >= bound else f"{bound + 10.0 ** (math.floor(math.log10(bound)) - 2):.3g}"


def _residual_as_data(residual: Residual) -> dict[str, Any]:
    """The errors with and without r(x), and its bounds, as plain data."""
    network, (largest, slopes) = residual.network, residual.network.bounds()
    names = [network.states[i] for i in network.rates]
    return {
        "needed": residual.needed,
        "ratio": None if math.isnan(residual.ratio) else residual.ratio,
        "held_out_before": residual.before,
        "held_out_after": residual.after,
        "box": {
            name: [float(c - w), float(c + w)]
            for name, c, w in zip(network.states, network.center, network.width, strict=True)
        },
        "largest": dict(zip(names, largest.tolist(), strict=True)),
        "slopes": {
            name: dict(zip(network.states, row, strict=True)) for name, row in zip(names, slopes.tolist(), strict=True)
        },
    }


def _in_percent(direction: Mapping[str, float]) -> dict[str, float]:
    """A direction, scaled so that its smallest change is 1 %, or less if another one would exceed 10 %."""
    sizes = [abs(change) for change in direction.values()]
    scale = min(0.01 / min(sizes), 0.1 / max(sizes))
    return {name: scale * change for name, change in direction.items()}


def _probability(p: float) -> str:
    return f"p = {p:.2f}" if p >= 0.01 else f"p = {p:.0e}" if p > 1e-12 else "p < 1e-12"


def _interval(one: Estimate) -> str:
    if not one.told:
        return "not told"
    low, high = rounded_interval(one.low, one.high)
    return f"[{low:.{DIGITS}g}, {high:.{DIGITS}g}]"


def _half(one: Estimate) -> str:
    if not one.told or one.value == 0:
        return "–"
    return f"{50 * (one.high - one.low) / abs(one.value):.2g} %"


def rounded_interval(low: float, high: float) -> tuple[float, float]:
    """An interval that contains a given one, with ends rounded outwards to two digits of its width."""
    if not high > low:
        return low, high
    unit = 10.0 ** (math.floor(math.log10(high - low)) - 1)
    return float(f"{math.floor(low / unit) * unit:.12g}"), float(f"{math.ceil(high / unit) * unit:.12g}")


def as_json(found: Identification, files: Sequence[str], residual: Residual | None = None) -> dict[str, Any]:
    """All results except the curves, as plain data."""
    return plain(
        {
            "files": [*files],
            "parameters": {name: one._asdict() for name, one in found.parameters.items()},
            "covariance": found.covariance.tolist(),
            "unknown_directions": found.unknown_directions,
            "noise": found.noise,
            "fit": found.fit,
            "fit_held_out": found.fit_held_out or None,
            "residuals": [vars(test) for test in found.tests],
            "model_is_right": found.model_is_right,
            "pieces": found.pieces,
            "degrees_of_freedom": found.freedom,
            **({} if residual is None else {"residual": _residual_as_data(residual)}),
        }
    )


def identified_yaml(
    path: Path,
    overrides: Sequence[str],
    config: Config,
    found: Identification,
    out: Path,
    key: str,
    files: Sequence[str],
    residual: Residual | None = None,
) -> tuple[str, str]:
    """(the config with the estimates and their ranges as YAML, a note if the ranges are not in it, else empty).

    Args:
        path: the file of the config.
        key: randomise or family, the section for the ranges.
        files: names of the files of data.
        residual: r(x), which is added to the equations if it is needed.
    """
    told = {name: one for name, one in found.parameters.items() if one.told}
    ranges = {name: [*rounded_interval(one.low, one.high)] for name, one in told.items()}
    ranges = {name: ends for name, ends in ranges.items() if ends[1] > ends[0]}
    values = {name: float(f"{one.value:.{DIGITS + 2}g}") for name, one in found.parameters.items()}
    layers = OmegaConf.create(read_yaml(path, Config)), OmegaConf.from_dotlist(list(overrides))
    content: Any = OmegaConf.to_container(OmegaConf.merge(*layers))
    content["experiment"] = f"{config.experiment}_identified"
    added = residual is not None and residual.needed
    if residual is not None and added:
        system = asdict(residual.config.system)
        content["system"] = {name: value for name, value in system.items() if value}
        limits = {"lower": config.controls.lower, "upper": config.controls.upper}  # of a model's file
        content.setdefault("controls", {name: value for name, value in limits.items() if value is not None})
    content.setdefault("system", {})["parameters"] = {**config.system.parameters, **values}
    others = {name: ends for name, ends in config.family.items() if name not in found.parameters}
    refused = _refusal(config, values, ranges, key, others)
    note = f"{key}: not written: {refused}" if refused else ""
    if not refused:
        content.pop("randomise", None)
        content[key] = {**ranges, **(others if key == "family" else {})}
        if key == "randomise":
            content.pop("family", None)
    noise = ", ".join(f"{sigma:.3g}" for sigma in found.noise.values())
    comments = [
        f"lyapnet train --config {out}",
        f"Identified from {', '.join(files)}: the values below, and 95 % intervals of each parameter by itself.",
        f"outputs: {{measure: [{', '.join(found.noise)}], noise: [{noise}]}}",
        *(
            []
            if found.model_is_right
            else ["The model does not explain these data: intervals count what is left as coloured noise."]
        ),
        *(residual_sentences(residual) if residual is not None and added else []),
        *([f"{key}: {_in_a_line(ranges)}"] if refused and ranges else []),
    ]
    config_from_plain(content)  # raises an error if the config is invalid
    text = "".join(f"# {' '.join(line.split())}\n" for line in comments) + yaml.dump(
        content, Dumper=_LineByLine, default_flow_style=None, sort_keys=False, allow_unicode=True, width=WIDTH
    )
    return text, note


class _LineByLine(yaml.SafeDumper):
    """Writes strings of several lines as blocks."""


_LineByLine.add_representer(
    str,
    lambda dumper, text: dumper.represent_scalar("tag:yaml.org,2002:str", text, style="|" if "\n" in text else None),
)


def _in_a_line(content: Any) -> str:
    return yaml.safe_dump(content, default_flow_style=True, sort_keys=False, allow_unicode=True, width=math.inf)


def _refusal(
    config: Config, values: Mapping[str, float], ranges: Mapping[str, list[float]], key: str, others: Mapping[str, Any]
) -> str:
    """The reason why the config cannot have these ranges; empty if it can."""
    if not ranges:
        return "the data tell no range"
    beside = {
        "family": config.family if others else {},
        "noise": config.noise,
        "horizon.stationary": config.horizon.stationary,
    }
    if key == "randomise" and (wrong := [name for name, given in beside.items() if given]):
        return f"randomise goes without {wrong[0]}"
    try:
        system, box = system_of(config)
        members_of(config, system, ranges, [""] * len(ranges), box, key)
    except UsageError as error:
        return one_line(error)
    return ""
