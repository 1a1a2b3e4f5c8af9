"""Initial states: a fresh batch of X₀ for every training step, a fixed draw for validation."""

from typing import Any

import lightning as L
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from lyapnet.errors import CheckpointError
from lyapnet.randomness import TRAINING, VALIDATION, stream
from lyapnet.sets import Box
from lyapnet.types import State


class InitialStateDataModule(L.LightningDataModule):
    """Batches (b, n) from X₀.

    The batch of a step is a function of (seed, process, step) alone: a run that resumes at a step draws what it
    would have drawn, whatever was prefetched or lost, and processes never share a batch.

    Args:
        initial_states: X₀.
        batch_size: initial states in each training batch, per process.
        validation_states: size of the one validation batch, the same at every validation.
        seed: of all streams.
    """

    def __init__(self, initial_states: Box, batch_size: int, validation_states: int, seed: int):
        super().__init__()
        self.initial_states, self.batch_size = initial_states, batch_size
        self.validation_states, self.seed = validation_states, seed

    def batch(self, step: int, process: int = 0) -> State:
        """The training batch of a step in a process."""
        return self.initial_states.sample(self.batch_size, stream(self.seed, TRAINING, process, step))

    def train_dataloader(self) -> DataLoader:
        return DataLoader(_CurrentBatch(self), batch_size=None)

    def validation_batch(self) -> State:
        """The states of every validation."""
        return self.initial_states.sample(self.validation_states, stream(self.seed, VALIDATION))

    def val_dataloader(self) -> DataLoader:
        return DataLoader([self.validation_batch()], batch_size=None)  # pyright: ignore[reportArgumentType]

    def position(self) -> int:
        """The step whose batch comes next."""
        return self.trainer.global_step if self.trainer else 0

    def state_dict(self) -> dict[str, Any]:
        """The position of the training stream: its seed and the step whose batch comes next."""
        return {"seed": self.seed, "step": self.position()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        if state_dict["seed"] != self.seed:
            raise CheckpointError(
                f"Expected to resume the stream of seed {state_dict['seed']}, got seed {self.seed}; "
                "keep the seed, or start a new run with --finetune."
            )


class EnsembleDataModule(InitialStateDataModule):
    """Batches (E, b, n): for each of the seeds seed, seed + 1, … what its run alone would draw.

    Args:
        seeds: E.
    """

    def __init__(self, initial_states: Box, batch_size: int, validation_states: int, seed: int, seeds: int):
        super().__init__(initial_states, batch_size, validation_states, seed)
        self.members = [
            InitialStateDataModule(initial_states, batch_size, validation_states, seed + k) for k in range(seeds)
        ]

    def batch(self, step: int, process: int = 0) -> Tensor:
        return torch.stack([member.batch(step, process) for member in self.members])

    def validation_batch(self) -> Tensor:
        return torch.stack([member.validation_batch() for member in self.members])


class _CurrentBatch(Dataset):
    """A dataset of one element: the batch of the current step. An epoch is one step, since no state is seen twice."""

    def __init__(self, states: InitialStateDataModule):
        self.states = states

    def __len__(self) -> int:
        return 1

    def __getitem__(self, index: int) -> Tensor:
        process = self.states.trainer.global_rank if self.states.trainer else 0
        return self.states.batch(self.states.position(), process)
