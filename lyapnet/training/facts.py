"""What can be said of a problem before training: its goal, its linearisation there, how stiff it is, where to start."""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from lyapnet.base.contracts import SLOPE, jumps
from lyapnet.base.random_streams import START, stream
from lyapnet.experiment.assembly.classes import float64_defaults
from lyapnet.loop.rollout import Rollout
from lyapnet.task.cost import PenaltyCost
from lyapnet.task.domain import as_written
from lyapnet.task.horizon import TABLEAUX
from lyapnet.task.operating_points import HELD
from lyapnet.task.problem import Problem
from lyapnet.training.candidates import CALM, Candidate, Start
from lyapnet.training.fact import Fact, listed
from lyapnet.training.learner import Learner
from lyapnet.training.relaxation import find_relaxation
from lyapnet.training.stages import Report, silent
from lyapnet.training.start import REMEDY, SMALLER, STATES
from lyapnet.training.start_cache import kept_or_chosen
from lyapnet.value.expansions import in_float64, path_under
from lyapnet.value.linearisation import (
    NAME_A_GOAL,
    LinAlgError,
    Linearisation,
    Missing,
    linearised,
    riccati_or_reason,
    singular,
    smoothed_part,
)

STABLE = 2.0  # a gain of the HJB law above which Euler steps of it oscillate and grow
REACHED = 1e-10  # of A, with states and controls in units of their own, above which one state acts on another
ROUNDED = 1e-8  # of the largest eigenvalue or of A, below which a part of an eigenvalue is zero
LOOPS = 64  # from as many states it is seen whether closed loops leave the domain
ROUNDINGS = 100  # of the task's precision, for a rate that sums several terms


def facts_of(
    learner: Learner,
    report: Report = silent,
    known: Callable[[Fact], None] = lambda fact: None,
    may_look_ahead: bool = False,
) -> list[Fact]:
    """The facts of a learner's problem; V and the penalty of constraints are left where training begins.

    Args:
        report: is told what is being done.
        known: is told each fact as soon as it is.
        may_look_ahead: whether training may take the law that looks ahead in the place of the sampled one.
    """
    problem, facts = learner.problem, list[Fact]()

    def tell(*several: Fact) -> None:
        for fact in several:
            facts.append(fact)
            known(fact)

    with float64_defaults():  # as the problem is built, so that f computes with the same constants
        exact = in_float64(problem)
        tell(_task(exact), *jump_facts(exact), *kink_facts(exact))
        if exact.domain is not None:
            tell(Fact("domain", str(exact.domain)))
        if not exact.has_goal:
            tell(Fact("goal", f"none: {exact.no_goal}", f"nothing, if that is the task; else {NAME_A_GOAL}"))
        elif (around := linearised(exact)).missing_values is not None:
            tell(Fact("goal", f"none: {around.missing_values.reason}", around.missing_values.remedy))
        else:
            tell(_goal(exact, around, problem.goal.dtype), *_modes(exact, around))
            stiff = stiffness(exact, learner.rollout)
            if around.missing is not None and around.missing.reason in stiff.found:
                stiff = Fact("stiffness", "unknown, for the reason above")
            tell(stiff)
    try:
        if isinstance(problem.cost, PenaltyCost):
            relaxation = find_relaxation(problem, report)
            problem.cost.weight.fill_(relaxation.weight)
            tell(Fact("constraints", str(relaxation).removeprefix("constraints: ")))
        start = kept_or_chosen([learner], report, lambda candidate: tell(_tried(candidate, facts)), may_look_ahead)
    except LinAlgError as error:
        reason, remedy = singular(error)
        tell(Fact("start", f"not found: {reason}", remedy))
        return facts
    tell(*_chosen(start), *_leaving(learner))
    return facts


def _leaving(learner: Learner) -> Iterator[Fact]:
    """From how many of LOOPS states of X₀ closed loops leave the domain, and what keeps them in it."""
    domain = learner.problem.domain
    if domain is None:
        return
    x0 = learner.problem.initial_states.sample(LOOPS, stream(0, START))
    law = learner.rollout.closed_loop.policy
    left = domain.left(path_under(learner.problem, lambda n, x: law(learner.problem.horizon.times(x)[n], x), x0).x)
    if left.any():
        limits = " ".join(f"constraints.{each.side}.{each.state}={each.value:g}" for each in domain.borders)
        found = f"closed loops of the start leave it from {int(left.sum())} of {LOOPS} states of X₀"
        yield Fact("domain", found, f"{limits}, which training then keeps, or a smaller horizon.dt")


def jump_facts(problem: Problem) -> list[Fact]:
    """Where f, g and the cost jump, on X₀ and beside it as far as the goal; optima take them as smooth."""
    problem, box = in_float64(problem), problem.initial_states
    cost = as_written(problem.cost)
    low, high = (end(getattr(box, side).double(), problem.goal) for side, end in
                 (("lower", torch.minimum), ("upper", torch.maximum)))  # fmt: skip
    width, size = high - low, torch.maximum(low.abs(), high.abs())
    room = width.where(width > 0, size.where(size > 0, 1.0)) / 2
    system, written = type(problem.system).__name__, type(cost).__name__
    with float64_defaults():
        return [
            Fact("jumps", jump.told(name, problem.system.state_names), SLOPE)
            for name, function in (
                (f"{system}.f(x)", problem.system.f), (f"{system}.g(x)", problem.system.g),
                (f"q(x) of {written}", cost.state), (f"φ(x) of {written}", cost.terminal),
            )
            for jump in jumps(function, low - room, high + room)
        ]  # fmt: skip


