"""Lost states: initial states from which the closed loop costs more than V predicts. Training uses them again."""

from typing import Any, cast

import torch
from lightning.pytorch import Callback, LightningModule, Trainer

from lyapnet.base.errors import DivergenceError
from lyapnet.base.random_streams import LOST
from lyapnet.base.types import PerState, State
from lyapnet.loop.programs.terms import value_floored
from lyapnet.task.cost import spread
from lyapnet.training.curves import data_of, log_scalars, with_loggers
from lyapnet.training.learner import Learner

SEARCHED_STATES = 512  # random states of X₀ that are tested at each validation
MAX_LOST_STATES = 256  # most recent lost states kept
MIN_EXCESS = 0.05  # relative excess of the cost over V(0, x₀) above which a state counts as lost


class LostStates(Callback):
    """Searches for lost states at the start and at each validation, adds them to the training data, logs their share.

    Near a kink of V, or where the control limits are hardly sufficient, a closed loop may cost a hundred times the
    optimum from one state in a thousand. The mean cost on X₀ then depends on states that are rare in the batches. The
    searched states are used neither for validation nor for tests. Mildly lost states are included, because training on
    the worst ones alone makes V worse elsewhere.
    """

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.global_step == 0:
            self.on_validation_end(trainer, pl_module)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        data, module = data_of(trainer), cast(Any, pl_module)
        x0 = data.further(SEARCHED_STATES, trainer.global_step)
        try:
            excesses = module.without_gradient(x0.to(module.device), _excess_of)
        except DivergenceError:  # a training batch that diverges is handled by the training itself
            return
        states_of_each = x0.reshape(-1, *x0.shape[-2:])
        each = zip(with_loggers(trainer, pl_module), data.of_each, states_of_each, excesses, strict=True)
        for (_, loggers), member_data, states, by in each:
            lost = (by > MIN_EXCESS).cpu()
            member_data.lost = torch.cat([states.cpu()[lost], member_data.lost])[:MAX_LOST_STATES]
            log_scalars(trainer, loggers, {"lost_fraction/val": lost.double().mean()})


def excess(cost: PerState, value: PerState, has_goal: bool = True) -> PerState:
    """The excess (J_N − V(0, x₀)) / V(0, x₀) of the cost over V; without a goal, relative to the spread of J_N."""
    return (cost - value) / (value_floored(value, cost) if has_goal else spread(cost))


def _excess_of(learner: Learner, x0: State) -> PerState:
    trajectory = learner.roll_out(x0, LOST)
    return excess(trajectory.expected_cost, trajectory.require_value()[0], learner.problem.has_goal)
