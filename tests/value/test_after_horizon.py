"""After T: what was asked for, and never in silence."""

import logging
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.linalg import solve_discrete_are
from torch.testing import assert_close

import lyapnet
from lyapnet import Controller
from lyapnet.base.errors import UsageError
from lyapnet.base.interpolation import Table
from lyapnet.evaluation.after_horizon import loops_after_horizon, share_at_goal, to_plain_data
from lyapnet.evaluation.after_horizon_figure import distances
from lyapnet.evaluation.oracles import discrete_riccati
from lyapnet.experiment.assembly import Parts, build_problem, member
from lyapnet.experiment.checkpoint import KEY, read_checkpoint, write_checkpoint
from lyapnet.experiment.config import load_config
from lyapnet.loop.rollout import Rollout
from lyapnet.task.constraints import Constraints
from lyapnet.task.cost import QuadraticCost, TargetCost
from lyapnet.task.cost.base import quadratic_form
from lyapnet.task.sets import Box, ControlBox
from lyapnet.task.systems import DoubleIntegrator, Linear, Pendulum
from lyapnet.value.after_horizon import AfterHorizon, is_held
from lyapnet.value.law_after_horizon import BEYOND
from lyapnet.value.policy import POLICIES, HJBPolicy
from lyapnet.value.regulator import Regulator
from tests.marks import sample
from tests.problems import CONF, Formula, Quadratic, problem_of

T = 1.0
X = torch.tensor([[0.5, -0.3], [1.0, 0.2]], dtype=torch.float64)


@pytest.fixture
def logged(caplog):
    return lambda: [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]


def controller(beyond, law="hjb", **parts):
    """Of V = (2 − t) xᵀx on the double integrator, T = 1 s in 10 steps."""
    problem = problem_of(DoubleIntegrator(), **parts)
    V = Formula(lambda t, x: (2 - t) * (x**2).sum(-1))
    rollout = Rollout(problem, POLICIES[law](problem, V), gradient="backprop")
    return Controller(problem, V, rollout, beyond=beyond)


@pytest.mark.parametrize("beyond", [None, *BEYOND])
def test_before_the_end_nothing_changes(beyond, logged):
    plain = controller(None)
    expected = HJBPolicy(plain.problem, plain.V)
    own = controller(beyond)
    for t in (0.0, 0.3, 0.95):
        assert_close(own.policy(t, X), expected(torch.tensor(t), X))
        assert_close(own.value(t, X), plain.V(torch.tensor(t), X))
    assert_close(own.value(T, X), plain.V(torch.tensor(T), X))
    assert_close(own.rollout(X).x, Rollout(plain.problem, expected, gradient="backprop")(X).x)
    assert not logged()


def test_unless_told_it_is_what_holds_the_goal_and_says_so_once(logged):
    """Before the note V and u at T are those of the choice too, so that nothing depends on what was asked first."""
    own, chosen = controller(None), controller("riccati")
    assert_close(own.policy(T, X), chosen.policy(T, X))
    assert not logged()
    for t in (7.0, 8.0, T):
        assert_close(own.policy(t, X), chosen.policy(t, X))
    (note,) = logged()
    assert note.startswith("note: the control law is for 1 s; after T follows riccati (the linear-quadratic regulator")
    assert (
        "under which 64 of 64 closed loops are no farther from the goal at 5 T than at T; to choose another, " in note
    )
    assert_close(own.value(7.0, X), chosen.value(7.0, X))
    assert_close(own.rollout(X, steps=20).x, chosen.rollout(X, steps=20).x)


@pytest.mark.parametrize("law", ["hjb", "sampled"])
def test_a_horizon_that_recedes_begins_at_every_step(law, logged):
    own = controller("receding", law)
    for t in (T, 1.05, 40.0):
        assert_close(own.policy(t, X), own.policy(0.0, X))
    assert_close(own.value(40.0, X), own.value(0.0, X))
    assert not torch.allclose(own.policy(0.95, X), own.policy(0.0, X), rtol=1e-2)
    mixed = own.policy(torch.tensor([0.5, 3.0]), X)
    assert_close(mixed, torch.stack([own.policy(0.5, X[0]), own.policy(0.0, X[1])]))
    assert not logged()


