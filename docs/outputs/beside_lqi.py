"""Loops that estimate a load beside a tuned LQI: a pendulum held at 45°, and a planar quadrotor that hovers.

python docs/outputs/beside_lqi.py PENDULUM QUADROTOR FIGURE, two checkpoints. After T a load of a fifth of the limits
acts, or the mass grows by a fifth. Each loop has those numbers of a grid with which it does best.
"""

import itertools
import sys
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from scipy.linalg import solve_discrete_are
from torch import Tensor

import lyapnet

DT, LOADED, STEPS = 0.02, 50, 250  # s; the step from which the load acts, and all steps
LOOPS, EXACT = 16, 1e-4  # loops with noise for each setting; noise that is assumed of exact readings
PRICES, DRIFTS = (0.1, 1e-3, 1e-5), (0.3, 1.0, 3.0, 10.0, 100.0)  # R of the cost; σ of d, N·m or N per √s
WEIGHTS = np.geomspace(1e-5, 1, 6), np.geomspace(1e-1, 1e7, 17)  # of an LQI's controls and integrals
WALKS = 0.1, 0.3, 1.0, 3.0  # N·m or N, noise of the controls that an LQI's filter assumes
SHOWN = "with estimator, R = 0.1", "with estimator, R = 0.001", "LQI, R = 0.1", "LQI, R tuned"  # in the figure

Control = Callable[[Tensor, Tensor], Tensor]  # states and readings of a batch of loops ↦ controls


class Plant(NamedTuple):
    """A plant and what happens to it; its first states are read, the first `held` of them shall stay."""

    name: str
    system: lyapnet.ControlSystem
    cases: dict[str, tuple[lyapnet.ControlSystem, float]]  # what happens ↦ the plant, and the load of each control
    target: list[float]
    at_rest: list[float]
    most: float  # largest control
    noise: list[float]  # of the readings
    held: int
    setpoint: float  # of which the bands are shares
    unit: str


def plants() -> tuple[Plant, Plant]:
    """The pendulum, and the quadrotor, whose thrusts are told from those that carry its first mass."""
    pendulum, quadrotor = lyapnet.SYSTEMS["pendulum"], lyapnet.SYSTEMS["planar_quadrotor"]
    angle, model = 0.7854, quadrotor()
    grows = {"load": (pendulum(), 3.0), "mass + 20 %": (pendulum(mass=1.2), 0.0)}
    lifts = {"load": (model, -0.5), "mass + 20 %": (quadrotor(mass=1.2 * model.mass), -0.1 * model.mass * 9.81)}
    torque = -9.81 * np.sin(angle)
    return (
        Plant("pendulum", pendulum(), grows, [angle, 0], [torque], 15, [0.005], 1, angle, "rad"),
        Plant("quadrotor", model, lifts, [0] * 6, [0, 0], 2.5, [0.02, 0.02, 0.01], 2, 1, "m"),
    )


def step(system: lyapnet.ControlSystem, x: Tensor, u: Tensor) -> Tensor:
    """A step of Δt by the classical method of Runge and Kutta."""
    a = system.dynamics(x, u)
    b = system.dynamics(x + DT / 2 * a, u)
    c = system.dynamics(x + DT / 2 * b, u)
    return x + DT / 6 * (a + 2 * b + 2 * c + system.dynamics(x + DT * c, u))


