"""One region of the receding law for each of several disturbances of one state."""

from typing import Any, NamedTuple

from lyapnet.claims.disturbances import figures
from lyapnet.claims.region_certificate import RegionCertificate
from lyapnet.controller.controller import Controller


class DisturbedRegions(NamedTuple):
    """Region certificates for several bounds w of the disturbance of one state."""

    controller: Controller
    state: str
    disturbances: list[float]  # w in units of ẋ_i, in increasing order
    certificates: list[RegionCertificate]

    @property
    def result(self) -> dict[str, Any]:
        """The numbers of each certificate as plain data."""
        rows = [{"w": w, **each.result} for w, each in zip(self.disturbances, self.certificates, strict=True)]
        return {"kind": "region", "disturbed": self.state, "rows": rows}

    def figure(self) -> figures.Figure:
        """Certified volume over w; for regions of two states, also their level lines."""
        controller, claims = self.controller, [each.claim for each in self.certificates]
        label = controller.system.state_labels[controller.system.state_names.index(self.state)]
        return figures.regions(
            self.disturbances, claims, controller.V, controller.initial_states, controller.problem.goal,
            controller.system.state_labels, label,
        )  # fmt: skip
