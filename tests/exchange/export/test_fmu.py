"""A unit for co-simulation: its description is valid, its answers are those of Python; and what is refused."""

import platform
import shutil
import subprocess
import sys
import zipfile
from xml.etree import ElementTree

import numpy as np
import pytest
import torch

from lyapnet.base.errors import UsageError
from lyapnet.exchange.export import export
from lyapnet.exchange.export.c import STRICT
from tests.exchange.export.test_c_loop import LOOPS, controller_of
from tests.marks import sample
from tests.problems import untrained

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
runs_here = pytest.mark.skipif(
    (sys.platform, platform.machine()) != ("linux", "x86_64"), reason="binaries are looked for on Linux alone"
)
SHORT = ("horizon.steps=12", "network.hidden=[8,8]")
VERSIONS = ("2.0", "3.0")


def unit_of(exported, folder, version="2.0", **options):
    """The file of a unit."""
    export(exported, folder / "unit.fmu", "fmu", fmi=version, **options)
    return folder / "unit.fmu"


def signal(names, values, dt):
    """Inputs over time for FMPy."""
    rows = [(k * dt, *row) for k, row in enumerate(values)]
    return np.array(rows, dtype=[("time", float), *((name, float) for name in names)])


@pytest.mark.gate
@pytest.mark.parametrize("version", sample(VERSIONS, 2))
def test_it_has_a_description_its_source_and_a_binary(version, tmp_path):
    file = unit_of(LOOPS["one state"](), tmp_path, version, name="level")
    with zipfile.ZipFile(file) as archive:
        names, description = archive.namelist(), archive.read("modelDescription.xml").decode()
        texts = [archive.read(name).decode() for name in names if name.startswith("sources/")]
    assert {"sources/fmu.c", "sources/policy.c", "sources/policy.h"} <= set(names)
    assert ("sources/buildDescription.xml" in names) == (version == "3.0")
    if (sys.platform, platform.machine()) == ("linux", "x86_64"):
        assert f"binaries/{'linux64' if version == '2.0' else 'x86_64-linux'}/level.so" in names
    root = ElementTree.fromstring(description)
    assert root.attrib["fmiVersion"] == version
    assert root.attrib["guid" if version == "2.0" else "instantiationToken"] in "".join(texts)
    found = {
        each.attrib["name"]: each.attrib
        for each in root.iter()
        if "valueReference" in each.attrib and "name" in each.attrib
    }
    assert list(found) == ["time", "level_d", "pump", "code"]
    assert found["level_d"]["description"] == '*/ "level" \\ %d'
    assert not any(str(tmp_path) in text for text in [description, *texts])


@pytest.mark.gate
@runs_here
@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("kind", ["the law", "a loop"])
def test_fmpy_finds_it_valid_and_its_answers_are_pythons(kind, version, tmp_path):
    fmpy, validation = pytest.importorskip("fmpy"), pytest.importorskip("fmpy.validation")
    controller = controller_of()
    loop = controller.with_estimator(input_disturbances={"torque": 0.1})
    file = str(unit_of(controller if kind == "the law" else loop, tmp_path, version))
    assert validation.validate_fmu(file) == []
    dt, N = controller.horizon.dt, 40
    names = ["angle", "velocity"] if kind == "the law" else ["angle"]
    values = 0.1 * np.random.default_rng(0).standard_normal((N + 1, len(names))).cumsum(0)
    for share in (1, 4, 0.5):
        h, held = dt / share, max(1, round(1 / share))
        result = fmpy.simulate_fmu(
            file, start_time=0, stop_time=N * dt, step_size=h, output_interval=h, input=signal(names, values, dt),
            output=["torque", "code"],
        )  # fmt: skip
        given = [values[k - k % held] for k in range(N)]  # inputs are those at the beginning of a step
        if kind == "the law":
            u = np.array([float(controller.policy(k * dt, x)[0]) for k, x in enumerate(given)])
        else:
            loop.reset()
            u = np.array([float(loop.step(y)[0]) for y in given])
        steps = {round(time / h): force for time, force in zip(result["time"], result["torque"], strict=True)}
        found = [steps[int(k * share) + 1] for k in range(held - 1, N, held)]
        assert found == pytest.approx(u[held - 1 :: held], rel=1e-9, abs=1e-9)
        assert result["torque"][0] == pytest.approx(u[0], rel=1e-9), "the control at the start knows the inputs there"


@pytest.mark.gate
@runs_here
def test_stepped_before_the_plant_it_is_the_closed_loop(tmp_path):
    fmi2, fmpy = pytest.importorskip("fmpy.fmi2"), pytest.importorskip("fmpy")
    controller = controller_of()
    file = unit_of(controller, tmp_path)
    described, folder = fmpy.read_model_description(str(file)), fmpy.extract(str(file), str(tmp_path / "unit"))
    unit = fmi2.FMU2Slave(
        guid=described.guid, unzipDirectory=folder, modelIdentifier=described.coSimulation.modelIdentifier
    )
    unit.instantiate()
    x = torch.tensor([0.8, -0.5], dtype=torch.float64)
    expected = controller.rollout(x[None]).x[:, 0]
    for _ in range(2):
        unit.setupExperiment(startTime=3.0)
        unit.enterInitializationMode()
        unit.exitInitializationMode()
        dt, path = controller.horizon.dt, [x]
        for k in range(controller.horizon.steps):
            unit.setReal([1, 2], path[-1].tolist())
            unit.doStep(currentCommunicationPoint=3.0 + k * dt, communicationStepSize=dt)
            path.append(controller.problem.step(path[-1], torch.tensor(unit.getReal([3])).double())[0])
        assert torch.stack(path) == pytest.approx(expected, rel=1e-9, abs=1e-9)
        with pytest.raises(Exception, match="fmi2DoStep failed"):
            unit.doStep(currentCommunicationPoint=0.0, communicationStepSize=dt)
        with pytest.raises(Exception, match="fmi2SetReal failed"):
            unit.setReal([3], [0.0])
        unit.terminate()
        unit.reset()  # and once more
    unit.freeInstance()
    stranger = fmi2.FMU2Slave(guid="another", unzipDirectory=folder, modelIdentifier="lyapnet")
    with pytest.raises(Exception, match="Failed to instantiate"):
        stranger.instantiate()


