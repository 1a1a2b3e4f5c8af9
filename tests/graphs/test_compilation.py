"""Machine code: the same numbers, once per machine; without a compiler, a line and no code."""

import copy
import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from lyapnet.build import build_problem, build_program, build_rollout, build_value_function
from lyapnet.config import load_config
from lyapnet.errors import CompilationError, UntraceableError
from lyapnet.graphs import compilation
from lyapnet.graphs.tracing import trace
from lyapnet.rollout import discrete_adjoint

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
    rollout = build_rollout(config, problem, build_value_function(config, problem))
    return rollout, build_program(config), problem.initial_states


def gradient(rollout, program, x0):
    loss = program(rollout(x0)).loss
    return torch.cat([g.flatten() for g in torch.autograd.grad(loss, rollout.discrete.trained())])


needs_compiler = pytest.mark.skipif(not compilation.has_compiler(), reason="needs a C++ compiler")


def measured(what):
    """What this file prints as a script: in a process of its own, since shape checks are not for a compiler."""
    command = [sys.executable, __file__, what]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


@needs_compiler
@pytest.mark.slow
def test_a_scan_as_machine_code_computes_the_same(cache):
    """x ↦ sin(wx) + t, three times, with what all steps share computed once."""
    found = measured("scan")
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
    before = compilation.is_on_disk(scan, arguments)
    with torch.no_grad():
        code = compilation.compiled(scan, arguments)
        error, difference = (
            max(float((a - b).abs().max()) for a, b in zip(code(*given), scan.loop(*arguments), strict=True))
            for given in (arguments, [2 * w, t, dt, x])
        )
    after = compilation.is_on_disk(scan, arguments)
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


@pytest.mark.slow
@needs_compiler
def test_machine_code_computes_the_same_and_is_kept(cache):
    found = measured("rollout")
    assert found["before"] is False
    assert found["after"] is True
    assert len(list(cache.iterdir())) == 6  # with digests; nothing is left of the compilation but its results
    assert found["gradient_error"] < 1e-10
    assert found["error_in_slices"] < 1e-10
    assert found["error_from_a_transposed_batch"] < 1e-10
    assert found["error_after_the_weights_were_frozen"] < 1e-10
    assert found["difference_after_a_change_of_weights"] > 1e-3
    assert found["error_without_a_compiler"] < 1e-10
    assert found["on_disk"] == {
        "system.parameters.mass=2": True,  # a buffer, and so an argument of the code
        "rollout.method=midpoint": False,
        "training.batch_size=4": False,
        "seed=1": True,
    }


def measure_machine_code():
    """What the test above needs to know, of a cache that is empty."""
    rollout, program, X0 = rollout_of()
    replayed = copy.deepcopy(rollout)
    x0, others = (X0.sample(b, torch.Generator().manual_seed(b)) for b in (3, 7))
    found: dict = {"before": rollout.discrete.is_on_disk(x0)}
    rollout.discrete.compile(x0)
    found["after"] = rollout.discrete.is_on_disk(x0)
    exact = gradient(replayed, program, x0)
    found["gradient_error"] = float((gradient(rollout, program, x0) - exact).norm() / exact.norm())
    with torch.no_grad():
        found["error_in_slices"] = float((rollout(others).x - replayed(others).x).abs().max())
        rollout.closed_loop.policy.V.network.weights.weight.mul_(1.5)  # parameters are arguments of the code
        found["difference_after_a_change_of_weights"] = float((rollout(x0).value - replayed(x0).value).abs().max())
    transposed = x0.mT.contiguous().mT  # its rows do not lie one after the other in memory
    difference = gradient(rollout, program, transposed) - gradient(rollout, program, x0)
    found["error_from_a_transposed_batch"] = float(difference.norm() / exact.norm())
    compilation.has_compiler = lambda: False  # what is on disk needs none
    again, *_ = rollout_of()
    again.discrete.compile(x0)
    found["error_without_a_compiler"] = float((again(x0).x - replayed(x0).x).abs().max())
    for p in again.parameters():
        p.requires_grad_(False)
    found["error_after_the_weights_were_frozen"] = float((again(x0).x - rollout_of()[0](x0).x).abs().max())
    found["on_disk"] = {
        change: rollout_of(change)[0].discrete.is_on_disk(torch.zeros(4 if "batch" in change else 3, 2).double())
        for change in ("system.parameters.mass=2", "rollout.method=midpoint", "training.batch_size=4", "seed=1")
    }
    print(json.dumps(found))


def test_a_loop_that_cannot_be_traced_says_so(monkeypatch):
    rollout, _, _ = rollout_of()
    dynamics = rollout.closed_loop.system.dynamics
    monkeypatch.setattr(
        type(rollout.closed_loop.system),
        "dynamics",
        lambda self, x, u: dynamics(x, u) * (2 if float(x.sum()) > 9 else 1),
    )
    with pytest.raises(UntraceableError, match=r"reads the values of a tensor at test_compilation\.py:\d+ \(.*float"):
        rollout.discrete.compile(torch.zeros(3, 2))


def test_without_a_compiler_there_is_no_machine_code(no_compiler):
    with pytest.raises(CompilationError, match="got none"):
        rollout_of()[0].discrete.compile(torch.zeros(3, 2))


def test_everything_has_to_be_on_disk(monkeypatch):
    for answers in ([True, True, False], [True, True, True]):
        remaining = iter(answers)
        monkeypatch.setattr(discrete_adjoint, "is_on_disk", lambda *_, left=remaining: next(left))
        assert rollout_of()[0].discrete.is_on_disk(torch.zeros(3, 2)) is all(answers)


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
    {"scan": measure_scan, "rollout": measure_machine_code}[sys.argv[1]]()
