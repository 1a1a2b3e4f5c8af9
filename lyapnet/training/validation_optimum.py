"""The callback that computes the optimal cost of the validation states before the first step."""

import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor
from torch.nn.functional import pad

from lyapnet.base.errors import OracleError
from lyapnet.base.random_streams import VALIDATION
from lyapnet.evaluation.oracles import oracle_of
from lyapnet.training.curves import data_of, members_of
from lyapnet.training.learner import Learner
from lyapnet.training.stage_messages import StageMessages

COMPARED_STATES = 64  # first validation states of each member, whose optimum is computed


class ValidationOptimum(Callback):
    """Computes the optimal cost of COMPARED_STATES validation states before the first step.

    Checkpoints store it, so that a resumed run is compared with the same numbers.

    Args:
        stages: shows progress and messages.
        wanted: whether to compute the optimum if the checkpoint has none.
    """

    def __init__(self, stages: StageMessages, wanted: bool = True):
        self.stages, self.wanted = stages, wanted
        self.cost: Tensor | None = None  # (members, b)

    def state_dict(self) -> dict[str, Any]:
        return {} if self.cost is None else {"cost": self.cost}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.cost = state_dict.get("cost")

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        members = members_of(pl_module)
        if self.cost is None and self.wanted:
            found = self._solve(members, data_of(trainer).validation_batch()) if trainer.is_global_zero else None
            self.cost = trainer.strategy.broadcast(found)
        if self.cost is not None:
            for member, cost in zip(members, self.cost.to(pl_module.device), strict=True):
                member.validation_optimum = cost
        if trainer.is_global_zero:
            self.stages("curves and figures of the start")

    def _solve(self, members: Sequence[Learner], states: Tensor) -> Tensor | None:
        """J* (members, b) for states (members, b, n), or (1, b) for (b, n); NaN after the first COMPARED_STATES states.

        On random plants it is the optimum of the plant from each state. None if the problem has no oracle.
        """
        started, first = time.perf_counter(), members[0]
        own = states.reshape(-1, *states.shape[-2:])
        states = torch.stack([each.with_plants(x0, VALIDATION) for each, x0 in zip(members, own, strict=True)])
        if first.problem.risk and first.problem.noise is not None:
            return None  # validation measures E J, for which the optimum with risk is not the optimum
        try:
            oracle = oracle_of(first.problem_of_loops, first.rollout.method)
            compared = states[..., :COMPARED_STATES, :]
            optima = oracle.solve(compared.flatten(0, -2), progress=partial(self.stages, "optima of validation states"))
        except OracleError as error:
            self.stages.console.print(f"no optimum to compare with: {error}", soft_wrap=True, markup=False)
            return None
        seconds, missing = time.perf_counter() - started, ""
        if optima.failures:
            missing = f"; unknown for {optima.failures}, which are left out"
        if missing or seconds > 0.2:  # short computations are not reported
            found = f"optimum of {len(optima.cost)} validation states, in {seconds:.0f} s"
            self.stages.console.print(f"{found}{missing}", soft_wrap=True)
        cost = optima.cost.cpu().reshape(-1, compared.shape[-2])
        return pad(cost, (0, states.shape[-2] - cost.shape[-1]), value=torch.nan)
