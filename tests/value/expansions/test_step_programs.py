"""What differential dynamic programming asks of a problem's steps, by the kernel and by torch."""

import pickle

import pytest
import torch
from torch.testing import assert_close

from lyapnet import Box, ControlAffineSystem, ControlBox, Cost, Horizon, Problem, QuadraticCost
from lyapnet.graphs.number_kernel.kernel import NumberKernel, ScanKernel
from lyapnet.task.sets import ControlSet
from lyapnet.task.systems import Pendulum
from lyapnet.value.derivatives import StepDerivatives
from lyapnet.value.expansions import (
    Expansion,
    follow_expansions,
    greedy_law,
    in_float64,
    optimal_trajectories,
    path_of,
    path_under,
)
from lyapnet.value.expansions.step_programs import StepPrograms
from tests.marks import sample

SIZES = (1.0, 0.25)


class Looking(Pendulum):
    """A pendulum whose code looks at numbers, and so has no trace."""

    def mass_matrix(self, q):
        return super().mass_matrix(q) * (1.0 if float(q.detach().abs().max()) < 1e6 else 2.0)


def swinging(system=None, steps=12, method="rk4", cost=None):
    cost = cost or QuadraticCost([[1.0, 0], [0, 0.1]], [[0.1]], [[5.0, 0], [0, 1]])
    box = Box([-1, -1], [1, 1])
    return in_float64(Problem(system or Pendulum(), cost, ControlBox(-2, 2), box, Horizon(steps, 0.05, method)))


def law_along(problem, b):
    """A path (x̄, ū) from b states, and some gains along it."""
    generator = torch.Generator().manual_seed(b)
    N = problem.horizon.steps
    u, k = (torch.randn(N, b, 1, generator=generator, dtype=torch.float64) for _ in range(2))
    K = torch.randn(N, b, 1, 2, generator=generator, dtype=torch.float64)
    x0 = problem.initial_states.sample(b, generator).double()
    return path_under(problem, lambda n, _: u[n], x0).x, u, k, K


def programs_of(problem):
    return {key[0]: type(program) for key, program in problem.findings.programs.items()}


@pytest.mark.parametrize("b", [1, 16, 37])
@pytest.mark.parametrize(("system", "kernel"), [(Pendulum, ScanKernel), (Looking, type(None))])
def test_line_searches_are_closed_loops_of_their_law(system, kernel, b):
    problem = swinging(system())
    x, u, k, K = law_along(problem, b)

    def law(n, now):
        alpha = torch.tensor(SIZES, dtype=torch.float64)[:, None, None]
        return problem.controls.project(u[n] + alpha * k[n] + (K[n] @ (now - x[n])[..., None])[..., 0])

    expected = path_under(problem, law, x[0].expand(len(SIZES), b, 2))
    found = path_of(problem, *StepPrograms(problem, SIZES).search(x, u, k, K))
    assert programs_of(problem) == {"search": kernel}
    assert found.x.shape == (13, 2, b, 2)
    for mine, other in zip(found, expected, strict=True):
        assert_close(mine, other, rtol=1e-10, atol=1e-10)
    assert not torch.allclose(found.cost[0], found.cost[1]), "the step sizes lead elsewhere"


@pytest.mark.parametrize("b", sample([16, 1, 37], 3))
@pytest.mark.parametrize(("system", "kernel"), [(Pendulum, ScanKernel), (Looking, type(None))])
def test_each_state_follows_the_law_of_an_expansion_of_its_own(system, kernel, b):
    problem, generator = swinging(system()), torch.Generator().manual_seed(0)
    N = problem.horizon.steps
    x, p = (torch.randn(N + 1, b, 2, generator=generator, dtype=torch.float64) for _ in range(2))
    root = torch.randn(N + 1, b, 2, 2, generator=generator, dtype=torch.float64)
    expansion = Expansion(x, x[..., 0], p, root @ root.mT)
    u = torch.zeros(N, b, 1, dtype=torch.float64)
    expected = path_under(problem, greedy_law(problem, expansion), x[0])
    found = follow_expansions(problem, expansion, u, x[0])
    assert programs_of(problem) == {"follow": kernel}
    for mine, other in zip(found, expected, strict=True):
        assert_close(mine, other, rtol=1e-10, atol=1e-10)
    if b > 1:
        turned = expansion.member(torch.arange(b).roll(1))
        assert not torch.allclose(follow_expansions(problem, turned, u, x[0]).cost, found.cost), "the twin: of another"


@pytest.mark.parametrize("rows", sample([512, 1, 700], 3))
@pytest.mark.parametrize(("system", "kernel"), [(Pendulum, NumberKernel), (Looking, type(None))])
def test_derivatives_are_those_of_autograd(system, kernel, rows):
    problem = swinging(system())
    generator = torch.Generator().manual_seed(0)
    z, p = (torch.randn(rows, d, generator=generator, dtype=torch.float64) for d in (3, 2))
    programs = StepPrograms(problem, SIZES)
    first, bends = programs.first(z), programs.curvature(z, p)
    assert programs_of(problem) == {"first": kernel, "curvature": kernel}
    by_torch = StepDerivatives(problem.step, 2)
    for mine, other in zip([*first, bends], [*by_torch.first(z), by_torch.curvature(z, p)], strict=True):
        assert_close(mine, other, rtol=1e-10, atol=1e-12)
    k = rows // 2
    F, paid = (lambda z, part=part: problem.step(z[:2], z[2:])[part] for part in (0, 1))
    of = torch.autograd.functional
    expected = [F(z[k]), paid(z[k]), of.jacobian(F, z[k]), of.jacobian(paid, z[k]), of.hessian(paid, z[k])]
    for mine, other in zip(first, expected, strict=True):
        assert_close(mine[k], other, rtol=1e-10, atol=1e-12)
    assert_close(bends[k], of.hessian(lambda z: F(z) @ p[k], z[k]), rtol=1e-10, atol=1e-12)


