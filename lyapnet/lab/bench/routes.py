"""The routes to compare: ways to compute the gradient, each as a function to call."""

import importlib.util
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lyapnet.base.errors import CompilationError, UsageError
from lyapnet.base.types import PerState, State, Time
from lyapnet.graphs.compilation import has_compiler
from lyapnet.lab.bench.cases import Case, flat
from lyapnet.loop.rollout import ADAPTIVE_METHODS, Rollout
from lyapnet.value.calculus import ValueFunction

FLOOR, BASELINE, REFERENCE, EXACT = "rollout", "adjoint-autograd", "backprop", "discrete"
GRADIENT_OF = {FLOOR: EXACT, "adjoint": "adjoint", BASELINE: "adjoint", REFERENCE: REFERENCE, EXACT: EXACT}
COMPILED_ROUTES = (FLOOR, EXACT)
JAX_ROUTES = {"jax": False, "jax-checkpoint": True, "jax-rollout": False}  # whether the steps are recomputed
ROUTES = (*GRADIENT_OF, *JAX_ROUTES)


class Entry(NamedTuple):
    """A route, ready to run."""

    route: str
    compiled: bool
    run: Callable[[], Any]
    flat: Callable[[Any], Tensor] | None  # result of run ↦ its gradient, one float64 vector; None: no gradient
    compile_seconds: float | None = None


class WithoutFormula(ValueFunction):
    """V without its formula for V_x, so that autograd computes V_x."""

    def __init__(self, V: ValueFunction):
        super().__init__()
        self.V = V

    def forward(self, t: Time, x: State) -> PerState:
        return self.V(t, x)


def routes_for(case: Case, asked: Sequence[str] = ()) -> list[str]:
    """The given routes; without any, all that this task and this machine support.

    Raises:
        UsageError: a route that is unknown, or that cannot be taken here.
    """
    for route in asked:
        if route not in ROUTES:
            raise UsageError(f"Expected routes among {', '.join(ROUTES)}, got {route!r}; choose some of them.")
        if obstacle := _obstacle(case, route):
            raise UsageError(f"Expected a route that {case.name} can take here, got {route}: {obstacle}")
    return [route for route in ROUTES if (route in asked if asked else _obstacle(case, route) is None)]


def entries(case: Case, x0: State, routes: Sequence[str], say: Callable[[str], Any]) -> Iterator[Entry]:
    """Each route as written, and then compiled if possible.

    Args:
        say: called with the reason if it is not.
    """
    adaptive = case.config.rollout.method in ADAPTIVE_METHODS
    gradient_of = {**GRADIENT_OF, FLOOR: REFERENCE} if adaptive else GRADIENT_OF
    plain = {gradient: case.rollout(gradient) for gradient in {gradient_of[r] for r in routes if r in gradient_of}}
    for route in routes:
        if route in JAX_ROUTES:
            yield _jax_entry(case, x0, route)
        elif route == BASELINE:
            yield _entry(case, x0, route, case.rollout(gradient_of[route], WithoutFormula(case.V)))
        else:
            yield _entry(case, x0, route, plain[gradient_of[route]])
    names = [route for route in routes if route in COMPILED_ROUTES]
    if names and not adaptive and case.config.rollout.compile != "off" and has_compiler():
        rollout = case.rollout(EXACT)
        assert rollout.discrete is not None
        try:
            _, seconds = timed(partial(rollout.discrete.compile, x0))
        except CompilationError as error:
            say(f"{error}; the compiled rows are left out.")
            return
        yield from (_entry(case, x0, route, rollout, seconds) for route in names)


def timed(run: Callable[[], Any]) -> tuple[Any, float]:
    """(result, seconds) of a call."""
    started = time.perf_counter()
    result = run()
    return result, time.perf_counter() - started


def _entry(case: Case, x0: State, route: str, rollout: Rollout, compile_seconds: float | None = None) -> Entry:
    compiled = compile_seconds is not None
    if route != FLOOR:
        return Entry(route, compiled, partial(case.gradient, rollout, x0), flat, compile_seconds)
    if rollout.discrete is not None:  # traced, as under the gradient of discrete, whose floor it is
        rollout.discrete.routines(x0)
    return Entry(route, compiled, partial(_without_gradient, rollout, x0), None, compile_seconds)


def _without_gradient(rollout: Rollout, x0: State) -> Any:
    with torch.no_grad():
        return rollout(x0)


def _jax_entry(case: Case, x0: State, route: str) -> Entry:
    from lyapnet.lab.bench.jax_twin import flat as flat_of_jax

    twin = _jax_twin(case, route)
    if "rollout" in route:
        run, seconds = timed(partial(twin.prepare_rollout, x0))
        return Entry(route, True, run, None, seconds)
    run, seconds = timed(partial(twin.prepare_gradient, x0))
    return Entry(route, True, run, lambda result: flat_of_jax(result[1]), seconds)


def _jax_twin(case: Case, route: str) -> Any:
    from lyapnet.lab.bench.jax_twin import JaxTwin  # only where JAX is installed

    return JaxTwin(case.problem, case.V, case.program, checkpoint=JAX_ROUTES[route])


def _obstacle(case: Case, route: str) -> str | None:
    """The reason why a route is not possible here; None if it is."""
    method, policy = case.config.rollout.method, case.config.rollout.policy
    if route == EXACT and method in ADAPTIVE_METHODS:
        return f"the steps of {method} depend on the state; change rollout.method."
    if route not in JAX_ROUTES:
        return None
    if importlib.util.find_spec("jax") is None:
        return "JAX is not installed."
    if (method, policy) != ("euler", "hjb"):
        return "the twin in JAX knows only rollout.method=euler and rollout.policy=hjb."
    try:
        _jax_twin(case, route)
    except UsageError as error:
        return str(error)
    return None
