"""Claims that closed loops under noise reach a target, against a closed form, simulated paths and planted falsities.

For dx = −kx dt + σ dW and V = kx², c(x) = −2k²x² + kσ² + 2λσ²k²x² + ε is largest at the edge |x| = r of the target, and
the probability of reaching it from x₀ before |x| = R is that of a scale function, ∫exp(ky²/σ²) dy.
"""

import math
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from scipy.integrate import quad

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.claims import reach_decrease
from lyapnet.claims.arguments import with_noise
from lyapnet.claims.checking import check
from lyapnet.claims.reach import prove_reach
from lyapnet.cli.options import read_numbers
from lyapnet.controller.controller import Controller
from lyapnet.loop.rollout import ClosedLoop
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.prover.kept_proofs import read_proofs, write_proofs
from lyapnet.task.constraints import StateLimits
from lyapnet.task.noise import Noise, StateNoise
from lyapnet.task.sets import Box
from lyapnet.task.systems import Linear
from lyapnet.value.policy import HJBPolicy
from tests.claims.planted import X0, cost, riccati
from tests.marks import sample
from tests.problems import AMPLE, Formula, problem_of

A, B = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])


def box(lower, upper):
    """In float64, also while the tests are collected."""
    return Box(*(torch.tensor(side, dtype=torch.float64) for side in (lower, upper)))


STATES, TARGET, AVOIDED = box([-2.5, -5.0], [2.5, 5.0]), box([-0.3, -0.7], [0.3, 0.7]), box([1.5, 2.0], [2.5, 5.0])
GAIN, SIGMA, EDGE, OUT, RATE = 2.0, 0.5, 0.4, 1.5, 0.05  # k, σ, r, R, ε of the scalar plant
NOW = torch.zeros(())


class Gained(HJBPolicy):
    """The law, times a factor."""

    factor = 1.0

    def forward(self, t, x):
        return self.factor * super().forward(t, x)


class Growing(Noise):
    """σ(x) = 0.3 (1 + x₂²) on the second state."""

    sources = 1

    def forward(self, x):
        return torch.stack([0 * x[..., 0], 0.3 * (1 + x[..., 1] ** 2)], -1)[..., None]


def value(scale=1.0):
    """V = scale · xᵀPx."""
    P = scale * torch.as_tensor(riccati())
    return Formula(lambda t, x: ((x @ P) * x).sum(-1) + 0 * t)


def task(noise=None, dynamics=A, **parts):
    problem = problem_of(Linear(dynamics.tolist(), B.tolist()), cost(), 100, 0.02, X0())
    return problem.replaced(noise=StateNoise([0.0, 0.3]) if noise is None else noise, **parts)


def prove(V=None, problem=None, gain=1.0, target=TARGET, avoided=(AVOIDED,), states=STATES, boxes=20_000, **options):
    problem = problem or task()
    policy = Gained(problem, V or value())
    policy.factor = gain
    budget = Budget(AMPLE, boxes=boxes)
    return prove_reach(ClosedLoop(problem, policy), problem, target, avoided, states=states, budget=budget, **options)


@cache
def certified():
    return prove()


def scalar(share, edge=EDGE, **options):
    """The claim about the scalar plant with the λ of the closed form times a share."""
    problem = problem_of(Linear([[0.0]], [[1.0]]), lyapnet.QuadraticCost([[1.0]], [[1.0]], [[1.0]]), 50, 0.02)
    problem = problem.replaced(noise=StateNoise([SIGMA]), initial_states=Box([-1.0], [1.0]))
    loop = ClosedLoop(problem, HJBPolicy(problem, Formula(lambda t, x: GAIN * x[..., 0] ** 2 + 0 * t)))
    risk = share * (1 - (GAIN * SIGMA**2 + RATE) / (2 * GAIN**2 * EDGE**2)) / SIGMA**2
    return prove_reach(
        loop, problem, Box([-edge], [edge]), risk=risk, rate=RATE, states=Box([-OUT], [OUT]), probability=0.6,
        budget=Budget(AMPLE, boxes=5000), **options,
    )  # fmt: skip


