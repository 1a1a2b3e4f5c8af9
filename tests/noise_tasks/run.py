"""One task with noise, trained by the default recipe and measured: python -m THIS NAME [--seed S] [KEY=VALUE …]

`lyapnet train --config task.yaml` runs in a copy of the folder; best.ckpt is rolled out under noise that no training
saw. `--certainty` also trains the task without its noise and runs that law under the same noise.
"""

import argparse
import math
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from omegaconf import OmegaConf
from torch import Tensor

import lyapnet
from lyapnet.controller import Controller
from lyapnet.experiment.assembly import build_problem, parts_of
from lyapnet.experiment.config import load_config
from tests.noise_tasks.exact import Exact
from tests.noise_tasks.tasks import TASKS, Task
from tests.tasks_without_goal.run import load, train
from tests.tasks_without_goal.tasks import inside

STATES, PATHS, SEED = 256, 40, 1000  # states of X₀; paths of the noise from each; seed of both
LIMIT = 1200.0  # CPU seconds of a training
TWO_SIDED = 1.96  # standard deviations of a 95 % interval


class Measures(NamedTuple):
    """What a law does under noise, from all paths."""

    paths: int
    mean: float  # E J, by J − M
    half_width: float  # of its 95 % interval
    plain_mean: float  # E J, by costs alone
    plain_half_width: float
    value: float  # mean of V(0, x₀)
    exact: float  # mean of J* over the same states
    control_error: float  # mean |u − u*|² / mean |u*|² over time and paths
    uncontrolled: float  # E J of u = 0; NaN where it diverges


def test_states(controller: Controller) -> Tensor:
    """States of X₀ that no training saw."""
    return controller.problem.initial_states.sample(STATES, torch.Generator().manual_seed(SEED)).double()


@torch.no_grad()
def measure(controller: Controller, exact: Exact | None, paths: int = PATHS, x0: Tensor | None = None) -> Measures:
    """Closed loops of a law from states of X₀, many paths from each."""
    problem, x0 = controller.problem, test_states(controller) if x0 is None else x0
    own = x0.to(problem.goal)
    samples, plain, zero, errors, sizes = list[Tensor](), list[Tensor](), list[Tensor](), 0.0, 0.0
    V = controller.value(0.0, own).double()
    for path in range(paths):
        noise = draw(controller, own, path)
        trajectory = controller.closed_loops(own, noise, with_surprises=False)
        samples.append(trajectory.expected_cost.double())
        plain.append(trajectory.cost.double())
        zero.append(cost_under(problem, own, noise, None))
        if exact is not None:
            for n, (x, u) in enumerate(zip(trajectory.x, trajectory.u, strict=False)):
                best = exact.control(n, x.double())
                errors += float(((u.double() - best) ** 2).sum())
                sizes += float((best**2).sum())
    mean, half = interval(torch.stack(samples))
    return Measures(
        paths * len(x0), mean, half, *interval(torch.stack(plain)), float(V.mean()),
        math.nan if exact is None else float(exact.value(x0).mean()), errors / sizes if sizes else math.nan,
        float(torch.stack(zero).mean()),
    )  # fmt: skip


def draw(controller: Controller, x0: Tensor, path: int) -> Tensor:
    """ΔW of one path of the noise from each state."""
    noise, horizon = controller.problem.noise, controller.horizon
    assert noise is not None
    return noise.draw(horizon.steps, horizon.dt, x0, torch.Generator().manual_seed(SEED + 1 + path))


@torch.no_grad()
def cost_under(problem: lyapnet.Problem, x0: Tensor, noise: Tensor, law: Controller | None) -> Tensor:
    """J of a law, or of u = 0, by the problem's own steps."""
    x, J = x0, x0.new_zeros(len(x0), dtype=torch.float64)
    for n, increment in enumerate(noise):
        u = problem.rest.expand(len(x), -1) if law is None else law.policy(n * problem.horizon.dt, x)
        assert problem.noise is not None
        following, paid = problem.step(x, u)
        x, J = following + problem.noise.displacement(x, increment), J + paid.double()
    return J + problem.cost.terminal(x).double()


