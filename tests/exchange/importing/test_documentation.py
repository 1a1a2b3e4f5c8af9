"""The example of docs/networks_of_others.md: two networks trained in torch alone, exported, and certified."""

import json
import math

import pytest
import torch
import yaml

from lyapnet.cli import main
from tests.pages import ROOT, blocks

pytest.importorskip("onnxruntime")
PAGE = ROOT / "docs" / "networks_of_others.md"
STEPS = "steps = 3000"


def ran(folder, monkeypatch, steps):
    """The names that the page's examples leave, run in a folder after so many steps of training."""
    (config,) = [block for block in blocks("yaml", PAGE) if "pendulum" in block]
    train = (PAGE.with_suffix("") / "train.py").read_text(encoding="utf-8")
    (excerpt,) = [block for block in blocks("python", PAGE) if "torch.onnx.export(" in block]
    assert all(part.strip() in train for part in excerpt.split("\n\n\n"))
    (certify,) = [block for block in blocks("python", PAGE) if "imported_controller(" in block]
    assert yaml.safe_load(config)["system"]["name"] == "pendulum"
    assert STEPS in train
    (folder / "pendulum.yaml").write_text(config, encoding="utf-8")
    monkeypatch.chdir(folder)
    names: dict = {"__name__": "example"}
    default = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        exec(train.replace(STEPS, f"steps = {steps}"), names)
    finally:
        torch.set_default_dtype(default)
    exec(certify, names)
    return names


def by_command(capsys, *options):
    capsys.readouterr()
    files = ["pendulum.yaml", "--value", "V.onnx", "--law", "u.onnx", "--set=-4:4,-10:10"]
    assert main(["certify", "region", *files, *options, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.gate
@pytest.mark.filterwarnings("ignore")  # torch's exporter's own
@pytest.mark.usefixtures("few_seconds_for_levels")
def test_the_example_runs(tmp_path, monkeypatch, capsys):
    names = ran(tmp_path, monkeypatch, 6)
    assert names["certificate"].verdict in ("certified", "falsified", "unknown")
    assert by_command(capsys, "--seconds=2")["verdict"] in ("certified", "falsified", "unknown")


@pytest.mark.gate
@pytest.mark.filterwarnings("ignore")
def test_the_example_is_certified(tmp_path, monkeypatch, capsys):
    """Files and modules are one function: the same boxes, but for the rounding of constants."""
    own = ran(tmp_path, monkeypatch, 3000)["certificate"]
    result = by_command(capsys)
    assert own.verdict == result["verdict"] == "certified"
    assert result["volume_share"] == 1
    assert result["region_volume_proved"] > 100
    assert math.isclose(own.result["region_volume_proved"], result["region_volume_proved"], rel_tol=0.01)
    assert result["equilibrium_offset"] < 1e-8
    assert result["precision"] == "float32"
    assert result["distance_left"] < 0.01
    assert "precision" not in own.result, "modules are read in real numbers"
