"""What training leaves behind: V, the control law, and the closed loop of a checkpoint."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, overload

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from lyapnet.build import Task, build_rollout, build_task, build_value_function
from lyapnet.checkpoint import KEY, read_checkpoint
from lyapnet.closed_loop import ClosedLoop
from lyapnet.config import Config, config_from_plain
from lyapnet.cost import QuadraticCost
from lyapnet.errors import CheckpointError, UsageError
from lyapnet.networks import NETWORKS
from lyapnet.rollout import Horizon, Trajectory
from lyapnet.sets import Box
from lyapnet.systems import SYSTEMS, ControlAffineSystem


class Controller:
    """V(t, x), u(t, x) and the closed loop they define.

    Tensors in, tensors out (of the controller's dtype); arrays and lists in, NumPy arrays out.
    """

    def __init__(self, config: Config, task: Task, V: nn.Module):
        self.config = config
        self._task, self._V = task, V.requires_grad_(False).eval()
        self._rollout = build_rollout(config, task, V)

    @property
    def system(self) -> ControlAffineSystem:
        """ẋ = f(x) + g(x)u."""
        return self._task.system

    @property
    def cost(self) -> QuadraticCost:
        """ℓ and φ."""
        return self._task.cost

    @property
    def horizon(self) -> Horizon:
        """N (`steps`), Δt (`dt`) and T (`duration`)."""
        return self._task.horizon

    @property
    def initial_states(self) -> Box:
        """X₀."""
        return self._task.initial_states

    @property
    def V(self) -> nn.Module:
        """The value function as a module: (t, x) ↦ (*batch,)."""
        return self._V

    @property
    def closed_loop(self) -> ClosedLoop:
        """(t, (x, ∫ℓ)) ↦ its derivative under u(t, x), as a module."""
        return self._rollout.closed_loop

    @overload
    def value(self, t: Tensor | float, x: Tensor) -> Tensor: ...
    @overload
    def value(self, t: ArrayLike, x: ArrayLike) -> np.ndarray: ...
    def value(self, t: Any, x: Any) -> Any:
        """V(t, x): t scalar or (*batch,) in s, x (*batch, n); returns (*batch,).

        Raises:
            ValueError: the shapes do not fit; names the expected ones.
        """
        return self._answer(self._V, t, x)

    @overload
    def policy(self, t: Tensor | float, x: Tensor) -> Tensor: ...
    @overload
    def policy(self, t: ArrayLike, x: ArrayLike) -> np.ndarray: ...
    def policy(self, t: Any, x: Any) -> Any:
        """u(t, x): t scalar or (*batch,) in s, x (*batch, n); returns (*batch, m).

        Raises:
            ValueError: the shapes do not fit; names the expected ones.
        """
        return self._answer(self.closed_loop.policy, t, x)

    def rollout(self, x0: Any) -> Trajectory:
        """The closed loop from x₀ (*batch, n), over the whole horizon; a Trajectory of what x₀ is, tensors or arrays.

        Raises:
            ValueError: the shape does not fit.
            DivergenceError: the closed loop leaves the finite numbers.
        """
        with torch.no_grad():
            trajectory = self._rollout(self._state(x0))
        return Trajectory(*(_like(x0, field) for field in trajectory))

    def _answer(self, function: Callable[[Tensor, Tensor], Tensor], t: Any, x: Any) -> Any:
        time, state = self._inputs(t, x)
        with torch.set_grad_enabled(torch.is_grad_enabled() and (time.requires_grad or state.requires_grad)):
            return _like(x, function(time, state))

    def _inputs(self, t: Any, x: Any) -> tuple[Tensor, Tensor]:
        state = self._state(x)
        time = torch.as_tensor(t, dtype=state.dtype, device=state.device)
        batch = tuple(state.shape[:-1])
        if time.ndim and tuple(time.shape) != batch:
            raise ValueError(f"Expected t scalar or of shape {batch}, got {tuple(time.shape)}; give a time per state.")
        return time, state

    def _state(self, x: Any) -> Tensor:
        like = self.initial_states.lower
        state = torch.as_tensor(x, dtype=like.dtype, device=like.device)
        n = self.system.n
        if not state.ndim or state.shape[-1] != n:
            names = ", ".join(self.system.state_names)
            raise ValueError(
                f"Expected x of shape (*batch, {n}), got {tuple(state.shape)}; the last axis holds {names}."
            )
        return state


def _like(given: Any, result: Tensor) -> Any:
    return result if isinstance(given, Tensor) else result.detach().cpu().numpy()


def load(
    path: str | Path,
    *,
    system: ControlAffineSystem | None = None,
    network: type[nn.Module] | None = None,
    device: str | torch.device = "cpu",
) -> Controller:
    """The controller of a checkpoint. Nothing that the file names is imported or run.

    Args:
        path: a .ckpt file of a run.
        system: needed where the run's system is not one of SYSTEMS; it replaces the one in the checkpoint.
        network: likewise, the class of a network that is not one of NETWORKS.
        device: where the tensors go.

    Raises:
        UsageError: no such file; or a class of the user's own that was not passed.
        CheckpointError: the file is truncated, foreign, or does not fit its own config.
    """
    content = read_checkpoint(path, device)
    config = config_of(content, path)
    for argument, given, name, registry in (
        ("system", system, config.system.name, SYSTEMS),
        ("network", network, config.network.name, NETWORKS),
    ):
        if given is None and name not in registry:
            raise UsageError(
                f"Expected {argument}=… for {str(path)!r}, got none; it was trained with {name}, and loading a file "
                f"never imports what the file names: pass {argument}=… to load, or --{argument} to lyapnet evaluate."
            )
    task = build_task(config, system)
    V = build_value_function(config, task, network)
    load_value_function(V, content, path)
    for module in (task.system, task.cost, task.initial_states, V):
        module.to(device)
    return Controller(config, task, V)


def config_of(content: dict[str, Any], path: str | Path) -> Config:
    """The config in the content of a checkpoint file.

    Raises:
        CheckpointError: there is none that this version understands.
    """
    plain = content[KEY].get("config")
    try:
        if not isinstance(plain, dict):
            raise UsageError(f"Expected a config, got {type(plain).__name__}")
        if "${" in json.dumps(plain, ensure_ascii=False):  # resolving one may read the environment, or call a function
            raise UsageError("Expected plain values, got an interpolation ${…}")
        return config_from_plain(plain)
    except UsageError as error:
        raise CheckpointError(
            f"Expected a checkpoint of this version of lyapnet, got {str(path)!r}: {error}"
        ) from error


def load_value_function(V: nn.Module, content: dict, path: str | Path) -> None:
    """Put a checkpoint's weights into V.

    Raises:
        CheckpointError: naming the tensors that differ; or it holds the weights of several seeds.
    """
    if content[KEY].get("config", {}).get("seeds", 1) > 1:
        raise CheckpointError(
            f"Expected the checkpoint of one seed, got {str(path)!r}, which holds several; use "
            "checkpoints/best.ckpt in a seed's folder beside it."
        )
    prefix = "V."
    weights = {key.removeprefix(prefix): w for key, w in content["state_dict"].items() if key.startswith(prefix)}
    own = V.state_dict()
    where = {True: "checkpoint", False: "config"}
    differing = [f"{key} is only in the {where[key in weights]}" for key in own.keys() ^ weights.keys()]
    differing += [
        f"{key} has shape {tuple(weights[key].shape)} in the checkpoint and {tuple(own[key].shape)} in the config"
        for key in own.keys() & weights.keys()
        if own[key].shape != weights[key].shape
    ]
    if differing:
        shown = "; ".join(sorted(differing)[:6]) + (f"; and {len(differing) - 6} more" if len(differing) > 6 else "")
        raise CheckpointError(
            f"Expected the network of {str(path)!r}, got another one: {shown}. Use the checkpoint's network section."
        )
    V.load_state_dict(weights)
