"""lyapnet certify: its JSON for every kind of claim, its table, and what it refuses."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from typer.main import get_command

from lyapnet.base.errors import UsageError
from lyapnet.claims import checking, funnel
from lyapnet.claims.claim import flags_of
from lyapnet.claims.kinds import Funnel, LowerBound, NoisyFunnel, Reach, Region, Sampled, Statistical, Tube
from lyapnet.claims.sound_certificate import SoundCertificate
from lyapnet.cli import certify, main
from lyapnet.cli.options import read_set
from lyapnet.controller.controller import Controller
from lyapnet.task.systems import DoubleIntegrator
from tests.claims import planted
from tests.problems import Formula, problem_of
from tests.runs import tiny_checkpoint

CLAIMS = {claim.kind: claim for claim in (Sampled, Statistical, Funnel, NoisyFunnel, Reach, Region, Tube)}

pytestmark = pytest.mark.usefixtures("few_seconds_for_levels")


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    return str(tiny_checkpoint(tmp_path_factory.mktemp("logs")))


def certificate(capsys, *arguments):
    capsys.readouterr()
    assert main(["certify", *arguments, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.gate
def test_sampled_and_statistical(checkpoint, capsys):
    sampled = certificate(capsys, "sampled", checkpoint)
    assert sampled["kind"] == "sampled"
    assert sampled["samples"] == 100
    assert 0 <= sampled["all_share"] <= min(sampled[f"{e}_share"] for e in ("decrease", "cost"))
    assert "terminal_share" not in sampled, "no radius was named"
    assert sampled["verdict"] == ("unknown" if sampled["all_share"] == 1 else "falsified")
    everything = ("--radius", "100", "--samples", "300", "--confidence", "0.9")
    result = certificate(capsys, "statistical", checkpoint, *everything)
    assert result["kind"] == "statistical"
    assert result["confidence"] == 0.9
    assert result["terminal_share"] == 1
    assert result["terminal_lower_bound"] == pytest.approx(0.1 ** (1 / 300))
    assert result["probability_lower_bound"] <= result["terminal_lower_bound"]
    assert result["verdict"] in ("certified", "falsified", "unknown")


@pytest.mark.gate
def test_sound(checkpoint, capsys, tmp_path):
    options = ("--seconds", "1", "--figure", str(tmp_path / "funnel.png"), "--delta", "0.5")
    result = certificate(capsys, "sound", checkpoint, *options)
    keys = {"kind", "verdict", "alpha", "delta", "rho", "set", "volume_share", "guaranteed_cost_ratio"}
    keys |= {"boxes", "seconds", "counterexample"}
    assert keys <= result.keys()
    assert result["kind"] == "sound"
    assert result["verdict"] != "certified"  # two steps of training are not enough
    assert result["alpha"] == 0.95
    assert (tmp_path / "funnel.png").stat().st_size > 0


@pytest.mark.gate
def test_tables(checkpoint, capsys):
    few = ["--samples", "20"]
    for kind, options, shown in (
        ("sampled", few, "sampled"),
        ("statistical", few, "1 − 1e-06"),
        ("sound", ["--seconds", "0.5"], "cost per second"),
    ):
        assert main(["certify", kind, checkpoint, *options]) == 0
        assert shown in capsys.readouterr().out


REFUSED = [
    ("certify --kind=sound", "Expected the kind of claim as a word, got --kind; as in lyapnet certify sound CKPT."),
    ("certify sound --kind sound", "Expected the kind of claim as a word, got --kind"),
    ("certify sound --set=1,2", "Expected --set as lower:upper"),
    ("certify sound --set=-0.5:0.5,-2:2", "Expected a set around X₀"),
    ("certify sound --set=-2:2", "Expected a set of 2 states, got 1"),
    ("certify sound --alpha=1.5", "Expected --alpha in (0, 1], got 1.5"),
    ("certify noisy", "Expected a task with noise for a noisy certificate, got one without"),
    ("certify noisy --probability=1", "Expected --probability strictly between 0 and 1, got 1"),
    ("certify sound --alpha=0", "Expected --alpha in (0, 1], got 0"),
    ("certify sound --delta=-1", "Expected --delta ≥ 0, got -1"),
    ("certify sound --delta=nan", "Expected --delta ≥ 0, got nan"),
    ("certify sound --seconds=0", "Expected --seconds > 0, got 0"),
    ("certify statistical --confidence=1", "Expected --confidence strictly between 0 and 1, got 1"),
    ("certify --confidence=0", "Expected --confidence strictly between 0 and 1, got 0"),
    ("certify statistical --share=0", "Expected --share in (0, 1], got 0"),
    ("certify statistical --share=1.1", "Expected --share in (0, 1], got 1.1"),
    ("certify sampled --radius=-1", "Expected --radius ≥ 0, got -1"),
    ("certify statistical --radius=-1", "Expected --radius ≥ 0, got -1"),
    (
        "certify sond",
        "Expected sampled, statistical, sound, noisy, reach, region, tube, check or a checkpoint, got 'sond'; did you "
        "mean sound?",
    ),
    ("certify proof", "got 'proof'; choose one, or name a file."),
    ("certify --alpha=0.9", "No such option: --alpha"),
    ("certify sampled --share=0.9", "No such option: --share"),
    ("certify sound --radius=1", "No such option: --radius"),
    ("certify statistical --refine=1", "No such option: --refine"),
    ("certify sampled --figure=nowhere/claim.png", "make 'nowhere' first"),
    ("certify sound --keep=nowhere/kept", "make 'nowhere' first"),
    ("certify region --keep=nowhere/kept", "make 'nowhere' first"),
    ("certify sampled --figure=claim.xyz", "got 'claim.xyz'; for example claim.png"),
    ("certify sampled --report=conf/reacher.yaml", "Expected report as a folder, got 'conf/reacher.yaml'"),
]


@pytest.mark.parametrize(("line", "message"), REFUSED)
def test_what_does_not_fit_is_refused(checkpoint, line, message, capsys):
    assert main([*line.split(), checkpoint]) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert len(printed.err.splitlines()) == 1
    assert not printed.out


def test_options_are_refused_before_any_work(monkeypatch, capsys):
    monkeypatch.setattr(certify.Given, "load", lambda _: pytest.fail("Expected no work on a wrong request."))
    for wrong in (
        ["sound", "any.ckpt", "--alpha=2"],
        ["statistical", "any.ckpt", "--share=2"],
        ["sampled", "any.ckpt", "--figure=nowhere/claim.png"],
        ["sound", "any.ckpt", "--set=1"],
    ):
        assert main(["certify", *wrong]) == 2
        assert capsys.readouterr().err.startswith("error: Expected")


def certifiable(*arguments, **own):
    """In place of a checkpoint: the Riccati V of the double integrator."""
    return Controller(planted.problem(), planted.stationary(planted.riccati()))


@pytest.mark.gate
def test_a_kept_proof_is_checked(checkpoint, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(certify.Given, "load", certifiable)
    monkeypatch.setattr(funnel, "MAX_LEVEL_SECONDS", 20.0)
    path = str(tmp_path / "kept.proof")
    options = ["--alpha", "0.9", "--delta", "0.05", "--keep", path]
    found = certificate(capsys, "sound", checkpoint, *options)
    assert found["verdict"] == "certified"
    assert len(found["fingerprint"]) == 64
    assert main(["certify", "check", path, checkpoint, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["kind"], result["verdict"]) == ("check", "certified")
    same = ("alpha", "delta", "set", "rho", "rho_wanted", "volume_share", "terminal_excess", "fingerprint")
    assert {name: result[name] for name in same} == {name: found[name] for name in same}
    assert result["boxes"] <= found["boxes"]
    assert result["share_of_search"] > 0
    assert main(["certify", "check", path, checkpoint]) == 0
    assert "check: certified" in capsys.readouterr().out
    monkeypatch.setattr(checking, "prove_funnel", lambda *a, **o: pytest.fail("Expected no work on another proof."))
    for other, why in ((0.999, "name its checkpoint."), (1.0, "changed or damaged")):  # another V, then a changed file
        V = planted.stationary(other * planted.riccati())
        monkeypatch.setattr(certify.Given, "load", lambda _, V=V: Controller(planted.problem(), V))
        if other == 1.0:
            content = Path(path).read_bytes()
            Path(path).write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
        assert main(["certify", "check", path, checkpoint]) == 1
        assert "check: refused" in capsys.readouterr().out
        assert main(["certify", "check", path, checkpoint, "--json"]) == 1
        assert why in json.loads(capsys.readouterr().out)["reason"]


@pytest.mark.gate
@pytest.mark.parametrize("kind", [["region"], ["sound", "--two-sided", "--alpha=0.9", "--delta=0.05"]])
def test_kept_proofs_of_other_kinds_are_checked(kind, checkpoint, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(certify.Given, "load", certifiable)
    monkeypatch.setattr(funnel, "MAX_LEVEL_SECONDS", 20.0)
    path = str(tmp_path / "kept.proof")
    found = certificate(capsys, *kind, checkpoint, "--keep", path)
    assert found["rho"] > 0
    assert main(["certify", "check", path, checkpoint, "--json"]) == (found["verdict"] != "certified")
    result = json.loads(capsys.readouterr().out)
    assert result["of"] == ("region" if len(kind) == 1 else "two-sided")
    same = found.keys() & {"rho", "rho_wanted", "set", "fingerprint", "decay", "hole", "contraction_box", "lower_level"}
    assert len(same) > 4
    assert {name: result[name] for name in same} == {name: found[name] for name in same}
    again = certificate(capsys, *kind, checkpoint, "--keep", path)
    assert (again["verdict"], again["rho"]) == (found["verdict"], found["rho"])


@pytest.mark.parametrize(("kind", "claim"), list(CLAIMS.items()))
def test_the_command_line_has_the_fields_of_the_claims(kind, claim):
    parameters = get_command(certify.app).commands[kind].params
    line = {parameter.opts[0].removeprefix("--"): parameter for parameter in parameters}
    assert dict(flags_of(claim)).keys() <= line.keys()
    for flag, f in flags_of(claim):
        assert line[flag].default == f.default
        assert line[flag].help.startswith(f.metadata["doc"])
    if kind == "tube":
        assert dict(flags_of(LowerBound)).keys() <= line.keys()


def test_the_command_says_every_option():
    controller = Controller(problem_of(DoubleIntegrator()), Formula(lambda t, x: (x**2).sum(-1)))
    options = {"alpha": 0.95, "delta": None, "set": "-1:1,-2:2", "seed": 0}
    line = SoundCertificate(controller, None, options).command("my run/best.ckpt", system="pendulum:Pendulum")
    assert line.startswith("lyapnet certify sound 'my run/best.ckpt' --alpha=0.95 --set=-1:1,-2:2")
    assert line.endswith("--seed=0 --system=pendulum:Pendulum")


def test_without_a_kind_it_is_statistical_without_a_note(checkpoint, capsys):
    new = certificate(capsys, "statistical", checkpoint, "--samples", "3")
    assert main(["certify", checkpoint, "--samples", "3", "--json"]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out) == new
    assert not printed.err


def test_help_fits_a_terminal(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    for kind in ("", *CLAIMS):
        assert main(["certify", *kind.split(), "--help"]) == 0
        text = capsys.readouterr().out
        assert "…" not in text.replace("lower:upper,…", ""), "nothing is cut off"
        assert max(map(len, text.splitlines())) <= 80


def test_help_loads_nothing_heavy():
    lines = "import sys", "from lyapnet.cli import main", "main(['certify', 'sound', '--help'])"
    program = "\n".join([*lines, "sys.exit('torch' in sys.modules)"])
    assert subprocess.run([sys.executable, "-c", program], stdout=subprocess.DEVNULL).returncode == 0


def test_a_missing_checkpoint_is_refused(capsys):
    assert main(["certify", "sampled", "nowhere.ckpt"]) == 2
    assert "nowhere.ckpt" in capsys.readouterr().err


def test_sets_are_read():
    assert read_set("-1:2,-0.5:0.25") == [[-1, -0.5], [2, 0.25]]
    for text in ("", "1", "2:1", "1:2:3", "a:b", "-inf:1", "nan:1"):
        with pytest.raises(UsageError, match="--set"):
            read_set(text)


@pytest.mark.gate
def test_disturbances_are_named_by_states(checkpoint, capsys, tmp_path):
    options = ["--seconds", "2", "--delta", "1", "--disturbance", "velocity=0.01"]
    result = certificate(capsys, "sound", checkpoint, *options, "--report", str(tmp_path))
    assert result["disturbance"] == {"velocity": 0.01}
    assert "--disturbance=velocity=0.01" in (tmp_path / "report.md").read_text()
    for wrong, expected in (("speed=1", "of position, velocity, got 'speed=1'"), ("velocity=a", "with a number")):
        assert main(["certify", "sound", checkpoint, "--disturbance", wrong]) == 2
        assert expected in capsys.readouterr().err
