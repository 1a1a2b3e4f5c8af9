"""lyapnet bench: fields and types, errors that are rounding or not, memory of known tensors, refusals, figures."""

import json
from pathlib import Path

import pytest
import torch

from lyapnet import cli
from lyapnet.base.errors import CompilationError
from lyapnet.graphs.compilation import has_compiler
from lyapnet.lab import bench
from lyapnet.lab.bench.accuracy import reference_gradient, relative_error
from lyapnet.lab.bench.arithmetic import multiply_adds
from lyapnet.lab.bench.cases import flat
from lyapnet.lab.bench.measurement import peak_bytes

TINY = ["horizon.steps=10", "network.name=fcn", "network.hidden=[8]", "rollout.compile=off"]
TORCH_ROUTES = ("rollout", "adjoint", "adjoint-autograd", "backprop", "discrete")


@pytest.fixture(autouse=True)
def _in_the_project(monkeypatch):
    monkeypatch.chdir(Path(__file__).parents[3])
    monkeypatch.setenv("NPROC", "1")


@pytest.fixture
def run(capsys):
    """Arguments of a tiny benchmark ↦ (status, output, errors)."""

    def call(*arguments):
        status = cli.main(["bench", "--batch", "3", "--repeats", "1", *TINY, *arguments])
        return (status, *capsys.readouterr())

    return call


@pytest.fixture
def rows_of(run):
    """Arguments of a tiny benchmark ↦ its rows."""

    def call(*arguments):
        status, out, err = run("--json", *arguments)
        assert status == 0, err
        return json.loads(out)

    return call


def case_of(*overrides, task="double_integrator"):
    return bench.load_case(task, [*TINY, *overrides])


def rows_by_route(rows):
    return {row["route"]: row for row in rows}


@pytest.mark.gate
def test_json_is_a_list_of_objects_with_these_fields(rows_of):
    rows = rows_of("--routes", ",".join(TORCH_ROUTES))
    assert [row["route"] for row in rows] == list(TORCH_ROUTES)
    kinds = {
        "task": str, "states": int, "batch": int, "route": str, "compiled": bool, "dtype": str, "seconds": float,
        "steps_per_second": float, "peak_bytes": int, "peak_share": float,
    }  # fmt: skip
    for row in rows:
        assert row.keys() == {*kinds, "relative_error", "compile_seconds"}
        assert all(type(row[key]) is kind for key, kind in kinds.items())
        assert (row["task"], row["batch"], row["dtype"], row["compiled"]) == ("double_integrator", 3, "float64", False)
        assert row["steps_per_second"] == pytest.approx(3 * 10 / row["seconds"])
        assert row["compile_seconds"] is None
        assert (row["relative_error"] is None) == (row["route"] == "rollout")


@pytest.mark.gate
def test_discrete_is_exact_and_the_adjoint_is_not(rows_of):
    error = {route: row["relative_error"] for route, row in rows_by_route(rows_of("horizon.steps=5")).items()}
    assert error["backprop"] == 0
    assert error["discrete"] < 1e-12
    assert error["adjoint"] > 1e-6
    assert error["adjoint-autograd"] == pytest.approx(error["adjoint"], rel=1e-6)


def test_float32_is_measured_against_float64(rows_of):
    rows = rows_by_route(rows_of("--routes", "backprop,discrete", "training.precision=float32"))
    for row in rows.values():
        assert row["dtype"] == "float32"
        assert 1e-9 < row["relative_error"] < 1e-2


@pytest.mark.parametrize("name", ["double_integrator", "double_integrator_value", "cartpole_balancing", "reacher"])
def test_reference_in_slices_is_the_gradient_of_the_whole_batch(name, monkeypatch):
    case = case_of(task=name)
    x0 = case.sample(7)
    whole = flat(case.gradient(case.rollout("backprop"), x0))
    monkeypatch.setattr("lyapnet.lab.bench.accuracy.SLICE", 3)
    assert relative_error(reference_gradient(case, x0), whole) < 1e-12
    assert relative_error(reference_gradient(case, x0[:6]), whole) > 1e-3


