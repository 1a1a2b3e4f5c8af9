"""u(t, x) and V(t, x) of one state as functions to be traced: limits, target, parameters and clock are inside."""

from collections.abc import Callable
from functools import cached_property
from typing import Any

import torch
from torch import Tensor
from torch.fx import GraphModule

from lyapnet.base.errors import ExportError
from lyapnet.controller.controller import Controller
from lyapnet.graphs.tracing import core_trace


class Law:
    """A controller's law, traced: functions of t (), x (n,) and, of a family, p (k,); t below 0 counts as 0.

    Args:
        controller: whose law it is.
        dtype: precision in which it will be computed; None: that of the controller.

    Raises:
        ExportError: the law after T is an error; or, where a trace is asked for, it cannot be made.
    """

    def __init__(self, controller: Controller, dtype: torch.dtype | None = None):
        self._continued = controller.law
        if self._continued.beyond == "error":
            raise ExportError(
                "Expected a law after T that another language can follow, got beyond=error; take hold, receding or "
                "riccati."
            )
        x0, constants = controller.initial_states, len(controller.system.constants)
        self._controls = controller.controls
        if dtype not in (None, x0.lower.dtype):
            self._controls = self._controls.rounded_for(dtype)
        example = (x0.center + x0.upper) / 2
        x, p = example.split([len(example) - constants, constants])
        self.arguments = {"t": torch.zeros_like(example[0]), "x": x, **({"p": p} if constants else {})}

    def given(self, t: Any, state: Any) -> list[Any]:
        """The arguments of t and a state (…, n + k), an array or a tensor."""
        n = len(self.arguments["x"])
        return [t, state[..., :n], state[..., n:]][: len(self.arguments)]

    @cached_property
    def control(self) -> GraphModule:
        """(u (m,),)"""
        return self._traced(lambda t, x: (self._applied(t, x),))

    @cached_property
    def value(self) -> GraphModule:
        """(V (),)"""
        return self._traced(lambda t, x: (self._continued.V.at_any_time(t, x)[0],))

    @cached_property
    def both(self) -> GraphModule:
        """(u, V)"""
        return self._traced(lambda t, x: (self._applied(t, x), self._continued.V.at_any_time(t, x)[0]))

    def control_beside(self, policy: Callable[[Tensor, Tensor], Tensor]) -> GraphModule:
        """(u, policy(t, x)), (m,) each, in one graph."""
        return self._traced(lambda t, x: (self._applied(t, x), policy(t, x)[0]))

    def _applied(self, t: Tensor, x: Tensor) -> Tensor:
        """u (m,) of a batch of one state."""
        return self._controls.applied(x, self._continued.at_any_time(t, x))[0]

    def _traced(self, function: Callable[[Tensor, Tensor], tuple[Tensor, ...]]) -> GraphModule:
        def of_one(t: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
            return function(t.clamp(min=0), torch.cat(state)[None])

        return core_trace(of_one, list(self.arguments.values()), "f, g, a cost and V", ExportError)
