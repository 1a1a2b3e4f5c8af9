"""The control sets that a config may name; a ControlBox is chosen by controls.lower and controls.upper."""

from lyapnet.task.ball import ControlBall
from lyapnet.task.ellipsoid import ControlEllipsoid
from lyapnet.task.polytope import ControlPolytope
from lyapnet.task.sets import ControlSet, Unbounded
from lyapnet.task.varying_limits import LimitTable

CONTROL_SETS: dict[str, type[ControlSet]] = {
    "unbounded": Unbounded, "ball": ControlBall, "ellipsoid": ControlEllipsoid,
    "polytope": ControlPolytope, "table": LimitTable,
}  # fmt: skip
