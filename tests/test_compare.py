"""lyapnet compare: its jobs, each run once, in processes or on Ray; a killed one goes on; all measured alike."""

import csv
import math
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console

import lyapnet
from lyapnet.cli import main
from lyapnet.comparison import workers
from lyapnet.comparison.command import _tell_of_optima
from lyapnet.comparison.plan import METHODS, OURS, Job, begun_jobs, job_named, jobs_of, load_comparison
from lyapnet.comparison.results import Result, with_common_optima
from lyapnet.comparison.workers import run_locally, run_on_ray, run_process, seconds_left
from lyapnet.errors import OracleError, UsageError
from lyapnet.evaluation import evaluate

ROOT = Path(__file__).parents[1]
SMOKE, FULL = ROOT / "conf" / "compare_smoke.yaml", ROOT / "conf" / "compare.yaml"


@pytest.fixture(scope="module")
def smoke(tmp_path_factory):
    """The whole comparison in two minutes, from a process of its own, as a user starts it: its folder and output."""
    folder = tmp_path_factory.mktemp("smoke")
    (folder / "conf").symlink_to(ROOT / "conf")
    return folder, compared(folder, "--workers", "2")


def compared(folder, *arguments):
    """What `lyapnet compare --config conf/compare_smoke.yaml` says."""
    command = [sys.executable, "-m", "lyapnet", "compare", "--config", "conf/compare_smoke.yaml", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=600)


def results_of(folder):
    return [Result.read(path) for path in sorted((folder / "logs" / "compare_smoke").rglob("result.json"))]


def test_every_method_is_trained_on_every_task(smoke):
    folder, said = smoke
    assert said.returncode == 0, said.stderr
    results = results_of(folder)
    assert {(r.task, r.method) for r in results} == {(t, m) for t in load_comparison(SMOKE).tasks for m in METHODS}
    assert "20/20" in said.stdout
    assert "left" in said.stdout
    for result in results:
        assert len(result.costs) == len(result.sums) == len(result.optima or ()) == 8
        assert result.curve[0].environment_steps == 0
        assert result.environment_steps == result.curve[-1].environment_steps > 0
        assert 0 < result.seconds < 60
        assert (result.constraint_loss is None) == (result.method != OURS)
        assert all(cost > 0.999 * best for cost, best in zip(result.costs, result.optima or (), strict=True))


def test_all_are_measured_on_the_same_states_at_their_own_cost(smoke):
    folder, _ = smoke
    optima, unclipped = {}, 0
    for result in with_common_optima(results_of(folder)):
        assert optima.setdefault(result.task, result.optima) == result.optima
        if result.method == OURS and not result.clipped_fraction:
            unclipped += 1
            found = evaluate(lyapnet.load(folder / result.checkpoint), 8, 0, optimum=False)
            assert sum(result.costs) / 8 == pytest.approx(found["cost_mean"], rel=1e-9)
            assert result.constraint_loss == pytest.approx(found["constraint_loss"], rel=1e-6)
    assert unclipped == 3, "four steps of training leave swing-up beyond its box"


def test_the_same_command_again_trains_nothing(smoke):
    folder, _ = smoke
    before = {path: path.stat().st_mtime_ns for path in (folder / "logs").rglob("result.json")}
    said = compared(folder)
    assert said.returncode == 0, said.stderr
    assert before == {path: path.stat().st_mtime_ns for path in before}


def test_another_config_is_not_taken_for_the_same(smoke):
    folder, _ = smoke
    for change, named in (
        ("tasks.double_integrator.hidden=[5]", "hidden = [5] instead of [16]"),
        ("evaluation_seed=7", "evaluation"),
    ):
        for report in ([], ["--report"]):
            said = compared(folder, change, *report)
            assert said.returncode == 2
            assert named in said.stderr
            assert len(said.stderr.strip().splitlines()) == 1


