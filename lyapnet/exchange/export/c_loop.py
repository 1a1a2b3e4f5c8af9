"""The control loop in C99: an estimator and the law at its estimate, y ↦ u, with one step for each Δt."""

import copy
import ctypes
import re
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.fx import GraphModule

from lyapnet.base.errors import ExportError
from lyapnet.base.random_streams import OUTPUTS, TEST, stream
from lyapnet.controller.output_feedback import ROUNDING, OutputFeedback
from lyapnet.exchange.export.c import Style, box_table, has_limits, numbers_of
from lyapnet.exchange.export.law import Law
from lyapnet.exchange.export.verification import AFTER, STATES, LoopAgreement, Points, tolerance_of
from lyapnet.graphs.c_functions import c_function
from lyapnet.graphs.c_text import Tables, literal
from lyapnet.graphs.tracing import core_trace
from lyapnet.loop.estimation.kalman import Belief
from lyapnet.task.domain import SLACK

MISSING = 0.05  # share of missing readings in the comparison with Python
ELSEWHERE = 0.05  # share of steps in this comparison at which the plant gets another control
EXAMPLES = 64  # number of states of X₀ from which the example is chosen
TRUSTED = 3  # standard deviations by which the first estimate may lie outside of X₀

Traced = dict[str, tuple[str, GraphModule, dict[str, Tensor], list[str]]]