def test_after_the_end_the_regulator_alone_is_asked():
    asked, problem = [], problem_of(DoubleIntegrator())

    def value(t, x):
        asked.append(float(t.detach().max()))
        return (2 - t) * (x**2).sum(-1)

    V = Formula(value)
    own = Controller(problem, V, Rollout(problem, HJBPolicy(problem, V), gradient="backprop"), beyond="riccati")
    own.rollout(X, steps=3 * problem.horizon.steps)
    assert asked
    assert max(asked) <= T
    asked.clear()
    times = torch.tensor([0.5, 2.0])
    assert_close(own.law(times, X)[1], own.law(times[1], X[1]))
    assert_close(own.law(times, X)[0], own.law(times[0], X[0]))
    assert asked, "one of the times is before T"


def test_an_error_where_one_is_asked_for():
    own = controller("error")
    own.policy(T, X)
    for ask in (own.policy, own.value):
        with pytest.raises(
            ValueError, match=r"Expected t within the horizon of 1 s, got 1\.1; .*hold, receding or riccati"
        ):
            ask(1.1, X)
    with pytest.raises(ValueError, match="within the horizon"):
        own.rollout(X, steps=11)


@pytest.mark.parametrize("beyond", [None, "receding"])
def test_no_time_is_before_the_horizon(beyond):
    with pytest.raises(ValueError, match=r"Expected t ≥ 0, got -0\.1"):
        controller(beyond).policy(-0.1, X)


@pytest.mark.gate
def test_the_regulator_is_that_of_a_long_horizon():
    """Held against Riccati's recursion over 4000 steps, and against scipy's solution written out."""
    system = DoubleIntegrator()
    cost = QuadraticCost(torch.diag(torch.tensor([2.0, 0.5])), [[0.4]], torch.eye(2))
    problem = problem_of(system, cost, 4000, 0.1)
    own = Controller(problem, Quadratic(torch.eye(2)), beyond="riccati")
    long = discrete_riccati(system, cost, problem.horizon)
    assert_close(own.value(1e6, X), long.value(0, X), rtol=1e-6, atol=0)
    A, B = np.array([[1, 0.1], [0, 1]]), np.array([[0], [0.1]])
    P = solve_discrete_are(A, B, np.diag([0.2, 0.05]), [[0.04]])
    K = np.linalg.solve(0.04 + B.T @ P @ B, B.T @ P @ A)
    assert_close(own.policy(1e6, X), -X @ torch.from_numpy(K).mT, rtol=1e-9, atol=0)
    settled = own.rollout(X, steps=8000).x
    assert float(settled[-1].abs().max()) < 1e-6


def test_about_a_target_within_limits():
    """A pendulum that leans stays there for as long as one likes; with the law of T = 0.5 s alone it does not."""
    system, target = Pendulum(), torch.tensor([0.6, 0.0])
    u, _ = system.holding_control(target)
    cost = TargetCost(QuadraticCost(torch.eye(2), [[1.0]], torch.eye(2)), target, u)
    problem = problem_of(system, cost, 10, 0.05, controls=ControlBox(-9.0, 2.0))
    V = Formula(lambda t, x: ((x - target) ** 2).sum(-1) + 0 * t)

    def ends(beyond):
        loop = Controller(problem, V, beyond=beyond).rollout(target + torch.tensor([[0.01, 0.0]]), steps=100)
        assert problem.controls.contains(loop.u).all()
        return float((loop.x[-1] - target).abs().max())

    assert ends("riccati") < 1e-4
    assert ends("hold") > 0.1


def test_a_longer_rollout_is_that_of_its_laws():
    """The states of the horizon, then those of the continued law, step by step; its cost is what they pay."""
    own = controller("receding")
    whole, first = own.rollout(X, steps=25), own.rollout(X)
    assert_close(whole.x[:11], first.x)
    x, paid = first.x[-1], first.running_cost[-1]
    for n in range(10, 25):
        u = own.policy(0.1 * n, x)
        x, paid = x + 0.1 * own.system.dynamics(x, u), paid + 0.1 * own.cost.running(x, u)
    assert_close(whole.x[-1], x)
    assert_close(whole.cost, paid + own.cost.terminal(x))
    assert len(own.rollout(X, steps=4).u) == 4
    assert isinstance(own.rollout(X.numpy(), steps=12).x, np.ndarray)


