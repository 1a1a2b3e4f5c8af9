"""Many trajectories of a task at once, as a vectorised environment of Stable-Baselines3."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from lyapnet.base.types import State
from lyapnet.lab.comparison.environments import Episodes
from lyapnet.lab.comparison.reference_problems import bounded_problem
from lyapnet.task.problem import Problem


class VectorEnvironment(VecEnv):
    """Many trajectories of a task in one batch of torch operations, as a vectorised environment of SB3.

    Each is an Environment; they start and end together, and start again at once from fresh states of X₀.

    Args:
        task, control_scale, observe_time: as for Environment.
        num_envs: trajectories.
        truncates: whether the end of the horizon is called a truncation, as for Environment. SB3 then adds its own
            estimate of what lies beyond it, which is right for a task that goes on and wrong for J_N: with false, the
            return that is learned is −J_N.
        seed: for the draws from X₀, and of noise.
    """

    def __init__(
        self,
        task: str | Path | Problem,
        num_envs: int,
        control_scale: Sequence[float] | None = None,
        observe_time: bool = False,
        truncates: bool = True,
        seed: int = 0,
    ):
        self.episodes = Episodes(bounded_problem(task, control_scale), observe_time)
        self.truncates, self.generator = truncates, torch.Generator().manual_seed(seed)
        self._actions = np.zeros((num_envs, self.episodes.problem.system.m))
        super().__init__(num_envs, self.episodes.observation_space, self.episodes.action_space)

    @property
    def state(self) -> np.ndarray:
        """x, (num_envs, n)."""
        return self.episodes.state.numpy().copy()

    def reset(self) -> np.ndarray:
        if (seed := self._seeds[0]) is not None:
            self.generator.manual_seed(seed)
        self._reset_seeds()
        return self.start(self.episodes.problem.initial_states.sample(self.num_envs, self.generator))

    def start(self, x0: State) -> np.ndarray:
        """Start at x₀ (num_envs, n) instead of random states of X₀; return the first observations."""
        self.episodes.start(x0)
        return self.episodes.observation

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        problem, x = self.episodes.problem, self.episodes.state
        noise = problem.noise
        increment = None if noise is None else noise.draw(1, problem.horizon.dt, x, self.generator)[0]
        rewards = self.episodes.advance(self._actions, increment).numpy()
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
        """The state of the trajectories and of the random generator, for `resume`."""
        episodes = self.episodes
        return {
            "state": episodes.state, "step": episodes.step, "generator": self.generator.get_state(),
            "clipped": episodes.clipped, "controls": episodes.controls,
        }  # fmt: skip

    def resume(self, position: dict[str, Any]) -> None:
        """Continue from a `position`, regardless of seeds that were set since."""
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
