"""The controller, the result of training: V, its control law, and the closed loop."""

import inspect
import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple, overload

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from lyapnet.base.contracts import copied
from lyapnet.base.errors import CompilationError, UntraceableError, UsageError
from lyapnet.base.random_streams import NOISE, stream
from lyapnet.controller.html import controller_as_html
from lyapnet.controller.origin import Origin
from lyapnet.controller.output_feedback import OutputFeedback, like_given
from lyapnet.experiment.assembly import Parts, build_plants, build_problem, build_rollout, member, named, ranges_of
from lyapnet.experiment.assembly.outputs import estimator_parts, problem_of_estimator
from lyapnet.experiment.config import Config, OutputsConfig, SystemConfig, require_one_for_each
from lyapnet.experiment.schema import check_values
from lyapnet.loop.programs import Program, ValueProgram
from lyapnet.loop.random_plants import RandomPlants
from lyapnet.loop.rollout import ClosedLoop, Rollout, Trajectory
from lyapnet.loop.rollout.runge_kutta import Step
from lyapnet.task.cost import Cost
from lyapnet.task.family import FamilySystem
from lyapnet.task.horizon import TABLEAUX, Horizon
from lyapnet.task.mapped_controls import MappedControls, written_cost, written_system
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box, ControlSet
from lyapnet.task.systems import ControlSystem
from lyapnet.value.after_horizon import AfterHorizon, choose_law
from lyapnet.value.at_parameters import AtParameters
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.law_after_horizon import ContinuedPolicy, LaterPolicy, slack
from lyapnet.value.policy import HJBPolicy, ValuePolicy, gain_over_step, known_law

MAX_LAW_DIFFERENCE = 0.2  # relative difference of V's HJB and sampled law without a note; about 1 % of the cost


def parameters_of(system: ControlSystem, config: SystemConfig) -> dict[str, Any]:
    """The constructor's arguments of a config's system, including defaults; empty if they do not fit the system."""
    try:
        bound = inspect.signature(type(system)).bind(**config.parameters)
    except TypeError:  # the user passed another system
        return {}
    bound.apply_defaults()
    return dict(bound.arguments)


class ArrayTrajectory(NamedTuple):
    """A batch of closed-loop trajectories as NumPy arrays, with the fields of a Trajectory."""

    t: np.ndarray  # (N + 1,)
    x: np.ndarray  # (N + 1, *batch, n)
    u: np.ndarray  # (N, *batch, m)
    running_cost: np.ndarray  # (N + 1, *batch): ∫ℓ up to t_n
    terminal_cost: np.ndarray  # (*batch,): φ(x_N)
    value: np.ndarray  # (N + 1, *batch): V(t_n, x_n)

    def require_value(self) -> np.ndarray:
        """V along the trajectory."""
        return self.value

    @property
    def cost(self) -> Any:  # an array, or a NumPy scalar for a single state
        """J_N = running cost plus terminal cost, (*batch,)."""
        return self.running_cost[-1] + self.terminal_cost

    @property
    def step_cost(self) -> np.ndarray:
        """∫ℓ over each step, (N, *batch)."""
        return self.running_cost[1:] - self.running_cost[:-1]


