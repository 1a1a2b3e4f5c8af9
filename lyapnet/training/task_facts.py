"""Facts about a problem before training: its goal, its linearisation there, the gain of a step, the initial V."""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor, nn

from lyapnet.base.contracts import SLOPE, jumps
from lyapnet.base.random_streams import OUTPUTS as OUTPUTS_STREAM
from lyapnet.base.random_streams import START, stream
from lyapnet.experiment.assembly.classes import float64_defaults
from lyapnet.experiment.assembly.outputs import estimator_parts
from lyapnet.experiment.config import OutputsConfig
from lyapnet.loop.estimation.kalman import ExtendedKalmanFilter
from lyapnet.loop.estimation.observability import observability
from lyapnet.loop.rollout import Rollout
from lyapnet.task.cost import PenaltyCost
from lyapnet.task.domain import as_written
from lyapnet.task.horizon import TABLEAUX
from lyapnet.task.noise import Noise
from lyapnet.task.operating_points import HELD
from lyapnet.task.problem import Problem
from lyapnet.task.systems import moving_states
from lyapnet.training.candidates import ZERO_VALUE, Candidate, Start
from lyapnet.training.config_facts import OBSERVABLE, Fact, format_numbers
from lyapnet.training.learner import Learner
from lyapnet.training.limit_facts import limit_facts
from lyapnet.training.penalty_weight import find_penalty_weight
from lyapnet.training.stage_messages import StageReport, silent
from lyapnet.training.start import NOT_FINITE_REMEDY, STEP_ERROR_REMEDY, TRIAL_STATES
from lyapnet.training.start_cache import load_or_choose_start
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.expansions import derivatives_of, in_float64, path_under
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

NAMED_CONTROLS = 4  # largest number of controls whose limits are printed by name
STEP_GAIN = "step gain"  # name of a fact
STABLE_GAIN = 2.0  # largest gain Δt λ of the HJB law for which Euler steps do not oscillate and grow
REACHABILITY_TOLERANCE = 1e-10  # relative to A in scaled units: larger entries count as coupling of two states
EIGENVALUE_TOLERANCE = 1e-8  # relative to the largest eigenvalue or A: smaller real and imaginary parts count as zero
OBSERVED_LOOPS = 16  # closed loops along which it is tested whether outputs determine the state
VAGUE = 0.5  # share of the uncertainty of x₀ that remains at T, above which the outputs do not determine a state
CONVEX = "convex"  # name of a fact
CONVEXITY_LOOPS, CONVEXITY_NODES, CONVEXITY_CONTROLS = 64, 8, 32  # loops, nodes of each and controls that are tried
DOMAIN_TEST_STATES = 64  # states of X₀ whose closed loops are checked against the domain
ROUNDING_UNITS = 100  # rounding error of a rate that sums several terms, in units of the machine precision


def facts_of(
    learner: Learner,
    report: StageReport = silent,
    known: Callable[[Fact], None] = lambda fact: None,
    may_look_ahead: bool = False,
    outputs: OutputsConfig | None = None,
) -> list[Fact]:
    """The facts about a learner's problem. Also initialises V and the constraint penalty as training would.

    Args:
        report: called with each stage of the work.
        known: called with each fact as soon as it is known.
        may_look_ahead: whether training may replace the sampled law by the lookahead law.
        outputs: the outputs that are measured; None: the state.
    """
    problem, facts = learner.problem, list[Fact]()

    def tell(*several: Fact) -> None:
        for fact in several:
            facts.append(fact)
            known(fact)

    with float64_defaults():  # as when the problem is built, so that f has the same constants
        exact = in_float64(problem)
        tell(_system_fact(exact), *jump_facts(exact), *kink_facts(exact))
        if exact.domain is not None:
            tell(Fact("domain", str(exact.domain)))
        if exact.noise is not None:
            tell(_noise_fact(exact, exact.noise))
        if not exact.has_goal:
            tell(Fact("goal", f"none: {exact.no_goal}", f"nothing, if that is the task; else {NAME_A_GOAL}"))
        elif exact.follows_reference:
            tell(Fact("reference", "the control u_r, about which controls cost nothing, follows it"))
        elif (around := linearised(exact)).missing_values is not None:
            tell(Fact("goal", f"none: {around.missing_values.reason}", around.missing_values.remedy))
        else:
            tell(_goal_fact(exact, around, problem.goal.dtype), *_mode_facts(exact, around), *limit_facts(exact))
            gain = step_gain(exact, learner.rollout)
            if around.missing is not None and around.missing.reason in gain.found:
                gain = Fact(STEP_GAIN, "unknown, for the reason above")
            tell(gain)
    try:
        if isinstance(problem.cost, PenaltyCost):
            relaxation = find_penalty_weight(problem, report)
            problem.cost.weight.fill_(relaxation.weight)
            tell(Fact("constraints", str(relaxation).removeprefix("constraints: ")))
        start = load_or_choose_start(
            [learner], report, lambda candidate: tell(_candidate_fact(candidate, facts)), may_look_ahead
        )
    except LinAlgError as error:
        reason, remedy = singular(error)
        tell(Fact("start", f"not found: {reason}", remedy))
        return facts
    tell(
        *_start_facts(start),
        *_domain_facts(learner),
        *convexity_facts(problem, learner.V, learner.rollout.closed_loop.policy),
    )
    tell(*observability_facts(learner, outputs))
    return facts


