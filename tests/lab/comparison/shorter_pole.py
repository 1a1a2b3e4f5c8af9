"""MPC with V on a cart-pole whose pole is a fifth shorter: python -m tests.lab.comparison.shorter_pole [NAME …].

The plans know the new length; V is that of the zoo's controller, for the old length. Beside them stand the controller's
own law, and plans with LQR's value. Costs are divided by the optimum with the new length.
"""

import sys
from functools import partial

import numpy as np
import torch

import lyapnet
from lyapnet.evaluation.oracles import oracle_of
from lyapnet.evaluation.robustness import disturbances
from lyapnet.lab.comparison.planners.mpc import PredictiveControl
from lyapnet.value.expansions import path_under

STATES = 8


def paths(problem, law_of, x0):
    """The closed loop from each state, under a law of its own."""

    def path(law, x):
        return path_under(problem, lambda k, z: torch.as_tensor(law(k, z[0].numpy()))[None].to(z), x[None], None)

    return [path(law_of(), x) for x in x0]


def law_of(controller):
    """(step, x) ↦ u of a controller."""
    return lambda k, x: controller.policy(k * controller.horizon.dt, x)


@torch.no_grad()
def main(names):
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float64)
    for name in names or ("cartpole_swingup", "cartpole_limited", "cartpole_balancing"):
        controller = lyapnet.load(f"zoo:{name}")
        changed = next(each for each in disturbances(controller, STATES, 0) if each.name.startswith("length -20"))
        problem, x0 = changed.problem, changed.x0.double()
        own = paths(problem, partial(law_of, controller), x0)
        optima = oracle_of(problem, changed.method).solve(x0, torch.cat([path.u for path in own], 1)).cost.numpy()
        laws = {"the law": None}
        for steps in (5, 10):
            laws[f"mpc_V_{steps}"] = PredictiveControl(problem, steps, controller)
            laws[f"mpc_{steps}"] = PredictiveControl(problem, steps)
        for title, planner in laws.items():
            found = own if planner is None else paths(problem, planner.law, x0)
            costs = np.array([float(path.cost) for path in found])
            print(f"{name}: {title} {costs.sum() / optima.sum():.4g}, worst {(costs / optima).max():.4g}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
