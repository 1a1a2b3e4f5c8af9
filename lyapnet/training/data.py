"""Initial states: a new batch of X₀ for every training step, a fixed batch for validation."""

from collections.abc import Sequence
from typing import Any

import lightning as L
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from lyapnet.base.errors import CheckpointError
from lyapnet.base.random_streams import LOST, TRAINING, VALIDATION, stream
from lyapnet.base.types import State
from lyapnet.task.problem import Problem


class InitialStateDataModule(L.LightningDataModule):
    """Batches (b, n) of initial states from X₀.

    The batch of a step depends only on (seed, process, step) and the lost states: a resumed run draws the same batches,
    and processes never share one.

    Args:
        problem: the problem with X₀.
        batch_size: initial states in each training batch, per process.
        validation_states: size of the validation batch, which is the same at every validation.
        seed: seed of all random streams.
        steps_per_epoch: training steps that Lightning calls an epoch; a validation follows each.
        lost_share: largest share of a batch that is drawn from `lost` instead of X₀. LostStates finds these states,
            which need more training than others.
    """

    problem: Problem
    batch_size: int
    validation_states: int
    seed: int
    steps_per_epoch: int
    lost_share: float
    lost: State

    def __init__(
        self,
        problem: Problem,
        batch_size: int = 64,
        validation_states: int = 64,
        seed: int = 0,
        steps_per_epoch: int = 1,
        lost_share: float = 0.0,
    ):
        super().__init__()
        self.problem, self.batch_size = problem, batch_size
        self.validation_states, self.seed, self.steps_per_epoch = validation_states, seed, steps_per_epoch
        self.lost_share, self.lost = lost_share, torch.empty(0, len(problem.initial_states.center))

    def batch(self, step: int, process: int = 0) -> State:
        """The training batch of a step in a process."""
        x0 = self.problem.initial_states.sample(self.batch_size, stream(self.seed, TRAINING, process, step))
        drawn = torch.randperm(len(self.lost), generator=stream(self.seed, LOST, step, process))
        lost = self.lost[drawn[: int(self.lost_share * self.batch_size)]]
        return torch.cat([x0[len(lost) :], lost.to(x0)])

    def further(self, count: int, step: int) -> State:
        """States of X₀ that are in no batch, drawn anew at each step; shape (count, n), or (E, count, n)."""
        return self.problem.initial_states.sample(count, stream(self.seed, LOST, step))

    def train_dataloader(self) -> DataLoader[Tensor]:
        return DataLoader(_Epoch(self), batch_size=None)

    def validation_batch(self) -> State:
        """The validation states."""
        return self.problem.initial_states.sample(self.validation_states, stream(self.seed, VALIDATION))

    def val_dataloader(self) -> DataLoader[Tensor]:
        return DataLoader([self.validation_batch()], batch_size=None)  # pyright: ignore[reportArgumentType]

    def position(self) -> int:
        """The step of the next batch."""
        return self.trainer.global_step if self.trainer else 0

    @property
    def of_each(self) -> Sequence["InitialStateDataModule"]:
        """The data module of each seed."""
        return [self]

    def state_dict(self) -> dict[str, Any]:
        """The seed, the step of the next batch, and the lost states of each seed."""
        return {"seed": self.seed, "step": self.position(), "lost": [each.lost for each in self.of_each]}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        if state_dict["seed"] != self.seed:
            raise CheckpointError(
                f"Expected to resume the stream of seed {state_dict['seed']}, got seed {self.seed}; "
                "keep the seed, or start a new run with --finetune."
            )
        if "lost" in state_dict:  # since version 0.3
            for each, lost in zip(self.of_each, state_dict["lost"], strict=True):
                each.lost = lost


class EnsembleDataModule(InitialStateDataModule):
    """Batches (E, b, n): for each of the seeds seed, seed + 1, … the batch of a run with only that seed.

    Args:
        seeds: E, the number of seeds.
    """

    def __init__(
        self,
        problem: Problem,
        batch_size: int,
        validation_states: int,
        seed: int,
        seeds: int,
        lost_share: float = 0.0,
    ):
        super().__init__(problem, batch_size, validation_states, seed)
        self.members = [
            InitialStateDataModule(problem, batch_size, validation_states, seed + k, lost_share=lost_share)
            for k in range(seeds)
        ]

    @property
    def of_each(self) -> Sequence[InitialStateDataModule]:
        return self.members

    def batch(self, step: int, process: int = 0) -> Tensor:
        return torch.stack([member.batch(step, process) for member in self.members])

    def further(self, count: int, step: int) -> Tensor:
        return torch.stack([member.further(count, step) for member in self.members])

    def validation_batch(self) -> Tensor:
        return torch.stack([member.validation_batch() for member in self.members])


class _Epoch(Dataset[Tensor]):
    """The batches of the current epoch."""

    def __init__(self, states: InitialStateDataModule):
        self.states = states

    def __len__(self) -> int:
        return self.states.steps_per_epoch

    def __getitem__(self, index: int) -> Tensor:
        states = self.states
        first = states.position() // states.steps_per_epoch * states.steps_per_epoch
        return states.batch(first + index, states.trainer.global_rank if states.trainer else 0)
