"""A small network r(x) that is added to the equations of a model, for effects that it lacks: ẋ = F(x, u) + r(x).

r_i = s_i Σ_h c_ih tanh(w_hᵀξ + b_h)/√H, where ξ is x shifted and scaled to [−1, 1] on the data, and s_i is the root
mean square of ẋ_i on the data. w and b are random and fixed, so r is linear in c, which is fitted by multiple shooting
like parameters, with the penalty Σ c². The network is written as further lines of the equations; so training,
certificates and exports can use the system like any other, and it stays control-affine.
Source: Rahimi, Recht, "Random features for large-scale kernel machines", NIPS 2007 (random layers).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from lyapnet.base.errors import UsageError
from lyapnet.base.names import with_underscores
from lyapnet.experiment.assembly.classes import default_dtype
from lyapnet.experiment.config import Config
from lyapnet.lab.identification.identify import held_out_curves, split_recordings
from lyapnet.lab.identification.measurements import Measurements
from lyapnet.lab.identification.results import Curve, Identification
from lyapnet.lab.identification.search import Search
from lyapnet.lab.identification.unknown_system import UnknownSystem, system_of
from lyapnet.task.systems import ControlSystem, EquationSystem, moving_states, states_that_are_rates
from lyapnet.training.stage_messages import StageReport, silent

UNITS = 24  # default of H
SLOPE = 1.5  # standard deviation of wᵀξ over the box of the data, about
NEEDED = 0.9  # ratio of the held-out errors with and without r, below which r counts as needed
MOST_PARTS = 20_000  # largest number of parts of the box of the data, for bounds
DIGITS = 9  # significant digits of numbers in the equations

Array = np.ndarray


@dataclass(frozen=True)
class Network:
    """r(x).

    Args:
        states: names of all states.
        rates: indices of the states whose rates get a residual.
        center, width: middle and half widths of the box of the data, (n,); ξ = (x − center)/width.
        w, b: (H, n) and (H,).
        scale: s_i, (outputs,).
        c: (outputs, H).
    """

    states: tuple[str, ...]
    rates: tuple[int, ...]
    center: Float[Array, " n"]
    width: Float[Array, " n"]
    w: Float[Array, "H n"]
    b: Float[Array, " H"]
    scale: Float[Array, " outputs"]
    c: Float[Array, "outputs H"]

    def __call__(self, x: Float[Array, "*batch n"]) -> Float[Array, "*batch outputs"]:
        return np.tanh((x - self.center) / self.width @ self.w.T + self.b) @ self.weights.T

    @property
    def weights(self) -> Float[Array, "outputs H"]:
        """s_i c_ih/√H."""
        return self.scale[:, None] * self.c / np.sqrt(len(self.b))

    def bounds(self) -> tuple[Float[Array, " outputs"], Float[Array, "outputs n"]]:
        """Bounds of |r_i| and of |∂r_i/∂x_j| on the box of the data, by interval arithmetic on parts of the box."""
        n = len(self.center)
        parts = max(1, int(MOST_PARTS ** (1 / n)))  # along each axis
        centers = np.stack(np.meshgrid(*[(2 * np.arange(parts) + 1) / parts - 1] * n), -1).reshape(-1, n)
        middle, reach = centers @ self.w.T + self.b, np.abs(self.w).sum(1) / parts
        low, high = np.tanh(middle - reach), np.tanh(middle + reach)
        plus, minus = np.maximum(self.weights, 0).T, np.minimum(self.weights, 0).T
        largest = np.maximum(high @ plus + low @ minus, -(low @ plus + high @ minus)).max(0)
        least = 1 - np.maximum(low**2, high**2)  # of tanh′
        most = 1 - np.tanh(np.maximum(np.abs(middle) - reach, 0)) ** 2
        slopes = np.empty((len(self.rates), n))
        for j in range(n):
            of_j = self.weights * self.w[:, j] / self.width[j]
            plus, minus = np.maximum(of_j, 0).T, np.minimum(of_j, 0).T
            slopes[:, j] = np.maximum(most @ plus + least @ minus, -(least @ plus + most @ minus)).max(0)
        return largest, slopes

    @property
    def everywhere(self) -> Float[Array, " outputs"]:
        """A bound of |r_i| for all x, Σ_h s_i |c_ih|/√H."""
        return np.abs(self.weights).sum(1)

    def added_to(self, equations: str, weight: Callable[[int, int], str] | None = None) -> str:
        """The equations of F + r.

        Args:
            weight: (output, unit) ↦ the text of c_ih; None: its number.
        """
        prefix = "residual"
        while prefix in equations:
            prefix += "_"
        names, count = [with_underscores(name) for name in self.states], len(self.b)
        slopes = self.w / self.width
        offsets = self.b - slopes @ self.center
        lines = list[str]()
        for h in range(count):
            products = (f"{_text(slope)}*{name}" for slope, name in zip(slopes[h], names, strict=True))
            lines.append(f"{prefix}{h} = tanh({' + '.join([_text(offsets[h]), *products])})")
        sums = {
            names[i]: (
                f"{_text(self.scale[k] / np.sqrt(count))}*("
                + " + ".join(f"{weight(k, h) if weight else _text(self.c[k, h])}*{prefix}{h}" for h in range(count))
                + ")"
            )
            for k, i in enumerate(self.rates)
        }
        for line in equations.splitlines():
            left, _, right = line.partition("#")[0].partition("=")
            state = "".join(left.split()).removeprefix("der(").removesuffix(")")
            added = left.lstrip().startswith("der") and state in sums
            lines.append(f"der({state}) = ({right.strip()}) + {sums[state]}" if added else line)
        return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class Residual:
    """A network r(x), and the errors with it on held-out data.

    Args:
        network: r(x).
        config: the config of the system with r(x).
        before, after: root mean square error of each held-out reading without and with r(x); empty without any.
    """

    network: Network
    config: Config
    before: dict[str, float]
    after: dict[str, float]

    @property
    def ratio(self) -> float:
        """The mean over readings of the error with r(x) over that without; NaN if nothing was held out."""
        pairs = [(self.after[name], self.before[name]) for name in self.before]
        return float(np.mean([a / b if b else 1.0 for a, b in pairs])) if pairs else np.nan

    @property
    def needed(self) -> bool:
        """Whether r(x) lowers the errors on held-out data by more than chance: ratio < NEEDED."""
        return self.ratio < NEEDED


def identify_residual(
    config: Config,
    data: Sequence[str | Path | Measurements],
    found: Identification,
    test: Sequence[str | Path | Measurements] = (),
    held_out: float | None = None,
    units: int = UNITS,
    report: StageReport = silent,
) -> Residual:
    """Fit r(x) to the same recordings as the parameters, which stay as they were found.

    Args:
        config: the system, as for `identify`.
        found: the result of `identify` for the same data.
        units: H.

    Raises:
        UsageError: the system has no equations, or the recordings are too short.
    """
    parameters = {**config.system.parameters, **found.values}
    config = replace(config, system=replace(config.system, parameters=parameters))
    with default_dtype(torch.float64):
        system, _ = system_of(config)
        require_equations(system)
        fitted, tested = split_recordings(system, data, test, held_out)
        network = _drawn(system, found.states, found.controls, units)
        names = [[f"weight_{k}_{h}" for h in range(units)] for k in range(len(network.rates))]
        unknown = UnknownSystem(
            _extended(config, network, {name: 0.0 for row in names for name in row}, lambda k, h: names[k][h]),
            [name for row in names for name in row], fitted[0].outputs, np.ones(units * len(names)),
        )  # fmt: skip
        search = Search(unknown, fitted, report)
        fit, solution = search.run()
        network = replace(network, c=solution.point.p.reshape(len(names), units))
        after = held_out_curves(search, fit, solution, tested)
    readings = search.readings.names
    before = [curve for curve in found.curves if curve.held_out]
    return Residual(network, _extended(config, network), _errors(readings, before), _errors(readings, after))


def require_equations(system: ControlSystem) -> None:
    """Refuse a system without equations, to which no network can be added."""
    if not isinstance(system, EquationSystem):
        raise UsageError(
            f"Expected a system of equations for --residual, got {system.title}; write it as one, or as a CasADi, URDF "
            "or MJCF file."
        )


def _drawn(system: ControlSystem, x: Array, u: Array, units: int) -> Network:
    """A network with weights 0 on the box of some states."""
    random, moving = np.random.default_rng(0), moving_states(system)
    states, n = torch.from_numpy(x), x.shape[1]
    plain = {j for _, j in states_that_are_rates(system, states)}  # positions, whose rates are other states
    rates = tuple(i for i in moving if i not in plain)
    low, high = x.min(0), x.max(0)
    width = np.where(high > low, (high - low) / 2, np.maximum(np.abs(low), 1.0))
    w = SLOPE * random.normal(size=(units, n)) * np.sqrt(3 / n)  # the variance of a uniform ξ is 1/3
    scale = np.sqrt((system.dynamics(states, torch.from_numpy(u)).numpy() ** 2).mean(0))[list(rates)]
    return Network(
        tuple(system.state_names), rates, (low + high) / 2, width, w, random.uniform(-1, 1, units), scale,
        np.zeros((len(rates), units)),
    )  # fmt: skip


def _extended(
    config: Config, network: Network, more: dict[str, float] | None = None,
    weight: Callable[[int, int], str] | None = None,
) -> Config:  # fmt: skip
    """The config of F + r, with further parameters."""
    system = config.system
    text, parameters = network.added_to(system.equations, weight), {**system.parameters, **(more or {})}
    return replace(config, system=replace(system, name="equations", equations=text, parameters=parameters))


def _errors(readings: Sequence[str], curves: Sequence[Curve]) -> dict[str, float]:
    """The root mean square of y − ŷ of each reading."""
    if not curves:
        return {}
    left = np.concatenate([curve.y - curve.y_hat for curve in curves])
    return dict(zip(readings, np.sqrt((left**2).mean(0)).tolist(), strict=True))


def _text(number: float) -> str:
    return f"{number:.{DIGITS}g}" if number >= 0 else f"({number:.{DIGITS}g})"
