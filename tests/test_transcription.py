"""The optimum by direct transcription, held against Riccati, rollouts and finite differences; and what it refuses."""

import contextlib
import csv
import io
import json
import math
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from lyapnet.build import build_task
from lyapnet.callbacks import FigureLogger
from lyapnet.checkpoint import read_checkpoint
from lyapnet.cli import main
from lyapnet.config import load_config
from lyapnet.controller import load
from lyapnet.cost import QuadraticCost
from lyapnet.errors import OracleError
from lyapnet.evaluation import evaluation
from lyapnet.oracles import discrete_riccati, oracle_of
from lyapnet.oracles.multistart import Candidate, MultiStart
from lyapnet.oracles.symbolic import require_equal, symbolic, traced
from lyapnet.oracles.transcription import Transcription
from lyapnet.rollout import Horizon
from lyapnet.systems import Cartpole, DoubleIntegrator, Linear, Reacher

ROOT = Path(__file__).parents[1]
CONF = ROOT / "conf"


@pytest.fixture(autouse=True)
def _empty_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("LYAPNET_CACHE", str(tmp_path / "cache"))


def task_of(name, *overrides):
    """(system, cost, X₀, horizon) of a shipped config."""
    return build_task(load_config(CONF / f"{name}.yaml", list(overrides)))


def transcription_of(name, *overrides, **options):
    task = task_of(name, *overrides)
    return Transcription(task.system, task.cost, task.horizon, **options), task.initial_states


# The optimum


def linear_task(n, m):
    """Unstable in open loop, with couplings in all weights."""
    half, terminal = torch.randn(n, n), torch.randn(n, n)
    cost = QuadraticCost(half @ half.mT, torch.eye(m) + 0.2 * torch.ones(m, m), terminal @ terminal.mT)
    return Linear(torch.randn(n, n), torch.randn(n, m)), cost, Horizon(30, 0.05)


@pytest.mark.parametrize(("n", "m"), [(1, 1), (3, 2), (6, 1)])
def test_optimum_of_a_linear_task_is_riccatis(n, m):
    system, cost, horizon = linear_task(n, m)
    x0 = torch.randn(5, n)
    optima = Transcription(system, cost, horizon).solve(x0)
    solution = discrete_riccati(system, cost, horizon)
    assert_close(optima.cost, solution.value(0, x0), rtol=1e-8, atol=1e-10)
    assert_close(optima.u[0], solution.policy(0, x0), rtol=1e-4, atol=1e-4)
    # twin: a slightly different model has another optimum
    other = discrete_riccati(Linear(1.001 * system.A, system.B), cost, horizon)
    assert not torch.allclose(optima.cost, other.value(0, x0), rtol=1e-6)


def test_one_step_and_any_leading_shape():
    system, cost = DoubleIntegrator(), QuadraticCost(torch.eye(2), [[1.0]], torch.eye(2))
    oracle = Transcription(system, cost, Horizon(1, 0.1))
    x0 = torch.randn(2, 3, 2)
    assert_close(oracle(x0), discrete_riccati(system, cost, Horizon(1, 0.1)).value(0, x0))
    assert oracle(x0[0, 0]).shape == ()
    assert oracle(x0.float()).dtype == torch.float32


def test_R_as_a_function_needs_no_riccati_equation():
    system = DoubleIntegrator(mass=2.0)
    cost = QuadraticCost(torch.eye(2), system.inverse_mass, torch.eye(2))
    same = QuadraticCost(torch.eye(2), [[0.5]], torch.eye(2))
    horizon, x0 = Horizon(20, 0.1), torch.randn(3, 2)
    assert_close(oracle_of(system, cost, horizon)(x0), oracle_of(system, same, horizon)(x0))


def slopes(oracle, x0, u, h=1e-4, directions=3):
    """First and second differences of J along random directions of control sequences, in one rollout."""
    d = torch.randn(directions, *u.shape)
    points = torch.cat([u + h * d, u - h * d, u[None]])
    _, J = oracle.rollout(x0.repeat(len(points), 1), points.movedim(0, 1).flatten(1, 2))
    up, down, middle = J.reshape(len(points), -1).split([directions, directions, 1])
    return (up - down) / (2 * h), (up - 2 * middle + down) / h**2


