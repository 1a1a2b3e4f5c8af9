"""Domains: borders that are found, against those of the functions; declared ones; and what leaves them."""

import json
import math

import pytest
import torch
from torch.testing import assert_close

import lyapnet
from lyapnet.base.errors import DivergenceError, UsageError
from lyapnet.cli import main
from lyapnet.evaluation import evaluate
from lyapnet.evaluation.oracles import oracle_of
from lyapnet.experiment.assembly import Parts, build_problem
from lyapnet.experiment.config import config_from_plain
from lyapnet.loop.rollout import Rollout
from lyapnet.task import domain
from lyapnet.task.domain import SLACK, Border, Domain, DomainCost, as_written, size_of
from lyapnet.task.family import FamilySystem
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box
from lyapnet.value.expansions import optimal_trajectories, path_under
from tests.fits import shorten_fits
from tests.tasks_without_goal.consumption import system
from tests.tasks_without_goal.consumption.system import Village

PLAIN = {
    "experiment": "economy",
    "system": {"name": f"{system.__name__}:Village"},
    "cost": {"name": f"{__name__}:Displeasure"},
    "controls": {"lower": 0, "upper": 3},
    "initial_states": {"lower": [2], "upper": [8]},
    "horizon": {"steps": 40, "dt": 0.2},
}


class Displeasure(system.Displeasure):
    """With a scrap value below what capital is worth on the way: nothing is to be left."""

    scrap = 0.2


class Written(lyapnet.ControlAffineSystem):
    """ẋ = h(x) + u for some h, in two states of which the second is at rest."""

    state_names, state_units = ("x", "y"), ("", "")
    control_names, control_units = ("u",), ("",)

    def __init__(self, h):
        super().__init__()
        self.h = h

    def f(self, x):
        return torch.stack([self.h(x[..., 0], x[..., 1]), torch.zeros_like(x[..., 0])], -1)

    def g(self, x):
        return torch.tensor([[1.0], [0.0]]).to(x).expand(*x.shape[:-1], 2, 1)


def written(h, cost=None):
    cost = cost or lyapnet.QuadraticCost(torch.eye(2), [[1.0]], torch.eye(2))
    horizon = lyapnet.Horizon(steps=5, dt=0.1)
    return Problem(Written(h), cost, lyapnet.Unbounded(), lyapnet.Box([0.2, 0.3], [0.6, 0.7]), horizon).double()


def economy(**changes):
    return build_problem(config_from_plain({**PLAIN, **changes}))


@pytest.mark.parametrize(
    ("h", "borders"),
    [
        (lambda x, y: torch.log(x), [("x", "lower", 0.0)]),
        (lambda x, y: torch.sqrt(x) * y, [("x", "lower", 0.0)]),
        (lambda x, y: x**0.4, [("x", "lower", 0.0)]),
        (lambda x, y: torch.log(1 - x), [("x", "upper", 1.0)]),
        (lambda x, y: torch.atanh(x), [("x", "lower", -1.0), ("x", "upper", 1.0)]),
        (lambda x, y: torch.log(x) + torch.sqrt(y + 0.25), [("x", "lower", 0.0), ("y", "lower", -0.25)]),
        (lambda x, y: torch.log(x / (y * 1e-6)), [("x", "lower", 0.0), ("y", "lower", 0.0)]),
        (lambda x, y: torch.sqrt(x**2 + 1e-6), []),
        (lambda x, y: torch.tanh(x) + torch.exp(20 * x), []),
        (lambda x, y: 1 / x, []),  # a pole, of which expansions take care
        (lambda x, y: torch.sqrt(x + y), []),  # a border that is not of one state
        (lambda x, y: torch.log(x.abs()), []),
    ],
)  # fmt: skip
def test_borders_are_found(h, borders):
    problem = written(h)
    assert [tuple(border[:3]) for border in problem.borders()] == borders
    assert (problem.within(problem.borders()).domain is None) == (not borders)


def test_a_border_says_whose_it_is():
    class Utility(lyapnet.Cost):
        def state(self, x):
            return -torch.log(x[..., 0])

        def R(self, x):
            return torch.ones(*x.shape[:-1], 1, 1).to(x)

        def terminal(self, x):
            return x[..., 1] ** 1.5

    problem = written(lambda x, y: x**0.5, Utility())
    domain = problem.within(problem.borders()).domain
    assert str(domain) == "x > 0, where f and q are defined; y > 0, where φ is defined"


def test_what_raises_beside_x0_has_no_border():
    def refusing(x, y):
        if (x < 0).any():
            raise ArithmeticError("no such state")
        return x.sqrt()

    assert written(refusing).borders() == []