def observability_facts(learner: Learner, config: OutputsConfig | None) -> list[Fact]:
    """Whether the outputs of a config determine the state along closed loops of the start; empty without outputs.

    Process noise of moving states is left out, because its effect in a step does not depend on the outputs. For states
    that are constant in the model, parameters and disturbances, their random walk limits what can be known.
    """
    if config is None or (parts := estimator_parts(config, in_float64(learner.problem))) is None:
        return []
    problem, outputs, drift, deviation = parts
    x0 = problem.initial_states.sample(OBSERVED_LOOPS, stream(0, START, OUTPUTS_STREAM))
    law, like = learner.rollout.closed_loop.policy, learner.problem.initial_states.lower
    times = problem.horizon.times(like)
    path = path_under(problem, lambda n, x: law(times[n], x[..., : len(like)].to(like)).to(x), x0)
    rows = path.cost.isfinite()
    if not rows.any():
        return [Fact(OBSERVABLE, "unknown: no closed loop of the start is finite")]
    x, u = path.x[:, rows], path.u[:, rows]
    system = problem.system
    found = observability(ExtendedKalmanFilter(problem, outputs, drift), x, u, deviation)
    fixed = problem.initial_states.widths == 0  # their deviation is only a convention
    usual = torch.where(fixed, deviation.maximum(x.flatten(0, 1).std(0)), deviation)
    estimated = [(i, name) for i, name in enumerate(system.state_names) if i not in system.settings]
    vague = [name for i, name in estimated if found.of_first[i] > VAGUE * usual[i]]
    told = ", ".join(f"{name} {float(found.deviation[i]):.2g}" for i, name in estimated)
    count = len(estimated)
    condition = f"condition {found.condition:.2g}" if found.rank == count else f"rank {found.rank} of {count}"
    known = f"standard deviations at T: {told}; {condition} of the Gramian along {x.shape[1]} loops of the start"
    walking = [name for i, name in estimated if i in system.constants and found.deviation[i] > VAGUE * deviation[i]]
    if not vague and not walking:
        return [Fact(OBSERVABLE, f"yes; {known}")]
    if not vague:
        listed, walk = ", ".join(walking), "it walks" if len(walking) == 1 else "they walk"
        return [
            Fact(
                OBSERVABLE,
                f"no: at T more than half of the first uncertainty is left of {listed}, as {walk}; {known}",
                f"a smaller walk of {listed}, or readings that tell more of it",
            )
        ]
    listed = ", ".join(vague)
    return [
        Fact(
            OBSERVABLE,
            f"no: the outputs hardly tell {listed}; {known}",
            f"measure {listed} too, or states that depend on them",
        )
    ]


