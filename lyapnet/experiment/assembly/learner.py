"""Builds V, its closed loop and the program of a config."""

import copy
import inspect
from typing import Any

import torch

from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly.classes import DTYPES, check_parameters, class_of, float64_defaults, section
from lyapnet.experiment.assembly.entries import entry_per_state, index_of
from lyapnet.experiment.config import Config
from lyapnet.loop.programs import Program
from lyapnet.loop.rollout import Rollout
from lyapnet.task.cost import Cost, CostWrapper, RegulatorsTail
from lyapnet.task.family import FamilySystem, family_cost_of
from lyapnet.task.problem import Problem
from lyapnet.task.systems import ControlSystem
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.networks import (
    CentredNetwork,
    ExpansionNetwork,
    IgnoringStates,
    Members,
    Scaling,
    StationaryNetwork,
    TerminalAnchor,
    Timeless,
    WithPenalty,
)
from lyapnet.value.policy import POLICIES


def build_value_function(config: Config, problem: Problem, network: type[ValueFunction] | None = None) -> ValueFunction:
    """V(t, x) with random weights from the config's seed, in its precision, for the config's control law.

    Args:
        network: a class that replaces the one named in the config.

    Raises:
        UsageError: the network does not have an option, or refuses its value.
    """
    options, n = config.network, problem.system.n
    cls, kept = network or class_of(config.network, "network"), _kept_states(config, problem.system)
    name = options.name
    if problem.horizon.stationary and cls is ExpansionNetwork:  # the default network
        cls, name = StationaryNetwork, "stationary"
    _require_same_end(problem, cls, options.terminal)
    angles = [kept.index(angle) for angle in problem.system.angles if angle in kept]
    chosen: dict[str, Any] = {
        "hidden": options.hidden,
        "activation": options.activation,
        "epsilon": options.epsilon,
        "smooth": options.smooth,
        "embedded_angles": angles if options.embed_angles else None,
    }
    chosen = {key: value for key, value in chosen.items() if value is not None}
    accepted, domain = inspect.signature(cls).parameters, problem.domain
    if "constants" in accepted:
        chosen["constants"] = [kept.index(i) for i in problem.system.constants if i in kept]
    if "weights" in accepted and isinstance(problem.system, FamilySystem):
        chosen["weights"] = [kept.index(i) for i in problem.system.logarithms]
    if "members" in accepted and isinstance(problem.system, FamilySystem):
        chosen["members"] = _members(problem, kept)
    if "borders" in accepted and domain is not None:
        places = {problem.system.state_names[i]: place for place, i in enumerate(kept)}
        chosen["borders"] = [(places[each.state], each) for each in domain.borders if each.state in places]
    if "scaling" not in accepted:
        raise UsageError(
            f"Expected a network built as {options.name}(scaling, …), got none; add that argument to __init__."
        )
    for key in (key for key in chosen if key not in accepted):
        option = {"embedded_angles": "embed_angles"}.get(key, key)
        raise UsageError(f"Expected a network that takes {option}, got {name}; remove network.{option}.")
    with float64_defaults(), torch.random.fork_rng(devices=[]), section("network"):
        torch.manual_seed(config.seed)
        V = cls(scaling=_scaling(config, problem, kept), **chosen)
        goal = problem.goal.double().cpu()[kept]
        if isinstance(V, StationaryNetwork):
            V.goal.copy_(goal)
        elif goal.any() and not isinstance(V, ExpansionNetwork):  # it has its own centre
            V = CentredNetwork(V, goal)
        if options.terminal == "exact":
            V = TerminalAnchor(V, _terminal_cost(problem, kept), problem.horizon.duration)
        if problem.horizon.stationary and not isinstance(V, StationaryNetwork):
            V = Timeless(V)
        if len(kept) < n:
            V = IgnoringStates(V, kept, n)
        if options.penalty and problem.constraints is not None:
            V = WithPenalty(V, problem.constraints, problem.constraints.margin, problem.horizon.dt)
    V.made_for = POLICIES[config.rollout.policy]
    return V.to(DTYPES[config.training.precision])


