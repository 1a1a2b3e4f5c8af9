"""The search space: keys of a config, each with a range or a list of values."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution

from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import Config, to_plain
from lyapnet.value.networks.expansion import standard_widths

TUNABLE = ("network", "pointwise", "program", "rollout", "trainer", "training")  # sections; others define the task
RATES, WEIGHTS = (3e-4, 3e-2), (1.0, 100.0)  # default ranges: a tenth and ten times the standard recipe's values
LOG = ":log"
EXAMPLES = "training.learning_rate=1e-4..1e-2:log or training.batch_size=16,32,64"


@dataclass(frozen=True)
class Range:
    """A key with a range; integers if both ends are."""

    key: str
    low: float
    high: float
    log: bool = False

    def __str__(self) -> str:
        return f"{self.key}={self.low}..{self.high}{LOG if self.log else ''}"

    @property
    def distribution(self) -> BaseDistribution:
        if isinstance(self.low, int) and isinstance(self.high, int):
            return IntDistribution(self.low, self.high, log=self.log)
        return FloatDistribution(self.low, self.high, log=self.log)

    @property
    def extremes(self) -> list[str]:
        """The ends of the range; if they are valid, all values are."""
        return [str(self.low), str(self.high)]

    def value_in_space(self, value: Any) -> Any:
        """The value of the distribution for a value of the config; None if it is outside the range."""
        inside = isinstance(value, int | float) and self.low <= value <= self.high
        return value if inside else None

    def text(self, value: float) -> str:
        """A value of the distribution as text for a config, with three digits."""
        if isinstance(value, int):
            return str(value)
        return str(min(max(float(f"{value:.3g}"), self.low), self.high))


@dataclass(frozen=True)
class Choice:
    """A key with a list of values, as on the command line."""

    key: str
    values: Sequence[str]

    def __str__(self) -> str:
        return f"{self.key}={','.join(self.values)}"

    @property
    def distribution(self) -> BaseDistribution:
        return CategoricalDistribution(self.values)

    @property
    def extremes(self) -> Sequence[str]:
        return self.values

    def value_in_space(self, value: Any) -> Any:
        return text if (text := _text(value)) in self.values else None

    def text(self, value: str) -> str:
        return value


Dimension = Range | Choice


def space_of(config: Config, vary: Sequence[str]) -> list[Dimension]:
    """The space of the given keys; without any, the standard space.

    Raises:
        UsageError: a key is not in TUNABLE, or given twice, or its values cannot be read.
    """
    space = [_dimension(each) for each in vary] if vary else standard_space(config)
    keys = [one.key for one in space]
    for key in keys:
        if key.partition(".")[0] not in TUNABLE:
            raise UsageError(
                f"Expected --vary of settings below {', '.join(TUNABLE)}, got {key}; the others make another task, or "
                "another measurement: lyapnet sweep compares those."
            )
        if keys.count(key) > 1:
            raise UsageError(f"Expected --vary once for each key, got {key} twice; leave one of them out.")
    return space


def standard_space(config: Config) -> list[Dimension]:
    """The few keys that matter in any task, with ranges around the config's values."""
    rate, batch, weight = config.training.learning_rate, config.training.batch_size, config.program.cost_to_go
    space: list[Dimension] = [
        Range("training.learning_rate", min(rate, RATES[0]), max(rate, RATES[1]), log=True),
        Choice("training.batch_size", (str(batch), str(2 * batch))),
    ]
    if config.program.name == "value" and weight:
        space.append(Range("program.cost_to_go", min(weight, WEIGHTS[0]), max(weight, WEIGHTS[1]), log=True))
    given = widths = config.network.hidden
    if widths is None and config.network.name == "expansion":
        widths = standard_widths(build_problem(config).system.n)
    if widths is not None:
        space.append(Choice("network.hidden", (_text(given), _text([2 * width for width in widths]))))
    return space


def given_values(config: Config, space: Sequence[Dimension]) -> dict[str, Any] | None:
    """The config's own values as values of the distributions; None if one of them is outside."""
    values = {one.key: one.value_in_space(value_of(config, one.key)) for one in space}
    return None if None in values.values() else values


def value_of(config: Config, key: str) -> Any:
    """The value of a key such as training.batch_size in a config; None if it is not given."""
    value: Any = to_plain(config)
    for name in key.split("."):
        value = value.get(name) if isinstance(value, Mapping) else None
    return value


def _dimension(vary: str) -> Dimension:
    """The dimension that a `--vary` option describes."""
    key, _, values = (part.strip() for part in vary.partition("="))
    low, dots, high = values.removesuffix(LOG).partition("..")
    try:
        if not (key and values):
            raise ValueError
        if not dots:
            return Choice(key, tuple(dict.fromkeys(_text(each) for each in _listed(values))))
        found = Range(key, _number(low), _number(high), values.endswith(LOG))
    except (ValueError, yaml.YAMLError, OmegaConfBaseException) as error:
        raise UsageError(
            f"Expected --vary key=low..high, key=low..high:log or key=value,value,…, got {vary!r}; as in {EXAMPLES}."
        ) from error
    if not (found.low < found.high and (found.low > 0 or not found.log)):
        raise UsageError(f"Expected --vary from a lower end to a higher one, above 0 with :log, got {vary!r}.")
    return found


def _number(text: str) -> float:
    try:
        return int(text)
    except ValueError:
        return float(text)


def _listed(values: str) -> list[Any]:
    """The entries that commas separate; commas within brackets do not."""
    found: Any = OmegaConf.to_container(OmegaConf.from_dotlist([f"values=[{values}]"]))
    return found["values"]


def _text(value: Any) -> str:
    """A value as on the command line."""
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))