@pytest.mark.gate
def test_copies_of_a_problem_share_its_programs_and_other_steps_have_their_own():
    problem = swinging()
    one = StepPrograms(problem, SIZES).first(torch.ones(3, 3, dtype=torch.float64))
    again = StepPrograms(in_float64(problem), SIZES).first(torch.ones(3, 3, dtype=torch.float64))
    assert len(problem.findings.programs) == 1
    assert_close(one, again, rtol=0, atol=0)
    euler = StepPrograms(problem.in_steps(method="euler"), SIZES).first(torch.ones(3, 3, dtype=torch.float64))
    assert len(problem.findings.programs) == 2
    assert not torch.allclose(euler[0], one[0])
    assert pickle.loads(pickle.dumps(problem)).findings.programs == {}, "a program belongs to its process"


@pytest.mark.gate
def test_tensors_of_a_problem_may_change():
    problem = swinging(Pendulum())
    z = torch.ones(3, 3, dtype=torch.float64)
    before = StepPrograms(problem, SIZES).first(z)
    problem.cost.Q.mul_(2)
    after = StepPrograms(problem, SIZES).first(z)
    assert_close(after, StepDerivatives(problem.step, 2).first(z), rtol=1e-12, atol=1e-12)
    assert not torch.allclose(before[1], after[1])


class Priced(Cost):
    """|x|² at a price that is a number, and no tensor."""

    price = 1.0

    def state(self, x):
        return self.price * x.square().sum(-1)

    def R(self, x):
        return torch.full((*x.shape[:-1], 1, 1), 0.1, dtype=x.dtype)

    def terminal(self, x):
        return 5 * x.square().sum(-1)


@pytest.mark.gate
@pytest.mark.parametrize("what", ["mass", "price"])
def test_a_number_that_changed_is_noticed(what):
    def problem_with(value):
        problem = swinging(steps=30, cost=Priced())
        setattr(problem.system if what == "mass" else problem.cost, what, value)
        return problem

    problem = problem_with(1.0)
    x0, u = torch.tensor([[0.5, 0.0], [-0.3, 0.8]]), torch.zeros(30, 2, 1)
    found = optimal_trajectories(problem, x0, u)
    before = found.path
    follow_expansions(problem, found.expansion, found.path.u, x0)
    assert {programs_of(problem)[name] for name in ("search", "follow")} == {ScanKernel}
    assert StepPrograms(problem, SIZES).agrees(before)
    setattr(problem.system if what == "mass" else problem.cost, what, 3.0)
    assert not StepPrograms(problem, SIZES).agrees(before)
    followed = follow_expansions(problem, found.expansion, found.path.u, x0)
    assert_close(followed, path_under(problem, greedy_law(problem, found.expansion), x0))
    after = optimal_trajectories(problem, x0, u).path
    assert StepPrograms(problem, SIZES).agrees(after)
    assert set(programs_of(problem).values()) == {type(None)}
    assert_close(after.cost, optimal_trajectories(problem_with(3.0), x0, u).path.cost)
    assert not torch.allclose(after.cost, before.cost)


class Exploding(ControlAffineSystem):
    """ẋ = x³ + u, which leaves the finite numbers within a few steps."""

    state_names, state_units = ("x",), ("",)
    control_names, control_units = ("u",), ("",)

    def f(self, x):
        return x**3

    def g(self, x):
        return torch.ones_like(x)[..., None]


class Saturating(Cost):
    """1 far from the goal, at infinity too."""

    def state(self, x):
        return 1 - torch.exp(-x.square().sum(-1))

    def R(self, x):
        return torch.ones_like(x)[..., None]

    def terminal(self, x):
        return self.state(x)


def test_a_path_through_infinity_that_costs_little_ends_the_search_all_the_same():
    problem = Problem(Exploding(), Saturating(), ControlBox(-1, 1), Box([5], [6]), Horizon(12, 1.0))
    found = optimal_trajectories(problem, torch.tensor([[5.0], [6.0]]), torch.zeros(12, 2, 1))
    assert found.path.cost.isfinite().all()
    assert float(found.path.x.abs().max()) > 1e300
    assert not StepPrograms(in_float64(problem), SIZES).agrees(found.path), "what is cut to the largest number"


class Ball(ControlSet):
    """|u| ≤ r, with r a number and no tensor."""

    def __init__(self, radius):
        super().__init__()
        self.radius = radius

    def minimise(self, R, b):
        return self.project(-0.5 * b / R[..., 0])

    def contains(self, u):
        return u.abs()[..., 0] <= self.radius

    def project(self, u):
        return u.clamp(-self.radius, self.radius)


def test_controls_that_differ_in_a_number_have_programs_of_their_own():
    problem = swinging()
    x, u, k, K = law_along(problem, 2)
    for radius in (1.0, 0.5):
        limited = problem.replaced(controls=Ball(radius))
        assert limited.findings is problem.findings
        found = StepPrograms(limited, SIZES).search(x, 10 * u, k, K)[1]
        assert float(found.abs().max()) == radius
    assert len(problem.findings.programs) == 2


@pytest.mark.parametrize("end", [-torch.inf, torch.inf, torch.nan])
def test_a_path_without_a_finite_cost_costs_infinitely_much(end):
    """Also where costs may be negative."""
    problem = swinging()
    x, u, _, _ = law_along(problem, 2)
    cost = path_of(problem, x, u, torch.tensor([1.0, end])).cost
    assert cost.isfinite().tolist() == [True, False]
    assert cost[1] == torch.inf
