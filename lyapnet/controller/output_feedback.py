"""A controller that reads noisy outputs instead of the state: an estimator, and the law at its estimate."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lyapnet.base.contracts import copied
from lyapnet.base.errors import UsageError
from lyapnet.base.types import Control, State
from lyapnet.controller.html import loop_as_html
from lyapnet.loop.estimation.kalman import FILTERS, Belief, Deviations, KalmanFilter
from lyapnet.task.family import LOGARITHM
from lyapnet.task.input_disturbances import DisturbedSystem
from lyapnet.task.outputs import Outputs, Readings
from lyapnet.task.problem import Problem
from lyapnet.value.law_after_horizon import ContinuedPolicy

ROUNDING = 1e-6  # largest excess of a setting over its range, relative to it; ends of ranges are rounded in float32


class OutputFeedback:
    """y_k ↦ u(t_k, x̂_k), called once in each Δt: x̂_k is the estimate from all readings up to y_k.

    The first call is at t = 0: its readings correct the first estimate before the first control. Each further call
    predicts one step under the control of the call before, and corrects by its readings. Each loop of a batch, whose
    shape is that of the first readings, has its own estimate; computations are in float64. Estimated disturbances d of
    controls are subtracted: the control is u(t, x̂) − d̂, within its limits.

    With a delay of d steps a control acts d Δt after its readings. The controls that act until then are known, and the
    model predicts the state x̂ at t_k + dΔt from them; the control is u(t_k + dΔt, x̂). Before the first one, the
    control at rest acts. For a plant that equals the model, without noise, this law is optimal from dΔt on if V is.

    Args:
        law: u(t, x) with its V, for all t ≥ 0.
        problem: the steps for the predictions of the estimator. Its states are those of the law, or (x, p) with
            estimated parameters p; disturbances d of controls come last.
        outputs: h and the noise of the readings.
        kind: ekf, the extended Kalman filter; or ukf, the unscented one.
        drift: see KalmanFilter.
        deviation: standard deviation of the first estimate, (n,).
        delay: d, the number of steps after which a control acts.
        around_state: whether evaluations draw the first estimate around x₀ with this deviation, or use the centre of
            X₀.
        controller: the Controller whose law it is, for exports.

    Raises:
        UsageError: unknown kind.
    """

    law: ContinuedPolicy
    kind: str
    outputs: Outputs
    deviation: Deviations
    delay: int
    around_state: bool
    controller: Any
    problem: Problem
    filter: KalmanFilter
    state_of_law: State  # an example of the law's argument x: its length, precision and device
    settings: dict[str, int]  # settings of a family: name ↦ index of the state
    ranged: list[int]  # indices of the parameters p, whose estimates stay in their ranges

    def __init__(
        self, law: ContinuedPolicy, problem: Problem, outputs: Outputs, kind: str, drift: Deviations,
        deviation: Deviations, delay: int = 0, around_state: bool = False, controller: Any = None,
    ):  # fmt: skip
        if kind not in FILTERS:
            raise UsageError(f"Expected an estimator as one of {', '.join(FILTERS)}, got {kind!r}; choose one of them.")
        self.law, self.kind, self.outputs, self.delay = law, kind, outputs, delay
        self.deviation, self.around_state, self.controller = deviation, around_state, controller
        self.state_of_law = problem.initial_states.lower[: law.system.n]
        self.problem = copied(problem).requires_grad_(False)  # in float64, on the CPU
        self._controls = problem.controls
        self._disturbed = problem.system.disturbed if isinstance(problem.system, DisturbedSystem) else []
        names = problem.system.state_names
        self.settings = {names[i].removeprefix(LOGARITHM): i for i in problem.system.settings}
        of_plant = list(problem.system.constants)[: len(problem.system.constants) - len(self._disturbed)]
        self.ranged = [i for i in of_plant if i not in problem.system.settings]
        self.filter = FILTERS[kind](self.problem, outputs, drift)
        self.reset()

    def _repr_html_(self) -> str:
        """The display in notebooks: a table."""
        return loop_as_html(self)

    def reset(self, x_hat: Any = None, P: Any = None, t: float = 0.0) -> None:
        """Restart: the next call of `step` is at t.

        Args:
            x_hat: the first estimate (*batch, n); None: the centre of X₀.
            P: its covariance (*batch, n, n); None: diagonal, with `outputs.initial_deviation` or that of a uniform
                distribution on X₀.

        Raises:
            ValueError: a shape does not fit, a number is not finite, or P is not symmetric positive semidefinite.
        """
        n = self.problem.system.n
        first = self.middle_estimate() if x_hat is None else _float64(x_hat)
        covariance = torch.diag(self.deviation.square()) if P is None else _float64(P)
        if first.ndim < 1 or first.shape[-1] != n:
            names = ", ".join(self.problem.system.state_names)
            raise ValueError(
                f"Expected x_hat of shape (*batch, {n}), got {tuple(first.shape)}; the last axis holds {names}."
            )
        if covariance.shape[-2:] != (n, n) or not _is_covariance(covariance):
            raise ValueError(
                f"Expected P of shape (*batch, {n}, {n}), symmetric and positive semidefinite, got another matrix of "
                f"shape {tuple(covariance.shape)}; give a covariance."
            )
        if not (bool(first.isfinite().all()) and math.isfinite(t)):
            raise ValueError(f"Expected finite x_hat and t, got {first.tolist()} and {t}; give numbers.")
        self._belief, self._t, self._began = Belief(first, covariance), float(t), 0.0
        self._due: Tensor | None = None  # controls in this interval and in the next d, (d + 1, *batch, m)
        self._like: Any = x_hat if x_hat is not None else np.empty(0)

    def middle_estimate(self) -> State:
        """The centre of X₀, at the beginning of a reference."""
        time, x = self.problem.system.reference_time, self.problem.initial_states.center.clone()
        if time is not None:
            x[time] = self.problem.initial_states.lower[time]
        return x

    def draw_first(self, x0: State, generator: torch.Generator) -> State:
        """A first estimate for each x₀: the centre of X₀, or around x₀ in states that X₀ fixes.

        If a deviation is given, it is around x₀ in all states. For parameters and disturbances it is always the centre;
        settings, such as targets, are those of x₀.
        """
        box, constants = self.problem.initial_states, list(self.problem.system.constants)
        around = (box.widths == 0) | self.around_state
        around[constants] = False
        around[list(self.settings.values())] = True
        near = x0 + self.deviation * torch.randn(x0.shape, generator=generator, dtype=torch.float64)
        return torch.where(around, near, box.center)

    @property
    def belief(self) -> Belief:
        """x̂ and P in float64, after the last readings."""
        return self._belief

    @property
    def t(self) -> float:
        """Time of the last readings, in s; before the first readings the time of `reset`."""
        return self._t

    @property
    def x_hat(self) -> Any:
        """x̂ (*batch, n) after the last readings."""
        return like_given(self._like, self._belief.x)

    @property
    def d_hat(self) -> Any:
        """The estimated disturbances of controls (*batch, k), the last of `x_hat`; k = 0 if none is estimated."""
        return like_given(self._like, self._disturbances(self._belief.x))

    def _disturbances(self, x: State) -> Tensor:
        return x[..., self.problem.system.n - len(self._disturbed) :]

    @property
    def at_range_end(self) -> list[str]:
        """Names of the parameters whose estimate is at an end of its range, in any loop of the batch.

        The plant may then be outside the range for which V was trained, and an offset may remain.
        """
        lower, upper = self._ends
        p = self._belief.x.reshape(-1, self.problem.system.n)[:, self.ranged]
        found = (((p <= lower) | (p >= upper)).any(0) & (lower < upper)).tolist()
        return [self.problem.system.state_names[i] for i, ends in zip(self.ranged, found, strict=True) if ends]

    @property
    def P(self) -> Any:
        """The covariance of x̂ (*batch, n, n) after the last readings."""
        return like_given(self._like, self._belief.P)

    @torch.no_grad()
    def step(self, y: Any, applied: Any = None, **settings: Any) -> Any:
        """u(t, x̂) (*batch, m) after readings y (*batch, p), within the limits of the controls.

        It acts at once, or `delay` steps later; `acting` is the control that acts until the next call.

        Args:
            y: the readings; NaN for one that is missing.
            applied: the control that the plant received since the last call, if it was not `acting`; ignored in the
                first call.
            settings: new values of settings of a family, such as a target, each a number or (*batch,). Settings that
                are left out keep their values, initially the middle of their ranges. The horizon restarts if one
                changes.

        Raises:
            ValueError: the shapes do not fit, a reading is infinite, or a setting is unknown or outside its range.
        """
        self.observe(y, applied)
        if settings:
            self._change(settings)
        if self._due is None:
            at_rest = self._controls.project(self.problem.rest.to(self._belief.x))
            self._due = at_rest.expand(self.delay + 1, *self._belief.x.shape[:-1], -1)
        like, x = self.state_of_law, self._belief.x
        for u in self._due[:-1]:
            x = self.problem.step(x, u)[0]
        t = self._t - self._began + self.delay * self.problem.horizon.dt
        u = self.without_disturbances(self.law(like.new_tensor(t), x[..., : len(like)].to(like)).detach(), x)
        self._due = torch.cat([self._due[:-1], u.double().cpu()[None]])
        return like_given(y, u)

    @property
    def acting(self) -> Any:
        """The control (*batch, m) that acts until the next call of `step`; available after the first call."""
        if self._due is None:
            raise ValueError("Expected acting after a call of step, got none since the reset; call step first.")
        return like_given(self._like, self._due[0])

    def without_disturbances(self, u: Control, x: State) -> Control:
        """u − d̂ within the limits, for the estimate x (*batch, n); u if no disturbance is estimated."""
        if not self._disturbed:
            return u
        disturbed = torch.tensor(self._disturbed, device=u.device)
        return self._controls.project(u.index_add(-1, disturbed, self._disturbances(x).to(u), alpha=-1))

    def corrected(self, belief: Belief, y: Readings) -> Belief:
        """The belief after readings y, with parameters within their ranges."""
        return self._clamp_parameters(self.filter.update(belief, y))

    @torch.no_grad()
    def observe(self, y: Any, applied: Any = None) -> None:
        """Update the estimate by readings y without computing a control; see `step`."""
        readings, p = _float64(y), self.outputs.count
        batch = tuple(self._belief.x.shape[:-1])
        if readings.ndim < 1 or readings.shape[-1] != p or (self._due is not None and readings.shape[:-1] != batch):
            expected = f"(*batch, {p})" if self._due is None else str((*batch, p))
            raise ValueError(
                f"Expected y of shape {expected}, got {tuple(readings.shape)}; the last axis holds "
                f"{', '.join(self.outputs.names)}."
            )
        if bool(readings.isinf().any()):
            raise ValueError("Expected finite readings, got an infinite one; write NaN for one that is missing.")
        self._like = y
        if self._due is None:
            belief = self._first_estimate(tuple(readings.shape[:-1]))
        else:
            u = self._due[0] if applied is None else self._applied(applied, self._due[0])
            self._due = torch.cat([self._due[1:], self._due[-1:]])  # without a new control the last one continues
            belief, self._t = self.filter.predict(self._belief, u), self._t + self.problem.horizon.dt
        self._belief = self.corrected(belief, readings)

    def named_settings(self, states: Tensor) -> dict[str, Tensor]:
        """Settings by name, as `step` takes them, from their entries of states, (*batch, k); weights from log₁₀."""
        names = self.problem.system.state_names
        return {
            name: 10**entry if names[i].startswith(LOGARITHM) else entry
            for (name, i), entry in zip(self.settings.items(), states.unbind(-1), strict=True)
        }

    def _change(self, settings: Mapping[str, Any]) -> None:
        """Change settings; if one differs, the horizon restarts."""
        x, box = self._belief.x.clone(), self.problem.initial_states
        for name, value in settings.items():
            if name not in self.settings:
                known = ", ".join(self.settings) or "none"
                raise ValueError(f"Expected settings among {known}, got {name!r}; correct the name, or leave it out.")
            i = self.settings[name]
            low, high, number = float(box.lower[i]), float(box.upper[i]), _float64(value)
            weight = self.problem.system.state_names[i].startswith(LOGARITHM)
            number = number.log10() if weight else number
            if number.ndim and number.shape != x.shape[:-1]:
                raise ValueError(
                    f"Expected {name} as a number or of shape {tuple(x.shape[:-1])}, got {tuple(number.shape)}."
                )
            room = ROUNDING * max(abs(low), abs(high))
            if not bool(((low - room <= number) & (number <= high + room)).all()):
                low, high = (10**low, 10**high) if weight else (low, high)
                raise ValueError(f"Expected {name} from {low:g} to {high:g}, for which V was trained, got {value}.")
            x[..., i] = number
        if self._due is not None and not torch.equal(x, self._belief.x):
            self._began = self._t
        self._belief = self._belief._replace(x=x)

    @staticmethod
    def _applied(given: Any, own: Tensor) -> Tensor:
        """The control that the plant received, in the shape of the returned control."""
        u = _float64(given)
        if u.shape != own.shape or not bool(u.isfinite().all()):
            raise ValueError(
                f"Expected applied as finite numbers of shape {tuple(own.shape)}, that of the control returned, got "
                f"{u.tolist() if u.numel() < 7 else tuple(u.shape)}; leave it out if the plant received that one."
            )
        return u

    def _clamp_parameters(self, belief: Belief) -> Belief:
        """The belief with estimates of parameters p moved into their ranges, beyond which f and V may be undefined."""
        if not self.ranged:
            return belief
        x, (lower, upper) = belief.x.clone(), self._ends
        x[..., self.ranged] = x[..., self.ranged].clamp(lower, upper)
        return belief._replace(x=x)

    @property
    def _ends(self) -> tuple[Tensor, Tensor]:
        box = self.problem.initial_states
        return box.lower[self.ranged], box.upper[self.ranged]

    def _first_estimate(self, batch: tuple[int, ...]) -> Belief:
        """The first estimate of each loop of a batch."""
        x, P = self._belief
        try:
            return Belief(x.expand(*batch, -1), P.expand(*batch, -1, -1))
        except RuntimeError as error:
            raise ValueError(
                f"Expected readings of as many loops as x_hat and P of the reset, {tuple(x.shape[:-1])} and "
                f"{tuple(P.shape[:-2])}, got {batch}; reset first."
            ) from error


def _float64(given: Any) -> Tensor:
    return torch.as_tensor(given, dtype=torch.float64, device="cpu").detach()


def _is_covariance(P: Tensor) -> bool:
    size = P.abs().amax((-1, -2), keepdim=True)
    symmetric = bool(((P - P.mT).abs() <= 1e-9 * size).all())
    return symmetric and bool((torch.linalg.eigvalsh(P) >= -1e-9 * size[..., 0]).all())


def like_given(given: Any, result: Any) -> Any:
    """The result as a tensor if a tensor was given, else as an array."""
    return result if isinstance(given, Tensor) else result.numpy(force=True)
