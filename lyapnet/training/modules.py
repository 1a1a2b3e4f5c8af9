"""The LightningModules: what they compute stands in programs/; what is shown, logged and saved, in callbacks.

One V is trained by a ValueModule; several seeds, by an EnsembleModule.
"""

import math
import re
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO
from torch import Tensor, nn

from lyapnet import __version__
from lyapnet.base.errors import CheckpointError, DivergenceError, UsageError
from lyapnet.base.random_streams import POINTS
from lyapnet.experiment.checkpoint import KEY, read_checkpoint, write_checkpoint
from lyapnet.loop.programs import PointwiseCondition, Program
from lyapnet.loop.rollout import ADAPTIVE_METHODS, Rollout, Trajectory
from lyapnet.task.cost import PenaltyCost
from lyapnet.task.problem import Problem
from lyapnet.training.checkpoint_files import CheckpointFiles
from lyapnet.training.curves import ScalarLogger, Stopwatch
from lyapnet.training.learner import Learner
from lyapnet.training.optimizer import OptimizerOptions
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.policy import HJBPolicy, known_law


class TrainingModule(L.LightningModule):
    """Minimises the sum of its members' losses, each over weights and on initial states of its own."""

    def __init__(self, members: Sequence[Learner], optimizer: OptimizerOptions):
        super().__init__()
        self.members: Sequence[Learner] = nn.ModuleList(members)  # pyright: ignore
        self.optimizer_options = optimizer
        self.rate_share: float = 1.0  # of the scheduled learning rate; less, once a training had to go back
        self.metadata: dict[str, Any] = {}  # plain data that checkpoints carry: the config, where there is one

    @abstractmethod
    def trajectories(self, x0: Tensor) -> Iterator[Trajectory]:
        """The members' closed loops from their initial states.

        Raises:
            DivergenceError: when it is the turn of one that is not finite.
        """

    @abstractmethod
    def save_member(self, member: Learner, path: Path) -> None:
        """Write a checkpoint that `lyapnet.load` takes for that of the member's own run."""

    def compile_for(self, batch_size: int) -> None:
        """Have training batches of this size run as machine code, which members share; see DiscreteAdjoint.compile."""
        first, *others = [member.rollout.discrete for member in self.members]
        if first is None:
            return
        X0 = self.members[0].problem.initial_states
        first.compile(X0.center.expand(batch_size, -1).contiguous())
        for loop in others:
            if loop is not None and not loop.share_code(first, X0.sample(batch_size, torch.Generator().manual_seed(0))):
                loop.compile_like(first)

    def training_step(self, x0: Tensor, batch_idx: int) -> dict[str, Tensor]:
        """One evaluation of each member's program on its initial states."""
        draw = (POINTS, self.global_rank, self.global_step)
        losses = self._for_each(x0, lambda member, trajectory: member.train_on(trajectory, draw))
        return {"loss": torch.stack(losses).sum()}

    def validation_step(self, x0: Tensor, batch_idx: int) -> None:
        """The tables of the fixed validation states, and the losses that pick the best checkpoints."""
        for member, loss in zip(self.members, self.validate_on(x0), strict=True):
            self.log(labelled("loss/val", member.label), loss, logger=False, sync_dist=True)

    def validate_on(self, x0: Tensor) -> list[Tensor]:
        """Fill each member's `validation` with the table of its states; the programs' losses on them."""
        return self.without_gradient(x0, Learner.measure_on)

    def without_gradient(self, x0: Tensor, evaluate: Callable[[Learner, Trajectory], Tensor]) -> list[Tensor]:
        """What `evaluate` makes of each member's trajectories."""
        with torch.inference_mode(False), torch.no_grad():  # V_x needs gradients, which inference mode forbids
            return self._for_each(x0.clone(), evaluate)

    def _for_each(self, x0: Tensor, evaluate: Callable[[Learner, Trajectory], Tensor]) -> list[Tensor]:
        """What `evaluate` makes of each member's trajectories; a divergence names iteration and member."""
        trajectories, results = self.trajectories(x0), []
        for member in self.members:
            try:
                results.append(evaluate(member, next(trajectories)))
            except DivergenceError as error:
                raise DivergenceError(f"{self.place(member.label)}: {error}") from error
        return results

    def place(self, label: str) -> str:
        """Where a member's training is, for messages."""
        return f"Iteration {self.global_step}" + (f", {label.replace('_', ' ')}" if label else "")

    def backward(self, loss: Tensor, *args: Any, **kwargs: Any) -> None:
        """Lightning's, which also meets an adaptive adjoint that gives up."""
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
        """Record the norm of each member's gradient; refuse to step along one that is not finite."""
        for member in self.members:
            norms = [p.grad.norm() for p in member.V.parameters() if p.grad is not None]
            member.gradient_norm = float(torch.stack(norms).norm())
            if not math.isfinite(member.gradient_norm):
                raise DivergenceError(
                    f"{self.place(member.label)}: Expected a finite gradient, got norm {member.gradient_norm}; lower "
                    "training.learning_rate or set trainer.gradient_clip_val."
                )

    def configure_optimizers(self) -> dict[str, Any]:
        """One optimizer for all members, each with a learning rate of its own."""
        options = self.optimizer_options
        optimizer = options.optimizer([{"params": [*member.V.parameters()]} for member in self.members])
        iterations = options.iterations or self.trainer.estimated_stepping_batches

        def rate_of(member: Learner) -> Callable[[int], float]:
            return lambda step: self.rate_share * options.rate(step, iterations, member.cooling)

        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, [rate_of(member) for member in self.members])
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def configure_callbacks(self) -> list[L.Callback]:
        """The curves, for any trainer; one that has these callbacks keeps its own."""
        present = {type(callback) for callback in self.trainer.callbacks}  # pyright: ignore
        stopwatch = Stopwatch()
        return [c for c in (stopwatch, ScalarLogger(stopwatch)) if type(c) not in present]

    def setup(self, stage: str) -> None:
        """Have any trainer write checkpoints with a digest, and verify it; one with files of its own keeps them."""
        if type(self.trainer.strategy.checkpoint_io) is TorchCheckpointIO:
            self.trainer.strategy.checkpoint_io = CheckpointFiles()

    @property
    def penalty(self) -> PenaltyCost | None:
        """What keeps closed loops off the constraints, where the problem has some."""
        cost = self.members[0].problem.cost
        return cost if isinstance(cost, PenaltyCost) else None

    def _state(self) -> dict[str, Any]:
        """What a checkpoint says of the training besides weights."""
        state = {"version": __version__, "rate_share": self.rate_share}
        return state if self.penalty is None else {**state, "penalty": float(self.penalty.weight)}

    @classmethod
    def load_from_checkpoint(cls, checkpoint_path: str | Path, *args: Any, **kwargs: Any) -> Any:
        """Lightning's, of a file whose digest holds and in which nothing is executed.

        Raises:
            LyapnetError: as read_checkpoint.
        """
        read_checkpoint(checkpoint_path)
        return super().load_from_checkpoint(checkpoint_path, *args, **{"weights_only": True, **kwargs})

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add what `lyapnet.load` needs, as plain data, and the share of the learning rate."""
        checkpoint[KEY] = {**self.metadata, **self._state()}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Go on no faster than the checkpoint's training did, and where this one had to go back, more slowly.

        Constraints have the penalty that they had.
        """
        self._tell_members_apart(checkpoint)
        if self.penalty is not None:
            self.penalty.weight.fill_(checkpoint.get(KEY, {}).get("penalty", 0.0))
        stored = checkpoint.get(KEY, {}).get("rate_share", 1.0)
        self.rate_share = min(self.rate_share, stored)
        for state in checkpoint.get("optimizer_states", []):
            for group in state["param_groups"]:
                group["lr"] *= self.rate_share / stored

    def _tell_members_apart(self, checkpoint: dict[str, Any]) -> None:
        """Give each member a learning rate of its own where they have one for all, as in checkpoints of version 0.3."""
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

    # A checkpoint holds each weight once, under the name that it has had since version 0.1.

    def state_dict(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        own = super().state_dict(*args, **kwargs)
        return {self._stored_name(key): tensor for key, tensor in own.items() if not _is_alias(key)}

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False) -> Any:
        wanted = {key: self._stored_name(key) for key in super().state_dict() if not _is_alias(key)}
        missing = [name for name in wanted.values() if name not in state_dict]
        if strict and missing:
            raise CheckpointError(f"Expected weights {', '.join(missing[:6])}, got none; use the same network.")
        further = [name for name in state_dict if name not in wanted.values() and "closed_loop." not in name]
        if strict and further:  # version 0.1 kept V under closed_loop too
            raise CheckpointError(f"Expected no weights {', '.join(further[:6])}, got some; use the same network.")
        known = {key: state_dict[name] for key, name in wanted.items() if name in state_dict}
        return super().load_state_dict(known, strict=False, assign=assign)

    def _stored_name(self, key: str) -> str:
        """What a weight is called in checkpoints."""
        return key


