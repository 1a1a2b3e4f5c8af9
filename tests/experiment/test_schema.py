"""The generic half of a config, on a schema of its own."""

from dataclasses import dataclass, field
from typing import Any

import pytest
from omegaconf import MISSING

from lyapnet.base.errors import UsageError
from lyapnet.experiment.schema import check_values, checked, differences, read_yaml, setting


@dataclass
class Engine:
    """A section."""

    power: float = setting(1.0, "Power in kW.", above=0)
    fuels: list[str] = setting(["petrol"], "What it burns.", choices=("petrol", "diesel"))
    driver: str = setting("nobody", "Who drives.", choices=("nobody",), user_class=True)


@dataclass
class Car:
    """A schema."""

    name: str = setting(MISSING, "Its name.")
    doors: int = setting(4, "Number of doors.", at_least=1, below=9)
    extras: dict[str, Any] = setting({}, "Anything.")
    engine: Engine = field(default_factory=Engine)


def built(content, *overrides):
    car = checked(Car, content, overrides)
    check_values(car)
    return car


def test_what_is_listed_replaces_the_defaults():
    car = built({"name": "x", "engine": {"power": 2}}, "doors=2", "extras.radio=true")
    assert car == Car("x", 2, {"radio": True}, Engine(2.0, ["petrol"]))
    assert built({"name": "y"}).extras == {}, "defaults are not shared"


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ({}, "Expected a value for name, got none"),
        ({"name": "x", "dors": 2}, "unknown key dors; did you mean doors?"),
        ({"name": "x", "power": 2}, "unknown key power; did you mean engine.power?"),
        ({"name": "x", "engine": 2}, "Expected engine as a section with power, fuels, driver, got 2"),
        ({"name": "x", "doors": "two"}, "Expected doors as int"),
        ({"name": "x", "doors": 0}, "Expected doors ≥ 1, got 0; correct it: Number of doors."),
        ({"name": "x", "doors": 9}, "Expected doors < 9, got 9"),
        ({"name": "x", "engine": {"power": 0}}, "Expected engine.power > 0, got 0"),
        ({"name": "x", "engine": {"fuels": ["petrol", "desel"]}}, "got 'desel'; did you mean diesel?"),
        ({"name": "x", "engine": {"driver": "me"}}, "one of nobody, or module:Class, got 'me'"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(content, named):
    with pytest.raises(UsageError) as raised:
        built(content)
    assert named in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_class_of_the_users_own_is_admitted_where_the_field_says_so():
    assert built({"name": "x", "engine": {"driver": "mine:Chauffeur"}}).engine.driver == "mine:Chauffeur"


def test_file_without_any_key_of_the_schema_is_refused(tmp_path):
    path = tmp_path / "car.yaml"
    path.write_text("horse: 1")
    with pytest.raises(UsageError, match=r"none of its keys \(name, doors, extras, engine\)"):
        read_yaml(path, Car)
    path.write_text("name: x\ndoors: 1e1")
    assert read_yaml(path, Car) == {"name": "x", "doors": 10.0}, "YAML 1.1 would read 1e1 as text"


def test_differences_have_full_names_and_both_values():
    one, other = {"a": 1, "b": {"c": 2, "d": 3}}, {"a": 1, "b": {"c": 4}, "e": {}}
    assert differences(one, other) == {"b.c": (2, 4), "b.d": (3, None), "e": (None, {})}
