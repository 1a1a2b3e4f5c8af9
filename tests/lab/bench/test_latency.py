"""The time of one control: as many calls as a loop of 1 kHz makes, of C that is far faster than Python."""

import json
import shutil

import pytest

from lyapnet.base.errors import ExportError
from lyapnet.cli import main
from lyapnet.lab.bench import latency
from lyapnet.lab.bench.latency import NATIVE
from tests.runs import tiny_checkpoint

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")


@pytest.mark.gate
def test_each_way_is_timed(tmp_path, capsys):
    checkpoint = tiny_checkpoint(tmp_path)
    capsys.readouterr()
    assert main(["bench", "law", str(checkpoint), "--seconds", "0.2", "--json"]) == 0
    rows = {row["way"]: row for row in json.loads(capsys.readouterr().out)}
    assert [*rows] == ["C, -O2", "C, -O3", f"C, {NATIVE}", "  core kept awake", "Python, compiled", "Python"]
    for row in rows.values():
        assert 0 < row["median"] <= row["most"] <= row["worst"]
        assert 0 < row["calls"] <= 200
    assert rows["C, -O2"]["calls"] == 200
    assert rows["C, -O3"]["median"] < rows["Python, compiled"]["median"] < rows["Python"]["median"]
    assert main(["bench", "law", str(checkpoint), "--seconds", "0.05"]) == 0
    assert "microseconds of u(t, x), 1 kHz" in capsys.readouterr().out


@pytest.mark.gate
def test_a_compiler_without_native_code(tmp_path, capsys, monkeypatch):
    checkpoint = tiny_checkpoint(tmp_path)
    compiling = latency.compile_c

    def compile_c(source, result, options):
        if "-march=native" in options:
            raise ExportError("unknown option")
        compiling(source, result, options)

    monkeypatch.setattr(latency, "compile_c", compile_c)
    capsys.readouterr()
    assert main(["bench", "law", str(checkpoint), "--seconds", "0.05", "--json"]) == 0
    ways = [row["way"] for row in json.loads(capsys.readouterr().out)]
    assert ways == ["C, -O2", "C, -O3", "Python, compiled", "Python"]


@pytest.mark.gate
def test_mpc_and_a_learners_policy_beside(tmp_path, capsys):
    pytest.importorskip("casadi")
    pytest.importorskip("stable_baselines3")
    checkpoint = tiny_checkpoint(tmp_path)
    capsys.readouterr()
    assert main(["bench", "law", str(checkpoint), "--seconds", "0.1", "--beside", "--json"]) == 0
    rows = {row["way"]: row for row in json.loads(capsys.readouterr().out)}
    assert [*rows][-2:] == ["MPC over T (fatrop)", "SB3's predict"]
    assert rows["C, -O3"]["median"] < min(rows[way]["median"] for way in [*rows][-2:])
