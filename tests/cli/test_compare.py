"""lyapnet compare as a user starts it: jobs run once, a killed one goes on, all are measured alike and reported."""

import csv
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console

import lyapnet
from lyapnet.base.errors import OracleError
from lyapnet.cli import main
from lyapnet.cli.compare import print_missing_optima
from lyapnet.evaluation.measurement import evaluate
from lyapnet.lab.comparison.plan import jobs_of, load_comparison
from lyapnet.lab.comparison.results import LEARNED, OURS, Result, with_common_optima

ROOT = Path(__file__).parents[2]
SMOKE = ROOT / "conf" / "compare_smoke.yaml"
SOME = ["--tasks", "double_integrator", "--methods", "lyapnet,ppo_tuned"]  # test_the_whole_comparison has all of them


@pytest.fixture(scope="module")
def smoke(tmp_path_factory):
    """A comparison of two methods on a task, from a process of its own: its folder and output."""
    folder = tmp_path_factory.mktemp("smoke")
    (folder / "conf").symlink_to(ROOT / "conf")
    return folder, compared(folder, *SOME, "--workers", "2")


def compared(folder, *arguments):
    """What `lyapnet compare --config conf/compare_smoke.yaml` says."""
    command = [sys.executable, "-m", "lyapnet", "compare", "--config", "conf/compare_smoke.yaml", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=600)


def results_of(folder):
    return [Result.read(path) for path in sorted((folder / "logs" / "compare_smoke").rglob("result.json"))]


def require_complete(folder, said, tasks, methods, unclipped):
    """Every method is trained on every task, and all are measured on the same states at their own cost."""
    assert said.returncode == 0, said.stderr
    results = results_of(folder)
    assert {(r.task, r.method) for r in results} == {(t, m) for t in tasks for m in methods}
    count = len(tasks) * len(methods)
    assert f"{count}/{count}" in said.stdout
    assert "left" in said.stdout
    for result in results:
        assert len(result.costs) == len(result.sums) == len(result.optima or ()) == 8
        assert result.curve[0].environment_steps == 0
        assert result.environment_steps == result.curve[-1].environment_steps > 0
        assert 0 < result.seconds < 60
        assert (result.constraint_loss is None) == (result.method != OURS)
        assert all(cost > 0.999 * best for cost, best in zip(result.costs, result.optima or (), strict=True))
    optima, within = {}, 0
    for result in with_common_optima(results):
        assert optima.setdefault(result.task, result.optima) == result.optima
        if result.method == OURS and not result.clipped_fraction:
            within += 1
            found = evaluate(lyapnet.load(folder / result.checkpoint), 8, 0, optimum=False)
            assert sum(result.costs) / 8 == pytest.approx(found["cost_mean"], rel=1e-9)
            assert result.constraint_loss == pytest.approx(found["constraint_loss"], rel=1e-6)
    assert within == unclipped


@pytest.mark.gate
def test_every_method_is_trained_and_measured_alike(smoke):
    require_complete(*smoke, ["double_integrator"], [OURS, "ppo_tuned"], unclipped=1)


@pytest.mark.nightly
def test_the_whole_comparison(tmp_path):
    (tmp_path / "conf").symlink_to(ROOT / "conf")
    tasks = load_comparison(SMOKE).tasks
    # four steps of training leave swing-up beyond its box
    require_complete(tmp_path, compared(tmp_path, "--workers", "2"), tasks, LEARNED, unclipped=3)


@pytest.mark.gate
def test_planners_stand_beside_what_learns(smoke, compare):
    status, out, err = compare("--tasks", "double_integrator", "--methods", "lqr,mpc_100", "--workers", "2")
    assert status == 0, err
    for name in ("LQR", "MPC (100 %)", "lyapnet", "PPO (tuned)"):
        assert name in out
    by_method = {result.method: result for result in results_of(smoke[0])}
    for method in ("lqr", "mpc_100"):
        result = by_method[method]
        assert result.costs == pytest.approx(result.optima, rel=1e-6), "a linear task within its box"
        assert result.times
        assert 0 < result.times.median <= result.times.most
        assert not result.curve
    assert by_method["lyapnet"].times
    report = smoke[0] / "logs" / "compare_smoke" / "report"
    rows = (report / "alternatives.csv").read_text().splitlines()
    assert len(rows) == 1 + len(by_method)
    assert "## Costs" in (report / "report.md").read_text(encoding="utf-8")


@pytest.fixture
def compare(smoke, monkeypatch, capsys):
    """Arguments of the same comparison, in this process ↦ (status, output, errors)."""
    monkeypatch.chdir(smoke[0])

    def run(*arguments):
        capsys.readouterr()
        return (main(["compare", "--config", "conf/compare_smoke.yaml", *arguments]), *capsys.readouterr())

    return run


@pytest.mark.gate
def test_the_same_command_again_trains_nothing(smoke, compare):
    before = {path: path.stat().st_mtime_ns for path in (smoke[0] / "logs").rglob("result.json")}
    status, out, err = compare(*SOME)
    assert status == 0, err
    assert not re.search(r"\b2 jobs", out)
    assert before
    assert before == {path: path.stat().st_mtime_ns for path in before}


@pytest.mark.gate
@pytest.mark.parametrize(
    ("change", "named", "report"),
    [
        ("tasks.double_integrator.hidden=[5]", "hidden = [5] instead of [16]", []),
        ("evaluation_seed=7", "evaluation", ["--report"]),
    ],
)
def test_another_config_is_not_taken_for_the_same(change, named, report, compare):
    status, _, err = compare(change, *report)
    assert status == 2
    assert named in err
    assert len(err.strip().splitlines()) == 1