class LoopTraces:
    """Traces of the parts of a loop with an estimator.

    They are predict (x, P, u) ↦ (x', P') and correct (x, P, y) ↦ (x', P'); with a delay, ahead (x, u) ↦ x'; and with
    estimated disturbances d̂, take_off (u, x) ↦ u − d̂ within the limits, for the u of the law.

    Args:
        loop: a loop with an extended Kalman filter (ekf).

    Raises:
        ExportError: the filter is another one; or a part cannot be traced.
    """

    def __init__(self, loop: OutputFeedback):
        if loop.kind != "ekf":
            raise ExportError(
                f"Expected an estimator that can be written in C, ekf, got {loop.kind}, which takes eigenvalues in "
                "each step; choose ekf, and compare the two by lyapnet evaluate."
            )
        self.loop, problem = loop, loop.problem
        self.readings, self.estimated, self.controls = loop.outputs.count, problem.system.n, problem.system.m
        self.settings = len(loop.settings)
        x, P = loop.middle_estimate(), torch.diag(loop.deviation.square())
        u, y = problem.rest.double(), loop.outputs(x)

        def predict(x: Tensor, P: Tensor, u: Tensor) -> tuple[Tensor, ...]:
            return tuple(loop.filter.predict(Belief(x, P), u))

        def correct(x: Tensor, P: Tensor, y: Tensor) -> tuple[Tensor, ...]:
            return tuple(loop.corrected(Belief(x, P), y))

        def ahead(x: Tensor, u: Tensor) -> tuple[Tensor, ...]:
            return (problem.step(x, u)[0],)

        def take_off(u: Tensor, x: Tensor) -> tuple[Tensor, ...]:
            return (loop.without_disturbances(u, x),)

        self._parts: Traced = {
            "predict": self._traced(predict, {"x": x, "P": P, "u": u}, ["x_next", "P_next"]),
            "correct": self._traced(correct, {"x": x, "P": P, "y": y}, ["x_next", "P_next"]),
        }  # fmt: skip
        if loop.delay:
            self._parts["ahead"] = self._traced(ahead, {"x": x, "u": u}, ["x_next"])
        if loop.d_hat.shape[-1]:
            self._parts["take_off"] = self._traced(take_off, {"u": u, "x": x}, ["u_next"])

    @staticmethod
    def _traced(
        function: Callable[..., tuple[Tensor, ...]], arguments: dict[str, Tensor], results: list[str]
    ) -> tuple[str, GraphModule, dict[str, Tensor], list[str]]:
        graph = core_trace(function, list(arguments.values()), "f, g, noise, outputs and V", ExportError)
        heads = [f"const double *{name}" for name in arguments] + [f"double *{name}" for name in results]
        return ", ".join(heads), graph, arguments, results

    def facts(self) -> dict[str, str]:
        """Lines for the comment at the top of the files."""
        outputs, system = self.loop.outputs, self.loop.problem.system
        readings = ", ".join(
            f"{name} ± {noise:g} {unit}".rstrip()
            for name, noise, unit in zip(outputs.names, outputs.noise.tolist(), outputs.units, strict=True)
        )
        names = [system.state_names[i] for i in self.loop.settings.values()]
        settings = {"r": ", ".join(names)} if names else {}
        delay = {"delay": f"{self.loop.delay} steps from readings to their control"} if self.loop.delay else {}
        return {"y": readings, **settings, "x̂": ", ".join(system.state_names), "estimator": self.loop.kind, **delay}

    def functions(self, tables: Tables) -> tuple[str, int]:
        """(the text of the traced functions, the number of entries of all arrays of a step on the stack)."""
        bodies, total = list[str](), 0
        for name, (heads, graph, arguments, results) in self._parts.items():
            body, size = c_function(f"static void {name}_of({heads})", graph, arguments, results, tables)
            bodies.append(body)
            total += size
        own = self.estimated + self.estimated**2 + self.readings + self.controls  # of the function for a step
        own += self.estimated if self.loop.delay else 0
        return "\n".join(bodies), total + own

    def declarations(self, style: Style) -> str:
        """The loop's type and functions for the header."""
        name, macro, real = style.name, style.macro, style.real
        n = f"{macro}_ESTIMATED"
        settings = f" const {real} r[{macro}_SETTINGS]," if self.settings else ""
        delay = self.loop.delay
        later = (
            f"    {real} later[{delay}][{macro}_CONTROLS];  /* those of the intervals after it */\n" if delay else ""
        )
        says = f"\n   It acts from {delay} calls after this one on; loop->u acts until the next call." if delay else ""
        return (
            f"/* A loop. After {name}_reset other estimates may be written to x and P, and a first time to start. */\n"
            f"typedef struct {{\n    {real} x[{n}];  /* the estimate after the last readings */\n"
            f"    {real} P[{n} * {n}];  /* its covariance, by rows */\n"
            f"    {real} u[{macro}_CONTROLS];  /* the control that acts until the next readings */\n"
            f"{later}    {real} t;  /* s, of the last readings */\n    {real} start;  /* s, of the first ones */\n"
            f"    unsigned long calls, begun;  /* steps so far, and at the last change of r */\n"
            f"}} {name}_loop;\n\nvoid {name}_reset({name}_loop *loop);\n\n"
            f"/* u after readings y at loop->t, once in each {macro}_DT; NaN is a reading that is missing."
            f"{says}{SETTINGS_SAY if self.settings else ''} */\n"
            f"int {name}_step({name}_loop *loop, const {real} y[{macro}_READINGS],{settings} "
            f"{real} u[{macro}_CONTROLS]);\n\n"
            "/* The control that the plant got since the last step, if it is not loop->u. */\n"
            f"int {name}_applied({name}_loop *loop, const {real} u[{macro}_CONTROLS]);\n\n"
        )

    def entries(self, style: Style, tried: Points, law: Law) -> str:
        """The functions of the loop; they call the law as `control_of`."""
        loop, problem = self.loop, self.loop.problem
        n, m, p, macro, name = self.estimated, self.controls, self.readings, style.macro, style.name
        box, domain, known = problem.initial_states, loop.controller.problem.domain, len(tried.lower)
        first = problem.controls.project(problem.rest)
        members = [numbers_of(box.center), numbers_of(torch.diag(loop.deviation.square()).flatten()), numbers_of(first)]
        if loop.delay:
            members.append(f"{{{', '.join([numbers_of(first)] * loop.delay)}}}")
        x_then = "ahead" if loop.delay else "loop->x"
        tables = [box_table("first_known", box.lower[:known], box.upper[:known])]
        checks = [f"if (!is_inside({known}, loop->x, known)) code |= {macro}_OUTSIDE;"]
        if domain is not None:
            tables.append(box_table("domain_of_estimates", *domain.narrowed(-SLACK)))
            size = len(domain.lower)  # further estimates, of what the law is not told, have none
            checks.append(f"if (!is_inside({size}, loop->x, domain_of_estimates)) code |= {macro}_OUTSIDE_DOMAIN;")
        if estimated := [i for i in loop.ranged if box.widths[i] > 0]:
            tables.append(box_table("ends", box.lower[estimated], box.upper[estimated]))
            checks.append(ENDS.replace("@K", str(len(estimated))).replace("@WHICH", ", ".join(map(str, estimated))))
        which = list(loop.settings.values())
        change = CHANGE.replace("@K", str(len(which))).replace("@WHICH", ", ".join(map(str, which)))
        if which:
            room = ROUNDING * torch.maximum(box.lower.abs(), box.upper.abs())[which]
            tables.append(box_table("ranges", box.lower[which] - room, box.upper[which] + room))
        words = {
            "SETTINGS": change if which else "",
            "LAW": ", ".join({"t": "&clock", "x": x_then, "p": f"{x_then} + {len(law.arguments['x'])}"}[each]
                             for each in law.arguments),
            "OFF": TAKE_OFF if "take_off" in self._parts else "", "THEN": x_then,
            "NEXT": SHIFT if loop.delay else "", "AHEAD": AHEAD if loop.delay else "", "DELAY": loop.delay,
            "LAST": f"later[{loop.delay - 1}]" if loop.delay else "u",
            "R": f"const double r[{len(which)}], " if which else "",
            "NAME": name, "MACRO": macro, "N": n, "M": m, "P": p, "KNOWN": known, "FIRST": ", ".join(members),
            "TRUSTED": literal(TRUSTED), "DT": problem.horizon.dt.hex(), "CHECKS": "\n    ".join(checks),
            "LIMIT": "limit(next);" if has_limits(problem.controls, style) else "",
        }  # fmt: skip
        fill = partial(re.sub, r"@([A-Z]+)", lambda word: str(words[word[1]]))
        return "\n".join([*tables, fill(fill(LOOP))])

    def example(self, style: Style) -> str:
        """A program that runs five steps of the loop with the same readings."""
        name, macro, real = style.name, style.macro, style.real
        y, settings = numbers_of(self._example_readings(5)), "r, " if self.settings else ""
        r = numbers_of(torch.full((self.settings,), torch.nan))  # they stay as they are
        declared = f"    const {real} r[{macro}_SETTINGS] = {r};\n" if self.settings else ""
        return (
            f'{"#include <math.h>" + chr(10) if self.settings else ""}#include <stdio.h>\n#include "policy.h"\n\n'
            "int main(void)\n{\n"
            f"    const {real} y[{macro}_READINGS] = {y};\n{declared}    {real} u[{macro}_CONTROLS];\n"
            f"    {name}_loop loop;\n"
            f"    {name}_reset(&loop);\n    for (int k = 0; k < 5; k++) {{\n"
            f"        int code = {name}_step(&loop, y, {settings}u);\n"
            f'        for (int i = 0; i < {macro}_CONTROLS; i++) printf("u[%d] = %g\\n", i, u[i]);\n'
            '        if (code) printf("code %d\\n", code);\n    }\n    return 0;\n}\n'
        )

    @torch.no_grad()
    def _example_readings(self, steps: int) -> Tensor:
        """Readings (p,) of that state of X₀ for which most controls of some steps are inside their limits."""
        loop, problem = copy.copy(self.loop), self.loop.problem
        loop.reset()
        box = problem.initial_states
        y = loop.outputs(torch.cat([box.center[None], box.sample(EXAMPLES, stream(0, TEST, OUTPUTS))]))
        u = torch.stack([loop.step(y).double().cpu() for _ in range(steps)])
        if problem.controls.limits is None:
            return y[0]
        low, high = (side.double().cpu() for side in problem.controls.limits)
        return y[((u > low) & (u < high)).double().mean((0, 2)).argmax()]


