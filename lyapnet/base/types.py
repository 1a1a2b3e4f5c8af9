"""Shape aliases with the letters of the equations, checked by jaxtyping during tests.

| letter  | meaning                                                              |
|---------|----------------------------------------------------------------------|
| n, m    | dimensions of the state x and of the control u                       |
| N       | number of time steps of the horizon; t has N + 1 nodes               |
| *batch  | any leading dimensions, one entry per state; may be empty            |

A time broadcasts against its states: one scalar for all of them, or one time for each.
"""

from collections.abc import Callable

from jaxtyping import Float
from torch import Tensor

Time = Float[Tensor, "*#batch"]
State = Float[Tensor, "*batch n"]
Control = Float[Tensor, "*batch m"]
PerState = Float[Tensor, "*batch"]  # one number for each state: V, a running cost, an energy
Coordinates = Float[Tensor, "*batch d"]  # q or q̇ of a mechanical system, n = 2d
MassMatrix = Float[Tensor, "*batch d d"]
InputMatrix = Float[Tensor, "*batch n m"]
ControlMatrix = Float[Tensor, "*batch m m"]
Noise = Float[Tensor, "*batch n sources"]  # σ(x)
Matrix = Float[Tensor, "rows columns"]

Times = Float[Tensor, " nodes"]
StatePath = Float[Tensor, "nodes *batch n"]
ValuePath = Float[Tensor, "nodes *batch"]
ControlPath = Float[Tensor, "steps *batch m"]
StepPath = Float[Tensor, "steps *batch"]

# Boxes of points (t, x) with 1 + n axes, time first; and values of any shape on each box
Corner = Float[Tensor, " axes"]
Corners = Float[Tensor, "boxes axes"]
Points = Float[Tensor, "points axes"]
PerBox = Float[Tensor, " boxes"]
OnBoxes = Float[Tensor, "boxes *shape"]
Terms = Float[Tensor, "terms boxes *shape"]  # the coefficients of a polynomial on each box

# Linearised closed loops: nodes of a block of steps, and the stages of each step.
Scalar = Float[Tensor, ""]
StagePath = Float[Tensor, "nodes stages *batch n"]
StageControls = Float[Tensor, "nodes stages *batch m"]
StageValues = Float[Tensor, "nodes stages *batch"]
StageSlopes = Float[Tensor, "nodes stages *batch columns"]  # (ẋ, ℓ): n + 1 columns
StageJacobians = Float[Tensor, "nodes stages *batch n n"]
StageInputMatrices = Float[Tensor, "nodes stages *batch n m"]
Jacobians = Float[Tensor, "nodes *batch n n"]

Value = Callable[[Tensor, Tensor], Tensor]  # V: (t, x) ↦ one number for each state
