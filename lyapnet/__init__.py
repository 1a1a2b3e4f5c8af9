"""lyapnet: time-varying value functions and Lyapunov functions, learned through closed-loop rollouts."""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

try:
    __version__ = version("lyapnet")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0.0.0"

if TYPE_CHECKING:
    from lyapnet.calculus import ValueFunction
    from lyapnet.constraints import AllOf, Ball, Constraints, StateLimits
    from lyapnet.controller import ArrayTrajectory, Controller
    from lyapnet.cost import Cost, ObstacleCost, PeriodicCost, PseudoHuberCost, QuadraticCost, TargetCost
    from lyapnet.errors import LyapnetError
    from lyapnet.horizon import Horizon
    from lyapnet.interpolation import Table
    from lyapnet.linear_algebra import norm
    from lyapnet.loading import load
    from lyapnet.policy import HJBPolicy, LookaheadPolicy, SampledPolicy, SontagPolicy
    from lyapnet.problem import Problem
    from lyapnet.programs import LyapunovProgram, Program, Tolerances, ValueProgram
    from lyapnet.rollout import Rollout, Trajectory
    from lyapnet.sets import Box, ControlBox, ControlSet, Unbounded
    from lyapnet.systems import SYSTEMS, ControlAffineSystem
    from lyapnet.training.data import InitialStateDataModule
    from lyapnet.training.experiment import train
    from lyapnet.training.modules import ValueModule
    from lyapnet.training.optimizer import OptimizerOptions

_HOMES = {  # imported when they are first asked for: torch and Lightning take seconds
    "calculus": ["ValueFunction"],
    "constraints": ["AllOf", "Ball", "Constraints", "StateLimits"],
    "controller": ["ArrayTrajectory", "Controller"],
    "cost": ["Cost", "ObstacleCost", "PeriodicCost", "PseudoHuberCost", "QuadraticCost", "TargetCost"],
    "errors": ["LyapnetError"],
    "interpolation": ["Table"],
    "linear_algebra": ["norm"],
    "loading": ["load"],
    "policy": ["HJBPolicy", "LookaheadPolicy", "SampledPolicy", "SontagPolicy"],
    "horizon": ["Horizon"],
    "problem": ["Problem"],
    "programs": ["LyapunovProgram", "Program", "Tolerances", "ValueProgram"],
    "rollout": ["Rollout", "Trajectory"],
    "sets": ["Box", "ControlBox", "ControlSet", "Unbounded"],
    "systems": ["SYSTEMS", "ControlAffineSystem"],
    "training.data": ["InitialStateDataModule"],
    "training.experiment": ["train"],
    "training.modules": ["ValueModule"],
    "training.optimizer": ["OptimizerOptions"],
}

__all__ = [
    "SYSTEMS",
    "AllOf",
    "ArrayTrajectory",
    "Ball",
    "Box",
    "Constraints",
    "ControlAffineSystem",
    "ControlBox",
    "ControlSet",
    "Controller",
    "Cost",
    "HJBPolicy",
    "Horizon",
    "InitialStateDataModule",
    "LookaheadPolicy",
    "LyapnetError",
    "LyapunovProgram",
    "ObstacleCost",
    "OptimizerOptions",
    "PeriodicCost",
    "Problem",
    "Program",
    "PseudoHuberCost",
    "QuadraticCost",
    "Rollout",
    "SampledPolicy",
    "SontagPolicy",
    "StateLimits",
    "Table",
    "TargetCost",
    "Tolerances",
    "Trajectory",
    "Unbounded",
    "ValueFunction",
    "ValueModule",
    "ValueProgram",
    "__version__",
    "load",
    "norm",
    "train",
]


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            return getattr(import_module(f"lyapnet.{home}"), name)
    raise AttributeError(f"module 'lyapnet' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