@pytest.mark.parametrize(("name", "least", "most"), [("cartpole_swingup", 170, 200), ("reacher", 1, 60)])
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


def test_no_controller_costs_less():
    oracle, X0 = transcription_of("reacher")
    x0 = X0.sample(6)
    optima = oracle.solve(x0)
    for stiffness, damping in ((0.2, 0.3), (0.6, 0.4), (2.0, 1.0)):
        x, u = x0, []
        for _ in range(oracle.horizon.steps):  # a spring and a damper at each joint
            u.append(-stiffness * x[:, :2] - damping * x[:, 2:])
            x = oracle.step(x, u[-1])[0]
        assert (oracle.rollout(x0, torch.stack(u))[1] > optima.cost).all()


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


def test_a_minimum_that_the_rollout_does_not_confirm_is_none():
    oracle, X0 = transcription_of("reacher", "horizon.steps=10")
    minimise, x0 = oracle._minimise, X0.sample(2)
    oracle._minimise = lambda *a: minimise(*a)._replace(cost=1.0)
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
    oracle._minimise = lambda x, start: worse[tuple(x.tolist())]
    assert oracle.solve(x0, known=best.u).failures == 2
    assert "known controls cost less" in oracle.solve(x0, known=best.u).reasons[0]


def test_minima_spread_to_the_states_around():
    """Two basins, costs 1 and 2; only the first state has a start in the better one."""

    def minimise(x0, start):
        basin = float(start.u[0, 0])
        return Candidate(start.x, start.u, 1 + basin)

    def start(basin):
        return Candidate(np.zeros((1, 1)), np.full((1, 1), basin), math.inf)

    search = MultiStart(np.arange(20.0)[:, None], [None] * 20, minimise)
    search.run({i: [start(float(i > 0))] for i in range(20)}, lambda done, total: None)
    assert [candidate.cost for candidate in search.best] == [1.0] * 20


# The cache


@pytest.fixture
def solved():
    """An oracle, some states, and their optima, which are on disk."""
    oracle, X0 = transcription_of("reacher", "horizon.steps=10")
    x0 = X0.sample(3)
    return oracle, x0, oracle.solve(x0)


def unsolvable(oracle):
    """The oracle without IPOPT."""
    oracle._minimise = lambda *_: "no solver"
    return oracle


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


