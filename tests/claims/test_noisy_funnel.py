"""Claims about closed loops under noise, against a linear-quadratic task in closed form and simulated paths.

For dx = (Ax + Bu) dt + σ dW and P of the algebraic Riccati equation, V = xᵀPx + r(T − t) with r = tr(σσᵀP) and
u = −R⁻¹BᵀPx fulfil 𝓛V + ℓ = 0 exactly; 𝓛V + ½λ‖σᵀV_x‖² ≤ 0 where λ is at most the least ratio of two quadratic forms.
"""

import math
from functools import cache

import numpy as np
import pytest
import torch
from scipy.linalg import eigh

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.claims import noisy_decrease
from lyapnet.claims.checking import check
from lyapnet.claims.noisy_decrease import NoisyDecrease, require_smooth
from lyapnet.claims.noisy_funnel import prove_noisy_funnel
from lyapnet.controller.controller import Controller
from lyapnet.loop.rollout import ClosedLoop
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.task.constraints import StateLimits
from lyapnet.task.cost import Cost
from lyapnet.task.noise import Noise, StateNoise
from lyapnet.task.sets import Box
from lyapnet.task.systems import Linear
from lyapnet.value.policy import HJBPolicy
from tests.claims.planted import DURATION, X0, riccati
from tests.marks import sample
from tests.problems import AMPLE, Formula, problem_of

A, B, Q = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.diag([10.0, 0.1])
SIGMA = np.array([[0.0], [0.3]])
STATES = Box(torch.tensor([-2.5, -5.0]), torch.tensor([2.5, 5.0]))


class Constant(Noise):
    """σ(x) = σ."""

    def __init__(self, sigma):
        super().__init__()
        self.matrix = torch.as_tensor(sigma)
        self.sources = self.matrix.shape[-1]

    def forward(self, x):
        return self.matrix.expand(*x.shape[:-1], -1, -1)


class Gained(HJBPolicy):
    """The law, times a factor."""

    factor = 1.0

    def forward(self, t, x):
        return self.factor * super().forward(t, x)


def cost():
    """φ = xᵀPx, so that V(T, ·) = φ."""
    return lyapnet.QuadraticCost(Q.tolist(), [[1.0]], riccati().tolist())


def rate_of_noise(sigma=SIGMA):
    """r = tr(σσᵀP)."""
    return float(np.trace(sigma @ sigma.T @ riccati()))


def largest_risk(sigma=SIGMA):
    """The largest λ with ½λ‖2σᵀPx‖² ≤ ℓ = xᵀ(Q + PBR⁻¹BᵀP)x for every x."""
    P = riccati()
    return 1 / eigh(2 * P @ sigma @ sigma.T @ P, Q + P @ B @ B.T @ P, eigvals_only=True)[-1]


def value(scale=1.0, noise=1.0):
    """V = scale · xᵀPx + noise · r(T − t)."""
    P, r = torch.as_tensor(riccati()), rate_of_noise()
    return Formula(lambda t, x: scale * ((x @ P) * x).sum(-1) + noise * r * (DURATION - t))


def task(sigma=SIGMA, dynamics=A, **parts):
    problem = problem_of(Linear(dynamics.tolist(), B.tolist()), cost(), 100, DURATION / 100, X0())
    return problem.replaced(noise=Constant(sigma), **parts)


def prove(V=None, problem=None, gain=1.0, **options):
    problem = problem or task()
    policy = Gained(problem, V or value())
    policy.factor = gain
    options = {"alpha": 1.0, "delta": 0.002, "risk": 0.9 * largest_risk(), "states": STATES, **options}
    return prove_noisy_funnel(ClosedLoop(problem, policy), problem, budget=Budget(AMPLE, boxes=30_000), **options)


