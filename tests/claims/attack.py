"""Attacks proved claims under noise by simulated paths: python -m tests.claims.attack PROOF CKPT [--paths 1000000].

Euler–Maruyama paths start at the corner of X₀ with the largest V(0, ·), where the bounds are weakest. For levels ρ' up
to that of the claim it prints the share of paths that rise above ρ' beside the bound of the theorem, and the mean cost
or time beside its bound. A share above its bound by more than four standard errors is a failure, exit status 1.
"""

import argparse
import math
import sys
from pathlib import Path

import torch

import lyapnet
from lyapnet.base.contracts import copied
from lyapnet.claims.arguments import with_noise
from lyapnet.claims.checking import check
from lyapnet.prover.kept_proofs import read_proofs

BATCH, SHARES = 50_000, (0.5, 0.1, 0.03, 0.01)  # paths at once; bounds whose levels are looked at


def attack_funnel(controller, claim, of, paths, finer, generator):
    """(name, observed, its standard error, bound) of a funnel under noise."""
    problem, loop = controller.problem, copied(controller.closed_loop)
    V, T, dt = loop.V, controller.horizon.duration, controller.horizon.dt / finer
    corner = _worst_corner(problem, V)
    risk, rho, alpha, delta = claim["risk"], claim["rho"], of["alpha"], of["delta"]
    at = float(V(torch.zeros(()), corner))
    levels = [level for level in (at - math.log(share) / risk for share in SHARES) if level < rho] + [rho]
    highest, paid = [], []
    with torch.no_grad():
        for size in _batches(paths):
            x, top, cost = corner.expand(size, -1).clone(), torch.full((size,), at), torch.zeros(size)
            for n in range(problem.horizon.steps * finer):
                t = torch.tensor(n * dt)
                u, inside = loop.policy(t, x), top <= rho
                cost += torch.where(inside, dt * loop.cost.running(x, u), 0.0)
                x = x + dt * loop.system.dynamics(x, u)
                x = x + loop.noise.displacement(x, loop.noise.draw(1, dt, x, generator)[0])
                top = torch.maximum(top, V(t + dt, x))
            v = rho / alpha + claim["terminal_excess"]
            paid.append(cost + torch.where(top <= rho, loop.cost.terminal(x), v))
            highest.append(top)
    highest, paid = torch.cat(highest), torch.cat(paid)
    later = risk * claim["leak"] * T
    for level in levels:
        bound = math.exp(-risk * (level - at)) + later * math.exp(risk * (claim["rho_wanted"] - level))
        yield f"P(V > {level:.4g})", *_share(highest > level), min(1.0, bound)
    guaranteed = (at + delta * T) / alpha + claim["terminal_excess"]
    yield "expected cost", float(paid.mean()), float(paid.std()) / math.sqrt(paths), guaranteed


def attack_reach(controller, claim, of, paths, finer, generator):
    """(name, observed, its standard error, bound) of a target reached under noise."""
    loop, problem = with_noise(of["noise"], controller)
    loop, V = copied(loop), copied(loop).V
    dt, now, corner = controller.horizon.dt / finer, torch.zeros(()), _worst_corner(problem, V)
    target, risk, rho = torch.tensor(of["target"]), claim["risk"], claim["rho"]
    at = float(V(now, corner))
    levels = [level for level in (at - math.log(share) / risk for share in SHARES) if level < rho] + [rho]
    highest, time, lost, met = [], [], 0, 0
    with torch.no_grad():
        for size in _batches(paths):
            x, top = corner.expand(size, -1).clone(), torch.full((size,), at)
            n, tops = 0, []
            while len(x) and n * dt < 1000 * controller.horizon.duration:
                x = x + dt * loop.system.dynamics(x, loop.policy(now, x))
                x = x + loop.noise.displacement(x, loop.noise.draw(1, dt, x, generator)[0])
                n, top = n + 1, torch.maximum(top, V(now, x))
                for box in torch.tensor(of["avoided"]).reshape(-1, 2, x.shape[-1]):
                    met += int(((x >= box[0]) & (x <= box[1])).all(-1).sum())
                ended = ((x >= target[0]) & (x <= target[1])).all(-1)
                tops.append(top[ended])
                time.append(torch.full((int(ended.sum()),), n * dt))
                x, top = x[~ended], top[~ended]
            lost += len(x)
            highest.append(torch.cat([*tops, top]))
    highest, time = torch.cat(highest), torch.cat(time)
    for level in levels:
        yield f"P(V > {level:.4g})", *_share(highest > level), math.exp(-risk * (level - at))
    yield "share not there in the end", lost / paths, math.sqrt(lost) / paths, math.exp(-risk * (rho - at))
    yield "states in a box to avoid, per path", met / paths, math.sqrt(met) / paths, math.exp(-risk * (rho - at))
    spread = float(time.std()) / math.sqrt(paths)
    yield "mean time to the target, s", float(time.mean()), spread, (at - claim["lowest"]) / claim["rate"]


def _worst_corner(problem, V):
    corners = copied(problem).initial_states.corners()
    return corners[int(V(torch.zeros(()), corners).argmax())]


def _batches(paths):
    return [min(BATCH, paths - begun) for begun in range(0, paths, BATCH)]


def _share(of):
    share = float(of.double().mean())
    return share, math.sqrt(share * (1 - share) / len(of))


ATTACKS = {"noisy": attack_funnel, "reach": attack_reach}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("proof", type=Path)
    parser.add_argument("checkpoint")
    parser.add_argument("--paths", type=int, default=1_000_000)
    parser.add_argument("--finer", type=int, default=5, help="steps for each Δt")
    given = parser.parse_args()
    torch.set_default_dtype(torch.float64)
    controller = lyapnet.load(given.checkpoint)
    claim = check(controller, given.proof)
    if claim["verdict"] != "certified":
        print(f"the proof is refused: {claim['reason']}")
        return 1
    of, failed = read_proofs(given.proof)[claim["of"]]["of"][0], False
    generator = torch.Generator().manual_seed(0)
    print(f"{given.paths} paths, Δt = {controller.horizon.dt / given.finer:g} s")
    for name, observed, error, bound in ATTACKS[claim["of"]](
        controller, claim, of, given.paths, given.finer, generator
    ):
        broken = observed - 4 * error > bound
        failed |= broken
        print(f"{name:36} {observed:.6g} ± {error:.2g}   bound {bound:.6g}{'   BROKEN' * broken}")
    return failed


if __name__ == "__main__":
    sys.exit(main())
