"""Attacks proved regions of steps: python -m tests.claims.attack_steps PROOF CKPT [--loops 100000] [--ascents 10000].

The proof is checked first. Then sequences of steps are simulated from states of the region, half of them within 5 % of
its edge, and the violations V(F(x)) − (1 − λΔt) max(V(x), c) and of F(x) ∈ D are ascended from others, within the
region. Prints the largest violation of each, the highest V after T and the largest distance from the goal; exit status
1 if the claim is violated by more than rounding.
"""

import argparse
import sys
from pathlib import Path

import torch

import lyapnet
from lyapnet.base.contracts import copied
from lyapnet.claims.checking import check
from lyapnet.prover.kept_proofs import read_proofs

BATCH, ASCENT = 20_000, 60
ROUNDING = 1e-9


def attack(proof: Path, checkpoint: str, loops: int, ascents: int) -> bool:
    """Whether nothing violates the claim of a proof."""
    controller = lyapnet.load(checkpoint)
    result, generator = check(controller, proof), torch.Generator().manual_seed(1)
    if result["verdict"] != "certified":
        print(f"refused: {result['reason']}")
        return False
    facts = read_proofs(proof)["region"]["of"][0]
    if "steps" not in facts:
        raise SystemExit("Expected the proof of a region of steps, got another; see attack_held.")
    problem, loop = copied(controller.problem), copied(controller.closed_loop).requires_grad_(False)
    D, rho = torch.tensor(result["set"], dtype=torch.float64), result["rho"]
    c = result["ultimate_level" if facts.get("practical") else "hole"]
    q, t, goal = 1 - facts["decay"] * facts["steps"]["dt"], torch.zeros((), dtype=torch.float64), problem.goal.double()

    def step(x):
        return problem.step(x, loop.policy(t, x))[0]

    def violation(x):
        """(V(F(x)) − q max(V(x), c) relative to ρ, how far F(x) is outside of D), at most 0 by the claim; and F(x)."""
        after = step(x)
        outside = torch.maximum(D[0] - after, after - D[1]).amax(-1) / (D[1] - D[0]).max()
        return (loop.V(t, after) - q * loop.V(t, x).clamp_min(c)) / rho, outside, after

    def starts(many):
        """States of the region, every second one close to its edge."""
        found = []
        while sum(map(len, found)) < many:
            x = D[0] + (D[1] - D[0]) * torch.rand(50 * BATCH, D.shape[-1], generator=generator, dtype=torch.float64)
            with torch.no_grad():
                V = loop.V(t, x)
            edge, inside = x[(rho >= V) & (0.95 * rho < V)], x[rho >= V]
            found += [edge[: many // 2], inside[: many - min(len(edge), many // 2)]]
        return torch.cat(found)[:many]

    rise, out, last, far, paths = -torch.inf, -torch.inf, -torch.inf, 0.0, 0
    for k in range(0, loops, BATCH):
        x = starts(min(BATCH, loops - k))
        paths += len(x)
        with torch.no_grad():
            for _ in range(problem.horizon.steps):
                one, other, x = violation(x)
                rise, out = max(rise, float(one.max())), max(out, float(other.max()))
            last, far = max(last, float(loop.V(t, x).max())), max(far, float((x - goal).norm(dim=-1).max()))
        print(f"{paths} sequences: largest rise {rise:.3e} of ρ, largest exit {out:.3e} of D, last V {last:.3e} "
              f"(c = {c:.3e}), last distance {far:.3e}", flush=True)  # fmt: skip
    worst = [-torch.inf, -torch.inf]
    for which in (0, 1):
        x = starts(ascents // 2)
        for k in range(ASCENT):
            leaf = x.detach().requires_grad_()
            (slope,) = torch.autograd.grad(violation(leaf)[which].sum(), leaf)
            moved = x + 0.05 * 0.9**k * (D[1] - D[0]) * slope.sign()
            moved = moved.maximum(D[0]).minimum(D[1])
            with torch.no_grad():
                x = torch.where((loop.V(t, moved) <= rho)[:, None], moved, x)
                worst[which] = max(worst[which], float(violation(x)[which].max()))
        print(f"{len(x)} ascents: largest {('rise', 'exit')[which]} {worst[which]:.3e}", flush=True)
    held = max(rise, out, *worst) <= ROUNDING
    print("nothing violates the claim" if held else "VIOLATED")
    return held


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("proof", type=Path)
    parser.add_argument("checkpoint")
    parser.add_argument("--loops", type=int, default=100_000)
    parser.add_argument("--ascents", type=int, default=10_000)
    given = parser.parse_args()
    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    sys.exit(not attack(given.proof, given.checkpoint, given.loops, given.ascents))