def paths(problem, V, x0, finer=20, seed=0, decay=0.0):
    """Euler–Maruyama in steps of Δt/finer: (ρ, δ) ↦ (whether each path leaves {V ≤ ρ + δt}, its cost up to then + ρ if
    it does).
    """
    policy, generator = HJBPolicy(problem, V), torch.Generator().manual_seed(seed)
    dt, steps = problem.horizon.dt / finer, problem.horizon.steps * finer
    x, record = x0.clone(), []
    with torch.no_grad():
        for n in range(steps):
            t = x.new_tensor(n * dt)
            u = policy(t, x)
            record.append((n * dt, V(t, x) * torch.exp(decay * t), dt * problem.cost.running(x, u)))
            noise = torch.randn(len(x), problem.noise.sources, generator=generator) * math.sqrt(dt)
            x = x + dt * problem.system.dynamics(x, u) + problem.noise.displacement(x, noise)
        record.append((DURATION, V(x.new_tensor(DURATION), x) * math.exp(decay * DURATION), problem.cost.terminal(x)))

    def outcome(rho, delta):
        left, paid = torch.zeros(len(x0), dtype=torch.bool), torch.zeros(len(x0))
        for t, height, step in record:
            left |= height > rho + delta * t
            paid += torch.where(left, 0.0, step)
        return left, paid + rho * left

    return outcome


@cache
def certified():
    return prove()


def test_the_condition_vanishes_for_the_closed_form():
    """With α = 1, no λ and δ = 0, and only with the trace term."""
    condition = NoisyDecrease(ClosedLoop(task(), HJBPolicy(task(), value())), 1.0, 0.0)
    t, x = DURATION * torch.rand(100), STATES.sample(100, torch.Generator().manual_seed(0)).double()
    torch.testing.assert_close(condition(t, x), torch.zeros(100), rtol=0, atol=1e-12)
    mean, steepness = condition.rates(t, x)
    torch.testing.assert_close(steepness, (2 * x @ torch.as_tensor(riccati() @ SIGMA))[:, 0] ** 2)
    assert (mean < 0).all()


def test_the_closed_form_is_certified():
    claim = certified()
    assert claim.verdict == "certified"
    assert claim.volume_share == 1
    corners = X0().corners()
    largest = float(value()(torch.zeros(()), corners).max())
    assert claim.largest == pytest.approx(largest, rel=2e-3)
    assert claim.wanted == pytest.approx(claim.largest + math.log(100 / 0.9) / claim.risk)
    assert claim.leave_probability(torch.tensor(claim.largest)) == pytest.approx(0.01)
    assert claim.leave_probability(torch.tensor(claim.rho + 1)) == 1
    assert claim.level(DURATION) == claim.rho
    assert claim.terminal_excess > -1e-2
    assert claim.guaranteed_cost(torch.tensor(3.0)) == pytest.approx(3, abs=0.02)  # V is the expected cost


@pytest.mark.gate
@pytest.mark.parametrize("share", [1.02, 1.5])
def test_a_larger_risk_than_the_closed_form_allows_is_falsified(share):
    claim = prove(risk=share * largest_risk(), delta=0.0)
    assert claim.verdict == "falsified"
    assert claim.counterexample is not None


@pytest.mark.gate
def test_the_risk_is_found():
    claim = prove(risk=None)
    assert claim.verdict == "certified"
    assert 0.5 * largest_risk() < claim.risk < 1.1 * largest_risk()  # δ allows a little more than the closed form


@pytest.mark.gate
@pytest.mark.parametrize("probability", [0.5, 0.9])
def test_simulated_paths_keep_both_bounds(probability):
    """From the corner of X₀ of largest V: the bound of leaving is met, and so is that of the expected cost."""
    claim, V, count = prove(probability=probability), value(), 4000
    assert claim.verdict == "certified"
    corner = max(X0().corners(), key=lambda x: float(V(torch.zeros(()), x)))
    left, paid = paths(task(), V, corner.expand(count, -1))(claim.rho, claim.delta)
    bound = float(claim.leave_probability(V(torch.zeros(()), corner)))
    assert float(left.double().mean()) <= bound
    error = float(paid.std()) / math.sqrt(count)
    guaranteed = float(claim.guaranteed_cost(V(torch.zeros(()), corner)))
    assert float(paid.mean()) - 4 * error <= guaranteed
    assert float(paid.mean()) > 0.9 * guaranteed


@pytest.mark.gate
def test_paths_of_a_stronger_noise_break_the_bounds():
    """The twin: what is proved of σ does not hold for 3σ, and the simulation sees it."""
    claim, V = prove(probability=0.5), value()
    x0 = torch.tensor([1.0, 0.7]).expand(1000, -1)
    left, _ = paths(task(3 * SIGMA), V, x0)(claim.rho, claim.delta)
    at = V(torch.zeros(()), x0[0])
    assert float(left.double().mean()) > float(claim.leave_probability(at))


