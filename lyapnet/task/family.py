"""Families of problems: the parameters in a range become constant states.

With z = (x, p) and ṗ = 0, V(t, x, p) is an ordinary V(t, z): training, optima, evaluation and certificates treat the
family as one problem with n + k states. The entry of p for a weight w of the cost is log₁₀ w: weights are drawn evenly
on a logarithmic scale, on which V is smooth over decades.
"""

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from lyapnet.base.contracts import differences, state_of
from lyapnet.base.errors import UsageError, one_line
from lyapnet.base.interpolation import Basis, combine
from lyapnet.base.shapes import Shape
from lyapnet.base.types import Control, ControlMatrix, PerState, State
from lyapnet.graphs.tracing import trace
from lyapnet.task.constraints import OfFirstStates
from lyapnet.task.cost import Cost, DiagonalWeights, with_matrices
from lyapnet.task.extended_system import ExtendedSystem
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box
from lyapnet.task.systems import ControlSystem, functions_of_state

GENERIC_CONTROL = 0.3  # each control at which dynamics that are not affine are compared
MEMBER_TOLERANCE = 1e-9  # largest relative difference of f and g between a member and a newly constructed system
ROUNDING = 1e-14  # coefficients of targets below this count as zero, relative to the largest state or control
LOGARITHM = "log10 "  # begins the names of states that are logarithms of weights
PREFIX = "target_"  # prefix of names of parameters that move the target instead of the dynamics


class FamilySystem(ExtendedSystem):
    """ẋ = f(x; p) + g(x; p)u and ṗ = 0, in the state z = (x, p).

    A parameter of the dynamics is an attribute of the system with the name of its constructor's argument, used in f and
    g. In a family it becomes a tensor (*batch,), one number for each state. Other parameters do not enter f and g.

    Args:
        system: f and g.
        names: names of the parameters, (k,).
        units: units of p.
        weights: the names among these that are weights of the cost; their entries of p are logarithms.
    """

    def __init__(
        self, system: ControlSystem, names: Sequence[str], units: Sequence[str], weights: Collection[str] = ()
    ):
        super().__init__(system, [f"{LOGARITHM}{name}" if name in weights else name for name in names], units)
        self.names, self.weights = tuple(names), frozenset(weights)
        moving = [name for name in names if name not in weights and not name.startswith(PREFIX)]
        self.parameters_in_f = {name: i for i, name in enumerate(names) if name in moving}
        own = range(system.n, system.n + len(names))
        self.constants = (*system.constants, *own)
        told = [i for i, name in zip(own, names, strict=True) if name not in self.parameters_in_f]
        self.settings = (*system.settings, *told)
        self.logarithms = tuple(system.n + i for i, name in enumerate(names) if name in weights)

    @property
    def title(self) -> str:
        return f"family of {self.system.title}"

    def joined(self, x: Tensor, parameters: Mapping[str, Any]) -> Tensor:
        """(x, p) from states, and parameters by name, each a scalar or (*batch,).

        Raises:
            ValueError: names or shapes do not match the family.
        """
        n = self.system.n
        if parameters.keys() != set(self.names):
            raise ValueError(f"Expected values for {', '.join(self.names)}, got {', '.join(parameters)}; give each.")
        if not x.ndim or x.shape[-1] != n:
            listed = ", ".join(self.system.state_names)
            raise ValueError(f"Expected x of shape (*batch, {n}), got {tuple(x.shape)}; the last axis holds {listed}.")
        entries = {name: _expand_parameter(x, name, parameters[name]) for name in self.names}
        for name in self.weights:
            if not bool((entries[name] > 0).all()):
                raise ValueError(f"Expected {name} > 0, got {parameters[name]!r}; a weight of the cost is positive.")
            entries[name] = entries[name].log10()
        return torch.cat([x, torch.stack([*entries.values()], -1)], -1)

    def values(self, p: Sequence[float]) -> dict[str, float]:
        """The parameters by name, weights as such, from the entries of p."""
        return {name: 10**each if name in self.weights else each for name, each in zip(self.names, p, strict=True)}

    def member(self, p: Float[Tensor, "*batch k"]) -> ControlSystem:
        """The system with parameters (k,), or with different ones for each of a batch of states."""
        return with_attributes(self.system, {name: p[..., i] for name, i in self.parameters_in_f.items()})

    def at(self, s: Tensor) -> ControlSystem:
        return self.member(s)

    def draw(self, x: np.ndarray, u: np.ndarray) -> Sequence[Shape]:
        n = self.system.n
        values = {name: float(x[n + i]) for name, i in self.parameters_in_f.items()}
        return with_attributes(self.system, values).draw(x[:n], u)


