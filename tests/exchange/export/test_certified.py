"""A claim about files of C: how far their u is off is bounded, and other or edited files are found."""

import hashlib
import re
import shutil

import numpy as np
import pytest
import torch

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.claims.certify import certify
from lyapnet.claims.checking import check, claim_text
from lyapnet.claims.kinds import Funnel
from lyapnet.cli import main
from lyapnet.cli.options import Given
from lyapnet.controller.controller import Controller
from lyapnet.exchange.export import CertifiedFiles, export
from lyapnet.exchange.export.c import FLAGS, CompiledLaw, Style
from lyapnet.exchange.export.law import Law
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.task.sets import Box, ControlBox
from lyapnet.task.systems import Linear
from lyapnet.value.policy import HJBPolicy
from tests.exchange.export.attack_file import attack
from tests.problems import AMPLE, Formula, problem_of

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
D = Box([-1.6], [1.6])


def integrator(weight=1.0, controls=None):
    """ẋ = u, ℓ = x² + u², V = x² for ever: u = −x; between limits if there are some. X₀ = [−1, 1], T = 2 s."""
    about = problem_of(Linear([[0.0]], [[1.0]]), steps=20)
    about = about if controls is None else about.replaced(controls=controls)
    V = Formula(lambda t, x: weight * (x**2).sum(-1) + 0 * t)
    return Controller(about, V, policy=HJBPolicy).continued("hold")


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """(controller, folder of its C in float32, proof about it)"""
    place = tmp_path_factory.mktemp("certified")
    controller = integrator(1.1)
    export(controller, place / "c", "c", dtype="float32")
    law = CertifiedFiles(controller, place / "c").law()
    claim = Funnel(alpha=0.5, delta=1e-2, states=D, measured={"x1": 0.01}, jitter=0.1, file=law)
    certificate = certify(controller, claim, budget=Budget(AMPLE, boxes=30_000), keep=place / "p.proof")
    assert certificate.verdict == "certified"
    return controller, place / "c", place / "p.proof", certificate


def copied_of(folder, place):
    return shutil.copytree(folder, place / "copy")


@pytest.mark.gate
def test_the_claim_names_the_file_and_how_far_it_is_off(exported):
    _, folder, _, certificate = exported
    result, bodies = certificate.result, [(folder / name).read_text() for name in ("policy.h", "policy.c")]
    digest = hashlib.sha256("".join(body.split("*/\n", 1)[1] for body in bodies).encode()).hexdigest()
    assert result["computed_by"] == digest
    assert result["precision"] == "float32"
    # u = −1.1x in three operations or so, on |x| ≤ 1.61
    assert 1.1 * 1.61 * 2**-24 < result["computed_within"]["u1"] < 20 * 1.1 * 1.61 * 2**-24
    assert result["control_errors"] == result["computed_within"]
    assert f"SHA-256 {digest} (without the comments at their top) compute in float32" in certificate.in_words()
    assert "given arithmetic of IEEE 754 without -ffast-math, and functions of the C library within 4 units" in (
        certificate.in_words()
    )


@pytest.mark.gate
def test_the_file_stays_within_the_bound(exported):
    controller, folder, _, certificate = exported
    program = CompiledLaw(folder, Law(controller), 1, FLAGS, Style(dtype=torch.float32))
    x = torch.linspace(-1.61, 1.61, 4001, dtype=torch.float64)[:, None]
    with torch.no_grad():
        expected = controller.closed_loop.policy(torch.zeros(len(x)).double(), x).numpy()
    off = np.abs(np.stack([program.policy(0.7, each) for each in x.numpy()]) - expected).max()
    bound = certificate.result["computed_within"]["u1"]
    assert off <= bound <= 100 * off


@pytest.mark.gate
def test_steps_of_quantised_controls_and_errors_of_the_file_add(exported):
    controller, folder, _, _ = exported
    claim = Funnel(
        alpha=0.5, delta=0.1, states=D, quantised={"u1": 0.02}, file=CertifiedFiles(controller, folder).law()
    )
    result = certify(controller, claim, budget=Budget(AMPLE, boxes=30_000)).result
    assert result["control_errors"]["u1"] == 0.01 + result["computed_within"]["u1"]


@pytest.mark.gate
def test_a_proof_is_checked_with_its_file_alone(exported, tmp_path):
    controller, folder, proof, certificate = exported
    result = check(controller, proof, law=CertifiedFiles(controller, folder).law())
    assert result["verdict"] == "certified"
    assert result["computed_by"] == certificate.result["computed_by"]
    assert "Expected --file with the C of this proof" in check(controller, proof)["reason"]
    export(controller, tmp_path / "double", "c")
    law = CertifiedFiles(controller, tmp_path / "double").law()
    refused = check(controller, proof, law=law)
    assert refused["verdict"] == "refused"
    assert f"got {law.sha256}; name" in refused["reason"]


@pytest.mark.gate
def test_a_claim_stands_in_the_header_and_an_edited_one_is_found(exported, tmp_path):
    controller, folder, proof, _ = exported
    place = copied_of(folder, tmp_path)
    files = CertifiedFiles(controller, place)
    result = check(controller, proof, law=files.law())
    header = files.write_claim(claim_text(result))
    text, code = header.read_text(), (place / "policy.c").read_text()
    assert code == (folder / "policy.c").read_text()
    assert text.split("*/\n", 1)[1] == (folder / "policy.h").read_text().split("*/\n", 1)[1]
    assert result["computed_by"] in text.split("*/\n", 1)[0]
    law = CertifiedFiles(controller, place).law()
    assert law.claimed == claim_text(result)
    assert law.sha256 == result["computed_by"], "the claim is not part of the digest"
    assert check(controller, proof, law=law)["verdict"] == "certified"
    header.write_text(text.replace("0.11 s apart", "0.21 s apart"))
    refused = check(controller, proof, law=CertifiedFiles(controller, place).law())
    assert refused["reason"] == "the header states another claim than this proof"


