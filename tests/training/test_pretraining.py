"""Fitting V to optima: what the examples say, against Riccati's solution and rollouts; and what fitting brings."""

import itertools

import pytest
import torch
from torch.testing import assert_close

from lyapnet.evaluation.oracles import discrete_riccati
from lyapnet.graphs.compilation import has_compiler
from lyapnet.loop.programs import ValueProgram
from lyapnet.loop.rollout import Rollout
from lyapnet.task.constraints import StateLimits
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.sets import ControlBox
from lyapnet.task.systems import Linear, Pendulum
from lyapnet.training import examples as of_optima
from lyapnet.training import pretraining
from lyapnet.training.examples import draw_examples, examples_visited
from lyapnet.training.learner import Learner
from lyapnet.training.optima import optima_for
from lyapnet.training.pretraining import errors, fit
from lyapnet.value.expansions import at_rest, optimal_trajectories, path_under, riccati
from lyapnet.value.networks import FCN, Scaling
from lyapnet.value.policy import SampledPolicy
from tests.fits import shorten_fits
from tests.problems import Formula, problem_of
from tests.value.expansions.test_expansions import hanging

GENERATOR = torch.Generator().manual_seed(0)


@pytest.fixture
def problem():
    return problem_of(Linear([[0.0, 1.0], [1.0, 0.0]], [[0.0], [1.0]]), steps=20, dt=0.1)


def shifted(problem, by):
    """The value function of a linear problem at the nodes, with a slope of its own added."""
    P = discrete_riccati(problem.system, problem.cost, problem.horizon).P

    def value(t, x):
        matrix = P[(t / problem.horizon.dt).round().long().clamp(0, problem.horizon.steps)]
        return ((x[..., None, :] @ matrix)[..., 0, :] * x).sum(-1) + by * x.sum(-1)

    return Formula(value)


def test_examples_are_the_value_function_of_a_linear_problem(problem):
    optimum = optima_for(problem, [riccati(problem)], problem.initial_states.sample(6))
    examples = draw_examples(problem, optimum, GENERATOR)
    along, near = examples.x.reshape(2, problem.horizon.steps, 6, problem.system.n)
    assert torch.equal(along, optimum.path.x[:-1])
    apart = (along[:, :, None] - along[:, None]).abs().max()
    assert 0.1 * apart < (near - along).abs().max() <= apart / 2
    value_error, excess = errors(shifted(problem, 0.0), examples, problem)
    assert float(value_error.detach()) < 1e-20
    assert float(excess.detach()) < 1e-20


def test_a_law_that_looks_ahead_has_examples_where_its_search_begins_and_where_it_ends():
    """About the control that costs nothing, and about the best one; with constraints about the best one alone."""
    problem = problem_of(Pendulum(), steps=12, dt=0.05)
    optimum = optimal_trajectories(problem, problem.initial_states.sample(3), torch.zeros(12, 3, 1))
    plain, ahead = (draw_examples(problem, optimum, torch.Generator().manual_seed(1), each) for each in (False, True))
    assert len(ahead.t) == 2 * len(plain.t)
    at_rest, at_best = (ahead.each(lambda column, k=k: column.unflatten(0, (2, 2, -1))[:, k]) for k in (0, 1))
    assert_close(at_rest.about, torch.zeros_like(at_rest.about))
    assert_close(at_rest.best.flatten(0, 1), plain.best)
    assert_close(at_best.about, at_best.best, rtol=1e-6, atol=1e-9)
    assert at_best.about.abs().max() > 0.1
    assert_close(at_best.led, problem.step(at_best.x, at_best.about)[0])
    never = StateLimits([1], [50.0], [1.0], [1.0])
    relaxed = problem.replaced(constraints=never).relaxed(weight=1e-6)
    assert_close(
        draw_examples(relaxed, optimum, torch.Generator().manual_seed(1), True).about, at_best.about.flatten(0, 1)
    )


