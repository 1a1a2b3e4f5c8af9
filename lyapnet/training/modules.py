"""The LightningModules: ValueModule trains one V, EnsembleModule several seeds.

The losses are in programs/; progress, logs and checkpoints are in callbacks.
"""

import math
import re
from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import lightning as L
import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO
from torch import Tensor, nn

from lyapnet import __version__
from lyapnet.base.errors import CheckpointError, DivergenceError, UsageError
from lyapnet.base.random_streams import POINTS, TRAINING, VALIDATION
from lyapnet.experiment.checkpoint import KEY, read_checkpoint, write_checkpoint
from lyapnet.loop.programs import PointwiseCondition, Program
from lyapnet.loop.random_plants import RandomPlants
from lyapnet.loop.rollout import ADAPTIVE_METHODS, Rollout
from lyapnet.task.cost import PenaltyCost
from lyapnet.task.problem import Problem
from lyapnet.training.checkpoint_files import CheckpointFiles
from lyapnet.training.curves import ScalarLogger, Stopwatch
from lyapnet.training.learner import Learner
from lyapnet.training.optimizer import OptimizerOptions
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.policy import HJBPolicy, known_law

T = TypeVar("T")


class TrainingModule(L.LightningModule):
    """Minimises the sum of its members' losses; each member has its own weights and initial states."""

    def __init__(self, members: Sequence[Learner], optimizer: OptimizerOptions):
        super().__init__()
        self.members: Sequence[Learner] = nn.ModuleList(members)  # pyright: ignore
        self.optimizer_options = optimizer
        self.rate_share: float = 1.0  # factor of the scheduled learning rate; below 1 after a divergence
        self.metadata: dict[str, Any] = {}  # plain data for checkpoints, such as the config

    @abstractmethod
    def states_of_each(self, x0: Tensor) -> Iterable[Tensor]:
        """The initial states (b, n) of each member."""

    @abstractmethod
    def save_member(self, member: Learner, path: Path) -> None:
        """Write a checkpoint that `lyapnet.load` reads like one of a run of this member alone."""

    def compile_for(self, batch_size: int) -> None:
        """Compile the closed loop for batches of this size; members share the code. See DiscreteAdjoint.compile."""
        _compile_alike([member.rollout for member in self.members], batch_size)
        _compile_alike([member.plants.rollout for member in self.members if member.plants is not None], batch_size)

    def training_step(self, x0: Tensor, batch_idx: int) -> dict[str, Tensor]:
        """The sum of the losses on their initial states of all members that still train."""
        draw = (POINTS, self.global_rank, self.global_step)

        def train(member: Learner, states: Tensor) -> Tensor | None:
            if self.has_ended(member, self.global_step):
                member.output = None
                return None
            return member.train_on(member.roll_out(states, TRAINING, *draw[1:]), draw)

        return {"loss": torch.stack([loss for loss in self._for_each(x0, train) if loss is not None]).sum()}

    def validation_step(self, x0: Tensor, batch_idx: int) -> None:
        """Fill the tables of the validation states and log the losses that choose the best checkpoints."""
        for member, loss in zip(self.members, self.validate_on(x0), strict=True):
            self.log(labelled("loss/val", member.label), loss, logger=False, sync_dist=True)

    def validate_on(self, x0: Tensor) -> list[Tensor]:
        """Fill each member's table `validation` and return the validation losses.

        The validation states are always the same: a member is no longer measured once its training has ended.
        """

        def validate(member: Learner, states: Tensor) -> Tensor:
            if self.has_ended(member, member.measured_at):
                return states.new_tensor(member.validation_loss)
            member.measured_at = self.global_step
            return member.measure_on(member.roll_out(states, VALIDATION))

        return self.without_gradient(x0, validate)

    def has_ended(self, member: Learner, step: int) -> bool:
        """Whether a member's training has ended before a step; no for processes that train together, which wait for a
        gradient of each member.
        """
        return member.cooling is not None and step > member.cooling[1] and self.trainer.world_size == 1

    def without_gradient(self, x0: Tensor, evaluate: Callable[[Learner, Tensor], T]) -> list[T]:
        """Evaluate each member on its initial states without recording a gradient."""
        with torch.inference_mode(False), torch.no_grad():  # V_x needs gradients, which inference mode forbids
            return self._for_each(x0.clone(), evaluate)

    def _for_each(self, x0: Tensor, evaluate: Callable[[Learner, Tensor], T]) -> list[T]:
        """Evaluate each member on its initial states; adds iteration and member to the message of a divergence."""
        results = []
        for member, states in zip(self.members, self.states_of_each(x0), strict=True):
            try:
                results.append(evaluate(member, states))
            except DivergenceError as error:
                raise DivergenceError(f"{self.place(member.label)}: {error}") from error
        return results

    def place(self, label: str) -> str:
        """Iteration and member, for messages."""
        return f"Iteration {self.global_step}" + (f", {label.replace('_', ' ')}" if label else "")

    def backward(self, loss: Tensor, *args: Any, **kwargs: Any) -> None:
        """Lightning's backward pass; reports an adaptive solver that does not reach t = 0 as a divergence."""
        try:
            super().backward(loss, *args, **kwargs)
        except AssertionError as error:
            if self.members[0].rollout.method not in ADAPTIVE_METHODS:
                raise
            raise DivergenceError(
                f"{self.place('')}: Expected the adjoint to reach t = 0, got {error}; lower "
                "training.learning_rate, or take rollout.gradient=backprop."
            ) from error

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Record the norm of each member's gradient; raise DivergenceError if it is not finite."""
        for member in self.members:
            norms = [p.grad.norm() for p in member.V.parameters() if p.grad is not None]
            if not norms:  # its training has ended
                continue
            member.gradient_norm = float(torch.stack(norms).norm())
            if not math.isfinite(member.gradient_norm):
                raise DivergenceError(
                    f"{self.place(member.label)}: Expected a finite gradient, got norm {member.gradient_norm}; lower "
                    "training.learning_rate or set trainer.gradient_clip_val."
                )

    def configure_optimizers(self) -> dict[str, Any]:
        """One optimizer with a parameter group, and so a learning rate, for each member."""
        options = self.optimizer_options
        optimizer = options.optimizer([{"params": [*member.V.parameters()]} for member in self.members])
        iterations = options.iterations or self.trainer.estimated_stepping_batches

        def rate_of(member: Learner) -> Callable[[int], float]:
            return lambda step: self.rate_share * member.rate_share * options.rate(step, iterations, member.cooling)

        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, [rate_of(member) for member in self.members])
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def configure_callbacks(self) -> list[L.Callback]:
        """Add the callbacks for curves, unless the trainer already has them."""
        present = {type(callback) for callback in self.trainer.callbacks}  # pyright: ignore
        stopwatch = Stopwatch()
        return [c for c in (stopwatch, ScalarLogger(stopwatch)) if type(c) not in present]

    def setup(self, stage: str) -> None:
        """Make the trainer write checkpoints with a digest, unless it has its own checkpoint plugin."""
        if type(self.trainer.strategy.checkpoint_io) is TorchCheckpointIO:
            self.trainer.strategy.checkpoint_io = CheckpointFiles()

    @property
    def penalty(self) -> PenaltyCost | None:
        """The cost with the constraint penalty; None if the problem has no constraints."""
        cost = self.members[0].problem.cost
        return cost if isinstance(cost, PenaltyCost) else None

    def _state(self) -> dict[str, Any]:
        """The state of the training in a checkpoint besides the weights."""
        state = {"version": __version__, "rate_share": self.rate_share}
        return state if self.penalty is None else {**state, "penalty": float(self.penalty.weight)}

    @classmethod
    def load_from_checkpoint(cls, checkpoint_path: str | Path, *args: Any, **kwargs: Any) -> Any:
        """Lightning's method; verifies the digest first and executes no code of the file.

        Raises:
            LyapnetError: as read_checkpoint.
        """
        read_checkpoint(checkpoint_path)
        return super().load_from_checkpoint(checkpoint_path, *args, **{"weights_only": True, **kwargs})

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the plain data that `lyapnet.load` needs, and the factor of the learning rate."""
        checkpoint[KEY] = {**self.metadata, **self._state()}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restore the penalty weight and the smaller of both learning rate factors, the stored and the current one."""
        self._split_parameter_groups(checkpoint)
        if self.penalty is not None:
            self.penalty.weight.fill_(checkpoint.get(KEY, {}).get("penalty", 0.0))
        stored = checkpoint.get(KEY, {}).get("rate_share", 1.0)
        self.rate_share = min(self.rate_share, stored)
        for state in checkpoint.get("optimizer_states", []):
            for group in state["param_groups"]:
                group["lr"] *= self.rate_share / stored

    def _split_parameter_groups(self, checkpoint: dict[str, Any]) -> None:
        """Split the common parameter group of version 0.3 into one group for each member."""
        counts = [len([*member.V.parameters()]) for member in self.members]
        for state in checkpoint.get("optimizer_states", []):
            if len(state["param_groups"]) == 1:
                (group,) = state["param_groups"]
                own = torch.tensor(group["params"]).split(counts)
                state["param_groups"] = [{**group, "params": each.tolist()} for each in own]
        for state in checkpoint.get("lr_schedulers", []):
            for key in ("base_lrs", "_last_lr", "lr_lambdas"):
                if len(state.get(key, ())) == 1:
                    state[key] = state[key] * len(counts)

    # A checkpoint holds each weight once, under its name since version 0.1.

    def state_dict(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        own = super().state_dict(*args, **kwargs)
        return {self._stored_name(key): tensor for key, tensor in own.items() if not _is_alias(key)}

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False) -> Any:
        for member in self.members:  # of other weights, after a divergence
            member.measured_at = -1
        wanted = {key: self._stored_name(key) for key in super().state_dict() if not _is_alias(key)}
        missing = [name for name in wanted.values() if name not in state_dict]
        if strict and missing:
            raise CheckpointError(f"Expected weights {', '.join(missing[:6])}, got none; use the same network.")
        further = [name for name in state_dict if name not in wanted.values() and "closed_loop." not in name]
        if strict and further:  # version 0.1 stored V under closed_loop too
            raise CheckpointError(f"Expected no weights {', '.join(further[:6])}, got some; use the same network.")
        known = {key: state_dict[name] for key, name in wanted.items() if name in state_dict}
        return super().load_state_dict(known, strict=False, assign=assign)

    def _stored_name(self, key: str) -> str:
        """The name of a weight in checkpoints."""
        return key


