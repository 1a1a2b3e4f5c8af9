"""What training leaves behind: its interface, and the numbers that judge it, counted again by hand."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import lyapnet
from lyapnet.base.errors import CheckpointError, DivergenceError, UsageError
from lyapnet.base.random_streams import TEST, stream
from lyapnet.cli import main
from lyapnet.controller.controller import Controller
from lyapnet.controller.loading import config_of
from lyapnet.evaluation.measurement import evaluate
from lyapnet.evaluation.oracles import discrete_riccati
from lyapnet.experiment.assembly import build_problem, build_program, build_rollout, build_value_function
from lyapnet.experiment.checkpoint import AFTER_HORIZON, KEY, read_checkpoint, write_checkpoint
from lyapnet.experiment.config import Config, load_config, to_plain
from lyapnet.loop.rollout import Rollout
from lyapnet.task.systems import DoubleIntegrator, Linear
from lyapnet.value.after_horizon import LAWS, AfterHorizon
from lyapnet.value.policy import HJBPolicy
from tests.problems import Quadratic, problem_of, untrained

CONF = Path(__file__).parents[2] / "conf"
SMALL = [
    *("horizon.steps=10", "training.iterations=2", "training.batch_size=4", "network.hidden=[8, 8]"),
    *("evaluation.validation_states=4", "evaluation.test_states=4", "loggers=[csv]", "rollout.gradient=adjoint"),
]
N, n, m = 10, 2, 1
X0 = [0.5, -0.2]
DESIGNED_KEYS = {
    *("cost_mean", "cost_max", "optimal_cost_mean", "cost_ratio", "value_error", "constraint_loss", "terminal_error"),
    *("decreasing_fraction", "satisfied_fraction", "satisfied_fraction_1e-3", "satisfied_fraction_1e-6"),
    *("samples", "seed"),
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a short training of the Lyapunov program."""
    logs = tmp_path_factory.mktemp("logs")
    config = CONF / "from_scratch" / "double_integrator.yaml"
    assert main(["train", "--config", str(config), f"logs={logs}", *SMALL]) == 0
    return logs / "double_integrator_from_scratch" / "version_0"


@pytest.fixture(scope="module")
def path(run):
    return run / "checkpoints" / "best.ckpt"


@pytest.fixture(scope="module")
def controller(path):
    return lyapnet.load(path)


@pytest.mark.gate
def test_public_attributes(controller):
    assert isinstance(controller.system, DoubleIntegrator)
    assert isinstance(controller.cost, lyapnet.QuadraticCost)
    assert isinstance(controller.initial_states, lyapnet.Box)
    assert isinstance(controller.config, Config)
    assert (controller.horizon.steps, controller.horizon.dt) == (N, 0.01)
    assert controller.horizon.duration == pytest.approx(0.1)
    assert {"SYSTEMS", "ControlAffineSystem", "QuadraticCost", "Box", "load"} <= set(lyapnet.__all__)


def test_a_controller_is_printed_as_what_it_is(controller):
    assert repr(controller) == f"Controller(DoubleIntegrator, AnchoredNetwork, HJBPolicy, {N} steps of 0.01 s)"


def test_controller_knows_its_problem_its_run_and_what_it_was_trained_for(controller):
    problem = controller.problem
    for part in ("system", "cost", "controls", "initial_states", "horizon"):
        assert getattr(controller, part) is getattr(problem, part)
    assert controller.parameters == {"mass": 1.0}
    assert (controller.method, type(controller.program)) == ("euler", lyapnet.LyapunovProgram)


def test_controller_of_parts_has_no_config():
    controller = controller_of(PartlyFalling())
    assert controller.parameters == {}
    with pytest.raises(UsageError, match="Expected a controller that a run left, got one made from parts"):
        _ = controller.config


def test_what_runs_of_earlier_versions_ignored_is_left_out_of_their_config():
    """A config with such a setting is refused; their checkpoints are read, and resumed without it."""
    config = load_config(CONF / "double_integrator.yaml", ["cost.name=own:Price", "cost.Q=null", "cost.R=null"])
    config.cost.Q_T = None
    plain = to_plain(config)
    plain["system"] |= {"title": "Sledge", "angles": ["velocity"]}
    plain["cost"] |= {"Q": [1, 1], "periodic": ["position"]}
    assert config_of({KEY: {"config": plain}}, "last.ckpt") == config
    for name in ("double_integrator", "pushing"):
        config = load_config(CONF / f"{name}.yaml")
        assert config_of({KEY: {"config": to_plain(config)}}, "last.ckpt") == config, "what is read stays"