def test_the_excess_is_what_wrong_controls_cost(problem):
    """To the last digit where the problem is linear: here along one trajectory, from its start."""
    x0, V = torch.tensor([[0.4, -0.7]]), shifted(problem, 0.3)
    policy, times = SampledPolicy(problem, V), problem.horizon.times(torch.zeros(()))
    path = path_under(problem, lambda n, x: policy(times[n], x).detach(), x0)
    optimum = optimal_trajectories(problem, x0, torch.zeros(problem.horizon.steps, 1, 1))
    along = draw_examples(
        problem, optimum._replace(path=optimum.path._replace(x=path.x), expansion=at(path.x, problem)), GENERATOR
    )
    _, excess = errors(V, along, problem)
    expected = float(path.cost - optimum.path.cost)
    assert expected > 0.01
    assert float(excess.detach()) * float(along.cost[0]) == pytest.approx(expected, rel=1e-9)


def test_a_wrong_slope_costs_nothing_where_the_control_stays_at_its_limit():
    """ẋ = u with |u| ≤ 1 from so far away that u* is at its limit all the way."""
    free = problem_of(Linear([[0.0]], [[1.0]]), QuadraticCost([[1.0]], [[0.01]], [[1.0]]), steps=10, dt=0.1)
    limited = free.replaced(controls=ControlBox([-1.0], [1.0]))
    optimum = optimal_trajectories(limited, torch.tensor([[5.0], [8.0]]), torch.zeros(10, 2, 1))
    assert bool((optimum.path.u == -1).all())
    start = draw_examples(limited, optimum, GENERATOR).each(lambda column: column[:2])  # both states x₀

    def excess(share, problem=limited):
        scaled = Formula(lambda t, x: share * (optimum.expansion.gradient[1] * x).sum(-1))
        return float(errors(scaled, start, problem)[1].detach())

    assert excess(1.0) == pytest.approx(0, abs=1e-12)
    assert excess(0.5) == pytest.approx(0, abs=1e-12)
    assert excess(0.5, free) > 1, "the twin without limits"
    assert excess(-1.0) > 0.5, "the twin at the other limit"


def at(x, problem):
    """Riccati's expansion around any states."""
    P = discrete_riccati(problem.system, problem.cost, problem.horizon).P[:, None]
    gradient = 2 * (P @ x[..., None])[..., 0]
    return riccati(problem)._replace(
        x=x, value=(gradient * x).sum(-1) / 2, gradient=gradient, hessian=2 * P.expand(*x.shape, x.shape[-1])
    )


@pytest.fixture(scope="module")
def optima():
    """A pendulum that hangs, and optima of it: (problem, those that are fitted to, those that are not)."""
    problem = hanging(steps=40)
    expansion = optimal_trajectories(problem, problem.initial_states.center[None], torch.zeros(40, 1, 1)).expansion
    seen, unseen = (optima_for(problem, [expansion.member(0)], problem.initial_states.sample(12)) for _ in range(2))
    return problem, seen, unseen


@pytest.fixture
def swing(optima, monkeypatch):
    """The same, with short fits."""
    shorten_fits(monkeypatch, 400, 200)
    return optima


def learner_of(problem, value_scale=1.0):
    V = FCN(Scaling((3.0,) * problem.system.n, problem.horizon.duration, value_scale), (32, 32))
    return Learner(problem, V, Rollout(problem, SampledPolicy(problem, V), gradient="discrete"), ValueProgram())


@pytest.mark.gate
def test_fitting_lowers_both_errors_on_states_that_it_did_not_see(swing):
    problem, seen, unseen = swing
    examples, others = (draw_examples(problem, optimum, GENERATOR) for optimum in (seen, unseen))
    learner = learner_of(problem, float(examples.cost.mean()))
    before = [float(error.detach()) for error in errors(learner.V, others, problem)]
    fit(learner, seen, examples)
    after = [float(error.detach()) for error in errors(learner.V, others, problem)]
    assert after[0] < before[0] / 20
    assert after[1] < before[1] / 20