@pytest.mark.gate
def test_the_closed_form_is_certified_and_its_bound_is_above_the_exact_probability():
    claim = scalar(0.97)
    assert claim.verdict == "certified"
    assert claim.largest == pytest.approx(GAIN, rel=2e-3)
    out = math.sqrt(claim.rho / GAIN)
    assert 1 < out < OUT
    for x0 in (0.6, 0.8, 1.0):
        risen, whole = (quad(lambda y: math.exp(GAIN * y**2 / SIGMA**2), EDGE, end)[0] for end in (x0, out))
        misses = 1 - float(claim.reach_probability(torch.tensor(GAIN * x0**2)))
        assert risen / whole <= misses
        assert misses < 0.5
    assert float(claim.reach_probability(torch.tensor(GAIN))) >= claim.probability
    assert float(claim.reach_probability(torch.tensor(claim.rho + 1))) == 0
    assert claim.mean_time(torch.tensor(claim.rho + 1)) == math.inf
    # V falls on the mean by at least ε; dx = −kx dt takes ln(1/r)/k without noise
    assert float(claim.mean_time(torch.tensor(GAIN))) > math.log(1 / EDGE) / GAIN


@pytest.mark.gate
@pytest.mark.parametrize("options", [{"share": 1.03}, {"share": 0.97, "edge": 0.97 * EDGE}])
def test_a_little_more_than_the_closed_form_is_falsified(options):
    claim = scalar(**options)
    assert claim.verdict == "falsified"
    assert claim.counterexample is not None


@pytest.mark.gate
def test_lambda_and_epsilon_are_found():
    claim = certified()
    assert claim.verdict == "certified"
    assert claim.volume_share == 1
    assert claim.rate > 0.1
    assert claim.risk > 0
    assert math.exp(-claim.risk * (claim.wanted - claim.largest)) == pytest.approx(0.01)
    assert claim.rim > claim.rho
    assert claim.reason is None


def paths(problem, V, x0, target, steps=4000, dt=0.002, seed=0, gain=1.0):
    """Euler–Maruyama: (V at its largest before the target, time to it or ∞) of each path."""
    policy, generator, x = HJBPolicy(problem, V), torch.Generator().manual_seed(seed), x0.clone()
    highest, reached = V(NOW, x), torch.full((len(x),), math.inf)
    with torch.no_grad():
        for n in range(steps):
            inside = ((x >= target.lower) & (x <= target.upper)).all(-1)
            reached = torch.where(inside & (reached == math.inf), n * dt, reached)
            highest = torch.where(reached == math.inf, torch.maximum(highest, V(NOW, x)), highest)
            if bool((reached < math.inf).all()):
                break
            noise = torch.randn(len(x), problem.noise.sources, generator=generator) * math.sqrt(dt)
            x = x + dt * problem.system.dynamics(x, gain * policy(NOW, x)) + problem.noise.displacement(x, noise)
    return highest, reached


def test_simulated_paths_keep_both_bounds():
    claim, V, count = certified(), value(), 1000
    corner = max(X0().corners(), key=lambda x: float(V(NOW, x)))
    highest, reached = paths(task(), V, corner.expand(count, -1), TARGET)
    assert bool((reached < math.inf).all())
    at = V(NOW, corner)
    assert float((highest > claim.rho).double().mean()) <= 1 - float(claim.reach_probability(at))
    assert float(reached.mean()) <= float(claim.mean_time(at))
    # the bound of a level closer to x₀ is not idle: some paths rise so far
    closer = at + 0.1 / claim.risk
    assert 0 < float((highest > closer).double().mean()) <= math.exp(-0.1)


def test_paths_of_a_stronger_noise_break_the_bound():
    """The twin: what is proved of σ does not hold for 10σ, and the simulation sees it."""
    claim, V = certified(), value()
    x0 = torch.tensor([1.0, 0.7]).expand(300, -1)
    highest, _ = paths(task(StateNoise([0.0, 3.0])), V, x0, TARGET, steps=1000)
    assert float((highest > claim.rho).double().mean()) > 0.01


