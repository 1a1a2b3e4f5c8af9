"""lyapnet certify --refine: a round writes its points, its config and a run, whatever stops it in between.

Most rounds are of a claim that is made up, as a proof takes seconds; one goes through the command.
"""

import csv
import dataclasses
import json
import shutil
import sys
from functools import partial
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf
from rich.console import Console
from torch.testing import assert_close

import lyapnet
from lyapnet.base.errors import Interrupted, UsageError
from lyapnet.claims.funnel import ProvedFunnel
from lyapnet.claims.region import ProvedRegion
from lyapnet.claims.region_certificate import RegionCertificate
from lyapnet.claims.sound_certificate import SoundCertificate
from lyapnet.cli import main
from lyapnet.experiment.assembly import Parts
from lyapnet.experiment.checkpoint import KEY, read_checkpoint, write_checkpoint
from lyapnet.experiment.config import load_config
from lyapnet.loop.programs import RegionProgram
from lyapnet.prover.condition import DecreaseCondition
from lyapnet.task.sets import Box
from lyapnet.training import experiment, refinement
from lyapnet.training.modules import ValueModule
from lyapnet.training.runs import TrainingRun
from tests.fits import shorten_fits

TINY = [
    *("training.iterations=2", "training.batch_size=4", "horizon.steps=8", "network.hidden=[4]"),
    *("evaluation.validation_states=4", "evaluation.test_states=4", "rollout.gradient=backprop"),
    "loggers=[csv]",  # no figures, which take most of the time of a short run
]
FEW = ["training.iterations=3", "pointwise.points=8"]
ALPHA, DELTA = 0.9, 0.01


def train(logs, *changes):
    """The folder of a run whose condition fails."""
    assert main(["train", "--config", "conf/from_scratch/double_integrator.yaml", f"logs={logs}", *TINY, *changes]) == 0
    return logs / "double_integrator_from_scratch/version_0"


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return train(tmp_path_factory.mktemp("logs"))


@pytest.fixture
def run(trained, tmp_path):
    """A copy of it, to be refined."""
    return shutil.copytree(trained, tmp_path / "run")


def best(folder):
    return folder / "checkpoints/best.ckpt"


def claimed(
    checkpoint, rho=-float("inf"), undecided=((0.01, 0.2, -0.3), (0.02, 1.5, 2.5)), level=20.0, controller=None
):
    """A claim about the controller of a checkpoint: nothing is proved, and two boxes are undecided."""
    controller = controller or lyapnet.load(checkpoint)
    D, centers = Box([-1.6, -2.6], [1.6, 2.6]), torch.tensor(undecided).reshape(-1, 3)
    duration = controller.horizon.duration
    claim = ProvedFunnel(
        alpha=ALPHA, delta=DELTA, duration=duration, states=D, rho=rho, wanted=level, least=level, volume_share=0.0,
        terminal_excess=0.0, counterexample=None, boxes=9, seconds=1.0, remaining_volume=0.5, undecided=centers,
        left_out=[],
    )  # fmt: skip
    return SoundCertificate(controller, claim, {"seed": 0})


def refine(run, rounds=1, certified=claimed):
    return refinement.refine(best(run), certified, rounds, FEW, Console(quiet=True))


def points_of(folder):
    with (folder / "points.csv").open() as file:
        header, *rows = csv.reader(file)
    return header, torch.tensor([[float(entry) for entry in row] for row in rows])


def runs(folder):
    return sorted(path.name for path in folder.glob("version_*"))


def weights(checkpoint):
    return lyapnet.load(checkpoint).V.state_dict()


def no_training(monkeypatch):
    monkeypatch.setattr(experiment, "fit", lambda *_: pytest.fail("Expected no training."))


@pytest.mark.gate
def test_a_round_is_a_run_that_learns_from_what_failed(run, trained):
    checkpoint, certificate = refine(run)
    folder = run / "refine_1"
    again = TrainingRun(folder / "version_0")
    assert runs(folder) == ["version_0"]
    assert again.finished
    assert checkpoint == again.best
    assert certificate.controller.config.pointwise.counterexamples
    assert again.finetuned_from == best(run).resolve()
    before, config = load_config(trained / "config.yaml"), load_config(folder / "config.yaml")
    assert config.training.learning_rate == pytest.approx(before.training.learning_rate / 5)
    assert (config.training.iterations, config.pointwise.points) == (3, 8), "the overrides"
    assert before.pointwise.weight is None
    assert config.pointwise.weight == before.program.constraint > 0
    assert config.pointwise.counterexamples == str(folder.resolve() / "points.csv")
    assert config.pointwise.region == [1.6, 2.6], "D"
    assert any(not torch.equal(w, weights(best(run))[name]) for name, w in weights(checkpoint).items())


