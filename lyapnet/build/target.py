"""The cost about a target, and the control that holds it."""

import math

import torch
from torch import Tensor

from lyapnet.build.entries import repeated, require_length
from lyapnet.config import Config
from lyapnet.cost import Cost, TargetCost
from lyapnet.errors import UsageError
from lyapnet.sets import ControlSet
from lyapnet.systems import ControlAffineSystem

HELD = 1e-9  # ẋ of a state that is held, against f


def about_target(config: Config, cost: Cost, system: ControlAffineSystem, controls: ControlSet) -> Cost:
    """The cost about the target of a config, if there is one."""
    if config.target is None and config.target_control is not None:
        raise UsageError("Expected target with target_control, got none; name the state that it holds.")
    if config.target is None:
        return cost
    target, given = repeated(config.target, system.n), repeated(config.target_control, system.m)
    require_length("target", len(target), system.state_names)
    x = torch.tensor(target, dtype=torch.float64)
    for name, numbers in (("target", target), ("target_control", given or [])):
        if not all(math.isfinite(number) for number in numbers):
            raise UsageError(f"Expected {name} of finite numbers, got {numbers}; correct it.")
    if given is None:
        u = holding(system, x)
    else:
        require_length("target_control", len(given), system.control_names)
        u = torch.tensor(given, dtype=torch.float64)
    if not bool(controls.contains(u)):
        raise UsageError(
            f"Expected the control at the target among those that are admitted, got {u.tolist()}; widen controls, or "
            "choose another target."
        )
    return TargetCost(cost, x, u)


def holding(system: ControlAffineSystem, x: Tensor) -> Tensor:
    """u* with f(x*) + g(x*)u* = 0."""
    u, left = system.holding_control(x)
    worst = int(left.abs().argmax())
    if not float(left.abs()[worst]) <= HELD * max(1.0, float(system.f(x).abs().max())):
        raise UsageError(
            f"Expected a target that some control holds, f(x*) + g(x*)u* = 0, got {float(left[worst]):.3g} for the "
            f"rate of {system.state_names[worst]} at {x.tolist()}; choose another, or say what the cost counts "
            "u from, as in target_control: [0]."
        )
    return u
