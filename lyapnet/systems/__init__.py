"""The registered systems; a new one is a subclass and one line here, or `module:Class` in a config."""

from lyapnet.systems.base import ControlAffineSystem, MechanicalSystem
from lyapnet.systems.cartpole import Cartpole
from lyapnet.systems.linear import DoubleIntegrator, IntegratorChain, Linear, is_linear
from lyapnet.systems.pendulum import Pendulum
from lyapnet.systems.planar_quadrotor import PlanarQuadrotor
from lyapnet.systems.reacher import Reacher

SYSTEMS: dict[str, type[ControlAffineSystem]] = {
    "double_integrator": DoubleIntegrator,
    "integrator_chain": IntegratorChain,
    "linear": Linear,
    "cartpole": Cartpole,
    "reacher": Reacher,
    "pendulum": Pendulum,
    "planar_quadrotor": PlanarQuadrotor,
}

__all__ = [
    "SYSTEMS",
    "Cartpole",
    "ControlAffineSystem",
    "DoubleIntegrator",
    "IntegratorChain",
    "Linear",
    "MechanicalSystem",
    "Pendulum",
    "PlanarQuadrotor",
    "Reacher",
    "is_linear",
]
