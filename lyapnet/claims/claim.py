"""A claim as data: a dataclass whose fields are its options, each with a description and a rule."""

import dataclasses
import math
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Any, ClassVar, get_args

from lyapnet.base.errors import UsageError

if TYPE_CHECKING:  # importing torch takes seconds, and the options of the command line do not need it
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
    check: Callable[[Any], object] | None = None,
    flag: str | None = "",
    metavar: str | None = None,
) -> Any:
    """A field of a claim, with its description and its range of finite numbers.

    Args:
        remedy: advice in the error message for a number outside the range.
        check: raises a UsageError for a value that is not allowed; not called for None.
        flag: the name on the command line; the name of the field if empty; None for a field without one.
        metavar: the placeholder of the value in the help text.
    """
    rule = {"doc": doc, "bounds": (above, at_least, below, at_most), "remedy": remedy, "check": check}
    return field(default=default, metadata={**rule, "flag": flag, "metavar": metavar})


def flag_of(f: dataclasses.Field[Any]) -> str | None:
    """The name of an option on the command line, without dashes; None if it is no option there."""
    flag = f.metadata.get("flag", "")
    return f.name.replace("_", "-") if flag == "" else flag


def kind_of_number(f: dataclasses.Field[Any]) -> type | None:
    """int or float for a field that holds a number, else None."""
    kinds = _types_of(f) - {NoneType, "None"}
    return next((kind for kind in (int, float) if kinds in ({kind}, {kind.__name__})), None)


def _types_of(f: dataclasses.Field[Any]) -> set[Any]:
    """The types in a field's annotation; their names if the annotation is a string."""
    if isinstance(f.type, str):
        return {name.strip() for name in re.sub(r"Optional\[(.*)\]", r"\1 | None", f.type).split("|")}
    return {*(get_args(f.type) or (f.type,))}


