"""A table of regions under disturbances of several sizes, for a terminal."""

from collections.abc import Sequence
from typing import Any

from rich.table import Table

from lyapnet.claims.disturbances.regions import DisturbedRegions
from lyapnet.claims.tables import floored


def table(title: str, regions: DisturbedRegions) -> Table:
    """A table with a row for each w."""
    names = regions.controller.system.state_names
    about = f"regions that no closed loop leaves under disturbances of at most w on d({regions.state})/dt"
    found = Table("w", "volume ≥", "of D", "c", "ends in", "verdict", title=f"{title}\n{about}")
    for row in regions.result["rows"]:
        found.add_row(f"{row['w']:g}", *_columns(row, names), row["verdict"])
    reasons = [f"w = {row['w']:g}: {row['reason']}" for row in regions.result["rows"] if row["reason"]]
    found.caption = "\n".join(["ends in: a box around {V(0, ·) ≤ c}", *reasons])
    return found


def _columns(row: dict[str, Any], names: Sequence[str]) -> tuple[str, str, str, str]:
    """The columns volume, share of D, c, and where closed loops end."""
    if row["rho"] is None:
        return "none proved", "", "", ""
    size = f"{row['region_volume_proved']:.4g}", floored(row["set_volume_share"])
    if "ultimate_level" not in row:
        if "distance_left" in row:
            return *size, "", f"the goal ± {row['distance_left']:.1g}"
        return *size, "", f"an equilibrium, goal ± {row['equilibrium_offset']:.1g}"
    sides = zip(names, *row["ultimate_extent"], strict=True)
    box = [f"{name} [{low:.3g}, {high:.3g}]" for name, low, high in sides if name not in row["states_left_out"]]
    return *size, f"{row['ultimate_level']:.4g}", "\n".join(box)
