"""lyapnet identify: from CSV files to tables, a figure and a config that goes on."""

import json

import numpy as np
import pytest
import yaml

from lyapnet.cli import main
from lyapnet.experiment.config import load_config
from tests.lab.identification.plants import PLANTS, record

TASK = """
system: {name: pendulum, parameters: {mass: 1.3, length: 0.6, damping: 0.05}}
cost: {Q: [1, 0.1], R: 0.1, Q_T: [1, 0.1]}
initial_states: {lower: [2.6, -0.5], upper: [3.7, 0.5]}
horizon: {steps: 10, dt: 0.02}
"""
TRUE = PLANTS["pendulum"].true


def write(path, recording, heading="t,torque,angle [deg],temperature"):
    rows = np.column_stack([recording.t, recording.u, np.degrees(recording.y), 20 + 0 * recording.t])
    np.savetxt(path, rows, "%.8g", ",", header=heading, comments="")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A config and two files of data."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pendulum.yaml").write_text(TASK)
    for name, recording in zip(("one.csv", "two.csv"), record(PLANTS["pendulum"], [0, 1], seconds=3.0), strict=True):
        write(tmp_path / name, recording)
    return tmp_path


@pytest.mark.gate
def test_the_config_goes_on_with_values_and_ranges(folder, capsys):
    assert main(["identify", "pendulum.yaml", "one.csv", "two.csv", "horizon.steps=20"]) == 0
    said = capsys.readouterr().out
    assert "columns that are not read: 'temperature'" in said
    assert "wrote pendulum_identified.yaml and pendulum_identified.png" in said
    written = folder / "pendulum_identified.yaml"
    assert written.read_text().splitlines()[0] == "# lyapnet train --config pendulum_identified.yaml"
    config = load_config(written)
    assert (config.experiment, config.horizon.steps) == ("pendulum_identified", 20)
    for name, value in TRUE.items():
        assert config.system.parameters[name] == pytest.approx(value, rel=0.05)
        low, high = config.randomise[name]
        assert low < config.system.parameters[name] < high
        assert f"[{low:.6g}, {high:.6g}]" in said, "the table says what the file says"
    assert (folder / "pendulum_identified.png").stat().st_size > 10_000


@pytest.mark.gate
def test_one_object_with_everything(folder, capsys):
    arguments = ["identify", "pendulum.yaml", "one.csv", "--test", "two.csv", "--json", "--out", "found.yaml"]
    assert main([*arguments, "--parameters", "mass,length", "--parameters", "damping,gravity", "--family"]) == 0
    out, err = capsys.readouterr()
    found = json.loads(out)
    assert "wrote found.yaml and found.png" in err
    assert found["parameters"].keys() == {*TRUE, "gravity"}
    assert found["parameters"]["gravity"]["high"] is None
    assert found["unknown_directions"][0].keys() == {"mass", "length", "gravity"}
    assert np.shape(found["covariance"]) == (4, 4)
    assert found["fit_held_out"]["angle"] > 0.9
    assert found["model_is_right"]
    content = yaml.safe_load((folder / "found.yaml").read_text())
    assert content["family"].keys() == {"damping"}, "the others have no range"
    assert "randomise" not in content


@pytest.mark.gate
def test_ranges_that_a_config_cannot_have_are_left_out_and_told(folder, capsys):
    (folder / "pendulum.yaml").write_text(f"{TASK}noise: {{velocity: 0.1}}\n")
    assert main(["identify", "pendulum.yaml", "one.csv"]) == 0
    assert "randomise: not written: randomise goes without noise" in capsys.readouterr().out
    written = (folder / "pendulum_identified.yaml").read_text()
    assert load_config("pendulum_identified.yaml").randomise == {}
    assert "# randomise: {mass: [" in written


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["pendulum.yaml", "horizon.steps=3"], "Expected CSV files of measurements after the config, got none"),
        (["pendulum.yaml", "none.csv"], "Expected a CSV file, got 'none.csv' (No such file or directory)"),
        (["pendulum.yaml", "one.csv", "--out", "pendulum.yaml"], "Expected --out as another YAML file"),
        (["pendulum.yaml", "one.csv", "--out", "found.png"], "Expected --out as another YAML file"),
        (["pendulum.yaml", "one.csv", "--parameters", "wind"], "got 'wind'"),
        (["pendulum.yaml", "one.csv", "--held-out", "0.99"], "Expected options of lyapnet identify"),
    ],
)
def test_what_is_asked_wrongly_is_refused(arguments, expected, folder, capsys):
    before = {path.name for path in folder.iterdir()}
    assert main(["identify", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert expected in line
    assert {path.name for path in folder.iterdir()} == before
