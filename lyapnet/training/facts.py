"""What can be said of a problem before training: its goal, its linearisation there, how stiff it is, where to start."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.cost import PenaltyCost
from lyapnet.expansions import in_float64, riccati
from lyapnet.horizon import TABLEAUX
from lyapnet.problem import Problem
from lyapnet.rollout import Rollout
from lyapnet.training.learner import Learner
from lyapnet.training.relaxation import find_relaxation
from lyapnet.training.start import CALM, REMEDY, Report, choose_start, silent

STABLE = 2.0  # a gain of the HJB law above which Euler steps of it oscillate and grow


class Fact(NamedTuple):
    """A line: what it is about, what was found, and what to do where that is a reason to."""

    name: str
    found: str
    advice: str = ""


def facts_of(learner: Learner, report: Report = silent) -> list[Fact]:
    """The facts of a learner's problem; V and the penalty of constraints are left where training begins.

    Args:
        report: is told what is being done.
    """
    problem = learner.problem
    exact = in_float64(problem)
    facts = [_task(exact), _goal(exact), *_linearisation(exact), stiffness(exact, learner.rollout)]
    if isinstance(problem.cost, PenaltyCost):
        relaxation = find_relaxation(problem, report)
        problem.cost.weight.fill_(relaxation.weight)
        facts.append(Fact("constraints", str(relaxation).removeprefix("constraints: ")))
    start = choose_start([learner], report)
    if start is None:
        return [*facts, Fact("start", "the network as it is drawn", "network.name=expansion tries what is known of V")]
    for candidate in start.candidates:
        cost = f"mean cost {candidate.cost:.5g}" if candidate.finite == 1 else f"finite on {candidate.finite:.0%} of X₀"
        chosen = " ← training starts here" if candidate == start.chosen else ""
        facts.append(Fact(f"start from {candidate.name}", f"{cost}, known after {candidate.seconds:.2g} s{chosen}"))
    if start.steps_miss:
        facts.append(Fact("steps", start.steps_miss, REMEDY))
    if start.chosen.finite < 1:
        facts.append(Fact("start", "no candidate is finite on all of X₀", "choose a smaller X₀, or a shorter horizon"))
    elif start.chosen.name == CALM:
        facts.append(Fact("start", "nothing known is better than no control", "expect a longer training"))
    return facts


def _task(problem: Problem) -> Fact:
    horizon, system, controls = problem.horizon, problem.system, problem.controls
    limits = ""
    if controls.limited:
        sides = None if controls.limits is None else [_listed(side.expand(system.m)) for side in controls.limits]
        limits = f" in {type(controls).__name__}" if sides is None else f" between {sides[0]} and {sides[1]}"
    return Fact(
        "task",
        f"{system.title}: {_counted(system.n, 'state')}, {_counted(system.m, 'control')}{limits}; "
        f"T = {horizon.duration:g} s in {_counted(horizon.steps, 'step')}",
    )


def _goal(problem: Problem) -> Fact:
    """Whether the goal is an equilibrium, or which control makes it one."""
    goal, system = problem.goal, problem.system
    f, rest = system.f(goal), system.dynamics(goal, problem.rest)
    where = f"{_listed(goal)}, " if goal.any() else ""
    if not bool(problem.controls.contains(problem.rest)):
        return Fact("goal", f"{where}u = {_listed(problem.rest)} is beyond its limits", "the cost has no rest there")
    if float(rest.abs().max()) <= 1e-9 * max(1.0, float(f.abs().max())):
        control = f"at u = {_listed(problem.rest)}" if problem.rest.any() else "without control"
        return Fact("goal", f"{where}an equilibrium {control}")
    u, left = system.holding_control(goal)
    if float(left.abs().max()) <= 1e-9 * float(f.abs().max()):
        remedy = "no target_control" if problem.cost.rest is not None else f"target: {goal.tolist()}"
        return Fact(
            "goal",
            f"{where}held by u = {_listed(u)}, which the cost charges",
            f"{remedy} has the cost count u from there, so that staying costs nothing",
        )
    return Fact(
        "goal", f"{where}no equilibrium: f(x*) = {_listed(f)}, and no control holds it", "the cost has no rest there"
    )


def _linearisation(problem: Problem) -> list[Fact]:
    """The eigenvalues of ẋ = Ax + Bu around the goal, and whether u reaches them."""
    system, goal, dt = problem.system, problem.goal, problem.horizon.dt
    A = torch.autograd.functional.jacobian(system.f, goal)
    assert isinstance(A, Tensor)
    moving = [i for i in range(system.n) if i not in system.constants]
    A, B = A[moving][:, moving], system.g(goal).detach()[moving]
    values = torch.linalg.eigvals(A)
    listed = ", ".join(_complex(value) for value in sorted(values.tolist(), key=lambda v: (-v.real, abs(v.imag))))
    unreached = [value for value in values if _rank(A, B, value) < len(A)]
    facts = [Fact("modes at the goal", f"{listed} 1/s")]
    if not unreached:
        facts.append(Fact("controllable", "yes, linearised at the goal"))
    else:
        modes = ", ".join(_complex(complex(value)) for value in unreached)
        grows = any(value.real > 1e-9 for value in unreached)
        facts.append(Fact(
            "controllable", f"not linearised at the goal: u does not reach {modes}",
            "what grows there cannot be held near the goal" if grows else "",
        ))  # fmt: skip
    method, z = problem.horizon.method, dt * values
    order = len(TABLEAUX[method].b)  # of each of these methods, as of its stability polynomial
    growth = sum((z**k / math.factorial(k) for k in range(1, order + 1)), start=torch.ones_like(z)).abs()
    if bool(((growth > 1 + 1e-9) & (values.real < -1e-9)).any()):
        by = "Euler" if method == "euler" else method
        facts.append(Fact("Δt", f"{dt:g} s makes a decaying mode grow under {by} steps", REMEDY))
    return facts


def stiffness(problem: Problem, rollout: Rollout | None = None) -> Fact:
    """Δt λ_max(R⁻¹gᵀHg)/2 at the goal, H from the Riccati solution: the gain of the HJB law over one step."""
    g, R = problem.system.g(problem.goal), problem.cost.R(problem.goal)
    weighted = torch.linalg.solve(R, g.mT @ riccati(problem).hessian @ g)
    gain = problem.horizon.dt / 2 * float(torch.linalg.eigvals(weighted).real.max())
    found = f"Δt λ(R⁻¹gᵀV_xx g)/2 = {gain:.3g}"
    if gain <= STABLE:
        return Fact("stiffness", f"{found}: every control law is stable at this Δt")
    found = f"{found} > {STABLE:g}: rollout.policy=hjb is unstable at this Δt"
    if rollout is not None and rollout.closed_loop.policy.held:
        return Fact("stiffness", f"{found}; the law that this config has is made to be held for Δt, and is stable")
    return Fact("stiffness", found, f"rollout.policy=sampled, or horizon.dt ≤ {problem.horizon.dt * STABLE / gain:.2g}")


def _rank(A: Tensor, B: Tensor, value: Tensor) -> int:
    """The rank of (A − λI, B): n where u reaches the mode (Popov, Belevitch, Hautus)."""
    shifted = A.to(value.dtype) - value * torch.eye(len(A), dtype=value.dtype)
    return int(torch.linalg.matrix_rank(torch.cat([shifted, B.to(value.dtype)], 1), rtol=1e-9))


def _counted(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def _listed(values: Tensor) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in values.tolist()) + ")"


def _complex(value: complex) -> str:
    return f"{value.real + 0.0:.3g}" if abs(value.imag) < 1e-9 else f"{value.real:.3g} {value.imag:+.3g}i"
