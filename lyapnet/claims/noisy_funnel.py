"""The noisy claim: a funnel that closed loops under noise leave with a small probability, and their expected cost."""

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from lyapnet.base.contracts import copied
from lyapnet.base.types import Corner, PerState
from lyapnet.claims.funnel import (
    ProvedFunnel,
    budget_for_level,
    enclosing_box,
    find_setting,
    largest_sample,
    prove_in_time,
    share_of,
    terminal_excess,
)
from lyapnet.claims.noisy_decrease import NoisyDecrease, require_smooth
from lyapnet.claims.preconditions import over_time, require_still
from lyapnet.claims.ultimate_bound import extent_of
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.prover.boxes import faces, random_points
from lyapnet.prover.branch_and_bound import Budget, just_above, just_below, minimum
from lyapnet.prover.condition import DecreaseCondition, own_constraints
from lyapnet.prover.kept_proofs import read_proofs, refuse_bad_file, select_proof
from lyapnet.prover.proof import Progress
from lyapnet.prover.verdict import time_limit_reason
from lyapnet.task.constraints import names_of
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box

SAMPLES = 40_000  # number of points (t, x), for each box, from which λ is chosen
LEVEL_FACTORS = (1.25, 1.5, 2.0, 3.0, 5.0, 8.0)  # levels whose boxes are tried for λ, relative to max V(0, ·) on X₀
RISKS = torch.logspace(3, -2, 81, dtype=torch.float64)  # values of λ to try, relative to 1/max V(0, ·) on X₀
LARGEST_EXPONENT = 700.0  # limit of exponents; exp(700) is still a float64, and probabilities are 1 long before
SAMPLE_MARGIN = 0.15  # relative increase of ½ λ ‖σᵀV_x‖² at samples, since bounds are less tight than values


@dataclass(frozen=True, kw_only=True)
class ProvedNoisyFunnel(ProvedFunnel):
    """For dx = (f + g u) dt + σ(x) dW, with V twice continuously differentiable in x, r(t) = ρ e^(−at), W = V e^(at)
    and 𝓛V = V_t + V_xᵀ(f + g u) + ½ tr(σσᵀV_xx), at every (t, x) in [0, T] × D with W ≤ ρ', in continuous time and for
    this model,

        𝓛V + α ℓ(x, u) ≤ δ     and     𝓛V + ½ λ ‖σᵀV_x‖² ≤ ṙ + η exp(λ(r − V)),

    and W > ρ' on the boundary of D, and wherever a constraint has h_j ≥ 0. Let τ be the time at which a closed loop
    from x₀ leaves the funnel {x ∈ D: V(t, x) ≤ ρ' e^(−at)}, or T if it does not. Up to τ, exp(λ(V − r)) − ληt and
    V + ∫(αℓ − δ) dt are supermartingales, so that for each x₀ ∈ D with V(0, x₀) ≤ ρ'

        P(leave before T) ≤ exp(λ(ρ − ρ')) (exp(−λ(ρ − V(0, x₀))) + ληT),
        E[∫ℓ dt up to τ + φ(x(T)) if the funnel is not left, else v/α + κ] ≤ (V(0, x₀) + δT)/α + κ,

    where v is the lowest level of the funnel, ρ' e^(−aT) or ρ', and κ = max(max of φ(x) − V(T, x)/α where W(T, x) ≤ ρ',
    −v/α), so that v/α + κ ≥ 0. Nothing is claimed about what happens after τ. x(T) lies in the box `end` if the funnel
    is not left.

    ρ (`wanted`) and η are such that closed loops from all of X₀ stay in the funnel of ρ' = ρ at least with a given
    `probability`; the verdict is on this claim. For every verdict, closed loops from the share `volume_share` of X₀ do
    so in the funnel of the largest proved level ρ' (`rho`).

    Ignorable states, and the parameters of a family, are as for a funnel without noise.
    """

    formula: ClassVar[str] = "ρe^(−at)"

    probability: float  # the probability of staying in the funnel that is to be proved
    risk: float  # λ in 1/cost
    leak: float  # η in cost per second
    decay: float  # a in 1/s
    largest: float  # an upper bound of max V(0, ·) on X₀
    rim: float  # a lower bound of W on the boundary of D, and where h_j ≥ 0
    end: Box | None = None  # a box around {x ∈ D: W(T, x) ≤ ρ'}; None if no level is proved

    def level(self, t: float) -> float:
        return self.rho * math.exp(-self.decay * t)

    def leave_probability(self, value: PerState) -> PerState:
        """The upper bound of P(leave before T) as a function of V(0, x₀), (*batch,); 1 outside of the funnel."""
        if self.rho == -math.inf:
            return torch.ones_like(value)
        start = torch.exp(-self.risk * (self.rho - value))
        later = (
            self.risk
            * self.leak
            * self.duration
            * math.exp(min(self.risk * (self.wanted - self.rho), LARGEST_EXPONENT))
        )
        return (start + later).clamp(max=1.0)

    @property
    def reason(self) -> str | None:
        if self.verdict != "unknown":
            return None
        if self.remaining_volume > 0:
            return f"{time_limit_reason(self.set_up)}: allow more, or resume a kept proof"
        if self.counterexample is not None:
            return "the condition fails close to the level that this probability needs: ask for less, or allow more δ"
        return "the funnel of this probability meets the boundary of D or a constraint: ask for less, or a larger set"


