"""The optimum by direct transcription, held against Riccati, rollouts and finite differences; and what it refuses."""

import math
import random
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from lyapnet.base.errors import OracleError
from lyapnet.evaluation.oracles import Optima, Oracle, continuous_riccati, discrete_riccati, oracle_of, transcription
from lyapnet.evaluation.oracles.cache import OptimaCache
from lyapnet.evaluation.oracles.multistart import EXPLORED, EXPLORED_AGAIN, Candidate, MultiStart
from lyapnet.evaluation.oracles.of_smoothed import OracleOfSmoothed
from lyapnet.evaluation.oracles.transcription import Transcription
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import load_config
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.horizon import Horizon
from lyapnet.task.sets import Box, Unbounded
from lyapnet.task.systems import Cartpole, ControlAffineSystem, DoubleIntegrator, Linear, Reacher
from tests.marks import sample
from tests.problems import problem_of

CONF = Path(__file__).parents[2] / "conf"


@pytest.fixture(autouse=True)
def _empty_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("LYAPNET_CACHE", str(tmp_path / "cache"))


def transcription_of(name, *overrides, **options):
    """The oracle of a shipped config, and its X₀."""
    problem = build_problem(load_config(CONF / f"{name}.yaml", list(overrides)))
    return Transcription(problem, **options), problem.initial_states


# The optimum


def linear_problem(n, m):
    """Unstable in open loop, with couplings in all weights."""
    half, terminal = torch.randn(n, n), torch.randn(n, n)
    cost = QuadraticCost(half @ half.mT, torch.eye(m) + 0.2 * torch.ones(m, m), terminal @ terminal.mT)
    return problem_of(Linear(torch.randn(n, n), torch.randn(n, m)), cost, 30, 0.05)


@pytest.mark.parametrize(("n", "m"), [(1, 1), (3, 2), (6, 1)])
def test_optimum_of_a_linear_task_is_riccatis(n, m):
    problem = linear_problem(n, m)
    system, cost, horizon = problem.system, problem.cost, problem.horizon
    x0 = torch.randn(5, n)
    optima = Transcription(problem).solve(x0)
    solution = discrete_riccati(system, cost, horizon)
    assert_close(optima.cost, solution.value(0, x0), rtol=1e-8, atol=1e-10)
    assert_close(optima.u[0], solution.policy(0, x0), rtol=1e-4, atol=1e-4)
    # twin: a slightly different model has another optimum
    other = discrete_riccati(Linear(1.001 * system.A, system.B), cost, horizon)
    assert not torch.allclose(optima.cost, other.value(0, x0), rtol=1e-6)


@pytest.mark.parametrize(("method", "order"), sample([("euler", 1), ("midpoint", 2), ("rk4", 2)], 3))
def test_optima_approach_that_of_continuous_time(method, order):
    """Holding u over a step costs O(Δt²), whatever the order of the steps."""
    problem, x0 = linear_problem(2, 1), torch.randn(3, 2)
    system, cost, horizon = problem.system, problem.cost, problem.horizon
    best = continuous_riccati(system, cost, horizon).value(0, x0)
    off = []
    for k in (2, 4):
        finer = problem.replaced(horizon=Horizon(k * horizon.steps, horizon.dt / k))
        off.append((Transcription(finer, method).solve(x0).cost / best - 1).abs().mean())
    assert float(torch.log2(off[0] / off[1])) == pytest.approx(order, abs=0.2)
    assert off[1] < (0.05 if order == 1 else 1e-3)


@pytest.mark.gate
def test_a_rollout_by_other_steps_is_compared_with_the_optimum_of_those():
    problem = transcription_of("pendulum_swingup", "horizon.steps=20")[0].problem
    x0 = problem.initial_states.sample(2).double()
    optima = {method: oracle_of(problem, method).solve(x0) for method in ("euler", "rk4", "dopri5")}
    assert_close(optima["rk4"].cost, optima["dopri5"].cost, rtol=1e-12, atol=0)
    assert not torch.allclose(optima["rk4"].cost, optima["euler"].cost, rtol=1e-4)


