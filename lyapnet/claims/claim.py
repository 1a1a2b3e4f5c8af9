"""A claim as data: a dataclass whose fields are its options, each with a sentence and a rule."""

import dataclasses
import math
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Any, ClassVar, get_args

from lyapnet.base.errors import UsageError

if TYPE_CHECKING:  # importing torch takes seconds, and the options of the command line need none of it
    from torch import Generator

    from lyapnet.claims.certificates import Certificate
    from lyapnet.controller.controller import Controller
    from lyapnet.prover.branch_and_bound import Budget
    from lyapnet.prover.proof import Progress


def option(
    default: Any,
    doc: str,
    *,
    above: float | None = None,
    at_least: float | None = None,
    below: float | None = None,
    at_most: float | None = None,
    remedy: str = "correct it",
    flag: str | None = "",
    metavar: str | None = None,
) -> Any:
    """A field of a claim, with its sentence and the numbers that it admits; only finite ones are.

    Args:
        remedy: what to do about another number, for the message that refuses it.
        flag: its name on the command line; that of the field if empty, and none if None.
        metavar: what help calls its value.
    """
    rule = {"doc": doc, "bounds": (above, at_least, below, at_most), "remedy": remedy, "flag": flag, "metavar": metavar}
    return field(default=default, metadata=rule)


def flag_of(f: dataclasses.Field[Any]) -> str | None:
    """The name of an option on the command line, without dashes; None where it has none there."""
    flag = f.metadata.get("flag", "")
    return f.name.replace("_", "-") if flag == "" else flag


def kind_of_number(f: dataclasses.Field[Any]) -> type | None:
    """int or float, for a field that holds one."""
    kinds = _types_of(f) - {NoneType, "None"}
    return next((kind for kind in (int, float) if kinds in ({kind}, {kind.__name__})), None)


def _types_of(f: dataclasses.Field[Any]) -> set[Any]:
    """The types of a union; by their names in a module in which annotations are not evaluated."""
    if isinstance(f.type, str):
        return {name.strip() for name in re.sub(r"Optional\[(.*)\]", r"\1 | None", f.type).split("|")}
    return {*(get_args(f.type) or (f.type,))}


def check_number(f: dataclasses.Field[Any], value: Any, name: str) -> None:
    """Refuse what a field does not admit.

    Args:
        name: what the message calls the option.
    """
    if kind_of_number(f) is None or (value is None and {NoneType, "None"} & _types_of(f)):
        return
    above, at_least, below, at_most = f.metadata.get("bounds", [None] * 4)
    remedy = f.metadata.get("remedy", "correct it")
    if isinstance(value, bool) or not isinstance(value, int if kind_of_number(f) is int else int | float):
        raise UsageError(f"Expected {name} as a number, got {value!r}; {remedy}.")
    low, high = (-math.inf if above is None else above), (math.inf if below is None else below)
    holds = low < value < high and not (at_least is not None and value < at_least)
    if not holds or (at_most is not None and value > at_most):
        raise UsageError(f"Expected {name} {_expected(f)}, got {value:g}; {remedy}.")


def _expected(f: dataclasses.Field[Any]) -> str:
    """The numbers that a field admits, in words."""
    above, at_least, below, at_most = f.metadata.get("bounds", [None] * 4)
    if above is not None and below is not None:
        return f"strictly between {above:g} and {below:g}"
    if above is not None and at_most is not None:
        return f"in ({above:g}, {at_most:g}]"
    bounds = ((">", above), ("≥", at_least), ("<", below), ("≤", at_most))
    return " and ".join(f"{sign} {bound:g}" for sign, bound in bounds if bound is not None) or "as a finite number"


@dataclass(frozen=True, kw_only=True)
class Run:
    """What a claim may use: seconds, processes, a seed, a file, and whom it tells of its progress.

    Args:
        budget: seconds, workers and where they work.
        seed: of all that is drawn.
        keep: a file in which a proof is kept, and from which it goes on.
        report: is told how far a proof is.
        two_sided: whether a bound from below is sought afterwards.
    """

    budget: "Budget"
    seed: int = 0
    keep: Path | None = None
    report: "Callable[[Progress], None] | None" = None
    two_sided: bool = False

    @property
    def generator(self) -> "Generator":
        """That of the seed, from its beginning."""
        from lyapnet.base.random_streams import CERTIFICATION, stream

        return stream(self.seed, CERTIFICATION)

    def share(self, share: float) -> "Run":
        """The same for the first of two sides, with a share of the seconds."""
        stop = type(self.budget.stop)()  # of its own: a signal between the two sides stops at once
        budget = replace(self.budget, seconds=share * self.budget.seconds, stop=stop)
        return replace(self, budget=budget, two_sided=True)

    def require_used_by(self, claim: "Claim") -> None:
        """Refuse means that a claim has no use for.

        Raises:
            UsageError: there are some.
        """
        given = {name: value for name, value in self._means.items() if value not in (None, "cpu")}
        for name in given.keys() - {"seconds", "workers", *claim.means}:
            raise UsageError(f"Expected no {name} for a {claim.kind} claim, got {given[name]!r}; leave it out.")

    @property
    def _means(self) -> dict[str, Any]:
        """Plain data, by the names of the command line."""
        budget, keep = self.budget, None if self.keep is None else str(self.keep)
        return {
            "seconds": budget.seconds, "workers": budget.workers, "device": budget.device, "ray": budget.ray,
            "keep": keep,
        }  # fmt: skip

    def options(self, claim: "Claim", **more: Any) -> dict[str, Any]:
        """All that a certificate was made with, as plain data by the names of the command line."""
        used = {name: value for name, value in self._means.items() if name in claim.means}
        return {**claim.options, **more, **used, "seed": self.seed}