@pytest.mark.gate
def test_seeds_beyond_the_config_are_reported(smoke, compare):
    tasks = "double_integrator,double_integrator"
    status, out, err = compare("--tasks", tasks, "--methods", "ppo_tuned", "--seeds", "2")
    assert status == 0, err
    assert "2/2" in out
    with (smoke[0] / "logs" / "compare_smoke" / "report" / "results.csv").open(newline="") as file:
        rows = [(row["task"], row["method"], row["seed"]) for row in csv.DictReader(file)]
    assert [seed for _, method, seed in rows if method == "ppo_tuned"] == ["0", "1"]
    assert [seed for _, method, seed in rows if method == "lyapnet"] == ["0"]


@pytest.mark.nightly
def test_a_killed_job_goes_on(tmp_path):
    """Without the comparison around it; that of test_a_killed_comparison_goes_on is continued in the same way."""
    (tmp_path / "conf").symlink_to(ROOT / "conf")
    longer = "tasks.double_integrator.steps.ppo_tuned=15000"
    folder = tmp_path / "logs" / "compare_smoke" / "double_integrator" / "ppo_tuned" / "seed_0"
    chosen = [longer, "--job", "double_integrator/ppo_tuned/seed_0"]
    process = started(tmp_path, folder, *chosen)
    process.kill()
    process.wait()
    kept = steps_kept(folder)
    assert 0 < kept < 15_000, "it was killed on its way"
    said = compared(tmp_path, *chosen)
    assert said.returncode == 0, said.stderr
    steps = [int(line.split("/")[0]) for line in said.stdout.splitlines() if "/15000" in line]
    assert steps[0] > kept, "it went on"
    assert Result.read(folder / "result.json").environment_steps >= 15_000


def started(place, folder, *arguments):
    """A `lyapnet compare` whose job has begun to train."""
    command = [sys.executable, "-m", "lyapnet", "compare", "--config", "conf/compare_smoke.yaml", *arguments]
    process = subprocess.Popen(command, cwd=place, start_new_session=True)
    deadline = time.monotonic() + 120
    while not list((folder / "checkpoints").glob("step_[1-9]*")) and time.monotonic() < deadline:
        time.sleep(0.05)
    return process


def steps_kept(folder):
    """Environment steps of the last checkpoint."""
    return max(int(path.name[5:]) for path in (folder / "checkpoints").glob("step_*"))


@pytest.mark.gate
@pytest.mark.parametrize(("killed", "length"), [("all of it", 15_000), ("the parent alone", 30_000)])
def test_a_killed_comparison_goes_on(killed, length, tmp_path):
    (tmp_path / "conf").symlink_to(ROOT / "conf")
    chosen = ["--tasks", "double_integrator", "--methods", "ppo_tuned", "--workers", "1"]
    chosen += [f"tasks.double_integrator.steps.ppo_tuned={length}"]
    job = tmp_path / "logs" / "compare_smoke" / "double_integrator" / "ppo_tuned" / "seed_0"
    process = started(tmp_path, job, *chosen)
    if killed == "all of it":
        os.killpg(process.pid, signal.SIGKILL)
    else:  # its job goes on, and the next command waits for it
        process.kill()
    process.wait()
    assert 0 < steps_kept(job) < length, "it was killed on its way"
    said = compared(tmp_path, *chosen)
    assert said.returncode == 0, said.stderr
    assert "1/1" in said.stdout
    steps = [line.split("/")[0] for line in (job / "job.log").read_text().splitlines() if f"/{length}" in line]
    assert steps[0] == "0"
    assert len(steps) <= len(set(steps)) + 1, "it went on, and two did not train at once"
    assert Result.read(job / "result.json").environment_steps >= length


@pytest.mark.gate
def test_costs_without_their_optimum_are_told_before_anything_is_trained(monkeypatch, capsys):
    jobs = jobs_of(load_comparison(SMOKE), ["reacher", "double_integrator"], ["ppo_tuned"])
    print_missing_optima(jobs, Console())
    assert not capsys.readouterr().out

    def none(*_):
        raise OracleError("Expected an oracle.")

    monkeypatch.setattr("lyapnet.lab.comparison.scoring.oracle_of", none)
    print_missing_optima(jobs, Console())
    said = capsys.readouterr().out.splitlines()
    assert said == [
        f"{task}: cost without its optimum. Expected an oracle." for task in ("reacher", "double_integrator")
    ]


def test_command_says_in_one_line_what_is_wrong(capsys):
    assert main(["compare"]) == 2
    assert "--config PATH" in capsys.readouterr().err
    assert main(["compare", "--config", str(SMOKE), "--job", "reacher"]) == 2
    assert "--job among" in capsys.readouterr().err
    assert main(["compare", "--config", str(SMOKE), "--job", "reacher/lyapnet/seed_x"]) == 2
    assert "task/method/seed_k" in capsys.readouterr().err


@pytest.mark.gate
def test_a_run_without_metrics_is_told_in_one_line(smoke, compare):
    """As a run of lyapnet 0.1, whose curves were in event files alone."""
    job = smoke[0] / "logs" / "compare_smoke" / "double_integrator" / "lyapnet" / "seed_0"
    metrics, result = job / "version_0" / "metrics.csv", job / "result.json"
    kept = {path: path.read_bytes() for path in (metrics, result)}
    metrics.unlink()
    result.unlink()
    try:
        status, _, err = compare("--job", "double_integrator/lyapnet/seed_0")
        assert status == 1
        assert err.startswith("error: Expected the validations of")
        assert "metrics.csv, got none; lyapnet 0.1" in err
        assert len(err.strip().splitlines()) == 1
    finally:
        for path, content in kept.items():
            path.write_bytes(content)