FALSE = {
    "V of the other sign": lambda: {"V": Formula(lambda t, x: 20 - value()(t, x))},
    "no control": lambda: {"gain": 0.0},
    "a gain of the other sign": lambda: {"gain": -1.0},
    "a gain that is far too low": lambda: {"gain": 0.2},
    "σ ten times as large": lambda: {"problem": task(StateNoise([0.0, 3.0]))},
    "σ on the other state": lambda: {"problem": task(StateNoise([1.0, 0.0]))},
    "a second source": lambda: {"problem": task(StateNoise([1.0, 0.3]))},
    "noise that grows with the speed": lambda: {"problem": task(Growing()), "probability": 0.999},
    "an unstable plant": lambda: {"problem": task(dynamics=A + 1.5 * np.eye(2))},
    "a target that is too small": lambda: {"target": Box([-0.02, -0.05], [0.02, 0.05])},
    "a target beside the goal": lambda: {"target": Box([0.2, -0.7], [0.8, 0.7])},
    "a target outside of D": lambda: {"target": Box([3.0, -1.0], [4.0, 1.0])},
    "a box to avoid in X₀": lambda: {"avoided": [Box([0.8, 0.5], [0.9, 0.6])]},
    "a box to avoid on the way": lambda: {"avoided": [AVOIDED, Box([0.5, -1.5], [0.7, -1.05])]},
    "a box to avoid around the target": lambda: {"avoided": [Box([-0.5, -1.0], [0.5, 1.0])]},
    "a probability that is too large for D": lambda: {"probability": 1 - 1e-15, "risk": 0.5, "rate": 0.05},
    "D that is too small": lambda: {"states": Box([-1.05, -1.2], [1.05, 1.2])},
    "λ that is far too large": lambda: {"risk": 60.0, "rate": 0.05},
    "ε that is too large": lambda: {"rate": 3.0},
    "a constraint that is violated": lambda: {"problem": task(constraints=StateLimits([0], [0.9], [1.0], [1.0]))},
}
REFUSED = ("a box to avoid in X₀", "a box to avoid around the target")  # before anything is proved


def worst(V=None, problem=None, gain=1.0, target=TARGET, avoided=(AVOIDED,), states=STATES, **options):
    """By how much a claim fails for every λ ≥ 0.2 and ε ≥ 0.01, or for those given, from differences of V alone: the
    largest c where V ≤ ρ, or how far V is below ρ where it has to be above.
    """
    V, problem, h = V or value(), problem or task(), 1e-4
    sides = zip(*sides_of(states), strict=True)
    grid = torch.cartesian_prod(*(torch.linspace(low, high, 61) for low, high in sides))
    corner = torch.cartesian_prod(torch.linspace(-1, 1, 21), torch.linspace(-0.7, 0.7, 21))
    outside = ~((grid > target.lower) & (grid < target.upper)).all(-1)
    slope = torch.stack([(V(NOW, grid + h * e) - V(NOW, grid - h * e)) / (2 * h) for e in torch.eye(2)], -1)
    mean = (slope * problem.system.dynamics(grid, -gain * slope[:, 1:] / 2)).sum(-1)
    assert problem.noise is not None
    sigma = problem.noise(grid)
    for column in sigma.unbind(-1):
        bend = V(NOW, grid + h * column) - 2 * V(NOW, grid) + V(NOW, grid - h * column)
        mean = mean + bend / (2 * h**2)
    variance = ((slope[..., None] * sigma).sum(-2) ** 2).sum(-1)
    forbidden = (grid == torch.as_tensor(states.lower)).any(-1) | (grid == torch.as_tensor(states.upper)).any(-1)
    for box in avoided:
        forbidden = forbidden | ((grid >= box.lower) & (grid <= box.upper)).all(-1)
    if problem.constraints is not None:
        forbidden = forbidden | (problem.constraints.worst(grid) >= 0)
    points = [box.center for box in avoided]
    least = []
    for risk in [options["risk"]] if "risk" in options else np.geomspace(0.2, 50, 40):
        gap = -math.log(1 - options.get("probability", 0.99)) / risk
        level, inside = float(V(NOW, corner).max()) + gap, outside & (V(NOW, grid) <= V(NOW, corner).max() + gap)
        excess = (mean + risk / 2 * variance + options.get("rate", 0.01))[inside]
        lowest = min([float(V(NOW, grid[forbidden]).min()), *(float(V(NOW, point)) for point in points)])
        least.append(max(float(excess.max()) if len(excess) else -math.inf, level - lowest))
    return min(least)