def test_a_task_without_a_domain_stays_as_it_is():
    system, cost = Written(lambda x, y: torch.sin(x)), lyapnet.QuadraticCost(torch.eye(2), [[1.0]], torch.eye(2))
    plain = {"system": {"name": f"{__name__}:Written"}, "initial_states": {"lower": [0.2], "upper": [0.6]}}
    problem = build_problem(config_from_plain({**PLAIN, **plain, "controls": {}}), Parts(system=system, cost=cost))
    assert problem.domain is None
    assert type(problem.system) is Written
    assert type(problem.cost) is lyapnet.QuadraticCost
    assert problem.within([]) is problem
    assert economy().domain is not None, "the twin"


def test_functions_are_finite_beyond_the_border_and_the_same_within():
    problem, bare = economy(), Village()
    assert str(problem.domain) == "capital > 0, where f is defined"
    assert type(problem.system).__name__ == "Village"
    assert isinstance(problem.system, Village)
    within = torch.tensor([[1e-3], [1.0], [9.0]], dtype=torch.float64)
    assert torch.equal(problem.system.f(within), bare.f(within))
    assert torch.equal(problem.cost.terminal(within), Displeasure().terminal(within))
    assert isinstance(as_written(problem.relaxed().cost), Displeasure)
    for beyond in (-1e-3, -5.0, -1e30, 0.0):
        x = torch.full((1, 1), beyond, dtype=torch.float64, requires_grad=True)
        parts = problem.system.f(x), problem.cost.state(x), problem.cost.terminal(x)
        for part in parts:
            (slope,) = torch.autograd.grad(part.sum(), x, retain_graph=True, materialize_grads=True)
            assert bool((part.isfinite() & slope.isfinite()).all())
        if -1e9 < beyond < 0:
            assert float(slope) < 0, "back into the domain costs less"
    bad = bare.f(torch.full((1, 1), -1.0, dtype=torch.float64))
    assert bool(bad.isnan()), "the twin"
    x = torch.zeros(1, 1, dtype=torch.float32, requires_grad=True)
    single = problem.to(torch.float32).system.f(x)
    assert single.dtype == torch.float32
    assert bool(torch.autograd.grad(single.sum(), x)[0].isfinite().all())


def test_the_price_is_smooth_and_zero_within():
    domain = Domain(
        ["x", "y"], torch.tensor([2.0, 1.0]), [Border("x", "lower", 1.0, ""), Border("x", "lower", 0.0, "")]
    )
    assert [border.value for border in domain.borders] == [1.0], "the tighter one of a side"
    x = torch.tensor([[1.0, -50.0], [3.0, 0.0], [-1.0, 0.0]], dtype=torch.float64)
    assert_close(domain.price(x), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), atol=2e-3, rtol=0)
    assert domain.price(x)[:2].eq(0).all()
    near = (1 + torch.linspace(-1e-2, 1e-2, 6, dtype=torch.float64))[:, None].expand(-1, 2).contiguous()
    assert torch.autograd.gradcheck(domain.price, (near.requires_grad_(),))
    path = torch.tensor([[3.0], [1 - 2 * SLACK * 0.9]]).expand(2, 2)[..., None].expand(2, 2, 2).clone()
    path[1, 1, 0] = 1 - 2 * SLACK * 1.1
    assert domain.left(path).tolist() == [False, True]


class Flat(lyapnet.Cost):
    """q and φ are the same at each state, and R = 1."""

    def __init__(self, q, phi):
        super().__init__()
        self.q, self.phi = q, phi

    def state(self, x):
        return x.new_full(x.shape[:-1], self.q)

    def R(self, x):
        return torch.ones(*x.shape[:-1], 1, 1).to(x)

    def terminal(self, x):
        return x.new_full(x.shape[:-1], self.phi)


@pytest.mark.parametrize(("q", "phi", "price"), [(2.0, 3.0, 4.0), (-2.0, 3.0, 4.0), (-2.0, -3.0, 4.0), (0.0, 0.0, 1.0)])
def test_what_a_state_outside_pays_is_that_of_a_whole_loop(q, phi, price):
    """T |q| + |φ| with T = 0.5 s, or 1 where that is zero, for each step at a distance of a state's size."""
    problem = written(lambda x, y: torch.log(x), Flat(q, phi))
    cost = problem.within(problem.borders()).cost
    d, s = torch.tensor([0.0, 1e-3, 1.0, 5.0], dtype=torch.float64), 1e-3
    x = torch.stack([-0.6 * d, torch.full_like(d, 0.5)], -1)  # x is at most 0.6 in X₀
    paid = price * ((d**2 + s**2).sqrt() - s)
    assert_close(cost.state(x), q + paid / 0.1, rtol=1e-12, atol=1e-12)
    assert_close(cost.terminal(x), phi + paid, rtol=1e-12, atol=1e-12)


