"""Control sets that are images of a simpler set at each state: u = c(x) + H(x)v for all v of a box or a ball.

A task with such a set is solved for v, the shares, as a task with the simpler, constant set:

    f + gu = (f + gc) + (gH)v,   (u − u*)ᵀR(u − u*) = (v − v*)ᵀ HᵀRH (v − v*),   v*(x) = H(x)⁻¹(u* − c(x)).

Derivatives of dynamics and costs in x then include those of c and H, and minimisers are those over the simpler set.
"""

import copy
from abc import abstractmethod

from torch import Tensor

from lyapnet.base.errors import UsageError
from lyapnet.base.types import Control, ControlMatrix, InputMatrix, State
from lyapnet.task.cost import Cost, CostWrapper
from lyapnet.task.extended_system import ExtendedSystem
from lyapnet.task.sets import ControlSet
from lyapnet.task.systems import ControlSystem


class MappedControls(ControlSet):
    """U(x) = {c(x) + H(x)v : v ∈ U₀}. A subclass also inherits from the class of U₀, the set of the shares v."""

    words: str = "a set of controls that depends on the state"

    @abstractmethod
    def moved(self, x: State, u: Control) -> Control:
        """c(x) + H(x)v, (*batch, m)."""

    @abstractmethod
    def stretched(self, x: State, rows: Tensor) -> Tensor:
        """MH(x) for a matrix M (*batch, k, m)."""

    def of(self, system: ControlSystem) -> "MappedControls":
        """This set for a system, with names of states replaced by their indices.

        Raises:
            UsageError: the set does not fit the system.
        """
        return self

    def check(self, x: State, m: int) -> None:
        """Check the set of m controls at states (b, n).

        Raises:
            UsageError: its functions break their contract.
        """


class MappedSystem(ExtendedSystem):
    """ẋ = f + g(c(x) + H(x)v), a system with shares v as controls.

    Args:
        system: f and g, or ẋ as a function of u.
        controls: c and H.
    """

    def __init__(self, system: ControlSystem, controls: MappedControls):
        super().__init__(system, [], [])
        self.controls = controls

    @property
    def title(self) -> str:
        return self.system.title

    def f(self, x: State) -> State:
        return self.system.dynamics(x, self.controls.moved(x, x.new_zeros(*x.shape[:-1], self.m)))

    def g(self, x: State) -> InputMatrix:
        return self.controls.stretched(x, self.system.g(x))

    def dynamics(self, x: State, u: Control) -> State:
        return self.system.dynamics(x, self.controls.moved(x, u))


class MappedCost(CostWrapper):
    """Another cost as a function of the shares: q(x) + (v − v*(x))ᵀ HᵀRH (v − v*(x)).

    Args:
        cost: q, R, u* and φ.
        controls: c and H.
        goal: the state (n,) whose v* is the control at rest.
        m: number of controls.

    Raises:
        UsageError: the cost has costs of controls beside uᵀRu, or methods of its own.
    """

    words: str

    def __init__(self, cost: Cost, controls: MappedControls, goal: State, m: int):
        super().__init__(cost)
        if cost.nonquadratic is not None or cost.has_methods_of_its_own:
            raise UsageError(
                f"Expected controls that cost uᵀRu alone with {controls.words}, got more in {type(cost).__name__}; "
                "leave out cost.control_costs and methods such as `running`, or take constant limits."
            )
        self.controls, self.m, self.words = controls, m, f"in {controls.words}"
        self.R_constant = self.R_inverse = None
        self.rest = self.rest_at(goal).detach()

    def R(self, x: State) -> ControlMatrix:
        once = self.controls.stretched(x, self.cost.R(x))
        return self.controls.stretched(x, once.mT)

    def rest_at(self, x: State) -> Tensor:
        rest, shape = self.cost.rest_at(x), (*x.shape[:-1], self.m)
        return self.controls.asked(x, x.new_zeros(shape) if rest is None else rest.expand(shape))


def mapped(system: ControlSystem, cost: Cost, controls: MappedControls, goal: State) -> tuple[ControlSystem, Cost]:
    """A system and a cost as functions of the shares; such a system or cost is returned unchanged.

    Args:
        goal: a typical state (n,), for costs without a goal.
    """
    if not isinstance(system, MappedSystem):
        system = MappedSystem(system, controls)
    inner = cost
    while isinstance(inner, CostWrapper) and not isinstance(inner, MappedCost):
        inner = inner.cost
    if not isinstance(inner, MappedCost):
        cost = MappedCost(cost, controls, goal if cost.goal is None else cost.goal.to(goal), system.m)
    return system, cost


def written_system(system: ControlSystem) -> ControlSystem:
    """The system as a function of u; for a MappedSystem the one inside it."""
    return system.system if isinstance(system, MappedSystem) else system


def written_cost(cost: Cost) -> Cost:
    """The cost as a function of u; for a MappedCost the one inside it."""
    if isinstance(cost, MappedCost):
        return cost.cost
    if not isinstance(cost, CostWrapper) or (inner := written_cost(cost.cost)) is cost.cost:
        return cost
    cost = copy.copy(cost)  # shares its tensors
    cost._modules = {**cost._modules, "cost": inner}
    cost._buffers = {**cost._buffers, **{name: getattr(inner, name) for name in ("rest", "R_constant", "R_inverse")}}
    return cost