# Time is double also in single precision, as rounding could otherwise let the law after T begin a step later.
LOOP = """
/* Take a new estimate if it is finite. */
static int keep(@NAME_loop *loop, const double *x, const double *P)
{
    if (!is_finite(@N, x) || !is_finite(@N * @N, P)) return @MACRO_NOT_FINITE;
    for (int i = 0; i < @N; i++) loop->x[i] = x[i];
    for (int i = 0; i < @N * @N; i++) loop->P[i] = P[i];
    return 0;
}

void @NAME_reset(@NAME_loop *loop)
{
    static const @NAME_loop first = {@FIRST, 0.0, 0.0, 0, 0};
    *loop = first;
}

int @NAME_applied(@NAME_loop *loop, const double u[@M])
{
    if (!is_finite(@M, u)) return @MACRO_NOT_FINITE;
    for (int i = 0; loop->calls > 0 && i < @M; i++) loop->u[i] = u[i];
    return 0;
}

int @NAME_step(@NAME_loop *loop, const double y[@P], @Rdouble u[@M])
{
    double x[@N], P[@N * @N], known_y[@P], next[@M];
    int code = 0;
    for (int i = 0; i < @P; i++) {
        known_y[i] = isfinite(y[i]) ? y[i] : NAN;
        if (!isfinite(y[i])) code |= @MACRO_MISSING;
    }
    if (loop->calls > 0) {
        predict_of(loop->x, loop->P, loop->u, x, P);
        code |= keep(loop, x, P);
@NEXT    }
    unsigned long k = loop->calls;
    loop->t = (double)((WIDE)loop->start + (WIDE)k * @DT);
    if (k + 1 > 0) loop->calls++;
    correct_of(loop->x, loop->P, known_y, x, P);
    code |= keep(loop, x, P);
@SETTINGS    double clock = loop->begun > 0 ? (double)((WIDE)(k - loop->begun) * @DT) : loop->t;
@AHEAD    control_of(@LAW, next);
    @OFF
    @LIMIT
    if (is_finite(@M, next))
        for (int i = 0; i < @M; i++) loop->@LAST[i] = next[i];
    else
        code |= @MACRO_NOT_FINITE;
    for (int i = 0; i < @M; i++) u[i] = loop->@LAST[i];
    @CHECKS
    for (int i = 0; loop->calls == 1 && i < @KNOWN; i++) {
        double room = @TRUSTED * sqrt(loop->P[i * @N + i]);
        if (loop->x[i] < first_known[i][0] - room || loop->x[i] > first_known[i][1] + room) code |= @MACRO_OUTSIDE_X0;
    }
    return code;
}
"""