def test_a_state_that_is_zero_in_all_of_x0_has_a_size_of_one():
    assert size_of(lyapnet.Box([0.0, -3.0, 2.0], [0.0, 1.0, 2.0])).tolist() == [1.0, 3.0, 2.0]


@pytest.mark.gate
def test_a_path_that_leaves_has_no_finite_cost_and_an_optimum_stays():
    problem = economy()
    x0 = problem.initial_states.sample(6, torch.Generator().manual_seed(0))
    path = path_under(problem, lambda n, x: torch.full_like(x, 3.0), x0)
    assert path.cost.isinf().all()
    assert path.x.isfinite().all()
    bare = problem.replaced(system=Village(), cost=Displeasure())
    assert path_under(bare, lambda n, x: torch.full_like(x, 3.0), x0).cost.isinf().all()
    optimum = optimal_trajectories(problem, x0, torch.full((40, 6, 1), 0.5, dtype=torch.float64))
    assert all(part.isfinite().all() for part in (*optimum.path, *optimum.expansion))
    assert float(optimum.path.x.min()) > -SLACK * 8
    assert float(optimum.path.x[-1].max()) < 0.05, "it ends at the border"
    pytest.importorskip("casadi")
    oracle = oracle_of(problem)
    found = oracle.solve(x0, optimum.path.u)
    assert not any(found.reasons)
    assert_close(found.cost, optimum.path.cost, rtol=2e-3, atol=0)
    assert float(oracle.rollout(x0, found.u)[0].min()) >= 0


DECLARED = {**PLAIN, "domain": {"lower": {"capital": 1.0}, "upper": {"capital": 20}}}


@pytest.mark.gate
def test_a_declared_domain_and_the_tighter_border_counts():
    said = str(build_problem(config_from_plain(DECLARED)).domain)
    assert said == "capital > 1, as declared; capital < 20, as declared"
    problem = build_problem(config_from_plain({**PLAIN, "domain": {"lower": {"capital": -1}}}))
    assert str(problem.domain) == "capital > 0, where f is defined"
    again = build_problem(config_from_plain(DECLARED), Parts(system=problem.system, cost=problem.cost))
    assert str(again.domain) == str(problem.domain), "made by hand"
    assert not isinstance(again.cost.cost, DomainCost)


@pytest.mark.parametrize(
    ("domain", "message"),
    [
        ({"lower": {"labour": 0}}, "domain.lower among capital, got 'labour'"),
        ({"upper": {"labour": 0}}, "domain.upper among capital"),
        ({"lower": {"capital": "zero"}}, "domain.lower"),
        ({"lower": {"capital": [0]}}, "domain.lower"),
        ({"lower": {"capital": None}}, "domain.lower"),
        ({"lower": {"capital": float("nan")}}, "domain.lower.capital as a finite number, got nan"),
        ({"upper": {"capital": float("inf")}}, "domain.upper.capital as a finite number, got inf"),
        ({"lower": {"capital": 2}}, "domain.lower.capital < 2, where X₀ ends, got 2"),
        ({"upper": {"capital": 5}}, "domain.upper.capital > 8, where X₀ ends, got 5"),
        ({"lower": {"capital": 9}, "upper": {"capital": 1}}, "domain.lower.capital < 2, where X₀ ends, got 9"),
        ({"lower": 0}, "domain.lower"),
        ({"least": {"capital": 0}}, "domain"),
        (3, "domain"),
    ],
)
def test_what_is_no_domain_is_refused_in_one_line(domain, message):
    with pytest.raises(UsageError, match=message) as refusal:
        build_problem(config_from_plain({**PLAIN, "domain": domain}))
    assert "\n" not in str(refusal.value)


@pytest.fixture
def brief(monkeypatch):
    """A search for a start that takes a second or two."""
    monkeypatch.setattr("lyapnet.training.optima.MAX_OPTIMA", 12)
    monkeypatch.setattr("lyapnet.training.start.MAX_OPTIMA", 12)
    shorten_fits(monkeypatch, 60, 30)
    monkeypatch.setattr("lyapnet.training.pretraining.BRIEF_STEPS", 10)


def written_to(tmp_path, **changes):
    few = {"evaluation": {"validation_states": 16, "test_states": 16, "animate": False}}
    content = {**PLAIN, **few, "training": {"iterations": 4}, "logs": str(tmp_path / "logs"), **changes}
    (tmp_path / "task.yaml").write_text(json.dumps(content))
    return str(tmp_path / "task.yaml")