@pytest.mark.gate
def test_a_fit_does_not_depend_on_the_pace_of_the_machine_unless_time_runs_out(problem, monkeypatch):
    """The twin: where time runs out, the learning rate falls sooner."""
    optimum = optima_for(problem, [riccati(problem)], problem.initial_states.sample(6))
    examples = draw_examples(problem, optimum, torch.Generator().manual_seed(0))

    def weights_after(pause):
        clock = itertools.chain([0.0] * 3, itertools.repeat(pause))  # one slow step, as of a busy machine
        monkeypatch.setattr(pretraining, "seconds_of_work", lambda: next(clock))
        torch.manual_seed(0)
        learner = learner_of(problem, 1.0)
        pretraining.fit_briefly(learner, examples)
        return torch.cat([p.flatten() for p in learner.V.parameters()])

    monkeypatch.setattr(pretraining, "BRIEF_STEPS", 40)
    seconds, undisturbed = pretraining.FIT_SECONDS[0], weights_after(0.0)
    assert torch.equal(weights_after(0.09 * seconds), undisturbed)
    assert not torch.equal(weights_after(0.5 * seconds), undisturbed)


@pytest.mark.gate
def test_a_law_that_costs_too_much_is_fitted_where_it_leads_until_it_does_not(swing, monkeypatch):
    """At most so many times as the method says; what stays is the V whose law cost least, though it is not the last."""
    problem, seen, _ = swing
    shorten_fits(monkeypatch, 60, 30)  # what is decided by pretended costs does not need a good fit
    smooth = pretraining.SMOOTH
    monkeypatch.setattr(pretraining, "SMOOTH", pretraining.WITH_KINKS)
    given, costs = draw_examples(problem, seen, GENERATOR), list[float]()
    mean, led = float(seen.path.cost.mean()), Learner.path_from

    steps, lower = list[int](), pretraining._Fit.lower
    now, seconds_of_a_fit = 1000.0, 0.0

    def lowering(self, examples, count, *arguments):
        nonlocal now
        steps.append(count)
        lower(self, examples, min(count, 60), *arguments)
        now += seconds_of_a_fit

    monkeypatch.setattr(pretraining._Fit, "lower", lowering)
    monkeypatch.setattr(pretraining, "seconds_of_work", lambda: now)

    def fitted(*pretended):
        """The cost of the law that is kept, and of each that was tried; the mean cost of each is pretended."""
        costs.clear()
        steps.clear()

        def pretending(learner, x0):
            path = led(learner, x0)
            costs.append(float(path.cost.mean()))
            return path._replace(cost=path.cost * pretended[len(costs) - 1] * mean / path.cost.mean())

        monkeypatch.setattr(Learner, "path_from", pretending)
        learner = learner_of(problem, mean)
        fit(learner, seen, given)
        return float(learner.rollout(seen.path.x[0]).cost.mean().detach())

    fitted(1.0005)
    assert len(costs) == 1, "that is enough"
    kept = fitted(2, 1.5, 1.0005)
    assert len(costs) == 3
    assert kept == pytest.approx(costs[2], rel=1e-6)
    assert steps == [60, 120, 120], "far from the optimum a round takes four times as many"
    kept = fitted(1.1, 1.0025, 1.0027, 1.0026, 1)
    assert len(costs) == 4, "the third and the fourth gain nothing"
    assert steps == [60, 120, 30, 30]
    assert kept == pytest.approx(costs[1], rel=1e-6)
    assert costs[1] != pytest.approx(costs[3], rel=1e-6)
    kept = fitted(1.1, 1.0025, 1.0027, 1.002, 1)
    assert len(costs) == 5, "after one in vain there is another"
    assert kept == pytest.approx(costs[4], rel=1e-6)
    kept = fitted(2, 1.5, 1.7, 1.6, 1.8, 1.2, 1)
    assert len(costs) == 7, "far from the optimum also after three in vain"
    fitted(2, 1.5, 1.7, 1.6, 1.8, 1.9, 1)
    assert len(costs) == 6, "but not after four"
    kept = fitted(2, 1.5, 1.4, 1.3, 1.2, 1.1, 1.09, 1.08, 1.07, 1.0)
    assert len(costs) == 1 + pretraining.WITH_KINKS.rounds
    assert kept == pytest.approx(costs[8], rel=1e-6)
    seconds_of_a_fit = 0.3 * pretraining.ROUNDS_SECONDS
    fitted(2, 1.5, 1.4, 1.3, 1.2, 1.1, 1.0)
    assert len(costs) == 5, "the fourth round ends after the time for rounds, which begins after the first fit"
    monkeypatch.setattr(pretraining, "SMOOTH", smooth)
    seconds_of_a_fit = 0.0
    fitted(2, 1.5, 1.7, 1.6, 1.2, 1)
    assert steps == [60, 30, 30, 30], "without kinks neither longer rounds nor more patience"


