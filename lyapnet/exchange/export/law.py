"""u(t, x) and V(t, x) of one state as traced functions, with limits, target, parameters and the law after T."""

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
    """A controller's law as traces of functions of t (), x (n,) and, for a family, p (k,); t below 0 counts as 0.

    Args:
        controller: the controller.
        dtype: the precision in which the law will be computed; None: that of the controller.

    Raises:
        ExportError: there is no law after T (beyond=error). The properties raise it if the law cannot be traced.
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
        """The arguments [t, x] or [t, x, p] for t and a state (…, n + k), as arrays or tensors."""
        n = len(self.arguments["x"])
        return [t, state[..., :n], state[..., n:]][: len(self.arguments)]

    @cached_property
    def control(self) -> GraphModule:
        """The trace of (u,), (m,)."""
        return self._traced(lambda t, x: (self._applied(t, x),))

    @cached_property
    def value(self) -> GraphModule:
        """The trace of (V,), ()."""
        return self._traced(lambda t, x: (self._continued.V.at_any_time(t, x)[0],))

    @cached_property
    def both(self) -> GraphModule:
        """The trace of (u, V)."""
        return self._traced(lambda t, x: (self._applied(t, x), self._continued.V.at_any_time(t, x)[0]))

    def control_beside(self, policy: Callable[[Tensor, Tensor], Tensor]) -> GraphModule:
        """The trace of (u, policy(t, x)), (m,) each."""
        return self._traced(lambda t, x: (self._applied(t, x), policy(t, x)[0]))

    def _applied(self, t: Tensor, x: Tensor) -> Tensor:
        """u, (m,), for x of shape (1, n + k)."""
        return self._controls.applied(x, self._continued.at_any_time(t, x))[0]

    def _traced(self, function: Callable[[Tensor, Tensor], tuple[Tensor, ...]]) -> GraphModule:
        def of_one(t: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
            return function(t.clamp(min=0), torch.cat(state)[None])

        return core_trace(of_one, list(self.arguments.values()), "f, g, a cost and V", ExportError)
