"""Tubes around closed loops, against closed forms and a second integrator; and false claims."""

import json
import re
from types import SimpleNamespace

import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.linalg import solve_continuous_lyapunov
from torch import nn

from lyapnet.base.errors import UsageError
from lyapnet.base.interpolation import Curve
from lyapnet.claims.certify import certify
from lyapnet.claims.kinds import Tube
from lyapnet.claims.tubes import enclosure
from lyapnet.claims.tubes.certificate import TubeCertificate
from lyapnet.claims.tubes.coordinates import Moving, bound_in_new_frame, bound_turn, ratio_of_errors
from lyapnet.claims.tubes.field import Field
from lyapnet.claims.tubes.tube import prove_tube
from lyapnet.cli import main
from lyapnet.controller.controller import Controller
from lyapnet.prover import bounds
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.task.constraints import StateLimits
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box
from lyapnet.task.systems import ControlAffineSystem, Linear
from tests.problems import Formula, problem_of

pytestmark = pytest.mark.usefixtures("one_closed_loop")

HALF, T = 0.3, 1.0


def controller(system=None, V=None, constraints=None, half=HALF):
    """The HJB law of V (0 by default) from |x_i| ≤ 0.3 over 1 s, with Q = R = Q_T = 1."""
    system = system or Linear([[0.0, 2.0], [-2.0, -0.5]], [[0.0], [1.0]])
    X0 = Box(torch.full((2,), -half).double(), torch.full((2,), half).double())
    about = problem_of(system, steps=20, dt=T / 20, initial_states=X0)
    if constraints is not None:
        about = Problem(about.system, about.cost, about.controls, about.initial_states, about.horizon, constraints)
    return Controller(about, V or Formula(lambda t, x: 0 * x.sum(-1) + 0 * t))


class Swinging(ControlAffineSystem):
    """θ̈ = 4 sin θ − θ̇ + u with a term in θ³."""

    state_names, state_units = ("angle", "rate"), ("rad", "rad/s")
    control_names, control_units = ("torque",), ("N·m",)

    def f(self, x):
        return torch.stack([x[..., 1], 4 * torch.sin(x[..., 0]) - x[..., 1] - x[..., 0] ** 3], -1)

    def g(self, x):
        return torch.tensor([[0.0], [1.0]]).to(x).expand(*x.shape[:-1], 2, 1)


def damped(t, x):
    """A V whose law brakes, more as time goes on."""
    return (3 * x[..., 0] ** 2 + x[..., 0] * x[..., 1] + x[..., 1] ** 2) * (1 + 0.5 * t)


@pytest.fixture(scope="module")
def straight():
    """The tube of the linear system without control."""
    return prove_tube(controller(), Budget(60))


@pytest.fixture(scope="module")
def swung():
    return prove_tube(controller(Swinging(), Formula(damped)), Budget(60))


def final(about, x0):
    """(x(T), J) by scipy, to 1e-10."""
    loop = about.closed_loop.double()

    def rate(t, y):
        return loop(torch.tensor(t).double(), torch.tensor(y).double()).detach().numpy()

    y = solve_ivp(rate, (0, T), [*x0, 0.0], method="DOP853", rtol=1e-10, atol=1e-12).y[:, -1]
    return y[:-1], y[-1] + float((y[:-1] ** 2).sum())


@pytest.mark.gate
def test_a_linear_flow_and_its_cost_in_closed_form(straight):
    """x(T) = e^{AT}x₀, and J = x₀ᵀPx₀ by a Lyapunov equation: the bounds contain them, and are tight."""
    A = torch.tensor([[0.0, 2.0], [-2.0, -0.5]]).double()
    flow = torch.linalg.matrix_exp(A * T)
    P = torch.from_numpy(solve_continuous_lyapunov(A.T.numpy(), -torch.eye(2).double().numpy()))
    P = P - flow.T @ P @ flow + flow.T @ flow
    claim = straight
    assert claim.verdict == "certified"
    assert claim.volume_share == 1
    reach = flow.abs().sum(-1) * HALF
    assert bool((claim.ends[..., 1].amax(0) >= reach).all())
    torch.testing.assert_close(claim.ends[..., 1].amax(0), reach, rtol=2e-3, atol=0)
    mean = float(P.trace()) * HALF**2 / 3
    low, high = claim.mean_cost
    assert low <= mean <= high
    assert high - low < 0.01 * mean
    x0 = torch.tensor([[0.3, 0.3], [-0.3, 0.1], [0.01, 0.29]]).double()
    exact, (lower, upper) = ((x0 @ P) * x0).sum(-1), claim.bounds_of_cost(x0)
    assert bool(((lower <= exact) & (exact <= upper)).all())
    assert claim.bounds_of_cost(torch.tensor([[0.4, 0.0]]))[1].tolist() == [torch.inf], "outside X₀"


