"""Costs with a kink at the goal: what is rounded, by which formula, where, and what that leads to."""

import pytest
import torch
from torch.testing import assert_close

import lyapnet
from lyapnet.evaluation.oracles import oracle_of
from lyapnet.experiment.assembly import Parts
from lyapnet.experiment.config import config_from_plain
from lyapnet.graphs.casadi_functions import casadi_function, require_equal, trace_for_casadi
from lyapnet.graphs.tracing import trace
from lyapnet.task.cost import PenaltyCost, SmoothedCost
from lyapnet.task.domain import Border, DomainCost, as_written
from lyapnet.training.build import build_module
from lyapnet.training.curves import members_of
from lyapnet.training.task_facts import kink_facts
from lyapnet.value.derivatives import jacobian
from lyapnet.value.expansions import Expansion, at_rest, greedy_law, in_float64, optimal_trajectories, path_under
from lyapnet.value.linearisation import SOLVED, TRAINED, riccati_or_reason, smooth_kinks
from tests.configs import objects
from tests.reports.run import HERE
from tests.reports.values import RIGHT
from tests.tasks_without_goal.tasks import problem_in, replay

PLAIN = {
    "experiment": "kink",
    "system": {"name": "double_integrator"},
    "cost": {"Q": [1, 1], "R": [0.1], "Q_T": [10, 10]},
    "controls": {"lower": -1, "upper": 1},
    "initial_states": {"lower": [-1, -1], "upper": [1, 1]},
    "horizon": {"steps": 20, "dt": 0.05},
}
NORMS = {
    "vector_norm": lambda x: torch.linalg.vector_norm(x, dim=-1),
    "linalg.norm": lambda x: torch.linalg.norm(x, dim=-1),
    "torch.norm": lambda x: torch.norm(x, dim=-1),
    "Tensor.norm": lambda x: x.norm(2, -1),
    "kept": lambda x: x.norm(p=2, dim=(-1,), keepdim=True)[..., 0],
    "lyapnet.norm": lyapnet.norm,
    "sqrt": lambda x: torch.sqrt((x * x).sum(-1)),
    "Tensor.sqrt": lambda x: (x * x).sum(-1).sqrt(),
    "power": lambda x: (x * x).sum(-1) ** 0.5,
    "pow": lambda x: (x * x).sum(-1).pow(0.5),
}
ABSOLUTE = {"torch.abs": torch.abs, "Tensor.abs": lambda x: x.abs(), "abs": abs}


class Kinked(lyapnet.Cost):
    """A function q, and 10q at the end."""

    def __init__(self, q):
        super().__init__()
        self.q = q

    def state(self, x):
        return self.q(x)

    def R(self, x):
        return torch.full((*x.shape[:-1], 1, 1), 0.05, dtype=x.dtype)

    def terminal(self, x):
        return 10 * self.q(x)


def problem_of(q, *overrides):
    return objects(config_from_plain(PLAIN, overrides))[0].replaced(cost=Kinked(q)).double()


def round_of(squared, width):
    return torch.sqrt(squared + width**2) - width


def curvature(function, x):
    leaf = x.clone().requires_grad_()
    return jacobian(jacobian(function(leaf)[..., None], leaf)[..., 0, :], leaf)


@pytest.mark.parametrize("name", [*NORMS, *ABSOLUTE])
def test_values_are_those_of_the_formula(name):
    q = NORMS[name] if name in NORMS else lambda x: ABSOLUTE[name](x).sum(-1)
    problem = smooth_kinks(problem_of(q))
    cost, x = problem.cost, torch.randn(50, 2, dtype=torch.float64)
    x = torch.cat([x, 1e-3 * x, 0 * x])
    assert isinstance(cost, SmoothedCost)
    (width,) = cost.widths["q"]
    assert TRAINED / 2 < width < 2 * TRAINED
    squares = (x * x).sum(-1, keepdim=True) if name in NORMS else x * x
    right = round_of(squares, width).sum(-1)
    assert_close(cost.state(x), right, rtol=0, atol=1e-12)
    assert_close(cost.terminal(x), 10 * right, rtol=0, atol=1e-11)
    assert not torch.allclose(cost.cost.state(x), right, rtol=0, atol=1e-5), "the twin, as it is written"
    goal = torch.zeros(2, dtype=torch.float64)
    assert float(cost.state(goal)) == 0
    assert_close(curvature(cost.state, goal).diagonal(), torch.full_like(goal, 1 / width))
    assert not torch.isclose(curvature(problem_of(q).cost.state, goal), torch.tensor(1 / width).double()).any()


def test_what_is_smooth_stays_the_same_object():
    smooth = {
        "quadratic": lambda x: (x * x).sum(-1),
        "rounded by hand": lambda x: round_of((x * x).sum(-1), 1e-6),
        "a root that does not vanish": lambda x: (1 + x * x).sqrt().sum(-1) - 2,
        "the square of an absolute value": lambda x: x.abs().square().sum(-1),
    }
    for q in smooth.values():
        problem = problem_of(q)
        assert smooth_kinks(problem) is problem
    plain = objects(config_from_plain(PLAIN, []))[0]
    assert smooth_kinks(plain) is plain
    kinked = problem_of(lyapnet.norm)
    assert smooth_kinks(kinked) is not kinked, "the twin"
    assert smooth_kinks(smooth_kinks(kinked)).cost.cost is kinked.cost


