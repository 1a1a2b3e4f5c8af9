"""The function to differentiate: the loss of a program for a task and a V with random weights."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from lyapnet.base.errors import UsageError
from lyapnet.base.random_streams import TEST, stream
from lyapnet.base.types import State
from lyapnet.experiment.assembly import build_problem, build_program, build_rollout, build_value_function
from lyapnet.experiment.config import Config, config_from_plain, load_config
from lyapnet.loop.programs import Program
from lyapnet.loop.rollout import Rollout
from lyapnet.task.problem import Problem
from lyapnet.value.calculus import ValueFunction

CONFIGS, CHAIN = Path("conf"), "chain:"


class Case(NamedTuple):
    """θ ↦ program(rollout(x₀)).loss, for a V of parameters θ."""

    name: str
    config: Config
    problem: Problem
    V: ValueFunction
    program: Program

    def rollout(self, gradient: str, V: ValueFunction | None = None, **options: Any) -> Rollout:
        """The closed loop with a given rollout.gradient and other options of this section, and costates of any size."""
        section = replace(self.config.rollout, gradient=gradient, costate_limit=None, **options)
        return build_rollout(replace(self.config, rollout=section), self.problem, self.V if V is None else V)

    def gradient(self, rollout: Rollout, x0: State) -> Sequence[Tensor]:
        """∂loss/∂θ."""
        return derivatives([self.program(rollout(x0)).loss], trained(self.V))

    def sample(self, batch: int) -> State:
        """Initial states, the same at each call."""
        return self.problem.initial_states.sample(batch, stream(self.config.seed, TEST))

    def in_steps(self, steps: int) -> "Case":
        """The case with the same T and another number of steps."""
        return self._replace(problem=self.problem.in_steps(steps=steps, dt=self.problem.horizon.duration / steps))


def load_case(name: str, overrides: Sequence[str] = ()) -> Case:
    """The case of a YAML file, of conf/NAME.yaml, or of chain:N, a chain of N integrators with one input.

    Raises:
        UsageError: no such task, or a config that does not hold.
    """
    path = Path(name)
    if is_chain(name):
        config = config_from_plain(_chain(name.removeprefix(CHAIN)), overrides)
    elif path.suffix in (".yaml", ".yml"):
        name, config = path.stem, load_config(path, overrides)
    else:
        known = sorted(file.stem for file in CONFIGS.glob("*.yaml"))
        if name not in known:
            raise UsageError(
                f"Expected a task of {CONFIGS}/ ({', '.join(known) or 'none in this folder'}), a YAML file or "
                f"{CHAIN}N, got {name!r}; choose one of them."
            )
        config = load_config(CONFIGS / f"{name}.yaml", overrides)
    problem = build_problem(config)
    return Case(name, config, problem, build_value_function(config, problem), build_program(config))


def is_chain(name: str) -> bool:
    """Whether a task is a chain of integrators."""
    return name.startswith(CHAIN)


def _chain(length: str) -> dict[str, Any]:
    """ẋ_i = x_{i+1}, ẋ_N = u on the double integrator's horizon, as a config."""
    if not (length.isdecimal() and int(length) > 0):
        raise UsageError(f"Expected {CHAIN}N with N ≥ 1 integrators, got {CHAIN}{length}; for example {CHAIN}8.")
    return {
        "experiment": f"chain_{length}",
        "program": {"name": "value", "terminal": 1.0, "trajectory_cost": 1.0},
        "system": {"name": "integrator_chain", "parameters": {"length": int(length)}},
        "cost": {"Q": [1.0], "R": [[1.0]], "Q_T": [1.0]},
        "initial_states": {"lower": [-1.0], "upper": [1.0]},
        "horizon": {"steps": 400, "dt": 0.01},
        "network": {"name": "fcn", "hidden": [64, 64]},
    }


def trained(V: nn.Module) -> list[Tensor]:
    """θ."""
    return [p for p in V.parameters() if p.requires_grad]


def derivatives(
    outputs: Sequence[Tensor], inputs: Sequence[Tensor], bars: Sequence[Tensor] | None = None
) -> Sequence[Tensor]:
    """Σ barᵀ ∂output/∂input; zero where an output does not depend on an input."""
    return torch.autograd.grad(outputs, inputs, bars, allow_unused=True, materialize_grads=True)


def flat(gradient: Sequence[Tensor]) -> Tensor:
    """A gradient as one float64 vector."""
    return torch.cat([part.flatten() for part in gradient]).double()
