"""Environments: the episode is the rollout, the return its cost; and the checkers of Gymnasium and SB3 agree."""

import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env as gymnasium_check
from stable_baselines3.common.env_checker import check_env as sb3_check
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecMonitor

from lyapnet.base.errors import DivergenceError, UsageError
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import load_config, to_plain
from lyapnet.lab.comparison.baselines.vector_environment import VectorEnvironment
from lyapnet.lab.comparison.controller_policy import ControllerPolicy
from lyapnet.lab.comparison.environments import IDS, Environment
from lyapnet.lab.comparison.reference_problems import CONTROL_SCALES, TASKS, bounded_problem
from lyapnet.lab.comparison.scoring import costs_of
from lyapnet.task.horizon import Horizon
from lyapnet.task.sets import Unbounded
from lyapnet.task.systems import DoubleIntegrator
from tests.problems import CONF, problem_of, untrained


def played(environment, x0, controls, scale):
    """The return of an episode from x₀ under given physical controls, and the states on the way."""
    _, _ = environment.reset(options={"state": x0})
    states, total = [environment.unwrapped.state], 0.0
    for n, u in enumerate(controls):
        _, reward, terminated, truncated, info = environment.step(u / scale)
        np.testing.assert_allclose(info["control"], u, rtol=1e-12)
        assert not terminated
        assert truncated == (n == len(controls) - 1)
        states.append(environment.unwrapped.state)
        total += reward
    return total, np.stack(states)


@pytest.mark.parametrize("name", TASKS)
def test_return_is_minus_the_cost_of_the_rollout(name):
    controller = untrained(name)
    environment = gymnasium.make(IDS[name])
    scale = environment.unwrapped.control_scale
    x0 = controller.initial_states.sample(1)[0].numpy()
    trajectory = controller.rollout(x0)
    total, states = played(environment, x0, trajectory.u.clip(-scale, scale), scale)
    assert (np.abs(trajectory.u) <= scale).all()
    np.testing.assert_allclose(states, trajectory.x, rtol=1e-9, atol=1e-12)
    assert total == pytest.approx(-trajectory.cost, rel=1e-9)
    again, _ = played(environment, x0, 0.9 * trajectory.u.clip(-scale, scale), scale)
    assert again != pytest.approx(-trajectory.cost, rel=1e-6), "other controls cost something else"


@pytest.mark.parametrize("name", TASKS)
def test_environment_made_by_name_is_the_task_of_the_config(name):
    config = load_config(CONF / f"{name}.yaml")
    environment = gymnasium.make(IDS[name]).unwrapped
    sections = ("system", "cost", "initial_states", "horizon")
    of_config, of_name = build_problem(config), environment.problem
    assert {key: TASKS[name][key] for key in sections}.keys() == TASKS[name].keys()
    assert to_plain(config)["horizon"] == {**TASKS[name]["horizon"], "stationary": False}
    x = of_config.initial_states.sample(5)
    u = torch.ones(5, of_config.system.m)
    for part in ("lower", "upper"):
        torch.testing.assert_close(getattr(of_name.initial_states, part), getattr(of_config.initial_states, part))
    torch.testing.assert_close(of_name.system.dynamics(x, u), of_config.system.dynamics(x, u))
    torch.testing.assert_close(of_name.cost.running(x, u), of_config.cost.running(x, u))
    torch.testing.assert_close(of_name.cost.terminal(x), of_config.cost.terminal(x))


@pytest.mark.parametrize("observe_time", [False, True])
@pytest.mark.parametrize("name", TASKS)
def test_checkers_pass(name, observe_time):
    environment = gymnasium.make(IDS[name], observe_time=observe_time).unwrapped
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*(minimum|maximum) value is.*infinity.*")  # a state has no bounds
        gymnasium_check(environment)
    sb3_check(environment)


def test_checker_finds_what_is_wrong():
    class Wrong(Environment):
        def step(self, action):
            observation, *others = super().step(action)
            return observation[:-1], *others

    with pytest.raises(AssertionError):
        sb3_check(Wrong("double_integrator"))


def test_time_is_observed_where_asked_for():
    environment = Environment("cartpole_balancing", observe_time=True)
    observation, _ = environment.reset(seed=0)
    times = [observation[-1]]
    for _ in range(3):
        observation, *_ = environment.step(np.zeros(1))
        times.append(observation[-1])
    np.testing.assert_allclose(times, [0, 0.01, 0.02, 0.03])
    np.testing.assert_array_equal(observation[:-1], environment.state)


