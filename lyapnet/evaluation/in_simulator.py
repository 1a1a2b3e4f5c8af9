"""Closed loops in MuJoCo's simulator, whose model may have contacts, friction and actuators."""

import math
import os
import sys
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from lyapnet.base.errors import UsageError, did_you_mean, one_line
from lyapnet.base.names import identifier, with_underscores
from lyapnet.base.types import PerState, State
from lyapnet.controller.controller import Controller
from lyapnet.evaluation.references import costs_of_plant
from lyapnet.task.models.robots import FORCE, RATE, TORQUE
from lyapnet.value.expansions import in_float64

AS_GOOD = 1.1  # ratio of the costs in the simulator and with the model up to which a closed loop counts as good


class Plant(NamedTuple):
    """A MuJoCo model with the indices of the controller's states and controls in it.

    Args:
        positions: for each state that is a position, (state, index in qpos).
        rates: for each state that is a rate, (state, index in qvel).
        actuators: for each control with an actuator, (control, index in ctrl).
        joints: for each control that is a force on a joint, (control, index in qfrc_applied).
    """

    mujoco: Any
    model: Any
    positions: list[tuple[int, int]]
    rates: list[tuple[int, int]]
    actuators: list[tuple[int, int]]
    joints: list[tuple[int, int]]


class SimulatedLoops(NamedTuple):
    """Closed loops from some states, in the simulator and with the controller's model.

    Args:
        cost: ∫ℓ dt + φ in the simulator with u held for Δt; infinite if the simulation became unstable.
        model_cost: the same with the model in continuous time.
        positions: positions of all joints in the first closed loop, (N + 1, …).
    """

    cost: PerState
    model_cost: PerState
    positions: NDArray

    def summary(self) -> dict[str, float]:
        """Mean costs, their ratio, the largest ratio, and the shares of finite and of good loops."""
        ratio = self.cost / self.model_cost
        finite = self.cost.isfinite()
        return {
            "simulated_cost_mean": float(self.cost.mean()),
            "model_cost_mean": float(self.model_cost.mean()),
            "cost_ratio": float(self.cost.mean() / self.model_cost.mean()),
            "largest_ratio": float(ratio.max()),
            "finite_fraction": float(finite.double().mean()),
            "as_good_fraction": float((ratio <= AS_GOOD).double().mean()),
        }


def read_plant(path: Path, controller: Controller, drawn: bool = False) -> Plant:
    """The plant of an MJCF or URDF file.

    A state is a joint of that name, or JOINT_rate its rate; a control is an actuator, or JOINT_torque and JOINT_force a
    force on a joint.

    Args:
        drawn: whether MuJoCo is to draw it too, which needs a library that is chosen before MuJoCo is imported.

    Raises:
        UsageError: MuJoCo is missing or cannot read the file, or a name is not in it.
    """
    if drawn and sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & {*os.environ}:
        os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        mujoco: Any = import_module("mujoco")
    except ImportError as error:
        raise UsageError("Expected MuJoCo for --plant, got none; pip install 'lyapnet[mujoco]'.") from error
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:  # no such file, no XML, or no model
        raise UsageError(
            f"Expected an MJCF or URDF file for --plant, got {str(path)!r} ({one_line(error)[:200]}); correct it."
        ) from error
    system = controller.system
    if controller.problem.noise is not None or system.constants or system.settings:
        raise UsageError("Expected one task without noise and references for --plant, got another; leave it out.")
    kinds = mujoco.mjtObj

    def names_of(kind: Any, count: int) -> dict[str, int]:
        names = (mujoco.mj_id2name(model, kind, k) for k in range(count))
        return {identifier(name): k for k, name in enumerate(names) if name}

    single = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    joints = {name: j for name, j in names_of(kinds.mjOBJ_JOINT, model.njnt).items() if model.jnt_type[j] in single}
    actuators = names_of(kinds.mjOBJ_ACTUATOR, model.nu)
    states = {name: int(model.jnt_qposadr[j]) for name, j in joints.items()}
    rates = {f"{name}{RATE}": int(model.jnt_dofadr[j]) for name, j in joints.items()}
    forces = {f"{name}{end}": int(model.jnt_dofadr[j]) for name, j in joints.items() for end in (TORQUE, FORCE)}
    plant = Plant(mujoco, model, [], [], [], [])
    for i, name in enumerate(with_underscores(name) for name in system.state_names):
        _add_index(
            i, name, ((states, plant.positions), (rates, plant.rates)), f"states of the controller in {path.name}"
        )
    for i, name in enumerate(with_underscores(name) for name in system.control_names):
        _add_index(
            i,
            name,
            ((actuators, plant.actuators), (forces, plant.joints)),
            f"controls of the controller in {path.name}",
        )
    return plant