class Targets(nn.Module, ABC):
    """The targets of a family's members: p ↦ x*(p) − x*(p̄) and u*(p)."""

    @abstractmethod
    def shift(self, p: Tensor) -> State:
        """x*(p) − x*(p̄), (*batch, n), of parameters (*batch, k)."""

    @abstractmethod
    def pull_back(self, p: Tensor, v: State) -> Tensor:
        """The gradient of vᵀx*(p) in p, (*batch, k), for v (*batch, n)."""

    def rest(self, p: Tensor) -> Control | None:
        """u*(p), (*batch, m); None: the same for all members."""
        return None


class LinearTargets(Targets):
    """x*(p) − x*(p̄) = E(p − p̄), and one u* for all members.

    Args:
        slope: E, (n, k).
        center: p̄, (k,).
    """

    slope: Float[Tensor, "n k"]
    center: Float[Tensor, " k"]

    def __init__(self, slope: Tensor, center: Tensor):
        super().__init__()
        self.register_buffer("slope", slope, persistent=False)
        self.register_buffer("center", center, persistent=False)

    def shift(self, p: Tensor) -> State:
        return (p - self.center) @ self.slope.mT

    def pull_back(self, p: Tensor, v: State) -> Tensor:
        return v @ self.slope


class InterpolatedTargets(Targets):
    """x*(p) and u*(p) as polynomials, or other functions, through the targets of some members.

    Args:
        basis: functions of p.
        points: (x*, u*) at the nodes of the basis, (nodes, n + m).
        center: (x*, u*) at p̄, (n + m,).
        n: number of states.
        solved: indices of the states that were solved for.
    """

    coefficients: Float[Tensor, "nodes n_plus_m"]
    rest_at_center: Float[Tensor, " m"]

    def __init__(self, basis: Basis, points: Tensor, center: Tensor, n: int, solved: Sequence[int] = ()):
        super().__init__()
        self.basis, self.n, self.solved = basis, n, list(solved)
        away = basis.coefficients(points - center)
        away[away.abs() < ROUNDING * points.abs().amax(0)] = 0.0
        self.register_buffer("coefficients", away, persistent=False)
        self.register_buffer("rest_at_center", center[n:], persistent=False)

    def _from_center(self, p: Tensor) -> Tensor:
        """(x*, u*)(p) − (x*, u*)(p̄)."""
        return combine(self.basis(p), self.coefficients)

    def shift(self, p: Tensor) -> State:
        return self._from_center(p)[..., : self.n]

    def pull_back(self, p: Tensor, v: State) -> Tensor:
        return self.basis.gradient(p, v @ self.coefficients[:, : self.n].mT)

    def rest(self, p: Tensor) -> Control:
        return self.rest_at_center + self._from_center(p)[..., self.n :]


