"""What becomes of a training that leaves the finite numbers, or whose cost rises: it goes back, and on more slowly."""

import copy
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from rich.console import Console

from lyapnet.base.contracts import TO_WRITE, without_slope
from lyapnet.base.errors import DivergenceError
from lyapnet.experiment.checkpoint import read_checkpoint
from lyapnet.task.cost import spread
from lyapnet.task.domain import as_written
from lyapnet.training.curves import members_of
from lyapnet.training.facts import stiffness
from lyapnet.training.learner import Learner
from lyapnet.training.loggers import take_back_after
from lyapnet.training.plan import Plan
from lyapnet.training.start import Start
from lyapnet.value.expansions import in_float64
from lyapnet.value.policy import HJBPolicy

RETURNS = 4  # at the most
SLOWER = 3.0  # by which each divides the learning rate
RISE = 2.0  # times the least cost so far of most validation states, from which on a run is taken for lost
TRIED = 32  # states of X₀ whose closed loops are searched for slopes that are not finite
MOST = 0.9  # of the validation states, the cheapest: a few are lost where V has a kink, with no need to turn back


class RisingCost(Callback):
    """Ends a training whose cost on MOST of the validation states has risen to RISE times the least so far; without a
    goal, by the spread of V(0, x₀).

    Raises:
        DivergenceError: it has.
    """

    def __init__(self) -> None:
        self.least: dict[str, float] = {}

    def state_dict(self) -> dict[str, Any]:
        return dict(self.least)

    def load_state_dict(self, state_dict: Mapping[str, float]) -> None:
        self.least = dict(state_dict)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.global_step == 0:
            self.on_validation_end(trainer, pl_module)  # of what training starts from

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        for member in members_of(pl_module):
            assert member.validation is not None
            costs = member.validation.cost.sort().values
            cost = float(costs[: math.ceil(MOST * len(costs))].mean()) if costs.isfinite().all() else math.inf
            least = self.least[member.label] = min(self.least.get(member.label, cost), cost)
            size = least if member.problem.has_goal else float(spread(member.validation.value))
            if cost - least > (RISE - 1) * size > 0:
                module: Any = pl_module
                raise DivergenceError(
                    f"{module.place(member.label)}: Expected a cost on the cheapest {MOST:.0%} of the validation "
                    f"states of at most {least + (RISE - 1) * size:.4g}, as {least:.4g} was reached before, got "
                    f"{cost:.4g}; lower training.learning_rate or set trainer.gradient_clip_val."
                )


class Returns:
    """Where a training that diverged goes on: from its last checkpoint, with a third of the learning rate.

    Before the first checkpoint that is the weights that it began with. Each return is told, and kept in the run's
    record; after RETURNS of them, or in several processes, the divergence is raised with its cause.

    Args:
        plan: what is trained.
        console: where returns are told.
        start: what the training began with, if that was chosen.
    """

    def __init__(self, plan: Plan, console: Console, start: Start | None):
        self.plan, self.console, self.start = plan, console, start
        self.weights = copy.deepcopy(plan.module.state_dict())
        self.found = _written(plan.run.last)  # by an earlier process, perhaps beyond the checkpoint that is resumed
        self.count = 0

    def go_back(self, error: DivergenceError, trainer: L.Trainer) -> Plan:
        """The plan from the last checkpoint on, more slowly.

        Raises:
            DivergenceError: there were too many returns, or no step was taken, so that the rate is no matter.
        """
        if self.count == RETURNS or trainer.world_size > 1:
            raise DivergenceError(f"{error}{self._diagnosis()}") from error
        plan, module = self.plan, self.plan.module
        if not self.count and trainer.global_step == 0:
            raise DivergenceError(f"{str(error).partition(';')[0]}; {self._before_any_step()}") from error
        if _written(plan.run.last) != self.found:
            plan = replace(plan, resume_from=plan.run.last, step=int(read_checkpoint(plan.run.last)["global_step"]))
        elif plan.resume_from is None:
            module.load_state_dict(self.weights)
        module.train()  # a validation may have ended in the middle
        module.rate_share /= SLOWER
        self.count += 1
        entry = {"to": plan.step, "rate_share": module.rate_share, "because": str(error)}
        plan.run.note(returns=[*plan.run.record()["returns"], entry])
        self.console.print(
            f"{error} Going back to step {plan.step}, with {module.rate_share:.2g} of the scheduled learning rate "
            f"(return {self.count} of at most {RETURNS}).",
            soft_wrap=True,
        )
        for run in plan.run.members(plan.config):
            take_back_after(run, plan.step if plan.resume_from else None)
        return plan

    def _before_any_step(self) -> str:
        """What is known of a divergence that no learning rate caused."""
        member: Learner = self.plan.module.members[0]
        tried = "no step was taken yet, so that no learning rate mends it"
        if (slope := infinite_slope(member)) is not None:
            return f"{tried}: {slope}; {TO_WRITE}."
        otherwise = " Look at f, g and the cost where closed loops lead, or choose a smaller Δt or X₀."
        return f"{tried}.{self._cause() or otherwise}"

    def _diagnosis(self) -> str:
        """Why going back has not helped, where that is known."""
        if not self.count:  # several processes
            return ""
        share = f"{self.plan.module.rate_share:.2g}"
        return f" {self.count} returns did not help, the last with {share} of the learning rate.{self._cause()}"

    def _cause(self) -> str:
        """What is wrong with the law or with the start, in a sentence; empty where nothing is known to be."""
        member: Learner = self.plan.module.members[0]
        if isinstance(member.rollout.closed_loop.policy, HJBPolicy):
            stiff = stiffness(in_float64(member.problem))
            if stiff.advice:
                return f" The law is too stiff: {stiff.found}; take {stiff.advice}."
        if self.start is not None and self.start.chosen.finite < 1:
            known = f"{self.start.chosen.finite:.0%}"
            return f" The start is finite on {known} of X₀ alone: choose a smaller X₀, or a shorter horizon."
        return ""


def infinite_slope(member: Learner) -> str | None:
    """Which of f, g, q and φ has a slope that is not finite along closed loops from X₀, and where; None: none has."""
    problem, names = in_float64(member.problem), member.problem.system.state_names
    try:
        with torch.no_grad():
            x0 = member.problem.initial_states.sample(TRIED, torch.Generator().manual_seed(0))
            x = member.rollout(x0).x.to(problem.goal).flatten(0, -2)
    except DivergenceError:
        return None
    parts = type(problem.system).__name__, type(as_written(problem.cost)).__name__
    for name, function in (
        (f"{parts[0]}.f(x)", problem.system.f), (f"{parts[0]}.g(x)", problem.system.g),
        (f"q(x) of {parts[1]}", problem.cost.state), (f"φ(x) of {parts[1]}", problem.cost.terminal),
    ):  # fmt: skip
        if (found := without_slope(function, [x])) is not None:
            i, slope, _, component = found
            where = ", ".join(f"{value:.6g}" for value in x[i].tolist())
            return f"the slope of {name} by {names[component]} is {slope} at x = ({where}), where a closed loop leads"
    return None


def _written(path: Path) -> int | None:
    """When a file was written, if it was."""
    return path.stat().st_mtime_ns if path.exists() else None
