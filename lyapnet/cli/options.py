"""Options that several commands share, and the controller that a command is given."""

import dataclasses
import functools
import inspect
import math
import sys
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from lyapnet.base.errors import UsageError
from lyapnet.claims.claim import check_number, flag_of, kind_of_number
from lyapnet.training.stage_messages import PATIENCE, StageMessages

FIRST = 1.0  # seconds after which a command first reports its stage

Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]


Checkpoint = Annotated[Path, typer.Argument(help="A checkpoint of a run, or zoo:NAME.", metavar="CKPT")]
At = Annotated[
    list[str] | None,
    typer.Option(help="A member of a family: NAME=VALUE for each parameter.", metavar="NAME=VALUE"),
]
Measured = Annotated[
    list[str] | None,
    typer.Option(
        "--outputs",
        help="With an estimator: a measured state and its noise; only the noise for the system's output(x).",
        metavar="STATE=SIGMA",
    ),
]
FirstDeviation = Annotated[
    list[float] | None,
    typer.Option(
        "--initial-deviation",
        help="Standard deviation of its first estimate: one for all states, or again for each.",
        metavar="SIGMA",
    ),
]
Delay = Annotated[
    int | None,
    typer.Option(
        help="With an estimator: steps of Δt after its readings at which a control acts (certify's is in s).",
        metavar="STEPS",
    ),
]
OWN = {
    "system": "a system", "network": "a network", "cost": "a cost", "controls": "a control set",
    "constraints": "constraints", "program": "a program",
}  # fmt: skip


@dataclass(frozen=True)
class Given:
    """The controller that a command is given: its checkpoint, the user's own parts, and the member of a family."""

    checkpoint: Path
    own: dict[str, str | None]  # the user's own parts, as module:Class, each by its option's name
    at: list[str] | None
    report: StageMessages  # reports the stage of the command
    functions: tuple[Path, Path] | None = None  # ONNX files of imported V and u; the checkpoint is then a config

    @property
    def title(self) -> str:
        """The name of the controller in tables."""
        from lyapnet.experiment.checkpoint import ZOO

        name = f"zoo:{self.checkpoint.stem}" if self.checkpoint.parent == ZOO else str(self.checkpoint)
        return ", ".join([name, *(self.at or []), *(path.name for path in self.functions or ())])

    @property
    def named(self) -> dict[str, str]:
        """The user's own parts that the command names."""
        return {part: name for part, name in self.own.items() if name is not None}

    @property
    def again(self) -> dict[str, str | None]:
        """The options that name the same controller in another command, without --at."""
        return {**self.own, **dict(zip(("value", "law"), map(str, self.functions or ()), strict=False))}

    def with_functions(self, value: Path | None, law: Path | None) -> "Given":
        """The same with V and u from ONNX files, and a config in place of the checkpoint; both files or none."""
        if value is None and law is None:
            return self
        if value is None or law is None or self.at:
            got = "--at" if self.at else "one"
            raise UsageError(f"Expected --value and --law, both and without --at, got {got}; a proof is about V and u.")
        return replace(self, functions=(value, law))

    def of(self, checkpoint: Path) -> "Given":
        """The same with another checkpoint."""
        return replace(self, checkpoint=checkpoint)

    def parts(self) -> Any:
        """The user's own parts, made with the config of the checkpoint."""
        from lyapnet.controller.loading import config_of
        from lyapnet.experiment.assembly import Parts, parts_named
        from lyapnet.experiment.checkpoint import read_checkpoint

        if not self.named:
            return Parts()
        return parts_named(config_of(read_checkpoint(self.checkpoint), self.checkpoint), self.named)

    def load(self) -> Any:
        """The controller."""
        import torch

        from lyapnet.base.threads import use_threads
        from lyapnet.controller.loading import load
        from lyapnet.experiment.assembly import DTYPES

        self.report(f"loading {self.title}")
        if self.functions is None:
            controller = load(self.checkpoint, **vars(self.parts()))
        else:
            from lyapnet.exchange.importing import imported_controller

            controller = imported_controller(self.checkpoint, *self.functions, self.named)
        use_threads(controller.config.training.threads)
        torch.set_default_dtype(DTYPES[controller.config.training.precision])  # until the command ends
        return choose_member(controller, self.at) if self.at else controller