def test_loaded_value_function_is_the_trained_one(controller, path):
    weights = read_checkpoint(path)["state_dict"]
    for name, tensor in controller.V.state_dict().items():
        assert torch.equal(tensor, weights[f"V.{name}"])
    untrained = build_value_function(controller.config, build_problem(controller.config))
    assert any(not torch.equal(a, b) for a, b in zip(untrained.parameters(), controller.V.parameters(), strict=True))


BATCHES = [(), (5,), (3, 4), (0,)]


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("each_its_time", [False, True])
def test_shapes_of_value_and_policy(batch, each_its_time, controller):
    x = torch.randn(*batch, n)
    t = torch.rand(batch) * controller.horizon.duration if each_its_time else 0.05
    assert controller.value(t, x).shape == batch
    assert controller.policy(t, x).shape == (*batch, m)


@pytest.mark.parametrize("batch", BATCHES)
def test_shapes_of_rollout(batch, controller):
    trajectory = controller.rollout(torch.randn(*batch, n))
    assert trajectory.t.shape == (N + 1,)
    assert trajectory.x.shape == (N + 1, *batch, n)
    assert trajectory.u.shape == (N, *batch, m)
    assert trajectory.cost.shape == batch


def test_batch_equals_loop(controller):
    t, x = torch.rand(6) * controller.horizon.duration, torch.randn(6, n)
    alone = list(zip(t, x, strict=True))
    assert_close(controller.value(t, x), torch.stack([controller.value(*one) for one in alone]))
    assert_close(controller.policy(t, x), torch.stack([controller.policy(*one) for one in alone]))
    assert_close(controller.rollout(x).cost, torch.stack([controller.rollout(one).cost for one in x]))


def fields(trajectory):
    return [*trajectory, trajectory.require_value(), trajectory.cost, trajectory.step_cost]


def test_tensors_in_tensors_out(controller):
    x = torch.tensor(X0)
    answers = [controller.value(0.0, x), controller.policy(torch.tensor(0.0), x), *fields(controller.rollout(x))]
    assert all(isinstance(answer, torch.Tensor) and not answer.requires_grad for answer in answers)
    assert {answer.dtype for answer in answers} == {torch.float64}


def test_answers_carry_no_graph_unless_the_question_does():
    """Also with a V whose gradient is autograd's, so that .numpy() works on every answer."""
    controller, x = controller_of(PartlyFalling()), torch.tensor(X0)
    for answer in (controller.value(0.0, x), controller.policy(0.0, x), controller.rollout(x).cost):
        assert not answer.requires_grad
    assert controller.value(0.0, x.requires_grad_()).requires_grad


@pytest.mark.parametrize("x", [X0, tuple(X0), np.array(X0), np.array(X0, dtype=np.float32)], ids=repr)
def test_arrays_and_lists_in_arrays_out(x, controller):
    tensor = torch.tensor(X0)
    pairs = [
        (controller.value(0, x), controller.value(0.0, tensor)),
        (controller.policy(np.array(0.05), x), controller.policy(0.05, tensor)),
        *zip(fields(controller.rollout(x)), fields(controller.rollout(tensor)), strict=True),
    ]
    assert isinstance(controller.rollout(x), lyapnet.ArrayTrajectory)
    assert isinstance(controller.rollout(tensor), lyapnet.Trajectory)
    for array, expected in pairs:
        assert isinstance(array, np.ndarray | np.generic)
        np.testing.assert_allclose(array, expected.numpy(), rtol=1e-6)


def test_a_member_outside_the_family_is_noted_once(caplog):
    """Its ends count as inside, up to the rounding of ten nines."""
    of_family = untrained("pendulum_swingup", "family={mass: [0.5, 2.0]}", "network.hidden=[4]")
    for mass in (0.5, 1.0, 2.0, 2.0 * (1 + 1e-10)):
        of_family.value(0.0, [0.1, 0.0], mass=mass)
    assert not caplog.records
    of_family.value(0.0, [[0.1, 0.0], [0.2, 0.0]], mass=[1.0, 2.1])
    of_family.policy(0.0, [0.1, 0.0], mass=0.4)
    assert [record.getMessage() for record in caplog.records] == [
        "note: V was trained for mass in [0.5, 2.0] and is evaluated outside of this range; "
        "values there are extrapolated."
    ]


