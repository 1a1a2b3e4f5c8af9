"""Initial states from which the closed loop costs more than V says: a training sees them again."""

from typing import Any, cast

import torch
from lightning.pytorch import Callback, LightningModule, Trainer

from lyapnet.base.errors import DivergenceError
from lyapnet.base.types import PerState
from lyapnet.loop.programs.terms import promised
from lyapnet.loop.rollout import Trajectory
from lyapnet.task.cost import spread
from lyapnet.training.curves import data_of, log_scalars, with_loggers
from lyapnet.training.learner import Learner

SOUGHT, KEPT = 512, 256  # states of X₀ that are tried at each validation; lost ones, those found last
EXCESS = 0.05  # of V(0, x₀), by which a closed loop that is lost costs more


class LostStates(Callback):
    """Seeks lost states at the start and at each validation, for the batches of the data module; logs their share.

    Beside a kink of V, and where limits just admit what the goal takes, a closed loop may cost a hundred times its
    optimum from one state in a thousand: X₀'s mean cost then depends on states that its batches seldom meet. Those of
    the search are validated and tested on nowhere. The mildly lost are among them: trained on the worst alone, V gets
    worse elsewhere.
    """

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.global_step == 0:
            self.on_validation_end(trainer, pl_module)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        data, module = data_of(trainer), cast(Any, pl_module)
        x0 = data.further(SOUGHT, trainer.global_step)
        try:
            found = module.without_gradient(x0.to(module.device), _excess_of)
        except DivergenceError:  # of which a batch that meets it makes more: the training goes back
            return
        each = zip(with_loggers(trainer, pl_module), data.of_each, x0.reshape(-1, *x0.shape[-2:]), found, strict=True)
        for (_, loggers), its, states, by in each:
            lost = (by > EXCESS).cpu()
            its.lost = torch.cat([states.cpu()[lost], its.lost])[:KEPT]  # batches are drawn on the CPU
            log_scalars(trainer, loggers, {"lost_fraction/val": lost.double().mean()})


def excess(cost: PerState, value: PerState, has_goal: bool = True) -> PerState:
    """(J_N − V(0, x₀)) / V(0, x₀): above zero where V promises what its law does not keep.

    Without a goal it is in units of the spread of costs.
    """
    return (cost - value) / (promised(value, cost) if has_goal else spread(cost))


def _excess_of(learner: Learner, trajectory: Trajectory) -> PerState:
    return excess(trajectory.cost, trajectory.require_value()[0], learner.problem.has_goal)
