"""Baselines: what SB3 is asked for, that it learns, and that a training which was stopped goes on as if it had not."""

import json
import os
import pickle
import shutil
import textwrap
import time
import zipfile

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.vec_env import VecNormalize
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from lyapnet.base.errors import LyapnetError, UsageError
from lyapnet.lab.comparison.baselines.baseline import Baseline
from lyapnet.lab.comparison.baselines.checkpoints import best_checkpoint, checkpoints
from lyapnet.lab.comparison.baselines.settings import SETTINGS
from lyapnet.lab.comparison.baselines.training import BaselineTraining, _logger, best_policy
from lyapnet.lab.comparison.reference_problems import bounded_problem
from lyapnet.lab.comparison.scoring import costs_of
from lyapnet.task.horizon import Horizon

SMALL = {
    "ppo": {"n_steps": 6, "batch_size": 24, "n_epochs": 2},
    "sac": {"batch_size": 8, "learning_starts": 30, "buffer_size": 600, "train_freq": 4, "gradient_steps": 4},
}  # fmt: skip
pytestmark = [
    pytest.mark.filterwarnings("ignore:You have specified a mini-batch size"),
    pytest.mark.filterwarnings("ignore:.*n_steps=.* is ignored because a custom"),  # SB3 on loading its own buffer
]


@pytest.fixture(autouse=True)
def _float32(_float64_and_seeded):
    """SB3 builds its networks in torch's default precision and feeds them float32."""
    torch.set_default_dtype(torch.float32)


def baseline_of(method, steps, seed=0, **options):
    """A baseline on six steps of the double integrator."""
    problem = bounded_problem("double_integrator").problem.replaced(horizon=Horizon(6, 0.1))
    return Baseline(bounded_problem(problem, [6.0]), method, seed, steps, [8], {**SMALL[method[:3]], **options})


def curve(folder, tag):
    """(step, value) of a scalar in TensorBoard's files, in the order of logging."""
    logged = EventAccumulator(str(folder), {"scalars": 0}).Reload()
    return [(event.step, event.value) for event in logged.Scalars(tag)]


def trained(folder, baseline, pieces=None):
    """A training, or its first pieces."""
    training = BaselineTraining(baseline, folder)
    heard = []

    def report(point):
        heard.append(point)
        if pieces is not None and len(heard) > pieces:
            raise KeyboardInterrupt

    training.run(report)
    return training


@pytest.mark.parametrize("method", SETTINGS)
def test_training_leaves_curves_and_a_model_that_sb3_loads(method, tmp_path):
    baseline = baseline_of(method, 1200)
    training = trained(tmp_path, baseline)
    steps = [point.environment_steps for point in training.curve]
    assert steps[0] == 0
    assert steps[-1] >= 1200
    whole = 6 if method.startswith("ppo") else 4
    assert {step % (baseline.setting.environments * whole) for step in steps} == {0}, "no rollout is cut"
    assert [step for step, _ in curve(tmp_path, "trajectory_cost/val")] == steps
    costs = [value for _, value in curve(tmp_path, "trajectory_cost/val")]
    np.testing.assert_allclose(costs, [point.cost for point in training.curve], rtol=1e-6)
    assert curve(tmp_path, "optimality_gap/val")
    best = best_checkpoint(tmp_path)
    assert best.step == steps[int(np.argmin(costs))]
    model = {"ppo": PPO, "sac": SAC}[method[:3]].load(best.folder / "model.zip")
    assert model.policy.net_arch == [8]
    path, policy = best_policy(baseline, tmp_path)
    measured = costs_of(policy, baseline.bounded, baseline.setting.observe_time, training.states)
    assert path == best.folder / "model.zip"
    assert float(measured.cost.mean()) == pytest.approx(min(costs), rel=1e-5), "the best one is what is measured"
    assert len(list((tmp_path / "checkpoints").iterdir())) <= 2


@pytest.mark.gate
@pytest.mark.parametrize(
    "method", [pytest.param(m, marks=pytest.mark.gate) if m.endswith("paper") else m for m in SETTINGS]
)
def test_stopped_training_goes_on_as_if_it_had_not_been(method, tmp_path):
    baseline = baseline_of(method, 2400)
    whole = trained(tmp_path / "whole", baseline)
    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path / "parts", baseline, pieces=5)  # SAC within an episode
    assert 0 < checkpoints(tmp_path / "parts")[-1].step < whole.curve[-1].environment_steps
    torch.manual_seed(5)  # a new process knows nothing of the old one's streams
    np.random.seed(5)  # noqa: NPY002
    resumed = trained(tmp_path / "parts", baseline)
    assert [p.cost for p in resumed.curve] == [p.cost for p in whole.curve]
    for one, other in zip(whole.model.policy.parameters(), resumed.model.policy.parameters(), strict=True):
        assert torch.equal(one, other)
    drawn = [step for step, _ in curve(tmp_path / "parts", "trajectory_cost/val")]
    assert sorted(drawn) == [p.environment_steps for p in whole.curve], "logged once"
    other = trained(tmp_path / "other", baseline_of(method, 2400, seed=1))
    assert other.curve[-1].cost != whole.curve[-1].cost


