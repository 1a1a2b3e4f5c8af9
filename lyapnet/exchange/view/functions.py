"""The functions of the page in JavaScript: V, u, one step of the closed loop, and facts about a state."""

import torch
from torch import Tensor

from lyapnet.base.errors import ExportError
from lyapnet.controller.controller import Controller
from lyapnet.graphs.javascript_functions import HELPERS, JavaScriptTables, javascript_function
from lyapnet.graphs.tracing import core_trace


def functions_of(controller: Controller) -> str:
    """The text of `look(t, x, u, V)`, `step(t, x, after, cost, u, V)` and `about(x, goal, end, worst)`.

    `look` computes u(t, x) and V(t, x); `step` also the state after one step of the closed loop and the cost of the
    step; `about` the goal (of each member of a family), φ(x) and max_j h_j(x), −∞ without constraints.

    Raises:
        ExportError: a function of the controller cannot be traced, or an operation has no rule.
    """
    problem, loop, one_step = controller.problem, controller.closed_loop, controller.step
    x = (controller.initial_states.center + controller.initial_states.upper) / 2
    t, dt = torch.zeros_like(x[0]), torch.full_like(x[0], problem.horizon.dt)

    def look(t: Tensor, x: Tensor) -> tuple[Tensor, ...]:
        output = loop.control(t, x[None])
        return problem.controls.applied(x[None], output.u)[0], output.value[0]

    def step(t: Tensor, x: Tensor) -> tuple[Tensor, ...]:
        after, _, cost, u, V = one_step(t, dt, x[None])
        assert V is not None
        return after[0], cost[0], problem.controls.applied(x[None], u)[0], V[0]

    def about(x: Tensor) -> tuple[Tensor, ...]:
        goal = x[None] - problem.cost.from_goal(x[None])
        none = torch.full_like(x[:1], -torch.inf)
        worst = none if problem.constraints is None else problem.constraints.worst(x[None])
        return goal[0], problem.cost.terminal(x[None])[0], worst[0]

    tables, texts = JavaScriptTables(), list[str]()
    for function, arguments, results in (
        (look, {"t": t, "x": x}, ["u", "V"]),
        (step, {"t": t, "x": x}, ["after", "cost", "u", "V"]),
        (about, {"x": x}, ["goal", "end", "worst"]),
    ):
        graph = core_trace(function, list(arguments.values()), "f, g, a cost, constraints and V", ExportError)
        texts.append(javascript_function(function.__name__, graph, arguments, results, tables))
    return "".join([HELPERS, *tables.text, *texts])