def prove_noisy_funnel(
    closed_loop: ClosedLoop,
    problem: Problem,
    probability: float = 0.99,
    alpha: float = 0.95,
    delta: float = 1e-2,
    risk: float | None = None,
    decay: float = 0.0,
    states: Box | None = None,
    budget: Budget | None = None,
    generator: torch.Generator | None = None,
    report: Callable[[Progress], None] | None = None,
    keep: Path | None = None,
    replay: bool = False,
    degree: int = 2,
) -> ProvedNoisyFunnel:
    """Prove the funnel that closed loops from X₀ leave with a small probability, or the largest one that is possible.

    Args:
        closed_loop: a closed loop with a V and noise; the claim is about its float64 copy.
        problem: gives X₀, T, the goal and the constraints.
        probability: the probability of staying in the funnel up to T, from each state of X₀.
        risk: λ; by default the largest that samples of the funnel allow, with a margin.
        decay: a ≥ 0, at which the funnel narrows.
        states: D; by default a box around the funnel, estimated from samples.
        report, keep, replay, degree: as in prove.

    Raises:
        UsageError: the task has no noise, V is not smooth, α, δ, λ or D are unsuitable, or the closed loop has an
            operator without a bound.
        Interrupted: Ctrl-C or SIGTERM; the message says whether the proof was kept.
    """
    started, budget, problem = time.monotonic(), budget or Budget(), copied(problem)
    loop, duration, goal = copied(closed_loop).requires_grad_(False), problem.horizon.duration, problem.goal.double()
    condition = NoisyDecrease(loop, alpha, delta, decay, probability, duration)
    constants = list(loop.system.constants)
    require_smooth(condition, over_time(problem.initial_states, duration))

    kept = kept_largest(keep, condition)

    def level_of(found: float, X0: Box) -> float:
        largest = found if kept is None else max(found, kept)  # a bound that is a little higher is a bound too
        if risk is None:
            box = partial(enclosing_box, condition.height, X0, goal, duration, constants=constants)
            boxes = [states] if states is not None else (box(level=each * largest) for each in LEVEL_FACTORS)
            choose_risk(condition, boxes, duration, largest)
        else:
            condition.aim(risk, largest)
        return condition.level

    left_out, X0, _, D, domain, sides, levels, assumed = find_setting(
        condition, problem, duration, states, budget, report, level_of
    )
    largest = condition.largest
    if constants:
        require_still(lambda t, x: (condition.noise(x)[..., constants, :],), domain)
    wanted, gap = condition.level, condition.level - largest
    needed = just_above(wanted)
    rim = minimum(condition.height, *sides, levels, enough=just_above(needed))
    if problem.constraints is not None:
        rim = min(rim, *levels_of_constraints(condition, problem, domain, budget, just_above(needed)))
    set_up, spent = time.monotonic() - started, budget.elapsed
    proof = prove_in_time(
        condition, domain, min(needed, just_below(rim)), budget,
        generator=generator, report=report, keep=keep, replay=replay, degree=degree,
    )  # fmt: skip
    rho = wanted if proof.level >= needed else proof.level
    lowest = min(rho, rho * math.exp(-decay * duration))
    end = None
    if rho > -math.inf:
        end = extent_of(condition.height, D, rho, Budget(max(1.0, budget.left), chunk=budget.chunk), duration)
    likely = rho - gap if rho >= wanted else _likely_level(condition, rho)
    return ProvedNoisyFunnel(
        alpha=alpha, delta=delta, duration=duration, states=D, rho=rho, wanted=wanted, largest=largest,
        least=largest_sample(condition.V, X0) + gap,
        volume_share=1.0 if rho >= wanted else share_of(condition.V, X0.lower, X0.upper, likely, budget),
        terminal_excess=max(terminal_excess(condition, D, duration, rho, budget), -lowest / alpha),
        counterexample=proof.counterexample, boxes=proof.boxes, seconds=set_up + proof.seconds,
        remaining_volume=proof.remaining_volume, undecided=proof.undecided, left_out=left_out,
        fingerprint=proof.fingerprint, proof_seconds=proof.seconds, constraints=names_of(problem.constraints),
        set_up=spent, assumed=assumed, probability=probability, risk=condition.risk, leak=condition.leak, decay=decay,
        rim=rim, end=end,
    )  # fmt: skip


