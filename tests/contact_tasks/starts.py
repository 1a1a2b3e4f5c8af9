"""A controller's costs from published starts, beside optima: python -m tests.contact_tasks.starts CKPT pushing_1000.

The optimum is the cheapest of differential dynamic programming from the law's controls, from softer contacts, and
IPOPT from its own guesses and from these. With `states 64` in the place of a name: the law's costs from 64 states of X₀
beside these optima. With `walls 64`: the shares of 64 states of X₀ from which the law leans on a wall where the optimum
does, and costs at most 1.05 times as much.
"""

import sys

import torch

import lyapnet
from lyapnet.evaluation.oracles import optimal_cost
from lyapnet.value.expansions import cheapest, greedy_law, in_float64, optimal_trajectories, path_under, riccati

STARTS = {  # x₀ ↦ the best cost that was known, of five guesses
    "pushing_10": {(0, 1, 0, 0): 823.70},
    "pushing_100": {(0, 1, 0, 0): 786.95},
    "pushing_1000": {(0, 1, 0, 0): 801.81},
    "dragging": {(0, 0, 0, 0): 6880.05},
    "walls_right": {(0.2, 0, 0.3, 0): 193.9, (0.3, 0, 0.6, 0): 1204.7, (0.3, -0.1, 0.5, 0): 695.3},
    "walls_tilted": {(0, 0.35, 0, 0): 403.6},
    "walls_left": {(-0.3, 0.2, 0, 0): 1774.3},
    "walls_fast": {(0.3, 0, 1, 0): 4290.7},
}


def leans(x):
    """Whether the tip of the pole meets a wall, of paths (N + 1, b, 4)."""
    return (x[..., 0] - 0.6 * x[..., 1]).abs().amax(0) > 0.35


def report_shares(controller, count):
    """Print on how many states of X₀ the law takes the family of the best optimum found."""
    problem = in_float64(controller.problem)
    x0 = problem.initial_states.sample(count, torch.Generator().manual_seed(123)).double()
    loop = controller.rollout(x0)
    linear = path_under(problem, greedy_law(problem, riccati(problem)), x0).u
    paths = [
        optimal_trajectories(problem, x0, u, softer_first=soft).path for u, soft in ((loop.u, False), (linear, True))
    ]
    best = cheapest(paths)
    ratio, same = loop.cost / best.cost, leans(loop.x) == leans(best.x)
    print(
        f"{count} states of X₀: mean cost / mean best {float(loop.cost.mean() / best.cost.mean()):.4f}, worst "
        f"{float(ratio.max()):.3f}, within 1.05: {float((ratio <= 1.05).double().mean()):.0%}, the same family: "
        f"{float(same.double().mean()):.0%}, leaning is best: {float(leans(best.x).double().mean()):.0%}"
    )


def best_of(problem, x0, u):
    """The least cost found from each start, and that of IPOPT."""
    laws = path_under(problem, greedy_law(problem, riccati(problem)), x0).u
    optima = [
        optimal_trajectories(problem, x0, controls, softer_first=soft)
        for controls, soft in ((u, False), (u, True), (laws, True))
    ]
    costs = torch.stack([each.path.cost for each in optima])
    best, rows = costs.argmin(0), torch.arange(len(x0))
    oracle = optimal_cost(problem)
    alone = torch.full_like(costs[0], torch.nan) if oracle is None else oracle.solve(x0).cost
    known = torch.stack([each.path.u for each in optima])[best, :, rows].movedim(0, 1)
    given = alone if oracle is None else oracle.solve(x0, known=known).cost
    return torch.stack([costs.amin(0), alone.nan_to_num(torch.inf), given.nan_to_num(torch.inf)]).amin(0), alone


def report_states(controller, count):
    """Print the law's costs from states of X₀ relative to the least found."""
    problem = in_float64(controller.problem)
    x0 = problem.initial_states.sample(count, torch.Generator().manual_seed(123)).double()
    loop = controller.rollout(x0)
    best, alone = best_of(problem, x0, loop.u)
    ratio = loop.cost / best
    print(
        f"{count} states of X₀: mean cost {float(loop.cost.mean()):.4g}, mean best {float(best.mean()):.4g}, ratio "
        f"{float(loop.cost.mean() / best.mean()):.4f}, median {float(ratio.median()):.4f}, worst "
        f"{float(ratio.max()):.3f}, within 1.05: {float((ratio <= 1.05).double().mean()):.0%}, IPOPT alone / best "
        f"{float(alone.nanmean() / best.mean()):.4f}, of {int(alone.isfinite().sum())}"
    )


def report_starts(controller, starts):
    """Print the costs of the law from some starts, beside optima."""
    x0 = torch.tensor([*starts], dtype=torch.float64)
    loop = controller.rollout(x0)
    best, ipopt = best_of(in_float64(controller.problem), x0, loop.u)
    rows = zip(
        starts.items(),
        loop.cost.tolist(),
        best.tolist(),
        ipopt.tolist(),
        controller.value(0.0, x0).tolist(),
        strict=True,
    )
    for (x, published), cost, optimum, alone, value in rows:
        print(
            f"{x}: law {cost:.2f}, V {value:.2f}, optimum {optimum:.2f}, IPOPT alone {alone:.2f}, published "
            f"{published}; law / optimum {cost / optimum:.4f}, law / published {cost / published:.4f}"
        )


if __name__ == "__main__":
    loaded = lyapnet.load(sys.argv[1])
    reports = {"walls": report_shares, "states": report_states}
    if sys.argv[2] in reports:
        reports[sys.argv[2]](loaded, int(sys.argv[3]))
    else:
        report_starts(loaded, STARTS[sys.argv[2]])