@torch.no_grad()
def convexity_facts(problem: Problem, V: ValueFunction, law: nn.Module) -> list[Fact]:
    """The share of states along loops of the start at which ℓ + V_xᵀF(x, u) is not convex in u, if F is not affine.

    Controls are drawn from U; without limits from a range three times as wide as that of the loops.
    """
    system = problem.system
    if system.affine:
        return []
    x0, times = problem.initial_states.sample(CONVEXITY_LOOPS, stream(0, START)), problem.horizon.times(problem.goal)
    path = path_under(problem, lambda n, x: law(times[n], x), x0)
    nodes = torch.linspace(0, problem.horizon.steps - 1, CONVEXITY_NODES).long()
    rows = path.cost.isfinite()
    if not rows.any():
        return [Fact(CONVEX, "unknown: no closed loop of the start is finite")]
    x, t = path.x[nodes][:, rows], times[nodes][:, None].expand(-1, int(rows.sum()))
    assert problem.controls.limits is not None  # the problem refuses other sets
    used = path.u[:, rows].flatten(0, 1)
    wide = used.amax(0) - used.amin(0)
    ends = (used.amin(0) - wide, used.amax(0) + wide)
    low, high = (
        torch.where(side.isfinite(), side.to(x), end) for side, end in zip(problem.controls.limits, ends, strict=True)
    )
    share = torch.rand(CONVEXITY_CONTROLS, 1, 1, system.m, generator=stream(0, START)).to(x)
    u = (low + share * (high - low)).expand(-1, *x.shape[:-1], -1)
    V_x = V.value_and_state_gradient(t, x)[1]

    def hamiltonian(u: Tensor) -> Tensor:
        here = x.expand(*u.shape[:-1], -1)
        return problem.cost.smooth_running(here, u) + (V_x * system.dynamics(here, u)).sum(-1)

    curvature = derivatives_of(hamiltonian, u)[1].double()
    least = torch.linalg.eigvalsh(curvature.nan_to_num(0, 0, 0))[..., 0]
    bent = (least < -ROUNDING_UNITS * torch.finfo(x.dtype).eps * curvature.abs().amax((-2, -1))).any(0)
    tried = f"{bent.numel()} states along closed loops of the start, at {CONVEXITY_CONTROLS} controls each"
    if not bent.any():
        return [Fact(CONVEX, f"ℓ + V_xᵀF(x, u) is convex in u at {tried}")]
    k = int(torch.where(bent, least.amin(0), torch.inf).argmin())
    worst = int(least.flatten(1)[:, k].argmin())
    place = f"t = {float(t.flatten()[k]):.3g} s, x = {_format_vector(x.flatten(0, 1)[k])}"
    found = f"ℓ + V_xᵀF(x, u) is not convex in u at {float(bent.double().mean()):.0%} of {tried}: as at {place}, "
    found += f"u = {_format_vector(u.flatten(1, 2)[worst, k])}"
    return [Fact(CONVEX, f"{found}; the law looks for its minimum from several starts")]


def _domain_facts(learner: Learner) -> Iterator[Fact]:
    """The number of states of X₀ whose closed loops leave the domain, and constraints that prevent it."""
    domain = learner.problem.domain
    if domain is None:
        return
    x0 = learner.problem.initial_states.sample(DOMAIN_TEST_STATES, stream(0, START))
    law = learner.rollout.closed_loop.policy
    left = domain.left(path_under(learner.problem, lambda n, x: law(learner.problem.horizon.times(x)[n], x), x0).x)
    if left.any():
        limits = " ".join(f"constraints.{each.side}.{each.state}={each.value:g}" for each in domain.borders)
        found = f"closed loops of the start leave it from {int(left.sum())} of {DOMAIN_TEST_STATES} states of X₀"
        yield Fact("domain", found, f"{limits}, which training then keeps, or a smaller horizon.dt")


def jump_facts(problem: Problem) -> list[Fact]:
    """The jumps of f, g and the cost on a box around X₀ and the goal; the optima assume smooth functions."""
    problem, box = in_float64(problem), problem.initial_states
    cost = as_written(problem.cost)
    low, high = (end(getattr(box, side).double(), problem.goal) for side, end in
                 (("lower", torch.minimum), ("upper", torch.maximum)))  # fmt: skip
    width, size = high - low, torch.maximum(low.abs(), high.abs())
    room = width.where(width > 0, size.where(size > 0, 1.0)) / 2
    system, written = type(problem.system).__name__, type(cost).__name__
    with float64_defaults():
        return [
            Fact("jumps", jump.described(name, problem.system.state_names), SLOPE)
            for name, function in (
                *((f"{system}.{name}", function) for name, function in problem.functions_of_state.items()),
                (f"q(x) of {written}", cost.state), (f"φ(x) of {written}", cost.terminal),
            )
            for jump in jumps(function, low - room, high + room)
        ]  # fmt: skip