def kept_largest(path: Path | None, condition: DecreaseCondition) -> float | None:
    """The bound of max V(0, ·) on X₀ that a file records, None if there is no file.

    It defines the condition of the proof; a bound with more boxes may be lower now.

    Raises:
        UsageError: the file holds another proof.
    """
    if path is None or not path.exists():
        return None
    content = select_proof(read_proofs(path), condition.proves, path, "take a new file")
    with refuse_bad_file(path):
        return float(content["of"][0]["largest"])


def _likely_level(condition: NoisyDecrease, rho: float) -> float:
    """The V(0, x₀) up to which closed loops stay with the wanted probability, if only ρ' = rho is proved; or −∞."""
    exponent = min(condition.risk * (condition.level - rho), LARGEST_EXPONENT)
    later = condition.risk * condition.leak * condition.duration * math.exp(exponent)
    start = 1 - condition.probability - later
    return rho + math.log(start) / condition.risk if start > 0 else -math.inf


def levels_of_constraints(
    condition: DecreaseCondition, problem: Problem, domain: tuple[Corner, Corner], budget: Budget, enough: float
) -> list[float]:
    """A lower bound of W on {(t, x): h_j(x) ≥ 0} for each constraint."""
    assert problem.constraints is not None
    h, (lower, upper) = own_constraints(problem.constraints, domain), (side[None] for side in domain)
    return [
        minimum(condition.height, lower, upper, budget_for_level(budget), lambda t, x, j=j: -h(x)[..., j], 0.0, enough)
        for j in range(len(names_of(h)))
    ]


def choose_risk(condition: NoisyDecrease, boxes: Iterable[Box], duration: float, largest: float) -> None:
    """Set λ to the largest one, with the lowest funnel, for which the second term of c is ≤ 0 at samples.

    If there is none, take the one with the lowest share of failures.

    Args:
        boxes: sets of states that are sampled in turn until a λ is found whose funnel they contain.
        largest: max W(0, ·) on X₀.
    """
    best = (math.inf, 1 / max(abs(largest), 1e-6))
    for box in boxes:
        t, V, W, rim, mean, steepness = _sample_rates(condition, box, duration)
        for risk in (RISKS / max(abs(largest), 1e-6)).tolist():
            condition.aim(risk, largest)
            inside = condition.level >= W
            if not rim > condition.level or not bool(inside.any()):
                continue
            fails = condition.excess(t, V, mean, (1 + SAMPLE_MARGIN) * steepness)[inside] > 0
            best = min(best, (float(fails.double().mean()), -risk), key=lambda each: each[0])
            if not bool(fails.any()):
                return
    condition.aim(abs(best[1]), largest)


def _sample_rates(
    condition: NoisyDecrease, box: Box, duration: float
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """(t, V, W, the least W at points of the boundary, 𝓛V, ‖σᵀV_x‖²) at random points of [0, T] × D."""
    (lower, upper), generator = over_time(box, duration), torch.Generator().manual_seed(0)
    t, x = random_points(lower, upper, SAMPLES, generator).tensor_split([1], -1)
    axes = [1 + i for i in range(box.dimension) if upper[1 + i] > lower[1 + i]]
    least, greatest = faces(lower, upper, axes)
    share = torch.rand(SAMPLES // 10, len(lower), generator=generator, dtype=torch.float64)
    sides = least[:, None] + (greatest - least)[:, None] * share
    with torch.no_grad():
        t = t[:, 0]
        rim = condition.height(sides[..., 0], sides[..., 1:]).min()
        return t, condition.V(t, x), condition.height(t, x), rim, *condition.rates(t, x)
