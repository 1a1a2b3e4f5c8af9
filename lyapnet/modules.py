"""The LightningModules: what they compute stands in programs/; what is logged, in callbacks.

A run of one seed is a ProgramModule; several seeds that train as one batch are an EnsembleModule of them.
"""

import math
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import lightning as L
import torch
from torch import Tensor, nn

from lyapnet import __version__
from lyapnet.build import Task, build_pointwise, build_program, build_rollout, build_task, build_value_function
from lyapnet.checkpoint import KEY, write_checkpoint
from lyapnet.config import Config, TrainingConfig, configs_of_seeds, label_of, to_plain
from lyapnet.discrete_adjoint import DiscreteAdjoint
from lyapnet.errors import CompilationError, DivergenceError, UsageError
from lyapnet.evaluation import StateTable, measure
from lyapnet.programs.base import ProgramOutput
from lyapnet.randomness import POINTS, VALIDATION, stream
from lyapnet.rollout import ADAPTIVE_METHODS, Trajectory
from lyapnet.types import PerState, State


class TrainedModule(L.LightningModule):
    """Minimises the sum of its members' losses, each over weights and on initial states of its own.

    What is shown of a member, the member keeps.
    """

    config: Config
    members: Sequence["ProgramModule"]  # what is trained together; a run of one seed is its own and only member
    labels: Sequence[str]  # what tells the members apart, in messages and names of files; "" for the only one

    @abstractmethod
    def trajectories(self, x0: Tensor) -> Iterator[Trajectory]:
        """The members' closed loops from their initial states.

        Raises:
            DivergenceError: when it is the turn of one that is not finite.
        """

    @abstractmethod
    def save_member(self, member: "ProgramModule", path: Path) -> None:
        """Write a checkpoint that `lyapnet.load` takes for that of the member's own run."""

    @abstractmethod
    def compile_for(self, batch_size: int) -> None:
        """Compile the closed loop and its gradient for training batches of this size; see DiscreteAdjoint.compile."""

    @abstractmethod
    def compiled_before(self, batch_size: int) -> bool:
        """Whether `compile_for` would find everything on disk."""

    def training_step(self, x0: Tensor, batch_idx: int) -> dict[str, Tensor]:
        """One evaluation of each member's program on its initial states."""
        draw = (POINTS, self.global_rank, self.global_step)
        losses = self._of_each(x0, lambda member, trajectory: member.train_on(trajectory, draw))
        return {"loss": torch.stack(losses).sum()}

    def validation_step(self, x0: Tensor, batch_idx: int) -> None:
        """The tables of the fixed validation states, and the losses that pick the best checkpoints."""
        for label, loss in zip(self.labels, self.validate_on(x0), strict=True):
            self.log(labelled("loss/val", label), loss, logger=False, sync_dist=True)

    def validate_on(self, x0: Tensor) -> list[Tensor]:
        """Fill each member's `validation` with the table of its states; the programs' losses on them."""
        return self._of_each(x0, ProgramModule.measure_on)

    def _of_each(self, x0: Tensor, evaluate: Callable[["ProgramModule", Trajectory], Tensor]) -> list[Tensor]:
        """What `evaluate` makes of each member's trajectories; a divergence names iteration and member."""
        trajectories, results = self.trajectories(x0), []
        for member, label in zip(self.members, self.labels, strict=True):
            try:
                results.append(evaluate(member, next(trajectories)))
            except DivergenceError as error:
                raise DivergenceError(f"{self._place(label)}: {error}") from error
        return results

    def _place(self, label: str) -> str:
        return f"Iteration {self.global_step}" + (f", {label.replace('_', ' ')}" if label else "")

    def backward(self, loss: Tensor, *args: Any, **kwargs: Any) -> None:
        """Lightning's, which also meets an adaptive adjoint that gives up."""
        try:
            super().backward(loss, *args, **kwargs)
        except AssertionError as error:
            if self.config.rollout.method not in ADAPTIVE_METHODS:
                raise
            raise DivergenceError(
                f"{self._place('')}: Expected the adjoint to reach t = 0, got {error}; lower "
                "training.learning_rate, or take rollout.gradient=backprop."
            ) from error

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Record the norm of each member's gradient; refuse to step along one that is not finite."""
        for member, label in zip(self.members, self.labels, strict=True):
            norms = [p.grad.norm() for p in member.V.parameters() if p.grad is not None]
            member.gradient_norm = float(torch.stack(norms).norm())
            if not math.isfinite(member.gradient_norm):
                raise DivergenceError(
                    f"{self._place(label)}: Expected a finite gradient, got norm {member.gradient_norm}; lower "
                    "training.learning_rate or set trainer.gradient_clip_val."
                )

    def configure_optimizers(self) -> dict[str, Any]:
        """One optimizer for all members: what it does to a weight depends on no other one."""
        options = self.config.training
        classes = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW}
        optimizer = classes[options.optimizer](
            [p for member in self.members for p in member.V.parameters()],
            lr=options.learning_rate,
            betas=(options.beta1, options.beta2),
            weight_decay=options.weight_decay,
        )
        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: cosine_decay(step, options))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add what `lyapnet.load` needs, as plain data."""
        checkpoint[KEY] = {"config": to_plain(self.config), "version": __version__}


class ProgramModule(TrainedModule):
    """Minimises a program over the weights of V, through the closed loop of V's own policy."""

    def __init__(self, config: Config, task: Task):
        super().__init__()
        self.config, self.task = config, task
        self.members, self.labels = [self], [""]
        self.initial_states = task.initial_states  # registered, so that X₀ follows the module from device to device
        self.V = build_value_function(config, task)
        self.closed_loop = build_rollout(config, task, self.V)
        self.program = build_program(config)
        self.pointwise = build_pointwise(config, task, self.V, self.closed_loop.closed_loop)
        self.validation_optimum: PerState | None = None  # J* of the validation states, once someone has asked for it
        # of the last training step and the last validation, for whoever shows them
        self.gradient_norm = self.steps_per_second = math.nan
        self.output: ProgramOutput | None = None
        self.validation: StateTable | None = None

    def trajectories(self, x0: State) -> Iterator[Trajectory]:
        yield self.closed_loop(x0)

    def train_on(self, trajectory: Trajectory, draw: Sequence[int] = (POINTS,)) -> Tensor:
        """The loss of a training batch; its parts are kept in `output`.

        Args:
            draw: names the stream of the points off the closed loops.
        """
        output = self._with_pointwise(self.program(trajectory, mean_over_processes), trajectory, draw)
        terms = {name: term.detach() for name, term in output.terms.items()}
        self.output = ProgramOutput(
            output.loss.detach(), terms, output.constraint_loss.detach(), output.trajectory_cost.detach()
        )
        return output.loss

    def measure_on(self, trajectory: Trajectory) -> Tensor:
        """The loss of the validation states and points; the states' table is kept in `validation`."""
        self.validation = measure(trajectory, self.program, self.validation_optimum)
        return self._with_pointwise(self.program(trajectory), trajectory, (VALIDATION, POINTS)).loss

    def _with_pointwise(self, output: ProgramOutput, trajectory: Trajectory, draw: Sequence[int]) -> ProgramOutput:
        """The program with its condition off the closed loops, where that has a weight."""
        if self.pointwise is None:
            return output
        values, mean_cost = trajectory.require_value(), mean_over_processes(output.trajectory_cost.detach())
        term = self.pointwise(stream(self.config.seed, *draw), mean_cost, values[0].max())
        loss = output.loss + self.config.pointwise.weight * term
        return output._replace(loss=loss, terms={**output.terms, "pointwise": term})

    def save_member(self, member: "ProgramModule", path: Path) -> None:
        self.trainer.save_checkpoint(path)

    def compile_for(self, batch_size: int) -> None:
        if self.closed_loop.discrete is not None:
            self.closed_loop.discrete.compile(self._any_batch(batch_size))

    def compiled_before(self, batch_size: int) -> bool:
        discrete = self.closed_loop.discrete
        return discrete is not None and discrete.is_on_disk(self._any_batch(batch_size))

    def _any_batch(self, batch_size: int) -> State:
        return self.task.initial_states.center.expand(batch_size, -1).contiguous()