TURNED = 0.3 * np.array([[math.sin(0.5)], [math.cos(0.5)]])
FALSE = {
    "V a tenth too low": lambda: {"V": value(0.9)},
    "V half as high": lambda: {"V": value(0.5)},
    "V a twentieth too low": lambda: {"V": value(0.95)},
    "V of the other sign": lambda: {"V": value(-1.0)},
    "V a little too low far from the goal": lambda: {"V": _bent()},
    "noise that V does not pay for": lambda: {"V": value(1.0, 0.0)},
    "noise that V pays half of": lambda: {"V": value(1.0, 0.5)},
    "a leak that is too small": lambda: {"V": value(1.0, 0.0), "delta": 0.98 * rate_of_noise()},
    "σ a tenth larger": lambda: {"problem": task(1.1 * SIGMA)},
    "σ doubled": lambda: {"problem": task(2 * SIGMA)},
    "σ in the other column": lambda: {"problem": task(SIGMA[::-1].copy())},
    "σ turned": lambda: {"problem": task(TURNED)},
    "a second source": lambda: {"problem": task(np.hstack([SIGMA, [[0.1], [0.0]]]))},
    "the same source twice": lambda: {"problem": task(np.hstack([SIGMA, SIGMA]))},
    "λ a twentieth too large": lambda: {"risk": 1.05 * largest_risk(), "delta": 0.0},
    "λ a half too large": lambda: {"risk": 1.5 * largest_risk(), "delta": 0.0},
    "λ ten times too large": lambda: {"risk": 10 * largest_risk(), "delta": 0.0},
    "a gain that is too low": lambda: {"gain": 0.5},
    "a gain that is a fifth too low": lambda: {"gain": 0.8},
    "a gain that is a third too high": lambda: {"gain": 1.33},
    "no control": lambda: {"gain": 0.0},
    "a gain of the other sign": lambda: {"gain": -1.0},
    "an unstable plant": lambda: {"problem": task(dynamics=A + 0.2 * np.eye(2))},
    "a plant that is pulled": lambda: {"problem": task(dynamics=A + np.array([[0, 0], [1.0, 0]]))},
    "a plant that drifts": lambda: {"problem": task(dynamics=A + np.array([[0.1, 0], [0, 0]]))},
    "a cost that is a tenth higher": lambda: {"problem": _dearer(1.1)},
    "a cost that is doubled": lambda: {"problem": _dearer(2.0)},
    "a small bump of the cost": lambda: {"problem": _dearer(1.0, bump=1.0)},
    "noise that grows with the speed": lambda: {"problem": task().replaced(noise=Growing(SIGMA))},
    "α above what V pays for": lambda: {"V": value(0.9), "alpha": 0.95, "risk": 1.0},
}


class Growing(Constant):
    """σ(x) = σ (1 + ½ x₂²)."""

    def forward(self, x):
        return super().forward(x) * (1 + x[..., 1, None, None] ** 2 / 2)


class _Dearer(Cost):
    """q times a factor, plus a bump at (0.9, 0) that is 0.1 wide."""

    def __init__(self, factor, bump):
        super().__init__()
        self.factor, self.bump = factor, bump

    def state(self, x):
        bump = torch.exp(-((x - torch.tensor([0.9, 0.0])) ** 2).sum(-1) / 0.1**2)
        return self.factor * (x**2 * torch.as_tensor(Q).diagonal()).sum(-1) + self.bump * bump

    def R(self, x):
        return torch.ones(*x.shape[:-1], 1, 1)

    def terminal(self, x):
        return ((x @ torch.as_tensor(riccati())) * x).sum(-1)


def _dearer(factor, bump=0.0):
    return task(cost=_Dearer(factor, bump))


def _bent():
    V = value()
    return Formula(lambda t, x: V(t, x) - 0.01 * (x**2).sum(-1) ** 2)