def test_controls_are_clipped_counted_and_told():
    environment = Environment("reacher")
    environment.reset(seed=0)
    *_, info = environment.step(np.array([-7.0, 0.5]))
    np.testing.assert_allclose(info["control"], [-CONTROL_SCALES["reacher"][0], 0.5 * CONTROL_SCALES["reacher"][1]])
    assert info["clipped"]
    *_, info = environment.step(np.array([0.2, 0.5]))
    assert not info["clipped"]
    assert environment.clipped_fraction == 1 / 4


@pytest.mark.parametrize("name", TASKS)
def test_batch_is_as_many_environments(name):
    batch, alone = VectorEnvironment(name, 3, seed=4), Environment(name)
    first = batch.reset()
    actions = np.random.default_rng(0).uniform(
        -1.2, 1.2, (batch.episodes.problem.horizon.steps, *batch.state.shape[:1], 1)
    )
    actions = np.broadcast_to(actions, (*actions.shape[:2], batch.episodes.problem.system.m))
    alone.reset(options={"state": first[1]})
    for n, action in enumerate(actions):
        observation, rewards, dones, infos = batch.step(action)
        expected, reward, _, truncated, info = alone.step(action[1])
        assert rewards[1] == pytest.approx(reward, rel=1e-12)
        np.testing.assert_allclose(infos[1]["control"], info["control"])
        last = infos[1].get("terminal_observation") if truncated else observation[1]
        np.testing.assert_allclose(last, expected, rtol=1e-9, atol=1e-12)
        assert list(dones) == [truncated] * 3
        assert infos[0].get("TimeLimit.truncated", False) == (n == len(actions) - 1)
    assert batch.episodes.problem.initial_states.contains(torch.as_tensor(observation)).all(), "a new episode began"
    assert not np.array_equal(observation, first)


def test_batch_draws_what_its_seed_says():
    one, same, other = (VectorEnvironment("reacher", 4, seed=s).reset() for s in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other)


def test_end_that_is_no_truncation_is_not_called_one():
    batch = VectorEnvironment(shortened("double_integrator", 2), 2, [6.0], truncates=False)
    batch.reset()
    batch.step(np.zeros((2, 1)))
    *_, infos = batch.step(np.zeros((2, 1)))
    assert not infos[0]["TimeLimit.truncated"]


def shortened(name, steps):
    problem = bounded_problem(name).problem
    return problem.replaced(horizon=Horizon(steps, problem.horizon.dt))


@pytest.mark.parametrize("observe_time", [False, True])
@pytest.mark.parametrize("name", ["double_integrator", "reacher"])
def test_evaluate_policy_scores_a_controller_at_its_own_cost(name, observe_time):
    controller = untrained(name, "horizon.steps=7")
    x0 = controller.initial_states.sample(3)
    scale = [1e3] * controller.system.m
    policy = ControllerPolicy(controller, scale)
    environment = VectorEnvironment(shortened(name, 7), 3, scale, observe_time)
    environment.reset = lambda: environment.start(x0)
    returns, _ = evaluate_policy(policy, VecMonitor(environment), 3, return_episode_rewards=True)  # pyright: ignore
    cost = controller.rollout(x0).cost
    np.testing.assert_allclose(returns, -cost.numpy(), rtol=1e-5)  # VecMonitor adds up in float32
    costs = costs_of(policy, bounded_problem(shortened(name, 7), scale), observe_time, x0)
    torch.testing.assert_close(costs.cost, cost, rtol=1e-12, atol=1e-12)
    wrong = ControllerPolicy(controller, [2e3] * controller.system.m)
    assert not torch.allclose(costs_of(wrong, bounded_problem(shortened(name, 7), scale), True, x0).cost, cost)


def test_controller_counts_the_steps_of_each_episode():
    controller = untrained("double_integrator", "horizon.steps=5")
    policy = ControllerPolicy(controller, [6.0])
    mean, spread = evaluate_policy(policy, Monitor(Environment(shortened("double_integrator", 5), [6.0])), 2)  # pyright: ignore
    assert np.isfinite([mean, spread]).all()
    x = np.array([[0.5, 0.1], [0.5, 0.1]])
    _, state = policy.predict(x, None, np.array([True, True]))
    late, state = policy.predict(x, state, np.array([False, True]))
    np.testing.assert_allclose(late[0] * 6, controller.policy(0.01, x[0]))
    np.testing.assert_allclose(late[1] * 6, controller.policy(0.0, x[1]))
    with pytest.raises(ValueError, match="2 or 3 entries, got 5"):
        policy.predict(np.zeros(5))


