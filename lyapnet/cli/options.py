"""What several commands share: options, and the controller that a command is given."""

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

FIRST = 1.0  # seconds after which a command says what it is doing

Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]


Checkpoint = Annotated[Path, typer.Argument(help="A checkpoint of a run, or zoo:NAME.", metavar="CKPT")]
At = Annotated[
    list[str] | None,
    typer.Option(help="Of a family, one member: NAME=VALUE for each parameter.", metavar="NAME=VALUE"),
]
Measured = Annotated[
    list[str] | None,
    typer.Option(
        "--outputs",
        help="With an estimator: a measured state and its noise; of the system's output(x), only the noise.",
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
    """The controller that a command is given: its checkpoint, the user's own parts, and of a family one member."""

    checkpoint: Path
    own: dict[str, str | None]  # the user's own parts, as module:Class, each by its option's name
    at: list[str] | None
    report: StageMessages  # is told what is being done
    functions: tuple[Path, Path] | None = None  # ONNX files of V and u made elsewhere; the checkpoint is a config then

    @property
    def title(self) -> str:
        """What a table calls the controller."""
        from lyapnet.experiment.checkpoint import ZOO

        name = f"zoo:{self.checkpoint.stem}" if self.checkpoint.parent == ZOO else str(self.checkpoint)
        return ", ".join([name, *(self.at or []), *(path.name for path in self.functions or ())])

    @property
    def named(self) -> dict[str, str]:
        """The user's own parts that the command names."""
        return {part: name for part, name in self.own.items() if name is not None}

    @property
    def again(self) -> dict[str, str | None]:
        """The options that give the same controller again, but for --at."""
        return {**self.own, **dict(zip(("value", "law"), map(str, self.functions or ()), strict=False))}

    def with_functions(self, value: Path | None, law: Path | None) -> "Given":
        """The same with V and u of their own files, where there are both; a config in the place of a checkpoint."""
        if value is None and law is None:
            return self
        if value is None or law is None or self.at:
            got = "--at" if self.at else "one"
            raise UsageError(f"Expected --value and --law, both and without --at, got {got}; a proof is about V and u.")
        return replace(self, functions=(value, law))

    def of(self, checkpoint: Path) -> "Given":
        """The same of another checkpoint."""
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
        return member_of(controller, self.at) if self.at else controller


def stages_of(name: str) -> StageMessages:
    """What tells on stderr what a command is doing, from before torch is imported; what is quickly done is not told.

    It keeps to the stderr of the command, which an oracle hides from others while it searches.
    """
    return StageMessages(Console(file=sys.stderr, highlight=False, markup=False), name, PATIENCE, FIRST)


def of_a_controller(command: Callable[..., None]) -> Callable[..., None]:
    """A command with a Given among its parameters, as one with CKPT in its place, --system and its like, and --at.

    A parameter of another dataclass stands for an option of each of its fields; see options_of.
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
        with stages_of(command.__name__) as report:
            report(f"importing torch for {checkpoint}")
            import torch

            from lyapnet.experiment.checkpoint import located  # takes seconds

            before = torch.get_default_dtype()
            try:
                command(**{given: Given(located(checkpoint), own, options.pop("at"), report)}, **options)
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
    """The options of the command line that the fields of a dataclass stand for.

    A field declared with lyapnet.claims.claim.option has its sentence, its rule and its name from there; any other says
    itself what it is, as Annotated[…, typer.Option(…)].

    Args:
        written: parameters that a command has by itself, which stand for no field.
    """
    return [
        inspect.Parameter(f.name, inspect.Parameter.KEYWORD_ONLY, annotation=_annotation(f), default=f.default)
        for f in dataclasses.fields(cls)
        if f.name not in written and flag_of(f) is not None
    ]


def _annotation(f: dataclasses.Field[Any]) -> Any:
    """A field as an option of the command line, with its rule."""
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
    """The value of a field from what its option was given."""
    return READ[name][1](value) if name in READ and value is not None else value


def read_set(text: str, name: str = "set") -> list[list[float]]:
    """[lower, upper] of "-1:1,-0.7:0.7": bounds of each state, in the order of the system.

    Args:
        name: the name of the option in the message.

    Raises:
        UsageError: there are none.
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


def read_pushes(named: Sequence[str], option: str = "--disturbance STATE=W") -> dict[str, float]:
    """The number of each state by its name, from "velocity=0.1": the largest push on its derivative, or another.

    Args:
        option: the option and its placeholder in the message.

    Raises:
        UsageError: no number, or a state stands there twice.
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
    """The ends of each parameter's interval, by its name, from "mass=0.9:1.1".

    Raises:
        UsageError: what is named is no interval, or stands there twice.
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
    "avoid": (True, lambda texts: [read_set(text, "avoid") for text in texts]), "disturbance": (True, read_pushes),
    "noise": (True, partial(read_pushes, option="--noise STATE=SIGMA")), "parameters": (True, read_intervals),
    "time": (False, str), "measured": (True, partial(read_pushes, option="--measured STATE=E")),
    "quantised": (True, partial(read_pushes, option="--quantised CONTROL=STEP")), "file": (False, Path),
}  # fmt: skip
"""A field that is no number ↦ whether its option may be given again, and how its text is read."""


def member_of(controller: Any, at: list[str]) -> Any:
    """The controller of one member of a family, from NAME=VALUE of its parameters."""
    try:
        parameters = {name: float(value) for name, _, value in (each.partition("=") for each in at)}
    except ValueError as error:
        raise UsageError(f"Expected --at NAME=VALUE with a number, got {' '.join(at)}; as in --at mass=0.9.") from error
    if len(parameters) < len(at):
        raise UsageError(f"Expected --at once for each parameter, got {' '.join(at)}; leave one of them out.")
    return controller.with_(**parameters)


def estimator_of(
    controller: Any, outputs: list[str], kind: str, deviation: list[float] | None, delay: int | None
) -> Any:
    """The controller with an estimator, of outputs that the command names, or else of its config; None without any."""
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