@pytest.mark.parametrize(
    ("system", "cost", "reason"),
    [
        (Linear([[1.0]], [[0.0]]), None, "that a linear law stabilises"),
        (
            Pendulum(),
            TargetCost(QuadraticCost(torch.eye(2), [[1.0]], torch.eye(2)), [0.6, 0.0], [0.0]),
            "an equilibrium",
        ),
    ],
)
def test_where_there_is_no_regulator_it_says_so(system, cost, reason):
    with pytest.raises(ValueError, match=f"Expected a goal .*{reason}.* for beyond=riccati"):
        Controller(problem_of(system, cost), Quadratic(torch.eye(system.n)), beyond="riccati")


def test_what_q_does_not_see_is_weighed_as_at_the_end():
    """The law is that of a q which is an Nth of φ, and brings the state to rest."""
    system = DoubleIntegrator()
    end, R = torch.diag(torch.tensor([3.0, 1.0])), [[1.0]]
    problem = problem_of(system, QuadraticCost(torch.zeros(2, 2), R, end))
    seen = problem_of(system, QuadraticCost(end / (10 * 0.1), R, end))  # N = 10 steps of 0.1 s
    assert_close(Regulator(problem, spread=True).K, Regulator(seen).K, rtol=1e-9, atol=0)
    loop = Controller(problem, Quadratic(torch.eye(2)), beyond="riccati").rollout(0.1 * X, steps=200)
    assert float(loop.x[-1].abs().max()) < 1e-4


@pytest.mark.parametrize(("weight", "spread"), [(0.0, True), (1.0, False)])
def test_a_mode_that_the_cost_does_not_see_is_no_regulator(weight, spread):
    """scipy has a solution all the same: no gain, and a cart that drifts for ever."""
    unseen = QuadraticCost(torch.zeros(2, 2), [[1.0]], weight * torch.eye(2))
    with pytest.raises(ValueError, match=r"every mode.*give Q more weights"):
        Regulator(problem_of(DoubleIntegrator(), unseen), spread=spread)


@pytest.mark.parametrize("steps", [0, -1])
def test_steps_that_are_no_number_are_refused(steps):
    with pytest.raises(ValueError, match="Expected steps as a whole number"):
        controller("hold").rollout(X, steps=steps)


@pytest.mark.parametrize("method", ["rk4", "dopri5"])
def test_a_longer_rollout_begins_as_the_horizon_has_it(method):
    """Also where the integrator looks ahead of a node."""
    problem = problem_of(DoubleIntegrator())
    V = Formula(lambda t, x: (5 - 4 * t) * (x**2).sum(-1))
    own = Controller(problem, V, Rollout(problem, HJBPolicy(problem, V), method, "backprop"), beyond="receding")
    whole = own.rollout(X)
    for steps in (3, 10, 14):
        other = own.rollout(X, steps=steps)
        shared = min(steps, 10)
        for field in ("t", "x", "running_cost", "value"):
            assert_close(getattr(other, field)[: shared + 1], getattr(whole, field)[: shared + 1], rtol=0, atol=1e-12)
        assert [len(field) for field in other[:4]] == [steps + 1, steps + 1, steps, steps + 1]
        assert_close(other.terminal_cost, own.cost.terminal(other.x[-1]))


def leaning(*, equilibrium=True, V=None, upper=2.0):
    """A pendulum that is to stay at 0.6 rad, from nearby."""
    system, target = Pendulum().double(), torch.tensor([0.6, 0.0], dtype=torch.float64)
    holding, _ = system.holding_control(target)
    about_zero = QuadraticCost(torch.eye(2), [[1.0]], torch.eye(2))
    costs = [TargetCost(about_zero, target, u) for u in (holding, [0.0])]
    held, other = (problem_of(system, cost, 10, 0.05, controls=ControlBox(-9.0, upper)) for cost in costs)
    P, lift = Regulator(held).P, 2 * float(holding) / float(system.g(target)[1, 0])
    if not equilibrium:  # u* = 0, and V asks for what holds
        V = V or Formula(lambda t, x: quadratic_form(P, x - target) - lift * x[..., 1] + 0 * t)
    problem = (held if equilibrium else other).replaced(initial_states=Box(target - 0.02, target + 0.02))
    return Controller(problem, V or Formula(lambda t, x: quadratic_form(P, x - target) + 0 * t), policy=HJBPolicy)