class ValueModule(ProgramModule):
    """The value program: V becomes the cost-to-go of its greedy policy."""


class LyapunovModule(ProgramModule):
    """The Lyapunov program: V falls along the closed loop at least as fast as the cost accrues."""


MODULES: dict[str, type[ProgramModule]] = {"value": ValueModule, "lyapunov": LyapunovModule}


class EnsembleModule(TrainedModule):
    """The runs of several seeds as one batch: each equals the run of its seed alone, up to rounding.

    Raises:
        UsageError: the gradient's route has no batch of closed loops; or the members' closed loops differ in more than
            trained weights.
    """

    def __init__(self, config: Config, task: Task):
        super().__init__()
        if config.rollout.gradient != "discrete":
            raise UsageError(
                f"Expected rollout.gradient=discrete for seeds={config.seeds}, got {config.rollout.gradient}; "
                "set it, or train the seeds one by one."
            )
        self.config, self.task = config, task
        runs = [MODULES[config.program.name](one, task) for one in configs_of_seeds(config)]
        self.members: Sequence[ProgramModule] = nn.ModuleList(runs)  # pyright: ignore
        self.labels = [label_of(one.config) for one in runs]
        self._require_one_batch()

    def trajectories(self, x0: Tensor) -> Iterator[Trajectory]:
        return self.members[0].closed_loop.together(x0, self._weights())

    def save_member(self, member: ProgramModule, path: Path) -> None:
        content = {"state_dict": member.state_dict(), "global_step": self.global_step}
        member.on_save_checkpoint(content)
        write_checkpoint(content, path)

    def compile_for(self, batch_size: int) -> None:
        self._discrete(0).compile(self._any_batch(batch_size), self._weights())

    def compiled_before(self, batch_size: int) -> bool:
        return self._discrete(0).is_on_disk(self._any_batch(batch_size), self._weights())

    def configure_gradient_clipping(
        self,
        optimizer: torch.optim.Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Each member's gradient by itself, as in a run of its own."""
        by_value = gradient_clip_algorithm == "value"  # Lightning's enumeration is of strings
        clip = nn.utils.clip_grad_value_ if by_value else nn.utils.clip_grad_norm_
        if gradient_clip_val and gradient_clip_val > 0:
            for member in self.members:
                clip(member.V.parameters(), gradient_clip_val)

    def _weights(self) -> list[Tensor]:
        """The members' trained parameters, (E, *shape) each."""
        trained = [self._discrete(k).trained() for k in range(len(self.members))]
        return [torch.stack(parameters) for parameters in zip(*trained, strict=True)]

    def _discrete(self, k: int) -> DiscreteAdjoint:
        discrete = self.members[k].closed_loop.discrete
        assert discrete is not None
        return discrete

    def _any_batch(self, batch_size: int) -> Tensor:
        return self.task.initial_states.center.expand(len(self.members), batch_size, -1).contiguous()

    def _require_one_batch(self) -> None:
        """Hold the members against what one batch can serve: the same function of their trained weights."""
        remedy = "train the seeds one by one"
        first, *others = [_frozen(member.V) for member in self.members]
        for label, other in zip(self.labels[1:], others, strict=True):
            for name, tensor in first.items():
                if not torch.equal(tensor, other[name]):
                    raise UsageError(
                        f"Expected seeds to differ in trained weights alone, got another {name} in {label}; {remedy}."
                    )
        try:
            self.compiled_before(self.config.training.batch_size)
        except CompilationError as error:
            raise UsageError(f"{error}, for seeds={self.config.seeds}; {remedy}.") from error


def labelled(name: str, label: str) -> str:
    """The name of one member's share of something; the name itself where there is but one."""
    return f"{name}/{label}" if label else name


def build_module(config: Config) -> TrainedModule:
    """What trains a config: one run, or an ensemble.

    Raises:
        UsageError: of build_task and the like, and of EnsembleModule.
    """
    task = build_task(config)
    return EnsembleModule(config, task) if config.seeds > 1 else MODULES[config.program.name](config, task)


def _frozen(module: nn.Module) -> dict[str, Tensor]:
    """What a module is made of besides its trained parameters."""
    untrained = {name: p for name, p in module.named_parameters() if not p.requires_grad}
    return {**untrained, **dict(module.named_buffers())}


def mean_over_processes(value: Tensor) -> Tensor:
    """The mean of a number over the processes that train together; itself where there is one."""
    if not (torch.distributed.is_available() and torch.distributed.is_initialized()):
        return value
    total = value.clone()
    torch.distributed.all_reduce(total)
    return total / torch.distributed.get_world_size()


def cosine_decay(step: int, options: TrainingConfig) -> float:
    """The learning rate at a step, as a share of the first: half a cosine down to `final_learning_rate`."""
    final = options.final_learning_rate / options.learning_rate
    progress = min(step / options.iterations, 1.0)
    return final + (1 - final) * (1 + math.cos(math.pi * progress)) / 2
