"""Robots from URDF and MJCF: accelerations against MuJoCo's, limits and names, and what is refused."""

import json

import numpy as np
import pytest
import torch

from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import load_config
from lyapnet.task.models import reading, robots
from lyapnet.task.models.systems import TOLERANCE
from lyapnet.task.systems.equations import defined
from tests.task.models.robot_files import ROBOTS, mjcf, urdf

pytest.importorskip("adam")
mujoco = pytest.importorskip("mujoco")


def system_of(model):
    names = ([*model.states], [*model.controls])
    return defined(model.equations, *(dict.fromkeys(each, "") for each in names))()


def difference(text, model, friction=0.0):
    """The largest difference of ẋ from MuJoCo's, relative to its largest acceleration."""
    plant = mujoco.MjModel.from_xml_string(text)
    flags = mujoco.mjtDisableBit
    plant.opt.disableflags |= flags.mjDSBL_CONTACT | flags.mjDSBL_LIMIT | flags.mjDSBL_FRICTIONLOSS
    data, system, random = mujoco.MjData(plant), system_of(model), np.random.default_rng(1)
    names = model.states[: plant.nv]  # in the order of the file, which is not MuJoCo's where a tree branches
    order = [mujoco.mj_name2id(plant, mujoco.mjtObj.mjOBJ_JOINT, name) for name in names]
    worst = 0.0
    for _ in range(20):
        q, rate, u = (random.normal(size=k) for k in (plant.nq, plant.nv, len(model.controls)))
        data.qpos[order], data.qvel[order] = q, rate
        if plant.nu:
            data.ctrl[:] = u
        else:  # a URDF has no actuators in MuJoCo
            data.qfrc_applied[order] = u - friction * np.tanh(rate / robots.SLIDING)
        mujoco.mj_forward(plant, data)
        x, u = torch.tensor(np.concatenate([q, rate])), torch.tensor(u)
        got = (system.f(x) + system.g(x) @ u).numpy()
        expected = np.concatenate([rate, data.qacc[order]])
        worst = max(worst, np.abs(got - expected).max() / np.abs(expected).max())
    return worst


@pytest.mark.parametrize("seed", range(8))
def test_a_random_urdf_moves_as_in_mujoco(seed):
    text = urdf(seed)
    assert difference(text, robots.model_of_urdf(text.encode())) < 1e-11


def test_dry_friction_is_smooth():
    text = urdf(3, friction=0.4)
    assert difference(text, robots.model_of_urdf(text.encode()), friction=0.4) < 1e-11


def test_a_wrong_mass_is_noticed():
    text = urdf(0)
    changed = text.replace('<mass value="', '<mass value="1', 1)
    assert difference(text, robots.model_of_urdf(changed.encode())) > 1e-3


@pytest.mark.parametrize("seed", range(8))
def test_a_random_mjcf_moves_as_in_mujoco(seed):
    text = mjcf(seed)
    assert difference(text, robots.model_of_mjcf(text.encode())) < 1e-9


@pytest.mark.parametrize(
    ("option", "part"),
    [
        ('<option density="1000" viscosity="0.1"/>', "differ from MuJoCo's"),
        ('<equality><joint joint1="j0" joint2="j1"/></equality>', "differ from MuJoCo's"),
        ("<worldbody><body><freejoint/><geom size='1'/></body></worldbody>", "free or ball joint"),
        ('<actuator><general joint="j0" dyntype="filter" dynprm="1"/></actuator>', "Expected actuators on joints"),
        ('<actuator><motor joint="j0" forcerange="-1 1"/></actuator>', "Expected actuators on joints"),
    ],
)
def test_other_elements_of_mjcf_are_refused(option, part):
    text = mjcf(1).replace("<worldbody>", f"{option}<worldbody>", 1)
    with pytest.raises(UsageError, match="Expected") as error:
        robots.model_of_mjcf(text.encode())
    assert part in str(error.value)


@pytest.mark.parametrize("name", ROBOTS)
def test_a_named_robot_moves_as_in_mujoco(name):
    kind, text, sections = ROBOTS[name]
    model = (robots.model_of_urdf if kind == "urdf" else robots.model_of_mjcf)(text.encode())
    assert len(sections["initial_states"]["lower"]) == len(model.states)
    assert difference(text, model) < 1e-9


def arm(**limit):
    given = {"effort": "5", **limit}
    written = " ".join(f'{key}="{value}"' for key, value in given.items())
    return (
        '<robot name="arm"><link name="base"/><link name="rod"><inertial><origin xyz="0 0 0.5"/><mass value="2"/>'
        '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>'
        '<visual><geometry><mesh filename="/etc/passwd"/></geometry></visual></link>'
        '<joint name="elbow pitch" type="continuous"><parent link="base"/><child link="rod"/><axis xyz="0 1 0"/>'
        f"<limit {written}/></joint></robot>"
    )