def _members(problem: Problem, kept: list[int]) -> Members:
    """The goals and regulators of the members of a stationary family, in the states on which V depends.

    Raises:
        UsageError: V does not depend on a parameter, or on a state that costs something.
    """
    cost, system = problem.cost, problem.system
    while not isinstance(cost, RegulatorsTail):
        assert isinstance(cost, CostWrapper)
        cost = cost.cost
    n = cost.n
    needed = [i for i in range(system.n) if i >= n or bool(cost.root.coefficients[:, i].any())]
    if unseen := [system.state_names[i] for i in needed if i not in kept]:
        raise UsageError(
            f"Expected V to depend on the parameters of a stationary family and on states that cost something, got "
            f"{unseen[0]} in network.ignored_states; leave it out there."
        )
    targets, root = copy.deepcopy((family_cost_of(cost).targets, cost.root))
    return Members(targets.double(), problem.goal[:n].double(), root.double(), kept[: len(kept) - system.n + n])


def _require_same_end(problem: Problem, cls: type[ValueFunction], terminal: str) -> None:
    """Check that the network suits the horizon.

    Raises:
        UsageError: a stationary network for a finite horizon, or terminal=exact for an infinite one.
    """
    stationary = problem.horizon.stationary
    if issubclass(cls, StationaryNetwork) and not stationary:
        raise UsageError(
            "Expected horizon.stationary: true with the stationary network, got a horizon that ends; its V has no time."
        )
    if stationary and terminal == "exact":
        raise UsageError("Expected network.terminal=free with horizon.stationary, got exact; V has no final time.")


def build_rollout(config: Config, problem: Problem, V: ValueFunction) -> Rollout:
    """The closed loop of V with the config's control law, integrator and gradient.

    Raises:
        UsageError: compile is on for a gradient that cannot be compiled, or the law does not suit the problem.
    """
    options = config.rollout
    if options.compile == "on" and options.gradient != "discrete":
        raise UsageError(
            f"Expected rollout.gradient=discrete for rollout.compile=on, got {options.gradient}; only that route "
            "compiles: take it, or leave compile at auto."
        )
    with section("rollout"):
        return Rollout(
            problem, POLICIES[options.policy](problem, V), options.method, options.gradient, options.rtol, options.atol,
            options.costate_limit,
        )  # fmt: skip


def build_program(config: Config) -> Program:
    """The program of a config.

    Raises:
        UsageError: the program does not have an option, or values contradict each other.
    """
    options, cls = program_options(config), class_of(config.program, "program")
    for name in options.keys() - inspect.signature(cls).parameters.keys():
        raise UsageError(f"Expected no program.{name} with the {config.program.name} program, got one; remove it.")
    check_parameters(cls, config.program.name, config.program.parameters, "program")
    with section("program"):
        program = cls(**options, **config.program.parameters)
        program.check_terminal(exact=config.network.terminal == "exact")
        return program


def program_options(config: Config) -> dict[str, Any]:
    """The weights and further keys of the config's program, except `parameters`."""
    given = vars(config.program)
    return {key: value for key, value in given.items() if key not in ("name", "parameters") and value is not None}


def _kept_states(config: Config, system: ControlSystem) -> list[int]:
    """The indices of the states on which V depends."""
    ignored = {index_of(name, "network.ignored_states", system) for name in config.network.ignored_states}
    if len(ignored) == system.n:
        raise UsageError("Expected V to depend on a state, got all in network.ignored_states; leave some out.")
    return [i for i in range(system.n) if i not in ignored]


def _terminal_cost(problem: Problem, kept: list[int]) -> Cost:
    """φ as a function of the kept states; raises UsageError if it depends on others."""
    n = problem.system.n
    if not all(problem.cost.ignores_at_end(i, n) for i in range(n) if i not in kept):
        raise UsageError(
            "Expected cost.Q_T without the states in network.ignored_states for terminal=exact, got weights on them."
        )
    return problem.cost if len(kept) == n else problem.cost.restricted_to(kept, n)


def _scaling(config: Config, problem: Problem, kept: list[int]) -> Scaling:
    goal = problem.goal.double()
    extent = problem.initial_states.reach_from(problem.goal).double()
    given = entry_per_state("network.state_scale", config.network.state_scale, problem.system)
    scale = given or [v if v > 0 else 1.0 for v in extent.tolist()]
    value = config.network.value_scale
    if value is None:
        value = float(problem.cost.terminal((goal + torch.tensor(scale).to(goal)).to(problem.goal))) or 1.0
    return Scaling([scale[i] for i in kept], problem.horizon.duration, value)
