"""The callback that compiles a closed loop before its first step, and when that pays."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer

from lyapnet.config import Config
from lyapnet.errors import CompilationError, UntraceableError
from lyapnet.graphs.compilation import cache_folder, has_compiler
from lyapnet.horizon import TABLEAUX
from lyapnet.policy import POLICIES
from lyapnet.training.compiling_ahead import CompilingAhead
from lyapnet.training.stages import Stages


class Compilation(Callback):
    """Compiles the closed loop and its gradient before the first step, where that pays, and says so.

    Args:
        stages: where it is said.
        batch_size: initial states in a training batch.
        wanted: whether to compile in any case; else only what is on disk already.
        record: takes down that the run is compiled, and in how many seconds.
    """

    def __init__(self, stages: Stages, batch_size: int, wanted: bool, record: Callable[..., None]):
        self.stages, self.batch_size, self.wanted, self.record = stages, batch_size, wanted, record
        self._ahead: CompilingAhead | None = None

    @contextmanager
    def ahead(self, module: LightningModule) -> Iterator[None]:
        """Compile beside what is done before the first step, in a process that ends with it."""
        self._ahead = CompilingAhead(module, self.batch_size) if self.wanted and has_compiler() else None
        try:
            yield
        finally:
            if self._ahead is not None:
                self._ahead.stop()

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        module: Any = pl_module
        try:
            on_disk = module.compiled_before(self.batch_size)
            if on_disk or self.wanted:
                self._compile(trainer, module, on_disk)
        except UntraceableError:  # which says so itself, where it runs as it is written
            return
        except CompilationError as error:
            self._say(trainer, f"{error}; running without compilation.")

    def _compile(self, trainer: Trainer, module: Any, on_disk: bool) -> None:
        started = time.perf_counter()
        if not on_disk and has_compiler():
            self._say(trainer, "compiling the closed loop and its gradient, once for this task and machine …")
        if trainer.is_global_zero:
            self.stages("compiling or loading machine code")
        if self._ahead is not None and not on_disk:
            self._ahead.wait()
        module.compile_for(self.batch_size)
        verb, seconds = "loaded" if on_disk else "compiled", time.perf_counter() - started
        beside = " besides the time in which the start was sought" if self._ahead is not None and not on_disk else ""
        self._say(trainer, f"{verb} machine code in {seconds:.0f} s{beside}, kept in {cache_folder()}")
        if trainer.is_global_zero:
            self.record(compiled=True, compilation_seconds=round(seconds, 2))

    def _say(self, trainer: Trainer, line: str) -> None:
        if trainer.is_global_zero:
            self.stages.console.print(line, soft_wrap=True)


def earns_compilation(config: Config) -> bool:
    """Whether a run is long enough to earn its compilation back.

    By measurement on the standard recipe and one CPU core, compiling takes about 45 s and then saves 1 ms at each
    stage of each step at which the law is asked, and 20 µs more for each state.
    """
    held = POLICIES[config.rollout.policy].held
    states, stages = config.training.batch_size * config.seeds, 1 if held else len(TABLEAUX[config.rollout.method].b)
    return config.training.iterations * config.horizon.steps * stages * (1e-3 + 2e-5 * states) > 45
