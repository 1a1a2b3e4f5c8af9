"""Closed loops along expansions and line searches, and derivatives of steps, as programs of lyapnet's kernel."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from lyapnet.base.linear_algebra import apply
from lyapnet.base.types import Control, ControlPath, PerState, State, StatePath
from lyapnet.graphs.agreement import THIRD, are_close
from lyapnet.graphs.number_kernel.kernel import NumberKernel, ScanKernel, in_threads, kernel_or_none
from lyapnet.graphs.scan import Scan
from lyapnet.graphs.stateless import state_of, stateless
from lyapnet.graphs.tracing import cut, trace
from lyapnet.task.problem import Problem
from lyapnet.value.derivatives import StepDerivatives
from lyapnet.value.expansions.laws import Expansion, held_control
from lyapnet.value.expansions.paths import Path

TRAJECTORIES, ROWS = 16, 512  # in one call of a program: of closed loops, and of derivatives
Kernel = NumberKernel | ScanKernel


class StepPrograms(StepDerivatives):
    """What differential dynamic programming asks of the steps of a problem, for batches of any size.

    What cannot be traced, or has an operation that the kernel lacks, is run by torch, to the same result. Programs are
    written once for a problem and its copies; the tensors that a problem is made of are read at each call, but other
    numbers are as they were when it was traced: `agrees` tells.

    Args:
        problem: in float64, on the CPU.
        step_sizes: α of the line search.
    """

    def __init__(self, problem: Problem, step_sizes: Sequence[float]):
        super().__init__(problem.step, problem.system.n)
        self.problem = problem
        self._search = _SearchStep(problem, step_sizes)
        self._first = _OfProblem(problem, super().first)
        self._curvature = _OfProblem(problem, super().curvature)
        self._facts = self._written_for()

    def search(self, x: StatePath, u: ControlPath, k: ControlPath, K: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Closed loops from x̄_0 (b, n) under u = ū + αk + K(x − x̄), kept to U, for each step size α.

        Args:
            x, u: x̄ (N + 1, b, n) and ū (N, b, m).
            k, K: (N, b, m) and (N, b, m, n).

        Returns:
            x (N + 1, sizes, b, n), u (N, sizes, b, m), and ∫ℓ over all of it (sizes, b).
        """
        start = _without_cost(x[0]).expand(len(self._search.step_sizes), -1, -1)
        return self._along("search", self._search, [x[:-1], u, k, K], start)

    def follow(self, expansion: Expansion, x0: State) -> tuple[StatePath, ControlPath, PerState]:
        """Closed loops from x₀ (b, n) under the held controls for V as the expansion of each has it: x, u and ∫ℓ."""
        columns = [expansion.x[1:], expansion.gradient[1:], expansion.hessian[1:]]
        return self._along("follow", _FollowStep(self.problem), columns, _without_cost(x0))

    def first(self, z: Tensor) -> list[Tensor]:
        return self._in_slices("first", self._first, z)

    def curvature(self, z: Tensor, p: State) -> Tensor:
        (bends,) = self._in_slices("curvature", self._curvature, z, p)
        return bends

    def agrees(self, path: Path) -> bool:
        """Whether steps and costs of finite paths are those of the problem as it is, up to a third of the digits."""
        finite = path.cost.isfinite()
        x, u, cost = path.x[:, finite], path.u[:, finite], path.cost[finite]
        with torch.no_grad():
            following, paid = self.problem.step(x[:-1], u)
            total = paid.sum(0) + self.problem.cost.terminal(x[-1])
        return are_close(x[1:], following, THIRD) and are_close(cost, total, THIRD)

    def forget(self) -> bool:
        """Run by torch from now on what programs were written for, here and for all copies of the problem.

        Returns:
            Whether there were any.
        """
        known = self.problem.findings.programs
        some = any(program is not None for program in known.values())
        known.update(dict.fromkeys(known))
        return some

    def _along(self, name: str, step: nn.Module, columns: list[Tensor], start: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(x, u, ∫ℓ) of steps (*columns (N, b, …) at its time, y (…, b, n + 1)) ↦ (y', y', u), for slices of b."""

        def slice_of(rows: Tensor) -> list[Tensor]:
            return [*(_filled(each, rows, 1, TRAJECTORIES) for each in columns), _filled(start, rows, -2, TRAJECTORIES)]

        b, one = start.shape[-2], slice_of(torch.arange(min(TRAJECTORIES, start.shape[-2])))
        kernel = self._kernel(name, lambda: _scan_kernel(step, one))
        if kernel is None:
            y, u = Scan(lambda: (), step, 0).loop(*columns, start)
        else:
            state = state_of(step)
            parts = in_threads(lambda rows: kernel(*state, *slice_of(rows)), torch.arange(b).split(TRAJECTORIES))
            y, u = (torch.cat(parts, -2)[..., :b, :] for parts in zip(*parts, strict=True))
        return torch.cat([start[None, ..., :-1], y[..., :-1]]), u, y[-1, ..., -1]

    def _in_slices(self, name: str, module: "_OfProblem", *columns: Tensor) -> list[Tensor]:
        """The results of a function of the rows of some columns, for all rows."""
        slices = [
            [_filled(column, rows, 0, ROWS) for column in columns] for rows in torch.arange(len(columns[0])).split(ROWS)
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

    def _written_for(self) -> tuple[Any, ...]:
        """What programs are for: problems with the same findings may differ in their steps and controls."""
        controls, m = self.problem.controls, self.problem.system.m
        sizes = torch.tensor([0.1, 1.0, 10.0, 1e4], dtype=torch.float64)
        tried = sizes[:, None, None] * torch.randn(4, 4, m, generator=torch.Generator().manual_seed(0)).double()
        shapes = tuple(tensor.shape for tensor in state_of(self.problem))
        kept = tuple(controls.project(tried).flatten().tolist())
        return self.problem.horizon, type(controls), kept, self._search.step_sizes, shapes


class _SearchStep(nn.Module):
    """(x̄, ū, k, K, y) ↦ (y', y', u), y = (x, ∫ℓ): one step under u = ū + αk + K(x − x̄), kept to U."""

    def __init__(self, problem: Problem, step_sizes: Sequence[float]):
        super().__init__()
        self.problem, self.step_sizes = problem, tuple(step_sizes)
        self.alpha = torch.tensor(step_sizes, dtype=torch.float64)[:, None, None]

    @torch.no_grad()
    def forward(self, along: Tensor, u: Tensor, k: Tensor, K: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Control]:
        x = y[..., :-1]
        u = self.problem.controls.project(u + self.alpha * k + apply(K, x - along))
        return _moved(self.problem, y, u)


class _FollowStep(nn.Module):
    """(x̄', p', H', y) ↦ (y', y', u), y = (x, ∫ℓ): one step under the held control for V' of an expansion."""

    def __init__(self, problem: Problem):
        super().__init__()
        self.problem = problem

    @torch.no_grad()
    def forward(self, center: State, p: State, H: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Control]:
        x = y[..., :-1]
        free = self.problem.response(x)
        u = held_control(self.problem, free, p + apply(H, free.x - center), H)
        return _moved(self.problem, y, u)


class _OfProblem(nn.Module):
    """A function of tensors, made of a problem."""

    def __init__(self, problem: Problem, function: Callable[..., Any]):
        super().__init__()
        self.problem, self.function = problem, function

    def forward(self, *arguments: Tensor) -> tuple[Tensor, ...]:
        result = self.function(*arguments)
        return (result,) if isinstance(result, Tensor) else tuple(result)


def _moved(problem: Problem, y: Tensor, u: Control) -> tuple[Tensor, Tensor, Control]:
    """(y', y', u): y = (x, ∫ℓ) after one step, to be carried on and to be kept."""
    following, paid = problem.step(y[..., :-1], u)
    y = torch.cat([following, y[..., -1:] + paid[..., None]], -1)
    return y, y, u


def _scan_kernel(step: nn.Module, arguments: list[Tensor]) -> ScanKernel:
    """The steps of one slice as a program."""
    *columns, y = arguments
    state, moving = state_of(step), len(columns)
    middle = [column[len(column) // 2] for column in columns]
    graph = trace(stateless(step), [*state, *(column[0] for column in columns), y], [[*middle, y]], whole=True)
    prepare, repeated = cut(graph, late=moving + 1, early_outputs=0, repeat=False)
    return ScanKernel(prepare, repeated, [*state, *arguments], moving)


def _without_cost(x: State) -> Tensor:
    """(x, 0)."""
    return torch.cat([x, torch.zeros_like(x[..., :1])], -1)


def _filled(column: Tensor, rows: Tensor, axis: int, count: int) -> Tensor:
    """Some rows along an axis, the last of them repeated until they are as many as a program takes."""
    return column.index_select(axis, torch.cat([rows, rows[-1:].expand(count - len(rows))]))
