"""The jobs of a comparison: which there are, in what order, what is refused; their results and the time they take."""

import math
from pathlib import Path

import pytest

from lyapnet.base.errors import UsageError
from lyapnet.lab.comparison.plan import Job, begun_jobs, job_named, jobs_of, load_comparison
from lyapnet.lab.comparison.progress import duration, seconds_left
from lyapnet.lab.comparison.results import OURS, Result, with_common_optima

ROOT = Path(__file__).parents[3]
SMOKE, FULL = ROOT / "conf" / "compare_smoke.yaml", ROOT / "conf" / "compare.yaml"


@pytest.mark.gate
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
    assert [job.seed for job in jobs_of(comparison, methods=["lqr"], seeds=4)] == [0], "a planner draws nothing"
    with pytest.raises(UsageError, match="Expected sac_tuned under steps"):
        jobs_of(comparison, methods=["sac_tuned"])


def test_a_baseline_that_lost_its_steps_is_not_asked_for(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    written = tmp_path / "own.yaml"
    written.write_text(f"tasks: {{reacher: {{config: {ROOT / 'conf' / 'reacher.yaml'}, steps: {{ppo_tuned: 9}}}}}}")
    for method in ("ppo_tuned", "sac_tuned"):
        (tmp_path / "logs" / "compare" / "reacher" / method / "seed_0").mkdir(parents=True)
    assert [job.method for job in begun_jobs(load_comparison(written))] == ["ppo_tuned"]


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
    assert [duration(seconds) for seconds in (7, 184, 7500)] == ["7 s", "3 min 4 s", "2 h 5 min"]


def test_result_reads_what_it_wrote(tmp_path):
    result = Result("t", "m", 1, 5, 2.0, 0.5, [1.0], [100.0], [0.9], None, 0.25, 3, "c.ckpt", [])
    result.write(tmp_path / "result.json")
    assert Result.read(tmp_path / "result.json") == result
    known = with_common_optima([result, Result(**{**vars(result), "optima": [math.nan]})])
    assert [r.optima for r in known] == [[0.9], [0.9]]
    better = with_common_optima([result, Result(**{**vars(result), "optima": [0.8]})])
    assert [r.optima for r in better] == [[0.8], [0.8]]