def test_one_step_and_any_leading_shape():
    system, cost = DoubleIntegrator(), QuadraticCost(torch.eye(2), [[1.0]], torch.eye(2))
    oracle = Transcription(problem_of(system, cost, 1, 0.1))
    x0 = torch.randn(2, 3, 2)
    assert_close(oracle(x0), discrete_riccati(system, cost, Horizon(1, 0.1)).value(0, x0))
    assert oracle(x0[0, 0]).shape == ()
    assert oracle(x0.float()).dtype == torch.float32


def test_R_as_a_function_needs_no_riccati_equation():
    system = DoubleIntegrator(mass=2.0)
    cost = QuadraticCost(torch.eye(2), system.inverse_mass, torch.eye(2))
    same = QuadraticCost(torch.eye(2), [[0.5]], torch.eye(2))
    x0 = torch.randn(3, 2)
    assert_close(oracle_of(problem_of(system, cost, 20))(x0), oracle_of(problem_of(system, same, 20))(x0))


def slopes(oracle, x0, u, h=1e-4, directions=3):
    """First and second differences of J along random directions of control sequences, in one rollout."""
    d = torch.randn(directions, *u.shape)
    points = torch.cat([u + h * d, u - h * d, u[None]])
    _, J = oracle.rollout(x0.repeat(len(points), 1), points.movedim(0, 1).flatten(1, 2))
    up, down, middle = J.reshape(len(points), -1).split([directions, directions, 1])
    return (up - down) / (2 * h), (up - 2 * middle + down) / h**2


@pytest.mark.gate
@pytest.mark.parametrize(("name", "least", "most"), sample([("reacher", 1, 60), ("cartpole_swingup", 170, 200)], 2))
def test_optimum_is_a_minimum_of_the_rollouts_cost(name, least, most):
    oracle, X0 = transcription_of(name)
    x0 = X0.sample(2, torch.Generator().manual_seed(3))
    optima = oracle.solve(x0)
    assert optima.failures == 0

    assert_close(oracle.rollout(x0, optima.u)[1], optima.cost, rtol=1e-12, atol=0)
    assert ((least < optima.cost) & (optima.cost < most)).all()
    assert (oracle.rollout(x0, torch.zeros_like(optima.u))[1] > 1.2 * optima.cost).all()
    first, second = slopes(oracle, x0, optima.u)
    assert (first.abs() < 1e-5 * optima.cost).all()
    assert (second > 0).all()
    # twin: elsewhere the slope is not zero
    assert (slopes(oracle, x0, 1.1 * optima.u)[0].abs() > 1e-4 * optima.cost).all()


@pytest.mark.gate
def test_no_controller_costs_less():
    oracle, X0 = transcription_of("reacher")
    x0 = X0.sample(6)
    optima = oracle.solve(x0)
    for stiffness, damping in ((0.2, 0.3), (0.6, 0.4), (2.0, 1.0)):
        x, u = x0, []
        for _ in range(oracle.problem.horizon.steps):  # a spring and a damper at each joint
            u.append(-stiffness * x[:, :2] - damping * x[:, 2:])
            x = oracle.problem.step(x, u[-1])[0]
        assert (oracle.rollout(x0, torch.stack(u))[1] > optima.cost).all()


@pytest.mark.gate
def test_neighbours_and_batch_do_not_matter():
    oracle, X0 = transcription_of("cartpole_swingup")
    x0 = X0.sample(3)
    together = oracle.solve(x0).cost
    assert together.max() < 200
    for entry in oracle.cache.folder.iterdir():
        entry.unlink()
    alone = torch.cat([oracle.solve(x[None]).cost for x in x0])
    assert_close(together, alone, rtol=1e-8, atol=0)


# Failure


def test_what_does_not_converge_is_nan_and_says_why():
    oracle, X0 = transcription_of("cartpole_swingup", iterations=2)
    optima = oracle.solve(X0.sample(3))
    assert optima.failures == 3
    assert torch.isnan(optima.cost).all()
    assert set(optima.reasons) == {"IPOPT: Maximum_Iterations_Exceeded"}
    assert not oracle.cache.folder.exists()