def kink_facts(problem: Problem) -> list[Fact]:
    """Which kinks of the cost at the goal are rounded, and how."""
    part = smoothed_part(problem.cost)
    if part is None:
        return []
    kinked = [symbol for symbol, widths in part.widths.items() if any(widths)]
    has, it = ("has", "it") if len(kinked) == 1 else ("have", "them")
    return [Fact("kink", f"{' and '.join(kinked)} {has} a kink at the goal: training rounds {it}, {part.words}")]


def _chosen(start: Start | None) -> Iterator[Fact]:
    """Where training starts from, and what its steps miss."""
    if start is None:
        yield Fact("start", "the network as it is drawn", "network.name=expansion tries what is known of V")
        return
    if start.steps_miss:
        yield Fact("steps", start.steps_miss, REMEDY)
    if start.should_look_ahead:
        yield Fact("law", start.about_law)
    advice = ""
    if start.chosen.finite < 1:
        advice = f"no candidate is finite on all of X₀: {SMALLER}"
    elif start.chosen.name == CALM:
        advice = "nothing known is better than no control: expect a longer training"
    yield Fact("start", f"training starts from {start.chosen.name}", advice)


def _tried(candidate: Candidate, told: Sequence[Fact]) -> Fact:
    """What came of a candidate; why there is none is said once."""
    if candidate.missing is not None:
        found, (reason, remedy) = f"no {candidate.name.removeprefix('the ')}", candidate.missing
        if any(reason in fact.found for fact in told):
            return Fact("start", f"{found}, for the reason above")
        return Fact("start", f"{found}: {reason}", remedy)
    mean = f"mean cost from {STATES} states of X₀ {candidate.cost:.5g}"
    cost = mean if candidate.finite == 1 else f"finite on {candidate.finite:.0%} of X₀"
    earlier = " of an earlier search" if candidate.kept else ""
    return Fact("start", f"from {candidate.name}: {cost}, known after {_seconds(candidate.seconds)} s{earlier}")


def _task(problem: Problem) -> Fact:
    system, controls = problem.system, problem.controls
    limits = ""
    if controls.limited:
        sides = None if controls.limits is None else [_listed(side.expand(system.m)) for side in controls.limits]
        limits = f" in {type(controls).__name__}" if sides is None else f" between {sides[0]} and {sides[1]}"
    return Fact(
        "system",
        f"{system.title}: {_counted(system.n, 'state')}, {_counted(system.m, 'control')}{limits}",
    )


def _goal(problem: Problem, around: Linearisation, precision: torch.dtype) -> Fact:
    """Whether the goal is an equilibrium, up to rounding in the precision of the task, or which control holds it."""
    rounding = max(HELD, ROUNDINGS * torch.finfo(precision).eps)
    goal, system = problem.goal, problem.system
    f, rest = around.f, system.dynamics(goal, problem.rest)
    where = f"{_listed(goal)}, " if goal.any() else ""
    if not bool(problem.controls.contains(problem.rest)):
        return Fact("goal", f"{where}u = {_listed(problem.rest)} is beyond its limits", "the cost has no rest there")
    if float(rest.abs().max()) <= rounding * max(1.0, float(f.abs().max())):
        control = f"at u = {_listed(problem.rest)}" if problem.rest.any() else "without control"
        return Fact("goal", f"{where}an equilibrium {control}")
    u, left = system.holding_control(goal)
    if float(left.abs().max()) <= rounding * float(f.abs().max()):
        remedy = f"target: {goal.tolist()} has the cost count u from there, so that staying costs nothing"
        if problem.cost.rest is not None:  # target_control says from where
            remedy = ""
        return Fact("goal", f"{where}held by u = {_listed(u)}, which the cost charges", remedy)
    return Fact(
        "goal", f"{where}no equilibrium: f(x*) = {_listed(f)}, and no control holds it", "the cost has no rest there"
    )


