"""Contact in f(x): a compliant normal force and regularised friction, smoothed over a given length and speed.

Both are averages of the exact functions: with random ξ of density ¾(1 − ξ²) on [−1, 1],

    (z)₊ = E max(0, z + ξ),    sgn(z) = E sign(z + ξ).

These are polynomials for |z| < 1, and equal max(0, z) and sign(z) elsewhere. (z)₊ has two continuous derivatives,
sgn(z) has one. They consist of clamp, products and sums, which certificates, C and CasADi support.
"""

import torch
from torch import Tensor, nn

from lyapnet.base.errors import UsageError

Number = float | Tensor


def normal_force(
    gap: Tensor, gap_rate: Tensor, stiffness: Number, damping: Number = 0.0, length: Number = 1e-3
) -> Tensor:
    """The force by which two bodies push each other apart, N = k ℓ(−d/ℓ)₊ max(0, 1 − c ḋ) ≥ 0.

    It is Hunt and Crossley's force, with the depth max(0, −d) made smooth for |d| < ℓ. It differs from the exact force
    by at most 3kℓ/16, at d = 0, and is equal to it for |d| ≥ ℓ. For c = 0 its derivative by d is between −k and 0.
    Without damping it conserves energy; with c > 0 it only takes energy away, and a body that meets another at a speed
    v leaves it at about v(1 − ⅔ c v).

    Args:
        gap: d in m, negative where the bodies overlap, (*batch,).
        gap_rate: ḋ in m/s, (*batch,).
        stiffness: k in N/m.
        damping: c in s/m.
        length: ℓ in m, positive; a number, or a tensor if it is a parameter of a family.

    Returns:
        N in N, (*batch,); it never pulls.

    Raises:
        UsageError: the length is not positive.

    Source: Hunt, Crossley, "Coefficient of restitution interpreted as damping in vibroimpact", Journal of Applied
    Mechanics 1975.
    """
    _require_positive("length", length)
    return stiffness * length * _smooth_ramp(-gap / length) * torch.relu(1 - damping * gap_rate)


def friction_force(slip: Tensor, normal: Tensor, coefficient: Number, speed: Number = 1e-2) -> Tensor:
    """Coulomb friction on a sliding body, −μN sgn(v/v_s), counted in the direction of v.

    It is exactly Coulomb's force for |v| ≥ v_s, and never adds energy. For |v| < v_s it is viscous, with the slope
    −3μN/(2v_s) at v = 0: a body that should stick creeps, at about ⅔ v_s F/(μN) under a small load F.

    Args:
        slip: v, speed of the body relative to the other one in m/s, (*batch,).
        normal: N ≥ 0 in N, (*batch,).
        coefficient: μ.
        speed: v_s in m/s, positive; a number, or a tensor if it is a parameter of a family.

    Returns:
        the force in N, (*batch,).

    Raises:
        UsageError: the speed is not positive.
    """
    _require_positive("speed", speed)
    return -coefficient * normal * _smooth_sign(slip / speed)


def _smooth_ramp(z: Tensor) -> Tensor:
    """(z)₊ = E max(0, z + ξ) = (1 + z)³(3 − z)/16 for |z| < 1."""
    within = z.clamp(-1, 1)
    return (1 + within) ** 3 * (3 - within) / 16 + torch.relu(z - 1)


def _smooth_sign(z: Tensor) -> Tensor:
    """sgn(z) = E sign(z + ξ) = z(3 − z²)/2 for |z| < 1."""
    within = z.clamp(-1, 1)
    return within * (3 - within**2) / 2


def _require_positive(name: str, value: Number) -> None:
    if not isinstance(value, Tensor) and not value > 0:
        raise UsageError(
            f"Expected a positive smoothing {name} of contact, got {value}; a small one, as 1e-6, is hard contact."
        )


def variable_lengths(module: nn.Module) -> list[tuple[Tensor, float]]:
    """Turn the smoothing lengths of all contacts in a module into buffers; return (buffer, value) for each.

    Args:
        module: for example a copy of a problem; its systems name these lengths in `contact_lengths`.
    """
    found = list[tuple[Tensor, float]]()
    for system in module.modules():
        for name in getattr(system, "contact_lengths", ()):
            value = getattr(system, name)
            if isinstance(value, float | int):
                delattr(system, name)
                system.register_buffer(name, torch.tensor(float(value), dtype=torch.float64), persistent=False)
                found.append((getattr(system, name), float(value)))
    return found
