"""Recovery from losses that are not finite: training returns to its last checkpoint with a smaller learning rate."""

import copy
from dataclasses import replace
from pathlib import Path

import lightning as L
import torch
from rich.console import Console

from lyapnet.base.contracts import TO_WRITE, without_slope
from lyapnet.base.errors import DivergenceError
from lyapnet.experiment.checkpoint import read_checkpoint
from lyapnet.task.domain import as_written
from lyapnet.training.best_weights import RATE_DIVISOR
from lyapnet.training.learner import Learner
from lyapnet.training.loggers import drop_logs_after
from lyapnet.training.plan import Plan
from lyapnet.training.start import Start
from lyapnet.training.task_facts import step_gain
from lyapnet.value.expansions import in_float64
from lyapnet.value.policy import HJBPolicy

MAX_RETURNS = 4  # returns to a checkpoint in one process
SLOPE_TEST_STATES = 32  # states of X₀ whose closed loops are searched for non-finite derivatives


class Returns:
    """Returns a diverged training to its last checkpoint, with a third of the learning rate.

    Before the first checkpoint it returns to the initial weights. Each return is printed and stored in the run's
    record. After MAX_RETURNS returns, or with several processes, the divergence is raised with its likely cause.

    Args:
        plan: the plan of the training.
        console: where returns are printed.
        start: the initial V, if it was chosen by a search.
    """

    def __init__(self, plan: Plan, console: Console, start: Start | None):
        self.plan, self.console, self.start = plan, console, start
        self.weights = copy.deepcopy(plan.module.state_dict())
        self.found = _modification_time(
            plan.run.last
        )  # an earlier process may have written a later checkpoint than the resumed one
        self.count = 0

    def go_back(self, error: DivergenceError, trainer: L.Trainer) -> Plan:
        """The plan that continues from the last checkpoint with a smaller learning rate.

        Raises:
            DivergenceError: there were too many returns, or the first step failed, so that the rate is not the cause.
        """
        if self.count == MAX_RETURNS or trainer.world_size > 1:
            raise DivergenceError(f"{error}{self._diagnose()}") from error
        plan, module = self.plan, self.plan.module
        if not self.count and trainer.global_step == 0:
            raise DivergenceError(f"{str(error).partition(';')[0]}; {self._diagnose_before_first_step()}") from error
        if _modification_time(plan.run.last) != self.found:
            plan = replace(plan, resume_from=plan.run.last, step=int(read_checkpoint(plan.run.last)["global_step"]))
        elif plan.resume_from is None:
            module.load_state_dict(self.weights)
        module.train()  # an aborted validation leaves it in evaluation mode
        module.rate_share /= RATE_DIVISOR
        self.count += 1
        entry = {"to": plan.step, "rate_share": module.rate_share, "because": str(error)}
        plan.run.note_return(entry)
        self.console.print(
            f"{error} Going back to step {plan.step}, with {module.rate_share:.2g} of the scheduled learning rate "
            f"(return {self.count} of at most {MAX_RETURNS}).",
            soft_wrap=True,
        )
        for run in plan.run.members(plan.config):
            drop_logs_after(run, plan.step if plan.resume_from else None)
        return plan

    def _diagnose_before_first_step(self) -> str:
        """Describe a divergence before the first step, which the learning rate cannot have caused."""
        member: Learner = self.plan.module.members[0]
        tried = "no step was taken yet, so that the learning rate is not the cause"
        if (slope := infinite_slope(member)) is not None:
            return f"{tried}: {slope}; {TO_WRITE}."
        otherwise = " Check f, g and the cost along closed loops, or choose a smaller Δt or X₀."
        return f"{tried}.{self._describe_cause() or otherwise}"

    def _diagnose(self) -> str:
        """Describe how often training went back, and the likely cause."""
        if not self.count:  # several processes
            return ""
        share = f"{self.plan.module.rate_share:.2g}"
        return (
            f" {self.count} returns did not help, the last with {share} of the learning rate.{self._describe_cause()}"
        )

    def _describe_cause(self) -> str:
        """Describe what is wrong with the law or the initial V, in a sentence; empty if nothing is known."""
        member: Learner = self.plan.module.members[0]
        if isinstance(member.rollout.closed_loop.policy, HJBPolicy):
            gain = step_gain(in_float64(member.problem))
            if gain.advice:
                return f" The steps are too long for the law: {gain.found}; take {gain.advice}."
        if self.start is not None and self.start.chosen.finite < 1:
            known = f"{self.start.chosen.finite:.0%}"
            return f" The start is finite on {known} of X₀ alone: choose a smaller X₀, or a shorter horizon."
        return ""


def infinite_slope(member: Learner) -> str | None:
    """Which of f, g, q and φ has a non-finite derivative along closed loops from X₀, and where; None if none has."""
    problem, names = in_float64(member.problem), member.problem.system.state_names
    try:
        with torch.no_grad():
            x0 = member.problem.initial_states.sample(SLOPE_TEST_STATES, torch.Generator().manual_seed(0))
            x = member.rollout(x0).x.to(problem.goal).flatten(0, -2)
    except DivergenceError:
        return None
    parts = type(problem.system).__name__, type(as_written(problem.cost)).__name__
    for name, function in (
        *((f"{parts[0]}.{name}", function) for name, function in problem.functions_of_state.items()),
        (f"q(x) of {parts[1]}", problem.cost.state), (f"φ(x) of {parts[1]}", problem.cost.terminal),
    ):  # fmt: skip
        if (found := without_slope(function, [x])) is not None:
            i, slope, _, component = found
            where = ", ".join(f"{value:.6g}" for value in x[i].tolist())
            return f"the slope of {name} by {names[component]} is {slope} at x = ({where}), where a closed loop leads"
    return None


def _modification_time(path: Path) -> int | None:
    """The time at which a file was last written, in ns; None if it does not exist."""
    return path.stat().st_mtime_ns if path.exists() else None