def test_a_resumed_training_writes_in_a_later_second(tmp_path):
    """Files of one second are read in the order of process and count as text, in which 10 comes before 9."""
    now = int(time.time()) + 1
    (tmp_path / f"events.out.tfevents.{now}.host.1.9").touch()
    _logger(tmp_path, 5)
    others = [path.name for path in tmp_path.glob("events.out.tfevents.*") if not path.name.endswith("host.1.9")]
    assert len(others) == 2
    assert all(int(name.split(".")[3]) > now for name in others)


@pytest.mark.parametrize("method", SETTINGS)
def test_tensorboard_has_how_it_was_trained_and_every_scalar_once(method, tmp_path):
    baseline = baseline_of(method, 1200)
    steps = [point.environment_steps for point in trained(tmp_path, baseline).curve]
    logged = EventAccumulator(str(tmp_path), {"scalars": 0}).Reload()
    tags = logged.Tags()["scalars"]
    for tag in tags:
        drawn = [event.step for event in logged.Scalars(tag)]
        assert drawn == steps[-len(drawn) :], f"{tag} once at each validation"
    assert {"trajectory_cost/train", "train/actor_loss" if "sac" in method else "train/loss"} <= set(tags)
    (text,) = logged.Tensors("config/text_summary")
    said = OmegaConf.create(textwrap.dedent(text.tensor_proto.string_val[0].decode()))
    assert (said["method"], said["seed"], said["steps"], said["hidden"]) == (method, 0, 1200, [8])
    assert said["setting"]["observe_time"] is baseline.setting.observe_time
    assert said["options"] == SMALL[method[:3]]


def test_finished_training_is_not_trained_again(tmp_path, monkeypatch):
    baseline = baseline_of("ppo_tuned", 500)
    trained(tmp_path, baseline)
    monkeypatch.setattr(PPO, "learn", lambda *_, **__: pytest.fail("Expected no further training."))
    assert trained(tmp_path, baseline).curve[-1].environment_steps >= 500


def test_killed_while_saving_the_last_whole_checkpoint_counts(tmp_path):
    baseline = baseline_of("ppo_tuned", 1200)
    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path, baseline, pieces=1)
    (last,) = checkpoints(tmp_path)[-1:]
    shutil.copytree(last.folder, last.folder.with_name(".new_half"))
    (last.folder.with_name(".new_half") / "progress.json").write_text("{")
    assert checkpoints(tmp_path)[-1].step == last.step
    assert trained(tmp_path, baseline).curve[-1].environment_steps >= 1200


@pytest.mark.gate
def test_tuned_ppo_learns_where_no_learning_does_not(tmp_path):
    learning = baseline_of("ppo_tuned", 20_000, n_epochs=10, n_steps=6, batch_size=96)
    first, *_, last = trained(tmp_path / "learning", learning).curve
    assert last.cost < 0.9 * first.cost
    idle = baseline_of("ppo_tuned", 4_000, learning_rate=0.0)
    first, *_, last = trained(tmp_path / "idle", idle).curve
    assert last.cost == pytest.approx(first.cost, rel=0.05)


def test_settings_are_those_of_the_paper():
    ppo, sac = SETTINGS["ppo_paper"], SETTINGS["sac_paper"]
    assert (ppo.environments, ppo.observe_time, ppo.normalise) == (90, False, False)
    wanted = {"learning_rate": 3e-4, "batch_size": 256, "n_epochs": 20, "clip_range": 0.4, "gae_lambda": 0.95}
    assert wanted.items() <= ppo.options.items()
    assert {"gamma": 0.98, "tau": 0.02, "train_freq": 1, "learning_rate": 3e-4}.items() <= sac.options.items()
    for name, setting in SETTINGS.items():
        assert setting.observe_time is name.endswith("tuned")
        assert setting.truncates is not setting.observe_time, "what lies beyond the end counts only where it is unseen"


