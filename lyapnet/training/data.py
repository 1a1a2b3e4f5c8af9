"""Initial states: a fresh batch of X₀ for every training step, a fixed draw for validation."""

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
    """Batches (b, n) from X₀.

    The batch of a step is a function of (seed, process, step) alone: a run that resumes at a step draws what it
    would have drawn, whatever was prefetched or lost, and processes never share a batch.

    Args:
        problem: whose X₀ is meant.
        batch_size: initial states in each training batch, per process.
        validation_states: size of the one validation batch, the same at every validation.
        seed: of all streams.
        steps_per_epoch: training steps that Lightning calls an epoch, after which it validates. No state is seen twice,
            but those that are lost.
        lost_share: share of a batch, at the most, that is drawn from `lost` instead: states that need more training
            than others, found by LostStates.
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
        """States of X₀ that are in no batch, another draw at each step: (count, n), or (E, count, n)."""
        return self.problem.initial_states.sample(count, stream(self.seed, LOST, step))

    def train_dataloader(self) -> DataLoader[Tensor]:
        return DataLoader(_Epoch(self), batch_size=None)

    def validation_batch(self) -> State:
        """The states of every validation."""
        return self.problem.initial_states.sample(self.validation_states, stream(self.seed, VALIDATION))

    def val_dataloader(self) -> DataLoader[Tensor]:
        return DataLoader([self.validation_batch()], batch_size=None)  # pyright: ignore[reportArgumentType]

    def position(self) -> int:
        """The step whose batch comes next."""
        return self.trainer.global_step if self.trainer else 0

    @property
    def of_each(self) -> Sequence["InitialStateDataModule"]:
        """What draws for each of the seeds."""
        return [self]

    def state_dict(self) -> dict[str, Any]:
        """The position of the training stream, its seed and the step whose batch comes next, and each seed's `lost`."""
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
    """Batches (E, b, n): for each of the seeds seed, seed + 1, … what its run alone would draw.

    Args:
        seeds: E.
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
    """The batches of the steps of an epoch, from the one that comes next."""

    def __init__(self, states: InitialStateDataModule):
        self.states = states

    def __len__(self) -> int:
        return self.states.steps_per_epoch

    def __getitem__(self, index: int) -> Tensor:
        states = self.states
        first = states.position() // states.steps_per_epoch * states.steps_per_epoch
        return states.batch(first + index, states.trainer.global_rank if states.trainer else 0)