def worst(V=None, problem=None, gain=1.0, delta=0.002, alpha=1.0, risk=None):
    """The largest of 𝓛V + max(αℓ, ½λ‖σᵀV_x‖²) − δ on a grid of X₀, from differences of V alone."""
    V, problem, h = V or value(), problem or task(), 1e-4
    grid = torch.cartesian_prod(torch.linspace(-1, 1, 41), torch.linspace(-0.7, 0.7, 41))
    t, axes, found = torch.tensor(0.5), torch.eye(2), []
    for x in (grid, 0.1 * grid):
        slope = torch.stack([(V(t, x + h * e) - V(t, x - h * e)) / (2 * h) for e in axes], -1)
        u = -gain * slope[:, 1:] / 2
        sigma = (problem.noise or Constant(SIGMA))(x)
        rate = (V(t + h, x) - V(t - h, x)) / (2 * h) + (slope * problem.system.dynamics(x, u)).sum(-1)
        for column in sigma.unbind(-1):
            rate = rate + (V(t, x + h * column) - 2 * V(t, x) + V(t, x - h * column)) / (2 * h**2)
        steepness = ((slope[..., None] * sigma).sum(-2) ** 2).sum(-1)
        spread = (0.9 * largest_risk() if risk is None else risk) / 2 * steepness
        found.append((rate + torch.maximum(alpha * problem.cost.running(x, u), spread)).max() - delta)
    return float(max(found))


@pytest.mark.parametrize("name", sample(FALSE, 30))
def test_nothing_false_is_certified(name):
    options = FALSE[name]()
    assert worst(**options) > 1e-3
    claim = prove(**options)
    assert claim.verdict == "falsified" or claim.verdict == "unknown"
    assert claim.volume_share < 1


def test_what_is_true_has_no_violation():
    """The twin of the falsity above."""
    assert worst() < 1e-5


@pytest.mark.gate
def test_a_set_that_is_too_small_is_not_certified():
    assert prove(states=Box([-1.3, -2.5], [1.3, 2.5])).verdict == "unknown"
    assert prove(probability=1 - 1e-9, states=Box([-1.6, -3.0], [1.6, 3.0])).verdict == "unknown"


@pytest.mark.gate
@pytest.mark.parametrize("name", sample(["V a tenth too low", "noise that V does not pay for", "σ doubled"], 3))
def test_with_a_larger_leak_the_same_is_true(name):
    """The twins: what fails holds with a δ that pays for it, or an α that asks for less."""
    larger = {
        "V a tenth too low": {"alpha": 0.7, "delta": 0.1, "risk": 1.0},
        "noise that V does not pay for": {"delta": 1.02 * rate_of_noise()},
        "σ doubled": {"delta": 3.02 * rate_of_noise(), "risk": 0.2 * largest_risk(), "probability": 0.9},
    }
    assert prove(**{**FALSE[name](), **larger[name]}).verdict == "certified"


def test_a_proof_without_the_trace_term_would_certify_what_is_false(monkeypatch):
    """The twin of the planted claims: they notice a term that is left out."""
    monkeypatch.setattr(noisy_decrease, "noise_derivative", lambda V, sigma, t, x: 0 * x[..., 0])
    assert prove(value(1.0, 0.0)).verdict == "certified"


@pytest.mark.gate
def test_constraints_hold_in_the_funnel():
    wide, narrow = (StateLimits([0, 0], [limit, -limit], [1.0, -1.0], [1.0, 1.0]) for limit in (2.4, 1.2))
    assert prove(problem=task(constraints=wide)).verdict == "certified"
    claim = prove(problem=task(constraints=narrow))
    assert claim.verdict == "unknown"
    assert claim.rho < claim.rim < float(value()(torch.zeros(()), torch.tensor([1.2, 0.0])))


@pytest.mark.gate
def test_the_end_is_where_paths_end():
    claim = certified()
    left, _ = paths(task(), value(), torch.zeros(500, 2))(claim.rho, claim.delta)
    assert not left.any()
    assert claim.end is not None
    P = torch.as_tensor(riccati())
    widest = (claim.rho + claim.delta * DURATION) ** 0.5 * torch.linalg.inv(P).diagonal().sqrt()
    torch.testing.assert_close(claim.end.upper, widest, rtol=0.05, atol=0)
    assert (claim.end.upper >= widest * (1 - 1e-9)).all()


