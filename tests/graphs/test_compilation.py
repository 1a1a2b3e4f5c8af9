"""C++ is compiled once for a machine, not at all without a compiler; files of other users are not run."""

import ctypes
from pathlib import Path

import pytest
import torch

from lyapnet.base.errors import CompilationError, UntraceableError
from lyapnet.experiment.assembly import build_problem, build_rollout, build_value_function
from lyapnet.experiment.config import load_config
from lyapnet.graphs import compilation
from lyapnet.graphs.number_kernel import assembly

CONFIG = Path(__file__).parents[2] / "conf" / "from_scratch" / "double_integrator.yaml"
SMALL = ["network.hidden=[4,4]", "horizon.steps=6", "training.batch_size=3", "training.iterations=1"]


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """An empty cache."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("LYAPNET_CACHE", str(folder))
    return folder


@pytest.fixture
def source(tmp_path):
    """C++ with one function, 7 unless a macro says otherwise."""
    path = tmp_path / "seven.cpp"
    path.write_text('#ifndef NUMBER\n#define NUMBER 7\n#endif\nextern "C" int number() { return NUMBER; }\n')
    return path


needs_compiler = pytest.mark.skipif(not compilation.has_compiler(), reason="needs a C++ compiler")


def rollout_of(*overrides):
    config = load_config(CONFIG, [*SMALL, *overrides])
    problem = build_problem(config)
    return build_rollout(config, problem, build_value_function(config, problem))


@needs_compiler
def test_a_file_for_each_source_and_its_options(source, cache, monkeypatch):
    assert compilation.library_of("some", (source,)).number() == 7
    assert compilation.library_of("some", (source,), "-DNUMBER=8").number() == 8
    assert len(list(cache.glob("some_*.so"))) == 2
    monkeypatch.setattr(compilation, "has_compiler", lambda: False)
    assert compilation.library_of("some", (source,)).number() == 7, "from disk"
    source.write_text(source.read_text() + "// changed")
    with pytest.raises(CompilationError, match=r"C\+\+ compiler"):
        compilation.library_of("some", (source,))


@needs_compiler
@pytest.mark.parametrize("change", ["cut short", "exchanged", "without a digest"])
def test_a_file_that_changed_is_compiled_again(change, source, cache, caplog):
    path = compilation.file_of_library("some", (source,))
    compilation.library_of("some", (source,))
    whole = path.read_bytes()
    path.unlink()  # the library that is loaded here keeps its file
    path.write_bytes({"cut short": whole[:100], "exchanged": b"another", "without a digest": whole}[change])
    path.chmod(0o600)
    if change == "without a digest":
        path.with_suffix(".sha256").unlink()
    assert compilation.library_of("some", (source,)).number() == 7
    assert path.read_bytes()[:4] == whole[:4]
    (note,) = (record.getMessage() for record in caplog.records if record.name.startswith("lyapnet"))
    assert str(path) in note
    caplog.clear()
    assert ctypes.CDLL(str(path)).number() == compilation.library_of("some", (source,)).number() == 7
    assert not caplog.records, "the counterpart: the unchanged file"


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
    monkeypatch.setattr(compilation, "has_compiler", lambda: False)
    assembly.library.cache_clear()
    with pytest.raises(CompilationError, match="got none"):
        rollout_of().discrete.compile(torch.zeros(3, 2))


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o720, 0o702])
def test_folder_that_others_can_write_is_refused(mode, source, cache):
    cache.mkdir()
    cache.chmod(mode)
    with pytest.raises(CompilationError, match="only you can write") as raised:
        compilation.library_of("some", (source,))
    assert str(cache) in str(raised.value)
    assert "chmod go-w" in str(raised.value)


def test_folder_of_another_user_is_refused(source, cache, monkeypatch):
    cache.mkdir(mode=0o700)
    monkeypatch.setattr(compilation.os, "getuid", lambda: cache.stat().st_uid + 1)
    with pytest.raises(CompilationError, match="only you can write"):
        compilation.library_of("some", (source,))