@pytest.mark.gate
def test_a_region_is_refined_with_the_weight_of_its_program(tmp_path):
    region = ["program.name=region", "program.constraint=0", "program.margin=null", "program.bound=null"]
    run = train(tmp_path, *region, "horizon.stationary=true", "cost.Q_T=null", "network.name=stationary")
    refine(run)
    assert load_config(run / "refine_1/config.yaml").pointwise.weight == RegionProgram.pointwise


@pytest.mark.gate
def test_its_points_fail_the_condition_or_are_undecided(run):
    """By plain arithmetic, at the controller that failed."""
    condition = DecreaseCondition(lyapnet.load(best(run)).closed_loop.double(), ALPHA, DELTA)
    refine(run)
    header, points = points_of(run / "refine_1")
    assert header == ["t", "position", "velocity"]
    *failing, first, second = points
    assert {tuple(first.tolist()), tuple(second.tolist())} == {(0.01, 0.2, -0.3), (0.02, 1.5, 2.5)}
    failing = torch.stack(failing)
    assert len(failing) == refinement.POINTS_PER_ROUND
    with torch.no_grad():
        c, W = condition(failing[:, 0], failing[:, 1:]), condition.height(failing[:, 0], failing[:, 1:])
    assert (c > 0).all()
    assert (W <= 20.0).all()
    assert len(refinement.failing_points(claimed(best(run), level=-1.0))) == 2, "no violation lies below this level"


@pytest.mark.gate
def test_what_is_pushed_is_refined_against_the_push(run):
    """The condition that is sought is the claim's own: V̇ at its worst under |w| ≤ w_max."""
    still = claimed(best(run))
    pushed = SoundCertificate(
        still.controller, dataclasses.replace(still.claim, disturbance=torch.tensor([0.0, 0.5]).double()), {"seed": 0}
    )
    (condition, domain, level), (other, *_) = pushed.searched_condition(), still.searched_condition()
    assert level == still.claim.wanted
    t, x = torch.zeros(50).double(), domain[0][1:] + (domain[1] - domain[0])[1:] * torch.rand(50, 2).double()
    _, slope = still.controller.V.value_and_state_gradient(t, x)
    with torch.no_grad():
        assert_close(condition(t, x) - other(t, x), 0.5 * slope[:, 1].abs())