@pytest.mark.parametrize(("hidden", "products"), [("8", 3 * 8 + 8), ("8,8", 3 * 8 + 8 * 8 + 8)])
def test_multiply_adds_of_a_network(hidden, products):
    """V and V_x at each of 10 steps, with the layers 3-8-1 and 3-8-8-1 for (t, x)."""
    case = case_of("network.name=fcn", f"network.hidden=[{hidden}]")
    assert multiply_adds(case) == 10 * 2 * products


def test_shares_of_the_peak_are_inverse_to_seconds(rows_of):
    """A gradient counts three times the arithmetic of its closed loop."""
    rows = rows_by_route(rows_of("--routes", "rollout,discrete"))
    loop, gradient = (rows[name]["peak_share"] * rows[name]["seconds"] for name in ("rollout", "discrete"))
    assert gradient == pytest.approx(3 * loop)
    assert 0 < rows["discrete"]["peak_share"] < 1


def test_peak_of_known_tensors():
    def call():
        first, second = torch.empty(1000), torch.empty(2000)
        del first
        return second, torch.empty(500)

    assert peak_bytes(call) == 8 * 3000
    assert peak_bytes(lambda: None) == 0


@pytest.mark.gate
def test_memory_of_backprop_grows_with_the_steps_and_exceeds_that_of_discrete():
    short, long = (
        {row.route: row.peak_bytes for row in bench.time_routes(case, 16, ["backprop", "discrete"], 1, print)}
        for case in (case_of(f"horizon.steps={steps}", "network.hidden=[32, 32]") for steps in (20, 80))
    )
    assert long["backprop"] > 3 * short["backprop"]
    assert long["backprop"] > 2 * long["discrete"]
    assert long["discrete"] < 3 * short["discrete"]


@pytest.mark.skipif(not has_compiler(), reason="needs a C++ compiler")
@pytest.mark.gate
def test_compiled_rows_come_after_the_eager_ones_unless_compilation_fails(monkeypatch):
    # machine code takes a minute to make: the traces stand in for it
    monkeypatch.setattr("lyapnet.loop.rollout.discrete_adjoint.DiscreteAdjoint.compile", lambda self, x0: None)
    case, said = case_of("rollout.compile=auto"), []
    rows = bench.time_routes(case, 3, ["rollout", "backprop", "discrete"], 1, said.append)
    assert [(row.route, row.compiled) for row in rows] == [
        ("rollout", False), ("backprop", False), ("discrete", False), ("rollout", True), ("discrete", True),
    ]  # fmt: skip
    assert [row.compile_seconds is not None for row in rows] == [row.compiled for row in rows]
    assert not said

    def fail(self, x0):
        raise CompilationError("Expected a closed loop to compile, got none")

    monkeypatch.setattr("lyapnet.loop.rollout.discrete_adjoint.DiscreteAdjoint.compile", fail)
    assert not any(row.compiled for row in bench.time_routes(case, 3, ["discrete"], 1, said.append))
    assert len(said) == 1


def test_without_a_compiler_a_notice_and_eager_rows(run, monkeypatch):
    for module in ("graphs.compilation", "bench.routes"):
        monkeypatch.setattr(f"lyapnet.{module}.has_compiler", lambda: False)
    status, out, err = run("--routes", "discrete", "--json", "rollout.compile=auto")
    assert status == 0
    assert len(err.strip().splitlines()) == 1
    assert [row["compiled"] for row in json.loads(out)] == [False]


@pytest.mark.gate
def test_table_names_every_route_and_batch(run):
    routes = ("adjoint", "adjoint-autograd", "backprop")
    status, out, _ = run(
        "--batch", "4", "--task", "double_integrator", "--task", "chain:3", "--routes", ",".join(routes)
    )
    assert status == 0
    assert "chain:3" in out
    for route in routes:
        rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in out.splitlines() if f" {route} " in line]
        assert [row[2] for row in rows] == ["3", "4"] * 2
        assert all(float(row[4]) > 0 for row in rows)  # times faster than adjoint-autograd


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (["--task", "pendulum"], "cartpole_balancing, cartpole_balancing_certified, cartpole_balancing_two_sided"),
        (["--task", "missing.yaml"], "missing.yaml"),
        (["--task", "chain:0"], "chain:8"),
        (["--routes", "discrete,quick"], "'quick'"),
        (["--routes", "discrete", "rollout.method=dopri5"], "dopri5"),
        (["--routes", "jax", "rollout.policy=sontag"], "JAX"),
        (["--batch", "0"], "'0'"),
        (["--batch", "12,many"], "'many'"),
        (["network.nam=fcn"], "network.name"),
        (["--repeats", "0"], "repeats"),
    ],
)
def test_what_cannot_be_measured_is_refused_in_one_line(run, arguments, what):
    status, out, err = run(*arguments)
    assert (status, out) == (2, "")
    assert what in err
    assert len(err.strip().splitlines()) == 1


