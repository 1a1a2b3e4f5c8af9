"""Optima of the tasks without a goal, by a transcription that has nothing of lyapnet: python -m THIS [NAME …]

Each task is written here a second time, in CasADi's symbols. Its explicit Euler steps are the equality constraints of
one nonlinear program (multiple shooting), states in units of the extents of tried paths, and IPOPT solves it from
several guesses, then from the controls of the nearest states until none gains. J* is what the controls that were
found cost when they are rolled out. Then random guesses from the first states look for anything better, and lyapnet's
own steps have to give the same J.
"""

import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from tests.tasks_without_goal.tasks import HERE, KEPT, WORKING, problem_of, replay

STATES = 64
SEED = 20  # of the states
EXAMINED, GUESSES = 8, 8  # states from which random guesses look for better optima, and how many from each
STORED = 2  # states whose optimal controls are kept
AGREES = 1e-6  # of the size of J*: two formulations, and two optima, that differ by less are the same
FEASIBLE = 1e-6  # of the limit, by which a rollout may exceed one

Symbols = Sequence[Any]


@dataclass(frozen=True)
class Task:
    """ẋ, ℓ and φ as functions of lists of symbols, and the numbers of the file."""

    dynamics: Callable[[Symbols, Symbols], Symbols]
    running: Callable[[Symbols, Symbols], Any]
    terminal: Callable[[Symbols], Any]
    controls: tuple[list[float], list[float]]
    start: tuple[list[float], list[float]]
    steps: int
    dt: float
    lower: dict[int, float] = field(default_factory=dict)  # limits of states by their index
    upper: dict[int, float] = field(default_factory=dict)
    tried: tuple[float, float] = (0.0, 1.0)  # shares of the way between the limits, of guesses
    guesses: int = 3  # from each state, and how many neighbours share their controls with it, itself included
    domain: dict[int, float] = field(default_factory=dict)  # kept above in the search; no optimum is near


def chemotherapy(x: Symbols, u: Symbols) -> Symbols:
    N, T, L, M = x  # L the lymphocytes
    k = 1 - ca.exp(-M)
    return [
        N - N**2 - N * T - 0.15 * k * N,
        1.5 * T - 1.5 * T**2 - 0.5 * L * T - N * T - 0.3 * k * T,
        0.33 + 0.01 * L * T / (0.3 + T) - L * T - 0.2 * L - 0.2 * k * L,
        u[0] - M,
    ]


def battery(x: Symbols, u: Symbols) -> Symbols:
    price = 0.25 + 0.06 * ca.cos(2 * math.pi * (x[1] - 17) / 24) + 0.06 * ca.cos(4 * math.pi * (x[1] - 20) / 24)
    return [0.95 * u[0] - u[1] / 0.95, 1, price * (u[0] - u[1])]


def rocket(x: Symbols, u: Symbols) -> Symbols:
    h, v, m = x
    return [v, (u[0] - 6 * ca.exp(-h / 8) * v * ca.sqrt(v**2 + 1e-6)) / m - 9.81e-3, -u[0] / 2]


def glider(x: Symbols, u: Symbols) -> Symbols:
    s, _, v, angle, C = x
    k, G = 0.0791, 9.81
    return [
        v * ca.cos(angle),
        v * ca.sin(angle) + 2.5 * ca.exp(-((s - 90) ** 2) / 1600),
        -k * (0.034 + 0.07 * C**2) * v**2 - G * ca.sin(angle),
        (k * C * v**2 - G * ca.cos(angle)) / v,
        u[0],
    ]


def pest(x: Symbols, u: Symbols) -> Symbols:
    b, p, e = x
    return [
        b * (0.08 - 0.01 * b - 0.01 * p),
        p * (0.2 - p / 75 - 0.1 * e - u[0]),
        e * (0.02 * p - 0.08 - 0.6 * u[0]) + u[1],
    ]


def heating(x: Symbols, u: Symbols) -> Symbols:
    L, B, LW, BW, h, _ = x
    out = 3 + 4 * ca.cos(2 * math.pi * (h - 15) / 24)
    price = 0.25 + 0.1 * ca.cos(2 * math.pi * (h - 18) / 24)
    return [
        (LW - L + 0.06 * (out - L) + 0.15 * (B - L) + 3 * u[0]) / 1.2,
        (0.7 * (BW - B) + 0.05 * (out - B) + 0.15 * (L - B) + 3 * u[1]) / 0.9,
        (L - LW + 0.08 * (out - LW)) / 9,
        (0.7 * (B - BW) + 0.07 * (out - BW)) / 6,
        1,
        price * (u[0] + u[1]),
    ]


