"""Networks for V(t, x); a new one is a ValueFunction that takes `scaling` and options, and one line here.

The options are the fields of the config's network section that the constructor names.
"""

from lyapnet.calculus import ValueFunction
from lyapnet.networks.anchored import AnchoredNetwork, GoalAnchor, TerminalAnchor
from lyapnet.networks.base import ACTIVATIONS, Scaling
from lyapnet.networks.centred import CentredNetwork
from lyapnet.networks.expansion import ExpansionNetwork
from lyapnet.networks.fcn import FCN
from lyapnet.networks.icnn import ICNN, PartiallyConvexNetwork
from lyapnet.networks.ignoring import IgnoringStates, kept_states
from lyapnet.networks.quadratic import QuadraticForm
from lyapnet.networks.stationary import StationaryNetwork, Timeless
from lyapnet.networks.with_penalty import WithPenalty, learned_part

NETWORKS: dict[str, type[ValueFunction]] = {
    "fcn": FCN,
    "icnn": ICNN,
    "anchored": AnchoredNetwork,
    "quadratic": QuadraticForm,
    "expansion": ExpansionNetwork,
    "stationary": StationaryNetwork,
}

__all__ = [
    "ACTIVATIONS",
    "FCN",
    "ICNN",
    "NETWORKS",
    "AnchoredNetwork",
    "CentredNetwork",
    "ExpansionNetwork",
    "GoalAnchor",
    "IgnoringStates",
    "PartiallyConvexNetwork",
    "QuadraticForm",
    "Scaling",
    "StationaryNetwork",
    "TerminalAnchor",
    "Timeless",
    "WithPenalty",
    "kept_states",
    "learned_part",
]