def interval(samples: Tensor) -> tuple[float, float]:
    """(mean, half-width of its 95 % interval) of samples (paths, states), the states being given."""
    return float(samples.mean()), TWO_SIDED * float((samples.var(0) / len(samples)).mean() / samples.shape[1]) ** 0.5


def prepare(folder: Path, task: Task, without_noise: bool = False) -> None:
    """Copy a task, or the same without the noise of its config, into an empty folder."""
    content = OmegaConf.to_container(OmegaConf.load(task.file))
    assert isinstance(content, dict)
    if without_noise:
        del content["noise"]
    OmegaConf.save(content, folder / "task.yaml")
    if (system := task.file.parent / "system.py").exists():
        shutil.copy(system, folder)


def trained(
    task: Task, seed: int, changes: Sequence[str], folder: Path, without_noise: bool = False
) -> tuple[Controller, float]:
    """(the controller that training a task in an empty folder gives, CPU seconds)."""
    prepare(folder, task, without_noise)
    run = train(folder, seed, LIMIT, changes)
    print((folder / "train.out").read_text(encoding="utf-8"))
    return load(folder, changes), run["cpu"]


def main() -> None:
    """Train and measure the task that the command line names, and print what came of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", choices=TASKS)
    parser.add_argument("changes", nargs="*", help="changes of the config, as key=value")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--paths", type=int, default=PATHS, help=f"paths from each of {STATES} states")
    parser.add_argument("--certainty", action="store_true", help="compare with the law of the task without its noise")
    parser.add_argument("--folder", type=Path, help="keep the runs there")
    given = parser.parse_intermixed_args()  # changes may stand before or after options
    task = TASKS[given.name]
    with tempfile.TemporaryDirectory(prefix=f"{given.name}_") as temporary:
        place = given.folder or Path(temporary)
        place.mkdir(parents=True, exist_ok=True)
        controller, seconds = trained(task, given.seed, given.changes, place)
        problem = controller.problem.double() if given.changes else problem_in(task)
        exact = None if task.exact is None else task.exact(problem)
        found = measure(controller, exact, given.paths)
        print(f"{given.name}, seed {given.seed}: {seconds:.0f} CPU s of training; {found.paths} paths")
        print(f"E J {found.mean:.6g} ± {found.half_width:.2g}, from costs alone {found.plain_mean:.6g} ± "
              f"{found.plain_half_width:.2g}")  # fmt: skip
        print(f"mean V(0, x₀) {found.value:.6g}; E J of u = 0 {found.uncontrolled:.6g}")
        if exact is not None:
            missed = (found.mean - found.exact) / (found.uncontrolled - found.exact)
            print(f"optimum of the steps {found.exact:.6g}: E J / optimum {found.mean / found.exact:.5f}, V / optimum "
                  f"{found.value / found.exact:.5f}, error of the control {found.control_error:.3%}, "
                  f"(E J − J*) / (J₀ − J*) {missed:.3%}")  # fmt: skip
        if task.continuous is not None:
            centre = problem.initial_states.center[None]
            at = float(controller.value(0.0, centre.to(controller.problem.goal)))
            print(f"V(0, centre) {at:.6g}, in continuous time {task.continuous:.6g}: "
                  f"{at / task.continuous - 1:+.3%}")  # fmt: skip
        if given.certainty:
            other = place / "without_noise"
            other.mkdir()
            law, _ = trained(task, given.seed, given.changes, other, without_noise=True)
            x0 = test_states(controller).to(controller.problem.goal)
            J = torch.stack([
                cost_under(controller.problem, x0, draw(controller, x0, path), law) for path in range(given.paths)
            ])  # fmt: skip
            mean, half = interval(J)
            print(f"the law trained without noise: E J {mean:.6g} ± {half:.2g}")


def problem_in(task: Task, *overrides: str) -> lyapnet.Problem:
    """The problem of a task, in float64."""
    with inside(task.file.parent):
        config = load_config(Path(task.file.name), list(overrides))
        return build_problem(config, parts_of(config)).double()


if __name__ == "__main__":
    main()