def make_stages(name: str) -> StageMessages:
    """Messages on stderr about the stages of a command; short stages are not reported.

    They go to the stderr from before the command, which remains when an oracle redirects stderr during a search.
    """
    return StageMessages(Console(file=sys.stderr, highlight=False, markup=False), name, PATIENCE, FIRST)


def with_controller_options(command: Callable[..., None]) -> Callable[..., None]:
    """Replace the parameter of type Given of a command by the options CKPT, --system and other parts, and --at.

    A parameter that is another dataclass is replaced by an option for each field; see options_of.
    """
    parameters = list(inspect.signature(command).parameters.values())
    (given,) = (parameter.name for parameter in parameters if parameter.annotation is Given)
    written = {parameter.name for parameter in parameters}
    groups: dict[str, tuple[Any, list[inspect.Parameter]]] = {
        parameter.name: (parameter.annotation, options_of(parameter.annotation, written))
        for parameter in parameters if parameter.name != given and dataclasses.is_dataclass(parameter.annotation)
    }  # fmt: skip

    @functools.wraps(command)
    def run(**options: Any) -> None:
        own, checkpoint = {name: options.pop(name) for name in OWN}, options.pop("checkpoint")
        for name, (made, each) in groups.items():
            taken = {option.name: options.pop(option.name) for option in each}
            options[name] = made(**{name: _read(name, value) for name, value in taken.items()})
        with make_stages(command.__name__) as report:
            report(f"importing torch for {checkpoint}")
            import torch

            from lyapnet.experiment.checkpoint import locate_checkpoint  # takes seconds

            before = torch.get_default_dtype()
            try:
                command(**{given: Given(locate_checkpoint(checkpoint), own, options.pop("at"), report)}, **options)
            finally:
                torch.set_default_dtype(before)

    def keyword(name: str, annotation: Any, **more: Any) -> inspect.Parameter:
        return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, annotation=annotation, **more)

    taken = list[inspect.Parameter]()
    for parameter in parameters:
        if parameter.name == given:
            taken.append(keyword("checkpoint", Checkpoint))
        elif parameter.name in groups:
            taken += groups[parameter.name][1]
        else:
            taken.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))
    named = (
        keyword(name, Annotated[str | None, typer.Option(help=f"module:Class of {what} of your own.")], default=None)
        for name, what in OWN.items()
    )
    taken[-1:] = [*named, keyword("at", At, default=None), taken[-1]]  # the last one is --debug
    vars(run)["__signature__"] = inspect.Signature(taken)
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in taken}
    return run


def options_of(cls: Any, written: Container[str] = ()) -> list[inspect.Parameter]:
    """The options of the command line for the fields of a dataclass.

    A field declared with lyapnet.claims.claim.option has its help, its rule and its name from there; any other is
    declared as Annotated[…, typer.Option(…)].

    Args:
        written: names of the command's other parameters; fields with these names are left out.
    """
    return [
        inspect.Parameter(f.name, inspect.Parameter.KEYWORD_ONLY, annotation=_annotation(f), default=f.default)
        for f in dataclasses.fields(cls)
        if f.name not in written and flag_of(f) is not None
    ]


def _annotation(f: dataclasses.Field[Any]) -> Any:
    """The type of a field as an option of the command line, with its rule."""
    if "doc" not in f.metadata:
        return f.type
    name, kind, rule = f"--{flag_of(f)}", kind_of_number(f), f.metadata
    if isinstance(f.default, bool):
        return Annotated[bool, typer.Option(name, help=rule["doc"])]
    if kind is None:
        several, _ = READ[f.name]
        texts = list[str] if several else str
        return Annotated[texts | None, typer.Option(name, help=rule["doc"], metavar=rule["metavar"])]

    def checked(value: float | None) -> float | None:
        check_number(f, value, name)
        return value

    least = rule["bounds"][1] if kind is int else None
    return Annotated[f.type, typer.Option(name, help=rule["doc"], min=least, callback=checked)]


def _read(name: str, value: Any) -> Any:
    """Read the value of a field from that of its option."""
    return READ[name][1](value) if name in READ and value is not None else value


def read_set(text: str, name: str = "set") -> list[list[float]]:
    """Read "-1:1,-0.7:0.7": [lower, upper], bounds of each state in the order of the system.

    Args:
        name: the name of the option in the message.

    Raises:
        UsageError: these are no bounds.
    """
    try:
        lower, upper = zip(*((float(low), float(high)) for low, high in _pairs(text)), strict=True)
        if not all(-math.inf < low <= high < math.inf for low, high in zip(lower, upper, strict=True)):
            raise ValueError("no bounds")
    except ValueError as error:
        raise UsageError(
            f"Expected --{name} as lower:upper for each state, got {text!r}; for example --{name}=-1.6:1.6,-2.6:2.6."
        ) from error
    return [list(lower), list(upper)]


