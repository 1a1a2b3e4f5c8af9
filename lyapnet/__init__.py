"""lyapnet: time-varying value functions and Lyapunov functions, learned through closed-loop rollouts."""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from lyapnet.base.moved_modules import find_moved_modules

try:
    __version__ = version("lyapnet")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0.0.0"

find_moved_modules()

if TYPE_CHECKING:
    from lyapnet.base.errors import LyapnetError
    from lyapnet.base.interpolation import Table
    from lyapnet.base.linear_algebra import norm
    from lyapnet.claims.certificates import Certificate
    from lyapnet.claims.certify import certify
    from lyapnet.claims.claim import Claim, Run, option
    from lyapnet.claims.everywhere import Everywhere
    from lyapnet.claims.kinds import Funnel, LowerBound, NoisyFunnel, Reach, Region, Sampled, Statistical, Tube
    from lyapnet.controller.controller import ArrayTrajectory, Controller
    from lyapnet.controller.loading import load
    from lyapnet.controller.output_feedback import OutputFeedback
    from lyapnet.evaluation.measurement import evaluate
    from lyapnet.exchange.export import export
    from lyapnet.loop.programs import LyapunovProgram, Program, Tolerances, ValueProgram
    from lyapnet.loop.rollout import Rollout, Trajectory
    from lyapnet.prover.branch_and_bound import Budget
    from lyapnet.task.ball import ControlBall
    from lyapnet.task.constraints import AllOf, Ball, Constraints, StateLimits
    from lyapnet.task.cost import Cost, ObstacleCost, PeriodicCost, PseudoHuberCost, QuadraticCost, TargetCost, TimeCost
    from lyapnet.task.cost.control_costs import (
        AbsoluteCost,
        ControlCost,
        ControlCosts,
        EntropyCost,
        LogCosCost,
        NormCost,
        PowerCost,
        PseudoHuberControlCost,
        SeparableCost,
    )
    from lyapnet.task.ellipsoid import ControlEllipsoid
    from lyapnet.task.horizon import Horizon
    from lyapnet.task.models.sympy_equations import sympy_system
    from lyapnet.task.models.systems import casadi_system
    from lyapnet.task.polytope import ControlPolytope
    from lyapnet.task.problem import Problem
    from lyapnet.task.sets import Box, ControlBox, ControlSet, Unbounded
    from lyapnet.task.systems import SYSTEMS, ControlAffineSystem, ControlSystem, EquationSystem
    from lyapnet.task.systems.contact import friction_force, normal_force
    from lyapnet.task.varying_limits import LimitTable, VaryingLimits
    from lyapnet.training.data import InitialStateDataModule
    from lyapnet.training.experiment import train
    from lyapnet.training.modules import ValueModule
    from lyapnet.training.optimizer import OptimizerOptions
    from lyapnet.value.calculus import ValueFunction
    from lyapnet.value.policy import HJBPolicy, LookaheadPolicy, SampledPolicy, SontagPolicy

_HOMES = {  # imported when they are first asked for: torch and Lightning take seconds
    "value.calculus": ["ValueFunction"],
    "task.constraints": ["AllOf", "Ball", "Constraints", "StateLimits"],
    "claims.certificates": ["Certificate"],
    "claims.certify": ["certify"],
    "claims.claim": ["Claim", "Run", "option"],
    "claims.everywhere": ["Everywhere"],
    "claims.kinds": ["Funnel", "LowerBound", "NoisyFunnel", "Reach", "Region", "Sampled", "Statistical", "Tube"],
    "prover.branch_and_bound": ["Budget"],
    "evaluation.measurement": ["evaluate"],
    "exchange.export": ["export"],
    "controller.controller": ["ArrayTrajectory", "Controller"],
    "task.cost": ["Cost", "ObstacleCost", "PeriodicCost", "PseudoHuberCost", "QuadraticCost", "TargetCost", "TimeCost"],
    "task.cost.control_costs": [
        "AbsoluteCost",
        "ControlCost",
        "ControlCosts",
        "EntropyCost",
        "LogCosCost",
        "NormCost",
        "PowerCost",
        "PseudoHuberControlCost",
        "SeparableCost",
    ],
    "base.errors": ["LyapnetError"],
    "base.interpolation": ["Table"],
    "base.linear_algebra": ["norm"],
    "controller.loading": ["load"],
    "controller.output_feedback": ["OutputFeedback"],
    "value.policy": ["HJBPolicy", "LookaheadPolicy", "SampledPolicy", "SontagPolicy"],
    "task.horizon": ["Horizon"],
    "task.polytope": ["ControlPolytope"],
    "task.problem": ["Problem"],
    "loop.programs": ["LyapunovProgram", "Program", "Tolerances", "ValueProgram"],
    "loop.rollout": ["Rollout", "Trajectory"],
    "task.ball": ["ControlBall"],
    "task.ellipsoid": ["ControlEllipsoid"],
    "task.sets": ["Box", "ControlBox", "ControlSet", "Unbounded"],
    "task.models.systems": ["casadi_system"],
    "task.models.sympy_equations": ["sympy_system"],
    "task.systems": ["SYSTEMS", "ControlAffineSystem", "ControlSystem", "EquationSystem"],
    "task.systems.contact": ["friction_force", "normal_force"],
    "task.varying_limits": ["LimitTable", "VaryingLimits"],
    "training.data": ["InitialStateDataModule"],
    "training.experiment": ["train"],
    "training.modules": ["ValueModule"],
    "training.optimizer": ["OptimizerOptions"],
}

__all__ = [
    "SYSTEMS",
    "AbsoluteCost",
    "AllOf",
    "ArrayTrajectory",
    "Ball",
    "Box",
    "Budget",
    "Certificate",
    "Claim",
    "Constraints",
    "ControlAffineSystem",
    "ControlBall",
    "ControlBox",
    "ControlCost",
    "ControlCosts",
    "ControlEllipsoid",
    "ControlPolytope",
    "ControlSet",
    "ControlSystem",
    "Controller",
    "Cost",
    "EntropyCost",
    "EquationSystem",
    "Everywhere",
    "Funnel",
    "HJBPolicy",
    "Horizon",
    "InitialStateDataModule",
    "LimitTable",
    "LogCosCost",
    "LookaheadPolicy",
    "LowerBound",
    "LyapnetError",
    "LyapunovProgram",
    "NoisyFunnel",
    "NormCost",
    "ObstacleCost",
    "OptimizerOptions",
    "OutputFeedback",
    "PeriodicCost",
    "PowerCost",
    "Problem",
    "Program",
    "PseudoHuberControlCost",
    "PseudoHuberCost",
    "QuadraticCost",
    "Reach",
    "Region",
    "Rollout",
    "Run",
    "Sampled",
    "SampledPolicy",
    "SeparableCost",
    "SontagPolicy",
    "StateLimits",
    "Statistical",
    "Table",
    "TargetCost",
    "TimeCost",
    "Tolerances",
    "Trajectory",
    "Tube",
    "Unbounded",
    "ValueFunction",
    "ValueModule",
    "ValueProgram",
    "VaryingLimits",
    "__version__",
    "casadi_system",
    "certify",
    "evaluate",
    "export",
    "friction_force",
    "load",
    "norm",
    "normal_force",
    "option",
    "sympy_system",
    "train",
]


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            return getattr(import_module(f"lyapnet.{home}"), name)
    raise AttributeError(f"module 'lyapnet' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