@pytest.mark.gate
@pytest.mark.parametrize("method", ["euler", "rk4"])
def test_the_compiled_loop_leads_where_the_law_does(swing, method):
    """Also where some states diverge; a loop whose controls are not held leads elsewhere, and is not taken."""
    problem = swing[0].in_steps(method=method)
    learner, x0 = learner_of(problem, 1.0), torch.tensor([[3.0, 0.5], [1e200, 1.0], [0.1, 0.0]], dtype=torch.float64)
    with torch.no_grad():
        for parameter in learner.V.parameters():
            parameter.normal_(generator=torch.Generator().manual_seed(0))
    policy, times = learner.rollout.closed_loop.policy, problem.horizon.times(x0)
    expected = path_under(problem, lambda n, x: policy(times[n], x).detach(), x0)
    if has_compiler():
        assert learner.rollout.discrete is not None
        learner.rollout.discrete.compile(x0[:2])
    found = learner.path_from(x0)
    assert_close(found, expected)
    assert found.cost.isfinite().tolist() == [True, False, True]
    unheld = Rollout(problem, policy, gradient="discrete", held=False)
    assert unheld.takes_steps_of_problem is (method == "euler")
    learner.rollout = unheld
    assert unheld.discrete is not None
    assert_close(learner.path_from(x0), expected)
    if method == "rk4":
        led = unheld.discrete(x0)[0].detach()
        assert float((led - expected.x)[:, 0].abs().max()) > 1e-6, "the twin"


def test_near_states_are_no_further_than_their_expansion_is_believed(swing, monkeypatch):
    problem, seen, _ = swing
    H, cost = seen.expansion.hessian[:-1], seen.path.cost.clamp_min(float(seen.path.cost.median()))

    def furthest():
        """The greatest ½ δᵀ|H|δ, as a share of the cost."""
        generator = torch.Generator().manual_seed(1)
        along, near = draw_examples(problem, seen, generator).x.reshape(2, problem.horizon.steps, 12, 2)
        values, vectors = torch.linalg.eigh(H)
        moved = (vectors.mT @ (near - along)[..., None])[..., 0]
        return float(((moved**2 * values.abs()).sum(-1) / 2 / cost).max())

    anyhow = furthest()
    monkeypatch.setattr(of_optima, "NEIGHBOUR_TRUST_LIMIT", anyhow / 5)
    assert furthest() == pytest.approx(anyhow / 5)


@pytest.mark.gate
def test_where_no_law_is_finite_a_fit_leaves_the_weights(swing, monkeypatch):
    problem, seen, _ = swing
    learner, x = learner_of(problem, 1.0), torch.randn(5, 2)
    before = learner.V(torch.zeros(()), x)
    monkeypatch.setattr(pretraining, "SMOOTH", pretraining.SMOOTH._replace(rounds=1))
    diverging = path_under(problem, at_rest(problem), seen.path.x[0])
    diverging = diverging._replace(cost=diverging.cost * torch.inf)
    monkeypatch.setattr(Learner, "path_from", lambda *arguments: diverging)
    fit(learner, seen, draw_examples(problem, seen, GENERATOR))
    assert_close(learner.V(torch.zeros(()), x), before, rtol=0, atol=0)