def sides_of(box):
    return torch.as_tensor(box.lower).tolist(), torch.as_tensor(box.upper).tolist()


@pytest.mark.parametrize("name", sample(FALSE, 20))
def test_nothing_false_is_certified(name):
    options = FALSE[name]()
    assert worst(**options) > 1e-3
    if name in REFUSED:
        with pytest.raises(UsageError, match=r"boxes to avoid outside X₀, got one that meets X₀ from \["):
            prove(boxes=3000, **options)
        return
    claim = prove(boxes=3000, **options)
    assert claim.verdict in ("falsified", "unknown")
    assert claim.volume_share < 1
    assert claim.reason is not None


def test_what_is_true_has_no_violation():
    """The twin of the falsity above."""
    assert worst() < 0


@pytest.mark.gate
def test_a_proof_without_the_trace_term_would_certify_what_is_false(monkeypatch):
    """The twin of the planted claims: they notice a term that is left out."""
    problem = task(StateNoise([0.9, 0.0]))
    options = {"problem": problem, "probability": 0.5, "risk": 0.05, "rate": 0.01, "boxes": 3000}
    states = Box([-4.0, -9.0], [4.0, 9.0])
    assert worst(states=states, avoided=(), **{k: v for k, v in options.items() if k != "boxes"}) > 1e-3
    assert prove(states=states, avoided=(), **options).verdict == "falsified"
    monkeypatch.setattr(reach_decrease, "noise_derivative", lambda V, sigma, t, x: 0 * x[..., 0])
    assert prove(states=states, avoided=(), **options).verdict == "certified"


def test_the_hole_is_the_interior_of_the_target_and_no_more():
    h = reach_decrease.OutsideBox(TARGET)
    edge = torch.tensor([[0.3, 0.0], [0.0, -0.7], [0.31, 0.0], [0.0, 0.71], [5.0, 5.0]])
    assert bool((h(edge) <= 0).all())
    assert bool((h(torch.tensor([[0.0, 0.0], [0.299, 0.0], [0.0, 0.699]])) > 0).all())


@pytest.mark.gate
def test_time_does_not_enter_v():
    """V(0, ·) alone is read: a V that falls by itself in time proves nothing."""
    falling = Formula(lambda t, x: value()(t, x) - 100 * t)
    assert prove(falling).verdict == "certified"
    frozen = Formula(lambda t, x: 1 - 100 * t + 0 * x[..., 0])
    assert prove(frozen, avoided=()).verdict != "certified"


def test_what_cannot_be_claimed_is_refused():
    with pytest.raises(UsageError, match="Expected a target to reach"):
        lyapnet.certify(noiseless(), lyapnet.Reach())
    with pytest.raises(UsageError, match="a target with an interior"):
        prove(target=Box([0.0, -1.0], [0.0, 1.0]))
    with pytest.raises(UsageError, match="Expected --noise STATE=SIGMA once for each state, got velocity twice"):
        read_numbers(["velocity=0.1", "velocity=0.2"], option="--noise STATE=SIGMA")
    with pytest.raises(UsageError, match="boxes of 2 states"):
        prove(avoided=[Box([0.0], [1.0])])
    with pytest.raises(UsageError, match="two derivatives in x"):
        prove(Formula(lambda t, x: value()(t, x) + x[..., 0].abs()))
    still = task()
    still.noise = None
    with pytest.raises(UsageError, match="Expected a task with noise"):
        prove(problem=still)
    wrong: list[dict[str, Any]] = [
        {"probability": 1.0}, {"rate": -1.0}, {"noise": {"velocity": -1}}, {"avoid": [[1, 2]]}
    ]  # fmt: skip
    for options in wrong:
        with pytest.raises(UsageError):
            lyapnet.Reach(target=[[-1, -1], [1, 1]], **options)