def simulate(plant: Plant, case: str, control: Control, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Deviations of what is held (steps, loops, held) and controls (steps, loops, m); noise is (steps, loops, p)."""
    target = torch.tensor(plant.target).double()
    x, states, controls = target.expand(noise.shape[1], -1), [], []
    for k in range(STEPS):
        states.append(x)
        controls.append(control(x, x[:, : noise.shape[-1]] + noise[k]).double())
        system, load = plant.cases[case] if k >= LOADED else (plant.system, 0.0)
        x = step(system, x, controls[-1] + load)
    return (torch.stack(states) - target)[..., : plant.held], torch.stack(controls)


def with_estimator(
    plant: Plant, trained: lyapnet.Controller, price: float, drift: float, noise: Sequence[float]
) -> Control:
    """The loop after T, with another R of the cost; its model takes steps of Runge and Kutta, as the plant moves."""
    target, at_rest = torch.tensor(plant.target).double(), torch.tensor(plant.at_rest).double()
    n, m = len(target), len(at_rest)
    Q = torch.tensor([1.0] * (n // 2) + [0.1] * (n // 2)).double().diag()
    cost = lyapnet.TargetCost(lyapnet.QuadraticCost(Q, price * torch.eye(m).double(), Q), target, at_rest)
    limits = lyapnet.ControlBox([-plant.most] * m, [plant.most] * m)
    problem = trained.problem.in_steps(method="rk4").replaced(cost=cost, controls=limits)
    loop = lyapnet.Controller(problem, trained.V, beyond="riccati").with_estimator(
        measure=plant.system.state_names[: len(noise)],
        noise=noise,
        input_disturbances=dict.fromkeys(plant.system.control_names, drift),
    )
    loop.reset([*plant.target, *[0.0] * m], t=problem.horizon.duration)
    return lambda x, y: loop.step(y)


def lqi(plant: Plant, grid: Sequence[Sequence[float]], loops: int = 1) -> Control:
    """u = u* − K(x − x*) − K_i ∫(y − y*) dt within the limits, for `loops` loops with each (r, q_i) or (r, q_i, walk).

    K is from Riccati's equation of the steps linearised at the target; r weighs the controls, q_i the integrals, which
    stop while a control is at its limit. With a walk a stationary Kalman filter estimates x from the readings.
    """
    target, at_rest = torch.tensor(plant.target).double(), torch.tensor(plant.at_rest).double()
    jacobians = torch.autograd.functional.jacobian(lambda x, u: step(plant.system, x, u), (target, at_rest))
    A, B = (each.numpy() for each in jacobians)
    n, m, p, S = len(A), B.shape[1], plant.held, np.diag(np.square(plant.noise))
    larger, inputs = np.block([[A, np.zeros((n, p))], [DT * np.eye(p, n), np.eye(p)]]), np.vstack([B, np.zeros((p, m))])
    H, gains, corrections = np.eye(len(S), n), [], []
    for r, q, *walk in grid:
        Q, R = np.diag([1.0] * (n // 2) + [0.1] * (n // 2) + [q] * p), r * np.eye(m)
        P = solve_discrete_are(larger, inputs, Q, R)
        gains.append(np.linalg.solve(R + inputs.T @ P @ inputs, inputs.T @ P @ larger))
        if walk:
            P = solve_discrete_are(A.T, H.T, walk[0] ** 2 * B @ B.T + 1e-12 * np.eye(n), S)
            corrections.append(P @ H.T @ np.linalg.inv(H @ P @ H.T + S))
    K, L = (torch.tensor(np.array(each)).repeat_interleave(loops, 0) for each in (gains, corrections))
    integral, predicted = torch.zeros(len(K), p).double(), torch.zeros(len(K), n).double()

    def control(x: Tensor, y: Tensor) -> Tensor:
        nonlocal integral, predicted
        error, read = x - target, y - target[: y.shape[-1]]
        if len(L):
            error = predicted + torch.einsum("bij,bj->bi", L, read - predicted[:, : read.shape[-1]])
        u = at_rest - torch.einsum("bij,bj->bi", K, torch.cat([error, integral], -1))
        kept = u.clamp(-plant.most, plant.most)
        integral = torch.where((u == kept).all(-1, keepdim=True), integral + DT * read[:, :p], integral)
        predicted = error @ torch.tensor(A).T + (kept - at_rest) @ torch.tensor(B).T
        return kept

    return control


def settling(deviations: Tensor, band: float) -> Tensor:
    """Seconds after the load until the deviations of each loop stay within the band; infinite if never."""
    outside = (deviations[LOADED:].abs() > band).any(-1)
    last = (outside * torch.arange(1, len(outside) + 1)[:, None]).amax(0)
    return torch.where(last < len(outside), DT * last.double(), torch.inf)


def compare_exact(plant: Plant, case: str, trained: lyapnet.Controller) -> dict[str, tuple[Tensor, Tensor]]:
    """Deviations and controls of the loops that are soonest within 0.5 %; readings are exact, LQIs know the state."""
    runs, none = {}, torch.zeros(STEPS, 1, len(plant.noise)).double()
    exact = [EXACT] * len(plant.noise)
    for price in PRICES:
        tried = [simulate(plant, case, with_estimator(plant, trained, price, each, exact), none) for each in DRIFTS]
        runs[f"with estimator, R = {price:g}"] = [(each,) for each in DRIFTS], *joined(tried)
    for name, prices in (("LQI, R = 0.1", (0.1,)), ("LQI, R tuned", WEIGHTS[0])):
        grid = [*itertools.product(prices, WEIGHTS[1])]
        runs[name] = grid, *simulate(plant, case, lqi(plant, grid), none.expand(-1, len(grid), -1))
    best = {}
    for name, (grid, y, u) in runs.items():
        soon, far = settling(y, 0.005 * plant.setpoint), y[LOADED:].abs().amax((0, -1))
        i = min(range(len(grid)), key=lambda i: (float(soon[i]), float(far[i])))
        best[name], moved = (y[:, i], u[:, i]), (u[LOADED:, i] - u[LOADED - 1, i]).abs().max()
        print(
            f"{plant.name}, {case}, {name} ({', '.join(f'{each:.3g}' for each in grid[i])}): 2 % in "
            f"{settling(y, 0.02 * plant.setpoint)[i]:.2f} s, 0.5 % in {soon[i]:.2f} s, at most {far[i]:.4f} "
            f"{plant.unit}, at the end {y[-1, i].abs().max():.0e}, control moves by {moved:.2f}",
            flush=True,
        )
    return best


def compare_noisy(plant: Plant, case: str, trained: lyapnet.Controller) -> None:
    """Print the least root mean square after the load from noisy readings, and that of an LQI with no more noise in u.

    The LQI has a Kalman filter.
    """
    drawn = torch.randn(STEPS, LOOPS, len(plant.noise), generator=torch.Generator().manual_seed(0)).double()
    noise = drawn * torch.tensor(plant.noise).double()
    grid = [*itertools.product(WEIGHTS[0], WEIGHTS[1][::2], WALKS)]
    others = figures(plant, *simulate(plant, case, lqi(plant, grid, LOOPS), noise.repeat(1, len(grid), 1)))
    for price in PRICES:
        tried = [simulate(plant, case, with_estimator(plant, trained, price, d, plant.noise), noise) for d in DRIFTS]
        own = figures(plant, *joined(tried))
        i = int(own[0].argmin())
        j = int(torch.where(others[1] <= own[1][i], others[0], torch.inf).argmin())
        for name, found in (
            (f"R = {price:g} ({DRIFTS[i]:g})", own[:, i]),
            ("LQI ({:.0e}, {:.0e}, {:g})".format(*grid[j]), others[:, j]),
        ):
            print(
                f"{plant.name}, {case}, noisy, {name}: root mean square {found[0]:.4f} {plant.unit}, of u at rest "
                f"{found[1]:.2f}, mean within 2 % in {found[2]:.2f} s",
                flush=True,
            )


def joined(runs: Sequence[tuple[Tensor, Tensor]]) -> list[Tensor]:
    """Deviations and controls of several runs as those of one batch."""
    return [torch.cat(each, 1) for each in zip(*runs, strict=True)]


def figures(plant: Plant, y: Tensor, u: Tensor) -> Tensor:
    """(3, settings): root mean square of y after the load and of u − u* before it; seconds until the mean is in 2 %."""
    y, u = (each.unflatten(1, (-1, LOOPS)) for each in (y, u - torch.tensor(plant.at_rest)))
    far = y[LOADED:].square().sum(-1).mean((0, 2)).sqrt().nan_to_num(torch.inf)
    return torch.stack(
        [far, u[LOADED // 2 : LOADED].square().mean((0, 2, 3)).sqrt(), settling(y.mean(2), 0.02 * plant.setpoint)]
    )


def draw(runs: dict[str, dict[str, tuple[Tensor, Tensor]]], path: str) -> None:
    """The loops after a load: what is held, and the first control."""
    figure = Figure(figsize=(8, 4.8), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True)
    t = DT * (np.arange(STEPS) - LOADED)
    for column, plant in zip(panels.T, plants(), strict=True):
        index, quantity, control = {"pendulum": (0, "angle − 45° (mrad)", "torque (N·m)")}.get(
            plant.name, (1, "height − setpoint (mm)", "each thrust (N)")
        )
        for name, color in zip(SHOWN, ("tab:blue", "tab:cyan", "tab:orange", "tab:red"), strict=True):
            y, u = runs[plant.name][name]
            column[0].plot(t, 1e3 * y[:, index], color=color, label=name)
            column[1].plot(t, u[:, 0], color=color, drawstyle="steps-post")
        column[0].axhspan(
            -5 * plant.setpoint, 5 * plant.setpoint, color="grey", alpha=0.15, label="0.5 % of the setpoint", lw=0
        )
        column[0].set(title=plant.name, ylabel=quantity, xlim=(-0.1, 1.2))
        column[1].set(ylabel=control, xlabel="time from the load on (s)")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    compared = {}
    for plant, path in zip(plants(), sys.argv[1:3], strict=True):
        trained = lyapnet.load(path)
        compared[plant.name] = {case: compare_exact(plant, case, trained) for case in plant.cases}["load"]
        compare_noisy(plant, "load", trained)
    draw(compared, sys.argv[3])