@pytest.mark.gate
def test_further_starts_end_where_they_take_much_longer_than_the_first_minimum(monkeypatch):
    oracle, X0 = transcription_of("cartpole_swingup")
    x0, rest = X0.sample(1)[0].numpy(), torch.zeros(oracle.problem.horizon.steps, 1).numpy()
    still = Candidate(rest.repeat(len(x0), 1), rest, math.inf)
    first = oracle.minimise(x0, still)
    count = oracle._limit.done
    assert 3 < count < 150
    assert transcription_of("cartpole_swingup", iterations=count)[0].minimise(x0, still).cost == first.cost
    short = transcription_of("cartpole_swingup", iterations=count - 1)[0].minimise(x0, still)
    assert short == "IPOPT: Maximum_Iterations_Exceeded"
    unknown = transcription_of("cartpole_swingup")[0]
    monkeypatch.setattr(transcription, "BRIEF_ITERATIONS", (2, 150))
    assert unknown.minimise(x0, still, briefly=True).cost == first.cost, "nothing is known of how long one takes"
    monkeypatch.undo()
    assert oracle.minimise(x0, still, briefly=True).cost == first.cost
    monkeypatch.setattr(transcription, "BRIEF_ITERATIONS", (2, 150))
    assert oracle.minimise(x0, still, briefly=True).cost == first.cost, "as long as the first one took, and longer"
    monkeypatch.setattr(transcription, "BRIEF_FACTOR", 0)
    assert oracle.minimise(x0, still, briefly=True) == "IPOPT: Maximum_Iterations_Exceeded"
    assert oracle.minimise(x0, still).cost == first.cost, "where none is known, there is more time"


def test_a_minimum_that_the_rollout_does_not_confirm_is_none():
    oracle, X0 = transcription_of("reacher", "horizon.steps=10")
    minimise, x0 = oracle.minimise, X0.sample(2)
    oracle.minimise = lambda *a: minimise(*a)._replace(cost=1.0)
    optima = oracle.solve(x0)
    assert optima.failures == 2
    assert "cost 1 is " in optima.reasons[0]


def test_known_controls_that_cost_less_than_every_minimum_refute_it():
    oracle, X0 = transcription_of("reacher", "horizon.steps=10")
    x0 = X0.sample(2)
    best = oracle.solve(x0)
    for entry in oracle.cache.folder.iterdir():
        entry.unlink()
    zero = torch.zeros_like(best.u)
    path, J = oracle.rollout(x0, zero)
    worse = {tuple(x.tolist()): Candidate(path[1:, i].numpy(), zero[:, i].numpy(), float(J[i]))
             for i, x in enumerate(x0)}  # fmt: skip
    oracle.minimise = lambda x, start, briefly: worse[tuple(x.tolist())]
    assert oracle.solve(x0, known=best.u).failures == 2
    assert "known controls cost less" in oracle.solve(x0, known=best.u).reasons[0]


def test_minima_spread_to_the_states_around():
    """Two basins, costs 1 and 2; only the first state has a start in the better one."""

    def minimise(x0, start, briefly):
        basin = float(start.u[0, 0])
        return Candidate(start.x, start.u, 1 + basin)

    def start(basin):
        return Candidate(np.zeros((1, 1)), np.full((1, 1), basin), math.inf)

    search = MultiStart(np.arange(20.0)[:, None], [None] * 20, minimise)
    search.run({i: [start(float(i > 0))] for i in range(20)}, lambda done, total: None)
    assert [candidate.cost for candidate in search.best] == [1.0] * 20


@pytest.mark.parametrize("basins", [1, 2])
def test_where_the_first_states_have_one_minimum_the_others_follow_their_neighbours(basins):
    """From 20 on starts lead to the better of two basins; of one basin, 40 states have one start each."""
    tried = Counter()

    def minimise(x0, start, briefly):
        tried[int(x0[0])] += 1
        return Candidate(start.x, start.u, 1 + float(start.u[0, 0]))

    def start(basin):
        return Candidate(np.zeros((1, 1)), np.full((1, 1), float(basin)), math.inf)

    search = MultiStart(np.arange(40.0)[:, None], [None] * 40, minimise)
    better = {7: 0.0} if basins == 2 else {}  # among the first states, one start of one state
    search.run({i: [start(1), start(better.get(i, 1))] for i in range(40)}, lambda done, total: None)
    assert {candidate.cost for candidate in search.best} == {1.0 if basins == 2 else 2.0}
    assert all(count == 1 for i, count in tried.items() if i >= EXPLORED) is (basins == 1)
    assert all(tried[i] > 1 for i in range(EXPLORED))