def _pairs(text: str) -> list[list[str]]:
    return [part.split(":") for part in text.split(",")]


def read_numbers(named: Sequence[str], option: str = "--disturbance STATE=W") -> dict[str, float]:
    """Read ["velocity=0.1"]: a number for each state, such as the largest disturbance of its derivative.

    Args:
        option: the option and its placeholder in the message.

    Raises:
        UsageError: no number, or a state that is named twice.
    """
    found = dict[str, float]()
    for text in named:
        name, _, value = text.partition("=")
        if name in found:
            raise UsageError(f"Expected {option} once for each state, got {name} twice; leave one of them out.")
        try:
            found[name] = float(value)
        except ValueError as error:
            raise UsageError(f"Expected {option} with a number, got {text!r}; for example {name}=0.1.") from error
    return found


def read_intervals(named: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Read ["mass=0.9:1.1"]: the ends of an interval for each parameter.

    Raises:
        UsageError: no interval, or a parameter that is named twice.
    """
    found = dict[str, tuple[float, float]]()
    for text in named:
        name, _, interval = text.partition("=")
        try:
            lower, upper = (float(end) for end in interval.split(":"))
        except ValueError as error:
            raise UsageError(
                f"Expected --parameter NAME=LOWER:UPPER with two numbers, got {text!r}; for example mass=0.9:1.1."
            ) from error
        if name in found:
            raise UsageError(f"Expected --parameter once for each parameter, got {name} twice; leave one of them out.")
        found[name] = (lower, upper)
    return found


READ: dict[str, tuple[bool, Callable[[Any], Any]]] = {
    "states": (False, read_set), "target": (False, partial(read_set, name="target")),
    "avoid": (True, lambda texts: [read_set(text, "avoid") for text in texts]), "disturbance": (True, read_numbers),
    "noise": (True, partial(read_numbers, option="--noise STATE=SIGMA")), "parameters": (True, read_intervals),
    "time": (False, str), "measured": (True, partial(read_numbers, option="--measured STATE=E")),
    "quantised": (True, partial(read_numbers, option="--quantised CONTROL=STEP")), "file": (False, Path),
}  # fmt: skip
"""A field that is no number ↦ whether its option may be repeated, and the function that reads its text."""


def choose_member(controller: Any, at: list[str]) -> Any:
    """The controller of a member of a family, from NAME=VALUE of its parameters."""
    try:
        parameters = {name: float(value) for name, _, value in (each.partition("=") for each in at)}
    except ValueError as error:
        raise UsageError(f"Expected --at NAME=VALUE with a number, got {' '.join(at)}; as in --at mass=0.9.") from error
    if len(parameters) < len(at):
        raise UsageError(f"Expected --at once for each parameter, got {' '.join(at)}; leave one of them out.")
    return controller.with_(**parameters)


def add_estimator(
    controller: Any, outputs: list[str], kind: str, deviation: list[float] | None, delay: int | None
) -> Any:
    """The controller with an estimator, for the outputs of the command or else of the config; None without outputs."""
    if not outputs:
        if controller.measures_outputs:
            return controller.with_estimator(kind, initial_deviation=deviation or None, delay=delay)
        if kind != "ekf" or deviation or delay is not None:
            raise UsageError(
                "Expected --outputs, or outputs in the run's YAML, with --estimator, --initial-deviation and --delay, "
                "got none; name what is measured: --outputs STATE=SIGMA."
            )
        return None
    named = [text.rpartition("=") for text in outputs]
    try:
        noise = [float(value) for _, _, value in named]
    except ValueError as error:
        raise UsageError(
            f"Expected --outputs STATE=SIGMA with a number, got {' '.join(outputs)}; as in --outputs angle=0.01."
        ) from error
    states = [name for name, _, _ in named if name]
    if states and len(states) < len(named):
        raise UsageError(f"Expected --outputs STATE=SIGMA for each, got {' '.join(outputs)}; name the state of each.")
    return controller.with_estimator(
        kind, measure=states, noise=noise, initial_deviation=deviation or None, delay=delay
    )
