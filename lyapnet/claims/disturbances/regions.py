"""One claim about the receding law for each of several largest pushes on one state."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from lyapnet.base.errors import UsageError
from lyapnet.claims.disturbances import figures
from lyapnet.claims.funnel import require_disturbance
from lyapnet.claims.region_certificate import RegionCertificate, region_certificate
from lyapnet.claims.sound_certificate import parse_disturbance
from lyapnet.controller.controller import Controller
from lyapnet.prover.proof import Progress


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


def regions_under_pushes(
    controller: Controller,
    disturbance: Sequence[str],
    decay: float | None = None,
    set: str | None = None,
    seconds: float = 60.0,
    workers: int = 1,
    device: str = "cpu",
    seed: int = 0,
    report: Callable[[Progress], None] | None = None,
    parameter: Sequence[str] | None = None,
) -> RegionsUnderPushes:
    """The claims for STATE=w,w,…, each within its own seconds; all else is as of one region.

    Raises:
        UsageError: more than one state is pushed, or what is named is none, or no number.
    """
    state, pushes = parse_pushes(disturbance, controller)
    certificates = [
        region_certificate(
            controller, decay, set, seconds, workers, device, [f"{state}={w!r}"], None, seed, report, parameter
        )
        for w in pushes
    ]
    return RegionsUnderPushes(controller, state, pushes, certificates)


def parse_pushes(disturbance: Sequence[str], controller: Controller) -> tuple[str, list[float]]:
    """The state and the pushes that "velocity=0,0.05,0.1" names, in increasing order, each once.

    Raises:
        UsageError: as of regions_under_pushes.
    """
    if len(disturbance) != 1:
        raise UsageError(
            f"Expected one --disturbance STATE=W,W,… where it has several values, got {len(disturbance)} of them; push "
            "one state."
        )
    state, _, values = disturbance[0].partition("=")
    found = []
    for value in values.split(","):
        w = parse_disturbance([f"{state}={value}"], controller)
        assert w is not None
        require_disturbance(w, controller.system.n)
        found.append(float(w[controller.system.state_names.index(state)]))
    return state, sorted({*found})
