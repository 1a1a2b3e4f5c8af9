"""The best control against IPOPT: costs of controls with each set that they may have, 1 to 6 controls.

`python -m tests.task.test_minima_by_ipopt --draws 100000` prints the largest gaps of each pair.
"""

import argparse
import math

import numpy as np
import pytest
import torch

from lyapnet.task.ball import ControlBall
from lyapnet.task.cost.control_costs import (
    AbsoluteCost,
    EntropyCost,
    LogCosCost,
    NormCost,
    PowerCost,
    PseudoHuberControlCost,
)
from lyapnet.task.cost.minimum import least_over
from lyapnet.task.sets import ControlBox
from tests.prover.test_minima import pairs

casadi = pytest.importorskip("casadi")
TOGETHER = 1000  # minimisations in one program of IPOPT
OPTIONS = {
    "ipopt.print_level": 0,
    "print_time": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-9,
    "ipopt.max_iter": 300,
    "ipopt.bound_relax_factor": 1e-12,  # its default of 1e-8 lets ‖u‖ be 1e-4 where u·u ≤ a² = 0
}


def own(cost, a, i):
    """The cost of |u| = a of control i, as an expression."""
    w = float(cost.weight.expand(6)[i]) if cost.weight.ndim == 0 else float(cost.weight[i])
    if isinstance(cost, AbsoluteCost):
        return w * a
    if isinstance(cost, PowerCost):
        return w * a**cost.exponent
    if isinstance(cost, PseudoHuberControlCost):
        return w * (casadi.sqrt(a * a + cost.width**2) - cost.width)
    end = float(cost.limit)
    if isinstance(cost, LogCosCost):
        return -w * 8 * end**2 / math.pi**2 * casadi.log(casadi.cos(math.pi * a / (2 * end)))
    assert isinstance(cost, EntropyCost)
    v = a / end
    return w * end**2 * ((1 - v) * casadi.log(1 - v) + (1 + v) * casadi.log(1 + v))


def solver(s, U, m):
    """(IPOPT for TOGETHER minimisations with parameters (W, b), their limits)."""
    k = TOGETHER
    u, W, b = casadi.MX.sym("u", m, k), casadi.MX.sym("W", m * m, k), casadi.MX.sym("b", m, k)
    x, constraints, value = [casadi.vec(u)], [], casadi.dot(b, u)
    for i in range(m):
        for j in range(m):
            value += casadi.dot(W[m * i + j, :], u[i, :] * u[j, :])
    costs = [] if s is None else [*s.costs]
    norms = [cost for cost in costs if isinstance(cost, NormCost)]
    if norms:  # a ≥ ‖u‖
        a = casadi.MX.sym("a", 1, k)
        x.append(casadi.vec(a))
        constraints.append(casadi.vec(casadi.sum1(u * u) - a * a))
        value += float(norms[0].weight) * casadi.sum2(a)
    elif costs:  # a ≥ |u|
        a = casadi.MX.sym("a", m, k)
        x.append(casadi.vec(a))
        constraints += [casadi.vec(u - a), casadi.vec(-u - a)]
        value += sum(casadi.sum2(own(cost, a[i, :], i)) for cost in costs for i in range(m))
    if isinstance(U, ControlBall):
        constraints.append(casadi.vec(casadi.sum1(u * u) - float(U.radius) ** 2))
    program = {"x": casadi.vertcat(*x), "f": value, "p": casadi.vertcat(casadi.vec(W), casadi.vec(b))}
    if constraints:
        program["g"] = casadi.vertcat(*constraints)
    low, high = (side.expand(m).numpy() for side in U.limits) if isinstance(U, ControlBox) else (-np.inf, np.inf)
    lower, upper = (np.broadcast_to(np.asarray(side), (k, m)).ravel() for side in (low, high))
    n = program["x"].numel() - m * k
    ends = [float(end) for end in ([] if s is None else s.open_limits)]
    lower = np.concatenate([lower, np.zeros(n)])
    upper = np.concatenate([upper, np.full(n, (1 - 1e-7) * min(ends, default=np.inf))])
    return casadi.nlpsol("s", "ipopt", program, OPTIONS), lower, upper


def gaps(name, m, draws):
    """(largest excess of the minimum over IPOPT's, that of IPOPT's, relative to bᵀu; how many IPOPT solved)."""
    torch.manual_seed(m)
    s, U = pairs(m)[name]
    solve, lower, upper = solver(s, U, m)
    above = below = 0.0
    solved = 0
    for _ in range(math.ceil(draws / TOGETHER)):
        A = torch.randn(TOGETHER, m, m)
        W = A @ A.mT * 10 ** (torch.rand(TOGETHER, 1, 1) - 1) + 0.05 * torch.eye(m)
        b = torch.randn(TOGETHER, m) * 10 ** (2 * torch.rand(TOGETHER, 1) - 1)
        found = least_over(s, U, W, b)
        assert U.contains(found.u).all()
        start = 0.3 * np.ones(len(lower))
        p = np.concatenate([W.reshape(TOGETHER, -1).numpy().ravel(), b.numpy().ravel()])
        answer = solve(x0=np.clip(start, lower, upper), p=p, lbx=lower, ubx=upper, lbg=-np.inf, ubg=0.0)
        if not solve.stats()["success"]:
            continue
        solved += TOGETHER
        u = torch.from_numpy(np.array(answer["x"])[: m * TOGETHER, 0].reshape(TOGETHER, m))
        u = U.project(u)
        value = ((W @ u[..., None])[..., 0] + b).mul(u).sum(-1) + (0 if s is None else s(u))
        scale = 1 + b.abs().sum(-1) * found.u.abs().amax(-1)
        above = max(above, float(((found.value - value) / scale).max()))
        below = max(below, float(((value - found.value) / scale).max()))
    return above, below, solved


@pytest.mark.nightly
@pytest.mark.parametrize("m", range(1, 7))
@pytest.mark.parametrize("name", pairs(1))
def test_no_control_of_ipopt_is_better(name, m):
    above, below, solved = gaps(name, m, TOGETHER)
    assert solved == TOGETHER
    assert above < 1e-12
    assert below < 1e-6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=100_000, help="for each pair, shared out among 1 to 6 controls")
    parser.add_argument("--each", action="store_true", help="for each number of controls instead")
    given = parser.parse_args()
    torch.set_default_dtype(torch.float64)
    for name in pairs(1):
        found = [gaps(name, m, given.draws if given.each else given.draws / 6) for m in range(1, 7)]
        solved = sum(each[2] for each in found)
        above, below = (max(each[k] for each in found) for k in (0, 1))
        print(f"{name:32} {solved:7} solved by IPOPT   above it {above:9.2g}   below it {below:9.2g}", flush=True)


if __name__ == "__main__":
    main()