TAKE_OFF = """double of_law[@M];
    for (int i = 0; i < @M; i++) of_law[i] = next[i];
    take_off_of(of_law, @THEN, next);"""
SHIFT = """        for (int i = 0; i < @M; i++) {
            loop->u[i] = loop->later[0][i];
            for (int j = 1; j < @DELAY; j++) loop->later[j - 1][i] = loop->later[j][i];
        }
"""
AHEAD = """    clock = (double)((WIDE)clock + (WIDE)@DELAY * @DT);
    double ahead[@N];
    for (int i = 0; i < @N; i++) ahead[i] = loop->x[i];
    for (int j = 0; j < @DELAY; j++) {
        ahead_of(ahead, j == 0 ? loop->u : loop->later[j - 1], x);
        for (int i = 0; i < @N; i++) ahead[i] = x[i];
    }
"""
ENDS = """static const int ranged[@K] = {@WHICH};
    for (int i = 0; i < @K; i++)
        if (loop->x[ranged[i]] <= ends[i][0] || loop->x[ranged[i]] >= ends[i][1]) code |= @MACRO_AT_RANGE_END;"""
CHANGE = """    static const int which[@K] = {@WHICH};
    for (int i = 0; i < @K; i++) {
        if (isnan(r[i]) || (r[i] <= loop->x[which[i]] && r[i] >= loop->x[which[i]])) continue;
        if (is_inside(1, r + i, ranges + i)) {
            loop->x[which[i]] = r[i];
            loop->begun = k;
        } else
            code |= @MACRO_OUTSIDE;
    }
"""
SETTINGS_SAY = """
   r: where one changes the horizon begins anew; if NaN or outside of its range it stays, at first in the middle.
   The time on a reference runs by itself from 0: give it where it jumps, and NaN otherwise."""


class CompiledLoop:
    """The loop as machine code of this process.

    Args:
        traces: the traces of the loop.
        functions: the compiled policy.c.
        style: the names and the precision of policy.c.
    """

    def __init__(self, traces: LoopTraces, functions: ctypes.CDLL, style: Style):
        n, m, self._style = traces.estimated, traces.controls, style
        number = ctypes.c_float if style.single else ctypes.c_double

        class Memory(ctypes.Structure):
            _fields_ = [
                ("x", number * n), ("P", number * (n * n)), ("u", number * m),
                ("later", number * (m * traces.loop.delay)), ("t", number), ("start", number),
                ("calls", ctypes.c_ulong), ("begun", ctypes.c_ulong),
            ]  # fmt: skip

        self.memory, self._controls, self._settings = Memory(), m, traces.settings
        self._reset, self._step, self._applied = (
            functions[f"{style.name}_{what}"] for what in ("reset", "step", "applied")
        )
        self._reset.argtypes, self._reset.restype = [ctypes.c_void_p], None
        self._step.argtypes = [ctypes.c_void_p] * (4 if traces.settings else 3)
        self._step.restype = ctypes.c_int
        self._applied.argtypes, self._applied.restype = [ctypes.c_void_p] * 2, ctypes.c_int
        self.code = 0  # what the last step returned
        self.reset()

    def reset(self) -> None:
        """Restart the loop with its first estimate."""
        self._reset(ctypes.addressof(self.memory))

    def step(self, y: NDArray, applied: NDArray | None = None, r: NDArray | None = None) -> NDArray:
        """u (m,) after readings y (p,), as OutputFeedback.step; NaN in the settings r of a family keeps them."""
        if applied is not None:
            given = np.ascontiguousarray(applied, self._style.numpy)
            self._applied(ctypes.addressof(self.memory), given.ctypes.data)
        readings, u = np.ascontiguousarray(y, self._style.numpy), np.empty(self._controls, self._style.numpy)
        given = [np.full(self._settings, np.nan) if r is None else r] if self._settings else []
        arrays = [readings, *(np.ascontiguousarray(each, self._style.numpy) for each in given), u]
        self.code = self._step(ctypes.addressof(self.memory), *(each.ctypes.data for each in arrays))
        return u

    @property
    def x_hat(self) -> NDArray:
        """x̂ (n,)."""
        return np.array(self.memory.x)

    @property
    def P(self) -> NDArray:
        """The covariance, (n²,)."""
        return np.array(self.memory.P)