def _compile_alike(rollouts: Sequence[Rollout], batch_size: int) -> None:
    """Compile some closed loops of one problem for batches of this size; they share the code."""
    loops = [rollout.discrete for rollout in rollouts if rollout.discrete is not None]
    if not loops:
        return
    first, *others = loops
    X0 = rollouts[0].problem.initial_states
    # not at the centre, which may be a goal, where V is only rounding and compiled code may round differently
    first.compile(((X0.center + X0.upper) / 2).expand(batch_size, -1).contiguous())
    for loop in others:
        if not loop.share_code(first, X0.sample(batch_size, torch.Generator().manual_seed(0))):
            loop.compile_like(first)


def _is_alias(key: str) -> bool:
    """Whether the key is a second name of a weight of V, by way of the closed loop."""
    return re.match(r"members\.\d+\.(rollout|plants)\.", key) is not None


class ValueModule(TrainingModule):
    """Minimises a program over the weights of V, through the closed loop of V's own policy.

        lightning.Trainer(max_epochs=300).fit(ValueModule(problem, V, ValueProgram()), InitialStateDataModule(problem))

    Args:
        problem: the optimal control problem.
        V: the network that is trained.
        program: the loss: a ValueProgram makes V the cost-to-go of its greedy policy, a LyapunovProgram makes V
            decrease along the closed loop at least as fast as the cost accrues.
        rollout: the closed loop of a policy that V defines; None: the closed loop of the law that V was made for, or of
            the HJB law if that is unknown, with its exact gradient. V remembers this law.
        pointwise: the program's condition at points off the closed loops, if it is a term of the loss.
        optimizer: the options of the optimizer.
        seed: seed of these points.
        plants: the plants of the closed loops, if they differ from the model.

    Raises:
        UsageError: f, g, the cost or V break their contracts.
    """

    def __init__(
        self,
        problem: Problem,
        V: ValueFunction,
        program: Program,
        rollout: Rollout | None = None,
        pointwise: PointwiseCondition | None = None,
        optimizer: OptimizerOptions | None = None,
        seed: int = 0,
        plants: RandomPlants | None = None,
    ):
        problem.check()
        if not any(p.is_floating_point() for p in V.parameters()):
            raise UsageError(f"Expected a network with real weights to train, got {type(V).__name__} without.")
        problem.check_value_function(V)
        law = known_law(problem, V) or HJBPolicy
        rollout = Rollout(problem, law(problem, V), gradient="discrete") if rollout is None else rollout
        member = Learner(problem, V, rollout, program, pointwise, seed, plants=plants)
        super().__init__([member], optimizer or OptimizerOptions())

    @property
    def problem(self) -> Problem:
        """The optimal control problem."""
        return self.members[0].problem

    @property
    def V(self) -> ValueFunction:
        """The network that is trained."""
        return self.members[0].V

    @property
    def rollout(self) -> Rollout:
        """The closed loop."""
        return self.members[0].rollout

    @property
    def program(self) -> Program:
        """The loss."""
        return self.members[0].program

    def states_of_each(self, x0: Tensor) -> Iterable[Tensor]:
        return (x0,)

    def save_member(self, member: Learner, path: Path) -> None:
        self.trainer.save_checkpoint(path)

    def _stored_name(self, key: str) -> str:
        return key.removeprefix("members.0.")


