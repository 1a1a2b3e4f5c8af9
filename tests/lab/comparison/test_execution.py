"""What a job's folder was made for, also where version 0.1 made it."""

import json
from pathlib import Path

import pytest

from lyapnet.base.errors import UsageError
from lyapnet.experiment.config import to_plain
from lyapnet.lab.comparison.execution import require_same
from lyapnet.lab.comparison.plan import job_named, load_comparison

CONFIG = Path(__file__).parents[3] / "conf" / "compare_smoke.yaml"
NEW = ("controls", "loggers", "callbacks")  # sections that came since


@pytest.fixture(params=["lyapnet", "ppo_tuned"])
def record(request, tmp_path, monkeypatch):
    """(A job, its record as 0.1 wrote it, where it lies)."""
    monkeypatch.chdir(CONFIG.parents[1])
    job = job_named(load_comparison(CONFIG, [f"logs={tmp_path}"]), f"double_integrator/{request.param}/seed_0")
    config = {key: value for key, value in to_plain(job.config).items() if key not in NEW}
    config["cost"] = {key: config["cost"][key] for key in ("Q", "R", "Q_T")}
    del config["program"]["parameters"]
    comparison = job.comparison
    content = {
        "evaluation": [comparison.evaluation_states, comparison.evaluation_seed],
        "control_scale": list(job.bounded.control_scale),
    }
    if request.param == "lyapnet":
        content["config"] = {**config, "logs": ""}
    else:
        task = [config[key] for key in ("system", "cost", "initial_states", "horizon")]
        content |= {"task": task, **job.baseline.description}
    job.folder.mkdir(parents=True)
    return job, content, job.folder / "job.json"


def test_a_record_of_version_0_1_is_that_of_the_same_job(record):
    job, content, path = record
    path.write_text(json.dumps(content))
    require_same(job)


def test_a_record_of_another_cost_is_refused(record):
    job, content, path = record
    cost = content["config"]["cost"] if "config" in content else content["task"][1]
    cost["Q"] = [11, 0.1]
    path.write_text(json.dumps(content))
    with pytest.raises(UsageError, match="as it was begun, got"):
        require_same(job)
