"""The registered systems; a new one is a subclass and one line here, or `module:Class` in a config."""

from lyapnet.systems.acrobot import Acrobot
from lyapnet.systems.base import ControlAffineSystem, MechanicalSystem
from lyapnet.systems.cartpole import Cartpole
from lyapnet.systems.linear import DoubleIntegrator, IntegratorChain, Linear, is_linear
from lyapnet.systems.path_tracking import PathTracking
from lyapnet.systems.pendulum import Pendulum
from lyapnet.systems.planar_quadrotor import PlanarQuadrotor
from lyapnet.systems.reacher import Reacher
from lyapnet.systems.rigid_body import BodyFrameQuadrotor, Quadrotor, Satellite
from lyapnet.systems.three_link_arm import ThreeLinkArm
from lyapnet.systems.van_der_pol import VanDerPol

SYSTEMS: dict[str, type[ControlAffineSystem]] = {
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
    "van_der_pol": VanDerPol,
    "path_tracking": PathTracking,
}

__all__ = [
    "SYSTEMS",
    "Acrobot",
    "BodyFrameQuadrotor",
    "Cartpole",
    "ControlAffineSystem",
    "DoubleIntegrator",
    "IntegratorChain",
    "Linear",
    "MechanicalSystem",
    "PathTracking",
    "Pendulum",
    "PlanarQuadrotor",
    "Quadrotor",
    "Reacher",
    "Satellite",
    "ThreeLinkArm",
    "VanDerPol",
    "is_linear",
]