@pytest.mark.gate
def test_a_batch_after_one_that_showed_one_minimum_has_fewer_starts(monkeypatch):
    monkeypatch.setattr(transcription, "_SINGLE_MINIMUM_TASKS", set())
    oracle, box = transcription_of("pendulum_swingup", "horizon.steps=20", "horizon.dt=0.05")
    counts, minimise, tried = Counter(), Transcription.minimise, 0

    def counted(self, *arguments):
        counts[tried] += 1
        return minimise(self, *arguments)

    monkeypatch.setattr(Transcription, "minimise", counted)
    batches = [box.sample(20, torch.Generator().manual_seed(seed)) for seed in (0, 1)]
    for x0 in batches:
        optima = oracle.solve(x0)
        tried += 1
    assert counts[1] <= counts[0] - (EXPLORED - EXPLORED_AGAIN)
    monkeypatch.setattr(transcription, "_SINGLE_MINIMUM_TASKS", set())
    monkeypatch.setenv("LYAPNET_CACHE", f"{oracle.cache.folder}_empty")
    again, _ = transcription_of("pendulum_swingup", "horizon.steps=20", "horizon.dt=0.05")
    assert_close(again.solve(batches[1]).cost, optima.cost, rtol=1e-7, atol=0)
    assert counts[2] == pytest.approx(counts[0], abs=2 * EXPLORED), "the twin: explored anew"
    assert counts[2] > counts[1]
    narrower = oracle.problem.replaced(initial_states=Box(0.5 * box.lower, 0.5 * box.upper))
    tried += 1
    Transcription(narrower).solve(0.5 * batches[0])
    assert counts[3] > counts[1], "of another X₀"


@pytest.mark.parametrize("explored", [EXPLORED, EXPLORED_AGAIN, 1])
def test_a_batch_tries_as_many_random_curves_however_few_states_are_explored(explored):
    oracle, box = transcription_of("pendulum_swingup", "horizon.steps=20", "horizon.dt=0.05")
    x0, nothing = box.sample(20, torch.Generator().manual_seed(0)), [None] * 20
    search = MultiStart(x0.numpy(), nothing, oracle.minimise, explored)
    guesses = [len([*each]) for each in oracle._starts(x0, range(20), nothing, search)]
    without_curves = guesses[-1]
    curves = [count - without_curves for count in guesses]
    assert sum(curves) == transcription.RANDOM_CURVE_STATES * transcription.CURVES_PER_STATE
    assert not any(curves[explored:])


def test_states_close_to_each_other_say_nothing_of_others(monkeypatch):
    monkeypatch.setattr(transcription, "_SINGLE_MINIMUM_TASKS", set())
    oracle, box = transcription_of("double_integrator", "horizon.steps=10", "horizon.dt=0.1")
    x0 = box.sample(EXPLORED, torch.Generator().manual_seed(0))
    oracle.solve(0.1 * x0)
    assert not transcription._SINGLE_MINIMUM_TASKS
    oracle.solve(x0)
    assert len(transcription._SINGLE_MINIMUM_TASKS) == 1


def test_known_controls_that_cost_less_are_tried_from_any_state():
    def minimise(x0, start, briefly):
        return Candidate(start.x, start.u, 1 + float(start.u[0, 0]))

    cold, known = (Candidate(np.zeros((1, 1)), np.full((1, 1), u), cost) for u, cost in ((1.0, math.inf), (0.0, 1.1)))
    search = MultiStart(np.arange(40.0)[:, None], [None] * 40, minimise)
    search.run({i: [known, cold] if i == 30 else [cold] for i in range(40)}, lambda done, total: None)
    assert {candidate.cost for candidate in search.best} == {1.0}, "and then reach all others"