def test_seeds_beyond_the_config_are_reported(smoke):
    folder, _ = smoke
    said = compared(folder, "--tasks", "reacher,reacher", "--methods", "ppo_tuned", "--seeds", "2")
    assert said.returncode == 0, said.stderr
    assert "2/2" in said.stdout
    with (folder / "logs" / "compare_smoke" / "report" / "results.csv").open(newline="") as file:
        rows = [(row["task"], row["method"], row["seed"]) for row in csv.DictReader(file)]
    assert ("reacher", "ppo_tuned", "1") in rows
    assert len(rows) == 21


@pytest.mark.parametrize("killed", ["all of it", "the parent alone"])
def test_a_killed_comparison_goes_on(killed, tmp_path):
    (tmp_path / "conf").symlink_to(ROOT / "conf")
    chosen = ["--tasks", "double_integrator", "--methods", "ppo_tuned", "--workers", "1"]
    chosen += ["tasks.double_integrator.steps.ppo_tuned=60000"]
    job = tmp_path / "logs" / "compare_smoke" / "double_integrator" / "ppo_tuned" / "seed_0"
    command = [sys.executable, "-m", "lyapnet", "compare", "--config", "conf/compare_smoke.yaml", *chosen]
    process = subprocess.Popen(command, cwd=tmp_path, start_new_session=True)
    deadline = time.monotonic() + 120
    while not list((job / "checkpoints").glob("step_[1-9]*")) and time.monotonic() < deadline:
        time.sleep(0.05)
    if killed == "all of it":
        os.killpg(process.pid, signal.SIGKILL)
    else:  # its job goes on, and the next command waits for it
        process.kill()
    process.wait()
    kept = max(int(path.name[5:]) for path in (job / "checkpoints").glob("step_*"))
    assert 0 < kept < 60_000, "it was killed on its way"
    said = compared(tmp_path, *chosen)
    assert said.returncode == 0, said.stderr
    assert "1/1" in said.stdout
    steps = [line.split("/")[0] for line in (job / "job.log").read_text().splitlines() if "/60000" in line]
    assert steps[0] == "0"
    assert len(steps) <= len(set(steps)) + 1, "it went on, and two did not train at once"
    assert Result.read(job / "result.json").environment_steps >= 60_000


def test_jobs_go_seed_by_seed_and_are_as_many_as_asked_for():
    comparison = load_comparison(FULL)
    jobs = jobs_of(comparison)
    assert len(jobs) == 4 * (5 + 4 * 3)
    assert [job.seed for job in jobs] == sorted(job.seed for job in jobs)
    some = jobs_of(comparison, ["reacher"], ["lyapnet", "sac_paper"], 2)
    assert [job.name for job in some] == [f"reacher/{m}/seed_{k}" for k in (0, 1) for m in ("lyapnet", "sac_paper")]
    assert job_named(comparison, some[-1].name).folder == some[-1].folder


def test_a_baseline_without_steps_is_not_compared(tmp_path):
    written = tmp_path / "own.yaml"
    written.write_text(f"tasks: {{reacher: {{config: {ROOT / 'conf' / 'reacher.yaml'}, steps: {{ppo_tuned: 9}}}}}}")
    comparison = load_comparison(written)
    assert {job.method for job in jobs_of(comparison)} == {OURS, "ppo_tuned"}
    with pytest.raises(UsageError, match="Expected sac_tuned under steps"):
        jobs_of(comparison, methods=["sac_tuned"])