def test_one_rod_is_a_pendulum():
    model = robots.model_of_urdf(arm().encode())
    assert (model.states, model.controls) == (["elbow_pitch", "elbow_pitch_rate"], ["elbow_pitch_torque"])
    assert (model.units, model.angles) == (["rad", "rad/s", "N·m"], ["elbow_pitch"])
    assert model.limits == [[-5.0], [5.0]]
    system = system_of(model)
    x, inertia = torch.tensor([[0.3, 0.7]], dtype=torch.float64), 0.1 + 2 * 0.5**2
    assert float(system.f(x)[0, 1]) == pytest.approx(2 * 9.81 * 0.5 * np.sin(0.3) / inertia)
    assert float(system.g(x)[0, 1, 0]) == pytest.approx(1 / inertia)


@pytest.mark.parametrize(
    ("text", "part"),
    [
        (arm(effort=0), "Expected a robot with motors"),
        (arm().replace("continuous", "floating"), "which is floating"),
        (arm().replace("<limit", '<mimic joint="a"/><limit'), "which is mimic"),
        ("<mujoco/>", "for MJCF write name: mjcf"),
        ('<!DOCTYPE robot [<!ENTITY a "b">]>' + arm(), "<!DOCTYPE>"),
        (arm(effort="nan"), "Expected a number for effort"),
    ],
)
def test_what_a_urdf_may_not_have(text, part):
    with pytest.raises(UsageError, match="Expected") as error:
        robots.model_of_urdf(text.encode())
    assert part in str(error.value)


def config(folder, kind, text, **changes):
    (folder / f"robot.{kind}").write_text(text, encoding="utf-8")
    content = {
        "system": {"name": kind, "file": f"robot.{kind}"},
        "cost": {"Q": [1, 0.1], "R": 0.1, "Q_T": [1, 0.1]},
        "initial_states": {"lower": [-1, -1], "upper": [1, 1]},
        "horizon": {"steps": 20},
        **changes,
    }
    path = folder / "task.yaml"
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


@pytest.mark.gate
def test_a_file_brings_names_units_and_limits(tmp_path):
    found = load_config(config(tmp_path, "urdf", arm()))
    assert found.system.states == {"elbow_pitch": "rad", "elbow_pitch_rate": "rad/s"}
    assert found.system.angles == ["elbow_pitch"]
    system = build_problem(found).system
    assert system.title == "robot", "the file's name"
    assert len(system.draw(np.zeros(2), np.zeros(1))) == 1, "the rod"
    path = config(tmp_path, "urdf", arm(), system={"name": "urdf", "file": "robot.urdf", "drawing": "disk(0, 0, 1)"})
    assert load_config(path).system.drawing == "disk(0, 0, 1)", "that of the YAML"
    assert (found.controls.lower, found.controls.upper) == ([-5.0], [5.0])
    found = load_config(config(tmp_path, "urdf", arm(), controls={"lower": -1, "upper": 1}))
    assert (found.controls.lower, found.controls.upper) == (-1, 1)


HOSTILE = {
    "an entity": '<!DOCTYPE a [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;">]><{root} name="&b;"/>',
    "nothing": "",
    "no XML": "robot: arm",
    "deep": "<a>" * 100_000,
    "an include": '<mujoco><include file="/etc/passwd"/></mujoco>',
    "a mesh": '<mujoco><asset><mesh name="a" file="/etc/passwd"/></asset></mujoco>',
    "many links": "<robot name='a'>" + "<link name='b'/>" * 100_000 + "</robot>",
    "a loop": arm().replace('<parent link="base"/>', '<parent link="rod"/>'),
    "no number": arm().replace('value="2"', 'value="two"'),
    "a negative mass": arm().replace('value="2"', 'value="-2"'),
}


@pytest.mark.gate
@pytest.mark.parametrize("kind", ["urdf", "mjcf"])
@pytest.mark.parametrize("name", sorted(HOSTILE))
def test_hostile_files_are_refused_in_one_line(kind, name, tmp_path):
    path = tmp_path / "robot"
    path.write_text(HOSTILE[name].replace("{root}", "robot" if kind == "urdf" else "mujoco"), encoding="utf-8")
    with pytest.raises(UsageError, match="Expected") as error:
        reading.read_model(path, kind, {"states": [], "controls": []})
    assert len(str(error.value).splitlines()) == 1


def test_tolerance_is_that_of_rounding():
    assert TOLERANCE <= 1e-12
