"""lyapnet certify: its JSON for every kind of claim, its table, and what it refuses."""

import json

import pytest

from lyapnet.certificates import OPTIONS, RULES, command, options_of, parse_set
from lyapnet.cli import main
from lyapnet.errors import UsageError

TINY = ["training.iterations=2", "horizon.steps=8", "evaluation.validation_states=4", "evaluation.test_states=4"]


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    changes = [f"logs={folder}", "network.hidden=[8]", *TINY]
    assert main(["train", "--config", "conf/double_integrator.yaml", *changes]) == 0
    return str(folder / "double_integrator/version_0/checkpoints/best.ckpt")


def certificate(capsys, *arguments):
    capsys.readouterr()
    assert main(["certify", *arguments, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_sampled_and_statistical(checkpoint, capsys):
    sampled = certificate(capsys, checkpoint, "--kind", "sampled")
    assert sampled["kind"] == "sampled"
    assert sampled["samples"] == 100
    assert 0 <= sampled["all_share"] <= min(sampled[f"{e}_share"] for e in ("decrease", "cost"))
    assert "terminal_share" not in sampled, "no radius was named"
    assert sampled["verdict"] == ("unknown" if sampled["all_share"] == 1 else "falsified")
    everything = ("--radius", "100", "--samples", "300", "--confidence", "0.9")
    result = certificate(capsys, checkpoint, *everything)
    assert result["kind"] == "statistical"
    assert result["confidence"] == 0.9
    assert result["terminal_share"] == 1
    assert result["terminal_lower_bound"] == pytest.approx(0.1 ** (1 / 300))
    assert result["probability_lower_bound"] <= result["terminal_lower_bound"]
    assert result["verdict"] in ("certified", "falsified", "unknown")


def test_sound(checkpoint, capsys, tmp_path):
    options = ("--kind", "sound", "--seconds", "3", "--figure", str(tmp_path / "funnel.png"), "--delta", "0.5")
    result = certificate(capsys, checkpoint, *options)
    keys = {"kind", "verdict", "alpha", "delta", "rho", "set", "volume_share", "guaranteed_cost_ratio"}
    keys |= {"boxes", "seconds", "counterexample"}
    assert keys <= result.keys()
    assert result["kind"] == "sound"
    assert result["verdict"] != "certified"  # two steps of training are not enough
    assert result["alpha"] == 0.95
    assert (tmp_path / "funnel.png").stat().st_size > 0


def test_tables(checkpoint, capsys):
    few = ["--samples", "20"]
    for kind, options, shown in (
        ("sampled", few, "sampled"),
        ("statistical", few, "1 − 1e-06"),
        ("sound", ["--seconds", "1"], "cost per second"),
    ):
        assert main(["certify", checkpoint, "--kind", kind, *options]) == 0
        assert shown in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--kind", "certain"], "Expected --kind as one of sampled, statistical, sound, got 'certain'"),
        (["--kind", "sound", "--set=1,2"], "Expected --set as lower:upper"),
        (["--kind", "sound", "--set=-0.5:0.5,-2:2"], "Expected a set around X₀"),
        (["--kind", "sound", "--set=-2:2"], "Expected a set of 2 states, got 1"),
        (["--kind", "sound", "--alpha", "1.5"], "Expected --alpha in (0, 1], got 1.5"),
        (["--kind", "sound", "--alpha", "0"], "Expected --alpha in (0, 1], got 0"),
        (["--kind", "sound", "--delta=-1"], "Expected --delta ≥ 0, got -1"),
        (["--kind", "sound", "--delta=nan"], "Expected --delta ≥ 0, got nan"),
        (["--kind", "sound", "--seconds", "0"], "Expected --seconds > 0, got 0"),
        (["--confidence", "1"], "Expected --confidence strictly between 0 and 1, got 1"),
        (["--confidence", "0"], "Expected --confidence strictly between 0 and 1, got 0"),
        (["--share", "0"], "Expected --share in (0, 1], got 0"),
        (["--share", "1.1"], "Expected --share in (0, 1], got 1.1"),
        (["--radius=-1"], "Expected --radius ≥ 0, got -1"),
        (["--alpha", "0.9"], "Expected --alpha with --kind sound, got --kind statistical; leave it out."),
        (["--kind", "sampled", "--share", "0.9"], "Expected --share with --kind statistical, got --kind sampled"),
        (
            ["--kind", "sound", "--radius", "1"],
            "Expected --radius with --kind sampled or statistical, got --kind sound",
        ),
        (["--figure", "nowhere/claim.png"], "make 'nowhere' first"),
        (["--kind", "sound", "--keep", "nowhere/kept"], "make 'nowhere' first"),
        (["--figure", "claim.xyz"], "got 'claim.xyz'; for example claim.png"),
        (["--report", "conf/reacher.yaml"], "Expected --report as a folder, got 'conf/reacher.yaml'"),
    ],
)
def test_what_does_not_fit_is_refused(checkpoint, arguments, message, capsys):
    assert main(["certify", checkpoint, *arguments]) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert len(printed.err.splitlines()) == 1
    assert not printed.out


def test_options_are_refused_before_any_work(monkeypatch, capsys):
    monkeypatch.setattr("lyapnet.cli._load", lambda *_: pytest.fail("Expected no work on a wrong request."))
    for wrong in (
        ["--alpha", "1"],
        ["--share", "2"],
        ["--figure", "nowhere/claim.png"],
        ["--kind", "sound", "--set=1"],
    ):
        assert main(["certify", "any.ckpt", *wrong]) == 2
        assert capsys.readouterr().err.startswith("error: Expected")


@pytest.mark.parametrize("kind", OPTIONS)
def test_defaults_are_what_the_rules_allow(kind):
    options = options_of(kind, {name: value for name, value in OPTIONS[kind].items() if name != "seed"})
    assert options == OPTIONS[kind]
    assert RULES.keys() <= {name for names in OPTIONS.values() for name in names}


def test_the_command_says_every_option():
    options = options_of("sound", {"set": "-1:1,-2:2"})
    line = command("my run/best.ckpt", "sound", options, system="pendulum:Pendulum")
    assert line.startswith("lyapnet certify 'my run/best.ckpt' --kind=sound --alpha=0.95 --set=-1:1,-2:2")
    assert line.endswith("--seed=0 --system=pendulum:Pendulum")


def test_a_missing_checkpoint_is_refused(capsys):
    assert main(["certify", "nowhere.ckpt"]) == 2
    assert "nowhere.ckpt" in capsys.readouterr().err


def test_sets_are_read():
    box = parse_set("-1:2,-0.5:0.25")
    assert box.lower.tolist() == [-1, -0.5]
    assert box.upper.tolist() == [2, 0.25]
    for text in ("", "1", "2:1", "1:2:3", "a:b"):
        with pytest.raises(UsageError, match="--set"):
            parse_set(text)
