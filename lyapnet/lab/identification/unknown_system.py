"""The system of a config with unknown parameters: their names, how f and g read them, and the values they may have."""

import inspect
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from lyapnet.base.errors import UsageError, did_you_mean, one_line
from lyapnet.experiment.assembly.classes import default_dtype
from lyapnet.experiment.assembly.named_parts import parts_of
from lyapnet.experiment.assembly.problem import build_initial_states, build_system
from lyapnet.experiment.config import Config
from lyapnet.lab.identification.measurements import NamedReadings
from lyapnet.lab.identification.shooting import Model
from lyapnet.task.problem import TEST_STATES
from lyapnet.task.sets import Box
from lyapnet.task.systems import ControlSystem

SLIGHT = 0.01  # relative change of a parameter for the comparison with a system that is built with it
ASIDE = 0.1  # distance from states that X₀ fixes, relative to them (or in their unit), for this comparison
STEP = 1e-2  # step of finite differences for the comparison of derivatives, relative to this change

Array = np.ndarray


def system_of(config: Config) -> tuple[ControlSystem, Box]:
    """The system of a config, and X₀, in float64."""
    parts = parts_of(config)
    with default_dtype(torch.float64):
        system = (build_system(config.system) if parts.system is None else parts.system).double()
        system.check_coordinates()
        return system, build_initial_states(config.initial_states, system)


def sought_parameters(config: Config, system: ControlSystem, names: Sequence[str]) -> dict[str, float]:
    """Name ↦ value of the parameters to fit: those named, or those in the config's system.parameters, or all.

    Raises:
        UsageError: a name is no number that the system has as an attribute, or there is none.
    """
    arguments = inspect.signature(type(system)).parameters
    kept = {name: getattr(system, name, None) for name in arguments}
    numbers = {name: float(value) for name, value in kept.items() if type(value) in (int, float)}  # pyright: ignore[reportArgumentType]
    if not names:
        found = {name: numbers[name] for name in config.system.parameters if name in numbers} or numbers
        if not found:
            raise UsageError(
                f"Expected numbers among the arguments of {type(system).__name__} that it keeps, got none; write "
                "self.NAME = NAME in its __init__, and read it in f and g."
            )
        return found
    for name in names:
        if name not in numbers:
            hint = did_you_mean(name, numbers, "write self.NAME = NAME in its __init__, and read it in f and g.")
            listed = ", ".join(numbers) or "none"
            raise UsageError(f"Expected parameters of {type(system).__name__} ({listed}), got {name!r}; {hint}")
    if len(set(names)) < len(names):
        raise UsageError(f"Expected each parameter once, got {', '.join(names)}; leave one out.")
    return {name: numbers[name] for name in names}


class UnknownSystem:
    """A config's system with unknown parameters.

    Args:
        config: the system, and X₀.
        names: the names of the parameters; empty: as in `sought_parameters`.
        outputs: names of the readings.
        spread: standard deviations of the parameters around their values in the config; None: very large.

    Raises:
        UsageError: a name is no parameter, or f and g do not read it as self.NAME.
    """

    def __init__(self, config: Config, names: Sequence[str], outputs: Sequence[str], spread: np.ndarray | None = None):
        self.config, self.spread = config, spread
        self.system, self.box = system_of(config)
        before = sought_parameters(config, self.system, names)
        self.names, self.before = list(before), np.array([*before.values()])
        self.readings = NamedReadings(self.system, outputs)
        self.model = Model(self.system, self.names, self.readings)
        for i in range(len(self.names)):
            self._require_read(i)

    def _require_read(self, i: int) -> None:
        """Require f, g and output to read parameter i as self.NAME, and to keep its derivative.

        Raises:
            UsageError: they do not.
        """
        cls, name, p = type(self.system).__name__, self.names[i], torch.from_numpy(self.before)
        generator = torch.Generator().manual_seed(0)
        x = self.box.sample(TEST_STATES, generator).double()
        beside = ASIDE * x.abs().where(x != 0, 1.0) * torch.rand(x.shape, generator=generator, dtype=torch.float64)
        x = torch.where(self.box.widths > 0, x, x + beside)  # at a fixed state of 0, its factors would have no effect
        u = torch.rand(TEST_STATES, self.system.m, generator=generator, dtype=torch.float64)
        slight = torch.zeros_like(p)
        slight[i] = SLIGHT * (abs(float(p[i])) or 1.0) * (-1 if p[i] < 0 else 1)

        def rates_and_readings(system: ControlSystem, x: Tensor, u: Tensor) -> Tensor:
            return torch.cat([system.dynamics(x, u), self.readings.of(system, x)], -1)

        try:
            here, there, before, after = (
                self.model.values(rates_and_readings, x, p + way, u)
                for way in (0 * slight, slight, -slight * STEP, slight * STEP)
            )
            slope = self.model.derivatives(rates_and_readings, x, p, u)[..., self.system.n + i]
        except Exception as error:  # the system may be the user's
            raise UsageError(
                f"Expected {cls} with f and g of torch operations that take {name} as a tensor, got "
                f"{one_line(error)[:200]}; write torch.stack in the place of torch.tensor and x.new_tensor, "
                f"or leave {name} out of --parameters."
            ) from error
        built = self._built({name: float((p + slight)[i])})
        if built is not None:
            expected = rates_and_readings(built, x, u).detach()
            if not torch.allclose(there, expected, 1e-9, 1e-9 * float(expected.abs().max())):
                raise UsageError(
                    f"Expected {cls} to read {name} as self.{name}, got another f or g than that of {cls} built with "
                    f"{name}={float((p + slight)[i]):g}; derive in f and g what __init__ derives from it, or leave "
                    f"{name} out of --parameters."
                )
        if torch.equal(here, there):
            raise UsageError(
                f"Expected {cls}.f, g or output to read {name}, got the same for each; read self.{name}, or leave "
                f"{name} out of --parameters."
            )
        difference = (after - before) / (2 * STEP * slight[i])
        if not torch.allclose(slope, difference, 1e-3, 1e-3 * float(difference.abs().max())):
            raise UsageError(
                f"Expected {cls}.f and g that keep the derivative by self.{name}, got ones that turn it into a number; "
                "write torch.stack in the place of torch.tensor and x.new_tensor."
            )

    def _built(self, changes: Mapping[str, float]) -> ControlSystem | None:
        """The system with other arguments; None if its constructor refuses them."""
        try:
            return type(self.system)(**{**self.config.system.parameters, **changes}).double()
        except Exception:  # the constructor may be the user's
            return None

    def bounds(self) -> tuple[Array, Array]:
        """The least and greatest values of parameters; 0 is one of them if the constructor refuses the other sign."""
        lower, upper = np.full(len(self.names), -np.inf), np.full(len(self.names), np.inf)
        for i, (name, value) in enumerate(zip(self.names, self.before, strict=True)):
            size = abs(value) or 1.0
            if value >= 0 and self._built({name: -size}) is None:
                lower[i] = 0.0 if self._built({name: 0.0}) is not None else 1e-6 * size
            if value <= 0 and self._built({name: size}) is None:
                upper[i] = 0.0 if self._built({name: 0.0}) is not None else -1e-6 * size
        return lower, upper
