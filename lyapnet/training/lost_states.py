"""Lost states: initial states from which the closed loop costs more than V predicts. Training uses them again."""

from functools import partial
from typing import Any, cast

import torch
from lightning.pytorch import Callback, LightningModule, Trainer

from lyapnet.base.errors import DivergenceError
from lyapnet.base.random_streams import LOST, stream
from lyapnet.base.types import PerState, State
from lyapnet.evaluation.worst_states import MIN_EXCESS, excess, search_near_worst
from lyapnet.training.curves import data_of, log_scalars, members_of, with_loggers
from lyapnet.training.learner import Learner

SEARCHED_STATES = 512  # random states of X₀ that are tested at each validation
MAX_LOST_STATES = 256  # most recent lost states kept
GRAVE_EXCESS = 0.5  # excess above which a lost state counts in the choice of the best weights
MOST_EXCESS = 1e3  # the largest that counts; also that of closed loops that are not finite


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

    def __init__(self) -> None:
        self.excesses: dict[str, float] = {}  # label ↦ `lost_excess` of a member

    def state_dict(self) -> dict[str, Any]:
        return dict(self.excesses)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.excesses = dict(state_dict)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        for member in members_of(pl_module):
            member.lost_excess = self.excesses.get(member.label, 0.0)
        if trainer.global_step == 0:
            self.on_validation_end(trainer, pl_module)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        data, module = data_of(trainer), cast(Any, pl_module)
        x0 = data.further(SEARCHED_STATES, trainer.global_step)
        found = module.without_gradient(x0.to(module.device), partial(_search, step=trainer.global_step))
        states_of_each = x0.reshape(-1, *x0.shape[-2:])
        each = zip(with_loggers(trainer, pl_module), data.of_each, states_of_each, found, strict=True)
        for (member, loggers), member_data, states, (excesses, largest) in each:
            lost = (excesses > MIN_EXCESS).cpu()
            member_data.lost = torch.cat([states.cpu()[lost], member_data.lost])[:MAX_LOST_STATES]
            if not module.has_ended(member, trainer.global_step):
                member.lost_excess = self.excesses[member.label] = largest if largest > GRAVE_EXCESS else 0.0
            scalars = {"lost_fraction/val": lost.double().mean(), "largest_excess/val": torch.tensor(largest)}
            log_scalars(trainer, loggers, scalars)


def _search(learner: Learner, x0: State, step: int) -> tuple[PerState, float]:
    """The excesses from random states of X₀, and the largest that is found from them and near the worst of them.

    Under noise and with random plants the latter is 0, as a single path or plant may cost more than V by chance.
    """
    problem = learner.problem
    try:
        cost, value = _cost_and_value(learner, x0)
    except DivergenceError:  # a training batch that diverges is handled by the training itself
        return x0.new_zeros(len(x0)), MOST_EXCESS
    excesses = excess(cost, value, problem.has_goal)
    if problem.noise is not None or learner.plants is not None:
        return excesses, 0.0

    def measure(near: State) -> PerState:
        return excess(*_cost_and_value(learner, near), problem.has_goal, cost)

    try:
        generator = stream(learner.seed, LOST, step, 1)
        found = search_near_worst(problem.initial_states, x0, excesses, measure, generator)[1]
    except DivergenceError:
        return excesses, MOST_EXCESS
    return excesses, min(float(found.max()), MOST_EXCESS)


def _cost_and_value(learner: Learner, x0: State) -> tuple[PerState, PerState]:
    trajectory = learner.roll_out(x0, LOST)
    return trajectory.expected_cost, trajectory.require_value()[0]