class EnsembleModule(TrainingModule):
    """Trains several seeds side by side, each exactly as in a run of that seed alone.

    Args:
        members: learners of one problem, with networks of one shape.
        optimizer: the options of the optimizer.
    """

    def __init__(self, members: Sequence[Learner], optimizer: OptimizerOptions | None = None):
        super().__init__(members, optimizer or OptimizerOptions())

    def states_of_each(self, x0: Tensor) -> Iterable[Tensor]:
        return x0.unbind()

    def save_member(self, member: Learner, path: Path) -> None:
        weights = {f"V.{name}": tensor for name, tensor in member.V.state_dict().items()}
        kept = {**member.metadata, **self._state()}
        write_checkpoint({"state_dict": weights, "global_step": self.global_step, KEY: kept}, path)

    def configure_gradient_clipping(
        self,
        optimizer: torch.optim.Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clip the gradient of each member separately, as in a run of its own."""
        by_value = gradient_clip_algorithm == "value"  # Lightning's GradClipAlgorithmType is a string enumeration
        clip = nn.utils.clip_grad_value_ if by_value else nn.utils.clip_grad_norm_
        if gradient_clip_val and gradient_clip_val > 0:
            for member in self.members:
                clip(member.V.parameters(), gradient_clip_val)


def labelled(name: str, label: str) -> str:
    """The name of a quantity of one member: name/label, or the name alone without a label."""
    return f"{name}/{label}" if label else name