def test_integers_are_states_too(controller):
    assert controller.value(0, [1, 0]) == controller.value(0.0, torch.tensor([1.0, 0.0])).numpy()


@pytest.mark.parametrize(
    ("t", "x", "expected"),
    [
        (0.0, torch.zeros(3), r"\(\*batch, 2\), got \(3,\)"),
        (0.0, torch.tensor(1.0), r"\(\*batch, 2\), got \(\)"),
        (0.0, np.zeros((4, 5)), r"\(\*batch, 2\), got \(4, 5\)"),
        (torch.zeros(3), torch.zeros(4, 2), r"\(4,\), got \(3,\)"),
        (torch.zeros(4, 1), torch.zeros(4, 2), r"\(4,\), got \(4, 1\)"),
        ([0.0, 0.1], [0.0, 0.0], r"\(\), got \(2,\)"),
    ],
)
def test_wrong_shapes_are_refused_with_the_expected_ones(t, x, expected, controller):
    for question in (controller.value, controller.policy):
        with pytest.raises(ValueError, match=f"Expected .*{expected}; "):
            question(t, x)
    if np.ndim(t) == 0:
        with pytest.raises(ValueError, match=f"Expected .*{expected}; "):
            controller.rollout(x)


def test_rollout_that_leaves_the_finite_numbers_is_refused(controller):
    with pytest.raises(DivergenceError, match=r"step 0 .*x0 = \[nan, 0.0\]"):
        controller.rollout([float("nan"), 0.0])


@torch.no_grad()
def by_hand(controller, x0):
    """Costs J_N, and V at every node (N + 1, b): the formulas of the task sheet, step by step."""
    dt, x, J = controller.horizon.dt, x0, 0
    V = [controller.value(0.0, x)]
    for step in range(controller.horizon.steps):
        u = controller.policy(step * dt, x)
        ell = torch.einsum("bi,ij,bj->b", x, controller.cost.Q, x) + controller.cost.R(x)[:, 0, 0] * u[:, 0] ** 2
        J = J + dt * ell
        x = x + dt * (controller.system.f(x) + torch.einsum("bnm,bm->bn", controller.system.g(x), u))
        V.append(controller.value((step + 1) * dt, x))
    return J + torch.einsum("bi,ij,bj->b", x, controller.cost.Q_T, x), torch.stack(V)


def test_cost_of_a_rollout_is_the_formula_of_the_task_sheet(controller):
    x0 = torch.randn(7, n)
    assert_close(controller.rollout(x0).cost, by_hand(controller, x0)[0])


# Evaluation


def test_evaluation_has_the_designed_keys(controller):
    result = evaluate(controller, samples=5, seed=2)
    assert result.keys() >= DESIGNED_KEYS
    assert (result["samples"], result["seed"]) == (5, 2)
    errors, corner, found = (result.pop(key) for key in ("terminal_errors", "worst_corner", "worst_found"))
    assert corner.keys() == found.keys() == {"count", "x0", "cost", "value"}
    assert errors.keys() == {"position (m)", "velocity (m/s)"}
    assert result["optimum_of"] == "steps of 0.01 s (euler) with u held"
    assert result["after_T"] in LAWS
    assert result["program"] == "LyapunovProgram"
    numbers = [value for key, value in result.items() if key not in ("optimum_of", "after_T", "program")]
    assert all(isinstance(value, int | float) for value in (*numbers, *errors.values()))
    assert json.loads(json.dumps(result)) == result


def test_evaluation_is_a_function_of_its_seed(controller):
    assert evaluate(controller, 8, seed=0) == evaluate(controller, 8, seed=0)
    assert evaluate(controller, 8, seed=0)["cost_mean"] != evaluate(controller, 8, seed=1)["cost_mean"]


