"""The page: plotly, the controller's functions in JavaScript, and the facts that it shows, in one file."""

import html
import json
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import torch

from lyapnet import __version__
from lyapnet.base.errors import DivergenceError, UsageError
from lyapnet.base.files import plain, write_atomically
from lyapnet.base.random_streams import FIGURES, stream
from lyapnet.base.types import State
from lyapnet.claims.checking import KeptSide
from lyapnet.controller.controller import Controller
from lyapnet.evaluation.figures import widest_axes
from lyapnet.exchange.view.functions import functions_of
from lyapnet.task.constraints import StateLimits, names_of, parts_of
from lyapnet.task.family import FamilySystem
from lyapnet.task.sets import Box

LOOPS = 64  # number of closed loops from X₀ for the ranges of the axes
CHECKED = 32  # number of states at which the page compares its functions with the controller
MARGIN = 0.08  # margin of the axes on either side, relative to the range of the points
ENDINGS = (".html", ".htm")


def write_page(controller: Controller, path: Path, title: str, funnel: KeptSide | None = None) -> None:
    """Write the page of a controller, as a whole or not at all.

    Raises:
        UsageError: the file has another ending; or as page_of.
        OSError: the file cannot be written.
    """
    if path.suffix not in ENDINGS:
        raise UsageError(f"Expected a file that ends in .html, got {str(path)!r}; name it so.")
    write_atomically(path, page_of(controller, title, funnel).encode())


def page_of(controller: Controller, title: str, funnel: KeptSide | None = None) -> str:
    """The page as HTML.

    Args:
        title: the title of the page.
        funnel: a proved funnel to draw; None for none.

    Raises:
        UsageError: plotly is not installed.
        ExportError: as functions_of.
    """
    try:
        from plotly.offline import get_plotlyjs  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError as error:
        raise UsageError(f'Expected plotly, got {error}; pip install "lyapnet[view]".') from error
    facts = json_in_script(facts_of(controller, title, funnel))
    parts = files("lyapnet.exchange.view")
    return Template((parts / "page.html").read_text(encoding="utf-8")).substitute(
        title=html.escape(title), plotly=get_plotlyjs(), functions=functions_of(controller), facts=facts,
        program=(parts / "page.js").read_text(encoding="utf-8"),
    )  # fmt: skip


def json_in_script(content: Any) -> str:
    """JSON for a script element, with all characters escaped that could begin or end an element or a comment there.

    HTML has no escapes inside a script (after `<!--<script>`, not even `</script>` ends it), but JSON has.
    """
    return json.dumps(content, ensure_ascii=False, allow_nan=False).translate(ESCAPES)


ESCAPES = {ord(each): f"\\u{ord(each):04x}" for each in "<>&\u2028\u2029"}


def facts_of(controller: Controller, title: str, funnel: KeptSide | None = None) -> dict[str, Any]:
    """The data of a controller for the page, as plain data; null stands for numbers that are not finite."""
    problem, system, box = controller.problem, controller.system, controller.initial_states
    center = box.center
    limits = problem.controls.fixed_limits or (-torch.inf, torch.inf)
    sides = [torch.as_tensor(side).to(center).expand(system.m).tolist() for side in limits]
    extent = _extent(controller, funnel)
    family = isinstance(system, FamilySystem)
    parameters = dict(zip(system.constants, system.names, strict=True)) if family else {}
    logarithmic = system.weights if family else frozenset[str]()
    facts = {
        "title": title,
        "task": f"{system.title}, {type(controller.program).__name__}, T = {problem.horizon.duration:g} s, "
        f"lyapnet {__version__}",
        "states": [
            {
                "name": name, "label": label, "unit": unit, "low": low, "high": high,
                "parameter": parameters.get(i), "logarithmic": parameters.get(i) in logarithmic,
            }
            for i, (name, label, unit, low, high) in enumerate(
                zip(
                    system.state_names, system.state_labels, system.state_units, extent.lower.tolist(),
                    extent.upper.tolist(), strict=True,
                )
            )
        ],
        "controls": [
            {"name": name, "label": label, "lower": lower, "upper": upper}
            for name, label, lower, upper in zip(system.control_names, system.control_labels, *sides, strict=True)
        ],
        "start": _start(controller).tolist(),
        "first": _first(controller).tolist(),
        "hasGoal": problem.has_goal,
        "axes": _axes(controller),
        "initialStates": {"lower": box.lower.tolist(), "upper": box.upper.tolist()},
        "steps": problem.horizon.steps,
        "dt": problem.horizon.dt,
        "constraints": list(names_of(problem.constraints)),
        "funnel": None if funnel is None else {
            "alpha": funnel.alpha, "delta": funnel.delta, "rho": funnel.rho, "lower": funnel.states.lower.tolist(),
            "upper": funnel.states.upper.tolist(),
        },
        "checks": _checks(controller),
    }  # fmt: skip
    return plain(facts)