@pytest.mark.gate
@runs_here
@pytest.mark.parametrize("version", VERSIONS)
def test_parameters_of_a_family_are_set(version, tmp_path):
    fmpy, validation = pytest.importorskip("fmpy"), pytest.importorskip("fmpy.validation")
    controller = untrained("cartpole_family", *SHORT)
    file = str(unit_of(controller, tmp_path, version, dtype="float32"))
    assert validation.validate_fmu(file) == []
    n = controller.system.n - len(controller.system.constants)
    described = fmpy.read_model_description(file)
    parameters = [each for each in described.modelVariables if each.causality == "parameter"]
    assert [each.variability for each in parameters] == ["tunable"] * len(controller.system.constants)
    z = ((controller.initial_states.center + controller.initial_states.upper) / 2).numpy()
    names = [each.name for each in described.modelVariables if each.causality == "input"]
    (control,) = (
        each.name
        for each in described.modelVariables
        if each.causality == "output" and each.type != "Integer" and each.type != "Int32"
    )
    dt = controller.horizon.dt
    for p in (z[n:], controller.initial_states.lower.numpy()[n:]):
        result = fmpy.simulate_fmu(
            file, stop_time=dt, step_size=dt, output_interval=dt, input=signal(names, [z[:n], z[:n]], dt),
            start_values={each.name: value for each, value in zip(parameters, p, strict=True)}, output=[control],
        )  # fmt: skip
        expected = float(controller.policy(0.0, np.concatenate([z[:n], p]))[0])
        assert result[control][1] == pytest.approx(expected, rel=1e-3, abs=1e-4)


@pytest.mark.gate
@runs_here
def test_settings_of_a_loop_are_inputs(tmp_path):
    fmpy, validation = pytest.importorskip("fmpy"), pytest.importorskip("fmpy.validation")
    loop = LOOPS["settings"]()
    file, dt = str(unit_of(loop, tmp_path)), loop.controller.horizon.dt
    assert validation.validate_fmu(file) == []
    goals = [0.1, 0.1, -0.2, -0.2, 0.3, 0.3]
    given = signal(["angle", "target_angle"], [(0.2, goal) for goal in goals], dt)
    result = fmpy.simulate_fmu(
        file, stop_time=5 * dt, step_size=dt, output_interval=dt, input=given, output=["torque"]
    )  # fmt: skip
    expected = [float(loop.step([0.2], target_angle=goal)[0]) for goal in goals[:-1]]
    assert result["torque"][1:] == pytest.approx(expected, rel=1e-9)


@pytest.mark.gate
@pytest.mark.parametrize("version", VERSIONS)
def test_compilers_take_its_source_without_a_warning(version, tmp_path):
    file = unit_of(LOOPS["a pendulum"](), tmp_path, version)
    with zipfile.ZipFile(file) as archive:
        archive.extractall(tmp_path / "unit")
    sources = [str(tmp_path / "unit" / "sources" / name) for name in ("fmu.c", "policy.c")]
    for compiler in filter(shutil.which, ("gcc", "clang")):
        command = [compiler, *STRICT, "-shared", "-fPIC", "-o", str(tmp_path / "unit.so"), *sources, "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert not done.returncode, done.stderr
    if version == "3.0":
        fmpy, etree = pytest.importorskip("fmpy"), pytest.importorskip("lxml.etree")
        schema = etree.XMLSchema(etree.parse(f"{fmpy.__path__[0]}/schema/fmi3/fmi3BuildDescription.xsd"))
        written = (tmp_path / "unit" / "sources" / "buildDescription.xml").read_bytes()
        assert schema.validate(etree.fromstring(written)), schema.error_log
        assert not schema.validate(etree.fromstring(written.replace(b"SourceFileSet", b"SourceSet")))


@pytest.mark.gate
def test_fmpy_would_find_a_description_that_is_not_valid(tmp_path):
    validation = pytest.importorskip("fmpy.validation")
    file = unit_of(controller_of(), tmp_path)
    with zipfile.ZipFile(file) as archive, zipfile.ZipFile(tmp_path / "other.fmu", "w") as other:
        for name in archive.namelist():
            content = archive.read(name)
            other.writestr(name, content.replace(b'<Unit name="rad"/>', b"") if name.endswith(".xml") else content)
    assert validation.validate_fmu(str(tmp_path / "other.fmu"))


def test_another_version_or_place_is_refused(tmp_path):
    with pytest.raises(UsageError, match=r"Expected fmi as one of 2.0, 3.0"):
        export(controller_of(), tmp_path / "unit.fmu", "fmu", fmi="1.0")
    with pytest.raises(UsageError, match=r"ends in .fmu"):
        export(controller_of(), tmp_path / "unit.zip", "fmu")
    assert not [*tmp_path.iterdir()]