def kink_facts(problem: Problem) -> list[Fact]:
    """The kinks of the cost at the goal, and how training smooths them."""
    part = smoothed_part(problem.cost)
    if part is None:
        return []
    kinked = [symbol for symbol, widths in part.widths.items() if any(widths)]
    has, it = ("has", "it") if len(kinked) == 1 else ("have", "them")
    return [Fact("kink", f"{' and '.join(kinked)} {has} a kink at the goal: training smooths {it}, {part.words}")]


def _start_facts(start: Start | None) -> Iterator[Fact]:
    """The initial V of training, and the error of the rollout's steps."""
    if start is None:
        yield Fact("start", "the network with random weights", "network.name=expansion tries what is known of V")
        return
    if start.steps_miss:
        yield Fact("steps", start.steps_miss, STEP_ERROR_REMEDY)
    if start.should_look_ahead:
        yield Fact("law", start.about_law)
    advice = ""
    if start.chosen.finite < 1:
        advice = f"no candidate is finite on all of X₀: {NOT_FINITE_REMEDY}"
    elif start.chosen.name == ZERO_VALUE:
        advice = "nothing known is better than no control: expect a longer training"
    yield Fact("start", f"training starts from {start.chosen.name}", advice)


def _candidate_fact(candidate: Candidate, told: Sequence[Fact]) -> Fact:
    """The result of a candidate; a reason that was already given is not repeated."""
    if candidate.missing is not None:
        found, (reason, remedy) = f"no {candidate.name.removeprefix('the ')}", candidate.missing
        if any(reason in fact.found for fact in told):
            return Fact("start", f"{found}, for the reason above")
        return Fact("start", f"{found}: {reason}", remedy)
    mean = f"mean cost from {TRIAL_STATES} states of X₀ {candidate.cost:.5g}"
    cost = mean if candidate.finite == 1 else f"finite on {candidate.finite:.0%} of X₀"
    earlier = " of an earlier search" if candidate.kept else ""
    return Fact("start", f"from {candidate.name}: {cost}, known after {_format_seconds(candidate.seconds)} s{earlier}")


def _system_fact(problem: Problem) -> Fact:
    system, controls = problem.system, problem.controls
    limits = ""
    if controls.limited:
        limits = f" in {controls}"
        if controls.fixed_limits is not None and controls.is_box:
            low, high = (side.expand(system.m) for side in controls.fixed_limits)
            units = (unit if unit != "1" else "" for unit in system.control_units)
            rows = zip(system.control_names, units, low.tolist(), high.tolist(), strict=True)
            limits = f" between {_format_vector(low)} and {_format_vector(high)}"
            if system.m <= NAMED_CONTROLS:
                named = [f"{name} between {a:.3g} and {b:.3g} {unit}".rstrip() for name, unit, a, b in rows]
                limits = ": " + ", ".join(named)
    return Fact(
        "system",
        f"{system.title}: {_format_count(system.n, 'state')}, {_format_count(system.m, 'control')}{limits}",
    )


def _noise_fact(problem: Problem, noise: Noise) -> Fact:
    """The strength of the noise of each state at the goal, and the cost of noise there by the linearised problem."""
    system, at = problem.system, problem.goal if problem.has_goal else problem.initial_states.center
    place = "the goal" if problem.has_goal else "the centre of X₀"
    strengths = torch.linalg.vector_norm(noise(at), dim=-1).tolist()
    listed = ", ".join(
        f"{name} {strength:.3g}" for name, strength in zip(system.state_names, strengths, strict=True) if strength
    )
    found = f"{_format_count(noise.sources, 'source')}; per √s at {place}: {listed or 'none'}"
    if problem.has_goal and not isinstance(around := riccati_or_reason(problem), Missing):
        found += f"; from the goal it costs {float(around.value[0]):.4g} up to T"
    return Fact("noise", f"{found}; costs of starts, below, are those under noise")