@pytest.mark.parametrize("solvable", [None, 3])
def test_the_first_failures_in_a_row_spare_the_others(solvable):
    tried = []

    def minimise(x0, start, briefly):
        tried.append(int(x0[0]))
        return Candidate(start.x, start.u, 1.0) if x0[0] == solvable else "none"

    search = MultiStart(np.arange(20.0)[:, None], [None] * 20, minimise)
    start = Candidate(np.zeros((1, 1)), np.zeros((1, 1)), math.inf)
    search.run({i: [start] for i in range(20)}, lambda done, total: None)
    if solvable is None:
        assert tried == list(range(8))
        assert search.reasons[7] == "none"
        assert "none, from 8 states in a row" in search.reasons[19]
    else:
        assert set(tried) == set(range(20)), "one that is found, and all are tried"


def test_a_search_tries_no_state_after_its_seconds(monkeypatch):
    """Each minimum takes a second of this clock, and there are three and a half."""
    clock = [100.0]
    monkeypatch.setattr("lyapnet.evaluation.oracles.multistart.time.thread_time", lambda: clock[0])

    def minimise(x0, start, briefly):
        clock[0] += 1
        return Candidate(start.x, start.u, 1.0)

    search = MultiStart(np.arange(20.0)[:, None], [None] * 20, minimise)
    start = Candidate(np.zeros((1, 1)), np.zeros((1, 1)), math.inf)
    search.run({i: [start] for i in range(20)}, lambda done, total: None, until=103.5)
    found = [best is not None for best in search.best]
    assert found == [True] * sum(found) + [False] * (20 - sum(found))
    assert 0 < sum(found) <= 4
    assert search.reasons[19] == "no time was left for it"


def test_an_oracle_without_seconds_has_no_optima():
    oracle, X0 = transcription_of("reacher", "horizon.steps=10")
    assert oracle.solve(X0.sample(3), seconds=0.0).failures == 3


# The cache


@pytest.fixture
def solved():
    """An oracle, some states, and their optima, which are on disk."""
    oracle, X0 = transcription_of("reacher", "horizon.steps=10")
    x0 = X0.sample(3)
    return oracle, x0, oracle.solve(x0)


def unsolvable(oracle):
    """The oracle without IPOPT."""
    oracle.minimise = lambda *_: "no solver"
    return oracle


@pytest.mark.gate
def test_what_is_on_disk_is_not_solved_again(solved):
    _, x0, optima = solved
    again = unsolvable(transcription_of("reacher", "horizon.steps=10")[0])
    assert torch.equal(again.solve(x0).cost, optima.cost)
    assert torch.equal(again.solve(x0.flip(0)).cost, optima.cost.flip(0))
    # twins: another state, another task
    assert again.solve(x0 + 1e-9).failures == 3
    for change in ("horizon.steps=11", "horizon.dt=0.011", "system.parameters.a2=0.0481", "cost.Q_T=[100,100,1,2]"):
        other = unsolvable(transcription_of("reacher", "horizon.steps=10", change)[0])
        assert other.solve(x0).failures == 3


def test_kept_controls_of_another_shape_or_type_are_none():
    cache, x0 = OptimaCache([], 3, 2, Unbounded()), torch.zeros(4, dtype=torch.float64)
    u = torch.arange(6, dtype=torch.float64).reshape(3, 2)
    assert cache.read(x0) is None
    for other in (u.float(), u[:2], u.mT, u / 0):
        cache.write(x0, other)
        assert cache.read(x0) is None
    cache.write(x0, u)
    assert torch.equal(cache.read(x0), u)