class FamilyCost(Cost):
    """The cost of each member: q and φ of x − (x*(p) − x*(p̄)), u counted from u*(p), and R(x) or R(x; p).

    With a reference, p = (τ,) is the time on it.

    Args:
        cost: q, R, φ and u* at p̄, functions of x.
        targets: x*(p) and u*(p).
        center: p̄ (k,).
        n: number of states x.
        R: z ↦ (*batch, m, m), if it depends on p otherwise than by weights; None: R of the cost.
        weights: the matrices of the cost as functions of its weights w; None: those of the cost.
        logarithms: entries of p that are log₁₀ w, in the order of the weights.
    """

    def __init__(
        self,
        cost: Cost,
        targets: Targets,
        center: Tensor,
        n: int,
        R: Callable[[State], ControlMatrix] | None = None,
        weights: DiagonalWeights | None = None,
        logarithms: Sequence[int] = (),
    ):
        super().__init__()
        self.cost, self.targets, self.n, self.R_of_member = cost, targets, n, R
        self.weights, self.logarithms = weights, list(logarithms)
        self.goal = torch.cat([center.new_zeros(n) if cost.goal is None else cost.goal, center])
        self.rest, self.nonquadratic = cost.rest, cost.nonquadratic
        if weights is None or "R" not in weights.matrices:
            self.R_constant, self.R_inverse = cost.R_constant, cost.R_inverse

    def member(self, p: Float[Tensor, "*batch k"]) -> Cost:
        """The cost at p̄ with the weights of parameters (k,), or with different ones for each of a batch of states."""
        if self.weights is None:
            return self.cost
        w = torch.stack([torch.exp(math.log(10) * p[..., i]) for i in self.logarithms], -1)
        return with_matrices(self.cost, self.weights(w))

    def _split(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """(x − (x*(p) − x*(p̄)), p)."""
        x, p = z[..., : self.n], z[..., self.n :]
        return x - self.targets.shift(p), p

    def from_goal(self, x: State) -> State:
        x, p = self._split(x)
        return torch.cat([self.cost.from_goal(x), torch.zeros_like(p)], -1)

    def target(self, p: Tensor) -> State:
        """x*(p), (*batch, n)."""
        assert self.goal is not None
        return self.goal[: self.n].to(p) + self.targets.shift(p)

    def rest_at(self, x: State) -> Tensor | None:
        own = self.targets.rest(x[..., self.n :])
        return self.cost.rest_at(x[..., : self.n]) if own is None else own

    def state(self, x: State) -> PerState:
        x, p = self._split(x)
        return self.member(p).state(x)

    def terminal(self, x: State) -> PerState:
        x, p = self._split(x)
        return self.member(p).terminal(x)

    def R(self, x: State) -> ControlMatrix:
        if self.R_of_member is not None:
            return self.R_of_member(x)
        return self.member(x[..., self.n :]).R(x[..., : self.n])


def family_cost_of(cost: Any) -> FamilyCost:
    """The FamilyCost inside a cost."""
    while not isinstance(cost, FamilyCost):
        cost = cost.cost
    return cost


def with_constant_states(problem: Problem, system: ControlSystem, initial_states: Box) -> Problem:
    """A problem in z = (x, p), with constants p on which only the system depends.

    Args:
        problem: the problem in x.
        system: the system in z.
        initial_states: X₀ × P.
    """
    n, center = problem.system.n, initial_states.center
    unmoved = LinearTargets(center.new_zeros(n, len(center) - n), center[n:])
    cost = FamilyCost(problem.cost, unmoved, center[n:], n)
    h = None if problem.constraints is None else OfFirstStates(problem.constraints, n)
    return problem.replaced(system=system, cost=cost, initial_states=initial_states, constraints=h)


def _expand_parameter(x: State, name: str, value: Any) -> PerState:
    """Expand the value of a parameter to a batch of states."""
    batch = tuple(x.shape[:-1])
    try:
        return torch.as_tensor(value, dtype=x.dtype, device=x.device).expand(batch)
    except (TypeError, ValueError, RuntimeError) as error:
        got = tuple(value.shape) if hasattr(value, "shape") else repr(value)
        raise ValueError(f"Expected {name} scalar or of shape {batch}, got {got}; give a number per state.") from error


def with_attributes(system: ControlSystem, values: Mapping[str, Any]) -> ControlSystem:
    """A shallow copy of a system with the attributes of some parameters replaced."""
    member = copy.copy(system) if values else system
    for name, value in values.items():
        setattr(member, system.attribute_of(name), value)
    return member


def parameter_of(system: ControlSystem, name: str, otherwise: Any = None) -> Any:
    """The value of a system's parameter, if an attribute holds it."""
    return getattr(system, system.attribute_of(name), otherwise)


def check_members(
    family: FamilySystem,
    build: Callable[[Mapping[str, float]], ControlSystem],
    z: State,
    called: str = "parameters of a family",
) -> None:
    """Compare f and g of a family at some states (b, n + k) with systems that are constructed with the parameters.

    Args:
        build: values of the parameters in f ↦ system.
        called: name of the parameters in messages.

    Raises:
        UsageError: f and g do not use a parameter, use values derived from it, or do not accept it as a tensor.
    """
    names, cls = list(family.parameters_in_f), type(family.system).__name__
    if unused := [name for name in names if not isinstance(parameter_of(family.system, name), int | float)]:
        known = [name for name, value in vars(family.system).items() if type(value) in (int, float)]
        raise UsageError(
            f"Expected {called} among the numbers that {cls} keeps ({', '.join(known) or 'none'}), got "
            f"{unused[0]}; write self.{unused[0]} = {unused[0]} in its __init__, and read it in f and g."
        )
    try:
        functions = functions_of_state(family, z.new_full((family.m,), GENERIC_CONTROL))
        values = {name: function(z) for name, function in functions.items()}
    except Exception as error:  # f and g may be the user's
        raise UsageError(
            f"Expected {cls}.f and g that take {', '.join(names)} as a tensor, one number for each state, got "
            f"{one_line(error)[:160]}; read states as x[..., i], and write c + torch.zeros_like(x[..., 0]) for "
            "torch.full_like(x[..., 0], c)."
        ) from error
    if unused := _unused_parameters(family, z):
        raise UsageError(
            f"Expected {cls}.f or g to read {unused[0]}, got the same for each; read self.{unused[0]}, or leave it out."
        )
    for i, (x, p) in enumerate(zip(*family.split(z), strict=True)):
        member = build(_values(family, p)).to(z)
        for name, function in functions_of_state(member, z.new_full((family.m,), GENERIC_CONTROL)).items():
            own, expected, symbol = values[name], function(x), name.partition("(")[0]
            got = own[i][: len(x)] if own.ndim > 1 and len(own) == len(z) else own
            if got.shape != expected.shape or not torch.allclose(got, expected, MEMBER_TOLERANCE, MEMBER_TOLERANCE):
                raise UsageError(
                    f"Expected {cls}.{symbol} to read {', '.join(names)} as self.{names[0]} and so on, a number for "
                    f"each state x[..., i], got another {symbol} than that of {cls} built with {p.tolist()}; what "
                    "__init__ derives from them has to be derived in f and g, and a system that is passed has the "
                    "other parameters of the config."
                )
    _require_same_operations(family, build, z)


def _values(family: FamilySystem, p: Tensor) -> dict[str, float]:
    """The parameters in f at some p (k,)."""
    return {name: float(p[i]) for name, i in family.parameters_in_f.items()}


def _require_same_operations(
    family: FamilySystem, build: Callable[[Mapping[str, float]], ControlSystem], z: State
) -> None:
    """Require that members equal newly constructed systems with the same parameters, at all states.

    Two objects with equal attributes are the same functions. If the constructor derives other attributes from the
    parameters and f or g use them, the traces of member and new system differ in an operation or number.
    """
    low, high = family.split(torch.stack([z.amin(0), z.amax(0)]))[1]
    share = torch.rand(RANDOM_MEMBERS, len(low), generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(z)
    compared = _ComparisonRecorder()
    build({name: compared.number(value) for name, value in _values(family, (low + high) / 2).items()})
    before, traced = state_of({"": family.system}), 0
    for p in [low, high, *compared.beside(low, high), *(low + (high - low) * share)]:
        values = _values(family, p)
        built, member = build(values).to(z), with_attributes(family.system, values).to(z)
        derived = differences(state_of({"self": member}), state_of({"self": built}))
        if derived and traced < MAX_TRACES:
            traced += 1
            if _traced_operations(member, values, z) != _traced_operations(built, values, z):
                raise UsageError(
                    f"Expected {type(built).__name__}.f and g to read no more of {', '.join(values)} than self."
                    f"{next(iter(values))} and so on, got others than those of {type(built).__name__} built with "
                    f"{p.tolist()}, of which __init__ derives {derived[0]}; derive it in f and g."
                )
    if changed := differences(before, state_of({"": family.system})):
        raise UsageError(
            f"Expected {type(family.system).__name__}.__init__ to change nothing but its object, got {changed[0]}, "
            "which is another one after it; write self.NAME = … for each number."
        )


RANDOM_MEMBERS = 32  # random members that are checked, besides those at the ends of ranges and at comparisons
MAX_TRACES = 4  # largest number of members whose traces are compared


class _ComparisonRecorder(list[float]):
    """The numbers with which a constructor compares its arguments, where its behaviour may change."""

    def number(self, value: float) -> float:
        """The value as a float that records the numbers it is compared with."""
        met = self

        class RecordingFloat(float):
            """A float that records the numbers it is compared with."""

        for sign in ("__lt__", "__le__", "__gt__", "__ge__", "__eq__", "__ne__"):

            def compare(one: float, other: Any, sign: str = sign) -> Any:
                if isinstance(other, int | float):
                    met.append(float(other))
                return getattr(float(one), sign)(other)

            setattr(RecordingFloat, sign, compare)
        RecordingFloat.__hash__ = float.__hash__
        return RecordingFloat(value)

    def beside(self, low: Tensor, high: Tensor) -> list[Tensor]:
        """Parameters in a box with one component at a recorded number or close to it on either side."""
        found = list[Tensor]()
        for axis, (least, greatest) in enumerate(zip(low.tolist(), high.tolist(), strict=True)):
            for value in {met + step * (greatest - least) for met in self for step in (-1e-3, 0.0, 1e-3)}:
                if least <= value <= greatest:
                    found.append((low + high) / 2)
                    found[-1][axis] = value
        return found


def _traced_operations(system: ControlSystem, values: Mapping[str, float], z: State) -> Any:
    """The traced operators and constants of a system's functions, with parameters as numbers and as tensors.

    None if they cannot be traced; certificates are then impossible too.
    """
    like = z[0, : system.n]

    def asked(x: Tensor, u: Tensor, *p: Tensor) -> tuple[Tensor, ...]:
        here = with_attributes(system, dict(zip(values, p[0].unbind(-1), strict=True))) if p else system
        weight = getattr(here, "inverse_mass", None)
        parts = [] if not here.affine else [here.f(x), here.g(x)]
        return *parts, here.dynamics(x, u), *([] if weight is None else [weight(x)])

    try:
        p = torch.tensor([*values.values()]).to(z)
        graphs = [trace(asked, [like, like.new_zeros(system.m), *more]) for more in ([], [p])]
    except Exception:  # f and g may be the user's
        return None
    return [(str(graph.graph), state_of({"": dict(graph.named_buffers())})) for graph in graphs]


def _unused_parameters(family: FamilySystem, z: State) -> list[str]:
    """The parameters on which neither f nor g depends."""
    x, p = family.split(z)
    with torch.enable_grad():
        read = {name: p[:, k].clone().requires_grad_() for name, k in family.parameters_in_f.items()}
        member = with_attributes(family.system, read)
        functions = functions_of_state(member, z.new_full((family.m,), GENERIC_CONTROL))
        total = 0 * x.new_zeros((), requires_grad=True) + sum(function(x).sum() for function in functions.values())
        found = torch.autograd.grad(total, [*read.values()], allow_unused=True)
    return [name for name, gradient in zip(read, found, strict=True) if gradient is None]