def check_number(f: dataclasses.Field[Any], value: Any, name: str) -> None:
    """Refuse a number that a field does not allow.

    Args:
        name: the name of the option in the message.
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
        raise UsageError(f"Expected {name} {_allowed_numbers(f)}, got {value:g}; {remedy}.")


def _allowed_numbers(f: dataclasses.Field[Any]) -> str:
    """The numbers that a field allows, in words."""
    above, at_least, below, at_most = f.metadata.get("bounds", [None] * 4)
    if above is not None and below is not None:
        return f"strictly between {above:g} and {below:g}"
    if above is not None and at_most is not None:
        return f"in ({above:g}, {at_most:g}]"
    bounds = ((">", above), ("≥", at_least), ("<", below), ("≤", at_most))
    return " and ".join(f"{sign} {bound:g}" for sign, bound in bounds if bound is not None) or "as a finite number"


@dataclass(frozen=True, kw_only=True)
class Run:
    """The resources of one certification: time, processes, seed, proof file and progress callback.

    Args:
        budget: seconds, number of workers and their device.
        seed: of all random numbers.
        keep: a file for the proof, from which a later run resumes.
        report: called with the progress of the proof.
        two_sided: whether a bound from below will be proved next.
    """

    budget: "Budget"
    seed: int = 0
    keep: Path | None = None
    report: "Callable[[Progress], None] | None" = None
    two_sided: bool = False

    @property
    def generator(self) -> "Generator":
        """A new random generator from the seed."""
        from lyapnet.base.random_streams import CERTIFICATION, stream

        return stream(self.seed, CERTIFICATION)

    def share(self, share: float) -> "Run":
        """The run of the first of two sides, with a share of the seconds."""
        stop = type(self.budget.stop)()  # a separate object: a signal between the two sides stops at once
        budget = replace(self.budget, seconds=share * self.budget.seconds, stop=stop)
        return replace(self, budget=budget, two_sided=True)

    def require_used_by(self, claim: "Claim") -> None:
        """Refuse resources that a claim cannot use.

        Raises:
            UsageError: some are given.
        """
        given = {name: value for name, value in self._resources.items() if value not in (None, "cpu")}
        for name in given.keys() - {"seconds", "workers", *claim.means}:
            raise UsageError(f"Expected no {name} for a {claim.kind} claim, got {given[name]!r}; leave it out.")

    @property
    def _resources(self) -> dict[str, Any]:
        """The resources as plain data, by their names on the command line."""
        budget, keep = self.budget, None if self.keep is None else str(self.keep)
        return {
            "seconds": budget.seconds, "workers": budget.workers, "device": budget.device, "ray": budget.ray,
            "keep": keep,
        }  # fmt: skip

    def options(self, claim: "Claim", **more: Any) -> dict[str, Any]:
        """All options of a certificate as plain data, by their names on the command line."""
        used = {name: value for name, value in self._resources.items() if name in claim.means}
        return {**claim.options, **more, **used, "seed": self.seed}


@dataclass(frozen=True, kw_only=True)
class Claim(ABC):
    """A statement about a controller; `lyapnet.certify(controller, claim)` tries to establish it.

    Each kind of claim is a dataclass derived from this class. Its fields are its options, declared with `option`; the
    command line, the report and the docs take their options from them.

    Raises:
        UsageError: a field does not allow its value.
    """

    kind: ClassVar[str]  # its name in certificates and reports
    means: ClassVar[Sequence[str]] = ("seconds", "workers", "device", "ray", "keep")  # resources of a run that it uses
    allows_noise: ClassVar[bool] = False  # whether the task may have noise
    allows_reference: ClassVar[bool] = False  # whether the goal may move along a reference
    allows_any_dynamics: ClassVar[bool] = False  # whether the system need not be control-affine
    share_of_two: ClassVar[float | None] = None
    """Share of the seconds, if a bound of the cost from below follows; None if the claim bounds no cost from above."""

    def __post_init__(self) -> None:
        for f in dataclasses.fields(self):
            value, check = getattr(self, f.name), f.metadata.get("check")
            check_number(f, value, f.name)
            if check is not None and value is not None:
                check(value)

    def require_law(self, controller: "Controller") -> None:  # noqa: B027, most claims take any law
        """Refuse a control law that claims of this kind cannot bound, before anything is computed.

        Raises:
            UsageError: this kind does not cover the cost of the controls or their set.
        """

    @abstractmethod
    def establish(self, controller: "Controller", run: Run) -> "Certificate":
        """Try to establish the claim for a controller with the resources of a run.

        Raises:
            UsageError: the claim does not fit the controller.
        """

    @property
    def options(self) -> dict[str, Any]:
        """The fields as plain data, by their names on the command line: numbers, and texts in the syntax used there."""
        given = {flag: (f.name, getattr(self, f.name)) for flag, f in flags_of(type(self))}
        return {flag: _plain(name, value) for flag, (name, value) in given.items()}


def check_disturbance(value: Any) -> None:
    """Refuse a value that is not a mapping from names to numbers."""
    if not isinstance(value, Mapping) or not all(isinstance(n, str) and _is_number(w) for n, w in value.items()):
        raise UsageError(f'Expected disturbance as numbers by name, got {value!r}; for example {{"velocity": 0.1}}.')


def check_reading(value: Any) -> None:
    """Refuse a value that is no name of a way to read a law."""
    if value not in READ_AT:
        raise UsageError(
            f"Expected time as {', '.join(READ_AT[:-1])} or {READ_AT[-1]}, got {value!r}; name one of them."
        )


READ_AT = ("continuous", "held", "steps")
"""When u is read: at every t; at certain times, and held in between; or at each step of the model, and held over it."""


def check_errors(value: Any) -> None:
    """Refuse a value that is not a mapping from names to finite numbers ≥ 0."""
    if not _are_sizes(value):
        raise UsageError(f'Expected errors as numbers ≥ 0 by name, got {value!r}; for example {{"velocity": 0.01}}.')


def check_noise(value: Any) -> None:
    """Refuse a value that is not a mapping from names to numbers ≥ 0, one of them positive."""
    if not _are_sizes(value) or not any(value.values()):
        raise UsageError(f'Expected noise as numbers ≥ 0 by name, got {value!r}; for example {{"velocity": 0.1}}.')


def check_boxes(value: Any) -> None:
    """Refuse a value that is not a sequence of sets of states."""
    if not isinstance(value, Sequence) or isinstance(value, str):
        raise UsageError(f"Expected a list of boxes to avoid, got {value!r}; for example [[[-2, 1], [-1, 2]]].")
    for each in value:
        sides_of(each)


def check_parameters(value: Any) -> None:
    """Refuse a value that is not a mapping from names to closed intervals [lower, upper]."""
    if not isinstance(value, Mapping) or not all(isinstance(n, str) and _is_interval(i) for n, i in value.items()):
        raise UsageError(
            f"Expected parameters as finite numbers (lower, upper) by name, with lower ≤ upper, got {value!r}; for "
            'example {"mass": (0.9, 1.1)}.'
        )


def _are_sizes(value: Any) -> bool:
    """Whether a value is a mapping from names to finite numbers ≥ 0."""
    usable = isinstance(value, Mapping) and all(isinstance(n, str) and _is_number(s) for n, s in value.items())
    return usable and all(0 <= size < math.inf for size in value.values())


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_interval(value: Any) -> bool:
    is_pair = isinstance(value, Sequence) and len(value) == 2 and all(map(_is_number, value))
    return is_pair and -math.inf < value[0] <= value[1] < math.inf


def flags_of(claim: type) -> Iterator[tuple[str, dataclasses.Field[Any]]]:
    """(name on the command line, field) for each option that has one there."""
    for f in dataclasses.fields(claim):
        flag = flag_of(f)
        if flag is not None:
            yield flag, f


def _plain(name: str, value: Any) -> Any:
    """A number, None, or text as on the command line: "-1:1,-2:2" for a box, ["mass=0.9:1.1"] for a mapping."""
    if isinstance(value, Mapping):
        return [f"{name}={_format_numbers(entry)}" for name, entry in value.items()] or None
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if name in BOXES:
        return _format_box(value)
    return [_format_box(each) for each in value] or None if name in LISTS_OF_BOXES else repr(value)


BOXES, LISTS_OF_BOXES = ("states", "target"), ("avoid",)
"""Fields that hold a set of states, and fields that hold several."""


def _format_box(value: Any) -> str:
    return ",".join(_format_numbers(ends) for ends in zip(*sides_of(value), strict=True))


def _format_numbers(value: Any) -> str:
    """A number, or the two ends of an interval, as text that keeps every digit."""
    ends = value if isinstance(value, Sequence) else [value]
    return ":".join(f"{float(end)!r}".removesuffix(".0") for end in ends)


def is_same(one: Any, other: Any) -> bool:
    """Whether two values of an option are equal; sets of states are equal if their bounds are."""
    if isinstance(one, int | float) or one is None or other is None:
        return one == other
    return sides_of(one) == sides_of(other)


def sides_of(states: Any) -> tuple[list[float], list[float]]:
    """The bounds (lower, upper) of a Box or of [[lower, …], [upper, …]].

    Raises:
        UsageError: states is neither of the two.
    """
    try:
        sides = states if isinstance(states, Sequence) else (states.lower.tolist(), states.upper.tolist())
        lower, upper = ([float(end) for end in side] for side in sides)
        if not lower or not all(-math.inf < low <= high < math.inf for low, high in zip(lower, upper, strict=True)):
            raise ValueError("invalid bounds")
    except (AttributeError, TypeError, ValueError) as error:
        raise UsageError(
            f"Expected states as a lyapnet.Box or [[lower, …], [upper, …]], got {states!r}; for example "
            "[[-1.6, -2.6], [1.6, 2.6]]."
        ) from error
    return lower, upper


@dataclass(frozen=True, kw_only=True)
class ReadAtTimes(Claim):
    """A claim about a law that is read at every t; or at certain times and held in between, with a delay and errors."""

    time: str | None = option(
        None, "When u is read: continuous, at every t; held, each Δt; or steps, a claim about steps of the model.",
        metavar="WHEN", check=check_reading,
    )  # fmt: skip
    interval: float | None = option(
        None, "Seconds between two readings of u; Δt if none.", above=0, remedy="give it in s"
    )  # fmt: skip
    jitter: float = option(
        0.0, "Share of this time by which a reading may be later.", at_least=0, remedy="0.1 is 10 % of the interval"
    )  # fmt: skip
    delay: float = option(
        0.0, "Seconds from a reading to the use of its control, at most.", at_least=0, remedy="give it in s"
    )  # fmt: skip
    measured: Mapping[str, float] | None = option(
        None, "The largest error of a state where it is read; may be repeated.", metavar="STATE=E",
        check=check_errors,
    )  # fmt: skip
    quantised: Mapping[str, float] | None = option(
        None, "The step to which a control is rounded; may be repeated.", metavar="CONTROL=STEP", check=check_errors
    )  # fmt: skip
