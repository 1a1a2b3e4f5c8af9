"""One control law for all plants of a box of parameters, as one closed loop with the parameters as constant states."""

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from lyapnet.base.contracts import copied
from lyapnet.base.errors import UsageError, did_you_mean
from lyapnet.controller.controller import Controller
from lyapnet.experiment.assembly.classes import float64_defaults, section
from lyapnet.loop.random_plants import NominalLaw
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.prover.readings import Readings
from lyapnet.task.family import PREFIX, FamilySystem, check_members, parameter_of, with_constant_states
from lyapnet.task.mapped_controls import MappedControls
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box
from lyapnet.task.systems import ControlSystem
from lyapnet.value.policy import ValuePolicy

OPTION = "parameters"
TEST_STATES = 8  # number of random states at which plants are compared with systems built with their parameters


@dataclass(frozen=True)
class Plants:
    """ẋ = f(x; p) + g(x; p)u(x) for each constant p in a box P, where u and V were made for one nominal plant.

    With z = (x, p) and ṗ = 0 this is one closed loop with constants, like that of a family. But here u and V depend on
    x alone: the law uses f, g and R of the nominal plant, which is a separate object.
    """

    system: FamilySystem  # in z
    nominal: Mapping[str, float]  # the parameters of the plant that u and V were made for
    box: Box  # P, (k,), in the order of `nominal`

    @property
    def ranges(self) -> dict[str, list[float]]:
        """The bounds of P by name."""
        ends = torch.stack([self.box.lower, self.box.upper], -1).tolist()
        return dict(zip(self.nominal, ends, strict=True))

    def around(self, states: Box) -> Box:
        """states × P.

        Raises:
            UsageError: the box has another number of states.
        """
        n = self.system.system.n
        if states.dimension != n:
            raise UsageError(f"Expected a set of {n} states, got {states.dimension}; give bounds for each state.")
        return Box(
            torch.cat([states.lower.double(), self.box.lower]), torch.cat([states.upper.double(), self.box.upper])
        )

    def disturbance_of_all(self, w: Tensor) -> Tensor:
        """A disturbance w of ẋ as one of ż, with zeros for ṗ."""
        return torch.cat([w, w.new_zeros(self.box.dimension)])

    def readings_of_all(self, readings: Readings) -> Readings:
        """Readings of x as readings of z, without errors of p."""
        return replace(readings, errors=(*readings.errors, *[0.0] * self.box.dimension))

    def all_of(self, loop: ClosedLoop, problem: Problem) -> tuple[ClosedLoop, Problem]:
        """The closed loop of all plants in z and its problem, from those of the nominal plant."""
        assert isinstance(loop.policy, ValuePolicy)
        joint = self.problem(problem)
        return ClosedLoop(joint, NominalLaw(joint, loop.policy)), joint

    def problem(self, problem: Problem) -> Problem:
        """The problem in z: the cost, the controls and the constraints of the nominal plant, and X₀ × P."""
        return with_constant_states(problem, self.system, self.around(problem.initial_states))


def plants_of(controller: Controller, ranges: Mapping[str, Sequence[float]]) -> Plants:
    """The plants of a controller's system with parameters in these ranges.

    At random states they are compared with systems that the constructor builds.

    Args:
        ranges: name of a constructor argument that f and g read as self.NAME ↦ [lower, upper].

    Raises:
        UsageError: the system is a family; or the constructor has no such argument, uses it in another way than as
            self.NAME, or refuses one of its values; or neither f nor g reads it.
    """
    if controller.system.constants:
        raise UsageError("Expected one system, got a family; choose one member of it (option at).")
    if isinstance(controller.controls, MappedControls):
        raise UsageError(
            f"Expected constant limits of controls with {OPTION}, got {controller.controls.words}; leave it out."
        )
    system = copied(controller.system)  # changes of its parameters must not change the law
    _require_arguments(system, ranges)
    lower, upper = (torch.tensor([ends[i] for ends in ranges.values()], dtype=torch.float64) for i in (0, 1))
    plants = Plants(
        FamilySystem(system, list(ranges), [""] * len(ranges)),
        {name: parameter_of(system, name, math.nan) for name in ranges},
        Box(lower, upper),
    )
    X0 = plants.around(controller.initial_states)
    z = torch.cat([X0.lower[None], X0.upper[None], X0.sample(TEST_STATES, torch.Generator().manual_seed(0)).double()])
    check_members(plants.system, _builder(controller), z, OPTION)
    return plants


def _builder(controller: Controller) -> Callable[[Mapping[str, float]], ControlSystem]:
    """A function that builds the controller's system with other parameters, in the controller's precision."""
    cls, given, dtype = type(controller.system), controller.parameters, controller.initial_states.lower.dtype

    def build(values: Mapping[str, float]) -> ControlSystem:
        with section(OPTION), float64_defaults():
            return cls(**{**given, **values}).to(dtype).double()

    return build


def _require_arguments(system: ControlSystem, names: Mapping[str, Any]) -> None:
    """Refuse names that are not arguments of the system's constructor."""
    cls = type(system)
    known = [name for name in inspect.signature(cls).parameters if not name.startswith(PREFIX)]
    for name in names:
        if name not in known:
            hint = did_you_mean(name, known, "choose one.")
            raise UsageError(
                f"Expected {OPTION} among the arguments of {cls.__name__} ({', '.join(known) or 'none'}), got {name}; "
                f"{hint}"
            )
