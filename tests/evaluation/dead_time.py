"""What dead time costs a loop that knows of it, and one that does not: python -m tests.evaluation.dead_time.

Each row is a controller of the zoo whose controls act some steps after their readings, on a plant like its model. Costs
are means over the same states of X₀, divided by those of u(t, x) with the state known and no dead time.
"""

import sys

import torch

import lyapnet
from lyapnet.base.random_streams import OUTPUTS, TEST, stream
from lyapnet.value.expansions import path_under

TASKS = {
    "cartpole_balancing": {"cart position": 0.012, "pole angle": 0.012},
    "cartpole_swingup": {"cart position": 0.006, "pole angle": 0.006},
    "planar_quadrotor": {"x": 0.02, "z": 0.02, "pitch": 0.01},
}
DELAYS = (0, 1, 5, 10, 20)
STATES = 256


@torch.no_grad()
def mean_cost(controller, readings, delay, told, states=STATES):
    """The mean cost of loops whose controls act `delay` steps late; infinite if one is lost."""
    loop = controller.with_estimator(measure=[*readings], noise=[*readings.values()], delay=delay if told else 0)
    problem, draws = loop.problem, stream(0, TEST, OUTPUTS)
    x0 = problem.initial_states.sample(states, stream(0, TEST))
    loop.reset(loop.draw_first(x0, draws))
    at_rest = problem.controls.project(problem.rest).expand(states, -1)
    acting = [at_rest] * delay  # the control of each step

    def law(k, x):
        acting.append(
            torch.as_tensor(loop.step(loop.outputs.draw(x, draws), applied=acting[max(k - 1, 0)] if k else None))
        )
        return acting[k]

    return float(path_under(problem, law, x0, None).cost.nan_to_num(torch.inf).mean())


def known_cost(controller, states=STATES):
    """The mean cost of u(t, x) with the state known and no dead time."""
    x0 = controller.initial_states.sample(states, stream(0, TEST))
    return float(controller.rollout(x0).cost.mean())


def main(names):
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float64)
    for name in names or TASKS:
        controller = lyapnet.load(f"zoo:{name}")
        known, dt = known_cost(controller), controller.horizon.dt
        for delay in DELAYS:
            told, untold = (mean_cost(controller, TASKS[name], delay, told) / known for told in (True, False))
            print(
                f"{name}, {delay} steps ({1000 * delay * dt:g} ms): told {told:.4f}, not told {untold:.4f}", flush=True
            )


if __name__ == "__main__":
    main(sys.argv[1:])