def _is_alias(key: str) -> bool:
    """Whether it names a weight of V by its place in the closed loop."""
    return re.match(r"members\.\d+\.rollout\.", key) is not None


class ValueModule(TrainingModule):
    """Minimises a program over the weights of V, through the closed loop of V's own policy.

        lightning.Trainer(max_epochs=300).fit(ValueModule(problem, V, ValueProgram()), InitialStateDataModule(problem))

    Args:
        problem: what is to be solved.
        V: what is trained.
        program: what is minimised: a ValueProgram makes V the cost-to-go of its greedy policy, a LyapunovProgram makes
            V fall along the closed loop at least as fast as the cost accrues.
        rollout: the closed loop of a policy that V defines; None: that of the law that V is made for, the HJB law where
            nobody knows, with its exact gradient. V is made for that law from then on.
        pointwise: the program's condition off the closed loops, if that is a term too.
        optimizer: how the weights move.
        seed: of the points at which that condition is asked for.

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
    ):
        problem.check()
        if not any(p.is_floating_point() for p in V.parameters()):
            raise UsageError(f"Expected a network with real weights to train, got {type(V).__name__} without.")
        problem.check_value_function(V)
        law = known_law(problem, V) or HJBPolicy
        rollout = Rollout(problem, law(problem, V), gradient="discrete") if rollout is None else rollout
        member = Learner(problem, V, rollout, program, pointwise, seed)
        super().__init__([member], optimizer or OptimizerOptions())

    @property
    def problem(self) -> Problem:
        """What is to be solved."""
        return self.members[0].problem

    @property
    def V(self) -> ValueFunction:
        """What is trained."""
        return self.members[0].V

    @property
    def rollout(self) -> Rollout:
        """The closed loop."""
        return self.members[0].rollout

    @property
    def program(self) -> Program:
        """What is minimised."""
        return self.members[0].program

    def trajectories(self, x0: Tensor) -> Iterator[Trajectory]:
        yield self.rollout(x0)

    def save_member(self, member: Learner, path: Path) -> None:
        self.trainer.save_checkpoint(path)

    def _stored_name(self, key: str) -> str:
        return key.removeprefix("members.0.")


class EnsembleModule(TrainingModule):
    """Several seeds' runs side by side, each as the run of its seed alone.

    Args:
        members: of one problem, with networks of one shape.
        optimizer: how the weights move.
    """

    def __init__(self, members: Sequence[Learner], optimizer: OptimizerOptions | None = None):
        super().__init__(members, optimizer or OptimizerOptions())

    def trajectories(self, x0: Tensor) -> Iterator[Trajectory]:
        for member, own in zip(self.members, x0, strict=True):
            yield member.rollout(own)

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
        """Each member's gradient by itself, as in a run of its own."""
        by_value = gradient_clip_algorithm == "value"  # Lightning's enumeration is of strings
        clip = nn.utils.clip_grad_value_ if by_value else nn.utils.clip_grad_norm_
        if gradient_clip_val and gradient_clip_val > 0:
            for member in self.members:
                clip(member.V.parameters(), gradient_clip_val)


def labelled(name: str, label: str) -> str:
    """The name of one member's share of something; the name itself where there is but one."""
    return f"{name}/{label}" if label else name
