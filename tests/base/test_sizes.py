"""Sizes that cannot work: refused by an estimate, wherever they come from, and those that can let through."""

import pytest
import torch

import lyapnet
from lyapnet.base import sizes
from lyapnet.base.errors import CheckpointError, UsageError
from lyapnet.cli import main
from lyapnet.evaluation import evaluate
from lyapnet.experiment.checkpoint import read_checkpoint, write_checkpoint
from lyapnet.experiment.config import config_from_plain, to_plain
from lyapnet.training.plan import plan_run
from tests.problems import untrained

HUGE = ["network.hidden=[1000000000]", "network.hidden=[1000000,1000000]", "horizon.steps=10000000000000",
        "training.threads=1000000000000"]  # fmt: skip
HUGE_TO_TRAIN = ["seeds=10000000000000", "training.batch_size=10000000000000", "evaluation.test_states=10000000000000",
                 "evaluation.validation_states=10000000000000"]  # fmt: skip


@pytest.mark.parametrize("override", [*HUGE, *HUGE_TO_TRAIN])
def test_what_cannot_work_is_refused_before_a_folder_is_made(override, tmp_path, capsys):
    line = ["train", "--config", "conf/from_scratch/double_integrator.yaml", f"logs={tmp_path}", override]
    assert main(line) == 2
    key, (error,) = override.split("=")[0], capsys.readouterr().err.splitlines()
    assert error.startswith(f"error: Expected {key}")
    assert "threads" in key or "GB are free); " in error
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [("network", "hidden", [10**9, 10**9]), ("horizon", "steps", 10**13), ("training", "threads", 10**12)],
)
def test_a_checkpoint_is_refused_alike(section, key, value, tmp_path):
    content = read_checkpoint("tests/fixtures/version_0.1/certified/checkpoints/best.ckpt")
    content["lyapnet"]["config"][section][key] = value
    write_checkpoint(content, tmp_path / "huge.ckpt")
    with pytest.raises(CheckpointError, match=f"Expected {section}.{key}"):
        lyapnet.load(tmp_path / "huge.ckpt")


def test_samples_are_refused_before_they_are_drawn():
    controller = untrained("double_integrator")
    with pytest.raises(UsageError, match=r"samples that fits into memory, got 10000000000000 \(about"):
        evaluate(controller, samples=10**13)


def test_the_line_is_where_memory_ends(monkeypatch):
    """A twin: what fits is let through, and the same is refused where there is less."""
    plain = to_plain(untrained("double_integrator").config)
    plain["network"]["hidden"] = [1000, 1000]  # 8 MB of weights, twice
    monkeypatch.setattr(sizes, "free_memory", lambda: 17_000_000)
    assert config_from_plain(plain).network.hidden == [1000, 1000]
    monkeypatch.setattr(sizes, "free_memory", lambda: 15_000_000)
    with pytest.raises(UsageError, match=r"network\.hidden.*\(about 0\.016 GB, 0\.015 GB are free\)"):
        config_from_plain(plain)


def test_more_devices_than_fit_are_refused(monkeypatch, tmp_path):
    config = config_from_plain({**to_plain(untrained("double_integrator").config), "logs": str(tmp_path)})
    config.trainer = {"devices": 3}
    monkeypatch.setattr(sizes, "free_memory", lambda: 300_000_000)
    with pytest.raises(UsageError, match=r"trainer\.devices that fits into memory, got 3"):
        plan_run(config)
    config.trainer = {"devices": 2}
    assert plan_run(config).run.folder.is_dir()


def test_free_memory_is_known():
    assert 1e6 < sizes.free_memory() <= 2**63
    assert torch.get_num_threads() <= sizes.THREADS
