"""A learned controller with the interface of a policy of Stable-Baselines3."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from lyapnet.controller.controller import Controller


class ControllerPolicy:
    """a = u(t, x) / control_scale, with the `predict` of SB3: its evaluate_policy scores a Controller like any model.

    Time comes with the observation, where that has n + 1 entries; else it is counted from the start of each episode, in
    the state that SB3 hands from call to call, as for a recurrent policy.

    Args:
        controller: what `lyapnet.load` gives.
        control_scale: the physical control at a = 1, as the environment has it.
    """

    def __init__(self, controller: Controller, control_scale: Sequence[float] | np.ndarray):
        self.controller, self.control_scale = controller, np.asarray(control_scale, dtype=float)

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """The actions for observations (*batch, n or n + 1), and the steps counted so far.

        Raises:
            ValueError: observations of another width.
        """
        x, n = np.asarray(observation, dtype=float), self.controller.system.n
        if x.shape[-1] not in (n, n + 1):
            raise ValueError(
                f"Expected observations of {n} or {n + 1} entries, got {x.shape[-1]}; the state, and time."
            )
        if x.shape[-1] == n + 1:
            return self._action(x[..., -1], x[..., :-1]), state
        steps = np.zeros(x.shape[:-1], dtype=int) if state is None else state[0]
        if episode_start is not None:
            steps = np.where(np.reshape(episode_start, steps.shape), 0, steps)
        return self._action(steps * self.controller.horizon.dt, x), (steps + 1,)

    def _action(self, t: np.ndarray, x: np.ndarray) -> np.ndarray:
        u, like = torch.as_tensor(self.controller.policy(t, x)), self.controller.initial_states.lower
        return self.controller.controls.asked(torch.as_tensor(x).to(like), u).numpy() / self.control_scale