@pytest.mark.nightly
def test_a_training_to_the_border_of_the_domain(tmp_path, brief, capsys):
    assert main(["train", "--config", written_to(tmp_path), "rollout.gradient=backprop"]) == 0
    result = json.loads((tmp_path / "logs/economy/version_0/evaluation.json").read_text())
    assert 0 <= result["left_domain_fraction"] <= 1
    assert result["cost_mean"] < 0, "none goes far"
    assert abs(result["regret"]) < 0.02
    assert "domain left, share of states" in capsys.readouterr().out
    run = tmp_path / "logs/economy/version_0/checkpoints/best.ckpt"
    assert str(lyapnet.load(run, system=Village(), cost=Displeasure()).problem.domain).startswith("capital > 0")


@pytest.mark.gate
@pytest.mark.parametrize("method", ["euler", "rk4"])
@pytest.mark.parametrize("gradient", ["discrete", "backprop"])
def test_the_gradient_of_a_closed_loop_that_leaves_is_finite(method, gradient):
    problem, V = economy(rollout={"method": method}), Worth(0.0)
    bare = problem.replaced(system=Village(), cost=Displeasure())
    slopes = []
    for each in (problem, bare):
        rollout = Rollout(each, lyapnet.SampledPolicy(each, V), gradient=gradient)
        try:
            cost = rollout(torch.tensor([[2.0], [8.0]], dtype=torch.float64)).cost.mean()
        except DivergenceError:
            continue
        (slope,) = torch.autograd.grad(cost, V.price)
        slopes.append(float(slope))
    assert len(slopes) == 1, "the twin diverges"
    assert math.isfinite(slopes[0])
    assert method != "euler" or slopes[0] < 0, "capital that is worth more is kept"


def test_a_family_has_a_domain():
    problem = economy(system={"name": f"{__name__}:WithShare"}, family={"share": [0.3, 0.5]})
    assert "capital > 0, where f is defined" in str(problem.domain)
    assert isinstance(problem.system, FamilySystem)
    x = torch.tensor([[-1.0, 0.4], [2.0, 0.4]], dtype=torch.float64)
    assert problem.system.f(x).isfinite().all()
    assert_close(problem.system.f(x)[1, :1], 0.8 * x[1, :1] ** 0.4 - 0.2)


class WithShare(Village):
    def __init__(self, share=0.4):
        super().__init__()
        self.share = share

    def f(self, x):
        return 0.8 * x ** torch.as_tensor(self.share).to(x)[..., None] - 0.1 * x


@pytest.mark.gate
def test_an_evaluation_counts_what_leaves():
    kept, lost = (evaluate(lyapnet.Controller(economy(), Worth(each)), 16, optimum=False) for each in (0.8, 0.0))
    assert kept["left_domain_fraction"] == 0
    assert kept["cost_mean"] < 0
    assert lost["left_domain_fraction"] == 1, "capital that is worth nothing is consumed at once"
    assert lost["cost_mean"] is None


class Worth(lyapnet.ValueFunction):
    """V = −p x: what capital is taken to be worth."""

    def __init__(self, price):
        super().__init__()
        self.price = torch.nn.Parameter(torch.tensor(price, dtype=torch.float64))

    def forward(self, t, x):
        return -self.price * x[..., 0] + 0 * t


@pytest.mark.gate
def test_check_says_the_domain_and_who_leaves_it(tmp_path, brief, capsys, monkeypatch):
    assert main(["check", written_to(tmp_path), "--json"]) == 0
    facts = [fact for fact in json.loads(capsys.readouterr().out)["facts"] if fact["fact"] == "domain"]
    assert [fact["found"] for fact in facts] == ["capital > 0, where f is defined"]
    monkeypatch.setattr("lyapnet.task.domain.Domain.left", lambda self, x, slack=0: torch.ones_like(x[0, ..., 0]) > 0)
    assert main(["check", written_to(tmp_path), "--json", "seed=1"]) == 0
    facts = [fact for fact in json.loads(capsys.readouterr().out)["facts"] if fact["fact"] == "domain"]
    assert facts[1]["found"] == "closed loops of the start leave it from 64 of 64 states of X₀"
    assert facts[1]["advice"].startswith("constraints.lower.capital=0")


@pytest.mark.parametrize(("least", "found"), [(1.0, ["x1 upper 1"]), (math.inf, [])], ids=["a root", "none"])
def test_borders_of_many_states_beside_a_matrix_that_is_the_same_everywhere(least, found):
    n = 12  # in several blocks of states
    assert 2 * n * domain.TEST_STATES * domain.SEARCH_PLACES > domain.STATES_AT_ONCE
    functions = {"f": lambda x: (least - x[..., :1]).sqrt(), "g": lambda x: torch.eye(n).expand(*x.shape, n)}
    borders = domain.find_borders(functions, Box([-0.5] * n, [0.5] * n), [f"x{i + 1}" for i in range(n)])
    assert [f"{border.state} {border.side} {border.value:g}" for border in borders] == found
