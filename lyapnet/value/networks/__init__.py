"""Networks for V(t, x). A new one is a ValueFunction with arguments `scaling` and options, and one line in NETWORKS.

The options are the fields of the config's network section that the constructor names.
"""

from lyapnet.value.calculus import ValueFunction
from lyapnet.value.networks.anchored import AnchoredNetwork, GoalAnchor, TerminalAnchor
from lyapnet.value.networks.base import ACTIVATIONS, Scaling
from lyapnet.value.networks.centred import CentredNetwork
from lyapnet.value.networks.expansion import ExpansionNetwork
from lyapnet.value.networks.fcn import FCN
from lyapnet.value.networks.icnn import ICNN, PartiallyConvexNetwork
from lyapnet.value.networks.ignoring import IgnoringStates, kept_states
from lyapnet.value.networks.quadratic import QuadraticForm
from lyapnet.value.networks.stationary import Members, StationaryNetwork, Timeless
from lyapnet.value.networks.with_penalty import WithPenalty, learned_part

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
    "Members",
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