def _axes(controller: Controller) -> list[int]:
    """The states of the first slice; −1 stands for time."""
    if controller.system.n == 1:
        return [-1, 0]
    free = [i for i in widest_axes(controller.initial_states) if i not in controller.system.constants]
    return sorted([*free, *(i for i in range(controller.system.n) if i not in free)][:2])


def _start(controller: Controller) -> State:
    """The other states of the first slice: those of the goal, of a family with its parameters at the centre of X₀."""
    problem, center = controller.problem, controller.initial_states.center
    return center - problem.cost.from_goal(center) if problem.has_goal else center


def _first(controller: Controller) -> State:
    """The start of the first closed loop: in the middle between the centre of X₀ and its upper corner."""
    box = controller.initial_states
    return (box.center + box.upper) / 2


def _extent(controller: Controller, funnel: KeptSide | None) -> Box:
    """The ranges of the axes: they contain X₀, closed loops from there, the goal, state limits and a funnel's D."""
    box = controller.initial_states
    try:
        x = controller.rollout(box.sample(LOOPS, stream(0, FIGURES))).x.flatten(0, 1)
    except DivergenceError:
        x = box.center[None]
    points = torch.cat([x, box.lower[None], box.upper[None], _start(controller)[None]])
    lower, upper = points.amin(0), points.amax(0)
    for part in parts_of(controller.problem.constraints):
        if isinstance(part, StateLimits):
            for i, limit in zip(part.states.tolist(), part.limits.to(lower), strict=True):  # a state may have two
                lower[i], upper[i] = torch.minimum(lower[i], limit), torch.maximum(upper[i], limit)
    room = MARGIN * torch.where(upper > lower, upper - lower, 1 + lower.abs())
    room[list(controller.system.constants)] = 0  # V was trained for parameters of X₀ only
    lower, upper = lower - room, upper + room
    if funnel is not None:
        lower = torch.minimum(lower, funnel.states.lower.to(lower))
        upper = torch.maximum(upper, funnel.states.upper.to(upper))
    return Box(lower, torch.where(upper > lower, upper, lower + 1))


def _checks(controller: Controller) -> dict[str, Any]:
    """The controller's u, V and next state at some times and states of X₀."""
    generator, horizon, step = stream(0, FIGURES), controller.horizon, controller.step
    x = controller.initial_states.sample(CHECKED, generator)
    nodes = torch.randint(horizon.steps, (CHECKED,), generator=generator)
    t = nodes.to(x) * horizon.dt
    with torch.no_grad():
        after = [step(*each)[0] for each in zip(t, x.new_full((CHECKED,), horizon.dt), x, strict=True)]
        u, V = controller.policy(t, x), controller.value(t, x)
    return {"t": t.tolist(), "x": x.tolist(), "u": u.tolist(), "V": V.tolist(), "after": torch.stack(after).tolist()}