@pytest.mark.parametrize("damage", [lambda c: c[: len(c) // 2], lambda c: b"", lambda c: c[:150] + b"?" + c[151:]])
def test_damaged_files_are_solved_again(solved, damage):
    oracle, x0, optima = solved
    for path in oracle.cache.folder.iterdir():
        path.write_bytes(damage(path.read_bytes()))
    assert [oracle.cache.read(x) for x in x0] == [None] * 3
    assert_close(oracle.solve(x0).cost, optima.cost)
    assert torch.equal(unsolvable(oracle).solve(x0).cost, optima.cost)


def test_a_flipped_bit_is_no_controls_or_the_same(solved):
    oracle, x0, _ = solved
    path, kept = oracle.cache._file(x0[0]), oracle.cache.read(x0[0])
    content, draws = path.read_bytes(), random.Random(0)
    for _ in range(2000):
        flipped = bytearray(content)
        flipped[draws.randrange(len(content))] ^= 1 << draws.randrange(8)
        path.write_bytes(flipped)
        found = oracle.cache.read(x0[0])
        assert found is None or torch.equal(found, kept)
    path.write_bytes(content)


def test_a_write_that_fails_leaves_no_draft(solved, monkeypatch):
    oracle, x0, _ = solved
    files = {*oracle.cache.folder.iterdir()}

    def refuse(*_):
        raise PermissionError

    monkeypatch.setattr(Path, "replace", refuse)
    oracle.cache.write(x0[0], oracle.cache.read(x0[0]))
    assert {*oracle.cache.folder.iterdir()} == files


def test_a_folder_that_cannot_be_written_keeps_nothing(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("LYAPNET_CACHE", str(tmp_path / "file"))
    oracle, X0 = transcription_of("reacher", "horizon.steps=3")
    assert oracle.solve(X0.sample(2)).failures == 0


def test_better_known_controls_replace_what_is_kept(solved):
    oracle, x0, optima = solved
    for x in x0:
        oracle.cache.write(x, torch.zeros_like(optima.u[:, 0]))
    assert (oracle.solve(x0).cost > 1.01 * optima.cost).all()
    assert_close(oracle.solve(x0, known=optima.u).cost, optima.cost)
    assert_close(oracle.solve(x0).cost, optima.cost)


# Precision, and systems past torch


def test_a_float32_task_is_solved_in_float64_and_left_as_it_is():
    """R as a method of the system that is copied: a copy in float64 does not keep the original's precision."""
    system = Reacher().float()
    cost = QuadraticCost(torch.eye(4), system.inverse_mass, torch.eye(4)).float()
    x0 = torch.tensor([[0.5, -0.5, 0.0, 0.0]])
    exact = Reacher()
    reference = QuadraticCost(torch.eye(4), exact.inverse_mass, torch.eye(4))
    ours = Transcription(problem_of(system, cost, 10, 0.05))(x0)
    assert_close(ours, Transcription(problem_of(exact, reference, 10, 0.05))(x0), rtol=1e-5, atol=0)
    assert system.B.dtype == torch.float32


class Drag(Cartpole):
    """A cartpole with a force that is computed past torch."""

    def forces(self, q, qdot):
        return super().forces(q, qdot) - torch.as_tensor(np.sin(qdot.detach().numpy()))


class Branch(Cartpole):
    """A cartpole whose code asks for its state."""

    def forces(self, q, qdot):
        return super().forces(q, qdot) * (2 if q[..., 0].sum() > 0 else 1)


@pytest.mark.parametrize("system", [Drag(), Branch()])
def test_a_system_past_torch_is_refused(system):
    weight = torch.eye(4)
    with pytest.raises(OracleError, match=r"reads the values of a tensor at test_transcription\.py:\d+ \(return super"):
        oracle_of(problem_of(system, QuadraticCost(weight, [[1.0]], weight), 5))


# Where a rollout of controls cannot follow the optimum


def pole_of_ten_seconds(growth=4.0):
    """ẍ = growth² x + u, whose rounding errors grow by e^(10 · growth) in a rollout."""
    system = Linear([[0.0, 1.0], [growth**2, 0.0]], [[0.0], [1.0]])
    return problem_of(system, QuadraticCost(torch.eye(2), torch.eye(1), torch.eye(2)), 200, 0.05)


def test_an_optimum_that_no_controls_lead_along_is_confirmed_step_by_step():
    problem, x0 = pole_of_ten_seconds(), torch.randn(4, 2)
    optima = Transcription(problem).solve(x0)
    assert optima.failures == 0
    assert_close(
        optima.cost, discrete_riccati(problem.system, problem.cost, problem.horizon).value(0, x0), rtol=1e-6, atol=0
    )
    assert optima.u.isnan().all(), "no controls are offered as the way to it"
    calm = pole_of_ten_seconds(growth=0.1)
    assert Transcription(calm).solve(x0).u.isfinite().all()


def found_from(problem, x0):
    """The oracle, and the minimum that IPOPT finds from a straight line."""
    oracle, x0 = Transcription(problem), np.asarray(x0, dtype=float)
    N, n, m = problem.horizon.steps, problem.system.n, problem.system.m
    return oracle, oracle.minimise(x0, Candidate(np.linspace(x0, np.zeros(n), N + 1)[1:], np.zeros((N, m)), math.inf))


def test_a_path_that_is_none_is_not_confirmed():
    x0 = torch.tensor([1.0, -0.5])
    oracle, found = found_from(pole_of_ten_seconds(), x0)
    assert oracle._cost_along(x0, found) == pytest.approx(found.cost, rel=1e-6)
    gap = found.x.copy()
    gap[9] += 1e-2
    for other in (found._replace(x=gap), found._replace(cost=1.0001 * found.cost)):
        assert oracle._cost_along(x0, other) is None


class Logistic(ControlAffineSystem):
    """ẏ = 4y(1 − y) − yu: y leaves 0 however little it is there."""

    state_names, control_names = ("y",), ("u",)

    def f(self, x):
        return 4 * x * (1 - x)

    def g(self, x):
        return -x[..., None]


class Unreachable(ControlAffineSystem):
    """An unstable pole, and ż = 4z, which no control reaches."""

    state_names, control_names = ("x", "v", "z"), ("u",)

    def f(self, x):
        return torch.stack([x[..., 1], 16 * x[..., 0], 4 * x[..., 2]], -1)

    def g(self, x):
        return x.new_tensor([[0.0], [1.0], [0.0]]).expand(*x.shape[:-1], 3, 1)


@pytest.mark.parametrize(("system", "x0"), [(Logistic(), [1e-13]), (Unreachable(), [0.5, 0.0, 1e-9])], ids=["y", "z"])
def test_what_grows_from_less_than_ipopts_tolerance_counts(system, x0):
    """IPOPT's path may close such a gap for nothing, where a closed loop costs far more."""
    n = system.n
    cost = QuadraticCost(torch.eye(n), torch.eye(1), torch.eye(n))
    problem = problem_of(system, cost, 200, 0.05, Box([-1.0] * n, [1.0] * n))
    oracle, found = found_from(problem, x0)
    along = None if isinstance(found, str) else oracle._cost_along(torch.tensor(x0), found)
    optima = oracle.solve(torch.tensor([x0]))
    least = 0.5 if n == 1 else 1e4  # of any closed loop, by far
    assert along is None or along > least
    assert optima.failures == 1 or float(optima.cost) > least


@pytest.mark.parametrize("size", [1.0, 1e-9])
def test_rounding_is_relative_to_the_costs_of_the_task(size, monkeypatch):
    cost = QuadraticCost(size * torch.eye(2), size * torch.eye(1), size * torch.eye(2))
    oracle, found = found_from(problem_of(DoubleIntegrator(), cost), [1.0, -0.5])
    x0 = torch.tensor([[1.0, -0.5]])
    monkeypatch.setattr(oracle, "_cost_along", lambda *_: None)
    for factor, confirmed in ((1.0, True), (1.0001, False)):
        search = MultiStart(x0.numpy(), [found._replace(cost=factor * found.cost)], oracle.minimise)
        assert bool(oracle._verify(x0, search, [None])[0].isfinite()) is confirmed


def test_a_cheaper_rollout_is_no_confirmation_of_a_dearer_path(monkeypatch):
    oracle, found = found_from(pole_of_ten_seconds(growth=0.1), [1.0, -0.5])
    x0 = torch.tensor([[1.0, -0.5]])
    monkeypatch.setattr(oracle, "_cost_along", lambda *_: 2 * found.cost)
    search = MultiStart(x0.numpy(), [found._replace(cost=2 * found.cost)], oracle.minimise)
    cost, reasons, _ = oracle._verify(x0, search, [None])
    assert math.isnan(float(cost))
    assert "in a rollout of its controls" in reasons[0]


def test_without_controls_a_smoothed_optimum_is_unknown():
    problem = pole_of_ten_seconds()

    class Smoothed(Oracle):
        def solve(self, x0, known, progress, seconds):
            u = torch.zeros(200, 2, 1)
            u[:, 1] = torch.nan
            return Optima(torch.ones(2), ["", ""], u)

    optima = OracleOfSmoothed(Smoothed(), problem, "euler").solve(torch.zeros(2, 2))
    assert optima.failures == 1
    assert optima.reasons[0] == ""
    assert "no controls lead along" in optima.reasons[1]