@pytest.mark.parametrize(
    "kink",
    [lambda x: torch.where(x[..., 0] > 0, x[..., 0], 0.0) ** 2, lambda x: torch.maximum(x[..., 0], x[..., 1]) ** 2],
)
def test_a_value_without_two_derivatives_is_refused(kink):
    V = Formula(lambda t, x: value()(t, x) + kink(x))
    with pytest.raises(UsageError, match="two derivatives in x"):
        prove(V)


def test_kinks_in_time_are_allowed():
    V = Formula(lambda t, x: value()(t, x) * (1 + 0 * torch.relu(t - 1)))
    condition = NoisyDecrease(ClosedLoop(task(), HJBPolicy(task(), V)), 1.0, 0.0)
    domain = torch.tensor([0.0, -1.0, -1.0]), torch.tensor([DURATION, 1.0, 1.0])
    require_smooth(condition, domain)


def test_a_task_without_noise_is_refused():
    problem = task()
    problem.noise = None
    with pytest.raises(UsageError, match="Expected a task with noise"):
        prove(problem=problem)


def test_noise_that_reads_values_is_refused():
    class Reading(Constant):
        def forward(self, x):
            return super().forward(x) * (3.0 if bool((x > 0.9).any()) else 1.0)

    with pytest.raises(UsageError):
        prove(problem=task().replaced(noise=Reading(SIGMA)))


def test_noise_that_remembers_is_refused():
    class Remembering(Constant):
        calls = 0

        def forward(self, x):
            self.calls += 1
            return super().forward(x) * (1 + (self.calls % 7 == 0))

    with pytest.raises(UsageError, match="remember"):
        prove(problem=task().replaced(noise=Remembering(SIGMA)))


DECAY = 0.1


@pytest.mark.gate
def test_a_narrowing_funnel_is_certified():
    """V falls at least at the rate of the least ratio of ℓ and V, by which the level may fall too."""
    P = riccati()
    rate = eigh(Q + P @ B @ B.T @ P, P, eigvals_only=True)[0]
    claim = prove(decay=DECAY * rate, risk=0.5 * largest_risk())
    assert claim.verdict == "certified"
    assert claim.level(DURATION) == pytest.approx(claim.rho * math.exp(-DECAY * rate * DURATION))
    wide = certified().end
    assert wide is not None
    assert claim.end is not None
    assert (claim.end.widths < wide.widths).all()
    left, _ = paths(task(), value(), torch.tensor([1.0, 0.7]).expand(1000, -1), decay=claim.decay)(claim.rho, 0.0)
    assert float(left.double().mean()) < 0.01
    assert prove(decay=1.5 * rate, risk=0.5 * largest_risk()).verdict == "falsified"


@pytest.mark.gate
def test_a_controller_is_certified_from_python(tmp_path):
    problem = task().replaced(noise=StateNoise([0.0, 0.3]))
    controller = Controller(problem, value(), policy=HJBPolicy)
    claim = lyapnet.NoisyFunnel(alpha=0.95, delta=0.01, states=[[-2.5, -5], [2.5, 5]])
    kept = tmp_path / "noisy.proof"
    certificate = lyapnet.certify(controller, claim, budget=AMPLE, keep=kept)
    assert certificate.verdict == "certified"
    result = certificate.result
    assert result["volume_share"] == 1
    assert result["leave_probability"] < 0.01
    assert 1 < result["guaranteed_cost_ratio"] < 1.1
    words = "\n".join([certificate.in_words(), *certificate.in_formulas(), certificate.verdict_text()])
    assert "½ tr(σσᵀV_xx)" in words
    assert "nothing is claimed about what follows" in words
    certificate.figure()
    again = check(controller, kept)
    assert again["verdict"] == "certified"
    assert again["rho"] == result["rho"]
    for other in (
        problem.replaced(noise=StateNoise([0.0, 0.31])),
        problem.replaced(initial_states=Box([-2, -2], [2, 2])),
    ):
        refused = check(Controller(other, value(), policy=HJBPolicy), kept)
        assert refused["verdict"] == "refused"
    assert check(Controller(problem, value(1.01), policy=HJBPolicy), kept)["verdict"] == "refused"