def weak(t, x):
    """A V whose law is zero: under it the pendulum falls."""
    return 1.0 + 0 * x.sum(-1) + 0 * t


def test_the_regulator_is_the_first_choice():
    assert leaning().after_horizon() == AfterHorizon("riccati", 64, 64)


def test_the_receding_law_where_there_is_no_regulator():
    """The law of V stays near the goal, which is no equilibrium of the control that costs nothing."""
    found = leaning(equilibrium=False).after_horizon()
    assert (found.beyond, found.held, found.reason) == ("receding", 64, "")


def test_the_law_at_the_end_where_no_other_holds():
    """V(0, ·) does nothing, and V(T, ·) holds."""
    strong = leaning(equilibrium=False).V
    V = Formula(lambda t, x: torch.where(t < 0.4, 0.0, 1.0) * strong(t, x))
    assert leaning(equilibrium=False, V=V).after_horizon().beyond == "hold"


def test_no_choice_where_nothing_holds_says_why(logged):
    own = leaning(equilibrium=False, V=Formula(weak))
    found = own.after_horizon()
    assert not found.holds
    assert found.held < 64
    for word in ("riccati: Expected a goal that is an equilibrium", "receding: ", "hold: "):
        assert word in found.reason
    own.policy(9.0, X)
    (note,) = logged()
    assert "no law was found under which all closed loops are no farther from the goal at 5 T than at T (ricc" in note


def test_a_plant_without_derivatives_is_no_failure():
    """The closed loop of a V whose gradient is known asks none of f and g."""

    class Plain(DoubleIntegrator):
        def dynamics(self, x, u):
            return super().dynamics(torch.from_numpy(x.numpy()), u)

    found = Controller(problem_of(Plain()), Quadratic(torch.eye(2))).after_horizon()
    assert found.beyond in ("receding", "hold")
    assert "riccati: " in found.reason


def test_a_plant_that_refuses_states_is_no_failure():
    """As a table does that ends: a law that asks for states outside holds nothing, and nothing else is lost."""

    class Ending(DoubleIntegrator):
        def f(self, x):
            if bool((x[..., 0].abs() > 1).any()):
                raise ValueError("outside of the table")
            return super().f(x)

        def dynamics(self, x, u):
            return self.f(x) + super().g(x)[..., 0] * u

    own = Controller(problem_of(Ending()), Formula(weak), policy=HJBPolicy)
    found = own.after_horizon()
    assert (found.beyond, found.held, found.loops) == ("hold", 0, 64)
    assert found.reason.count("outside of the table") == 3
    assert share_at_goal(own, X) == 0.0


def test_a_task_without_end_has_one_law():
    """The regulator, which is asked first elsewhere, does not follow it."""
    problem = problem_of(DoubleIntegrator())
    endless = problem.replaced(horizon=replace(problem.horizon, stationary=True))
    V = Quadratic(torch.tensor([[2.0, 1.0], [1.0, 2.0]]))
    own = Controller(endless, V, policy=HJBPolicy)
    assert own.after_horizon() == AfterHorizon("hold", 64, 64)
    assert own.law.beyond == "hold"
    assert Controller(problem, V, policy=HJBPolicy).after_horizon().beyond == "riccati"


def test_limits_that_are_too_narrow_hold_nothing():
    """Gravity is stronger than what the limits leave."""
    pendulum = leaning()
    assert leaning(upper=float(pendulum.problem.rest) + 1e-3).after_horizon().held < 64