def test_a_second_integrator_stays_within(swung):
    about = controller(Swinging(), Formula(damped))
    assert swung.verdict == "certified"
    x0 = torch.cat([about.initial_states.corners(), about.initial_states.sample(12, torch.Generator().manual_seed(1))])
    low, high = swung.bounds_of_cost(x0.double())
    for k, x in enumerate(x0.tolist()):
        end, cost = final(about, x)
        assert float(low[k]) <= cost <= float(high[k])
        inside = torch.tensor(end)
        assert bool(((swung.ends[..., 0].amin(0) <= inside) & (inside <= swung.ends[..., 1].amax(0))).all())
    assert float((high - low).max()) < 0.05 * float(high.mean()), "the bounds are tight"


@pytest.mark.gate
def test_the_machine_code_encloses_the_same(swung, monkeypatch):
    monkeypatch.setattr(bounds, "MANY", 10**9 if swung.steps > bounds.MANY else 0)
    other = prove_tube(controller(Swinging(), Formula(damped)), Budget(60))
    torch.testing.assert_close(torch.tensor(other.mean_cost), torch.tensor(swung.mean_cost), rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(other.ends, swung.ends, rtol=1e-8, atol=1e-10)


def limit(bound):
    return StateLimits([0], [bound], [1.0], [1.0], ["angle"])


@pytest.mark.gate
def test_constraints_are_kept_or_violated_and_which_is_proved(straight):
    peak = float(straight.ranges[..., 0, 1].max())
    kept = prove_tube(controller(constraints=limit(1.05 * peak)), Budget(60))
    assert kept.verdict == "certified"
    assert list(kept.constraints) == ["angle"]
    violated = prove_tube(controller(constraints=limit(0.9 * peak)), Budget(60))
    assert violated.verdict == "falsified"
    x0 = torch.tensor(violated.violating).double()
    A, t = torch.tensor([[0.0, 2.0], [-2.0, -0.5]]).double(), torch.linspace(0, T, 200).double()
    assert float((torch.linalg.matrix_exp(A * t[:, None, None]) @ x0)[:, 0].max()) > 0.9 * peak, "it does"


@pytest.mark.gate
def test_the_end_within_a_radius(straight):
    radii = 1.001 * straight.reach, 0.5 * straight.reach
    asked = [prove_tube(controller(), Budget(60), radius=r).verdict for r in radii]
    assert asked == ["certified", "falsified"]


class Escaping(Swinging):
    """ẋ = x², ẏ = u − y: from x₀ > 1, x is at infinity before 1 s."""

    def f(self, x):
        return torch.stack([x[..., 0] ** 2, -x[..., 1]], -1)


@pytest.mark.gate
def test_what_escapes_is_not_proved():
    assert prove_tube(controller(Escaping(), half=0.7), Budget(60)).verdict == "certified"
    claim = prove_tube(controller(Escaping(), half=1.2), Budget(60, 100))
    assert claim.verdict == "unknown"
    assert 0 < claim.volume_share < 2.2 / 2.4
    assert float(claim.cells.upper[:, 0].max()) < 1
    assert re.fullmatch(r"seconds spent, \d+ of them before the first box: allow more", claim.reason)


@pytest.mark.parametrize(
    "bad", [[[1.0, 2.0], [2.0, 4.0]], [[torch.nan, 0.0], [0.0, 1.0]], [[torch.inf, 1.0], [1.0, 1.0]]]
)
def test_coordinates_without_an_inverse_bound_nothing_and_leave_the_other_cells_alone(bad):
    """A narrow spike in f gives such coordinates: its slope stretches them by e⁵⁰ along the middle of a cell."""
    good = torch.tensor([[2.0, 1.0], [0.0, 1.0]]).double()
    frames, r = torch.stack([good, torch.tensor(bad).double(), good]), torch.full((3, 2), 0.1).double()
    found = bound_in_new_frame(frames, frames.abs(), frames, frames.abs(), 0 * r, r)
    alone = bound_in_new_frame(*([frames[:1], frames[:1].abs()] * 2), 0 * r[:1], r[:1])
    assert found[[0, 2]].tolist() == [alone[0].tolist()] * 2
    assert not bool(found[1].isfinite().all())
    E = bound_turn(Moving(frames, 0 * frames, 0 * frames))[1]
    assert ratio_of_errors(E).isfinite().flatten().tolist() == [True, False, True]


class Pretending(Escaping):
    """Its dynamics differ from f + gu."""

    def dynamics(self, x, u):
        return torch.stack([-x[..., 0], u[..., 0] - x[..., 1]], -1)


def test_a_closed_loop_that_is_not_its_parts_is_refused():
    with pytest.raises(UsageError, match="runs by"):
        prove_tube(controller(Pretending()), Budget(4))


integrate = enclosure.nominal.integrate


def bad_nominal(slope, t, h, y):
    """Wrong closed loops: an error of 0.3 % after a second."""
    return integrate(slope, t, h, y) * (1 + 0.003 * h)


def outside(claim, about):
    """(how many of 20 costs by scipy are outside of their bounds, how many have bounds)."""
    x0 = about.initial_states.sample(20, torch.Generator().manual_seed(3)).double()
    low, high = claim.bounds_of_cost(x0)
    costs = torch.tensor([final(about, x)[1] for x in x0.tolist()])
    return int(((costs < low) | (costs > high)).sum()), int(high.isfinite().sum())


@pytest.mark.gate
def test_simulations_are_not_believed(monkeypatch):
    """With polynomials along wrong closed loops the tube becomes wider, and stays true."""
    monkeypatch.setattr(enclosure.nominal, "integrate", bad_nominal)
    about = controller(Swinging(), Formula(damped))
    claim = prove_tube(about, Budget(20))
    wrong, bounded = outside(claim, about)
    assert bounded > 0
    assert wrong == 0


@pytest.mark.gate
def test_without_the_bounds_they_would_be(monkeypatch):
    """The counterpart: if the defect of the polynomials is set to 0, the claim is false."""
    monkeypatch.setattr(enclosure.nominal, "integrate", bad_nominal)
    bounded = enclosure._Tube._bound_defect

    def careless(self, *arguments):
        w, cost, *others = bounded(self, *arguments)
        return 0 * w, cost, *others

    monkeypatch.setattr(enclosure._Tube, "_bound_defect", careless)
    about = controller(Swinging(), Formula(damped))
    assert outside(prove_tube(about, Budget(20)), about)[0] > 0


def test_steps_end_where_the_law_may_have_a_kink():
    """At the nodes of its curves, and Δt earlier, when a sampled law reads V(t + Δt, ·)."""
    loop = nn.ModuleList([Curve(torch.tensor([0.0, 0.5, 1.0]), torch.zeros(3))])
    assert Field.kinks(SimpleNamespace(loop=loop), 1.0, 0.125) == [0.375, 0.5, 0.875]


def test_the_certificate_and_its_figure(swung):
    certificate = TubeCertificate(controller(Swinging(), Formula(damped)), swung, {"seconds": 30.0, "seed": 0})
    assert certificate.result["verdict"] == "certified"
    low, high = certificate.result["mean_cost"]
    assert low < high <= certificate.result["greatest_cost"]
    assert f"{low:.6g} to {high:.6g}" in certificate.in_words()
    assert len(certificate.figure().axes) == 3


@pytest.mark.gate
def test_two_workers_prove_the_same(swung):
    two = certify(controller(Swinging(), Formula(damped)), Tube(), budget=Budget(60, workers=2)).claim
    assert two.mean_cost == pytest.approx(swung.mean_cost, rel=1e-9)
    assert two.volume_share == swung.volume_share == 1


@pytest.mark.gate
def test_from_the_command_line(capsys):
    main(["certify", "tube", "zoo:double_integrator", "--seconds", "60", "--json"])
    result = json.loads(capsys.readouterr().out)
    assert result["kind"] == "tube"
    assert result["verdict"] == "certified"
    assert 3.0 < result["mean_cost"][0] < result["mean_cost"][1] < 3.2
