"""Certificates: on how much of X₀ a controller keeps its promises, and how sure that is.

Three claims of growing strength: sampled, statistical, sound. Each class says in its first line what it claims.
"""

from lyapnet.certification.statistical import (
    SampledClaim,
    StatisticalClaim,
    Tolerances,
    lower_bound,
    sampled_claim,
    statistical_claim,
)

__all__ = [
    "SampledClaim",
    "StatisticalClaim",
    "Tolerances",
    "lower_bound",
    "sampled_claim",
    "statistical_claim",
]