def _goal_fact(problem: Problem, around: Linearisation, precision: torch.dtype) -> Fact:
    """Whether the goal is an equilibrium up to rounding, or which control holds it."""
    rounding = max(HELD, ROUNDING_UNITS * torch.finfo(precision).eps)
    goal, system = problem.goal, problem.system
    f, rest = around.f, system.dynamics(goal, problem.rest)
    where, held = f"{_format_vector(goal)}, " if goal.any() else "", problem.controls.moved(goal, problem.rest)
    if not bool(problem.controls.contains(problem.rest)):
        return Fact("goal", f"{where}u = {_format_vector(held)} is beyond its limits", "the cost has no rest there")
    if float(rest.abs().max()) <= rounding * max(1.0, float(f.abs().max())):
        control = f"at u = {_format_vector(held)}" if held.any() else "without control"
        return Fact("goal", f"{where}an equilibrium {control}")
    u, left = system.holding_control(goal)
    if float(left.abs().max()) <= rounding * float(f.abs().max()):
        remedy = f"target: {goal.tolist()} has uᵀRu count u from there"
        if problem.cost.nonquadratic is None:
            remedy += ", so that staying costs nothing"
        if problem.cost.rest is not None:  # target_control says from where
            remedy = ""
        u = problem.controls.moved(goal, u)
        return Fact("goal", f"{where}held by u = {_format_vector(u)}, which the cost charges", remedy)
    return Fact(
        "goal",
        f"{where}no equilibrium: f(x*) = {_format_vector(f)}, and no control holds it",
        "the cost has no rest there",
    )


def _mode_facts(problem: Problem, around: Linearisation) -> list[Fact]:
    """The eigenvalues of ẋ = Ax + Bu at the goal, and whether the pair (A, B) is controllable."""
    if around.missing is not None:
        return [Fact("modes", f"unknown: {around.missing.reason}", around.missing.remedy)]
    moving = moving_states(problem.system)
    A, B, dt = around.A[moving][:, moving], around.g[moving], problem.horizon.dt
    extent = problem.initial_states.reach_from(problem.goal)[moving]
    values = torch.linalg.eigvals(A)
    facts = [Fact("modes", f"{_format_modes(values)} 1/s at the goal, without feedback")]
    unreached = unreached_modes(A, B, extent.where(extent > 0, 1))
    if not len(unreached):
        facts.append(Fact("controllable", "yes, linearised at the goal"))
    else:
        grows = bool((unreached.real > REACHABILITY_TOLERANCE * float(A.abs().max())).any())
        facts.append(Fact(
            "controllable", f"not linearised at the goal: u does not reach {_format_modes(unreached)}",
            "what grows there cannot be held near the goal" if grows else "",
        ))  # fmt: skip
    method, z = problem.horizon.method, dt * values
    order = len(TABLEAUX[method].b)  # of these methods' stability polynomials: their number of stages
    growth = sum((z**k / math.factorial(k) for k in range(1, order + 1)), start=torch.ones_like(z)).abs()
    if bool(((growth > 1 + 1e-9) & (values.real < -1e-9)).any()):
        by = "Euler" if method == "euler" else method
        facts.append(Fact("Δt", f"{dt:g} s makes a decaying mode grow under {by} steps", STEP_ERROR_REMEDY))
    return facts