def test_paper_sum_is_the_cost_without_the_step():
    bounded, x0 = bounded_problem("double_integrator"), torch.tensor([[1.0, 0.0], [0.2, -0.3]])

    class Nothing:
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return np.zeros((len(observation), 1)), state

    costs = costs_of(Nothing(), bounded, False, x0)
    x, total = x0.clone(), torch.zeros(2)
    for _ in range(400):
        total += bounded.problem.cost.running(x, torch.zeros(2, 1))
        x = x + 0.01 * torch.stack([x[:, 1], torch.zeros(2)], -1)
    phi = bounded.problem.cost.terminal(x)
    torch.testing.assert_close(costs.sum, total + phi)
    torch.testing.assert_close(costs.cost, 0.01 * total + phi)
    assert costs.clipped_fraction == 0


@pytest.mark.parametrize(
    ("task", "scale", "named"),
    [
        ("double_integratr", None, "a task as one of"),
        (str(CONF / "integrator_chain.yaml"), None, "control_scale"),
        ("reacher", [1.0], "each of"),
        ("reacher", [1.0, -1.0], "control_scale > 0"),
        ("nowhere.yaml", [1.0], "config file"),
        (None, None, "task=…"),
    ],
    ids=lambda value: str(value).removeprefix(f"{CONF}/"),
)
def test_impossible_environment_is_refused(task, scale, named):
    with pytest.raises(UsageError, match=named):
        Environment(task, scale)


def test_policy_that_diverges_costs_infinity_where_it_does():
    class Pushes:
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return np.where(observation[:, :1] > 1e100, 1.0, 0.0), state

    x0 = torch.tensor([[0.0, 0.1, 0.0, 0.0], [0.0, 0.1, 0.0, 1e200], [0.0, 0.1, 0.0, 0.0]])
    costs = costs_of(Pushes(), bounded_problem("cartpole_swingup"), False, x0)
    assert costs.cost[1] == torch.inf
    assert costs.sum[1] == torch.inf
    assert torch.isfinite(costs.cost[0])
    assert costs.cost[0] == costs.cost[2]


def test_action_of_another_shape_is_refused():
    environment = Environment("double_integrator")
    environment.reset(seed=0)
    with pytest.raises(ValueError, match=r"shape \(1,\), got \(2,\)"):
        environment.step(np.zeros(2))
    with pytest.raises(ValueError, match="one a_i for each control"):
        environment.step(np.zeros((1, 1)))


def test_a_name_with_its_module_needs_no_import_of_lyapnet():
    name = "lyapnet.lab.comparison.environments:lyapnet/Reacher-v0"
    program = f"import gymnasium; print(gymnasium.make('{name}').unwrapped.problem.system)"
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert said.stdout.strip() == "Reacher()", said.stderr


def test_any_task_is_made_by_name():
    environment = gymnasium.make("lyapnet/Task-v0", task=str(CONF / "integrator_chain.yaml"), control_scale=5)
    assert environment.observation_space.shape == (4,)


def test_environment_of_a_config_of_your_own(tmp_path):
    path = tmp_path / "chain.yaml"
    path.write_text((CONF / "integrator_chain.yaml").read_text())
    environment = Environment(str(path), [5.0])
    observation, _ = environment.reset(seed=1)
    assert observation.shape == (4,)
    same, _ = environment.reset(seed=1)
    np.testing.assert_array_equal(observation, same)
    with pytest.raises(ValueError, match="one state"):
        environment.reset(options={"state": np.zeros(3)})


def test_state_that_leaves_the_numbers_is_told():
    environment = Environment("cartpole_swingup")
    environment.reset(options={"state": np.array([0.0, 0.0, 0.0, 1e200])})
    with pytest.raises(DivergenceError, match="step 1"):
        environment.step(np.zeros(1))


def test_controls_outside_the_set_are_projected_onto_it():
    class Small(Unbounded):
        def project(self, u):
            return u.clamp(-0.5, 0.5)

        def minimise(self, R, b):
            return self.project(super().minimise(R, b))

    environment = Environment(problem_of(DoubleIntegrator(), controls=Small()), control_scale=2.0)
    environment.reset(seed=0)
    *_, info = environment.step(np.array([1.0]))
    assert info["control"] == [0.5]