class Controller:
    """V(t, x), u(t, x) and their closed loop.

    Methods return tensors (of the controller's dtype) for tensors, and NumPy arrays for arrays and lists.
    """

    problem: Problem
    program: Program
    V: ValueFunction
    origin: Origin | None
    _after_horizon: AfterHorizon | None

    def __init__(
        self,
        problem: Problem,
        V: ValueFunction,
        rollout: Rollout | None = None,
        program: Program | None = None,
        config: Config | None = None,
        beyond: str | None = None,
        parts: Parts | None = None,
        policy: type[ValuePolicy] | None = None,
        after_horizon: AfterHorizon | None = None,
        origin: Origin | None = None,
    ):
        """A controller from its parts.

        Without a rollout the closed loop uses steps of the horizon's method, as in training and evaluation; a rollout
        with an adaptive method has to be given.

        Args:
            problem: the problem of V.
            V: the value function; its weights are frozen.
            rollout: the closed loop of V; None: the closed loop of its law.
            program: the program that V was trained with, which certificates refer to; None: the value program.
            config: the config of the run that trained V, if there was one.
            beyond: the law after T: hold, receding, riccati or error, as in lyapnet.load; None: the first of riccati,
                receding and hold that keeps closed loops near the goal, chosen on first use.
            parts: the user's parts that replaced those of the config.
            policy: the control law of V, if there is no rollout; None: the law for which V was trained, or the HJB law
                if that is unknown, with a note if it matters.
            after_horizon: the result of an earlier choice of the law after T.
            origin: the checkpoint that V was loaded from; None: there is none.

        Raises:
            UsageError: V.made_for is no control law.
            ValueError: the rollout is of another V or problem, or both rollout and policy are given.
        """
        self.problem, self._config, self._beyond, self._parts = problem, config, beyond, parts or Parts()
        self.program = ValueProgram() if program is None else program
        self._warned = False  # whether a warning of parameters outside the family was logged
        self.V, self.origin = V.requires_grad_(False).eval(), origin
        if rollout is not None and policy is not None:
            raise ValueError("Expected a rollout or a policy, got both; the rollout has one: leave the other out.")
        gradient = "backprop" if problem.noise is None else "discrete"  # the only gradient that supports noise
        self._rollout = rollout or Rollout(problem, (policy or _law_of(problem, V))(problem, V), gradient=gradient)
        if self._rollout.problem is not problem or self._rollout.closed_loop.V is not V:
            raise ValueError("Expected the rollout of this V on this problem, got another one; build it from both.")
        law = self.closed_loop.policy
        assert isinstance(law, ValuePolicy)  # because it has a V
        self._after_horizon = after_horizon
        self._continued = ContinuedPolicy(problem, law, beyond, self.after_horizon, noted=after_horizon is not None)

    def __repr__(self) -> str:
        horizon, V, law = self.horizon, type(self.V).__name__, type(self.closed_loop.policy).__name__
        about = f"{type(self.system).__name__}, {V}, {law}, {horizon.steps} steps of {horizon.dt:g} s"
        return f"{type(self).__name__}({about})"

    def _repr_html_(self) -> str:
        """The display in notebooks: a table, and some closed loops."""
        return controller_as_html(self)

    @property
    def config(self) -> Config:
        """The config of the run that trained V.

        Raises:
            UsageError: there is none, because the controller was made from parts.
        """
        if self._config is None:
            raise UsageError("Expected a controller that a run left, got one made from parts; it has no config.")
        return self._config

    @property
    def parameters(self) -> dict[str, Any]:
        """The arguments of the system's constructor; empty if unknown."""
        return {} if self._config is None else parameters_of(self.system, self._config.system)

    @property
    def system(self) -> ControlSystem:
        """ẋ = f(x) + g(x)u."""
        return written_system(self.problem.system)

    @property
    def cost(self) -> Cost:
        """ℓ and φ."""
        return written_cost(self.problem.cost)

    @property
    def controls(self) -> ControlSet:
        """U."""
        return self.problem.controls

    @property
    def horizon(self) -> Horizon:
        """N (`steps`), Δt (`dt`) and T (`duration`)."""
        return self.problem.horizon

    @property
    def initial_states(self) -> Box:
        """X₀."""
        return self.problem.initial_states

    @property
    def method(self) -> str:
        """The integrator of the rollouts."""
        return self._rollout.method

    @property
    def closed_loop(self) -> ClosedLoop:
        """(t, (x, ∫ℓ)) ↦ its derivative under u(t, x), as a module."""
        return self._rollout.closed_loop

    @property
    def step(self) -> Step:
        """(t, Δt, x) ↦ (x', stages, ∫ℓ, u, V), one step of the rollouts; rk4 for an adaptive method."""
        return Step(self._rollout.stepped, TABLEAUX.get(self._rollout.solver_arguments["method"], TABLEAUX["rk4"]))

    @property
    def plants(self) -> RandomPlants | None:
        """The plants with the random parameters of its config's `randomise`; None if there are none."""
        return None if self._config is None else build_plants(self._config, self._rollout)

    @property
    def law(self) -> ContinuedPolicy:
        """u(t, x) for all t ≥ 0 as a module, with its V."""
        return self._continued

    def after_horizon(self) -> AfterHorizon:
        """The law after T that training chose, and how many closed loops it holds up to 5 T; chosen now if unknown.

        If `beyond` was given, the controller follows that law nevertheless.
        """
        if self._after_horizon is None:
            self._after_horizon = choose_law(
                self.problem, lambda law, x0, steps: self.continued(law).rollout(x0, steps).x
            )
        return self._after_horizon

    @overload
    def value(self, t: Tensor | float, x: Tensor, **parameters: Any) -> Tensor: ...
    @overload
    def value(self, t: ArrayLike, x: ArrayLike, **parameters: Any) -> np.ndarray: ...
    def value(self, t: Any, x: Any, **parameters: Any) -> Any:
        """V(t, x): t ≥ 0 scalar or (*batch,) in s, x (*batch, n); returns (*batch,).

        Args:
            parameters: parameters of a family by name, each a scalar or (*batch,); none if x is (x, p).

        Raises:
            ValueError: the shapes do not fit, or t < 0.
        """
        return self._evaluate(self.law.V, t, x, parameters)

    @overload
    def policy(self, t: Tensor | float, x: Tensor, **parameters: Any) -> Tensor: ...
    @overload
    def policy(self, t: ArrayLike, x: ArrayLike, **parameters: Any) -> np.ndarray: ...
    def policy(self, t: Any, x: Any, **parameters: Any) -> Any:
        """u(t, x): t ≥ 0 scalar or (*batch,) in s, x (*batch, n); returns (*batch, m).

        Args:
            parameters: parameters of a family by name, each a scalar or (*batch,), as in policy(t, x, pole_mass=0.2);
                none if x is (x, p).

        Raises:
            ValueError: the shapes do not fit, or t < 0.
        """
        return self._evaluate(lambda t, x: self.controls.applied(x, self.law(t, x)), t, x, parameters)

    def with_(self, **parameters: float) -> "Controller":
        """The controller of a family's member: its problem, and V(t, (x, p)) at fixed parameters.

        Raises:
            UsageError: this is no family; or a parameter is missing, unknown, or outside the range of training.
        """
        system = self.system
        if not isinstance(system, FamilySystem) or self._config is None:
            raise UsageError("Expected a controller of a family, got one of a single problem; add family to the YAML.")
        config, parts, p = member(self.config, self._parts, self.problem, parameters)
        problem = build_problem(config, parts).to(self.initial_states.lower.device)
        V = AtParameters(self.V, self.initial_states.lower.new_tensor(p))
        rollout = build_rollout(config, problem, V)
        known = self._after_horizon  # chosen for the family, used for its members
        return Controller(problem, V, rollout, self.program, config, self._beyond, parts, after_horizon=known)

    @property
    def measures_outputs(self) -> bool:
        """Whether the config of its run has outputs."""
        return self._config is not None and self._config.outputs.noise is not None

    def with_estimator(
        self,
        kind: str = "ekf",
        *,
        measure: Sequence[str] | None = None,
        noise: Sequence[float] | float | None = None,
        process_noise: Mapping[str, float] | None = None,
        input_disturbances: Mapping[str, float] | None = None,
        initial_deviation: Sequence[float] | float | None = None,
        delay: int | None = None,
    ) -> OutputFeedback:
        """The controller for states that are not measured: y ↦ u(t, x̂) with a Kalman filter; see OutputFeedback.

        Arguments that are left out are those of `outputs` in the config of the run.

        Args:
            kind: ekf, the extended Kalman filter; ukf, the unscented one.
            measure: names of the measured states; empty: the readings of the system's method output(x).
            noise: standard deviation of each reading, in its unit; one number for all measured states.
            process_noise: random walk assumed of states, by name, in the unit per √s.
            input_disturbances: constant disturbances of controls, by name, that are estimated and subtracted; each with
                its assumed random walk, in its unit per √s.
            initial_deviation: standard deviation of the first estimate of each state.
            delay: number of steps of Δt after which a control acts, because a reading, computation or actuator is late.

        Raises:
            UsageError: there are no outputs, or they do not fit the system.
        """
        if isinstance(self.controls, MappedControls):
            raise UsageError(
                f"Expected constant limits of controls, or a ball, for an estimator, got {self.controls.words}; take "
                "another set."
            )
        given = {
            "measure": [measure] if isinstance(measure, str) else None if measure is None else [*measure],
            "noise": _listed(noise),
            "process_noise": None if process_noise is None else dict(process_noise),
            "input_disturbances": None if input_disturbances is None else dict(input_disturbances),
            "initial_deviation": _listed(initial_deviation),
            "delay": delay,
        }
        known = OutputsConfig() if self._config is None else self._config.outputs
        section = replace(known, **{key: value for key, value in given.items() if value is not None})
        check_values(section, "outputs.")
        require_one_for_each(None if noise is None or np.ndim(noise) == 0 else _listed(noise), section.measure)
        plants = self.plants
        problem = self.problem if plants is None else plants.problem
        if (parts := estimator_parts(section, copied(problem))) is None:
            raise UsageError(
                "Expected outputs for an estimator, got none; add outputs: {measure: […], noise: […]} to the YAML, or "
                "give measure and noise."
            )
        return OutputFeedback(
            self.law, problem_of_estimator(section, problem), parts.outputs, kind, parts.drift, parts.deviation,
            section.delay, around_state=section.initial_deviation is not None, controller=self,
        )  # fmt: skip

    def continued(self, beyond: str) -> "Controller":
        """The controller with another law after T: hold, receding, riccati or error, as in lyapnet.load.

        Raises:
            ValueError: unknown name; or riccati, and the goal is no equilibrium that a linear law can stabilise.
        """
        parts, origin = self._parts, self.origin
        return Controller(self.problem, self.V, self._rollout, self.program, self._config, beyond, parts, origin=origin)

    @overload
    def rollout(
        self,
        x0: Tensor,
        steps: int | None = None,
        *,
        noise: Tensor | np.ndarray | int | None = None,
        **parameters: float,
    ) -> Trajectory: ...
    @overload
    def rollout(
        self,
        x0: ArrayLike,
        steps: int | None = None,
        *,
        noise: Tensor | np.ndarray | int | None = None,
        **parameters: float,
    ) -> ArrayTrajectory: ...
    def rollout(
        self, x0: Any, steps: int | None = None, *, noise: Tensor | np.ndarray | int | None = None, **parameters: float
    ) -> Any:
        """The closed loop from x₀ (*batch, n): a Trajectory of tensors, an ArrayTrajectory of arrays and lists.

        Args:
            steps: number of steps of Δt; None: that of the horizon. φ is evaluated at the last state; after T the law
                is `beyond`.
            noise: seed of one path of the noise from each state, or ΔW of each step (N, *batch, k), as problem.noise
                draws it; None: the closed loop without its noise.
            parameters: parameters of a family by name; none if x₀ is (x₀, p).

        Raises:
            ValueError: the shape does not fit; or noise after T, or for a problem without noise.
            DivergenceError: the closed loop is not finite.
        """
        if parameters:
            return self.with_(**parameters).rollout(x0, steps, noise=noise)
        if steps is not None and (not isinstance(steps, int) or steps < 1):
            raise ValueError(f"Expected steps as a whole number ≥ 1, got {steps!r}; give how many steps of Δt to take.")
        with torch.no_grad():
            state = self._state(x0)
            trajectory: Trajectory = self._rollout(state, self._increments(state, steps, noise))
            if steps is not None and steps < self.horizon.steps:
                trajectory = self._cut(trajectory, steps)
            elif steps is not None and steps > self.horizon.steps:
                trajectory = self._prolong(trajectory, steps - self.horizon.steps)
            trajectory = trajectory.applied(self.controls)
        return (
            trajectory if isinstance(x0, Tensor) else ArrayTrajectory(*(like_given(x0, field) for field in trajectory))
        )

    @torch.no_grad()
    def closed_loops(self, x0: Tensor, increments: Tensor | None = None, with_surprises: bool = True) -> Trajectory:
        """The closed loops under given noise, see Rollout.forward; their controls are elements of U."""
        return self._rollout(x0, increments, with_surprises)

    def _increments(self, x0: Tensor, steps: int | None, given: Tensor | np.ndarray | int | None) -> Tensor | None:
        """ΔW of each step from a batch of states; None without noise."""
        noise, horizon = self.problem.noise, self.horizon
        if given is None:
            return None
        if noise is None:
            raise ValueError("Expected no noise for a task without, got some; leave it out.")
        if steps not in (None, horizon.steps):
            raise ValueError(
                f"Expected the {horizon.steps} steps of the horizon with noise, got {steps}; leave it out."
            )
        if isinstance(given, int) and not isinstance(given, bool) and given >= 0:
            return noise.draw(horizon.steps, horizon.dt, x0, stream(given, NOISE))
        shape = (horizon.steps, *x0.shape[:-1], noise.sources)
        if not isinstance(given, Tensor | np.ndarray) or tuple(given.shape) != shape:
            got = tuple(given.shape) if isinstance(given, Tensor | np.ndarray) else repr(given)
            raise ValueError(f"Expected noise as a seed ≥ 0, or as ΔW of shape {shape}, got {got}; give one of them.")
        return torch.as_tensor(given).to(x0)

    def _cut(self, whole: Trajectory, steps: int) -> Trajectory:
        """The first steps of a trajectory."""
        nodes = slice(steps + 1)
        end, value = self.cost.terminal(whole.x[steps]), whole.require_value()[nodes]
        return Trajectory(whole.t[nodes], whole.x[nodes], whole.u[:steps], whole.running_cost[nodes], end, value)

    def share_code_of(self, rollout: Rollout) -> None:
        """Use the compiled code of another rollout of this law, if it has some and it agrees."""
        own, other = self._rollout.discrete, rollout.discrete
        if own is not None and other is not None and other.compiled_batch:
            draw = torch.Generator().manual_seed(0)
            own.share_code(other, self.problem.initial_states.sample(other.compiled_batch, draw))

    def compile_for(self, x0: Tensor) -> None:
        """Compile the closed loop for batches like x₀ (b, n), where that is possible; it then runs faster."""
        if self._rollout.discrete is not None and not self._rollout.discrete.compiled_batch:
            with suppress(UntraceableError, CompilationError):
                self._rollout.discrete.compile(x0)

    def _prolong(self, first: Trajectory, steps: int) -> Trajectory:
        """Continue a trajectory after T by a number of steps, under the law after T."""
        problem = self.problem.in_steps(steps=steps)
        law, solver = LaterPolicy(problem, self.law, self.horizon.duration), self._rollout.solver_arguments
        rest = Rollout(problem, law, self.method, "backprop", solver["rtol"], solver["atol"])(first.x[-1])
        return Trajectory(
            self.problem.in_steps(steps=self.horizon.steps + steps).horizon.times(first.x),
            torch.cat([first.x, rest.x[1:]]),
            torch.cat([first.u, rest.u]),
            torch.cat([first.running_cost, first.running_cost[-1] + rest.running_cost[1:]]),
            rest.terminal_cost,
            torch.cat([first.require_value(), rest.require_value()[1:]]),
        )

    def _evaluate(
        self, function: Callable[[Tensor, Tensor], Tensor], t: Any, x: Any, parameters: Mapping[str, Any]
    ) -> Any:
        time, state = self._inputs(t, self._append_parameters(x, parameters) if parameters else x)
        with torch.set_grad_enabled(torch.is_grad_enabled() and (time.requires_grad or state.requires_grad)):
            return like_given(x, function(time, state))

    def _inputs(self, t: Any, x: Any) -> tuple[Tensor, Tensor]:
        state = self._state(x)
        time = torch.as_tensor(t, dtype=state.dtype, device=state.device)
        batch = tuple(state.shape[:-1])
        if time.ndim and tuple(time.shape) != batch:
            raise ValueError(f"Expected t scalar or of shape {batch}, got {tuple(time.shape)}; give a time per state.")
        if bool((time < -slack(time, self.horizon.duration)).any()):
            raise ValueError(f"Expected t ≥ 0, got {float(time.min()):g}; the horizon begins at 0.")
        return time.clamp(min=0), state

    def _append_parameters(self, x: Any, parameters: Mapping[str, Any]) -> Tensor:
        """(x, p) from x and the parameters of a family; warns of parameters outside the range of training."""
        if not isinstance(self.system, FamilySystem):
            raise ValueError(f"Expected no parameters, got {', '.join(parameters)}; this is of a single problem.")
        box, n = self.initial_states, self.system.system.n
        given = named(parameters, self.system.system)
        state = self.system.joined(torch.as_tensor(x, dtype=box.lower.dtype, device=box.lower.device), given)
        lower, upper = box.lower[n:], box.upper[n:]
        room = 1e-9 * torch.maximum(lower.abs(), upper.abs())
        if not self._warned and not bool(Box(lower - room, upper + room).contains(state[..., n:]).all()):
            ranges = ranges_of(self.config, self.system)
            self._warned, known = True, ", ".join(f"{name} in {ends}" for name, ends in ranges.items())
            note = "note: V was trained for %s and is evaluated outside of this range; values there are extrapolated."
            logging.getLogger(__name__).warning(note, known)
        return state

    def _state(self, x: Any) -> Tensor:
        like = self.initial_states.lower
        state = torch.as_tensor(x, dtype=like.dtype, device=like.device)
        n = self.system.n
        if not state.ndim or state.shape[-1] != n:
            names = ", ".join(self.system.state_names)
            raise ValueError(
                f"Expected x of shape (*batch, {n}), got {tuple(state.shape)}; the last axis holds {names}."
            )
        return state


def _law_of(problem: Problem, V: ValueFunction) -> type[ValuePolicy]:
    """The control law for which V was trained; the HJB law if it is unknown, with a note if that matters."""
    known = known_law(problem, V)
    if known is None and (gain := gain_over_step(problem, V)) > MAX_LAW_DIFFERENCE:
        logging.getLogger(__name__).warning(
            "note: the control law for which %s was trained is unknown; u is its HJB law, which at this Δt differs by "
            "%.0f %% from the law with u held. Pass policy=lyapnet.SampledPolicy for a V of steps with u held, "
            "lyapnet.HJBPolicy for a V of continuous time; or set V.made_for.",
            type(V).__name__, 100 * gain,
        )  # fmt: skip
    return HJBPolicy if known is None else known


def _listed(given: Sequence[float] | float | None) -> list[float] | None:
    """A number as a list of one."""
    return None if given is None else [float(each) for each in np.atleast_1d(np.asarray(given))]