def test_jax_is_left_out_where_it_is_not_installed(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    case = case_of()
    assert bench.routes_for(case) == list(TORCH_ROUTES)
    with pytest.raises(ValueError, match="not installed"):
        bench.routes_for(case, ["jax"])


def test_jax_rows_where_it_is_installed(rows_of):
    pytest.importorskip("jax")
    task = "conf/from_scratch/double_integrator_value.yaml"
    rows = rows_by_route(rows_of("--task", task, "--routes", "jax,jax-checkpoint,jax-rollout"))
    assert all(row["compiled"] and row["peak_bytes"] is None for row in rows.values())
    assert rows["jax"]["relative_error"] < 1e-9
    assert rows["jax-checkpoint"]["relative_error"] < 1e-9
    assert rows["jax-rollout"]["relative_error"] is None


def test_adaptive_method_has_a_floor_but_no_discrete_route(rows_of):
    dopri5 = "rollout.method=dopri5"
    assert bench.routes_for(case_of(dopri5))[:4] == ["rollout", "adjoint", "adjoint-autograd", "backprop"]
    assert "discrete" not in bench.routes_for(case_of(dopri5))
    (row,) = rows_of("--routes", "rollout", dopri5)
    assert row["relative_error"] is None


def test_chain_of_integrators_moves_its_last_state_by_its_control():
    system = case_of(task="chain:3").problem.system
    x, u = torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([[4.0]])
    assert system.dynamics(x, u).tolist() == [[2.0, 3.0, 4.0]]


@pytest.mark.gate
def test_accuracy_orders_of_convergence():
    by_route = {}
    for point in bench.gradient_accuracy(case_of("horizon.steps=40", "horizon.dt=0.02"), batch=2, halvings=2):
        by_route.setdefault((point.route, point.method), []).append(point)
    for method, order, stages in (("euler", 1, 1), ("rk4", 4, 4)):
        coarse, fine = by_route["discrete", method]  # twice the steps
        assert coarse.continuous_error / fine.continuous_error == pytest.approx(2**order, rel=0.3)
        assert max(coarse.discretisation_error, fine.discretisation_error) < 1e-12
        assert min(point.discretisation_error for point in by_route["adjoint", method]) > 1e-10
        forward = [10 * stages, 20 * stages]
        assert [point.evaluations for point in by_route["backprop", method]] == forward
        assert [point.evaluations for point in by_route["adjoint", method]] == [2 * count for count in forward]
    loose, *_, tight = by_route["adjoint", "dopri5"]
    assert tight.evaluations > loose.evaluations
    assert tight.continuous_error < loose.continuous_error


@pytest.mark.gate
def test_figures_are_written(run, tmp_path, monkeypatch):
    points = [bench.Accuracy("adjoint", "euler", 20, 1e-2, 1e-2), bench.Accuracy("backprop", "euler", 10, 0.0, 1e-2)]
    monkeypatch.setattr("lyapnet.lab.bench.gradient_accuracy", lambda case: points)
    folder = tmp_path / "new" / "figures"
    tasks = "double_integrator,chain:1,chain:2"
    status, _, err = run("--task", tasks, "--routes", "backprop", "--figures", str(folder))
    assert status == 0, err
    assert {path.stem for path in folder.iterdir()} == {
        "gradient_error", "gradient_time", "steps_per_second_against_n",
    }  # fmt: skip


def test_figure_folder_that_is_a_file_is_refused_before_anything_is_measured(run, tmp_path):
    file = tmp_path / "file"
    file.write_text("")
    status, out, err = run("--figures", str(file))
    assert (status, out) == (1, "")
    assert len(err.strip().splitlines()) == 1
