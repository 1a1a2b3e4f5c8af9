"""Cost over optimum at 50 members of a family, of V and of each member's LQR: python docs/weightings.py CKPT."""

import sys

import torch

import lyapnet
from lyapnet.evaluation.oracles import oracle_of
from lyapnet.task.family import FamilySystem
from lyapnet.value.expansions import greedy_law, in_float64, path_under, riccati

MEMBERS, STATES = 50, 8
controller = lyapnet.load(sys.argv[1])
box, system = controller.initial_states, controller.system
assert isinstance(system, FamilySystem), "a controller of a family"
draw = torch.Generator().manual_seed(12345)
p = system.split(box.sample(MEMBERS, draw))[1]
members = [system.values(each.tolist()) for each in p]
x = system.split(box.sample(MEMBERS * STATES, draw))[0]
z = torch.cat([x, p.repeat_interleave(STATES, 0)], -1)
loops = controller.rollout(z)
optimum = oracle_of(controller.problem, controller.method).solve(z, loops.u).cost
print(f"{int(optimum.isnan().sum())} of {len(z)} states without optimum")


def lqr_costs(which: int) -> torch.Tensor:
    """Costs from a member's states under its own LQR, cut at its limits."""
    own = in_float64(controller.with_(**members[which]).problem)
    states = x[which * STATES : (which + 1) * STATES].double()
    return path_under(own, greedy_law(own, riccati(own)), states).cost


for name, cost in (("V", loops.cost), ("LQR", torch.cat([lqr_costs(k) for k in range(MEMBERS)]))):
    both = [each.where(optimum.isfinite(), 0).double().unflatten(0, (MEMBERS, STATES)) for each in (cost, optimum)]
    ratio = both[0].sum(1) / both[1].sum(1)
    worst = members[int(ratio.argmax())]
    print(f"{name}: mean of the members {ratio.mean():.4f}, worst {ratio.max():.4f} at {worst}")