class _Path(NamedTuple):
    """The inputs and results of a loop in Python, each (steps, b, …)."""

    y: Tensor  # readings
    applied: Tensor  # controls that the plant got instead of those of the loop; NaN if it got those
    r: Tensor  # settings of a family; NaN if they stayed
    u: Tensor
    x_hat: Tensor
    P: Tensor


def verify_loop(loop: OutputFeedback, found: CompiledLoop, dtype: torch.dtype) -> LoopAgreement:
    """Compare an exported loop with Python's on closed loops from X₀ of the model, up to 1.25 T, 10 000 steps in all.

    Some readings are missing, and at some steps the plant gets another control. Steps from which on the loop in Python
    is not finite are left out.

    Raises:
        ExportError: they differ by more than rounding.
    """
    path, count = _path_of(loop), 0
    worst = np.zeros(3)
    expected = [each.flatten(2).double().numpy() for each in (path.u, path.x_hat, path.P)]
    finite = np.all([np.isfinite(each).all(-1) for each in expected], 0).cumprod(0).astype(bool)
    scales = [_largest(each[finite], own_axis) for each, own_axis in zip(expected, (False, True, False), strict=True)]
    for k in range(path.y.shape[1]):
        found.reset()
        for step in range(int(finite[:, k].sum())):
            applied = path.applied[step, k]
            other = None if bool(applied.isnan().any()) else applied.numpy()
            u = found.step(path.y[step, k].numpy(), other, path.r[step, k].numpy())
            for i, own in enumerate((u, found.x_hat, found.P)):
                difference = np.abs(own - expected[i][step, k]) / scales[i]
                worst[i] = max(worst[i], np.where(np.isnan(difference), np.inf, difference).max())
            count += 1
    agreement = LoopAgreement(count, *worst.tolist())
    if not max(agreement[1:]) <= tolerance_of(loop.law, dtype, loop.state_of_law.dtype):
        raise ExportError(
            f"Expected the loop's own u and estimate, got others: {agreement}; "
            + (
                "choose --dtype float64"
                if dtype == torch.float32
                else "report this with f, g, the cost and the network"
            )
            + ". Nothing was written."
        )
    return agreement


def _largest(values: NDArray, of_each: bool) -> NDArray:
    size = np.abs(values).max(0) if of_each else np.abs(values).max()
    return np.where(size > 0, size, 1.0)


@torch.no_grad()
def _path_of(loop: OutputFeedback) -> _Path:
    """Closed loops of the model with the estimator, from states of X₀."""
    loop = copy.copy(loop)  # the estimate of the given loop does not change
    loop.reset()
    problem, draw = loop.problem, stream(0, TEST, OUTPUTS)
    steps = min(STATES, max(2, round(AFTER * problem.horizon.steps)))
    x, other = problem.initial_states.sample(-(-STATES // steps), draw), None
    rows, which = list[tuple[Tensor, ...]](), list(loop.settings.values())
    for _ in range(steps):
        y = loop.outputs.draw(x, draw)
        y = y.masked_fill(~y.isfinite() | (torch.rand(y.shape, generator=draw) < MISSING), torch.nan)
        changed = bool(which) and float(torch.rand((), generator=draw)) < ELSEWHERE
        r = (
            problem.initial_states.sample(len(x), draw)[:, which]
            if changed
            else torch.full((len(x), len(which)), torch.nan)
        )
        settings = loop.named_settings(r) if changed else {}
        u = loop.step(y, applied=other, **settings).double().cpu()
        rows.append((y, torch.full_like(u, torch.nan) if other is None else other, r, u, *loop.belief))
        acting = loop.acting
        replaced = float(torch.rand((), generator=draw)) < ELSEWHERE and bool(acting.isfinite().all())
        other = problem.controls.project(0.9 * acting) if replaced else None
        x = problem.step(x, acting if other is None else other)[0]
    return _Path(*map(torch.stack, zip(*rows, strict=True)))
