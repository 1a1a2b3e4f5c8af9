"""An ellipsoid of controls."""

import math

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from lyapnet.base.errors import UsageError
from lyapnet.controller.controller import Controller
from lyapnet.exchange.export import export
from lyapnet.exchange.export.c import FLAGS, NAME, CompiledLaw, Style
from lyapnet.exchange.export.law import Law
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import config_from_plain
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.ellipsoid import ControlEllipsoid
from lyapnet.task.systems import SYSTEMS, Rocket
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.policy import SampledPolicy
from tests.problems import problem_of

H, CENTER = [[1.1, 0.4], [-0.2, 0.7]], [0.3, -0.1]
PLAIN = {
    "experiment": "x", "system": {"name": "rocket"}, "cost": {"Q": 1, "R": 0.1, "Q_T": 10},
    "controls": {"name": "ellipsoid", "parameters": {"radii": H, "center": CENTER}},
    "initial_states": {"lower": -1, "upper": 1}, "horizon": {"steps": 10, "dt": 0.1},
}  # fmt: skip


class Bowl(ValueFunction):
    """V = xᵀPx with a P that couples position and velocity."""

    def forward(self, t, x):
        place, speed = x[..., :2], x[..., 2:]
        return (8 * place**2 + 8 * place * speed + 8 * speed**2).sum(-1)


def is_within(u, radii=H, center=CENTER):
    """‖H⁻¹(u − c)‖ ≤ 1, in more digits than float64 has."""
    (a, b), (c, d) = np.array(radii, dtype=np.longdouble)
    x, y = (np.asarray(u, dtype=np.float64).astype(np.longdouble) - np.array(center)).T
    return (d * x - b * y) ** 2 + (a * y - c * x) ** 2 <= (a * d - b * c) ** 2


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("radii", [H, [[1.0, 0.0], [0.0, 1e-3]], [[1.0, 0.999], [0.999, 1.0]]])
def test_no_control_leaves_it_to_the_last_bit(radii, dtype):
    controls, v = ControlEllipsoid(radii, [3.0, -7.0]).to(dtype), torch.randn(20_000, 2, dtype=dtype)
    u = controls.applied(torch.zeros(20_000, 1, dtype=dtype), 10 * v)
    assert is_within(u, radii, [3.0, -7.0]).all()
    if dtype == torch.float32:
        return
    assert not is_within(controls.moved(v, 1.0001 * v / v.norm(dim=-1, keepdim=True)), radii, [3.0, -7.0]).any()
    back = controls.asked(v, controls.moved(v, v))
    assert_close(back, v, atol=1e-6, rtol=0)


def test_the_best_control_is_that_of_another_solver():
    system, cost = SYSTEMS["reacher"](), QuadraticCost(torch.eye(4), [[2.0, 0.9], [0.9, 1.0]], torch.eye(4))
    problem = problem_of(system, cost, controls=ControlEllipsoid(H, CENTER))
    x, p = torch.randn(40, 4), torch.logspace(-3, 1, 40)[:, None] * torch.randn(40, 4)
    R = problem.cost.R(x)
    b = (problem.system.g(x).mT @ p[..., None])[..., 0] - 2 * (R @ problem.rest_at(x)[..., None])[..., 0]
    u = problem.controls.applied(x, problem.best_control(R, b))
    W, own = torch.tensor([[2.0, 0.9], [0.9, 1.0]]), (system.g(x).mT @ p[..., None])[..., 0]
    angles = torch.linspace(0, 2 * math.pi, 200_000)[:, None, None]
    border = torch.tensor(CENTER) + torch.cat([angles.cos(), angles.sin()], -1) @ torch.tensor(H).mT
    free = -torch.linalg.solve(2 * W, own.mT).mT

    def paid(u):
        return torch.einsum("...i,ij,...j->...", u, W, u) + (own * u).sum(-1)

    inside = torch.from_numpy(is_within(free))
    least = torch.where(inside, paid(free), torch.stack([paid(part).amin(0) for part in border.split(5000)]).amin(0))
    assert_close(paid(u), least, rtol=1e-7, atol=1e-7)
    assert bool(inside.any())
    assert not bool(inside.all()), "its border"
    with pytest.raises(AssertionError):
        assert_close(paid(0.99 * u), least, rtol=1e-7, atol=1e-7)


@pytest.mark.gate
def test_a_controller_says_controls_of_it_and_so_does_its_c(tmp_path):
    own = Controller(build_problem(config_from_plain(PLAIN)), Bowl(), policy=SampledPolicy)
    x = 2 * torch.randn(2000, 4)
    u = own.policy(0.0, x)
    assert is_within(u).all()
    loop, system, J, y = own.rollout(x[:20]), Rocket(), 0.0, x[:20]
    for k in range(10):
        J = J + 0.1 * own.cost.running(y, loop.u[k])
        y = y + 0.1 * system.dynamics(y, loop.u[k])
    assert_close(J + own.cost.terminal(y), loop.cost)
    for dtype in ("float64", "float32"):
        export(own, tmp_path / dtype, "c", dtype=dtype)
        kind = getattr(torch, dtype)
        law = CompiledLaw(tmp_path / dtype, Law(own, kind), 2, FLAGS, Style(NAME, kind), None)
        found = law.of_many(np.zeros(len(x)), x.numpy())[0]
        assert is_within(found).all()
        assert np.abs(found - u.numpy()).max() < 1e-3


@pytest.mark.parametrize(
    ("radii", "center", "words"),
    [
        ([1.0, -1.0], None, "numbers > 0"),
        ([[1.0, 2.0], [2.0, 4.0]], None, "condition"),
        ([[1.0, 2.0]], None, "square"),
        ([1.0, math.nan], None, "finite"),
        ("wide", None, "list of numbers"),
        ([1.0, 1.0], [0.0], "center of 2"),
    ],
)
def test_an_ellipsoid_without_meaning_is_refused(radii, center, words):
    with pytest.raises(ValueError, match=rf"Expected .*{words}.*, got .+[;:] .+"):
        ControlEllipsoid(radii, center)


def test_an_ellipsoid_of_other_controls_is_refused():
    with pytest.raises(UsageError, match=r"Expected an ellipsoid of 1 controls \(torque\), got 2; .+"):
        problem_of(SYSTEMS["pendulum"](), controls=ControlEllipsoid(H))
