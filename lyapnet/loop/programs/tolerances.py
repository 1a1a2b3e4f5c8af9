"""Success criteria of a closed loop, which certificates check."""

from dataclasses import dataclass

EVENTS = ("decrease", "terminal", "cost", "constraints", "all")  # an event that is not required counts as success


@dataclass(frozen=True)
class Tolerances:
    """Success of one closed loop from x₀, on the nodes of the horizon:

        decrease:  Σ_n max(V_{n+1} − V_n + Δt ℓ_n, 0) ≤ decrease · V(0, x₀),
        terminal:  ‖x_N − goal‖ ≤ radius,
        cost:      J_N(x₀) ≤ (1 + cost) V(0, x₀),
        constraints:  h(x_n) ≤ 0,
        all:       all of these.

    Args:
        radius: in the norm of the state, each component in its own unit; None, also for decrease: not required.
        constraints: whether they are required.
    """

    radius: float | None = None
    decrease: float | None = 1e-2
    cost: float = 0.0
    constraints: bool = False

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value is not None and not 0 <= value < float("inf"):
                raise ValueError(f"Expected tolerance {name} ≥ 0, got {value}; state what counts as success.")

    @property
    def asked(self) -> list[str]:
        """The required single events."""
        constraints = True if self.constraints else None
        limits = {"decrease": self.decrease, "terminal": self.radius, "cost": self.cost, "constraints": constraints}
        return [event for event, limit in limits.items() if limit is not None]
