"""Lost states: initial states from which the closed loop costs more than V predicts. Training uses them again."""

from functools import partial
from typing import Any, cast

import torch
from lightning.pytorch import Callback, LightningModule, Trainer

from lyapnet.base.errors import DivergenceError
from lyapnet.base.random_streams import LOST, stream
from lyapnet.base.types import PerState, State
from lyapnet.evaluation.worst_states import MIN_EXCESS, excess, search_near_worst
from lyapnet.training.curves import data_of, log_scalars, with_loggers
from lyapnet.training.learner import Learner

SEARCHED_STATES = 512  # random states of X₀ that are tested at each validation
MAX_LOST_STATES = 256  # most recent lost states kept
GRAVE_EXCESS = 0.5  # relative excess over V(0, x₀) from which on it counts in the choice of the best weights


class LostStates(Callback):
    """Searches for lost states at the start and at each validation, adds them to the training data, logs their share.

    Near a kink of V, or where the control limits are hardly sufficient, a closed loop may cost a hundred times the
    optimum from one state in a thousand. The mean cost on X₀ then depends on states that are rare in the batches. The
    searched states are used neither for validation nor for tests. Mildly lost states are included, because training on
    the worst ones alone makes V worse elsewhere.

    If some random states are lost, states near the worst of them are tested too: beside a cliff of the cost closed
    loops cost more already. These searches find failures that are too rare for the validation states, and the largest
    excess counts in the choice of the best weights, see `Learner.selection_loss`. Training uses the random ones.
    """

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.global_step == 0:
            self.on_validation_end(trainer, pl_module)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        data, module = data_of(trainer), cast(Any, pl_module)
        x0 = data.further(SEARCHED_STATES, trainer.global_step)
        try:
            found = module.without_gradient(x0.to(module.device), partial(_search, step=trainer.global_step))
        except DivergenceError:  # a training batch that diverges is handled by the training itself
            return
        states_of_each = x0.reshape(-1, *x0.shape[-2:])
        each = zip(with_loggers(trainer, pl_module), data.of_each, states_of_each, found, strict=True)
        for (member, loggers), member_data, states, (excesses, largest) in each:
            lost = (excesses > MIN_EXCESS).cpu()
            member_data.lost = torch.cat([states.cpu()[lost], member_data.lost])[:MAX_LOST_STATES]
            if member.measured_at == trainer.global_step:  # its training had not ended earlier
                member.lost_excess = largest if largest > GRAVE_EXCESS else 0.0
            scalars = {"lost_fraction/val": lost.double().mean(), "largest_excess/val": torch.tensor(largest)}
            log_scalars(trainer, loggers, scalars)


def _search(learner: Learner, x0: State, step: int) -> tuple[PerState, float]:
    """The excesses from random states of X₀, and the largest that is found from them and near the worst of them."""
    excesses, generator = _excess_of(learner, x0), stream(learner.seed, LOST, step, 1)
    measure = partial(_excess_of, learner)
    return excesses, float(search_near_worst(learner.problem.initial_states, x0, excesses, measure, generator)[1].max())


def _excess_of(learner: Learner, x0: State) -> PerState:
    trajectory = learner.roll_out(x0, LOST)
    return excess(trajectory.expected_cost, trajectory.require_value()[0], learner.problem.has_goal)
