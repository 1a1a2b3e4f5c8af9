"""The registered systems. A new one is a subclass and one line in SYSTEMS, or `module:Class` in a config."""

from collections import ChainMap
from collections.abc import Mapping

from lyapnet.task.models.reading import KINDS
from lyapnet.task.systems.acrobot import Acrobot
from lyapnet.task.systems.base import (
    ControlAffineSystem,
    ControlSystem,
    MechanicalSystem,
    functions_of_state,
    moving_states,
    states_that_are_rates,
)
from lyapnet.task.systems.cartpole import Cartpole
from lyapnet.task.systems.equations import EquationSystem
from lyapnet.task.systems.glider import Glider
from lyapnet.task.systems.kinematic_bicycle import KinematicBicycle
from lyapnet.task.systems.linear import DoubleIntegrator, IntegratorChain, Linear, is_linear
from lyapnet.task.systems.path_tracking import PathTracking
from lyapnet.task.systems.pendulum import Pendulum
from lyapnet.task.systems.planar_quadrotor import PlanarQuadrotor
from lyapnet.task.systems.reacher import Reacher
from lyapnet.task.systems.rigid_body import BodyFrameQuadrotor, Quadrotor, Satellite
from lyapnet.task.systems.rocket import Rocket
from lyapnet.task.systems.three_link_arm import ThreeLinkArm
from lyapnet.task.systems.van_der_pol import VanDerPol

SYSTEMS: dict[str, type[ControlSystem]] = {
    "double_integrator": DoubleIntegrator,
    "integrator_chain": IntegratorChain,
    "linear": Linear,
    "cartpole": Cartpole,
    "reacher": Reacher,
    "pendulum": Pendulum,
    "planar_quadrotor": PlanarQuadrotor,
    "acrobot": Acrobot,
    "three_link_arm": ThreeLinkArm,
    "quadrotor": Quadrotor,
    "body_frame_quadrotor": BodyFrameQuadrotor,
    "satellite": Satellite,
    "rocket": Rocket,
    "van_der_pol": VanDerPol,
    "path_tracking": PathTracking,
    "kinematic_bicycle": KinematicBicycle,
    "glider": Glider,
}
BY_EQUATIONS = ("equations", *KINDS)  # equations in a config, or read from a model's file
NAMED_SYSTEMS: Mapping[str, type[ControlSystem]] = ChainMap(SYSTEMS, dict.fromkeys(BY_EQUATIONS, EquationSystem))

__all__ = [
    "BY_EQUATIONS",
    "NAMED_SYSTEMS",
    "SYSTEMS",
    "Acrobot",
    "BodyFrameQuadrotor",
    "Cartpole",
    "ControlAffineSystem",
    "ControlSystem",
    "DoubleIntegrator",
    "EquationSystem",
    "Glider",
    "IntegratorChain",
    "KinematicBicycle",
    "Linear",
    "MechanicalSystem",
    "PathTracking",
    "Pendulum",
    "PlanarQuadrotor",
    "Quadrotor",
    "Reacher",
    "Rocket",
    "Satellite",
    "ThreeLinkArm",
    "VanDerPol",
    "functions_of_state",
    "is_linear",
    "moving_states",
    "states_that_are_rates",
]