def secreted_protein(x: Symbols, u: Symbols) -> Symbols:
    M, P, X, S, V = x
    mu = 21.87 * S / (S**2 + 62.9 * S + 25)
    dilution = u[0] / V
    return [
        4.75 * mu / (0.12 + mu) * (P - M) - dilution * M,
        S * ca.exp(-5 * S) / (0.1 + S) * X - dilution * P,
        mu * X - dilution * X,
        -7.3 * mu * X + dilution * (20 - S),
        u[0],
    ]


def orbit(x: Symbols, u: Symbols) -> Symbols:
    r, v, w = x
    return [v, w**2 / r - 1 / r**2 + u[0], -v * w / r + u[1]]


TASKS = {
    "advertising": Task(
        lambda x, u: [0.4 * u[0] * (1 - x[0]) - 0.3 * x[0]],
        lambda x, u: -3 * x[0] + 0.25 * u[0] ** 2,
        lambda x: -2 * x[0],
        ([0], [3]), ([0.05], [0.6]), 100, 0.05,
    ),
    "chemotherapy": Task(
        chemotherapy,
        lambda x, u: x[1] + 0.2 * u[0] ** 2,
        lambda x: 40 * x[1] - 5 * x[0],
        ([0], [1]), ([0.8, 0.08, 0.1, 0], [1, 0.15, 0.3, 0]), 200, 0.1, lower={0: 0.72},
        upper={3: 0.5},
    ),
    "battery": Task(
        battery,
        lambda x, u: 0.01 * (u[0] ** 2 + u[1] ** 2),
        lambda x: x[2] - 0.2 * x[0],
        ([0, 0], [4, 4]), ([2, 0, 0], [8, 6, 0]), 96, 0.25, lower={0: 1}, upper={0: 9},
    ),
    "rocket": Task(
        rocket,
        lambda x, u: 0.002 * u[0] ** 2,
        lambda x: -x[0],
        ([0], [6]), ([0, 0.02, 90], [1, 0.1, 110]), 150, 0.4, lower={2: 60}, tried=(0, 0.4),
    ),
    "glider": Task(
        glider,
        lambda x, u: 10 * u[0] ** 2,
        lambda x: -x[0] - 10 * x[1] - x[2] ** 2 / 1.962,
        ([-0.3], [0.3]), ([-20, 0, 11, -0.15, 0.6], [20, 0, 14, 0.05, 0.9]), 200, 0.06,
        lower={4: 0.1}, upper={4: 1.4}, tried=(0.46, 0.54), domain={2: 3},
    ),
    "growth": Task(
        lambda x, u: [x[0] ** 0.33 - 0.06 * x[0] - x[1], u[0] * x[1], -0.03 * x[2]],
        lambda x, u: -x[2] * ca.log(x[1]) + 0.5 * u[0] ** 2,
        lambda x: -4 * x[2] * ca.log(x[0]),
        ([-0.5], [0.5]), ([2, 0.6, 1], [8, 1.4, 1]), 100, 0.2,
        tried=(0.4, 0.6), domain={0: 0.1, 1: 0.01},
    ),
    "pest": Task(
        pest,
        lambda x, u: 300 * u[0] ** 2 + 200 * u[1] ** 2,
        lambda x: -150 * x[0],
        ([0, 0], [0.3, 0.4]), ([1, 3, 0.3], [3, 9, 1.5]), 160, 0.25,
    ),
    "heating": Task(
        heating,
        lambda x, u: 0.02 * (u[0] ** 2 + u[1] ** 2),
        lambda x: x[5] - 0.08 * (1.2 * x[0] + 0.9 * x[1] + 9 * x[2] + 6 * x[3] - 17.1 * 18),
        ([0, 0], [2, 1.5]), ([20.5, 18.5, 17.5, 16.5, 0, 0], [22, 20, 19.5, 18.5, 4, 0]), 120, 0.2,
        lower={0: 20, 1: 18},
    ),
    "secreted_protein": Task(
        secreted_protein,
        lambda x, u: 0.5 * u[0] ** 2,
        lambda x: -x[0] * x[4],
        ([0], [2]), ([0, 0, 1, 1, 1], [0, 0, 2, 4, 2]), 200, 0.05, tried=(0.02, 0.4), guesses=10,
        domain={3: 0},
    ),
    "orbit": Task(
        orbit,
        lambda x, u: 2 * (u[0] ** 2 + u[1] ** 2),
        lambda x: -x[0] + 10 * (x[1] ** 2 + (x[2] - 1 / ca.sqrt(x[0])) ** 2),
        ([-0.12, -0.12], [0.12, 0.12]), ([0.95, -0.05, 0.95], [1.05, 0.05, 1.05]), 100, 0.035,
    ),
}  # fmt: skip


