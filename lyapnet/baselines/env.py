"""Every task as an environment of reinforcement learning: one trajectory (Gymnasium), or many at once (SB3)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from lyapnet.baselines.tasks import BoundedTask, bounded_task
from lyapnet.build import Task
from lyapnet.errors import DivergenceError
from lyapnet.types import PerState, State


class EulerEpisodes:
    """Trajectories of a task (*batch,) that start together: x_{n+1} = x_n + Δt(f + gu), with u = scale · clip(a, ±1).

    The reward of step n is −Δt ℓ(x_n, u_n), and −φ(x_N) with the last: an episode's undiscounted return is −J_N(x₀).
    """

    def __init__(self, bounded: BoundedTask, observe_time: bool):
        self.task, self.observe_time = bounded.task, observe_time
        like = bounded.task.initial_states.lower
        self.scale = torch.tensor(bounded.control_scale).to(like)
        system, n = bounded.task.system, len(like) + observe_time
        self.observation_space = spaces.Box(-np.inf, np.inf, (n,), np.float64)
        self.action_space = spaces.Box(-1.0, 1.0, (system.m,), np.float32)
        self.state, self.step, self.control = like, 0, self.scale
        self.clipped = self.controls = 0

    def start(self, x0: State) -> None:
        """Begin at x₀ (*batch, n)."""
        self.state, self.step = x0, 0

    def advance(self, action: np.ndarray) -> PerState:
        """One step; the rewards (*batch,).

        Raises:
            ValueError: actions of another shape.
        """
        given = torch.tensor(np.asarray(action)).to(self.scale)
        if given.shape != (*self.state.shape[:-1], len(self.scale)):
            raise ValueError(
                f"Expected actions of shape {(*self.state.shape[:-1], len(self.scale))}, got {tuple(given.shape)}; "
                "one a_i for each control."
            )
        self.clipped += int((given.abs() >= 1).sum())  # at the bound: learners clip before they ask
        self.controls += given.numel()
        self.control = self.scale * given.clamp(-1, 1)
        system, cost, _, horizon = self.task
        reward = -horizon.dt * cost.running(self.state, self.control)
        self.state = self.state + horizon.dt * system.dynamics(self.state, self.control)
        self.step += 1
        return reward - cost.terminal(self.state) if self.over else reward

    def require_finite(self) -> None:
        """Refuse to go on with a state that left the finite numbers.

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
        return self.step >= self.task.horizon.steps

    @property
    def observation(self) -> np.ndarray:
        """x, and t in s where it is observed, (*batch, n or n + 1)."""
        x = self.state
        if self.observe_time:
            time = torch.full_like(x[..., :1], self.step * self.task.horizon.dt)
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

    Args:
        task: a reference task by name, a config file, or a Task; lyapnet/Task-v0 makes an environment of any.
        control_scale: max |u_i|; known for the reference tasks.
        observe_time: join t in s to the observation: the optimal control depends on it.

    Raises:
        UsageError: see bounded_task.
    """

    metadata = {"render_modes": []}  # noqa: RUF012  (Gymnasium's own declaration)

    def __init__(
        self,
        task: str | Path | Task | None = None,
        control_scale: float | Sequence[float] | None = None,
        observe_time: bool = False,
    ):
        self._episode = EulerEpisodes(bounded_task(task, control_scale), observe_time)
        self.observation_space, self.action_space = self._episode.observation_space, self._episode.action_space
        self.render_mode = None

    @property
    def task(self) -> Task:
        """System, cost, X₀ and horizon."""
        return self._episode.task

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
        box = self.task.initial_states
        drawn = self.np_random.uniform(box.lower.numpy(), box.upper.numpy())
        x0 = np.asarray((options or {}).get("state", drawn))
        if x0.shape != drawn.shape:
            raise ValueError(f'Expected options["state"] of shape {drawn.shape}, got {x0.shape}; give one state.')
        self._episode.start(torch.as_tensor(x0).to(box.lower))
        return self._episode.observation, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        reward = float(self._episode.advance(action))
        self._episode.require_finite()
        info = {"control": self._episode.control.numpy().copy(), "clipped": bool((np.abs(action) >= 1).any())}
        return self._episode.observation, reward, False, self._episode.over, info


class VectorEnvironment(VecEnv):
    """Many trajectories of a task in one batch of torch operations, as a vectorised environment of SB3.

    Each is an Environment; they start and end together, and start again at once from fresh states of X₀.

    Args:
        task, control_scale, observe_time: as of Environment.
        num_envs: trajectories.
        truncates: whether the end of the horizon is called a truncation, as of Environment. SB3 then adds its own
            estimate of what lies beyond it, which is right for a task that goes on and wrong for J_N: with false, the
            return that is learned is −J_N.
        seed: of the draws of X₀.
    """

    def __init__(
        self,
        task: str | Path | Task,
        num_envs: int,
        control_scale: Sequence[float] | None = None,
        observe_time: bool = False,
        truncates: bool = True,
        seed: int = 0,
    ):
        self.episodes = EulerEpisodes(bounded_task(task, control_scale), observe_time)
        self.truncates, self.generator = truncates, torch.Generator().manual_seed(seed)
        self._actions = np.zeros((num_envs, self.episodes.task.system.m))
        super().__init__(num_envs, self.episodes.observation_space, self.episodes.action_space)

    @property
    def state(self) -> np.ndarray:
        """x, (num_envs, n)."""
        return self.episodes.state.numpy().copy()

    def reset(self) -> np.ndarray:
        if (seed := self._seeds[0]) is not None:
            self.generator.manual_seed(seed)
        self._reset_seeds()
        return self.start(self.episodes.task.initial_states.sample(self.num_envs, self.generator))

    def start(self, x0: State) -> np.ndarray:
        """Begin at x₀ (num_envs, n) instead of states drawn from X₀; the first observations."""
        self.episodes.start(x0)
        return self.episodes.observation

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        rewards = self.episodes.advance(self._actions).numpy()
        self.episodes.require_finite()
        applied = zip(self.episodes.control.numpy(), np.abs(self._actions), strict=True)
        infos: list[dict[str, Any]] = [{"control": u, "clipped": bool((a >= 1).any())} for u, a in applied]
        over, observation = self.episodes.over, self.episodes.observation
        if over:
            for info, last in zip(infos, observation, strict=True):
                info |= {"terminal_observation": last, "TimeLimit.truncated": self.truncates}
            observation = self.reset()
        return observation, rewards, np.full(self.num_envs, over), infos

    def position(self) -> dict[str, Any]:
        """Where the trajectories and their draws are, for `resume`."""
        episodes = self.episodes
        return {
            "state": episodes.state, "step": episodes.step, "generator": self.generator.get_state(),
            "clipped": episodes.clipped, "controls": episodes.controls,
        }  # fmt: skip

    def resume(self, position: dict[str, Any]) -> None:
        """Go on from a `position`, whatever seed was asked for since."""
        self._reset_seeds()
        self.generator.set_state(position["generator"])
        for name in ("state", "step", "clipped", "controls"):
            setattr(self.episodes, name, position[name])

    def close(self) -> None:
        pass

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        if attr_name == "state":
            return [self.state[i] for i in self._get_indices(indices)]
        value = None if attr_name == "render_mode" else getattr(self.episodes, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError("Expected no change of one trajectory among many; make another VectorEnvironment.")

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        raise NotImplementedError("Expected no method of one trajectory among many; use those of VectorEnvironment.")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]


class Costs(NamedTuple):
    """What a policy costs from each of a batch (b,) of states."""

    cost: PerState  # J_N = Δt Σℓ_n + φ; ∞ where the closed loop left the finite numbers
    sum: PerState  # Σℓ_n + φ, as the paper has it
    clipped_fraction: float  # share of controls at the bounds of the action box


def costs_of(policy: Any, bounded: BoundedTask, observe_time: bool, x0: State) -> Costs:
    """What a policy with SB3's `predict` costs from each of x₀ (b, n), without exploration; clipped as in training."""
    episodes, dt = EulerEpisodes(bounded, observe_time), bounded.task.horizon.dt
    episodes.start(x0)
    cost, memory, start = torch.zeros_like(x0[:, 0]), None, np.ones(len(x0), dtype=bool)
    while not episodes.over:
        action, memory = policy.predict(episodes.observation, state=memory, episode_start=start, deterministic=True)
        cost, start = cost - episodes.advance(action), np.zeros(len(x0), dtype=bool)
        lost = ~torch.isfinite(episodes.state).all(-1)
        cost[lost] = torch.inf
        episodes.state[lost] = 0  # a policy cannot be asked about what is no number
    terminal = bounded.task.cost.terminal(episodes.state)
    cost = torch.nan_to_num(cost, nan=torch.inf, posinf=torch.inf)
    return Costs(cost, (cost - terminal) / dt + terminal, episodes.clipped_fraction)
