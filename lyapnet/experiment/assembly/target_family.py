"""The targets of a family's members: x*(p) and u*(p), with states that are not given solved for."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from lyapnet.base.contracts import copied
from lyapnet.base.errors import UsageError
from lyapnet.base.interpolation import ChebyshevProducts, fewest_products
from lyapnet.experiment.assembly.target import (
    CONTROL_ADVICE,
    log_once,
    named_entries,
    not_held_error,
    state_limits,
    trim,
    with_written_target,
)
from lyapnet.experiment.config import Config
from lyapnet.task.cost import Cost, TargetCost
from lyapnet.task.family import FamilySystem, InterpolatedTargets, LinearTargets, Targets, family_cost_of
from lyapnet.task.operating_points import HELD, OperatingPoint, OperatingPoints
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box, ControlSet

TEST_MEMBERS = 8  # number of random members whose targets are checked, besides those at the ends of the ranges
MOST_MEMBERS = 400  # largest number of members for interpolation of targets
CHOOSE_ANOTHER = f"choose another, or {CONTROL_ADVICE}"
MAX_RATE = 1e-8  # largest rate at an interpolated target, in units of the rates on X₀


def cost_and_targets(
    config: Config, cost: Cost, family: FamilySystem, controls: ControlSet, box: Box, moved: Mapping[int, int]
) -> tuple[Cost, Targets]:
    """The cost about the target of the member in the middle, and the targets of all members.

    Args:
        box: X₀ × P.
        moved: index of a state ↦ index of the parameter that is its target.

    Raises:
        UsageError: no admissible control holds the target of a member, or no polynomials fit the targets.
    """
    n = family.system.n
    ranges = Box(box.lower[n:], box.upper[n:])
    slope = torch.zeros(n, ranges.dimension, dtype=torch.float64)
    for i, k in moved.items():
        slope[i, k] = 1
    linear = LinearTargets(slope, ranges.center)
    if not moved and config.target is None and config.target_control is None:
        return cost, linear
    members = TargetsOfMembers(config, family, controls, box, moved)
    if config.target_control is not None:
        if config.target is None:
            members.put_others_at_zero()
        return with_written_target(members.config_of(ranges.center), cost, family.system, controls), linear
    tested = torch.cat([ranges.corners(), ranges.sample(TEST_MEMBERS, torch.Generator().manual_seed(0))])
    middle = members.solve_middle(tested)
    cost = TargetCost(cost, middle.x, middle.u)
    if not members.solved:
        rests = torch.stack([members.point(p).u for p in tested])
        if bool(((rests - middle.u).abs() <= HELD * middle.u.abs().max().clamp_min(1)).all()):
            return cost, linear
    return cost, members.interpolate(ranges, tested)


def target_of_member(
    config: Config, problem: Problem, moved: Mapping[int, int], p: Sequence[float]
) -> list[float] | None:
    """x*(p) of a member in full, for its own config; None if there is no target.

    Args:
        problem: of the family.
    """
    if config.target is None and not moved:
        return None
    problem = copied(problem)  # in float64
    family, cost = problem.system, family_cost_of(problem.cost)
    assert isinstance(family, FamilySystem)
    members = TargetsOfMembers(config, family, problem.controls, problem.initial_states, moved)
    member = torch.tensor([*p], dtype=torch.float64)
    given = {**dict.fromkeys(range(family.system.n), 0.0), **members.given(member)}
    if not (isinstance(cost.targets, InterpolatedTargets) and cost.targets.solved):
        return [*given.values()]
    members.solved = cost.targets.solved
    return members.beside(cost.target(member), member).x.tolist()


class TargetsOfMembers:
    """Operating points of a family's members, p ↦ (x*, u*).

    Args:
        box: X₀ × P.
        moved: index of a state ↦ index of the parameter that is its target.
    """

    def __init__(self, config: Config, family: FamilySystem, controls: ControlSet, box: Box, moved: Mapping[int, int]):
        n = family.system.n
        self.config, self.family, self.controls, self.moved = config, family, controls, moved
        self.initial_states, self.center = Box(box.lower[:n], box.upper[:n]), box.center[n:]
        self.unit = torch.where(box.widths[n:] > 0, box.widths[n:], 1.0)
        self.written = {} if config.target is None else named_entries(config.target, family.system)
        self.solved = [i for i in range(n) if i not in self.written and i not in moved]
        self._known = list[tuple[Tensor, OperatingPoint]]()

    def given(self, p: Tensor) -> dict[int, float]:
        """Index ↦ value of the states of a member's target that are not solved for."""
        return {**self.written, **{i: float(p[k]) for i, k in self.moved.items()}}

    def config_of(self, p: Tensor) -> Config:
        """The config with the target of a member."""
        names = self.family.system.state_names
        return replace(self.config, target={names[i]: value for i, value in self.given(p).items()})

    def put_others_at_zero(self) -> None:
        """Give 0 to all states of the target that are not given."""
        self.written, self.solved = dict.fromkeys(range(self.family.system.n), 0.0), []

    def solve_middle(self, tested: Tensor) -> OperatingPoint:
        """The operating point of the member in the middle; without a target in the config, other states are 0.

        They are solved for instead if no control holds that state.

        Raises:
            UsageError: none of its controls holds it.
        """
        n, center = self.family.system.n, self.center
        if self.solved and self.config.target is None:
            zeros = dict.fromkeys(range(n), 0.0)
            if all(self._search(p).held_by(_state({**zeros, **self.given(p)})).held for p in (center, *tested)):
                self.put_others_at_zero()
        found = trim(self.config_of(center), self.family.member(center), self.controls, self.initial_states)
        if self.solved:
            log_once(f"in the middle of the family: {found.note}")
        elif found.note:
            raise not_held_error(self.family.member(center), _state(self.given(center)), CHOOSE_ANOTHER)
        self._known = [(center, found.point)]
        return found.point

    def point(self, p: Tensor) -> OperatingPoint:
        """The operating point of a member, continued from those of neighbouring members; see `beside`."""
        nearest_first = sorted(self._known, key=lambda known: float(((known[0] - p) / self.unit).norm()))
        if nearest_first and torch.equal(nearest_first[0][0], p):
            return nearest_first[0][1]
        found = self.beside(nearest_first[0][1].x, p)
        self._known.append((p, found))
        return found

    def beside(self, x: Tensor, p: Tensor) -> OperatingPoint:
        """The operating point of a member that is nearest to a state, or has all given states.

        Raises:
            UsageError: no admissible control holds it.
        """
        search, x = self._search(p), x.clone()
        for i, value in self.given(p).items():
            x[i] = value
        found = search.nearest(x, self.solved) if self.solved else search.held_by(x)
        values = ", ".join(f"{name} = {value:.6g}" for name, value in self.family.values(p.tolist()).items())
        if found is None or not found.held:
            raise not_held_error(search.system, x, f"it is that of {values}: narrow the family, or {CONTROL_ADVICE}")
        if not found.admitted:
            raise UsageError(
                f"Expected controls within limits that hold the target of {values}, got {found.u.tolist()}; widen "
                "controls, or narrow the family."
            )
        return found

    def interpolate(self, ranges: Box, tested: Tensor) -> InterpolatedTargets:
        """Polynomials through the operating points of members.

        Raises:
            UsageError: they would need too many members.
        """
        basis = fewest_products(ranges.lower, ranges.upper, self._is_accurate, tested, MOST_MEMBERS)
        if basis is not None:
            return self._through(basis)
        raise UsageError(
            f"Expected targets that are smooth in {', '.join(self.family.names)}, got some that polynomials through "
            f"{MOST_MEMBERS} members miss; narrow the family, or write target_control."
        )

    def _through(self, basis: ChebyshevProducts) -> InterpolatedTargets:
        nodes = basis.nodes()
        for p in sorted(nodes, key=lambda p: float(((p - self.center) / self.unit).norm())):
            self.point(p)  # in the order of neighbours, so that all are of one branch
        points = torch.stack([torch.cat([self.point(p).x, self.point(p).u]) for p in nodes])
        middle = self.point(self.center)
        return InterpolatedTargets(basis, points, torch.cat([middle.x, middle.u]), len(middle.x), self.solved)

    def _is_accurate(self, basis: ChebyshevProducts, tested: Tensor) -> bool:
        """Whether the interpolated targets have the given states, and the interpolated controls hold them."""
        targets, middle = self._through(basis), self.point(self.center)
        for p in tested:
            search, x = self._search(p), middle.x + targets.shift(p)
            missed = [abs(float(x[i]) - value) > MAX_RATE * (1 + abs(value)) for i, value in self.given(p).items()]
            u = targets.rest(p)
            f, g = search.system.affine_model(x, u)
            rate = (f + g @ u) / search.rate
            if any(missed) or not bool((rate.abs() <= MAX_RATE).all()):
                return False
        return True

    def _search(self, p: Tensor) -> OperatingPoints:
        limits = state_limits(self.config.constraints, self.family.system)
        return OperatingPoints(self.family.member(p), self.controls, self.initial_states, limits)


def _state(entries: Mapping[int, float]) -> Tensor:
    return torch.tensor([entries[i] for i in sorted(entries)], dtype=torch.float64)
