"""Machine code for one task, as on a GPU: the same numbers, once per machine; without a compiler, none."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from lyapnet.build import build_problem, build_rollout, build_value_function
from lyapnet.config import load_config
from lyapnet.errors import CompilationError, UntraceableError
from lyapnet.graphs import compilation, libraries
from lyapnet.graphs.number_kernel import kernel
from lyapnet.graphs.tracing import trace

CONFIG = Path(__file__).parents[2] / "conf" / "from_scratch" / "double_integrator.yaml"
SMALL = ["network.hidden=[4,4]", "horizon.steps=6", "training.batch_size=3", "training.iterations=1"]


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """A cache of its own, empty."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("LYAPNET_CACHE", str(folder))
    return folder


@pytest.fixture
def no_compiler(monkeypatch):
    monkeypatch.setattr(compilation, "has_compiler", lambda: False)


def rollout_of(*overrides):
    config = load_config(CONFIG, [*SMALL, *overrides])
    problem = build_problem(config)
    return build_rollout(config, problem, build_value_function(config, problem))


needs_compiler = pytest.mark.skipif(not compilation.has_compiler(), reason="needs a C++ compiler")


def measured():
    """What this file prints as a script: in a process of its own, since shape checks are not for a compiler."""
    command = [sys.executable, __file__]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


@needs_compiler
@pytest.mark.slow
def test_a_scan_as_machine_code_computes_the_same(cache):
    """x ↦ sin(wx) + t, three times, with what all steps share computed once."""
    found = measured()
    assert found["before"] is False
    assert found["after"] is True
    assert found["error"] < 1e-12
    assert found["difference_with_another_weight"] > 1e-3
    assert len(list(cache.glob("*.pt2"))) == 1
    assert found["twice"] is True
    assert found["refused"] == dict.fromkeys(("flipped", "exchanged", "writable", "without a digest"), True)
    assert "only you can write" in found["folder"]


def assigned(w):
    """As in g of many systems: one number written into zeros."""
    numbers = torch.zeros_like(w)
    numbers[-1] = 0.25
    return numbers


def measure_scan():
    """What the test above needs to know."""
    w, t, dt, x = (torch.tensor(y).double() for y in ([1.5, 0.5], [0.0, 1.0, 2.0], [1.0] * 3, [1.0] * 2))
    prepare = trace(lambda w: (2 * w + assigned(w),), (w,))
    step = trace(lambda w, t, dt, x, shared: (torch.sin(shared * x) + t * dt, 2 * x, w + x), (w, t[0], dt[0], x, w))
    scan, arguments = compilation.Scan(prepare, step, 1), [w, t, dt, x]
    before = compilation.file_of(scan, arguments).is_file()
    with torch.no_grad():
        code = compilation.compiled(scan, arguments)
        error, difference = (
            max(float((a - b).abs().max()) for a, b in zip(code(*given), scan.loop(*arguments), strict=True))
            for given in (arguments, [2 * w, t, dt, x])
        )
    after = compilation.file_of(scan, arguments).is_file()
    found = {"before": before, "after": after, "error": error, "difference_with_another_weight": difference}
    print(json.dumps({**found, **measure_what_is_refused(compilation.file_of(scan, arguments), scan, arguments)}))


def measure_what_is_refused(path, scan, arguments):
    """Whether a changed file is taken for missing, where there is no compiler to replace it; and a folder's refusal."""
    whole, digest = path.read_bytes(), path.with_suffix(".sha256").read_text()
    compilation.has_compiler = lambda: False

    def refusal():
        try:
            compilation.compiled(scan, arguments)
        except CompilationError as error:
            return str(error)
        return ""

    middle = len(whole) // 2
    changes = {
        "flipped": lambda: path.write_bytes(whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :]),
        "exchanged": lambda: path.write_bytes(b"PK evil"),
        "writable": lambda: path.chmod(0o620),
        "without a digest": lambda: path.with_suffix(".sha256").unlink(),
    }
    found: dict = {"twice": refusal() == "", "refused": {}}
    for name, change in changes.items():
        change()
        found["refused"][name] = "compiler" in refusal() and not path.exists()
        path.write_bytes(whole)
        path.chmod(0o600)
        path.with_suffix(".sha256").write_text(digest)
        assert refusal() == "", "the twin"
    path.parent.chmod(0o770)
    found["folder"] = refusal()
    return found


def test_a_loop_that_cannot_be_traced_says_so(monkeypatch):
    rollout = rollout_of()
    dynamics = rollout.closed_loop.system.dynamics
    monkeypatch.setattr(
        type(rollout.closed_loop.system),
        "dynamics",
        lambda self, x, u: dynamics(x, u) * (2 if float(x.sum()) > 9 else 1),
    )
    with pytest.raises(UntraceableError, match=r"reads the values of a tensor at test_compilation\.py:\d+ \(.*float"):
        rollout.discrete.compile(torch.zeros(3, 2))


def test_without_a_compiler_there_is_no_machine_code(monkeypatch):
    monkeypatch.setattr(libraries, "has_compiler", lambda: False)
    kernel.library.cache_clear()
    with pytest.raises(CompilationError, match="got none"):
        rollout_of().discrete.compile(torch.zeros(3, 2))


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o720, 0o702])
def test_folder_that_others_can_write_is_refused(mode, cache):
    graph = trace(lambda x: (torch.sin(x),), (torch.zeros(3),))
    cache.mkdir()
    cache.chmod(mode)
    with pytest.raises(CompilationError, match="only you can write") as raised:
        compilation.compiled(graph, [torch.zeros(3)])
    assert str(cache) in str(raised.value)
    assert "chmod go-w" in str(raised.value)


def test_folder_of_another_user_is_refused(cache, monkeypatch):
    graph = trace(lambda x: (torch.sin(x),), (torch.zeros(3),))
    cache.mkdir(mode=0o700)
    monkeypatch.setattr(compilation.os, "getuid", lambda: cache.stat().st_uid + 1)
    with pytest.raises(CompilationError, match="only you can write"):
        compilation.compiled(graph, [torch.zeros(3)])


def test_a_file_of_machine_code_that_was_cut_short_is_replaced(cache, no_compiler, caplog):
    """Without a compiler, it is missed instead."""
    x = torch.zeros(3)
    graph = trace(lambda x: (torch.sin(x),), (x,))
    cache.mkdir(mode=0o700)
    path = compilation.file_of(graph, [x])
    path.write_bytes(b"PK\x03\x04 cut short")
    with pytest.raises(CompilationError, match=r"C\+\+ compiler"):
        compilation.compiled(graph, [x])
    assert not path.exists()
    (note,) = (record.getMessage() for record in caplog.records if record.name.startswith("lyapnet"))
    assert str(path) in note
    assert "\n" not in note


@pytest.mark.parametrize("change", ["constant", "operation", "shape", "dtype"])
def test_other_functions_and_arguments_have_files_of_their_own(change, cache):
    def file(weight=2.0, operation=torch.sin, x=torch.zeros(3)):  # noqa: B008
        weight = torch.tensor(weight)
        return compilation.file_of(trace(lambda x: (operation(x) * weight.to(x),), (x,)), [x])

    others = {"constant": {"weight": 3.0}, "operation": {"operation": torch.cos}, "shape": {"x": torch.zeros(4)},
              "dtype": {"x": torch.zeros(3).float()}}  # fmt: skip
    assert file() == file()
    assert file() != file(**others[change])


if __name__ == "__main__":
    measure_scan()