def test_errors_count_against_what_their_own_trajectory_costs(problem):
    """From a state that is dear, a V that is off by a tenth is off as much as from others; from a cheap one, less."""
    x0 = torch.tensor([[1.0, 0.0], [10.0, 0.0], [20.0, 0.0]])
    optimum = optimal_trajectories(problem, x0, torch.zeros(problem.horizon.steps, 3, 1))
    examples, exact = draw_examples(problem, optimum, GENERATOR), shifted(problem, 0.0)
    wrong = Formula(lambda t, x: 1.1 * exact(t, x))
    off = [errors(wrong, examples.each(lambda column, row=row: column[[row]]), problem)[0].item() for row in range(3)]
    assert off == pytest.approx([0.01 * 1e-4, 0.01, 0.01], rel=1e-6)


def test_the_states_that_a_law_visits_are_examples(problem):
    """Of a linear problem, whose expansions are exact wherever they are asked."""
    optimum = optima_for(problem, [riccati(problem)], problem.initial_states.sample(6))
    law = at_rest(problem)
    led_path = path_under(problem, law, optimum.path.x[0])
    visited = examples_visited(problem, optimum, led_path)
    x = visited.x.reshape(problem.horizon.steps, 6, problem.system.n)
    led, best = led_path.x[:-1], optimum.path.x[:-1]
    share = ((x - best) * (led - best)).sum(-1) / ((led - best) ** 2).sum(-1).clamp_min(1e-12)
    assert_close(x - best, share[..., None] * (led - best))
    assert bool((share[1:] > 0).all())
    assert float(share.min()) < 0.9, "what lies far from the optimum is drawn nearer"
    near = examples_visited(
        problem, optimum, led_path._replace(x=optimum.path.x + 0.01 * (led_path.x - optimum.path.x))
    )
    assert_close(near.x.reshape(x.shape), best + 0.01 * (led - best), msg="and what lies near it is not")
    for error in errors(shifted(problem, 0.0), visited, problem):
        assert float(error.detach()) < 1e-20
    assert float(errors(shifted(problem, 0.1), visited, problem)[1].detach()) > 1e-6
    assert len(draw_examples(problem, optimum, GENERATOR).concatenated_with(visited).t) == 3 * len(visited.t)


@pytest.mark.parametrize("free", [False, True])
def test_a_law_that_diverges_leaves_finite_examples(problem, free):
    if free:  # a state that costs nothing, in which V does not curve
        cost = QuadraticCost(torch.diag(torch.tensor([1.0, 0.0])), [[1.0]], torch.diag(torch.tensor([1.0, 0.0])))
        problem = problem_of(Linear([[0.0, 0.0], [1.0, 0.0]], [[1.0], [0.0]]), cost, steps=20, dt=0.1)
    optimum = optima_for(problem, [riccati(problem)], problem.initial_states.sample(4))
    path = path_under(problem, lambda _, x: 1e40 * x[..., :1] * x.norm(), optimum.path.x[0])
    assert float(path.x.abs().max()) > 1e300
    visited = examples_visited(problem, optimum, path)
    assert all(column.isfinite().all() for column in visited)


def test_only_finite_trajectories_are_examples(problem):
    x0 = problem.initial_states.sample(3)
    optimum = optimal_trajectories(problem, x0, torch.zeros(problem.horizon.steps, 3, 1))
    broken = optimum.path.cost.clone()
    broken[1] = torch.inf
    examples = draw_examples(problem, optimum._replace(path=optimum.path._replace(cost=broken)), GENERATOR)
    assert len(examples.t) == 2 * 2 * problem.horizon.steps
    assert_close(examples.cost.unique(), optimum.path.cost[[0, 2]].sort().values)