@pytest.fixture(scope="module")
def region_run(tmp_path_factory):
    """The folder of a run of the region program that has hardly begun."""
    folder = tmp_path_factory.mktemp("regions")
    tiny = [each for each in TINY if "steps" not in each]
    changes = [*tiny, "horizon={steps: 40, dt: 0.2, stationary: true}", "training.warmup=0", "pointwise.points=16"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lyapnet.training.start.MAX_OPTIMA", 6)
        shorten_fits(patch, 5, 5)
        patch.setattr("lyapnet.training.pretraining.BRIEF_STEPS", 10)
        assert main(["train", "--config", "conf/regions/van_der_pol.yaml", f"logs={folder}", *changes]) == 0
    return folder / "van_der_pol_region/version_0"


@pytest.mark.gate
def test_a_region_is_refined_by_what_fails_in_it(region_run, capsys):
    before = load_config(region_run / "config.yaml")
    options = ["--set=-4.8:4.8,-10.8:10.8", "--seconds", "5", "--refine", "1", "--json"]
    assert main(["certify", "region", str(best(region_run)), *FEW, *options]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["kind"] == "region"
    folder = region_run / "refine_1"
    assert runs(folder) == ["version_0"]
    config = load_config(folder / "config.yaml")
    assert before.pointwise.weight is None
    assert config.pointwise.weight == RegionProgram.pointwise, "the program's own"
    assert config.pointwise.region == [4.8, 10.8]
    _, points = points_of(folder)
    assert not points[:, 0].any(), "V has no time"
    controller = lyapnet.load(best(region_run))
    t, x = points[:, 0].double(), points[:, 1:].double()
    value, slope = controller.V.value_and_state_gradient(t, x)
    fall = (slope * controller.system.dynamics(x, controller.closed_loop.policy(t, x))).sum(-1)
    assert float((fall > -0.01 * value).double().mean()) > 0.5, "V rises there, or hardly falls; others are undecided"


@pytest.mark.gate
def test_a_region_that_comes_up_to_the_boundary_is_complete(region_run):
    controller = lyapnet.load(best(region_run))
    claim = partial(
        ProvedRegion, decay=0.01, states=Box([-1.0, -1.0], [1.0, 1.0]), rim=2.0, wanted=5.0, least=5.0, hole=0.1,
        contraction=None, slowest=-1.0, volume_share=0.5, region_share=0.5, proof=None, seconds=1.0, left_out=[],
    )  # fmt: skip
    assert RegionCertificate(controller, claim(rho=1.9999), {"seed": 0}).is_complete
    assert not RegionCertificate(controller, claim(rho=1.5), {"seed": 0}).is_complete


@pytest.mark.gate
def test_the_same_command_does_not_train_again(run, monkeypatch):
    checkpoint, _ = refine(run)
    before = checkpoint.read_bytes()
    no_training(monkeypatch)
    assert refine(run)[0] == checkpoint
    assert checkpoint.read_bytes() == before
    assert runs(run / "refine_1") == ["version_0"]


@pytest.mark.gate
def test_a_second_round_starts_from_the_first_and_keeps_its_points(run):
    refine(run)
    checkpoint, _ = refine(run, rounds=2)
    assert checkpoint == TrainingRun(run / "refine_2/version_0").best
    assert TrainingRun(run / "refine_2/version_0").finetuned_from == best(run / "refine_1/version_0").resolve()
    (_, first), (_, both) = points_of(run / "refine_1"), points_of(run / "refine_2")
    assert torch.equal(both[-len(first) :], first)
    assert len(both) > len(first)
    rates = [load_config(folder / "config.yaml").training.learning_rate for folder in (run, run / "refine_2")]
    assert rates[1] == pytest.approx(rates[0] / 25)


def interrupted(*_):
    raise KeyboardInterrupt


@pytest.mark.gate
@pytest.mark.parametrize(
    ("place", "name", "written"),
    [
        (refinement, "to_yaml", {"points.csv"}),
        (experiment, "fit", {"points.csv", "config.yaml", "version_0"}),
        (ValueModule, "on_before_optimizer_step", {"points.csv", "config.yaml", "version_0"}),
    ],
    ids=["before its config", "before its training", "in its training"],
)
def test_what_was_stopped_goes_on_to_the_same_end(place, name, written, run, trained, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(place, name, interrupted)
        with pytest.raises((KeyboardInterrupt, SystemExit, Interrupted)):
            refine(run)
    assert {path.name for path in (run / "refine_1").iterdir()} == written
    checkpoint, _ = refine(run)
    assert runs(run / "refine_1") == ["version_0"]
    undisturbed, _ = refine(shutil.copytree(trained, tmp_path / "undisturbed"))
    assert all(torch.equal(w, weights(undisturbed)[name]) for name, w in weights(checkpoint).items())


def test_what_is_certified_needs_no_round(run, monkeypatch):
    no_training(monkeypatch)
    checkpoint, certificate = refine(run, 3, partial(claimed, rho=20.0))
    assert checkpoint == best(run)
    assert certificate.claim.verdict == "certified"
    assert not list(run.glob("refine_*"))


@pytest.mark.gate
def test_where_nothing_fails_it_still_trains(run):
    """A rim that is too low, say, has neither counterexamples nor undecided boxes."""
    refine(run, certified=partial(claimed, undecided=(), level=-1.0))
    assert runs(run / "refine_1") == ["version_0"]
    assert points_of(run / "refine_1")[1].numel() == 0


@pytest.mark.gate
def test_single_precision_is_refined(tmp_path):
    refine(train(tmp_path, "training.precision=float32"))
    assert runs(tmp_path / "double_integrator_from_scratch/version_0/refine_1") == ["version_0"]


@pytest.mark.gate
def test_the_command(run, capsys, monkeypatch):
    class Made(SoundCertificate):
        def numbers(self):
            return {"alpha": self.options["alpha"], "trained with": self.controller.config.seed}

    def certify(controller, claim, **_):
        return Made(controller, claimed(best(run)).claim, {"alpha": claim.alpha, "seed": 0})

    monkeypatch.setattr("lyapnet.claims.certify.certify", certify)
    capsys.readouterr()
    command = ["certify", "sound", str(best(run)), *FEW, "--alpha=0.7", "--json"]
    assert main([*command, "--refine=1", "seed=5"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["alpha"], result["trained with"]) == (0.7, 5), "of what was trained last"
    assert runs(run / "refine_1") == ["version_0"]
    no_training(monkeypatch)
    assert main([*command, "--refine=1", "seed=5"]) == 0


PART = """
from pathlib import Path
from lyapnet.task.systems import DoubleIntegrator
import lightning as L

Path({mark!r}).touch()

class Cart(DoubleIntegrator):
    pass

class Quiet(L.Callback):
    pass
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    """Two modules, `named` and `trap`, that leave a mark where they are imported."""
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("named", "trap"):
        (tmp_path / f"{name}.py").write_text(PART.format(mark=str(tmp_path / f"{name} imported")))
    yield lambda name: (tmp_path / f"{name} imported").exists()
    for name in ("named", "trap"):
        sys.modules.pop(name, None)


def rewrite(checkpoint, **sections):
    """Give the config of a checkpoint other sections, as a file from elsewhere may have them."""
    content = read_checkpoint(checkpoint)
    content[KEY]["config"].update(sections)
    write_checkpoint(content, checkpoint)


TRAPS = {
    "its system": {"system": {"name": "trap:Cart", "parameters": {}}},
    "its callbacks": {"callbacks": ["trap:Quiet"]},
}


@pytest.fixture
def undecided(monkeypatch):
    """A sound claim that takes no time and proves nothing."""
    monkeypatch.setattr(
        "lyapnet.claims.certify.certify", lambda controller, *_, **__: claimed(best(Path()), controller=controller)
    )
    monkeypatch.setattr(SoundCertificate, "table", lambda *_: "")
    monkeypatch.setattr(SoundCertificate, "numbers", lambda self: {"system": type(self.controller.system).__name__})


@pytest.mark.parametrize("what", TRAPS)
def test_refining_imports_nothing_that_a_checkpoint_names(what, run, own, undecided, capsys):
    rewrite(best(run), **TRAPS[what])
    for command in ([], ["callbacks=[named:Quiet]"] if what == "its system" else ["--system=named:Cart"]):
        assert main(["certify", "sound", str(best(run)), *FEW, "--refine=1", *command]) == 2
        printed = capsys.readouterr().err.splitlines()
        assert "Expected" in printed[-1]
        assert "trap:" in printed[-1]
        assert not list(run.glob("refine_*"))
    assert not own("trap")


@pytest.mark.gate
@pytest.mark.parametrize("what", TRAPS)
def test_refining_trains_with_what_the_command_names(what, run, own, undecided, capsys):
    rewrite(best(run), **TRAPS[what])
    capsys.readouterr()
    command = ["--system=named:Cart"] if what == "its system" else ["callbacks=[named:Quiet]"]
    assert main(["certify", "sound", str(best(run)), *FEW, "--refine=1", "--json", *command]) == 0
    assert own("named")
    assert not own("trap")
    config = load_config(run / "refine_1/config.yaml")
    assert (config.system.name, config.callbacks) in [("named:Cart", []), ("double_integrator", ["named:Quiet"])]
    assert json.loads(capsys.readouterr().out)["system"] == ("Cart" if what == "its system" else "DoubleIntegrator")


@pytest.mark.parametrize("what", TRAPS)
def test_a_round_that_lies_there_is_trained_with_nothing_that_it_names(what, run, own, undecided, capsys, monkeypatch):
    """Its config came with the folder."""
    with monkeypatch.context() as patch:
        patch.setattr(experiment, "fit", interrupted)
        with pytest.raises(KeyboardInterrupt):
            refine(run)
    path = run / "refine_1/config.yaml"
    path.write_text(OmegaConf.to_yaml({**OmegaConf.load(path), **TRAPS[what]}))
    assert main(["certify", "sound", str(best(run)), *FEW, "--refine=1"]) == 2
    assert "trap:" in capsys.readouterr().err.splitlines()[-1]
    assert not own("trap")


@pytest.mark.gate
def test_parts_from_python_are_trained_with(run):
    """Also where their class cannot be imported; and their name stands in for what the checkpoint said."""

    class Heavy(lyapnet.task.systems.DoubleIntegrator):
        pass

    class Price(lyapnet.QuadraticCost):
        pass

    rewrite(best(run), system={"name": "trap:Cart", "parameters": {}})
    system, cost = Heavy(mass=2.0), Price(torch.eye(2), torch.eye(1), torch.eye(2))

    def certified(checkpoint):
        return claimed(checkpoint, controller=lyapnet.load(checkpoint, system=system, cost=cost))

    with pytest.raises(UsageError, match="trap:Cart"):
        refinement.refine(best(run), certified, 1, FEW, Console(quiet=True))
    assert not list(run.glob("refine_*"))
    checkpoint, _ = refinement.refine(best(run), certified, 1, FEW, Console(quiet=True), Parts(system, cost))
    config = load_config(run / "refine_1/config.yaml")
    assert config.system.name.endswith("Heavy")
    assert config.cost.Q is None, "which no Price reads"
    with pytest.raises(UsageError, match="Heavy"):
        lyapnet.load(checkpoint)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["seed=3"], "Expected overrides with --refine ROUNDS, got 'seed=3'; add it."),
        (["--refine=1", "--keep=proof.pt"], "Expected --keep or --refine, got both"),
    ],
)
def test_what_does_not_go_together_is_refused(arguments, message, run, capsys):
    assert main(["certify", "sound", str(best(run)), *arguments]) == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert len(printed.splitlines()) == 1
    assert not list(run.glob("refine_*"))
