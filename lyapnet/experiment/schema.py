"""Generic tools for configs: dataclasses with a sentence for each field, read from YAML, with helpful errors."""

import dataclasses
import difflib
import io
import math
import operator
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import field
from functools import cache, cached_property
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from omegaconf import MISSING, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from lyapnet.base.errors import UsageError, did_you_mean, one_line
from lyapnet.base.files import LARGEST_TEXT, read_file
from lyapnet.base.names import with_underscores

_NUMBER = re.compile(r"\s*[-+]?[\d._]+(e[-+]?\d+)?\s*|.*\$\{.*", re.I)  # a number in quotes, or an interpolation


class Names(Sequence[str]):
    """The names in a registry of lyapnet, which is loaded on first use, because it loads torch."""

    def __init__(self, home: str, registry: str):
        self._home, self._registry = home, registry

    @cached_property
    def _names(self) -> tuple[str, ...]:
        return tuple(getattr(import_module(f"lyapnet.{self._home}"), self._registry))

    def __getitem__(self, index: Any) -> Any:
        return self._names[index]

    def __len__(self) -> int:
        return len(self._names)


def setting(
    default: Any,
    doc: str,
    *,
    choices: Sequence[str] = (),
    user_class: bool = False,
    folder: bool = False,
    lines: bool = False,
    mapping: bool = False,
    above: float | None = None,
    at_least: float | None = None,
    below: float | None = None,
) -> Any:
    """A dataclass field with a description and its admissible values.

    Args:
        user_class: whether module:Class is admissible too.
        folder: whether the value must be a relative path that stays in its folder.
        lines: whether the text may have several lines.
        mapping: whether a mapping is admissible instead of a list.
    """
    bounds = {">": above, "≥": at_least, "<": below}
    rule = {
        "doc": doc,
        "choices": choices,
        "user_class": user_class,
        "folder": folder,
        "lines": lines,
        "bounds": bounds,
    }
    rule["mapping"] = mapping
    if isinstance(default, list | dict):
        return field(default_factory=lambda: type(default)(default), metadata=rule)
    return field(default=default, metadata=rule)


def read_yaml(path: str | Path, schema: type) -> dict[str, Any]:
    """Read a YAML file that has some keys of a schema.

    Raises:
        UsageError: no such file, not YAML, or none of the keys.
    """
    try:
        text = io.StringIO(read_file(Path(path), LARGEST_TEXT).decode())
        # reads 1e-2 as a number; YAML 1.1 does not
        content = OmegaConf.to_container(OmegaConf.load(text), resolve=False)
    except OSError as error:
        raise UsageError(
            f"Expected a config file, got {str(path)!r} ({error.strerror or error}); see conf/."
        ) from error
    except (yaml.YAMLError, UnicodeDecodeError, OmegaConfBaseException, ValueError, RecursionError) as error:
        raise UsageError(f"Expected YAML in {str(path)!r}, got {_yaml_reason(error)}; correct the file.") from error
    sections = [f.name for f in dataclasses.fields(schema)]
    if not isinstance(content, Mapping) or not any(name in content for name in sections):
        raise UsageError(
            f"Expected a config in {str(path)!r}, got none of its keys ({', '.join(sections)}); see conf/."
        )
    return {str(key): value for key, value in content.items()}


def _yaml_reason(error: Exception) -> str:
    """Describe why a text is no valid YAML, with its line."""
    if not isinstance(error, yaml.MarkedYAMLError) or error.problem is None or error.problem_mark is None:
        return one_line(error)
    mark, context = error.problem_mark, f" {error.context}" if error.context else ""
    return f"in line {mark.line + 1}, column {mark.column + 1}: {one_line(f'{error.problem}{context}')}"


Schema = TypeVar("Schema")


def checked(schema: type[Schema], content: Mapping[str, Any], overrides: Sequence[str] = ()) -> Schema:
    """Build an object of a schema from nested dictionaries and overrides; checks keys and types, but not values.

    Raises:
        UsageError: an unknown key, a missing one, or a wrong type.
    """
    for override in overrides:
        if "=" not in override.lstrip("="):
            raise UsageError(f"Expected overrides as key.sub=value, got {override!r}; put an = between key and value.")
    try:
        layers = list[dict[str, Any]]()
        for layer in (OmegaConf.create(dict(content)), OmegaConf.from_dotlist(list(overrides))):
            given: Any = OmegaConf.to_container(layer, resolve=False)
            _refuse_unknown_keys(given, schema, "")
            layers.append(_numbers_to_lists(given, schema))
            for f in dataclasses.fields(schema):  # pyright: ignore
                if f.metadata.get("folder") and re.search(r"\$\{[^}]*:", str(given.get(f.name, ""))):
                    raise UsageError(f"Expected {f.name} without ${{…:…}}, got {given[f.name]!r}; write the name out.")
        written, given = layers
        layers = [_drop_replaced(written, given, schema), given]
        merged = OmegaConf.merge(_defaults(schema), *(OmegaConf.create(layer) for layer in layers))
        config = OmegaConf.to_object(merged)
    except OmegaConfBaseException as error:
        raise UsageError(_explain(error, schema)) from error
    except TypeError as error:  # an override changes a list to a mapping, or vice versa
        raise UsageError(
            f"Expected values of the same kind in file and command, got {' '.join(overrides)!r}."
        ) from error
    except (yaml.YAMLError, RecursionError) as error:
        raise UsageError(f"Expected a YAML value after =, got {one_line(' '.join(overrides))!r}; quote it.") from error
    assert isinstance(config, schema)
    return config


