"""Compiled closed loops of expansions and line searches, and compiled derivatives of steps."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from lyapnet.base.linear_algebra import apply
from lyapnet.base.threads import in_threads
from lyapnet.base.types import Control, ControlPath, PerState, State, StatePath
from lyapnet.graphs.agreement import THIRD, are_close
from lyapnet.graphs.number_kernel.kernel import NumberKernel, ScanKernel, kernel_or_none
from lyapnet.graphs.scan import Scan
from lyapnet.graphs.stateless import state_of, stateless
from lyapnet.graphs.tracing import cut, trace
from lyapnet.task.problem import Problem
from lyapnet.value.derivatives import StepDerivatives
from lyapnet.value.expansions.laws import Expansion, held_control
from lyapnet.value.expansions.paths import Path

LOOPS_PER_CALL, ROWS_PER_CALL = 16, 512  # closed loops, and rows of derivatives, in one call of a program
Kernel = NumberKernel | ScanKernel


class StepPrograms(StepDerivatives):
    """The compiled steps of a problem and their derivatives for differential dynamic programming, any batch size.

    Torch runs functions that cannot be traced or use operations that the kernel lacks, with the same result. Programs
    are compiled once for a problem and its copies. They read the problem's tensors at each call, but other numbers are
    those of the time of tracing; `agrees` checks them.

    Args:
        problem: in float64, on the CPU.
        step_sizes: α of the line search.
    """

    def __init__(self, problem: Problem, step_sizes: Sequence[float]):
        super().__init__(problem.smooth_step, problem.system.n)
        self.problem = problem
        self._search = _SearchStep(problem, step_sizes)
        self._first = _FunctionOfProblem(problem, super().first)
        self._curvature = _FunctionOfProblem(problem, super().curvature)
        self._facts = self._cache_key()

    def search(self, x: StatePath, u: ControlPath, k: ControlPath, K: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Closed loops from x̄_0 (b, n) under u = ū + αk + K(x − x̄), projected onto U, for each step size α.

        Args:
            x, u: x̄ (N + 1, b, n) and ū (N, b, m).
            k, K: (N, b, m) and (N, b, m, n).

        Returns:
            x (N + 1, sizes, b, n), u (N, sizes, b, m), and ∫ℓ over the horizon (sizes, b).
        """
        start = _append_zero_cost(x[0]).expand(len(self._search.step_sizes), -1, -1)
        return self._run_loops("search", self._search, [x[:-1], u, k, K], start)

    def follow(self, expansion: Expansion, u: ControlPath, x0: State) -> tuple[StatePath, ControlPath, PerState]:
        """Closed loops (x, u, ∫ℓ) from x₀ (b, n), each under the held controls for V from its own expansion.

        Args:
            u: ū (N, b, m), near which the controls of a system that is not control-affine are searched for.
        """
        columns = [expansion.x[1:], expansion.gradient[1:], expansion.hessian[1:], u]
        return self._run_loops("follow", _FollowStep(self.problem), columns, _append_zero_cost(x0))

    def first(self, z: Tensor) -> list[Tensor]:
        return self._in_slices("first", self._first, z)

    def curvature(self, z: Tensor, p: State) -> Tensor:
        (bends,) = self._in_slices("curvature", self._curvature, z, p)
        return bends

    def agrees(self, path: Path) -> bool:
        """Whether finite paths have the steps and costs of the current problem, up to a third of the digits."""
        finite = path.cost.isfinite()
        x, u, cost = path.x[:, finite], path.u[:, finite], path.cost[finite]
        with torch.no_grad():
            following, paid = self.problem.step(x[:-1], u)
            total = paid.sum(0) + self.problem.cost.terminal(x[-1])
        return are_close(x[1:], following, THIRD) and are_close(cost, total, THIRD)

    def forget(self) -> bool:
        """Discard all programs of the problem and its copies; torch runs these functions from now on.

        Returns:
            Whether there were any programs.
        """
        known = self.problem.findings.programs
        some = any(program is not None for program in known.values())
        known.update(dict.fromkeys(known))
        return some

    def _run_loops(
        self, name: str, step: nn.Module, columns: list[Tensor], start: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """(x, u, ∫ℓ) of N steps (columns at time n, y) ↦ (y', y', u), with columns (N, b, …) and y (…, b, n + 1)."""

        def slice_of(rows: Tensor) -> list[Tensor]:
            return [
                *(_padded_rows(each, rows, 1, LOOPS_PER_CALL) for each in columns),
                _padded_rows(start, rows, -2, LOOPS_PER_CALL),
            ]

        b, one = start.shape[-2], slice_of(torch.arange(min(LOOPS_PER_CALL, start.shape[-2])))
        kernel = self._kernel(name, lambda: _scan_kernel(step, one))
        if kernel is None:
            y, u = Scan(lambda: (), step, 0).loop(*columns, start)
        else:
            state = state_of(step)
            parts = in_threads(lambda rows: kernel(*state, *slice_of(rows)), torch.arange(b).split(LOOPS_PER_CALL))
            y, u = (torch.cat(parts, -2)[..., :b, :] for parts in zip(*parts, strict=True))
        return torch.cat([start[None, ..., :-1], y[..., :-1]]), u, y[-1, ..., -1]

    def _in_slices(self, name: str, module: "_FunctionOfProblem", *columns: Tensor) -> list[Tensor]:
        """Apply a function of rows to all rows of some columns, in slices."""
        slices = [
            [_padded_rows(column, rows, 0, ROWS_PER_CALL) for column in columns]
            for rows in torch.arange(len(columns[0])).split(ROWS_PER_CALL)
        ]
        state = state_of(module)
        examples = [*state, *slices[0]]
        kernel = self._kernel(name, lambda: NumberKernel(trace(stateless(module), examples, whole=True), examples))
        if kernel is None:
            parts = [module(*arguments) for arguments in slices]
        else:
            parts = in_threads(lambda arguments: kernel(*state, *arguments), slices)
        return [torch.cat(results)[: len(columns[0])] for results in zip(*parts, strict=True)]

    def _kernel(self, name: str, write: Callable[[], Kernel]) -> Kernel | None:
        known, key = self.problem.findings.programs, (name, *self._facts)
        if key not in known:
            known[key] = kernel_or_none(write)
        return known[key]

    def _cache_key(self) -> tuple[Any, ...]:
        """The key of the programs: problems with the same findings may differ in horizon and controls.

        Programs run any number of steps.
        """
        controls, m, horizon = self.problem.controls, self.problem.system.m, self.problem.horizon
        sizes = torch.tensor([0.1, 1.0, 10.0, 1e4], dtype=torch.float64)
        tried = sizes[:, None, None] * torch.randn(4, 4, m, generator=torch.Generator().manual_seed(0)).double()
        shapes = tuple(tensor.shape for tensor in state_of(self.problem))
        kept = tuple(controls.project(tried).flatten().tolist())
        return horizon.dt, horizon.method, type(controls), kept, self._search.step_sizes, shapes


class _SearchStep(nn.Module):
    """(x̄, ū, k, K, y) ↦ (y', y', u), y = (x, ∫ℓ): one step under u = ū + αk + K(x − x̄), projected onto U."""

    def __init__(self, problem: Problem, step_sizes: Sequence[float]):
        super().__init__()
        self.problem, self.step_sizes = problem, tuple(step_sizes)
        self.alpha = torch.tensor(step_sizes, dtype=torch.float64)[:, None, None]

    @torch.no_grad()
    def forward(self, along: Tensor, u: Tensor, k: Tensor, K: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Control]:
        x = y[..., :-1]
        u = self.problem.controls.project(u + self.alpha * k + apply(K, x - along))
        return _advance(self.problem, y, u)


class _FollowStep(nn.Module):
    """(x̄', p', H', ū, y) ↦ (y', y', u), y = (x, ∫ℓ): one step under the held control for V' from an expansion."""

    def __init__(self, problem: Problem):
        super().__init__()
        self.problem = problem

    @torch.no_grad()
    def forward(self, center: State, p: State, H: Tensor, near: Control, y: Tensor) -> tuple[Tensor, Tensor, Control]:
        x = y[..., :-1]
        free = self.problem.response(x)
        u = held_control(self.problem, x, free, p + apply(H, free.x - center), H, near)
        return _advance(self.problem, y, u)


class _FunctionOfProblem(nn.Module):
    """A function of tensors that depends on a problem."""

    def __init__(self, problem: Problem, function: Callable[..., Any]):
        super().__init__()
        self.problem, self.function = problem, function

    def forward(self, *arguments: Tensor) -> tuple[Tensor, ...]:
        result = self.function(*arguments)
        return (result,) if isinstance(result, Tensor) else tuple(result)


def _advance(problem: Problem, y: Tensor, u: Control) -> tuple[Tensor, Tensor, Control]:
    """(y', y', u) with y' = (x, ∫ℓ) after one step, as the carried state and as the output of a scan."""
    following, paid = problem.step(y[..., :-1], u)
    y = torch.cat([following, y[..., -1:] + paid[..., None]], -1)
    return y, y, u


def _scan_kernel(step: nn.Module, arguments: list[Tensor]) -> ScanKernel:
    """Compile the steps of one slice."""
    *columns, y = arguments
    state, moving = state_of(step), len(columns)
    middle = [column[len(column) // 2] for column in columns]
    graph = trace(stateless(step), [*state, *(column[0] for column in columns), y], [[*middle, y]], whole=True)
    prepare, repeated = cut(graph, late=moving + 1, early_outputs=0, repeat=False)
    return ScanKernel(prepare, repeated, [*state, *arguments], moving)


def _append_zero_cost(x: State) -> Tensor:
    """(x, 0)."""
    return torch.cat([x, torch.zeros_like(x[..., :1])], -1)


def _padded_rows(column: Tensor, rows: Tensor, axis: int, count: int) -> Tensor:
    """Some rows along an axis, with the last one repeated up to the batch size of a program."""
    return column.index_select(axis, torch.cat([rows, rows[-1:].expand(count - len(rows))]))