def counted(controller, samples, seed):
    """The figures of an evaluation, state by state."""
    x0 = controller.initial_states.sample(samples + 100, stream(seed, TEST))
    J, V = by_hand(controller, x0)
    ell = controller.rollout(x0).step_cost
    hinges = [sum(max(float(V[k + 1, i] - V[k, i] + ell[k, i]), 0.0) for k in range(N)) for i in range(len(x0))]
    falls = [all(V[k + 1, i] <= V[k, i] for k in range(N)) for i in range(samples)]
    paper = range(samples, samples + 100)
    return {
        "cost_mean": float(J[:samples].mean()),
        "cost_max": float(J[:samples].max()),
        "constraint_loss": sum(hinges[:samples]) / samples,
        "decreasing_fraction": sum(falls) / samples,
        "satisfied_fraction": sum(hinges[i] <= 0.01 * float(V[0, i]) for i in paper) / 100,
        "satisfied_fraction_1e-3": sum(hinges[i] <= 0.001 * float(V[0, i]) for i in paper) / 100,
        "satisfied_fraction_1e-6": sum(hinges[i] <= 1e-6 * float(V[0, i]) for i in paper) / 100,
    }


def controller_of(V):
    config = load_config(CONF / "from_scratch" / "double_integrator.yaml", [f"horizon.steps={N}"])
    return Controller(build_problem(config), V, program=build_program(config))


class PartlyFalling(lyapnet.ValueFunction):
    """V falls as fast as the cost accrues from some states, not from others; it rises near the goal."""

    def forward(self, t, x):
        return 3 * x[..., 0] ** 2 * (1 - 0.9 * x[..., 0] * t / 0.1) + 0.01 * t


def test_shares_are_counted_as_by_hand():
    controller = controller_of(PartlyFalling())
    result, expected = evaluate(controller, 40, seed=3), counted(controller, 40, seed=3)
    assert {key: result[key] for key in expected} == pytest.approx(expected, rel=1e-9)
    assert 0 < result["decreasing_fraction"] < 1
    assert 0 < result["satisfied_fraction"] < 1


def test_trained_controller_is_measured_as_by_hand(controller):
    result, expected = evaluate(controller, 6, seed=1), counted(controller, 6, seed=1)
    assert {key: result[key] for key in expected} == pytest.approx(expected, rel=1e-9)


def riccati(quadratic, factor=1.0, steps=100):
    """A controller around factor · xᵀP_n x, where P solves the Riccati equation."""
    config = load_config(CONF / "from_scratch" / "double_integrator.yaml", [f"horizon.steps={steps}"])
    problem = build_problem(config)
    P = discrete_riccati(problem.system, problem.cost, problem.horizon).P
    V = quadratic(factor * P, dt=problem.horizon.dt)
    return Controller(problem, V, program=build_program(config))


def test_exact_value_function_has_no_gap(quadratic):
    result = evaluate(riccati(quadratic), 64)
    assert result["cost_ratio"] == pytest.approx(1, abs=1e-3)
    assert result["cost_ratio"] >= 1 - 1e-12
    assert result["value_error"] < 1e-12
    assert result["decreasing_fraction"] == 1


@pytest.mark.parametrize("factor", [0.3, 3.0])
def test_wrong_value_function_has_a_gap(factor, quadratic):
    result = evaluate(riccati(quadratic, factor), 64)
    assert result["cost_ratio"] > 1.05
    assert result["value_error"] == pytest.approx(abs(factor - 1))


@pytest.mark.gate
def test_satisfied_share_follows_the_slack(quadratic):
    """1.1 V* falls by 1.1 ℓ along its own loop but for O(Δt); 0.5 V* by about half of what the condition asks."""
    assert evaluate(riccati(quadratic, 1.1), 8)["satisfied_fraction"] == 1
    assert evaluate(riccati(quadratic, 0.5), 8)["satisfied_fraction"] == 0


def test_task_without_an_oracle_has_no_gap_to_report(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)  # CasADi is an extra
    config = load_config(CONF / "from_scratch" / "reacher.yaml", ["horizon.steps=3", "network.hidden=[4]"])
    problem = build_problem(config)
    V = build_value_function(config, problem)
    result = evaluate(Controller(problem, V, build_rollout(config, problem, V)), 4)
    assert result.keys() >= DESIGNED_KEYS
    assert result["optimal_cost_mean"] is result["cost_ratio"] is result["value_error"] is None
    assert result["optimum_failures"] is None
    assert result["no_optimum"].startswith("Expected CasADi for the optimum of a nonlinear task, got none; ")
    assert result["cost_mean"] > 0


def test_no_samples_are_refused(controller):
    with pytest.raises(ValueError, match="Expected samples ≥ 1, got 0"):
        evaluate(controller, 0)