def _add_index(i: int, name: str, places: Any, where: str) -> None:
    for known, found in places:
        if name in known:
            found.append((i, known[name]))
            return
    every = [each for known, _ in places for each in known]
    hint = did_you_mean(name, every, "name joints and actuators as the controller's states and controls.")
    raise UsageError(f"Expected {where} ({', '.join(every) or 'which has none'}), got {name}; {hint}")


@torch.no_grad()
def simulate(controller: Controller, plant: Plant, x0: State) -> SimulatedLoops:
    """Closed loops from states x0 (b, n), with u held for Δt; the simulator takes several equal steps in each Δt."""
    problem = in_float64(controller.problem)
    policy, horizon, x0 = controller.closed_loop.policy, problem.horizon, x0.double().cpu()
    each = max(1, math.ceil(horizon.dt / float(plant.model.opt.timestep) - 1e-9))
    plant.model.opt.timestep = step = horizon.dt / each
    states = [_start(plant, row) for row in x0.numpy()]
    cost, x = torch.zeros(len(x0), dtype=torch.float64), x0
    positions = [states[0].qpos.copy()]
    for n in range(horizon.steps):
        like = x.to(controller.initial_states.lower)
        u = controller.controls.applied(like, policy(like.new_tensor(n * horizon.dt), like)).double()
        for data, control in zip(states, u.numpy(), strict=True):
            _set_controls(plant, data, control)
        for _ in range(each):
            before = problem.cost.running(x, u)
            for data in states:
                plant.mujoco.mj_step(plant.model, data)
            x = torch.from_numpy(np.stack([_read_state(plant, data, x0.shape[-1]) for data in states]))
            cost += step * (before + problem.cost.running(x, u)) / 2
        positions.append(states[0].qpos.copy())
    cost = torch.where(cost.isfinite(), cost + problem.cost.terminal(x), torch.inf)
    return SimulatedLoops(cost, costs_of_plant(problem, policy, x0), np.stack(positions))


def _start(plant: Plant, x: NDArray) -> Any:
    data = plant.mujoco.MjData(plant.model)
    for i, place in plant.positions:
        data.qpos[place] = x[i]
    for i, place in plant.rates:
        data.qvel[place] = x[i]
    return data


def _set_controls(plant: Plant, data: Any, u: NDArray) -> None:
    for i, place in plant.actuators:
        data.ctrl[place] = u[i]
    for i, place in plant.joints:
        data.qfrc_applied[place] = u[i]


def _read_state(plant: Plant, data: Any, n: int) -> NDArray:
    """The state x; NaN if the simulator found an instability and reset itself."""
    warnings = plant.mujoco.mjtWarning
    lost = any(data.warning[int(kind)].number for kind in (
        warnings.mjWARN_BADQPOS, warnings.mjWARN_BADQVEL, warnings.mjWARN_BADQACC,
    ))  # fmt: skip
    x = np.full(n, np.nan)
    if not lost:
        for i, place in plant.positions:
            x[i] = data.qpos[place]
        for i, place in plant.rates:
            x[i] = data.qvel[place]
    return x