class Transcription:
    """One task as a nonlinear program, built once for all its states."""

    def __init__(self, task: Task):
        self.task, self.n, self.m = task, len(task.start[0]), len(task.controls[0])
        x, u = ca.SX.sym("x", self.n), ca.SX.sym("u", self.m)
        xs, us = ca.vertsplit(x), ca.vertsplit(u)
        step = ca.Function("step", [x, u], [x + task.dt * ca.vertcat(*task.dynamics(xs, us)), task.running(xs, us)])
        self.phi = ca.Function("phi", [x], [task.terminal(xs)])
        self.step = step
        self.slopes = ca.Function("slopes", [x, u], [ca.jacobian(step(x, u)[0], x)])
        self.low, self.high = (np.array(limits, dtype=float) for limits in task.controls)
        self.generator = np.random.default_rng(SEED + 1)
        self.scale = self._extents()
        self.solver = self._solver()

    def roll(self, x0: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, float, float]:
        """States (steps + 1, n), J, and by how much of its limit a state exceeds it at most."""
        path, J = [np.asarray(x0, dtype=float)], 0.0
        for control in u:
            after, cost = self.step(path[-1], control)
            path.append(np.asarray(after).ravel())
            J += self.task.dt * float(cost)
        x = np.array(path)
        excess = [(limit - x[:, i].min()) / abs(limit) for i, limit in self.task.lower.items()]
        excess += [(x[:, i].max() - limit) / abs(limit) for i, limit in self.task.upper.items()]
        return x, J + float(self.phi(x[-1])), max(excess, default=0.0)

    def stiffness(self, x: np.ndarray, u: np.ndarray) -> float:
        """The largest −Re λ of (F_x − 1) along a path, F the step: explicit Euler is stable below 2, smooth below 1."""
        slopes = [np.asarray(self.slopes(*each)) for each in zip(x[:-1], u, strict=True)]
        return max(float((1 - np.linalg.eigvals(slope).real).max()) for slope in slopes)

    def guess(self, share: float | None = None) -> np.ndarray:
        """A share of the way between the ends of what is tried; None: random, linear between five nodes."""
        nodes, grid = np.linspace(0, 1, 5), np.linspace(0, 1, self.task.steps)
        shares = np.full((5, self.m), share) if share is not None else self.generator.random((5, self.m))
        least, most = self.task.tried
        between = least + (most - least) * np.stack([np.interp(grid, nodes, column) for column in shares.T], -1)
        return self.low + (self.high - self.low) * between

    def _extents(self) -> np.ndarray:
        low, high = np.array(self.task.start, dtype=float)
        paths = [self.roll((low + high) / 2, self.guess(share))[0] for share in (0.1, 0.5, None, None)]
        seen = np.concatenate([path[np.isfinite(path).all(-1)] for path in paths])
        return np.maximum(np.ptp(seen, axis=0), high - low)

    def _solver(self) -> ca.Function:
        task, N = self.task, self.task.steps
        x0 = ca.SX.sym("x0", self.n)
        X, U = ca.SX.sym("X", self.n, N), ca.SX.sym("U", self.m, N)  # in units of their extents
        width, J, gaps, before = self.high - self.low, 0, [], x0
        for k in range(N):
            after, cost = self.step(before, self.low + width * U[:, k])
            before, J = self.scale * X[:, k], J + task.dt * cost
            gaps.append(X[:, k] - after / self.scale)
        low, high = np.full((N, self.n), -np.inf), np.full((N, self.n), np.inf)
        for i, limit in {**task.domain, **task.lower}.items():
            low[:, i] = limit / self.scale[i]
        for i, limit in task.upper.items():
            high[:, i] = limit / self.scale[i]
        self.bounds = {
            "lbx": np.concatenate([low.ravel(), np.zeros(N * self.m)]),
            "ubx": np.concatenate([high.ravel(), np.ones(N * self.m)]),
        }
        program = {"x": ca.vertcat(ca.vec(X), ca.vec(U)), "p": x0, "f": J + self.phi(before), "g": ca.vertcat(*gaps)}
        options = {"tol": 1e-9, "print_level": 0, "sb": "yes", "max_iter": 300, "bound_relax_factor": 1e-10}
        return ca.nlpsol(
            "solver",
            "ipopt",
            program,
            {"ipopt": options, "print_time": False, "show_eval_warnings": False, "error_on_fail": False},
        )

    def solve(self, x0: np.ndarray, u: np.ndarray) -> tuple[float, np.ndarray] | None:
        """J and controls of the local optimum that a guess leads to; None: none, or none within the limits."""
        path = self.roll(x0, u)[0][1:] / self.scale
        path = np.where(np.isfinite(path), path, x0 / self.scale)
        given = np.concatenate([path.ravel(), ((u - self.low) / (self.high - self.low)).ravel()])
        found = self.solver(x0=given, p=x0, lbg=0, ubg=0, **self.bounds)
        shares = np.asarray(found["x"]).ravel()[self.task.steps * self.n :].reshape(-1, self.m)
        controls = np.clip((self.low + (self.high - self.low) * shares).round(9), self.low, self.high)
        _, J, excess = self.roll(x0, controls)
        ends = self.solver.stats()["return_status"] in ("Solve_Succeeded", "Solved_To_Acceptable_Level")
        return (J, controls) if ends and math.isfinite(J) and excess <= FEASIBLE else None