# The user's own system


@pytest.fixture
def own_system(path, tmp_path):
    """The checkpoint of a run on a system of the user's own."""
    content = read_checkpoint(path)
    content[KEY]["config"]["system"] = {"name": "mine:Cart", "parameters": {"mass": 2.0}}
    write_checkpoint(content, tmp_path / "own.ckpt")
    return tmp_path / "own.ckpt"


def test_system_of_the_users_own_is_passed_to_load(own_system):
    with pytest.raises(UsageError, match=r"Expected system=.*mine:Cart"):
        lyapnet.load(own_system)
    mine = DoubleIntegrator(mass=2.0)
    assert lyapnet.load(own_system, system=mine).system.mass == 2.0


def test_evaluate_command_takes_a_system_of_the_users_own(own_system, monkeypatch, capsys):
    monkeypatch.chdir(own_system.parent)
    monkeypatch.setattr(sys, "path", [*sys.path])
    (own_system.parent / "mine.py").write_text("from lyapnet.task.systems import DoubleIntegrator as Cart\n")
    arguments = ["evaluate", str(own_system), "--samples", "5", "--json"]
    assert main(arguments) == 2
    assert "mine:Cart" in capsys.readouterr().err
    assert main([*arguments, "--system", "mine:Cart"]) == 0
    sys.modules.pop("mine")
    expected = evaluate(lyapnet.load(own_system, system=DoubleIntegrator(mass=2.0)), 5)
    assert json.loads(capsys.readouterr().out) == expected


def test_passed_system_replaces_the_one_of_the_checkpoint(controller, path):
    heavier = lyapnet.load(path, system=DoubleIntegrator(mass=2.0))
    x = torch.tensor(X0)
    assert_close(heavier.value(0.0, x), controller.value(0.0, x))
    assert_close(heavier.policy(0.0, x), controller.policy(0.0, x))  # g/R = (1/m)/(1/m)
    assert not torch.allclose(heavier.rollout(x).x[-1], controller.rollout(x).x[-1])


def of_others(caplog):
    """The notes of problems that a checkpoint was not trained for."""
    messages = (record.getMessage() for record in caplog.records)
    return [message for message in messages if "was trained for a problem with other" in message]


def test_another_plant_is_noted_at_load(path, caplog):
    lyapnet.load(path)
    lyapnet.load(path, system=DoubleIntegrator())
    assert not of_others(caplog)
    lyapnet.load(path, system=DoubleIntegrator(mass=2.0))
    (note,) = of_others(caplog)
    assert str(path) in note
    assert "other g, R;" in note


@pytest.mark.gate
def test_evaluate_notes_another_plant_once_and_measures_it(path, tmp_path, monkeypatch, capsys, caplog):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "swapped.py").write_text(
        "from lyapnet.task.systems import DoubleIntegrator\n"
        "class Other(DoubleIntegrator):\n"
        "    def __init__(self):\n"
        "        super().__init__()\n"
        "        self.state_names = ['velocity', 'position']\n"
    )
    arguments = ["evaluate", str(path), "--samples", "5", "--json", "--robustness"]
    assert main(arguments) == 0
    assert not of_others(caplog)
    assert main([*arguments, "--system", "swapped:Other"]) == 0
    (note,) = of_others(caplog)
    assert "other state names;" in note
    own, other = (json.loads(line) for line in capsys.readouterr().out.splitlines())
    assert own["cost_mean"] == other["cost_mean"]


@pytest.mark.parametrize(("held", "beyond", "noted"), [(10, None, True), (64, None, False), (10, "hold", False)])
def test_a_law_after_T_that_holds_too_few_is_noted_at_load(held, beyond, noted, path, tmp_path, caplog):
    """Where the law after T is the user's choice, nothing is to be said of the one that training found."""
    found = AfterHorizon("receding", held, 64, "receding: 10 of 64")
    content = read_checkpoint(path)
    content[KEY][AFTER_HORIZON] = found._asdict()
    write_checkpoint(content, tmp_path / "after.ckpt")
    controller = lyapnet.load(tmp_path / "after.ckpt", beyond=beyond)
    assert controller.after_horizon() == found
    notes = [record.getMessage() for record in caplog.records if "no law was found" in record.getMessage()]
    assert len(notes) == noted


