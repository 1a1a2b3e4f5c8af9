"""A callback that returns to the best weights, with a smaller learning rate, when a training becomes worse."""

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor

from lyapnet.task.cost import spread
from lyapnet.training.curves import data_of, members_of
from lyapnet.training.learner import Learner, number_over_processes

RATE_DIVISOR = 3.0  # each return divides the learning rate by this
WORSE_BY = 0.01  # relative increase of the cost, from the best weights, above which training counts as worse
WORSE_FOR = 60  # number of steps for which training is worse before it returns
DIVERGENCE_COST_RATIO = 2.0  # cost relative to that of the best weights above which it returns at once
COMPARED_SHARE = 0.9  # share of validation states, the cheapest, in that cost; the others may be near a kink of V


@dataclass
class Best:
    """The best weights of a member so far, with the state needed to continue from them."""

    loss: float = math.inf  # least selection loss
    step: int = 0
    cost: float = math.inf  # mean cost of the validation states
    cheapest: float = math.inf  # mean cost of the cheapest COMPARED_SHARE of them
    weights: dict[str, Tensor] = field(default_factory=dict)
    optimizer: list[dict[str, Any]] = field(default_factory=list)  # state of the optimizer for each parameter of V
    worse_since: int | None = None  # first of the last consecutive validations that were worse
    rate_share: float = 1.0  # factor of the scheduled learning rate


class ReturnToBest(Callback):
    """Returns a member to its best weights if its closed loops cost more, during or at the end of its training.

    The best weights are those of the least selection loss of `Learner`, as in best.ckpt. Training is worse if the mean
    cost of the validation states exceeds that of the best weights by more than WORSE_BY. After WORSE_FOR steps of this,
    or at once if the cheapest COMPARED_SHARE of the states cost DIVERGENCE_COST_RATIO times as much, weights and
    optimizer return to their best state, and the learning rate becomes a third. A member that is worse after its last
    step gets its best weights, from which a resumed or fine-tuned run starts.

    Without a goal costs are relative to the spread of V(0, x₀), under noise to that of the costs if it is larger:
    V(0, x₀) may be nearly the same on all of X₀.

    Args:
        returns_if_worse: whether it also returns after WORSE_FOR steps. Costs of a training from random weights vary
            by more than WORSE_BY.
        say: prints a line.
        note: adds a return to the run's record.
    """

    def __init__(self, returns_if_worse: bool, say: Callable[[str], None], note: Callable[[Mapping[str, Any]], None]):
        self.returns_if_worse, self.say, self.note = returns_if_worse, say, note
        self.best: dict[str, Best] = {}  # by label

    def state_dict(self) -> dict[str, Any]:
        return {label: asdict(best) for label, best in self.best.items()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        self.best = {label: Best(**stored) for label, stored in state_dict.items()}

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        for member in members_of(pl_module):
            best = self.best.setdefault(member.label, Best())
            member.rate_share = best.rate_share
        if trainer.global_step == 0:
            self.on_validation_end(trainer, pl_module)  # the initial V

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        groups, states = trainer.optimizers[0].param_groups, data_of(trainer).of_each
        for member, group, data in zip(members_of(pl_module), groups, states, strict=True):
            if member.measured_at == trainer.global_step and self._compare(trainer, member, group):
                data.lost = data.lost[:0]  # they are those of the weights that it has left

    def _compare(self, trainer: Trainer, member: Learner, group: dict[str, Any]) -> bool:
        """Compare a member, whose training had not ended earlier, with its best weights, and keep or restore them.

        Returns:
            Whether they are restored.
        """
        assert member.validation is not None
        step, best = trainer.global_step, self.best[member.label]
        loss, cost, cheapest, spread_of_costs = (
            number_over_processes(value, member.problem.goal.device) for value in _measures(member)
        )
        if loss < best.loss or not math.isfinite(best.loss):
            best.loss, best.step, best.cost, best.cheapest, best.worse_since = loss, step, cost, cheapest, None
            best.weights = {name: value.clone() for name, value in member.V.state_dict().items()}
            states = (trainer.optimizers[0].state.get(p, {}) for p in group["params"])
            best.optimizer = [_copy_of(state) for state in states]
            return False
        sizes = (best.cost, best.cheapest) if member.problem.has_goal else (spread_of_costs, spread_of_costs)
        diverges = cheapest - best.cheapest > (DIVERGENCE_COST_RATIO - 1) * sizes[1]
        if not (diverges or cost - best.cost > WORSE_BY * sizes[0]):
            best.worse_since = None
            return False
        best.worse_since = step if best.worse_since is None else best.worse_since
        ends = step >= (member.cooling[1] if member.cooling else trainer.max_epochs or math.inf)
        if not (ends or diverges or (self.returns_if_worse and step - best.worse_since >= WORSE_FOR)):
            return False
        self._return(
            trainer, member, group, f"cost {cost:.4g} at step {step}, {best.cost:.4g} at step {best.step}", ends
        )
        return True

    def _return(self, trainer: Trainer, member: Learner, group: dict[str, Any], because: str, ends: bool) -> None:
        """Restore the best weights of a member."""
        best = self.best[member.label]
        member.V.load_state_dict(best.weights)
        for p, state in zip(group["params"], best.optimizer, strict=True):
            trainer.optimizers[0].state[p] = _copy_of(state)
        best.worse_since = None
        what = "training ends with the weights of that step"
        if not ends:
            best.rate_share = member.rate_share = best.rate_share / RATE_DIVISOR
            group["lr"] /= RATE_DIVISOR
            what = f"training continues from there, with {best.rate_share:.2g} of the scheduled learning rate"
        if trainer.is_global_zero:
            named = f" of {member.label.replace('_', ' ')}" if member.label else ""
            self.say(f"worse: the validation states{named} {because}; {what}")
            self.note({"to": best.step, "rate_share": best.rate_share, "because": because})


def _measures(member: Learner) -> tuple[float, float, float, float]:
    """The selection loss, the mean cost, that of the cheapest states, and the spread of costs."""
    assert member.validation is not None
    costs = member.validation.cost.nan_to_num(math.inf).sort().values
    cheapest = costs[: math.ceil(COMPARED_SHARE * len(costs))]
    size = float(spread(member.validation.value))
    if member.problem.noise is not None:
        size = max(size, float(spread(cheapest)))
    return member.selection_loss, float(costs.mean()), float(cheapest.mean()), size


def _copy_of(state: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of the optimizer's state for one parameter."""
    return {key: value.clone() if isinstance(value, Tensor) else value for key, value in state.items()}