def test_constraints_count_after_the_end():
    """A regulator that swings through a wall which the closed loop keeps until T is none."""
    own = leaning()
    inside = Table([[0.5, 0.62]], [-0.1, 0.02])

    class Wall(Constraints):
        names = ("wall",)

        def forward(self, x):
            return inside(x[..., :1])[..., None]

    x = torch.full((51, 2, 2), 0.6, dtype=torch.float64)
    x[20, 1, 0] = 0.63
    assert is_held(own.problem, x).tolist() == [True, True]
    assert is_held(own.problem.replaced(constraints=Wall()), x).tolist() == [True, False]


def test_what_the_cost_does_not_weigh_may_go_anywhere():
    problem = problem_of(
        DoubleIntegrator(), QuadraticCost(torch.diag(torch.tensor([0.0, 1.0])), [[1.0]], [[0.0] * 2] * 2)
    )
    x = torch.zeros(51, 1, 2, dtype=torch.float64)
    x[:, 0, 0] = torch.arange(51)
    assert is_held(problem, x).tolist() == [True]
    assert is_held(problem_of(DoubleIntegrator()), x).tolist() == [False]


def test_a_long_horizon_is_not_tried():
    own = Controller(problem_of(DoubleIntegrator(), None, 5000, 1e-3), Quadratic(torch.eye(2)))
    found = own.after_horizon()
    assert (found.beyond, found.loops, found.holds) == ("hold", 0, False)
    assert "not tried" in found.reason
    assert share_at_goal(own, X) is None


@pytest.mark.gate
def test_the_regulator_of_a_family_is_that_of_each_member():
    """Along pole mass and length of a cart-pole, between the nodes of its polynomials too; outside, that of the end."""
    config = load_config(CONF / "cartpole_family.yaml")
    problem = build_problem(config)
    regulator, system = Regulator(problem, spread=True), problem.system
    generator = torch.Generator().manual_seed(1)
    for z in problem.initial_states.sample(4, generator).double():
        p = z[list(system.constants)]
        own, parts, _ = member(config, Parts(), problem, dict(zip(config.family, p.tolist(), strict=True)))
        expected = Regulator(build_problem(own, parts), spread=True)
        offset = 0.1 * torch.randn(5, system.system.n, generator=generator, dtype=torch.float64)
        x = expected.problem.goal + offset
        whole = torch.cat([x, p.expand(5, -1)], -1)
        assert_close(regulator(whole.float()), expected(x.float()), rtol=1e-3, atol=1e-4)
        assert_close(regulator.cost(whole.float()), expected.cost(x.float()), rtol=1e-2, atol=1e-5)


def test_what_a_checkpoint_says_is_taken(tmp_path, logged):
    path = checkpoint_that_says(tmp_path, {"beyond": "receding", "held": 64, "loops": 64, "reason": ""})
    own = lyapnet.load(path)
    assert_close(own.policy(1e3, X), own.continued("receding").policy(1e3, X))
    assert not logged()


def test_what_does_not_hold_is_said_at_load(tmp_path, logged):
    lyapnet.load(
        checkpoint_that_says(tmp_path, {"beyond": "hold", "held": 3, "loops": 64, "reason": "riccati: 2 of 64"})
    )
    (note,) = logged()
    assert "no law was found under which all closed loops are no farther from the goal at 5 T" in note
    assert note.endswith("(riccati: 2 of 64); to choose another, load with beyond=hold, receding, riccati or error.")


@pytest.mark.parametrize(
    "said",
    sample([
        None, "riccati", {}, {"beyond": "riccati"}, {"beyond": "error", "held": 1, "loops": 1, "reason": ""},
        {"beyond": ["riccati"], "held": 1, "loops": 1, "reason": ""},
        {"beyond": "riccati", "held": True, "loops": 1, "reason": ""},
        {"beyond": "riccati", "held": 1, "loops": 1, "reason": "", "more": 1},
        {"beyond": "receding", "held": 65, "loops": 64, "reason": ""},
        {"beyond": "receding", "held": 1, "loops": 64, "reason": "\x1b[2J"},
    ], 10),
)  # fmt: skip
def test_what_a_checkpoint_cannot_mean_is_found_anew(said, tmp_path):
    found = lyapnet.load(checkpoint_that_says(tmp_path, said)).after_horizon()
    assert found == AfterHorizon("riccati", 64, 64)


