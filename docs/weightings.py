"""Cost over optimum at 50 random members of a family, from 8 states each: python docs/weightings.py CKPT."""

import sys

import torch

import lyapnet
from lyapnet.evaluation.oracles import oracle_of
from lyapnet.task.family import FamilySystem

MEMBERS, STATES = 50, 8
controller = lyapnet.load(sys.argv[1])
box, system = controller.initial_states, controller.system
assert isinstance(system, FamilySystem), "a controller of a family"
n, draw = system.n - len(system.constants), torch.Generator().manual_seed(12345)
p = box.sample(MEMBERS, draw)[:, n:]
x = box.sample(MEMBERS * STATES, draw)[:, :n]
z = torch.cat([x, p.repeat_interleave(STATES, 0)], -1)
loops = controller.rollout(z)
optimum = oracle_of(controller.problem, controller.method).solve(z, loops.u).cost.unflatten(0, (MEMBERS, STATES))
cost = loops.cost.unflatten(0, (MEMBERS, STATES))
ratio = cost.where(optimum.isfinite(), 0).sum(1) / optimum.nan_to_num().sum(1)
worst = int(ratio.argmax())
print(f"{int(optimum.isnan().sum())} of {MEMBERS * STATES} states without optimum")
print(f"cost / optimum: mean of the members {ratio.mean():.4f}, worst {ratio[worst]:.4f}", end="")
print(f" at {system.values(p[worst].tolist())}")
