"""Reports of certificates: their content; and outputs that cannot be written are refused, or leave no file."""

import hashlib
import json
import math
import platform
import re

import pytest
import torch

from lyapnet.claims.certify import certify
from lyapnet.claims.funnel import ProvedFunnel
from lyapnet.claims.kinds import Funnel, Sampled, Statistical
from lyapnet.claims.report import markdown, report_of, write_outputs
from lyapnet.claims.sampling_certificates import SampledCertificate, StatisticalCertificate
from lyapnet.claims.sound_certificate import SoundCertificate
from lyapnet.claims.statistical import BoundedShare, CountedSuccesses
from lyapnet.cli import main
from lyapnet.controller.controller import Controller
from lyapnet.controller.loading import load
from lyapnet.experiment.checkpoint import read_checkpoint, write_checkpoint
from lyapnet.loop.programs import LyapunovProgram, Tolerances, ValueProgram
from lyapnet.prover.counterexamples import Counterexample
from lyapnet.task.sets import Box, ControlBox
from lyapnet.task.systems import DoubleIntegrator
from tests.problems import Formula, problem_of
from tests.runs import tiny_checkpoint

pytestmark = pytest.mark.usefixtures("few_seconds_for_levels")


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    return tiny_checkpoint(tmp_path_factory.mktemp("logs"))


@pytest.fixture(scope="module")
def reported(checkpoint, tmp_path_factory):
    """kind ↦ the folder of its report."""
    options = {
        "sampled": [],
        "statistical": ["--samples", "50", "--radius", "2"],
        "sound": ["--seconds", "0.5"],
        "region": ["--seconds", "3"],
    }
    root = tmp_path_factory.mktemp("reports")
    for kind, rest in options.items():
        assert main(["certify", kind, str(checkpoint), *rest, "--report", str(root / kind)]) == 0
    return root


def content(folder):
    def refuse(name):
        pytest.fail(f"Expected JSON, got {name}.")

    return json.loads((folder / "report.json").read_text(encoding="utf-8"), parse_constant=refuse)


@pytest.mark.gate
@pytest.mark.parametrize("kind", ["sampled", "statistical", "sound", "region"])
def test_a_report_names_what_was_certified(kind, reported, checkpoint):
    report = content(reported / kind)
    assert report["kind"] == report["certificate"]["kind"] == kind
    assert report["verdict"] == report["certificate"]["verdict"]
    assert report["checkpoint"]["sha256"] == hashlib.sha256(checkpoint.read_bytes()).hexdigest()
    assert report["system"] == {"name": "double_integrator", "parameters": {"mass": 1.0}}
    assert report["initial_states"] == {"lower": [-1, -0.7], "upper": [1, 0.7]}
    assert report["cost"]["Q"] == [10, 0.1]
    assert report["horizon"] == {"steps": 8, "dt": 0.01, "duration": 0.08}
    assert report["versions"]["torch"] == torch.__version__
    assert report["versions"]["python"] == platform.python_version()
    assert report["experiment"] == "double_integrator_from_scratch"
    assert {path.name for path in (reported / kind).iterdir()} == {"report.json", "report.md", report["figure"]}


@pytest.mark.gate
def test_a_report_has_the_limits_of_the_controller(checkpoint):
    """Not the limits of the config, which may differ."""

    def controls_of(**own):
        certificate = certify(load(checkpoint, **own), Sampled(samples=3))
        report = report_of(certificate, checkpoint, "lyapnet certify")
        (line,) = [line for line in markdown(report).splitlines() if line.startswith("| controls |")]
        return report["controls"], line

    assert controls_of() == ({}, "| controls | without limits |")
    limited = {"lower": [-1.0], "upper": [None]}, "| controls | lower = [-1.0], upper = [None] |"
    assert controls_of(controls=ControlBox(-1.0, math.inf)) == limited


@pytest.mark.gate
@pytest.mark.parametrize("kind", ["sampled", "statistical", "sound", "region"])
def test_its_markdown_says_the_same(kind, reported):
    report, text = content(reported / kind), (reported / kind / "report.md").read_text(encoding="utf-8")
    assert text == markdown(report).rstrip() + "\n"
    for shown in (report["checkpoint"]["sha256"], report["command"], report["date"], report["versions"]["platform"]):
        assert shown in text
    assert f": {kind}, {report['verdict']}" in text.splitlines()[0]
    assert (reported / kind / re.findall(r"!\[[^]]*\]\(([^)]+)\)", text)[0]).is_file()
    for table in re.findall(r"(?:^\|.*\n)+", text, flags=re.MULTILINE):
        columns = {len(re.findall(r"(?<!\\)\|", row)) for row in table.splitlines()}
        assert len(columns) == 1, "every row of a table has the same cells"


