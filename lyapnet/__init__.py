"""lyapnet: time-varying value functions and Lyapunov functions, learned through closed-loop rollouts."""

from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec

try:
    __version__ = version("lyapnet")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0.0.0"

from lyapnet.controller import Controller, load
from lyapnet.cost import QuadraticCost
from lyapnet.errors import LyapnetError
from lyapnet.rollout import Horizon, Trajectory
from lyapnet.sets import Box
from lyapnet.systems import SYSTEMS, ControlAffineSystem

if find_spec("gymnasium"):  # of the extra lyapnet[baselines]
    import lyapnet.baselines  # noqa: F401  (registers the environments: gymnasium.make("lyapnet/Reacher-v0"))

__all__ = [
    "SYSTEMS",
    "Box",
    "ControlAffineSystem",
    "Controller",
    "Horizon",
    "LyapnetError",
    "QuadraticCost",
    "Trajectory",
    "__version__",
    "load",
]
