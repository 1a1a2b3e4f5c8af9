"""lyapnet certify: its JSON for every kind of claim, its table, its figure, and what it refuses."""

import json

import pytest
import torch
from torch import nn

from lyapnet import figures
from lyapnet.certificates import parse_set
from lyapnet.certification import Counterexample, SoundClaim
from lyapnet.cli import main
from lyapnet.errors import UsageError
from lyapnet.sets import Box
from lyapnet.systems import Cartpole, DoubleIntegrator

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
    for kind, shown in (("sampled", "sampled"), ("statistical", "1 − 1e-06"), ("sound", "cost per second")):
        assert main(["certify", checkpoint, "--kind", kind, "--samples", "20", "--seconds", "1"]) == 0
        assert shown in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--kind", "certain"], "Expected --kind as one of sampled, statistical, sound, got 'certain'"),
        (["--kind", "sound", "--set=1,2"], "Expected --set as lower:upper"),
        (["--kind", "sound", "--set=-0.5:0.5,-2:2"], "Expected a set around X₀"),
        (["--kind", "sound", "--set=-2:2"], "Expected a set of 2 states, got 1"),
        (["--kind", "sound", "--alpha", "1.5"], "Expected 0 < alpha ≤ 1, got 1.5"),
        (["--kind", "sound", "--delta=-1"], "Expected delta ≥ 0"),
        (["--confidence", "1"], "Expected a confidence between 0 and 1"),
        (["--radius=-1"], "Expected tolerance radius ≥ 0"),
    ],
)
def test_what_does_not_fit_is_refused(checkpoint, arguments, message, capsys):
    assert main(["certify", checkpoint, *arguments]) != 0
    assert message in capsys.readouterr().err


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


class Bowl(nn.Module):
    def forward(self, t, x):
        return (x**2).sum(-1)


def claim(rho):
    states = Box(torch.tensor([-2.0, -2.0]), torch.tensor([2.0, 2.0]))
    found = Counterexample(1.0, [0.5, 1.5], 0.1, 2.4)
    share = 0.5 if rho > 0 else 0.0
    return SoundClaim(0.9, 0.01, 4.0, states, rho, 2.0, share, 0.0, found, 10, 1.0, 0.0)


def test_the_funnel_is_drawn_with_its_levels():
    X0 = Box(torch.tensor([-1.0, -1.0]), torch.tensor([1.0, 1.0]))
    (axes,) = figures.funnel(claim(1.0), Bowl(), X0, DoubleIntegrator()).axes
    radii = [path.vertices for c in axes.collections for path in c.get_paths()]
    assert radii
    levels = [1.0 + 0.01 * t for t in (0, 1, 2, 3, 4)]
    for vertices, level in zip(radii, levels, strict=True):
        assert (vertices**2).sum(-1) == pytest.approx(level, rel=1e-2)
    assert not figures.funnel(claim(-float("inf")), Bowl(), X0, DoubleIntegrator()).axes[0].collections
    with pytest.raises(UsageError, match="2 states"):
        figures.funnel(claim(1.0), Bowl(), X0, Cartpole())
