"""Reports of certificates: they name what was certified; what cannot be written is refused, or leaves nothing."""

import hashlib
import json
import platform
import re

import pytest
import torch

from lyapnet.certificates import certify, options_of
from lyapnet.cli import main
from lyapnet.controller import load
from lyapnet.report import in_formulas, in_words, markdown, of_the_verdict, write_outputs

TINY = ["training.iterations=2", "horizon.steps=8", "evaluation.validation_states=4", "evaluation.test_states=4"]


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    changes = [f"logs={folder}", "network.hidden=[8]", *TINY]
    assert main(["train", "--config", "conf/double_integrator.yaml", *changes]) == 0
    return folder / "double_integrator/version_0/checkpoints/best.ckpt"


@pytest.fixture(scope="module")
def reported(checkpoint, tmp_path_factory):
    """kind ↦ the folder of its report."""
    options = {"sampled": [], "statistical": ["--samples", "50", "--radius", "2"], "sound": ["--seconds", "0.5"]}
    root = tmp_path_factory.mktemp("reports")
    for kind, rest in options.items():
        assert main(["certify", str(checkpoint), "--kind", kind, *rest, "--report", str(root / kind)]) == 0
    return root


def content(folder):
    def refuse(name):
        pytest.fail(f"Expected JSON, got {name}.")

    return json.loads((folder / "report.json").read_text(encoding="utf-8"), parse_constant=refuse)


@pytest.mark.parametrize("kind", ["sampled", "statistical", "sound"])
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
    assert report["experiment"] == "double_integrator"
    assert {path.name for path in (reported / kind).iterdir()} == {"report.json", "report.md", report["figure"]}


@pytest.mark.parametrize("kind", ["sampled", "statistical", "sound"])
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


def test_its_command_makes_the_same_certificate(reported, capsys):
    report = content(reported / "statistical")
    program, *arguments = report["command"].split()
    assert program == "lyapnet"
    capsys.readouterr()
    assert main([*arguments, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == report["certificate"]


def test_another_checkpoint_has_another_hash(reported, checkpoint, tmp_path):
    copy = tmp_path / "copy.ckpt"
    weights = torch.load(checkpoint, weights_only=True)
    name = next(key for key in weights["state_dict"] if key.startswith("V."))
    weights["state_dict"][name] += 1e-3
    torch.save(weights, copy)
    assert main(["certify", str(copy), "--kind", "sampled", "--samples", "2", "--report", str(tmp_path)]) == 0
    assert content(tmp_path)["checkpoint"]["sha256"] != content(reported / "sampled")["checkpoint"]["sha256"]


def test_a_sampled_claim_in_words():
    limits = {"radius": 0.5, "decrease": None, "cost": 0.05}
    result = {
        "kind": "sampled",
        "verdict": "falsified",
        "samples": 100,
        "all_share": 0.97,
        "tolerances": limits,
        "seed": 3,
    }
    assert in_words(result).startswith("Of 100 states drawn uniformly from X₀ (seed 3), 97 succeed")
    assert in_formulas(result) == ["‖x(T)‖ ≤ 0.5", "J(x₀) ≤ 1.05 V(0, x₀)"]
    assert "one that fails was found" in of_the_verdict(result)
    assert "one that fails" not in of_the_verdict({**result, "verdict": "unknown"})


def test_a_bound_is_rounded_down_in_words():
    result = {"kind": "statistical", "verdict": "unknown", "samples": 50, "all_share": 1.0, "seed": 0}
    result |= {"confidence": 1 - 1e-6, "probability_lower_bound": 0.7585776, "required_share": 0.99}
    result |= {"tolerances": {"radius": None, "decrease": 0.01, "cost": 0.05}}
    assert "With confidence 1 − 1e-06, at least 75.857% of X₀" in in_words(result)
    assert in_formulas(result)[-1].startswith("P(x₀ succeeds) ≥ 75.857%")


SOUND = {
    "kind": "sound", "verdict": "unknown", "alpha": 0.9, "delta": 0.01, "duration": 4.0, "rho": 1.25,
    "volume_share": 0.5, "terminal_excess": 0.5, "counterexample": None,
}  # fmt: skip


def test_a_funnel_in_words():
    assert "ρ = 1.25" in in_words(SOUND)
    assert "at least 50.000% of X₀" in in_words(SOUND)
    condition, funnel, cost = in_formulas(SOUND)
    assert condition.startswith("V_t + V_xᵀ(f + g u) + 0.9 ℓ(x, u) ≤ 0.01 ")
    assert "V(t, x(t)) ≤ 1.25 + 0.01 t" in funnel
    assert cost.startswith("J(x₀) ≤ (V(0, x₀) + 0.01 · 4) / 0.9 + 0.5 ")


def test_no_funnel_claims_nothing():
    nothing = {**SOUND, "rho": None, "terminal_excess": None, "volume_share": 0.0, "verdict": "falsified"}
    nothing["counterexample"] = {"t": 1.0, "x": [0.5, 1.5], "condition": 0.1, "height": 2.4}
    assert "nothing is claimed" in in_words(nothing)
    assert not any("1.25" in line for line in in_formulas(nothing))
    assert "At t = 1 s, x = (0.5, 1.5) it fails by 0.1" in of_the_verdict(nothing)


def test_the_result_is_printed_even_if_the_report_cannot_be_written(checkpoint, tmp_path, monkeypatch, capsys):
    def full(path, content):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr("lyapnet.report.write_atomically", full)
    capsys.readouterr()
    few = ["--kind", "sampled", "--samples", "2", "--json"]
    assert main(["certify", str(checkpoint), *few, "--report", str(tmp_path / "report")]) == 1
    printed = capsys.readouterr()
    assert json.loads(printed.out)["samples"] == 2
    assert "No space left on device" in printed.err
    assert not list((tmp_path / "report").iterdir())


def test_a_figure_in_any_format_that_is_known(checkpoint, tmp_path):
    controller = load(checkpoint)
    options = options_of("sampled", {"samples": 5})
    certificate = certify(controller, "sampled", options)
    for name, start in (("claim.svg", b"<?xml"), ("claim.pdf", b"%PDF")):
        assert [*write_outputs(certificate, checkpoint, "", tmp_path / name, None)] == [tmp_path / name]
        assert (tmp_path / name).read_bytes().startswith(start)


def test_nothing_is_infinite_in_json(checkpoint):
    options = options_of("sound", {"seconds": 0.1, "alpha": 1.0, "delta": 0.0})
    result = certify(load(checkpoint), "sound", options).result
    assert json.dumps(result, allow_nan=False)
    assert result["terminal_excess"] is None, "κ is infinite where no funnel was proved"