def _modes(problem: Problem, around: Linearisation) -> list[Fact]:
    """The eigenvalues of ẋ = Ax + Bu around the goal, and whether u reaches them."""
    if around.missing is not None:
        return [Fact("modes", f"unknown: {around.missing.reason}", around.missing.remedy)]
    moving = [i for i in range(problem.system.n) if i not in problem.system.constants]
    A, B, dt = around.A[moving][:, moving], around.g[moving], problem.horizon.dt
    extent = problem.initial_states.reach_from(problem.goal)[moving]
    values = torch.linalg.eigvals(A)
    facts = [Fact("modes", f"{_modes_in_words(values)} 1/s at the goal")]
    unreached = unreached_modes(A, B, extent.where(extent > 0, 1))
    if not len(unreached):
        facts.append(Fact("controllable", "yes, linearised at the goal"))
    else:
        grows = bool((unreached.real > REACHED * float(A.abs().max())).any())
        facts.append(Fact(
            "controllable", f"not linearised at the goal: u does not reach {_modes_in_words(unreached)}",
            "what grows there cannot be held near the goal" if grows else "",
        ))  # fmt: skip
    method, z = problem.horizon.method, dt * values
    order = len(TABLEAUX[method].b)  # of each of these methods, as of its stability polynomial
    growth = sum((z**k / math.factorial(k) for k in range(1, order + 1)), start=torch.ones_like(z)).abs()
    if bool(((growth > 1 + 1e-9) & (values.real < -1e-9)).any()):
        by = "Euler" if method == "euler" else method
        facts.append(Fact("Δt", f"{dt:g} s makes a decaying mode grow under {by} steps", REMEDY))
    return facts


def unreached_modes(A: Tensor, B: Tensor, extent: Tensor) -> Tensor:
    """The eigenvalues of the part of ẋ = Ax + Bu that u does not reach: by rotations, the states that B moves are split
    off, then those that these move, and so on, until nothing moves what is left.

    States are in units of their extents, balanced, so that what one does to another is as large as what that does to it
    where both act, and each control in that in which it moves them by one.

    Source: Van Dooren, "The generalized eigenstructure problem in linear system theory", IEEE Transactions on Automatic
    Control 1981 (the staircase form).
    """
    from scipy.linalg import matrix_balance  # loaded where it is asked for: it takes a tenth of a second

    _, (units, _) = matrix_balance((A * extent / extent[:, None]).numpy(), permute=False, separate=True)
    extent = extent * torch.from_numpy(units)
    A, B = A * extent / extent[:, None], B / extent[:, None]
    B = B / B.norm(dim=0).clamp_min(torch.finfo(B.dtype).tiny)
    weakest = REACHED
    size = float(A.norm()) or 1.0
    while len(A):
        rotation, moved, _ = torch.linalg.svd(B)
        rank = int((moved > weakest).sum())
        if not rank:
            break
        A = rotation.mT @ A @ rotation
        A, B, weakest = A[rank:, rank:], A[rank:, :rank], REACHED * size
    return _rounded(torch.linalg.eigvals(A), size)


def stiffness(problem: Problem, rollout: Rollout | None = None) -> Fact:
    """Δt λ_max(R⁻¹gᵀHg)/2 at the goal, H from the Riccati solution: the gain of the HJB law over one step."""
    at_goal = riccati_or_reason(problem)
    if isinstance(at_goal, Missing):
        return Fact("stiffness", f"unknown: {at_goal.reason}; {at_goal.remedy}")
    g, R = problem.system.g(problem.goal), problem.cost.R(problem.goal)
    weighted = torch.linalg.solve(R, g.mT @ at_goal.hessian @ g)
    if not weighted.isfinite().all():
        return Fact("stiffness", "unknown: R⁻¹gᵀV_xx g is not finite at the goal; give every control a weight in R")
    gain = problem.horizon.dt / 2 * float(torch.linalg.eigvals(weighted).real.max())
    found = f"Δt λ(R⁻¹gᵀV_xx g)/2 = {gain:.3g}"
    if gain <= STABLE:
        return Fact("stiffness", f"{found}: every control law is stable at this Δt")
    found = f"{found} > {STABLE:g}: rollout.policy=hjb is unstable at this Δt"
    if rollout is not None and rollout.closed_loop.policy.held:
        return Fact("stiffness", f"{found}; the law that this config has is made to be held for Δt, and is stable")
    return Fact("stiffness", found, f"rollout.policy=sampled, or horizon.dt ≤ {problem.horizon.dt * STABLE / gain:.2g}")


def _counted(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def _listed(values: Tensor) -> str:
    return listed(values.tolist())


def _seconds(seconds: float) -> str:
    return f"{seconds:.0f}" if seconds >= 10 else f"{seconds:.2g}"


def _modes_in_words(values: Tensor) -> str:
    """Eigenvalues in decreasing order of their real parts, those that look alike once: "2, 0 (3 times), -1 ± 3i"."""
    size = ROUNDED * float(values.abs().max())
    values = torch.complex(
        values.real.where(values.real.abs() > size, 0), values.imag.where(values.imag.abs() > size, 0)
    )
    ordered = sorted(values.tolist(), key=lambda value: (-value.real, abs(value.imag)))
    counts = Counter(_complex(value) for value in ordered if value.imag >= 0)
    return ", ".join(text if count == 1 else f"{text} ({count} times)" for text, count in counts.items())


def _rounded(values: Tensor, size: float) -> Tensor:
    """Complex numbers without parts that are only rounding, against a size."""
    parts = torch.view_as_real(values)
    return torch.view_as_complex(parts.where(parts.abs() > ROUNDED * size, 0))


def _complex(value: complex) -> str:
    """A real number, or a conjugate pair."""
    return f"{value.real + 0.0:.3g}" if not value.imag else f"{value.real + 0.0:.3g} ± {value.imag:.3g}i"