@cache
def _defaults(schema: type) -> Any:
    """The fields of a schema with types and defaults, cached; merging copies them."""
    return OmegaConf.structured(schema)


def differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Full name ↦ both values of the entries in which two nested dictionaries differ; None if one is missing."""
    a, b = dict(_leaves(one)), dict(_leaves(other))
    return {key: (a.get(key), b.get(key)) for key in dict.fromkeys([*a, *b]) if a.get(key) != b.get(key)}


def _leaves(content: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in content.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _refuse_unknown_keys(content: Any, schema: Any, prefix: str) -> None:
    known = {f.name: f for f in dataclasses.fields(schema)}
    if not isinstance(content, Mapping):
        name, names = prefix.rstrip("."), ", ".join(known)
        raise UsageError(f"Expected {name} as a section with {names}, got {content!r}; indent its keys below it.")
    for key, value in content.items():
        if key not in known:
            near = difflib.get_close_matches(str(key), known, n=1, cutoff=0.5)
            names = _same_name_elsewhere(str(key), schema) or [prefix + name for name in near]
            hint = f"did you mean {names[0]}?" if names else f"choose one of {', '.join(known)}."
            raise UsageError(f"Expected a key of the schema, got unknown key {prefix}{key}; {hint}")
        section = known[key].type
        if isinstance(section, type) and dataclasses.is_dataclass(section):
            _refuse_unknown_keys(value, section, f"{prefix}{key}.")
        collection = str(section).partition("[")[0]
        if isinstance(value, {"list": Mapping, "dict": list}.get(collection, ())):
            raise UsageError(f"Expected {prefix}{key} as {section}, got {value!r}; correct its value.")
        for entry in get_args(section)[1:]:  # the section in dict[str, section]
            for name, one in value.items() if dataclasses.is_dataclass(entry) and isinstance(value, Mapping) else ():
                _refuse_unknown_keys(one, entry, f"{prefix}{key}.{name}.")


def _numbers_to_lists(content: Mapping[str, Any], schema: type, prefix: str = "") -> dict[str, Any]:
    """Replace a single number by a list of one, where a list of floats is expected.

    Raises:
        UsageError: the value is neither a list nor a number.
    """
    found = dict(content)
    for f in dataclasses.fields(schema):  # pyright: ignore
        key, value, annotation = f"{prefix}{f.name}", content.get(f.name), str(f.type)
        of_floats = annotation.startswith("list[float]")
        if isinstance(f.type, type) and dataclasses.is_dataclass(f.type):
            if isinstance(value, Mapping):
                found[f.name] = _numbers_to_lists(value, f.type, f"{key}.")
        elif of_floats and type(value) in (int, float):
            found[f.name] = [value]
        elif annotation.startswith("list["):
            _refuse_scalar(
                key, value, "a number or a list of numbers" if of_floats else "a list", f.metadata.get("doc", "")
            )
            if annotation in ("list[float]", "list[float] | None") and isinstance(value, list):
                _require_numbers(key, dict(enumerate(value)), f.metadata.get("doc", ""))
        elif annotation == "dict[str, float]":
            _require_numbers(key, value, f.metadata.get("doc", ""))
        elif annotation.startswith("dict[str, list[") and isinstance(value, Mapping):
            for name, entry in value.items():
                _refuse_scalar(f"{key}.{name}", entry, "a list", f.metadata.get("doc", ""))
    return found


def _drop_replaced(content: Mapping[str, Any], later: Mapping[str, Any], schema: type) -> dict[str, Any]:
    """Remove values that a later layer replaces and that a merge would keep in addition.

    These are lists that a mapping replaces, or mappings that a list replaces, and entries of a mapping whose name
    occurs again with another spelling of its spaces.
    """
    found = dict(content)
    for f in dataclasses.fields(schema):  # pyright: ignore
        value, other = content.get(f.name), later.get(f.name)
        if isinstance(f.type, type) and dataclasses.is_dataclass(f.type):
            if isinstance(value, Mapping) and isinstance(other, Mapping):
                found[f.name] = _drop_replaced(value, other, f.type)
        elif (
            f.metadata.get("mapping") and isinstance(value, Mapping) != isinstance(other, Mapping) and other is not None
        ):
            found.pop(f.name, None)
        elif isinstance(value, Mapping) and isinstance(other, Mapping):
            replaced = {with_underscores(name) for name in other}
            found[f.name] = {
                name: one for name, one in value.items() if name in other or with_underscores(name) not in replaced
            }
    return found


def _require_numbers(key: str, value: Any, doc: str) -> None:
    """Raise UsageError unless the value is a mapping of names to numbers, missing, or an interpolation."""
    if value is not None and not isinstance(value, Mapping | str):
        raise UsageError(f"Expected {key} as {{name: number}}, got {value!r}; correct it: {doc}")
    for name, entry in value.items() if isinstance(value, Mapping) else ():
        if not (type(entry) in (int, float) or (isinstance(entry, str) and _NUMBER.fullmatch(entry))):
            raise UsageError(f"Expected {key}.{name} as a number, got {entry!r}; correct it: {doc}")


def _refuse_scalar(key: str, value: Any, kind: str, doc: str) -> None:
    """Raise UsageError for a number, a Boolean, or a text that is neither missing nor an interpolation."""
    text = isinstance(value, str) and value != MISSING and "${" not in value
    if text or isinstance(value, int | float):
        raise UsageError(f"Expected {key} as {kind}, got {value!r}; correct it: {doc}")


def _annotations(schema: type, prefix: str = "") -> dict[str, Any]:
    """Full name ↦ type of every field."""
    found: dict[str, Any] = {}
    for f in dataclasses.fields(schema):
        if isinstance(f.type, type) and dataclasses.is_dataclass(f.type):
            found |= _annotations(f.type, f"{prefix}{f.name}.")
        else:
            found[f"{prefix}{f.name}"] = f.type
    return found


def _same_name_elsewhere(key: str, schema: type) -> list[str]:
    """The full names of fields with this name, for a key in the wrong section; those of every task come first."""
    names = [name for name in _annotations(schema) if name.split(".")[-1] == key]
    return sorted(names, key=lambda name: not name.startswith(("system.", "cost.", "initial_states.", "horizon.")))


def _explain(error: OmegaConfBaseException, schema: type) -> str:
    key = error.full_key or "a key"
    if isinstance(error, MissingMandatoryValue):
        return f"Expected a value for {key}, got none; add it to the config file or append {key}=… to the command."
    annotation = _annotations(schema).get(key.split("[")[0])
    kind = annotation.__name__ if type(annotation) is type else annotation or "another type"
    got = str(error).splitlines()[0]
    return f"Expected {key} as {kind}, got: {got}; correct its value."


def check_values(config: Any, prefix: str = "") -> None:
    """Check every field, and every entry of a section, by its declared rule."""
    for f in dataclasses.fields(config):
        key, value = f"{prefix}{f.name}", getattr(config, f.name)
        entries = {f"{key}.{name}": entry for name, entry in value.items()} if isinstance(value, dict) else {key: value}
        for name, entry in entries.items():
            if dataclasses.is_dataclass(entry):
                check_values(entry, f"{name}.")
            elif f.metadata and entry is not None:
                _check_value(name, entry, f.metadata)


def _check_value(key: str, value: Any, rule: Mapping[str, Any]) -> None:
    _check_text(key, value, rule)
    choices = rule["choices"]
    if choices and isinstance(value, list):
        for entry in value:
            _check_value(key, entry, rule)
        return
    if choices and value not in choices and not (rule["user_class"] and ":" in value):
        hint = did_you_mean(str(value), choices, "choose one of them.")
        own = ", or module:Class" if rule["user_class"] else ""
        raise UsageError(f"Expected {key} as one of {', '.join(choices)}{own}, got {value!r}; {hint}")
    holds = {">": operator.gt, "≥": operator.ge, "<": operator.lt}
    bounds = {symbol: bound for symbol, bound in rule["bounds"].items() if bound is not None}
    if bounds and isinstance(value, list) and not value:  # == is elementwise for a number of NumPy
        raise UsageError(f"Expected {key} with at least one entry, got none; correct it: {rule['doc']}")
    for symbol, bound in bounds.items():
        for number in value if isinstance(value, list) else [value]:
            if not (holds[symbol](number, bound) and math.isfinite(number)):
                raise UsageError(f"Expected {key} {symbol} {bound}, got {value}; correct it: {rule['doc']}")


def _check_text(key: str, value: Any, rule: Mapping[str, Any]) -> None:
    if rule["folder"] and (not value.isprintable() or {"", ".", ".."} & {*value.replace("\\", "/").split("/")}):
        raise UsageError(f"Expected {key} as a name, or several joined by /, got {value!r}; correct it: {rule['doc']}")
    allowed = "\n\t" if rule["lines"] else ""
    if isinstance(value, str) and any(character < " " and character not in allowed for character in value):
        raise UsageError(f"Expected {key} without control characters, got {value!r}; correct it: {rule['doc']}")