def test_a_baseline_that_lost_its_steps_is_not_asked_for(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    written = tmp_path / "own.yaml"
    written.write_text(f"tasks: {{reacher: {{config: {ROOT / 'conf' / 'reacher.yaml'}, steps: {{ppo_tuned: 9}}}}}}")
    for method in ("ppo_tuned", "sac_tuned"):
        (tmp_path / "logs" / "compare" / "reacher" / method / "seed_0").mkdir(parents=True)
    assert [job.method for job in begun_jobs(load_comparison(written))] == ["ppo_tuned"]


def test_costs_without_their_optimum_are_told_before_anything_is_trained(monkeypatch, capsys):
    jobs = jobs_of(load_comparison(SMOKE), ["reacher", "double_integrator"], ["ppo_tuned"])
    _tell_of_optima(jobs, Console())
    assert not capsys.readouterr().out

    def none(*_):
        raise OracleError("Expected an oracle.")

    monkeypatch.setattr("lyapnet.baselines.rl.oracle_of", none)
    _tell_of_optima(jobs, Console())
    said = capsys.readouterr().out.splitlines()
    assert said == [
        f"{task}: cost without its optimum. Expected an oracle." for task in ("reacher", "double_integrator")
    ]


def test_baselines_have_the_networks_and_the_task_of_the_comparison():
    jobs = {job.name: job for job in jobs_of(load_comparison(FULL))}
    baseline = jobs["cartpole_balancing/ppo_paper/seed_2"].baseline
    assert (baseline.hidden, baseline.seed) == ([200, 500], 2)
    assert baseline.bounded.control_scale == (20.0,)
    assert (baseline.validations, jobs["double_integrator/sac_tuned/seed_0"].baseline.validations) == (40, 200)
    assert jobs["double_integrator/ppo_paper/seed_0"].baseline.options["learning_rate"] == 3e-5
    assert "learning_rate" not in jobs["reacher/ppo_paper/seed_0"].baseline.options


@pytest.mark.parametrize(
    ("overrides", "tasks", "methods", "named"),
    [
        ([], ["reachr"], None, "--tasks among"),
        ([], None, ["ppo"], "--methods among"),
        ([], None, ["ppo_tund"], "did you mean ppo_tuned"),
        (["tasks.reacher.steps.ppo_paper=many"], None, None, "as another type, got: Value 'many'"),
        (["methods=[ppo]"], None, None, "methods among"),
        (["seedz=3"], None, None, "did you mean seeds"),
        (["seeds=0"], None, None, "seeds ≥ 1"),
        (["methods=[]"], None, None, "at least one of"),
        (["tasks.reacher.options.ppo_paper=3"], None, None, "section of options"),
        (["tasks.reacher.options.ppo_paper.learnig_rate=3"], None, None, "did you mean learning_rate"),
        (["tasks.reacher.stepz=3"], None, None, "tasks.reacher.steps"),
        (["tasks.reacher.steps.ppo=3"], None, None, "tasks.reacher.steps among"),
        (["tasks.reacher.steps.ppo_paper=0"], None, None, "tasks.reacher.steps.ppo_paper ≥ 1"),
        (["tasks.reacher.validations.ppo_paper=0"], None, None, "tasks.reacher.validations.ppo_paper ≥ 1"),
        (["tasks.reacher.validations.ppo=3"], None, None, "tasks.reacher.validations among"),
        (["tasks.reacher.control_scale=[1]"], None, None, "each of"),
        (["tasks.reacher.config=nowhere.yaml"], None, None, "config file"),
    ],
)
def test_impossible_comparison_is_refused_before_anything_is_trained(overrides, tasks, methods, named):
    with pytest.raises(UsageError, match=named):
        jobs_of(load_comparison(SMOKE, overrides), tasks, methods)


def test_command_says_in_one_line_what_is_wrong(capsys):
    assert main(["compare"]) == 2
    assert "--config PATH" in capsys.readouterr().err
    assert main(["compare", "--config", str(SMOKE), "--job", "reacher"]) == 2
    assert "--job among" in capsys.readouterr().err
    assert main(["compare", "--config", str(SMOKE), "--job", "reacher/lyapnet/seed_x"]) == 2
    assert "task/method/seed_k" in capsys.readouterr().err


def pretended(monkeypatch, tmp_path, script):
    """Two jobs, and a command that runs a Python script in the place of a training."""
    comparison = load_comparison(SMOKE)
    (tmp_path / "conf").symlink_to(ROOT / "conf")
    monkeypatch.chdir(tmp_path)
    jobs = jobs_of(comparison, ["reacher", "double_integrator"], ["ppo_tuned"])
    return jobs, [sys.executable, "-c", script]


FAILING = """
import os, pathlib, sys
print("threads", os.environ["OMP_NUM_THREADS"], flush=True)
if "reacher" in sys.argv[1]:
    sys.exit("last words")
(pathlib.Path("logs") / "compare_smoke" / sys.argv[1] / "result.json").write_text("{}")
"""


@pytest.mark.parametrize("runner", ["local", "ray"])
def test_a_job_that_fails_is_told_and_the_others_go_on(runner, monkeypatch, tmp_path):
    jobs, command = pretended(monkeypatch, tmp_path, FAILING)
    begun = []
    if runner == "local":
        outcomes = list(run_locally(jobs, command, 2, begun.append))
    else:
        pytest.importorskip("ray")
        outcomes = list(run_on_ray(jobs, command, "local", begun.append))
    assert {outcome.job.task: outcome.failure for outcome in outcomes} == {
        "reacher": "last words", "double_integrator": "",
    }  # fmt: skip
    assert set(begun) == set(jobs)
    assert all("threads 1" in (job.folder / "job.log").read_text() for job in jobs)


@pytest.mark.parametrize("scheme", ["", "ray://"])
def test_a_cluster_that_is_not_there_is_told_at_once(scheme):
    pytest.importorskip("ray")
    with socket.create_server(("127.0.0.1", 0)) as server:  # a port that nobody listens on once it is closed
        address = f"{scheme}127.0.0.1:{server.getsockname()[1]}"
    with pytest.raises(UsageError, match="Connection refused; run ray start"):
        next(run_on_ray([], [], address, print))


@pytest.mark.parametrize(
    ("script", "words"),
    [
        ("print('saved')", "saved"),  # a training that was told to stop leaves with status 0, and without a result
        ("import os, signal; print('ratio 1.2'); os.kill(os.getpid(), signal.SIGKILL)", "stopped by SIGKILL"),
        ("import sys; sys.exit(3)", "stopped with status 3"),
    ],
)
def test_only_a_result_counts_as_success(script, words, tmp_path):
    (tmp_path / "job.log").write_text("words of an earlier attempt\n")
    _, failure = run_process([sys.executable, "-c", script], tmp_path)
    assert failure == words
    assert (tmp_path / "job.log").read_text().startswith("words of an earlier attempt")


def test_interrupting_stops_what_runs(monkeypatch, tmp_path):
    jobs, command = pretended(monkeypatch, tmp_path, "import time; time.sleep(60)")
    started = time.monotonic()

    def interrupt(*_, **__):
        while len(list(tmp_path.rglob("job.log"))) < 2:
            time.sleep(0.01)
        raise KeyboardInterrupt

    monkeypatch.setattr(workers, "wait", interrupt)
    with pytest.raises(KeyboardInterrupt):
        list(run_locally(jobs, command, 2, lambda job: None))
    assert time.monotonic() - started < 30


def test_time_left_is_that_of_jobs_alike():
    comparison = load_comparison(FULL)
    ours, ppo, other = (Job(comparison, "reacher", m, 0) for m in ("lyapnet", "ppo_paper", "sac_paper"))
    again = Job(comparison, "reacher", "lyapnet", 1)
    elsewhere = Job(comparison, "double_integrator", "lyapnet", 0)
    assert seconds_left([ours], {}, {}, 1) is None
    assert seconds_left([ours, again, elsewhere], {}, {ours: 10.0}, 2) == pytest.approx(10)
    assert seconds_left([ours, again], {again: 4.0}, {ours: 10.0}, 1) == pytest.approx(6)
    assert seconds_left([ours, again], {again: 40.0}, {ours: 10.0}, 1) == 0
    assert seconds_left([ours, ppo, other], {}, {ours: 10.0, ppo: 30.0}, 1) == pytest.approx(20)


def test_result_reads_what_it_wrote(tmp_path):
    result = Result("t", "m", 1, 5, 2.0, 0.5, [1.0], [100.0], [0.9], None, 0.25, 3, "c.ckpt", [])
    result.write(tmp_path / "result.json")
    assert Result.read(tmp_path / "result.json") == result
    known = with_common_optima([result, Result(**{**vars(result), "optima": [math.nan]})])
    assert [r.optima for r in known] == [[0.9], [0.9]]
    better = with_common_optima([result, Result(**{**vars(result), "optima": [0.8]})])
    assert [r.optima for r in better] == [[0.8], [0.8]]
