"""A polytope of controls."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from torch.testing import assert_close

from lyapnet.base.errors import UsageError
from lyapnet.claims.certify import certify
from lyapnet.claims.kinds import Funnel, Region, Tube
from lyapnet.controller.controller import Controller
from lyapnet.evaluation.measurement import evaluate
from lyapnet.exchange.export import export
from lyapnet.exchange.export.c import FLAGS, NAME, CompiledLaw, Style
from lyapnet.exchange.export.law import Law
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import config_from_plain
from lyapnet.task.polytope import ControlPolytope
from lyapnet.value.policy import HJBPolicy, SampledPolicy
from tests.task.test_ellipsoid import Bowl

A, B = [[1.0, 1.0], [-1.0, 0.0], [0.0, -1.0], [2.0, -1.0], [-1.0, 3.0]], [1.5, 1.0, 0.7, 2.0, 3.1]


def drawn(m, k, generator):
    """A random polytope of k rows about a random point, and a box around it."""
    normals = torch.randn(k, m, generator=generator).double()
    inner = torch.randn(m, generator=generator).double()
    sides = normals @ inner + torch.rand(k, generator=generator).double() + 0.1
    one = torch.eye(m).double()
    return torch.cat([normals, one, -one]), torch.cat([sides, inner + 2, 2 - inner])


def dual_minimum(R, b, normals, sides):
    """The minimiser of uᵀRu + bᵀu over Au ≤ b from its dual, min over λ ≥ 0, by L-BFGS-B and its rows solved again."""
    G = np.linalg.inv(2 * R)
    H, h = normals @ G @ normals.T, normals @ G @ b + sides
    found = minimize(
        lambda y: (y @ H @ y / 2 + h @ y, H @ y + h), np.zeros(len(sides)), jac=True, method="L-BFGS-B",
        bounds=[(0, None)] * len(sides), options={"ftol": 1e-16, "gtol": 1e-12, "maxiter": 20_000, "maxcor": 30},
    )  # fmt: skip
    held = found.x > 1e-6 * max(1.0, found.x.max())
    y = np.zeros(len(sides))
    if held.any():
        y[held] = np.linalg.lstsq(H[np.ix_(held, held)], -h[held], rcond=None)[0]
    u = -G @ (b + normals.T @ y)
    right = (normals @ u <= sides + 1e-9).all() and (y >= -1e-9).all()
    return u if right else None


@pytest.mark.parametrize("m", [1, 2, 3, 4])
def test_the_minimum_is_that_of_another_solver(m):
    """Of random polytopes and costs, at 1e-9; the twin is the minimum over another polytope."""
    generator, compared = torch.Generator().manual_seed(m), 0
    for _ in range(12):
        normals, sides = drawn(m, 3, generator)
        controls = ControlPolytope(normals.tolist(), sides.tolist())
        L = torch.randn(10, m, m, generator=generator).double()
        R = L @ L.mT + 0.05 * torch.eye(m).double()
        b = 6 * torch.randn(10, m, generator=generator).double()
        u = controls.minimise(R, b)
        assert controls.contains(u).all()
        for k in range(10):
            expected = dual_minimum(R[k].numpy(), b[k].numpy(), normals.numpy(), sides.numpy())
            if expected is not None:
                compared += 1
                assert_close(u[k], torch.from_numpy(expected), rtol=1e-9, atol=1e-9)
    assert compared > 100
    other = ControlPolytope(normals.tolist(), (sides + 0.01).tolist()).minimise(R, b)
    assert bool((other - u).abs().max() > 1e-3)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e4])
def test_no_control_leaves_it_to_the_last_bit(dtype, scale):
    controls = ControlPolytope(A, [scale * side for side in B]).to(dtype)
    L, b = torch.randn(5000, 2, 2, dtype=dtype), 10 * scale * torch.randn(5000, 2, dtype=dtype)
    u = controls.minimise(L @ L.mT + 0.01 * torch.eye(2, dtype=dtype), b)
    rows, sides = np.array(A, dtype=np.longdouble), np.array([scale * side for side in B], dtype=np.longdouble)
    reached = u.double().numpy().astype(np.longdouble) @ rows.T
    assert (reached <= sides).all()
    assert ((reached > sides * (1 - 1e-4)).any(0)).all(), "each of its sides"
    beside = controls.project(10 * scale * torch.randn(5000, 2, dtype=dtype)).double().numpy()
    assert (beside.astype(np.longdouble) @ rows.T <= sides).all()
    assert not (1.001 * reached <= sides).all()


def test_the_derivative_is_that_of_differences():
    controls = ControlPolytope(A, B)
    R, b = torch.tensor([[1.0, 0.4], [0.4, 0.5]]), (4 * torch.randn(300, 2)).requires_grad_()
    R = R.expand(300, 2, 2)
    u = controls.minimise(R, b)
    slope = torch.stack([torch.autograd.grad(u[:, i].sum(), b, retain_graph=True)[0] for i in range(2)], 1)
    step, one = 1e-6, torch.eye(2)
    ends = [[controls.minimise(R, b.detach() + sign * step * one[j]) for j in range(2)] for sign in (1, -1)]
    differences = torch.stack([(ends[0][j] - ends[1][j]) / (2 * step) for j in range(2)], -1)
    bend = torch.stack([ends[0][j] + ends[1][j] - 2 * u.detach() for j in range(2)], -1).abs().amax((-2, -1))
    smooth = bend < 1e-9
    assert_close(slope[smooth], differences[smooth], rtol=1e-5, atol=1e-6)
    tangents, inverse = controls.tangents(u.detach()), torch.linalg.inv(2 * R)
    rank = tangents.diagonal(dim1=-2, dim2=-1).sum(-1).round()
    assert {0, 1, 2} == set(rank.tolist()), "corners, edges and the inside"
    free = rank == 2
    assert_close(slope[free], -inverse[free])
    assert_close(slope[rank == 0], torch.zeros_like(slope[rank == 0]))
    assert smooth.sum() > 290


PLAIN = {
    "experiment": "x", "system": {"name": "rocket"}, "cost": {"Q": 1, "R": 0.1, "Q_T": 10},
    "controls": {"name": "polytope", "parameters": {"A": A, "b": B}},
    "initial_states": {"lower": -1, "upper": 1}, "horizon": {"steps": 10, "dt": 0.1},
}  # fmt: skip


@pytest.mark.gate
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_an_exported_law_stays_within_it(dtype, tmp_path):
    own = Controller(build_problem(config_from_plain(PLAIN)), Bowl(), policy=SampledPolicy)
    x, kind = 2 * torch.randn(1000, 4), getattr(torch, dtype)
    export(own, tmp_path / "law", "c", dtype=dtype)
    law = CompiledLaw(tmp_path / "law", Law(own, kind), 2, FLAGS, Style(NAME, kind), None)
    u = law.of_many(np.zeros(1000), x.numpy())[0].astype(np.longdouble)
    assert (u @ np.array(A, dtype=np.longdouble).T <= np.array(B, dtype=np.longdouble)).all()
    assert np.abs(u - own.policy(0.0, x).numpy()).max() < 1e-3


@pytest.mark.parametrize(
    ("rows", "sides", "words"),
    [
        (A, B[:3], "number for each"),
        ([[0.0, 0.0], *A], [1.0, *B], "not zero"),
        (A[:2], B[:2], "bounded"),
        ([[1.0], [-1.0]], [1.0, -2.0], "not empty"),
        ([[1.0], [-1.0]], [1.0, -1.0], "an inside"),
        ([[math.nan], [-1.0]], [1.0, 1.0], "finite"),
        (np.vstack([np.eye(5), -np.eye(5)]).tolist(), [1.0] * 10, "at most 4 controls"),
    ],
)
def test_a_polytope_without_meaning_is_refused(rows, sides, words):
    with pytest.raises(ValueError, match=rf"Expected .*{words}.*, got .+[;:] .+"):
        ControlPolytope(rows, sides)


def test_the_evaluation_says_how_often_controls_are_on_its_border():
    plane = {"A": [[0, 0, 1, 0], [0, 0, 0, 1], [0, 0, 0, 0], [0, 0, 0, 0]], "B": [[0, 0], [0, 0], [1, 0], [0, 1]]}
    near = {**PLAIN, "system": {"name": "linear", "parameters": plane}}
    own = Controller(build_problem(config_from_plain(near)), Bowl(), policy=SampledPolicy)
    border = evaluate(own, samples=20, optimum=False)["at_border"]
    assert 0 < border["steps"] < border["states"] <= 1
    u = own.controls.inner + torch.tensor([[0.0, 0.0], [1e-3, 0.0]])
    assert not bool(own.controls.at_border(u).any())
    assert bool(own.controls.at_border(own.controls.project(100 * torch.randn(50, 2))).all())
    wide = {**near, "horizon": {"steps": 10, "dt": 0.01}, "controls": {"name": "ball", "parameters": {"radius": 1e6}}}
    inside = Controller(build_problem(config_from_plain(wide)), Bowl(), policy=SampledPolicy)
    assert evaluate(inside, samples=20, optimum=False)["at_border"] == {"steps": 0, "states": 0}


def test_what_does_not_know_it_refuses_it():
    plain = {**PLAIN, "cost": {**PLAIN["cost"], "control_costs": [{"name": "norm", "weight": 1}]}}
    with pytest.raises(UsageError, match=r"Expected costs of controls .+ in ControlPolytope, got NormCost; .+"):
        build_problem(config_from_plain(plain))
    own = Controller(build_problem(config_from_plain(PLAIN)), Bowl(), policy=HJBPolicy)
    for claim in (Funnel(), Region(), Tube()):
        with pytest.raises(UsageError, match=r"Expected .+ certificate, got uᵀRu in ControlPolytope; .+"):
            certify(own, claim)
    pytest.importorskip("casadi")
    from lyapnet.lab.comparison.planners.mpc import PredictiveControl

    with pytest.raises(UsageError, match=r"Expected limits and uᵀRu alone for MPC, got .+; .+"):
        PredictiveControl(own.problem, 20)
