"""Jobs side by side, here and on Ray: what fails is told, what runs is stopped, and only a result counts."""

import socket
import sys
import time
from pathlib import Path

import pytest

from lyapnet.base.errors import UsageError
from lyapnet.lab.comparison import workers
from lyapnet.lab.comparison.workers import Runnable, run_jobs, run_process

FAILING = """
import os, sys
print("threads", os.environ["OMP_NUM_THREADS"], flush=True)
sys.exit("last words")
"""
WORKING = """
import os, pathlib
print("threads", os.environ["OMP_NUM_THREADS"], flush=True)
pathlib.Path("working", "result.json").write_text("{}")
"""


class Pretended(Runnable):
    """A Python script in the place of a training."""

    name, folder = "", Path()  # set below: a Runnable only asks that they are there

    def __init__(self, name, script):
        self.name, self.folder, self.script = name, Path(name), script

    @property
    def command(self):
        return [sys.executable, "-c", self.script]

    @property
    def finished(self):
        return (self.folder / "result.json").is_file()


@pytest.mark.parametrize("runner", ["local", pytest.param("ray", marks=pytest.mark.gate)])
def test_a_job_that_fails_is_told_and_the_others_go_on(runner, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    jobs = [Pretended("failing", FAILING), Pretended("working", WORKING)]
    begun = []
    if runner == "ray":
        pytest.importorskip("ray")
        monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[3]))  # where its workers find this module
    outcomes = list(run_jobs(jobs, 2, "local" if runner == "ray" else None, begun.append))
    assert {outcome.job.name: outcome.failure for outcome in outcomes} == {"failing": "last words", "working": ""}
    assert set(begun) == set(jobs)
    assert all("threads 1" in (job.folder / "job.log").read_text() for job in jobs)


@pytest.mark.parametrize("scheme", ["", "ray://"])
def test_a_cluster_that_is_not_there_is_told_at_once(scheme):
    pytest.importorskip("ray")
    with socket.create_server(("127.0.0.1", 0)) as server:  # a port that nobody listens on once it is closed
        address = f"{scheme}127.0.0.1:{server.getsockname()[1]}"
    with pytest.raises(UsageError, match="Connection refused; run ray start"):
        next(run_jobs([], 1, address))


@pytest.mark.parametrize(
    ("script", "words"),
    [
        ("print('saved')", "saved"),  # a training that was told to stop leaves with status 0, and without a result
        ("import os, signal; print('ratio 1.2'); os.kill(os.getpid(), signal.SIGKILL)", "stopped by SIGKILL"),
        ("import sys; sys.exit(3)", "stopped with status 3"),
    ],
)
def test_only_a_result_counts_as_success(script, words, monkeypatch, tmp_path):
    (tmp_path / "job.log").write_text("words of an earlier attempt\n")
    monkeypatch.chdir(tmp_path.parent)
    _, failure = run_process(Pretended(tmp_path.name, script))
    assert failure == words
    assert (tmp_path / "job.log").read_text().startswith("words of an earlier attempt")


def test_interrupting_stops_what_runs(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    jobs = [Pretended(name, "import time; time.sleep(60)") for name in ("one", "other")]
    started = time.monotonic()

    def interrupt(*_, **__):
        while len(list(tmp_path.rglob("job.log"))) < 2:
            time.sleep(0.01)
        raise KeyboardInterrupt

    monkeypatch.setattr(workers, "wait", interrupt)
    with pytest.raises(KeyboardInterrupt):
        list(run_jobs(jobs, 2))
    assert time.monotonic() - started < 30
