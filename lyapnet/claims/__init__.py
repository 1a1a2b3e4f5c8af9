"""Certificates: on how much of X₀ a controller keeps its promises, and how sure that is.

Three claims of growing strength, sampled, statistical and sound, and one about the receding law, region. Each class
says in its first line what it claims.
"""

from lyapnet.claims.funnel import SoundClaim, enclosing_box, sound_claim
from lyapnet.claims.region import RegionClaim, region_claim
from lyapnet.claims.statistical import (
    SampledClaim,
    StatisticalClaim,
    lower_bound,
    sampled_claim,
    statistical_claim,
)
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.prover.condition import DecreaseCondition
from lyapnet.prover.counterexamples import Counterexample, violations
from lyapnet.prover.proof import Progress, Proof, prove
from lyapnet.prover.verdict import Verdict

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