def claim_of(**options):
    states, avoid = [[-2.5, -5], [2.5, 5]], [[[1.5, 2], [2.5, 5]]]
    return lyapnet.Reach(**{"target": [[-0.3, -0.7], [0.3, 0.7]], "states": states, "avoid": avoid, **options})


def noiseless():
    """A controller without noise: σ is that of the claim."""
    problem = task()
    problem.noise = None
    return Controller(problem, value(), policy=HJBPolicy)


def test_a_controller_is_certified_from_python():
    certificate = lyapnet.certify(noiseless(), claim_of(noise={"x2": 0.3}), budget=AMPLE)
    assert certificate.verdict == "certified"
    words = "\n".join([certificate.in_words(), *certificate.in_formulas(), certificate.verdict_text()])
    assert "½ tr(σσᵀV_xx)" in words
    assert words.count("x2: 0.3") == 2
    assert certificate.result["noise"] == "x2: 0.3"
    assert "Nothing is claimed about what follows" in words
    assert certificate.options["avoid"] == ["1.5:2.5,2:5"]
    assert certificate.options["target"] == "-0.3:0.3,-0.7:0.7"
    assert 0 < certificate.result["miss_probability"] < 0.01
    certificate.figure()


def test_the_noise_of_the_claim_is_not_rounded():
    loop, _ = with_noise({"x2": 0.3}, noiseless())
    assert float(loop.noise.sigma[1, 0]) == 0.3


@pytest.mark.gate
def test_a_rate_that_is_asked_for_is_kept_where_no_sample_says_what_is_possible():
    assert prove(target=box([-3.0, -6.0], [3.0, 6.0]), avoided=(), rate=0.5, boxes=10).rate == 0.5


FORGED = {
    "noise": {"x2": 0.6}, "target": [[-0.1, -0.2], [0.1, 0.2]], "probability": 0.9999,
    "avoided": [[[0.5, -1.5], [0.7, -1.0]]], "risk": 50.0, "rate": 3.0, "largest": 5.0, "upper": [0.0, 1.1, 1.1],
}  # fmt: skip


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """The file of a proof, and the controller that it is about."""
    path, controller = tmp_path_factory.mktemp("reach") / "reach.proof", noiseless()
    assert lyapnet.certify(controller, claim_of(noise={"x2": 0.3}), budget=AMPLE, keep=path).verdict == "certified"
    return path, controller


@pytest.mark.parametrize("name", sample(FORGED, 8))
def test_a_forged_proof_is_refused(kept, tmp_path, name):
    path, controller = kept
    proofs = read_proofs(path)
    proofs["reach"]["of"][0][name] = FORGED[name]
    write_proofs(other := tmp_path / "forged.proof", proofs)
    assert check(controller, other)["verdict"] == "refused"


def test_a_kept_proof_is_checked(kept):
    path, controller = kept
    again = check(controller, path)
    assert again["verdict"] == "certified"
    assert again["volume_share"] == 1


@pytest.mark.gate
def test_a_kept_proof_of_another_controller_is_refused(kept):
    path, controller = kept
    assert check(Controller(controller.problem, value(1.01), policy=HJBPolicy), path)["verdict"] == "refused"
    assert check(Controller(task(), value(), policy=HJBPolicy), path)["verdict"] == "refused"


def test_noise_beside_that_of_the_task_or_of_no_state_is_refused():
    with pytest.raises(UsageError, match="Expected no noise beside that of the task"):
        lyapnet.certify(Controller(task(), value(), policy=HJBPolicy), claim_of(noise={"x2": 0.1}))
    with pytest.raises(UsageError, match="Expected noise of"):
        lyapnet.certify(noiseless(), claim_of(noise={"nobody": 0.1}))