def unreached_modes(A: Tensor, B: Tensor, extent: Tensor) -> Tensor:
    """The eigenvalues of the uncontrollable part of ẋ = Ax + Bu.

    The staircase algorithm splits off the states that B moves, then the states that these move, and so on, until the
    remaining part is not moved. States are scaled by their extents and balanced, so that the couplings of two states
    have the same size in both directions; each column of B is scaled to norm 1.

    Source: Van Dooren, "The generalized eigenstructure problem in linear system theory", IEEE Transactions on Automatic
    Control 1981 (the staircase form).
    """
    from scipy.linalg import matrix_balance  # imported here because it takes 0.1 s

    _, (units, _) = matrix_balance((A * extent / extent[:, None]).numpy(), permute=False, separate=True)
    extent = extent * torch.from_numpy(units)
    A, B = A * extent / extent[:, None], B / extent[:, None]
    B = B / B.norm(dim=0).clamp_min(torch.finfo(B.dtype).tiny)
    weakest = REACHABILITY_TOLERANCE
    size = float(A.norm()) or 1.0
    while len(A):
        rotation, moved, _ = torch.linalg.svd(B)
        rank = int((moved > weakest).sum())
        if not rank:
            break
        A = rotation.mT @ A @ rotation
        A, B, weakest = A[rank:, rank:], A[rank:, :rank], REACHABILITY_TOLERANCE * size
    return _drop_rounding(torch.linalg.eigvals(A), size)


def step_gain(problem: Problem, rollout: Rollout | None = None) -> Fact:
    """The gain of the HJB law over one step, Δt λ_max(R⁻¹gᵀHg)/2 at the goal, with H from the Riccati solution."""
    at_goal = riccati_or_reason(problem)
    if isinstance(at_goal, Missing):
        return Fact(STEP_GAIN, f"unknown: {at_goal.reason}; {at_goal.remedy}")
    g, R = problem.system.affine_model(problem.goal, problem.rest)[1].detach(), problem.cost.R(problem.goal)
    weighted = torch.linalg.solve(R, g.mT @ at_goal.hessian @ g)
    if not weighted.isfinite().all():
        return Fact(STEP_GAIN, "unknown: R⁻¹gᵀV_xx g is not finite at the goal; give every control a weight in R")
    gain = problem.horizon.dt / 2 * float(torch.linalg.eigvals(weighted).real.max())
    found = f"Δt λ(R⁻¹gᵀV_xx g)/2 = {gain:.3g}"
    if gain <= STABLE_GAIN:
        return Fact(STEP_GAIN, f"every control law is stable at this Δt: {found}")
    found = f"{found} > {STABLE_GAIN:g}"
    if rollout is not None and rollout.closed_loop.policy.held:
        law = "the law that this config has is stable, made to be held for Δt"
        return Fact(STEP_GAIN, f"{law}; rollout.policy=hjb would not be: {found}")
    found = f"rollout.policy=hjb is unstable at this Δt: {found}"
    return Fact(
        STEP_GAIN, found, f"rollout.policy=sampled, or horizon.dt ≤ {problem.horizon.dt * STABLE_GAIN / gain:.2g}"
    )


def _format_count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def _format_vector(values: Tensor) -> str:
    """The entries in brackets, with 0 for what is rounding beside the largest."""
    rounding = values.abs() < 1e-12 * values.abs().amax()
    return format_numbers(values.masked_fill(rounding, 0.0).tolist())


def _format_seconds(seconds: float) -> str:
    return f"{seconds:.0f}" if seconds >= 10 else f"{seconds:.2g}"


def _format_modes(values: Tensor) -> str:
    """Format eigenvalues by decreasing real part, equal ones once: "2, 0 (3 times), -1 ± 3i"."""
    size = EIGENVALUE_TOLERANCE * float(values.abs().max())
    values = torch.complex(
        values.real.where(values.real.abs() > size, 0), values.imag.where(values.imag.abs() > size, 0)
    )
    ordered = sorted(values.tolist(), key=lambda value: (-value.real, abs(value.imag)))
    counts = Counter(_format_complex(value) for value in ordered if value.imag >= 0)
    return ", ".join(text if count == 1 else f"{text} ({count} times)" for text, count in counts.items())


def _drop_rounding(values: Tensor, size: float) -> Tensor:
    """Set real and imaginary parts to zero that are only rounding relative to a size."""
    parts = torch.view_as_real(values)
    return torch.view_as_complex(parts.where(parts.abs() > EIGENVALUE_TOLERANCE * size, 0))


def _format_complex(value: complex) -> str:
    """Format a real number, or a conjugate pair."""
    return f"{value.real + 0.0:.3g}" if not value.imag else f"{value.real + 0.0:.3g} ± {value.imag:.3g}i"