@pytest.mark.parametrize(
    ("file", "edit", "line"),
    [
        ("policy.c", (r"1\.1(?=f)|2\.2(?=f)", "1.2"), None),
        ("policy.c", (r"SHA-256 \w|lyapnet: \S+", "lyapnet: 9"), 1),
        ("policy.h", (r"X₀: x1 -1", "X₀: x1 -2"), None),
        ("policy.h", (r"#define LYAPNET_DT \S+", "#define LYAPNET_DT 1.0f"), None),
        ("policy.h", (r"typedef float", "typedef double"), None),
        ("policy.c", (r"\Z", "/* more */"), None),
    ],
)
def test_edited_files_are_found(exported, tmp_path, file, edit, line):
    controller, folder, _, _ = exported
    place = copied_of(folder, tmp_path)
    before = (place / file).read_text()
    after = re.sub(*edit, before, count=1)
    assert after != before
    (place / file).write_text(after)
    with pytest.raises(
        UsageError, match=r"Expected policy.. as lyapnet export writes it .+, got another from line \d+"
    ):
        CertifiedFiles(controller, place)


def test_the_file_of_another_controller_is_found(exported):
    _, folder, _, _ = exported
    with pytest.raises(UsageError, match=r"Expected policy\.. as lyapnet export writes it for this checkpoint"):
        CertifiedFiles(integrator(1.2), folder)


def test_what_is_no_export_is_refused(exported, tmp_path):
    controller, folder, _, _ = exported
    with pytest.raises(UsageError, match=r"Expected policy.h and policy.c of lyapnet export in .+, got none; name"):
        CertifiedFiles(controller, tmp_path)
    for name in ("policy.h", "policy.c"):
        (tmp_path / name).write_text("int main(void) { return 0; }\n")
    with pytest.raises(UsageError, match=r"Expected files of lyapnet export --to c in .+, got others; name its folder"):
        CertifiedFiles(controller, tmp_path)
    with pytest.raises(UsageError, match="Expected file as the law that it computes, got"):
        certify(controller, Funnel(states=D, file=folder))
    with pytest.raises(UsageError, match="Expected --time held with --file, got continuous"):
        certify(controller, Funnel(states=D, time="continuous", file=CertifiedFiles(controller, folder).law()))


@pytest.mark.gate
def test_limits_of_single_precision_are_moved_inwards_and_count(tmp_path):
    controller = integrator(controls=ControlBox(torch.tensor(-0.7).double(), torch.tensor(0.3).double()))
    export(controller, tmp_path / "c", "c", dtype="float32")
    law = CertifiedFiles(controller, tmp_path / "c").law()
    assert 0 < law.moved[0] <= 0.7 * 2**-23
    sides = torch.tensor([-1.0]).double(), torch.tensor([1.0]).double()
    assert law.errors(sides, 5000)[0] > law.moved[0]


@pytest.mark.gate
def test_a_controller_in_single_precision_is_not_certified(tmp_path):
    controller = lyapnet.load("zoo:double_integrator")
    single = Controller(controller.problem.to(torch.float32), controller.V.float(), policy=HJBPolicy).continued("hold")
    export(single, tmp_path / "c", "c", dtype="float32")
    with pytest.raises(UsageError, match=r"Expected a controller in float64 .+, got one in float32\."):
        CertifiedFiles(single, tmp_path / "c").law()


@pytest.mark.gate
@pytest.mark.parametrize("name", ["double_integrator", "pendulum_swingup", "cartpole_balancing"])
def test_controllers_of_the_zoo_stay_within_a_bound_that_is_not_a_hundred_times_as_large(tmp_path, name):
    (bound,), (off,), _ = attack(lyapnet.load(f"zoo:{name}"), tmp_path / "c", 100_000)
    assert off <= bound <= 100 * off


@pytest.mark.gate
def test_from_the_command_line(tmp_path, capsys, monkeypatch):
    """Exported, proved, stated in the header, checked; then edited."""
    monkeypatch.setattr(Given, "load", lambda self: integrator(1.1))
    folder, proof, checkpoint = str(tmp_path / "c"), str(tmp_path / "p"), "zoo:double_integrator"
    export_it = ["export", checkpoint, "--to", "c", "--out", folder, "--dtype", "float32", "--beyond", "hold"]
    sound = ["certify", "sound", checkpoint, "--alpha", "0.5", "--delta", "0.01", "--set=-1.6:1.6", "--file", folder]
    assert main(export_it) == 0
    assert main([*sound, "--keep", proof, "--report", str(tmp_path / "report"), "--json"]) == 0
    capsys.readouterr()
    assert f"--file={folder}" in (tmp_path / "report" / "report.md").read_text()
    assert main([*export_it, "--certified", proof]) == 0
    assert f"certified: {proof}, checked, is about these files" in " ".join(capsys.readouterr().out.split())
    check_it = ["certify", "check", proof, checkpoint, "--file", folder, "--json"]
    assert main(check_it) == 0
    header = tmp_path / "c" / "policy.h"
    header.write_text(header.read_text().replace("0.1 s apart", "0.2 s apart"))
    assert main(check_it) == 1
    assert main([*export_it, "--dtype", "float64", "--certified", proof]) == 2
    assert "Expected a proof of these files for --certified, got: " in capsys.readouterr().err
    assert "certified: " not in header.read_text()
    assert main(["export", checkpoint, "--to", "onnx", "--out", folder + ".onnx", "--certified", proof]) == 2
    assert "Expected --certified with --to c and the law alone, got --to onnx;" in capsys.readouterr().err