@dataclass(frozen=True, kw_only=True)
class Claim(ABC):
    """What is claimed of a controller: `lyapnet.certify(controller, claim)` tries to establish it.

    A kind of claim is a dataclass of this class. Its fields are its options, declared with `option`; from them come
    the options of the command line, of the report and of the table in the docs.

    Raises:
        UsageError: a field does not admit its value.
    """

    kind: ClassVar[str]  # what certificates and reports call it
    means: ClassVar[Sequence[str]] = ("seconds", "workers", "device", "ray", "keep")  # of a run, which it can use
    share_of_two: ClassVar[float | None] = None  # of the seconds, beside a bound from below; None: it bounds no cost

    def __post_init__(self) -> None:
        for f in dataclasses.fields(self):
            check_number(f, getattr(self, f.name), f.name)
        states = getattr(self, "states", None)  # a set, where a claim has one
        if states is not None:
            sides_of(states)
        _check_names("disturbance", getattr(self, "disturbance", None), _is_number, '{"velocity": 0.1}')
        _check_names("parameters", getattr(self, "parameters", None), _is_interval, '{"mass": (0.9, 1.1)}')

    @abstractmethod
    def establish(self, controller: "Controller", run: Run) -> "Certificate":
        """What can be said of a controller with the means of a run.

        Raises:
            UsageError: the claim does not fit the controller.
        """

    @property
    def options(self) -> dict[str, Any]:
        """Its fields as plain data, by their names on the command line: numbers, texts as they are written there."""
        given = {flag: (f.name, getattr(self, f.name)) for flag, f in flags_of(type(self))}
        return {flag: _plain(name, value) for flag, (name, value) in given.items()}


def _check_names(option: str, given: Any, holds: Callable[[Any], bool], example: str) -> None:
    """Refuse what is no mapping of names to values of a kind."""
    fits = isinstance(given, Mapping) and all(isinstance(name, str) and holds(each) for name, each in given.items())
    if given is not None and not fits:
        raise UsageError(f"Expected {option} as numbers by name, got {given!r}; for example {example}.")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_interval(value: Any) -> bool:
    return isinstance(value, Sequence) and len(value) == 2 and all(map(_is_number, value))


def flags_of(claim: type) -> Iterator[tuple[str, dataclasses.Field[Any]]]:
    """The names of options on the command line, and their fields."""
    for f in dataclasses.fields(claim):
        flag = flag_of(f)
        if flag is not None:
            yield flag, f


def _plain(name: str, value: Any) -> Any:
    """A number, None, or what the command line takes: "-1:1,-2:2" for states, ["mass=0.9:1.1"] for a mapping."""
    if isinstance(value, Mapping):
        return [f"{name}={_written(entry)}" for name, entry in value.items()] or None
    if value is None or isinstance(value, bool | int | float | str):
        return value
    return ",".join(_written(ends) for ends in zip(*sides_of(value), strict=True)) if name == "states" else repr(value)


def _written(value: Any) -> str:
    """A number, or the two ends of an interval, without loss."""
    ends = value if isinstance(value, Sequence) else [value]
    return ":".join(f"{float(end)!r}".removesuffix(".0") for end in ends)


def is_same(one: Any, other: Any) -> bool:
    """Whether two values of an option are equal, sets by their sides."""
    if isinstance(one, int | float) or one is None or other is None:
        return one == other
    return sides_of(one) == sides_of(other)


def sides_of(states: Any) -> tuple[list[float], list[float]]:
    """(lower, upper) of a Box or of [[lower, …], [upper, …]].

    Raises:
        UsageError: it is neither.
    """
    try:
        sides = states if isinstance(states, Sequence) else (states.lower.tolist(), states.upper.tolist())
        lower, upper = ([float(end) for end in side] for side in sides)
        if not lower or not all(-math.inf < low <= high < math.inf for low, high in zip(lower, upper, strict=True)):
            raise ValueError("ends that are none")
    except (AttributeError, TypeError, ValueError) as error:
        raise UsageError(
            f"Expected states as a lyapnet.Box or [[lower, …], [upper, …]], got {states!r}; for example "
            "[[-1.6, -2.6], [1.6, 2.6]]."
        ) from error
    return lower, upper
