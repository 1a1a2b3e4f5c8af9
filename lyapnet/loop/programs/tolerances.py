"""What counts as success of one closed loop: the events that a program promises, and certificates count."""

from dataclasses import dataclass

EVENTS = ("decrease", "terminal", "cost", "constraints", "all")  # one that is not asked for counts as success


@dataclass(frozen=True)
class Tolerances:
    """Success of one closed loop from x₀, on the nodes of the horizon:

        decrease:  Σ_n max(V_{n+1} − V_n + Δt ℓ_n, 0) ≤ decrease · V(0, x₀),
        terminal:  ‖x_N − goal‖ ≤ radius,
        cost:      J_N(x₀) ≤ (1 + cost) V(0, x₀),
        constraints:  h(x_n) ≤ 0,
        all:       these together.

    Args:
        radius: in the norm of the state's components, each in its own unit. None, here and for decrease: not asked for.
        constraints: whether they are asked for.
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
        """The single events that are asked for."""
        constraints = True if self.constraints else None
        limits = {"decrease": self.decrease, "terminal": self.radius, "cost": self.cost, "constraints": constraints}
        return [event for event, limit in limits.items() if limit is not None]