def initial_states(task: Task) -> np.ndarray:
    """The states (STATES, n) that the optima are about, to six digits after the point."""
    low, high = np.array(task.start, dtype=float)
    return (low + (high - low) * np.random.default_rng(SEED).random((STATES, len(low)))).round(6)


def find(name: str) -> dict[str, Any]:
    """All optima of one task, with what is known of how sure they are."""
    own, x0 = Transcription(TASKS[name]), initial_states(TASKS[name])
    best: list[tuple[float, np.ndarray]] = []
    worst = failed = 0
    for x in x0:
        tried = [own.solve(x, own.guess(share)) for share in (0.1, 0.5, *[None] * (own.task.guesses - 2))]
        known = sorted((each for each in tried if each), key=lambda each: each[0])
        assert known, f"Expected an optimum of {name} from {x}, got none; try more guesses."
        best.append(known[0])
        worst += sum(each[0] - known[0][0] > AGREES * abs(known[0][0]) for each in known)
        failed += len(tried) - len(known)
    near = np.linalg.norm((x0[:, None] - x0) / own.scale, axis=-1).argsort(1)
    from_others, improved = 0, True
    while improved:
        improved = False
        for i, x in enumerate(x0):
            for j in near[i, 1 : own.task.guesses]:
                found = own.solve(x, best[j][1])
                if found and found[0] < best[i][0] - AGREES * abs(best[i][0]):
                    best[i], improved, from_others = found, True, from_others + 1
    better = 0
    for i, x in enumerate(x0[:EXAMINED]):
        for found in (own.solve(x, own.guess()) for _ in range(GUESSES)):
            better += bool(found and found[0] < best[i][0] - AGREES * abs(best[i][0]))
    paths = [own.roll(x, u) for x, (_, u) in zip(x0, best, strict=True)]
    excess = max(path[2] for path in paths)
    stiffness = max(own.stiffness(path[0], u) for path, (_, u) in zip(paths, best, strict=True))
    assert stiffness < 1, f"Expected smooth Euler steps, got {stiffness:.2f}; choose a smaller dt."
    for i, limit in own.task.domain.items():
        least = min(path[0][:, i].min() for path in paths)
        assert least > limit + 0.01 * own.scale[i], f"Expected optima away from the edge {limit} of state {i}; move it."
    print(f"{name}: {own.task.guesses * STATES} guesses, {failed} without an optimum, {worst} to a dearer one; "
          f"{from_others} improved from neighbours; {better} of {EXAMINED * GUESSES} random guesses better; "
          f"limits exceeded by {excess:.1e} of themselves; Euler's −Δt λ {stiffness:.2f} at most",
          flush=True)  # fmt: skip
    assert not better, "Expected no better optimum from random guesses; try more guesses."
    return {
        "seed": SEED,
        "states": x0.tolist(),
        "optima": [J for J, _ in best],
        "controls": [u.tolist() for _, u in best],
    }


def main(names: Sequence[str]) -> None:
    """Find the optima of some tasks, hold them against lyapnet's steps, and keep them."""
    for name in names or (*WORKING, *KEPT):
        found = find(name)
        J = np.array(found["optima"])
        again = replay(problem_of(name), found["states"], found["controls"]).J.numpy()
        difference = np.abs(again - J) / np.abs(J).max()
        print(f"  J* {J.mean():.6g}, from {J.min():.6g} to {J.max():.6g}, spread {J.std():.4g}; "
              f"lyapnet's steps differ by {difference.max():.1e} of it at most", flush=True)  # fmt: skip
        assert difference.max() < AGREES, "Expected the same J from both formulations; correct one of them."
        found["controls"] = found["controls"][:STORED]
        lines = ",\n".join(f'"{key}": {json.dumps(value)}' for key, value in found.items())
        (HERE / name / "optima.json").write_text("{" + lines + "}\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
