"""The callback that compiles the closed loop and its gradient to machine code."""

import time
from collections.abc import Callable
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer

from lyapnet.base.errors import CompilationError, UntraceableError
from lyapnet.graphs.number_kernel.assembly import is_built
from lyapnet.training.stage_messages import StageMessages, StageReport


class Compilation(Callback):
    """Compiles the closed loop and its gradient to machine code, and reports if that is not possible.

    Args:
        stages: shows progress and messages.
        batch_size: initial states in a training batch.
        record: called with the facts that the run is compiled and how many seconds it took.
    """

    def __init__(self, stages: StageMessages, batch_size: int, record: Callable[..., None]):
        self.stages, self.batch_size, self.record = stages, batch_size, record
        self._compiled_on: str | None = None  # type of the device, such as "cpu"

    def before_start(self, trainer: Trainer, pl_module: LightningModule, report: StageReport) -> None:
        """Compile for the search of the initial V, which always runs on the CPU."""
        self._compile(trainer, pl_module, report)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self._compiled_on != pl_module.device.type:
            self._compile(trainer, pl_module, self.stages)

    def _compile(self, trainer: Trainer, pl_module: LightningModule, report: StageReport) -> None:
        module: Any = pl_module
        self._compiled_on = module.device.type
        started = time.perf_counter()
        if trainer.is_global_zero:
            fresh = (
                "" if is_built(torch.get_default_dtype()) else " and compiling lyapnet's kernel, once for this machine"
            )
            report(f"tracing the closed loop and its gradient{fresh}")
        try:
            module.compile_for(self.batch_size)
        except UntraceableError:  # compile_for has logged the reason; the loop runs uncompiled
            return
        except CompilationError as error:
            if trainer.is_global_zero:
                self.stages.console.print(f"{error}; running without compilation.", soft_wrap=True)
            return
        if trainer.is_global_zero and self._compiled_on == trainer.strategy.root_device.type:
            self.record(compiled=True, compilation_seconds=round(time.perf_counter() - started, 2))