@pytest.mark.parametrize("damage", [lambda c: c[: len(c) // 2], lambda c: b"", lambda c: c[:150] + b"?" + c[151:]])
def test_damaged_files_are_solved_again(solved, damage):
    oracle, x0, optima = solved
    for path in oracle.cache.folder.iterdir():
        path.write_bytes(damage(path.read_bytes()))
    assert [oracle.cache.read(x) for x in x0] == [None] * 3
    assert_close(oracle.solve(x0).cost, optima.cost)
    assert torch.equal(unsolvable(oracle).solve(x0).cost, optima.cost)


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


# The translation


def translated(function, arguments):
    result = symbolic(traced(function, arguments), arguments)
    require_equal(result, function, arguments)
    return result


def test_every_registered_system_is_translated(system, cost):
    def task(x, u):
        return system.f(x), system.g(x), system.dynamics(x, u), cost.running(x, u), cost.terminal(x)

    arguments = torch.zeros(1, system.n), torch.zeros(1, system.m)
    result = translated(task, arguments)
    for _ in range(5):
        x, u = 3 * torch.randn(1, system.n), 3 * torch.randn(1, system.m)
        for ours, theirs in zip(result.call([x[0].numpy(), u[0].numpy()]), task(x, u), strict=True):
            assert_close(torch.tensor(np.array(ours)).flatten(), theirs.flatten(), rtol=1e-11, atol=1e-11)


MASS = torch.eye(4, dtype=torch.float64) + 0.1


def filled(x):
    result = torch.zeros_like(x)
    result[..., 0] = x[..., 1] ** 2
    result[..., 2:] = torch.sin(x[..., :2])
    return result


FUNCTIONS = {
    "powers": lambda x: x**2 + x**3 + (1 + x**2) ** 0.5 + 2.0**x + torch.sqrt(1 + x * x).pow(-1.5) + x.abs() ** x,
    "trigonometry": lambda x: torch.sin(x) + torch.cos(x) * torch.tan(x / 4) + torch.atan(x) + torch.atan2(x, 1 + x**2),
    "inverse": lambda x: torch.asin(torch.tanh(x)) + torch.acos(torch.sin(x)) + torch.asinh(x) + torch.acosh(2 + x * x),
    "exponentials": lambda x: torch.exp(-x) + torch.log(1 + x * x) + torch.log1p(x * x) + torch.expm1(x) + torch.erf(x),
    "hyperbolic": lambda x: torch.tanh(x) + torch.sinh(x) / torch.cosh(x) + torch.sigmoid(x),
    "activations": lambda x: torch.nn.functional.softplus(x) + torch.relu(x) + torch.nn.functional.silu(x)
    + torch.nn.functional.elu(x) + torch.nn.functional.gelu(x),
    "branches": lambda x: torch.where(x > 0, x, -2 * x) + torch.sign(x) + torch.clamp(x, -0.5, 0.5) + x.clamp(min=0),
    "logic": lambda x: torch.where((x > 0) & ~(x >= 1) | (x < -1), x, 0.0) + (x == 0),
    "extremes": lambda x: torch.maximum(x, x.flip(-1)) + torch.minimum(x, 0 * x) + x.amax(-1, True) - x.amin(-1),
    "rounding": lambda x: torch.floor(x) + torch.ceil(3 * x) + torch.fmod(x, 0.7) + torch.remainder(x, 0.7),
    "sums": lambda x: x.sum(-1, keepdim=True) + x.mean() + x.prod(-1) + x.cumsum(-1) + torch.linalg.norm(x, dim=-1),
    "pieces": lambda x: torch.cat([x[..., 2:], x[..., :2]], -1) + x[..., [3, 1, 0, 2]] + x.roll(1, -1) + x.repeat(1, 1),
    "shapes": lambda x: x.view(1, 2, 2).mT.reshape(1, 4) + torch.stack(x.unbind(-1), -1) + x.T.expand(4, 4).sum(0),
    "in place": filled,
    "constants": lambda x: x + torch.arange(4.0) + torch.linspace(0, 1, 4) + torch.ones_like(x) + torch.full((4,), 2.0),
    "products": lambda x: x @ MASS + torch.einsum("ij,bj->bi", MASS, x) + torch.nn.functional.linear(x, MASS, MASS[0]),
    "outer": lambda x: (x[..., None] @ x[..., None, :]).flatten(1) + torch.diag_embed(x).flatten(1) + (x[0] @ x[0]),
    "matrices": lambda x: torch.linalg.solve(MASS + torch.diag_embed(x**2), x[..., None])[..., 0]
    + (torch.linalg.inv(MASS + x.mT @ x) @ x[0]) * torch.linalg.det(MASS + x.mT @ x),
    "row solve": lambda x: torch.linalg.solve(MASS + x.mT @ x, x, left=False) + torch.linalg.solve(MASS, x[0]),
    "cross": lambda x: torch.linalg.cross(x[..., :3], x[..., 1:]),
    "precision": lambda x: x.double().to(torch.float64) + x.detach().clone(),
}  # fmt: skip


@pytest.mark.parametrize("name", FUNCTIONS)
def test_operations_of_user_systems_are_translated(name):
    def function(x):
        return (FUNCTIONS[name](x),)

    x = torch.zeros(1, 4)
    result = translated(function, (x,))
    point = torch.tensor([[0.3, -0.8, 1.7, -2.2]])
    (value,) = result.call([point[0].numpy()])
    assert_close(torch.tensor(np.array(value)).flatten(), function(point)[0].flatten(), rtol=1e-10, atol=1e-10)


def test_a_wrong_rule_is_found():
    x = torch.zeros(1, 2)
    wrong = symbolic(traced(lambda x: (torch.sin(x),), (x,)), (x,))
    with pytest.raises(OracleError, match="off by"):
        require_equal(wrong, lambda x: (torch.sin(1.000001 * x),), (x,))


def test_an_operator_without_a_rule_is_named():
    x = torch.zeros(1, 2)
    with pytest.raises(OracleError, match=r"^Expected operations .*, got aten.special_bessel_j0.default; write it"):
        symbolic(traced(lambda x: (torch.special.bessel_j0(x),), (x,)), (x,))


class Drag(Cartpole):
    """A cartpole with a force that is computed past torch."""

    def forces(self, q, qdot):
        return super().forces(q, qdot) - torch.as_tensor(np.sin(qdot.detach().numpy()))


class Branch(Cartpole):
    """A cartpole whose code asks for its state."""

    def forces(self, q, qdot):
        return super().forces(q, qdot) * (2 if q[..., 0].sum() > 0 else 1)


@pytest.mark.parametrize(
    ("system", "message"), [(Drag(), "got a trace that is off by"), (Branch(), "that torch can trace")]
)
def test_a_system_past_torch_is_refused(system, message):
    weight = torch.eye(4)
    with pytest.raises(OracleError, match=message):
        oracle_of(system, QuadraticCost(weight, [[1.0]], weight), Horizon(5, 0.1))


# What users see


SMALL = ["horizon.steps=6", "network.hidden=[4]", "training.iterations=2", "training.validate_every=1",
         "evaluation.validation_states=4", "evaluation.test_states=4", "evaluation.figures_every=99"]  # fmt: skip


def train(folder, *arguments):
    return main(["train", "--config", str(CONF / "reacher.yaml"), *SMALL, f"logs={folder}", *arguments])


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """(folder, printed lines) of a short training on the reacher."""
    folder, printed = tmp_path_factory.mktemp("trained"), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        patch.setenv("LYAPNET_CACHE", str(folder / "cache"))
        patch.setattr(FigureLogger, "_draw", lambda *_: None)
        assert train(folder / "logs") == 0
    return folder / "logs" / "reacher" / "version_0", printed.getvalue()


@pytest.fixture
def run(trained, monkeypatch):
    """The folder of that training; drawing takes most of the time of another one."""
    monkeypatch.setattr(FigureLogger, "_draw", lambda *_: None)
    return trained[0]


@pytest.fixture
def without_casadi(monkeypatch):
    for name in ("lyapnet.oracles.transcription", "lyapnet.oracles.symbolic"):
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "casadi", None)


def evaluated(run, capsys, *arguments):
    capsys.readouterr()
    assert main(["evaluate", str(run / "checkpoints" / "best.ckpt"), "--samples", "5", *arguments]) == 0
    return capsys.readouterr().out


def test_evaluation_reports_the_optimum_of_a_nonlinear_task(run, capsys, tmp_path):
    files = ["--table", str(tmp_path / "states.csv"), "--figures", str(tmp_path / "figures")]
    result = json.loads(evaluated(run, capsys, "--json", *files))
    controller = load(run / "checkpoints" / "best.ckpt")
    measured = evaluation(controller, 5)
    oracle = oracle_of(controller.system, controller.cost, controller.horizon)
    optimal, V = oracle(measured.table.x0), controller.value(0.0, measured.table.x0)
    assert result["optimal_cost_mean"] == pytest.approx(float(optimal.mean()))
    assert result["cost_ratio"] == pytest.approx(
        float(controller.rollout(measured.table.x0).cost.mean() / optimal.mean())
    )
    assert result["value_error"] == pytest.approx(float((V - optimal).abs().mean() / optimal.mean()))
    assert result["cost_ratio"] > 1
    assert result["optimum_failures"] == 0
    rows = list(csv.DictReader((tmp_path / "states.csv").read_text(encoding="utf-8").splitlines()))
    assert [float(row["optimal_cost"]) for row in rows] == pytest.approx(optimal.tolist())
    assert [float(row["elbow angle (rad)"]) for row in rows] == pytest.approx(measured.table.x0[:, 1].tolist())
    assert (tmp_path / "figures" / "optimality.png").stat().st_size > 10_000


def test_failed_optima_are_left_out_and_counted(run, capsys, monkeypatch, tmp_path):
    controller = load(run / "checkpoints" / "best.ckpt")
    whole = evaluation(controller, 5)
    minimise, lost = Transcription._minimise, set(map(tuple, whole.table.x0[1:3].tolist()))

    def failing(self, x0, start):
        return "IPOPT: lost" if tuple(x0.tolist()) in lost else minimise(self, x0, start)

    monkeypatch.setenv("LYAPNET_CACHE", str(tmp_path / "another"))
    monkeypatch.setattr(Transcription, "_minimise", failing)
    result = json.loads(evaluated(run, capsys, "--json"))
    assert result["optimum_failures"] == 2
    kept = [0, 3, 4]
    assert result["optimal_cost_mean"] == pytest.approx(float(whole.table.optimal_cost[kept].mean()))
    ratio = whole.table.cost[kept].mean() / whole.table.optimal_cost[kept].mean()
    assert result["cost_ratio"] == pytest.approx(float(ratio))
    assert result["cost_mean"] == pytest.approx(float(whole.table.cost.mean()))
    assert "2 of 5 states have no optimum" in " ".join(evaluated(run, capsys).split())


@pytest.mark.usefixtures("without_casadi")
def test_without_casadi_the_rest_is_reported(run, capsys):
    assert json.loads(evaluated(run, capsys, "--json"))["optimal_cost_mean"] is None
    printed = " ".join(evaluated(run, capsys).split())
    assert "pip install 'lyapnet[oracle]'" in printed
    assert "cost J, mean" in printed


@pytest.mark.usefixtures("run", "without_casadi")
def test_without_casadi_a_training_goes_on(tmp_path, capsys):
    assert train(tmp_path / "logs") == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "no optimum to compare with: Expected CasADi" in printed
    assert printed.count("pip install 'lyapnet[oracle]'") == 2  # at the start, and below the table
    assert json.loads((tmp_path / "logs/reacher/version_0/evaluation.json").read_text())["cost_ratio"] is None


def test_a_training_is_compared_with_the_same_optimum_to_its_end(run, trained, capsys, tmp_path):
    def kept(folder):
        (cost,) = read_checkpoint(folder / "checkpoints" / "last.ckpt")["callbacks"]["ValidationOptimum"]["cost"]
        return cost

    assert "optimum of 4 validation states: mean" in trained[1]
    assert "cost/optimum" in trained[1]
    copy = tmp_path / "logs" / "reacher" / "version_0"
    shutil.copytree(run, copy)
    assert train(tmp_path / "logs", "training.iterations=3", "--resume", "last") == 0
    assert torch.equal(kept(copy), kept(run))
    assert "optimum of" not in capsys.readouterr().out


@pytest.mark.usefixtures("run")
def test_the_optimum_is_not_sought_where_it_is_not_wanted(tmp_path, capsys):
    assert train(tmp_path / "logs", "evaluation.optimum=false") == 0
    assert "optimum of" not in capsys.readouterr().out
    assert not (tmp_path / "cache" / "optima").exists()


def test_a_float32_task_is_solved_in_float64_and_left_as_it_is():
    """R as a method of the system that is copied: a copy in float64 does not keep the original's precision."""
    system = Reacher().float()
    cost = QuadraticCost(torch.eye(4), system.inverse_mass, torch.eye(4)).float()
    x0 = torch.tensor([[0.5, -0.5, 0.0, 0.0]])
    exact = Reacher()
    reference = QuadraticCost(torch.eye(4), exact.inverse_mass, torch.eye(4))
    horizon = Horizon(10, 0.05)
    ours = Transcription(system, cost, horizon)(x0)
    assert_close(ours, Transcription(exact, reference, horizon)(x0), rtol=1e-5, atol=0)
    assert system.B.dtype == torch.float32