def test_a_kink_that_no_root_makes_is_left_with_its_reason():
    problem = problem_of(lambda x: torch.relu(x).sum(-1) + x.square().sum(-1))
    assert smooth_kinks(problem) is problem


def test_a_root_that_does_not_vanish_at_the_goal_is_left_as_it_is():
    problem = smooth_kinks(problem_of(lambda x: torch.sqrt(1 + x[..., 0] ** 2) - 1 + x[..., 1].abs()))
    assert isinstance(problem.cost, SmoothedCost)
    first, second = problem.cost.widths["q"]
    assert first == 0 < second
    x = torch.randn(20, 2, dtype=torch.float64)
    right = torch.sqrt(1 + x[:, 0] ** 2) - 1 + round_of(x[:, 1] ** 2, second)
    assert_close(problem.cost.state(x), right, rtol=0, atol=1e-12)


def test_constraints_and_the_record_are_those_of_the_task():
    problem = problem_of(lyapnet.norm)
    smooth = smooth_kinks(problem)
    assert as_written(smooth.cost) is problem.cost
    assert smooth.record() == problem.record()
    assert smooth.has_goal
    limited = objects(config_from_plain({**PLAIN, "constraints": {"upper": {"velocity": 2}}}, []))[0]
    relaxed = smooth.replaced(constraints=limited.double().constraints).relaxed()
    assert isinstance(relaxed.cost, PenaltyCost)
    assert as_written(relaxed.cost) is problem.cost


def test_in_a_domain_a_root_is_rounded_and_the_price_of_leaving_is_not():
    problem = problem_of(lambda x: torch.sqrt(x[..., 0]) + x[..., 1] ** 2, "initial_states.lower=[0,-1]")
    problem = problem.within([Border("position", "lower", 0.0, "where q is defined")])
    for share in (TRAINED, SOLVED):
        smooth = smooth_kinks(problem, share)
        outer = smooth.cost
        assert isinstance(outer, DomainCost)
        assert isinstance(outer.cost, SmoothedCost)
        assert as_written(outer) is as_written(problem.cost)
        (width,) = outer.cost.widths["q"]
        x = torch.rand(20, 2, dtype=torch.float64) + 0.1
        assert_close(outer.state(x), round_of(x[:, 0], width) + x[:, 1] ** 2, rtol=0, atol=1e-12)


def test_traces_are_the_functions():
    problem = smooth_kinks(problem_of(lyapnet.norm))
    x = torch.randn(3, 2, dtype=torch.float64)

    def both(x):
        return problem.cost.state(x), problem.cost.terminal(x)

    for result, value in zip(trace(both, (x,))(x), both(x), strict=True):
        assert_close(result, value)
    one = torch.zeros(1, 2, dtype=torch.float64)
    require_equal(casadi_function(trace_for_casadi(both, (one,)), (one,)), both, (one,))


def test_what_trains_is_rounded():
    content = {**PLAIN, "cost": {"name": "kinks:Kinked"}}
    module = build_module(config_from_plain(content, []), Parts(cost=Kinked(lyapnet.norm)))
    problem = members_of(module)[0].problem
    assert isinstance(problem.cost, SmoothedCost)
    (fact,) = kink_facts(problem)
    assert fact.found.startswith("q and φ have a kink at the goal: training smooths them, √(x² + ε²) − ε with ε = ")
    plain = members_of(build_module(config_from_plain(PLAIN, [])))[0].problem
    assert not isinstance(plain.cost, SmoothedCost)
    assert not kink_facts(plain), "the twin"


@pytest.mark.gate
def test_the_distance_to_a_goal():
    """Optima from no control and from the Riccati law, and by IPOPT, for what they cost as the task is written."""
    pytest.importorskip("casadi")
    problem, x0 = problem_in(HERE / "distance"), torch.tensor(list(RIGHT["distance"]), dtype=torch.float64)
    right = torch.tensor(list(RIGHT["distance"].values()), dtype=torch.float64)
    smooth = in_float64(smooth_kinks(problem, SOLVED))
    known = riccati_or_reason(smooth)
    assert isinstance(known, Expansion)
    assert not isinstance(riccati_or_reason(problem), Expansion), "the twin, as it is written"
    for law in (at_rest(smooth), greedy_law(smooth, known)):
        u = optimal_trajectories(smooth, x0, path_under(smooth, law, x0).u).path.u
        assert_close(replay(problem, x0, u.transpose(0, 1)).J, right, rtol=1e-3, atol=0)
    u = path_under(problem, at_rest(problem), x0).u
    unrounded = optimal_trajectories(problem, x0, u).path.cost
    assert bool((unrounded > 1.1 * right).any()), "the twin, as it is written"
    optima = oracle_of(problem).solve(x0)
    assert optima.u is not None
    assert_close(optima.cost, right, rtol=2e-4, atol=0)
    assert_close(optima.cost, replay(problem, x0, optima.u.transpose(0, 1)).J, rtol=1e-9, atol=0)
