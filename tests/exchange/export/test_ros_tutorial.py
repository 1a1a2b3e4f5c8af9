"""The ROS 2 nodes of the tutorial, held against the controller on stand-ins of what they take from ROS."""

import functools
import re
import shutil
import subprocess
import xml.etree.ElementTree as ET

import numpy as np
import pytest

import lyapnet
from lyapnet.exchange.export import compiled, export
from tests.exchange.export.ros_stand_ins import HEADERS, in_cpp, in_python
from tests.marks import sample
from tests.pages import ROOT

needs_compilers = pytest.mark.skipif(shutil.which("g++") is None or shutil.which("cc") is None, reason="no g++ or cc")
PAGE = (ROOT / "docs" / "tutorials" / "ros2.md").read_text(encoding="utf-8")
PACKAGE = ROOT / "docs" / "tutorials" / "reacher_policy"
FILES = {
    str(path.relative_to(PACKAGE)): path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.*") if path.is_file()
}
BEYOND = re.search(r"--beyond (\w+)", PAGE)[1]
NAMES = ["elbow", "gripper", "shoulder"]


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    """The package of the tutorial, with the stand-ins beside it."""
    folder = tmp_path_factory.mktemp("workspace") / "reacher_policy"
    headers = {f"../include/{name}": text for name, text in HEADERS.items()}
    for name, text in {**FILES, **headers}.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
    export(lyapnet.load("zoo:reacher_limited", beyond=BEYOND), folder / "law", "c")
    return folder


@pytest.fixture(scope="module")
def program(package):
    """The node in C++."""
    result, law = package / "policy_node", package / "law"
    subprocess.run(["cc", "-std=c99", "-O2", "-c", law / "policy.c", "-o", package / "policy.o"], check=True)
    command = ["g++", "-std=c++17", "-Wall", "-Wextra", "-Werror", f"-I{package.parent / 'include'}", f"-I{law}"]
    subprocess.run([*command, package / "src" / "policy_node.cpp", package / "policy.o", "-o", result], check=True)
    return result


@pytest.fixture(params=sample(["Python", "C++"], 2))
def run(request, monkeypatch):
    """events ↦ (Δt in ns, what was published when, log) of one of the nodes."""
    if request.param == "C++":
        program = request.getfixturevalue("program")
        return lambda events: in_cpp(program, events)
    monkeypatch.setattr("lyapnet.exchange.export.compiled", lambda controller: law_of(controller.law.beyond))
    return lambda events: in_python(monkeypatch, FILES["scripts/policy_node.py"], events)


@functools.cache
def law_of(beyond):
    return compiled(lyapnet.load("zoo:reacher_limited", beyond=beyond))


def seen(ns, x, names=NAMES):
    """The event of a state (shoulder, elbow angles and velocities), with a joint that is not the law's."""
    return (ns, names, [x[1], 0.5, x[0]], [x[3], -0.5, x[2]])


START = 7_000_000_123  # ns, of the clock when the first state comes
STEP = 10_000_000
X = (0.7, -0.4, 0.2, 0.1)


@pytest.mark.gate
@needs_compilers
def test_it_publishes_what_the_controller_says(run):
    controller = lyapnet.load("zoo:reacher_limited", beyond=BEYOND)
    assert controller.horizon.dt == STEP / 1e9
    loop = controller.rollout([2.0, -1.5, 0.0, 0.0], steps=220)
    assert controller.horizon.steps < 220
    times = START + STEP * np.arange(220)
    events = [(START - STEP,)]  # the timer, before there is a state
    for ns, x in zip(times.tolist(), loop.x.tolist(), strict=False):
        events += [seen(ns, [9.0] * 4), seen(ns, x), (ns,)]
    period, published, log = run(events)
    published = np.array(published)
    assert period == pytest.approx(STEP)
    assert published[:, 0] == pytest.approx(times)
    assert published[:, 1:] == pytest.approx(loop.u, abs=1e-9)
    assert not log
    swapped = [(*event[:1], NAMES[::-1], *event[2:]) if event[1:] else event for event in events]
    assert np.abs(np.array(run(swapped)[1])[:, 1:] - loop.u).max() > 0.1, "with other names the torques are others"


@needs_compilers
@pytest.mark.parametrize(
    ("event", "reason"),
    [
        (seen(START + STEP, (0.7, float("nan"), 0.2, 0.1)), "the state is not finite"),
        (seen(START + STEP, (0.7, -0.4, float("inf"), 0.1)), "the state is not finite"),
        (seen(START + STEP, X, ["elbow", "gripper", "hip"]), "there is no joint shoulder"),
        ((START + STEP, NAMES, [0.0, 0.0, 0.0], []), "a position and a velocity for each name are needed"),
        ((START + 6 * STEP,), "the state is too old"),
    ],
)
def test_it_stops_and_says_why_once(run, event, reason):
    late = START + 7 * STEP
    _, published, log = run([seen(START, X), (START,), (START + 5 * STEP,), event, event, seen(late, X), (late,)])
    assert log == [f"stopped, zeros from here on: {reason}"]
    assert all(u != 0 for line in published[:2] for u in line[1:]), "a state may be five steps old"
    assert all(line[1:] == [0.0, 0.0] for line in published[2:])
    assert published[-1][0] == late, "it goes on publishing zeros"


@needs_compilers
def test_it_stops_at_a_first_state_that_is_none(run):
    _, published, log = run([seen(START, X, ["a", "b", "c"]), (START,)])
    assert published == [[START, 0.0, 0.0]]
    assert len(log) == 1


@pytest.mark.gate
@needs_compilers
@pytest.mark.skipif(shutil.which("cmake") is None, reason="no cmake")
def test_the_package_builds_and_installs(package, tmp_path):
    wanted = re.findall(r"find_package\((\w+) REQUIRED\)", FILES["CMakeLists.txt"])
    for name in wanted:
        place = tmp_path / name
        place.mkdir()
        target = "rclcpp::rclcpp" if name == "rclcpp" else f"{name}::all"
        (place / f"{name}Config.cmake").write_text(
            f"add_library({target} INTERFACE IMPORTED)\nset({name}_TARGETS {target})\n"
            f'target_include_directories({target} INTERFACE "{package.parent / "include"}")\n'
            "macro(ament_package)\nendmacro()\n"
        )
    made, installed = tmp_path / "build", tmp_path / "install"
    subprocess.run(["cmake", "-S", package, "-B", made, f"-DCMAKE_PREFIX_PATH={tmp_path}"], check=True)
    subprocess.run(["cmake", "--build", made], check=True)
    subprocess.run(["cmake", "--install", made, "--prefix", installed], check=True)
    found = sorted(path.name for path in (installed / "lib" / "reacher_policy").iterdir())
    assert found == ["policy_node", "policy_node.py"]
    declared = {element.text for element in ET.fromstring(FILES["package.xml"]) if "depend" in element.tag}
    assert declared == {*wanted, "rclpy"}