@pytest.mark.gate
def test_its_command_makes_the_same_certificate(reported, capsys):
    report = content(reported / "statistical")
    program, *arguments = report["command"].split()
    assert program == "lyapnet"
    capsys.readouterr()
    assert main([*arguments, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == report["certificate"]


@pytest.mark.gate
def test_another_checkpoint_has_another_hash(reported, checkpoint, tmp_path):
    copy = tmp_path / "copy.ckpt"
    weights = read_checkpoint(checkpoint)
    name = next(key for key in weights["state_dict"] if key.startswith("V."))
    weights["state_dict"][name] += 1e-3
    write_checkpoint(weights, copy)
    assert main(["certify", "sampled", str(copy), "--samples", "2", "--report", str(tmp_path)]) == 0
    assert content(tmp_path)["checkpoint"]["sha256"] != content(reported / "sampled")["checkpoint"]["sha256"]


def claimed(cls, claim, seed=3):
    """A certificate of a claim about an untrained controller."""
    V = Formula(lambda t, x: (x**2).sum(-1) + 0 * t)
    return cls(Controller(problem_of(DoubleIntegrator()), V), claim, {"seed": seed})


def count_successes(successes, limits, cls=CountedSuccesses, samples=100, **more):
    held = (torch.arange(samples) < successes)[:, None].expand(samples, 5)
    return cls(torch.zeros(samples, 2), held, limits, **more)


def test_a_sampled_claim_in_words():
    one = claimed(SampledCertificate, count_successes(97, Tolerances(0.5, None, 0.05)))
    assert one.in_words().startswith("Of 100 states drawn uniformly from X₀ (seed 3), 97 succeed")
    assert one.in_formulas() == ["‖x(T)‖ ≤ 0.5", "J(x₀) ≤ 1.05 V(0, x₀)"]
    assert "one that fails was found" in one.verdict_text()
    all_succeed = claimed(SampledCertificate, count_successes(100, Tolerances(0.5, None, 0.05)))
    assert "one that fails" not in all_succeed.verdict_text()


def test_a_bound_is_rounded_down_in_words():
    limits, more = Tolerances(None, 0.01, 0.05), {"confidence": 1 - 1e-6, "share": 0.99}
    claim = count_successes(50, limits, BoundedShare, 50, **more)
    assert claim.probability_lower_bound == pytest.approx(0.7585776, abs=1e-7)
    one = claimed(StatisticalCertificate, claim)
    assert "With confidence 1 − 1e-06, at least 75.857% of X₀" in one.in_words()
    assert one.in_formulas()[-1].startswith("P(x₀ succeeds) ≥ 75.857%")


def funnel(**changes):
    found = {
        "alpha": 0.9, "delta": 0.01, "duration": 4.0, "states": Box([-2.0, -2.0], [2.0, 2.0]), "rho": 1.25,
        "wanted": 2.0, "least": 2.0, "volume_share": 0.5, "terminal_excess": 0.5, "counterexample": None, "boxes": 10,
        "seconds": 1.0, "remaining_volume": 0.1, "undecided": torch.empty(0, 3), "left_out": [], **changes,
    }  # fmt: skip
    return claimed(SoundCertificate, ProvedFunnel(**found))


def test_a_funnel_in_words():
    assert "ρ = 1.25" in funnel().in_words()
    assert "at least 50.000% of X₀" in funnel().in_words()
    condition, mouth, cost = funnel().in_formulas()
    assert condition.startswith("V_t + V_xᵀ(f + g u) + 0.9 ℓ(x, u) ≤ 0.01 ")
    assert "V(t, x(t)) ≤ 1.25 + 0.01 t" in mouth
    assert cost.startswith("J(x₀) ≤ (V(0, x₀) + 0.01 · 4) / 0.9 + 0.5 ")


def test_no_funnel_claims_nothing():
    found = Counterexample(1.0, [0.5, 1.5], 0.1, 1.4)
    nothing = funnel(rho=-math.inf, volume_share=0.0, terminal_excess=math.inf, counterexample=found)
    assert nothing.verdict == "falsified"
    assert "nothing is claimed" in nothing.in_words()
    assert not any("1.25" in line or "inf" in line for line in nothing.in_formulas())
    assert "At t = 1 s, x = (0.5, 1.5) it fails by 0.1" in nothing.verdict_text()


@pytest.mark.gate
def test_the_result_is_printed_even_if_the_report_cannot_be_written(checkpoint, tmp_path, monkeypatch, capsys):
    def full(path, content):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr("lyapnet.claims.report.write_atomically", full)
    capsys.readouterr()
    few = ["--samples", "2", "--json"]
    assert main(["certify", "sampled", str(checkpoint), *few, "--report", str(tmp_path / "report")]) == 1
    printed = capsys.readouterr()
    assert json.loads(printed.out)["samples"] == 2
    assert "No space left on device" in printed.err
    assert not list((tmp_path / "report").iterdir())


@pytest.mark.gate
def test_a_figure_in_any_format_that_is_known(checkpoint, tmp_path):
    certificate = certify(load(checkpoint), Sampled(samples=5))
    for name, start in (("claim.svg", b"<?xml"), ("claim.pdf", b"%PDF")):
        assert [*write_outputs(certificate, checkpoint, "", tmp_path / name, None)] == [tmp_path / name]
        assert (tmp_path / name).read_bytes().startswith(start)


@pytest.mark.gate
def test_nothing_is_infinite_in_json(checkpoint):
    result = certify(checkpoint, Funnel(alpha=1.0, delta=0.0), budget=0.1).result
    assert json.dumps(result, allow_nan=False)
    assert result["terminal_excess"] is None, "κ is infinite where no funnel was proved"


@pytest.mark.parametrize(("program", "told"), [(ValueProgram(), True), (LyapunovProgram(), False)])
def test_a_value_function_that_is_no_bound_is_told_what_to_do(program, told):
    V = Formula(lambda t, x: 1e-3 * (x**2).sum(-1))
    certificate = certify(Controller(problem_of(DoubleIntegrator()), V, program=program), Statistical(samples=50))
    assert certificate.verdict == "falsified"
    assert ("program.name=lyapunov" in certificate.result.get("advice", "")) is told