def test_normalisation_is_kept_with_the_model(tmp_path):
    baseline = baseline_of("ppo_tuned", 500)
    training = trained(tmp_path, baseline)
    policy = checkpoints(tmp_path)[-1].policy(baseline)
    assert isinstance(policy.normalisation, VecNormalize)
    observation = np.array([[0.5, -0.2, 0.3]])
    expected, _ = training.policy.predict(observation)
    np.testing.assert_array_equal(policy.predict(observation)[0], expected)
    assert not np.array_equal(policy.model.predict(observation, deterministic=True)[0], expected)


class Malice:
    """Unpickling this makes a folder."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return os.mkdir, (str(self.marker),)


def evil(path, marker):
    """The same file with something to run in it."""
    if path.suffix == ".zip":
        model = SAC.load(path) if "ent_coef_optimizer.pth" in zipfile.ZipFile(path).namelist() else PPO.load(path)
        model.further = Malice(marker)
        model.save(path)
    else:
        path.write_bytes(pickle.dumps(Malice(marker)))


@pytest.mark.parametrize("name", ["model.zip", "normalisation.pkl", "replay.pkl", "streams.pt", "progress.json"])
def test_what_another_program_wrote_is_not_unpickled(name, tmp_path):
    baseline, folder = baseline_of("sac_tuned", 1200), tmp_path / "job"
    with pytest.raises(KeyboardInterrupt):
        trained(folder, baseline, pieces=1)
    last, marker = checkpoints(folder)[-1], tmp_path / "executed"
    evil(last.folder / name, marker)
    for use in (lambda: BaselineTraining(baseline, folder), lambda: last.file(name) or last.progress):
        with pytest.raises(LyapnetError) as raised:
            use()
        assert str(last.folder / name) in str(raised.value)
        assert "\n" not in str(raised.value)
    assert not marker.exists()
    if name == "model.zip":  # even with a digest: a policy is read from its weights alone
        last.seal()
        last.policy(baseline)
        assert not marker.exists()
        last.model(baseline, baseline.wrapped(baseline.environment()))
        assert marker.exists(), "the twin: the same file is malicious indeed"


def test_baseline_without_digests_is_refused(tmp_path):
    baseline = baseline_of("ppo_tuned", 1200)
    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path, baseline, pieces=1)
    last = checkpoints(tmp_path)[-1]
    kept = (last.folder / "digests.json").read_text()
    (last.folder / "digests.json").unlink()
    with pytest.raises(LyapnetError, match="trains it again"):
        BaselineTraining(baseline, tmp_path)
    (last.folder / "digests.json").write_text(kept)
    BaselineTraining(baseline, tmp_path)


def test_unknown_method_is_refused():
    with pytest.raises(UsageError, match="ppo_paper"):
        _ = baseline_of("ppo_best", 10).setting


def test_pieces_are_whole_episodes_or_updates():
    baseline = baseline_of("ppo_paper", 30_000)
    assert baseline.piece % (90 * 6) == 0
    baseline = baseline_of("sac_paper", 10_000)
    assert baseline.piece % (16 * 4) == 0
    assert baseline.piece == pytest.approx(10_000 / baseline.validations, rel=0.5)
    assert baseline_of("sac_paper", 1).piece == 16 * 4
    assert baseline_of("sac_paper", 1, train_freq=1).piece == 16
    assert baseline_of("ppo_paper", 1).piece == 90 * 6


def test_progress_is_plain_data(tmp_path):
    trained(tmp_path, baseline_of("ppo_paper", 500))
    progress = json.loads((checkpoints(tmp_path)[-1].folder / "progress.json").read_text())
    assert progress["seconds"] > 0
    assert progress["curve"][0]["environment_steps"] == 0


@pytest.mark.parametrize(
    ("method", "options", "named"),
    [
        ("ppo_tuned", {"learnig_rate": 1}, "did you mean learning_rate"),
        ("sac_tuned", {"clip_range": 0.2}, "options of SAC"),
        ("ppo_tuned", {"n_steps": 4}, "n_steps of ppo_tuned to divide 6"),
        ("sac_tuned", {"train_freq": [1, "episode"]}, "train_freq of sac_tuned as a number of steps"),
    ],
)
def test_impossible_options_are_refused(method, options, named):
    with pytest.raises(UsageError, match=named):
        baseline_of(method, 10, **options).check()
    baseline_of(method, 10).check()


def test_finished_training_keeps_no_replay_buffer(tmp_path):
    trained(tmp_path, baseline_of("sac_tuned", 500))
    assert not list(tmp_path.rglob("replay.pkl"))
    assert trained(tmp_path, baseline_of("sac_tuned", 500)).curve[-1].environment_steps >= 500
