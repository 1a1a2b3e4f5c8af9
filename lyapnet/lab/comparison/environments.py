"""Tasks as environments of reinforcement learning, with Gymnasium's interface, one trajectory each.

Importing this registers them: gymnasium.make("lyapnet.lab.comparison.environments:lyapnet/Reacher-v0") does it by
itself.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from jaxtyping import Float
from torch import Tensor

from lyapnet.base.errors import DivergenceError, UsageError
from lyapnet.base.types import PerState, State
from lyapnet.lab.comparison.reference_problems import BoundedProblem, bounded_problem
from lyapnet.task.problem import Problem


class Episodes:
    """Trajectories of a task (*batch,) that start together: x_{n+1} = F(x_n, u_n), with u = scale · clip(a, ±1).

    F is the problem's step with u held, x_n + Δt(f + gu) with Euler. A control outside U is projected onto it. The
    reward of step n is what it costs, −Δt ℓ(x_n, u_n) with Euler, and −φ(x_N) with the last: an episode's undiscounted
    return is −J_N(x₀).

    With noise x_{n+1} = F(x_n, u_n) + σ(x_n)ΔW_n, by Euler–Maruyama as in training, and a return is that of one path.
    """

    def __init__(self, bounded: BoundedProblem, observe_time: bool):
        self.problem, self.observe_time = bounded.problem, observe_time
        like = bounded.problem.initial_states.lower
        self.scale = torch.tensor(bounded.control_scale).to(like)
        system, n = bounded.problem.system, len(like) + observe_time
        self.observation_space = spaces.Box(-np.inf, np.inf, (n,), np.float64)
        self.action_space = spaces.Box(-1.0, 1.0, (system.m,), np.float32)
        self.state, self.step, self.control = like, 0, self.scale
        self.clipped = self.controls = 0

    def start(self, x0: State) -> None:
        """Start at x₀ (*batch, n)."""
        self.state, self.step = x0, 0

    def advance(self, action: np.ndarray, increment: Float[Tensor, "*batch sources"] | None = None) -> PerState:
        """One step; the rewards (*batch,).

        Args:
            increment: ΔW of the step in √s; None: the task has no noise.

        Raises:
            ValueError: actions of another shape; or noise without ΔW, or ΔW without noise.
        """
        noise = self.problem.noise
        if (noise is None) != (increment is None):
            raise ValueError("Expected increments with a task that has noise, and none with another; correct the call.")
        given = torch.tensor(np.asarray(action)).to(self.scale)
        if given.shape != (*self.state.shape[:-1], len(self.scale)):
            raise ValueError(
                f"Expected actions of shape {(*self.state.shape[:-1], len(self.scale))}, got {tuple(given.shape)}; "
                "one a_i for each control."
            )
        self.clipped += int((given.abs() >= 1).sum())  # = 1 counts, as algorithms clip actions before they step
        self.controls += given.numel()
        controls = self.problem.controls
        asked = controls.project(self.scale * given.clamp(-1, 1))
        following, paid = self.problem.step(self.state, asked)
        self.control = controls.applied(self.state, asked)
        if noise is not None and increment is not None:
            following = following + noise.displacement(self.state, increment)
        self.state = following
        self.step += 1
        return -paid - self.problem.cost.terminal(self.state) if self.over else -paid

    def require_finite(self) -> None:
        """Check that the states are finite.

        Raises:
            DivergenceError: naming the first such state.
        """
        lost = torch.nonzero(~torch.isfinite(self.state).all(-1).reshape(-1)).flatten()
        if len(lost):
            first = self.state.reshape(-1, self.state.shape[-1])[lost[0]].tolist()
            raise DivergenceError(
                f"Expected finite states, got x = {first} at step {self.step} in one of {len(lost)} trajectories; "
                "lower control_scale or Δt."
            )

    @property
    def over(self) -> bool:
        """Whether the horizon is reached."""
        return self.step >= self.problem.horizon.steps

    @property
    def observation(self) -> np.ndarray:
        """x, and t in s where it is observed, (*batch, n or n + 1)."""
        x = self.state
        if self.observe_time:
            time = torch.full_like(x[..., :1], self.step * self.problem.horizon.dt)
            x = torch.cat([x, time], -1)
        return x.numpy().copy()

    @property
    def clipped_fraction(self) -> float:
        """Share of all controls so far that were at or beyond the bounds of the action box."""
        return self.clipped / max(self.controls, 1)


class Environment(gymnasium.Env[np.ndarray, np.ndarray]):
    """A task as a Gymnasium environment; the horizon ends an episode by truncation, and nothing terminates it early.

    The observation is x, in the units of the system, and the action a ∈ [−1, 1]^m: u = control_scale · a, in the units
    of the control. `state` is x; info holds "control", the u that was applied, and "clipped", whether some a_i was at
    or beyond its bound. `reset(options={"state": x0})` starts from x₀ instead of drawing it from X₀.

    A task with noise draws it from `np_random`, after x₀: the seed of `reset` tells the whole path.

    Args:
        task: a reference task by name, a config file, or a Problem; lyapnet/Task-v0 makes an environment of any.
        control_scale: max |u_i|; known for the reference tasks.
        observe_time: join t in s to the observation: the optimal control depends on it.
        render_mode: "rgb_array": `render` returns a picture of the present, as `lyapnet animate` draws it.

    Raises:
        UsageError: another render_mode; or see bounded_problem.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 100}  # noqa: RUF012  (Gymnasium's own declaration)

    def __init__(
        self,
        task: str | Path | Problem | None = None,
        control_scale: float | Sequence[float] | None = None,
        observe_time: bool = False,
        render_mode: str | None = None,
    ):
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise UsageError(f'Expected render_mode="rgb_array" or none, got {render_mode!r}; it is the only one.')
        self._episode = Episodes(bounded_problem(task, control_scale), observe_time)
        self.observation_space, self.action_space = self._episode.observation_space, self._episode.action_space
        self.metadata = {**self.metadata, "render_fps": round(1 / self.problem.horizon.dt, 3)}  # real time
        self.render_mode, self._picture = render_mode, None
        if render_mode is not None:
            from lyapnet.evaluation.scenes import Picture  # imports matplotlib, which training does not need

            self._picture = Picture(self.problem)

    @property
    def problem(self) -> Problem:
        """System, cost, X₀ and horizon."""
        return self._episode.problem

    @property
    def state(self) -> np.ndarray:
        """x, (n,)."""
        return self._episode.state.numpy().copy()

    @property
    def control_scale(self) -> np.ndarray:
        """The physical control at a = 1, (m,)."""
        return self._episode.scale.numpy().copy()

    @property
    def clipped_fraction(self) -> float:
        """Share of all controls so far that were at or beyond the bounds of the action box."""
        return self._episode.clipped_fraction

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        box = self.problem.initial_states
        drawn = self.np_random.uniform(box.lower.numpy(), box.upper.numpy())
        x0 = np.asarray((options or {}).get("state", drawn))
        if x0.shape != drawn.shape:
            raise ValueError(f'Expected options["state"] of shape {drawn.shape}, got {x0.shape}; give one state.')
        self._episode.start(torch.as_tensor(x0).to(box.lower))
        if self._picture is not None:
            self._picture.begin(self.state)
        return self._episode.observation, {}

    def _increment(self) -> Tensor | None:
        """ΔW of the next step, (k,); None without noise."""
        noise, dt = self.problem.noise, self.problem.horizon.dt
        if noise is None:
            return None
        drawn = math.sqrt(dt) * self.np_random.standard_normal(noise.sources)
        return torch.from_numpy(drawn).to(self._episode.state)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        reward = float(self._episode.advance(action, self._increment()))
        self._episode.require_finite()
        info = {"control": self._episode.control.numpy().copy(), "clipped": bool((np.abs(action) >= 1).any())}
        if self._picture is not None:
            self._picture.go_on(self.state, info["control"])
        return self._episode.observation, reward, False, self._episode.over, info

    def render(self) -> np.ndarray | None:
        """The present as (height, width, 3) bytes; None without a render_mode.

        Raises:
            ResetNeeded: no episode has begun.
            UsageError: the system's `draw` fails.
        """
        if self._picture is None:
            gymnasium.logger.warn('render() shows nothing without render_mode="rgb_array".')
            return None
        if not self._picture.path:
            raise gymnasium.error.ResetNeeded("Expected reset() before render(), got none; call it first.")
        return self._picture.frame()


IDS = {
    "double_integrator": "lyapnet/DoubleIntegrator-v0",
    "cartpole_balancing": "lyapnet/CartpoleBalancing-v0",
    "cartpole_swingup": "lyapnet/CartpoleSwingUp-v0",
    "reacher": "lyapnet/Reacher-v0",
}

_ENTRY = f"{__name__}:{Environment.__name__}"
gymnasium.register(id="lyapnet/Task-v0", entry_point=_ENTRY)  # task=… is any
for _name, _id in IDS.items():
    gymnasium.register(id=_id, entry_point=_ENTRY, kwargs={"task": _name})
