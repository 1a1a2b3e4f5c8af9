"""Certificates: on how much of X₀ a controller keeps its promises, and how sure that is.

Three claims of growing strength: sampled, statistical, sound. Each class says in its first line what it claims.
"""

from lyapnet.certification.bounds import BoundedFunction, DecreaseCondition
from lyapnet.certification.branch_and_bound import Budget, Counterexample, Progress, Proof, prove, violations
from lyapnet.certification.funnel import SoundClaim, enclosing_box, sound_claim
from lyapnet.certification.statistical import (
    SampledClaim,
    StatisticalClaim,
    Tolerances,
    lower_bound,
    sampled_claim,
    statistical_claim,
)

__all__ = [
    "BoundedFunction",
    "Budget",
    "Counterexample",
    "DecreaseCondition",
    "Progress",
    "Proof",
    "SampledClaim",
    "SoundClaim",
    "StatisticalClaim",
    "Tolerances",
    "enclosing_box",
    "lower_bound",
    "prove",
    "sampled_claim",
    "sound_claim",
    "statistical_claim",
    "violations",
]
