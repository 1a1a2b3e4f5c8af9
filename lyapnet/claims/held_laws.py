"""Claims about a law that is read at certain times and held: readings from the options, as numbers and in words."""

from collections.abc import Sequence
from typing import Any

from lyapnet.base.errors import UsageError, did_you_mean
from lyapnet.claims.arguments import number_of_each_state
from lyapnet.claims.claim import ReadAtTimes
from lyapnet.controller.controller import Controller
from lyapnet.prover.float_errors import ULPS, UNBOUNDED_STATE_LIMIT
from lyapnet.prover.readings import Readings
from lyapnet.task.problem import Problem
from lyapnet.task.systems import ControlSystem
from lyapnet.task.varying_limits import VaryingLimits


def held_options(claim: ReadAtTimes) -> list[str]:
    """The names of the given options that are about a held law."""
    names = ("interval", "jitter", "delay", "measured", "quantised", "file")
    return [name for name in names if getattr(claim, name, None)]


def readings_of(claim: ReadAtTimes, controller: Controller, made_for: str, forever: bool = False) -> Readings | None:
    """The readings of the law; None for a claim about u read at every t.

    Args:
        made_for: "continuous" or "held", used if the claim does not say which; "held" only for tasks that allow it.
        forever: whether the law is u(0, x), used without end.

    Raises:
        UsageError: options of a held law for one that is read at every t, a name is unknown, there are constraints, or
            limits depend on the state.
    """
    problem, system = controller.problem, controller.system
    given = held_options(claim)
    refused = _reason_against(problem)
    time = claim.time or ("held" if given or (made_for == "held" and refused is None) else "continuous")
    if time != "held":
        if given:
            raise UsageError(f"Expected --time held with --{given[0]}, got {time}; {READ_THEN[time]}.")
        return None
    if refused is not None:
        raise UsageError(refused)
    errors = number_of_each_state("the error", claim.measured or {}, controller)
    constant = [system.state_names[i] for i in system.constants if errors[i]]
    if constant:
        raise UsageError(f"Expected errors of measured states, got {constant[0]}, a parameter; leave it out.")
    steps, interval = claim.quantised or {}, claim.interval or problem.horizon.dt
    unknown = [name for name in steps if name not in system.control_names]
    if unknown:
        hint = did_you_mean(unknown[0], system.control_names, "name one of them.")
        raise UsageError(f"Expected steps of {', '.join(system.control_names)}, got '{unknown[0]}'; {hint}")
    rounding = tuple(steps.get(name, 0.0) / 2 for name in system.control_names)
    duration = None if forever else problem.horizon.duration
    return Readings(round((1 + claim.jitter) * interval, 12), claim.delay, tuple(errors), rounding, duration)


READ_THEN = {"continuous": "u is then read at every t", "steps": "u is then read in each step of the model"}
"""Value of `time` ↦ when u is read, for messages."""


def _reason_against(problem: Problem) -> str | None:
    """The message that refuses a claim about a held law for this task; None if there is no reason to."""
    if problem.constraints is not None:
        return "Expected no state constraints for a law that is held, got some; add --time continuous."
    if isinstance(problem.controls, VaryingLimits):
        return (
            "Expected limits that do not depend on the state for a law that is held, got some that do; between two "
            "readings u would follow them. Add --time continuous."
        )
    return None


def readings_facts(readings: Readings | None, system: ControlSystem) -> dict[str, Any]:
    """The readings by the keys of a certificate's result; empty if u is read at every t."""
    if readings is None:
        return {}
    return {
        "read_within": readings.interval, "used_within": readings.delay,
        "measured": _named(system.state_names, readings.errors),
        "control_errors": _named(system.control_names, readings.control_errors), **_computed_facts(readings, system),
    }  # fmt: skip


def _computed_facts(readings: Readings, system: ControlSystem) -> dict[str, Any]:
    """The program that computes u, by the keys of a certificate's result; empty for real numbers."""
    computed = readings.computed
    if computed is None:
        return {}
    named = dict(zip(system.control_names, computed.errors, strict=True))
    return {"computed_by": computed.sha256, "precision": computed.precision, "computed_within": named}


READINGS = {
    "read_within": "seconds between two readings of u, at most",
    "used_within": "seconds from a reading to its use, at most",
    "measured": "errors of the states that are read, at most",
    "control_errors": "errors of the controls, at most",
    "computed_by": "SHA-256 of the C that computes u",
    "precision": "its numbers",
    "computed_within": "how far its u is off, at most",
}
"""Labels of `readings_facts`."""


def readings_text(readings: Readings | None, system: ControlSystem) -> str:
    """The readings in words."""
    if readings is None:
        return "with u read at every t"
    delay = ""
    if readings.delay:
        delay = f", used in this order, at most {readings.delay!r} s later (that of t = 0 at once)"
    errors = "".join(
        f", with an error of at most {value!r} of {what}{name}"
        for what, named in (("the measured ", _named(system.state_names, readings.errors)),
                            ("", _named(system.control_names, readings.control_errors)))
        for name, value in named.items()
    )  # fmt: skip
    return f"with u read at any times at most {readings.interval!r} s apart{delay}, and held until the next{errors}"


def computed_text(readings: Readings | None, system: ControlSystem, left_out: Sequence[int]) -> str:
    """A sentence on the program that computes u; empty for real numbers.

    Args:
        left_out: states on which nothing depends.
    """
    computed = None if readings is None else readings.computed
    if computed is None:
        return ""
    within = (
        f", with {', '.join(system.state_names[i] for i in left_out)} within ±{UNBOUNDED_STATE_LIMIT:g}"
        if left_out
        else ""
    )
    off = " and ".join(
        f"{error!r} of {name}" for name, error in zip(system.control_names, computed.errors, strict=True)
    )
    return (
        f"u is what policy.h and policy.c of SHA-256 {computed.sha256} (without the comments at their top) compute in "
        f"{computed.precision} from the measured state{within}, called up to t = {computed.latest!r} s: that is at "
        f"most {off} off, and counted among the errors, given arithmetic of IEEE 754 without -ffast-math, and "
        f"functions of the C library within {ULPS} units in the last place. "
    )


def control_of(readings: Readings, law: str) -> str:
    """The control of a reading as a formula, with e and r if there are such errors.

    Args:
        law: the law, with {} where e is added.
    """
    return law.format(" + e" * any(readings.errors)) + " + r" * any(readings.control_errors)


def _named(names: Sequence[str], bounds: Sequence[float]) -> dict[str, float]:
    """The bounds that are not 0, by name."""
    return {name: bound for name, bound in zip(names, bounds, strict=True) if bound > 0}