def checkpoint_that_says(folder, said):
    content = read_checkpoint("zoo:double_integrator")
    content[KEY]["after_horizon"] = said
    path = folder / "said.ckpt"
    write_checkpoint(content, path)
    return path


@pytest.mark.parametrize(("steps", "dt"), [(90, 1 / 30), (49, 0.1 / 3)])
def test_the_last_node_is_within_the_horizon_in_single_precision(steps, dt, logged):
    problem = problem_of(DoubleIntegrator(), None, steps, dt).float()
    V = Quadratic(torch.eye(2)).float()
    for beyond in ("error", "hold"):
        own = Controller(problem, V, beyond=beyond)
        own.policy(problem.horizon.times(problem.goal)[-1], X.float())
        own.policy(-1e-9, X.float())
    assert not logged()


def test_another_word_is_refused():
    with pytest.raises(ValueError, match="Expected beyond as one of riccati, receding, hold, error, got 'stop'"):
        controller("stop")


def test_what_each_law_after_the_end_does():
    own = controller(None)
    found = {one.beyond: one for one in loops_after_horizon(own, X, 3)}
    assert list(found) == ["riccati", "receding", "hold"]
    for beyond, one in found.items():
        assert_close(one.distance, controller(beyond).rollout(X, steps=30).x.norm(dim=-1))
    riccati, receding, hold = (row["distances"] for row in to_plain_data(list(found.values()), own, 3))
    assert [at["time"] for at in hold] == pytest.approx([1.0, 1.2, 2.0, 3.0])
    assert hold[0]["mean"] == receding[0]["mean"] == riccati[0]["mean"]
    assert len({at[-1]["mean"] for at in (hold, receding, riccati)}) == 3
    (panel,) = distances(list(found.values()), own).axes
    assert [line.get_label() for line in panel.lines] == ["riccati", "receding", "hold", "T"]
    assert panel.lines[0].get_xdata()[-1] == pytest.approx(3.0)


def test_a_law_that_cannot_follow_says_why():
    """There is no regulator of a plant that no control reaches."""
    problem = problem_of(Linear([[1.0]], [[0.0]]), QuadraticCost([[1.0]], [[1.0]], [[1.0]]))
    riccati, receding, hold = loops_after_horizon(Controller(problem, Quadratic(torch.eye(1))), X[:, :1], 1)
    assert len(hold.distance) == 12, "one step after T at the least"
    assert hold.refused == ""
    assert riccati.distance is None
    assert "that a linear law stabilises" in riccati.refused
    assert receding.mean_at(11) == hold.mean_at(11)


def test_a_law_that_leaves_the_finite_numbers_says_so():
    """V(T, ·) = 0 leaves an unstable plant alone, whose states grow by eleven with each step."""
    problem = problem_of(Linear([[100.0]], [[1.0]]), QuadraticCost([[1.0]], [[1.0]], [[1.0]]))
    own = Controller(problem, Formula(lambda t, x: torch.where(t < 0.95, 105.0, 0.0) * (x**2).sum(-1)))
    riccati, receding, hold = found = loops_after_horizon(own, X[:, :1], 40)
    assert hold.distance is None
    assert "the closed loop diverges" in hold.refused
    assert float(receding.distance[-1].max()) < 1e-6
    assert float(riccati.distance[-1].max()) < 1e-6
    assert to_plain_data(found, own, 40)[-1]["distances"][-1]["mean"] is None
    assert "none of hold" in distances(found, own).axes[0].get_title()


def test_closed_loops_that_stay_at_the_goal_have_a_figure():
    own = controller(None)
    assert distances(loops_after_horizon(own, 0 * X, 2), own).axes[0].get_ylim()[0] > 0


def test_what_does_not_fit_is_no_refusal():
    with pytest.raises(ValueError, match="Expected x of shape"):
        loops_after_horizon(controller(None), torch.zeros(2, 3), 2)


@pytest.mark.parametrize("multiple", [0.5, float("inf"), float("nan"), 1e12])
def test_a_time_that_never_comes_is_refused(multiple):
    with pytest.raises(UsageError, match=r"Expected a multiple of T (from 1 on|that fits into memory)"):
        loops_after_horizon(controller(None), X, multiple)
