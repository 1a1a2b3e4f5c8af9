"""One claim about the receding law for each of several largest pushes on one state."""

from typing import Any, NamedTuple

from lyapnet.claims.disturbances import figures
from lyapnet.claims.region_certificate import RegionCertificate
from lyapnet.controller.controller import Controller


class RegionsUnderPushes(NamedTuple):
    """{x ∈ D: V(0, x) ≤ ρ} that no closed loop leaves, and {V(0, x) ≤ c} that each comes to, for each w of one ẋ_i."""

    controller: Controller
    state: str
    pushes: list[float]  # w in units of ẋ_i, in increasing order
    certificates: list[RegionCertificate]

    @property
    def result(self) -> dict[str, Any]:
        """Plain data: what is known of each claim."""
        rows = [{"w": w, **each.result} for w, each in zip(self.pushes, self.certificates, strict=True)]
        return {"kind": "region", "disturbed": self.state, "rows": rows}

    def figure(self) -> figures.Figure:
        """Certified volume over w, and where two states are seen, the regions and where they end."""
        controller, claims = self.controller, [each.claim for each in self.certificates]
        label = controller.system.state_labels[controller.system.state_names.index(self.state)]
        return figures.regions(
            self.pushes, claims, controller.V, controller.initial_states, controller.problem.goal,
            controller.system.state_labels, label,
        )  # fmt: skip
