"""Attacks proved claims about held laws: python -m tests.claims.attack_held PROOF CKPT [--loops 100000].

Closed loops are simulated from X₀ and from the edge of the region or the funnel's mouth, with readings at random times,
delays, errors of the largest size and pushes. Half of them start where an ascent of V after one hold
has found the largest rise. Prints the highest level that a loop reaches beside the proved one, the largest cost beside
the guaranteed one, and for a region the highest V in the end beside c; exit status 1 if one is beyond.
"""

import argparse
import sys
from pathlib import Path

import torch

import lyapnet
from lyapnet.base.contracts import copied
from lyapnet.claims.checking import check
from lyapnet.prover.kept_proofs import read_proofs
from tests.claims.held_loops import held_loops

BATCH, STEPS = 5000, 30
LONG = 20  # horizons that the loops of a region last


def attack(proof: Path, checkpoint: str, loops: int) -> bool:
    """Whether no loop is beyond what is proved."""
    controller = lyapnet.load(checkpoint)
    result, generator = check(controller, proof), torch.Generator().manual_seed(0)
    if result["verdict"] != "certified":
        print(f"refused: {result['reason']}")
        return False
    kind = "region" if result["of"] == "region" else "above"
    facts = read_proofs(proof)[kind]["of"][0]
    readings, push = facts["readings"], facts.get("disturbance")
    loop, X0 = copied(controller.closed_loop).requires_grad_(False), controller.initial_states
    D, rho = torch.tensor(result["set"], dtype=torch.float64), result["rho"]
    T, receding = controller.horizon.duration, kind == "region"
    now, highest, dearest, last = torch.zeros((), dtype=torch.float64), [], [], []
    for k in range(0, loops, BATCH):
        x0 = _starts(loop, X0, D, rho, min(BATCH, loops - k), readings, generator)
        with torch.no_grad():
            V0, top = loop.V(now, x0), torch.full((len(x0),), -torch.inf, dtype=torch.float64)
            for t, x, paid in held_loops(
                loop, x0, LONG * T if receding else T, readings["interval"], readings["delay"], readings["errors"],
                readings["control_errors"], generator, push=push, receding=receding, fine=2,
            ):  # fmt: skip
                W = loop.V(0 * t, x) if receding else loop.V(t, x) - result["delta"] * t
                top, end, cost = torch.maximum(top, W), x, paid
            highest.append(float((top - rho).max()))
            if receding:
                last.append(float(loop.V(0 * now, end).max()))
            else:
                bound = (V0 + result["delta"] * T) / result["alpha"] + result["terminal_excess"]
                dearest.append(float(((cost + loop.cost.terminal(end)) / bound).max()))
        print(f"{k + len(x0)} loops: highest level − ρ = {max(highest):.3e} (ρ = {rho:.6g})"
              + (f", last V {max(last):.3e} (c = {result['ultimate_level']:.3e})" if receding
                 else f", largest cost / guaranteed {max(dearest):.4f}"), flush=True)  # fmt: skip
    held = max(highest) <= 1e-9 * abs(rho) and (not last or max(last) <= result["ultimate_level"])
    return held and (not dearest or max(dearest) <= 1)


def _starts(loop, X0, D, rho, many, readings, generator):
    """States with V(0, x) ≤ ρ: a third in X₀, the others on the edge of the level set, half of these by ascent."""
    now, inside = torch.zeros((), dtype=torch.float64), X0.sample(many // 3, generator).double()
    with torch.no_grad():
        inside = inside[loop.V(now, inside) <= rho]
    free = many - len(inside)
    ray = torch.randn(free, D.shape[-1], generator=generator, dtype=torch.float64) * (D[1] - D[0]) / 2
    low, high = torch.zeros(free), torch.ones(free) * 4
    center = D.mean(0)
    with torch.no_grad():
        for _ in range(50):  # the edge on each ray, from the middle of D
            middle = (low + high) / 2
            point = center + middle[:, None].double() * ray
            within = (loop.V(now, point) <= rho) & ((D[0] <= point) & (point <= D[1])).all(-1)
            low, high = torch.where(within, middle, low), torch.where(within, high, middle)
    edge = center + low[:, None].double() * ray
    half = edge[: free // 2].clone()
    for step in range(STEPS):
        x = half.detach().requires_grad_()
        u = loop.policy(now, x)
        after = x + readings["interval"] * loop.system.dynamics(x, u)
        rise = (loop.V(now, after) - loop.V(now, x)).sum()
        (slope,) = torch.autograd.grad(rise, x)
        moved = half + 0.02 * 0.9**step * (D[1] - D[0]) * slope.sign()
        with torch.no_grad():
            fits = (loop.V(now, moved) <= rho) & ((D[0] <= moved) & (moved <= D[1])).all(-1)
        half = torch.where(fits[:, None], moved, half)
    return torch.cat([inside, half.detach(), edge[free // 2 :]])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("proof", type=Path)
    parser.add_argument("checkpoint")
    parser.add_argument("--loops", type=int, default=100_000)
    given = parser.parse_args()
    torch.set_default_dtype(torch.float64)
    sys.exit(not attack(given.proof, given.checkpoint, given.loops))
