"""Certificates: on how much of X₀ a controller keeps its promises, and how sure that is.

Three claims of growing strength, sampled, statistical and sound, and one about the receding law, region. Each class
says in its first line what it claims.
"""

from lyapnet.certification.branch_and_bound import Budget
from lyapnet.certification.condition import DecreaseCondition
from lyapnet.certification.counterexamples import Counterexample, violations
from lyapnet.certification.funnel import SoundClaim, enclosing_box, sound_claim
from lyapnet.certification.proof import Progress, Proof, prove
from lyapnet.certification.region import RegionClaim, region_claim
from lyapnet.certification.statistical import (
    SampledClaim,
    StatisticalClaim,
    lower_bound,
    sampled_claim,
    statistical_claim,
)
from lyapnet.certification.verdict import Verdict

__all__ = [
    "Budget",
    "Counterexample",
    "DecreaseCondition",
    "Progress",
    "Proof",
    "RegionClaim",
    "SampledClaim",
    "SoundClaim",
    "StatisticalClaim",
    "Verdict",
    "enclosing_box",
    "lower_bound",
    "prove",
    "region_claim",
    "sampled_claim",
    "sound_claim",
    "statistical_claim",
    "violations",
]