def test_weights_of_another_network_are_named_up_to_six(path, tmp_path):
    content = read_checkpoint(path)
    weights = content["state_dict"]
    own = sorted(name for name in weights if name.startswith("V."))
    weights[own[0]] = weights[own[0]].new_zeros(7, 7)
    write_checkpoint(content, tmp_path / "shape.ckpt")
    with pytest.raises(
        CheckpointError, match=rf"got another one: {own[0][2:]} has shape \(7, 7\) in the checkpoint[^;]*$"
    ):
        lyapnet.load(tmp_path / "shape.ckpt")
    weights |= {f"V.extra{i}": torch.zeros(1) for i in range(8)}
    write_checkpoint(content, tmp_path / "more.ckpt")
    with pytest.raises(CheckpointError, match=r"extra5 is only in the checkpoint; and 3 more\. Use"):
        lyapnet.load(tmp_path / "more.ckpt")


def test_a_rollout_of_more_or_fewer_steps_is_the_same_closed_loop():
    """Under a V that does not depend on time the law after T is that before T."""
    problem = problem_of(DoubleIntegrator(), steps=6)
    V = Quadratic(torch.tensor([[2.0, 1.0], [1.0, 2.0]]), dt=100.0)
    short = lyapnet.Controller(problem, V, policy=HJBPolicy, beyond="hold")
    long = lyapnet.Controller(problem.in_steps(steps=10), V, policy=HJBPolicy, beyond="hold")
    x0 = torch.tensor([X0, [-0.3, 0.9]])
    assert_close(tuple(short.rollout(x0, steps=10)), tuple(long.rollout(x0)))
    assert_close(tuple(long.rollout(x0, steps=6)), tuple(short.rollout(x0)))


def test_a_system_of_another_number_of_states_is_named(path):
    with pytest.raises(UsageError, match=r"a system of 2 states.*best\.ckpt.*got Linear of 3 \(x1, x2, x3\); pass the"):
        lyapnet.load(path, system=Linear(np.zeros((3, 3)).tolist(), [[0.0], [0.0], [1.0]]))


def test_a_checkpoint_without_a_record_is_taken_as_it_is(path, tmp_path, caplog):
    content = read_checkpoint(path)
    assert content[KEY].pop("problem")
    write_checkpoint(content, tmp_path / "old.ckpt")
    lyapnet.load(tmp_path / "old.ckpt", system=DoubleIntegrator(mass=2.0))
    assert not of_others(caplog)


# lyapnet evaluate


def test_evaluate_command_prints_one_json_object(controller, path, capsys):
    assert main(["evaluate", str(path), "--samples", "5", "--seed", "2", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == evaluate(controller, 5, seed=2)


def test_evaluate_command_prints_a_table(path, capsys):
    assert main(["evaluate", str(path), "--samples", "5"]) == 0
    assert "cost / optimum" in capsys.readouterr().out


def test_run_writes_the_evaluation_of_its_best_checkpoint(controller, run):
    assert json.loads((run / "evaluation.json").read_text()) == evaluate(controller, 4, seed=0)


@pytest.mark.parametrize(
    ("arguments", "status"), [(["missing.ckpt"], 2), (["PATH", "--samples", "0"], 2), (["PATH", "--nonsense"], 2)]
)
def test_evaluate_command_refuses_in_one_line(arguments, status, path, capsys):
    assert main(["evaluate", *[str(path) if a == "PATH" else a for a in arguments]]) == status
    assert capsys.readouterr().err.count("\n") == 1


def test_evaluate_command_refuses_a_truncated_checkpoint(path, tmp_path, capsys):
    cut = tmp_path / "cut.ckpt"
    shutil.copy(path, cut)
    cut.write_bytes(cut.read_bytes()[:500])
    assert main(["evaluate", str(cut)]) == 1
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert str(cut) in message
    with pytest.raises(CheckpointError):
        main(["evaluate", str(cut), "--debug"])


def test_a_rollout_of_another_value_function_is_refused():
    problem = problem_of(DoubleIntegrator())
    V, other = (Quadratic(torch.eye(2)) for _ in range(2))
    lyapnet.Controller(problem, V, Rollout(problem, HJBPolicy(problem, V)))
    with pytest.raises(ValueError, match="the rollout of this V on this problem"):
        lyapnet.Controller(problem, V, Rollout(problem, HJBPolicy(problem, other)))
