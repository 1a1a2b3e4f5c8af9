"""Drawings of robots: the places of their bodies against MuJoCo's, views, and links without bodies."""

import math
import re

import numpy as np
import pytest

from lyapnet.base.shapes import Disk, Line, Polygon, oblique
from lyapnet.task.models import robots
from lyapnet.task.systems.equations import defined
from tests.task.models.robot_files import CART_POLE, LEG, TWO_LINK, mjcf, urdf

pytest.importorskip("adam")
mujoco = pytest.importorskip("mujoco")


def system_of(model):
    names = (dict.fromkeys(each, "") for each in (model.states, model.controls))
    return defined(model.equations, *names, drawing=model.drawing)()


def drawn(system, q):
    return system.draw(np.concatenate([q, np.ones(system.n - len(q))]), np.ones(system.m))


def placed(text, model, q):
    """MuJoCo's data at positions of the joints in the order of the model."""
    plant = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(plant)
    for name, value in zip(model.states[: plant.nq], q, strict=True):
        data.qpos[mujoco.mj_name2id(plant, mujoco.mjtObj.mjOBJ_JOINT, name)] = value
    mujoco.mj_forward(plant, data)
    return plant, data


@pytest.mark.parametrize("seed", range(4))
def test_spheres_of_a_random_urdf_are_where_mujoco_has_them(seed):
    count, random = iter(range(100)), np.random.default_rng(seed)

    def with_sphere(found):
        place = " ".join(f"{value:.4f}" for value in random.normal(size=3))
        shape = f'<geometry><sphere radius="{0.1 + next(count) / 100:.3f}"/></geometry>'
        return f'{found[0]}<collision><origin xyz="{place}" rpy="0.1 0.2 0.3"/>{shape}</collision>'

    text = re.sub("</inertial>", with_sphere, urdf(seed))
    model = robots.model_of_urdf(text.encode())
    system = system_of(model)
    for _ in range(3):
        q = random.normal(size=system.n // 2)
        plant, data = placed(text, model, q)
        expected = {
            round(float(size[0]), 3): oblique(at) for size, at in zip(plant.geom_size, data.geom_xpos, strict=True)
        }
        got = {round(shape.radius, 3): shape.center for shape in drawn(system, q) if isinstance(shape, Disk)}
        assert len(expected) > 3
        assert got.keys() == expected.keys()
        for radius, center in got.items():
            np.testing.assert_allclose(center, expected[radius], atol=1e-10)


@pytest.mark.parametrize("seed", range(4))
def test_boxes_of_a_random_mjcf_are_where_mujoco_has_them(seed):
    text, random = mjcf(seed), np.random.default_rng(seed)
    model = robots.model_of_mjcf(text.encode())
    system = system_of(model)
    q = random.normal(size=system.n // 2)
    plant, data = placed(text, model, q)
    signs = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1)
    expected = np.concatenate(
        [
            oblique((at[:, None] + turn.reshape(3, 3) @ (size[:, None] * signs)).T)
            for at, turn, size in zip(data.geom_xpos, data.geom_xmat, plant.geom_size, strict=True)
        ]
    )
    got = np.concatenate([shape.points for shape in drawn(system, q) if isinstance(shape, Polygon)])
    assert len(got) == 3 * len(expected), "six faces of four corners"
    distance = np.linalg.norm(got[:, None] - expected, axis=-1)
    assert distance.min(0).max() < 1e-10
    assert distance.min(1).max() < 1e-10


def test_a_cart_with_a_pole_is_seen_from_the_side():
    model = robots.model_of_mjcf(CART_POLE.encode())
    cart, top, foot, pole = drawn(system_of(model), np.array([0.3, 0.5]))
    assert sorted(cart.points) == [
        [pytest.approx(0.3 + a), pytest.approx(b)] for a in (-0.1, 0.1) for b in (-0.05, 0.05)
    ]
    end = [0.3 + 0.6 * math.sin(0.5), 0.6 * math.cos(0.5)]
    assert {tuple(np.round(each.center, 12)) for each in (top, foot)} == {tuple(np.round(end, 12)), (0.3, 0.0)}
    assert top.radius == foot.radius == 0.02
    np.testing.assert_allclose(np.mean(pole.points, 0), [0.3 + 0.3 * math.sin(0.5), 0.3 * math.cos(0.5)])


@pytest.mark.parametrize(("axis", "tip"), [
    ("0 1 0", lambda a: (math.sin(a), math.cos(a))),  # x and z: the rod points along z
    ("1 0 0", lambda a: (-math.sin(a), math.cos(a))),  # y and z
    ("0 0 1", lambda a: (0.0, 0.0)),  # from above the rod is a point
    ("0 1 1", lambda a: tuple(oblique([math.sin(a) / math.sqrt(2), (1 - math.cos(a)) / 2, (1 + math.cos(a)) / 2]))),
])  # fmt: skip
def test_a_robot_is_seen_along_the_axis_about_which_all_turn(axis, tip):
    text = (
        '<robot name="rod"><link name="base"/><link name="rod"><inertial><mass value="1"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial><visual><origin xyz="0 0 1"/><geometry>'
        '<sphere radius="0.2"/></geometry></visual></link><joint name="pivot" type="continuous"><parent link="base"/>'
        f'<child link="rod"/><axis xyz="{axis}"/></joint></robot>'
    )
    (disk,) = drawn(system_of(robots.model_of_urdf(text.encode())), np.array([0.7]))
    np.testing.assert_allclose(disk.center, tip(0.7), atol=1e-12)
    assert disk.radius == 0.2


def test_links_without_bodies_are_bones_and_the_last_one_the_box_of_its_inertia():
    upper, lower = drawn(system_of(robots.model_of_urdf(TWO_LINK.encode())), np.zeros(2))
    assert isinstance(upper, Line)
    np.testing.assert_allclose(upper.points, [[0, 0], [0, 0.5]], atol=1e-12)
    moment, least = 0.021, 0.001  # of a box with sides a, a, c: m (a² + c²)/12 and m a²/6
    a, c = math.sqrt(6 * least), math.sqrt(12 * moment - 6 * least)
    np.testing.assert_allclose(np.ptp(lower.points, 0), [a, c])
    np.testing.assert_allclose(np.mean(lower.points, 0), [0, 0.75])


@pytest.mark.parametrize("geometry", [
    '<mesh filename="a.stl"/>', '<box size="1 2"/>', '<sphere radius="big"/>', '<box size="1 1 inf"/>', "",
])  # fmt: skip
def test_what_cannot_be_drawn_does_not_refuse_the_robot(geometry):
    text = LEG.replace('<link name="shank">', f'<link name="shank"><visual><geometry>{geometry}</geometry></visual>')
    assert robots.model_of_urdf(text.encode()).drawing == robots.model_of_urdf(LEG.encode()).drawing


def test_names_of_motors_are_not_those_of_results():
    text = CART_POLE.replace('name="force"', 'name="v0"').replace('name="hinge"', 'name="v1"')
    assert len(drawn(system_of(robots.model_of_mjcf(text.encode())), np.zeros(2))) == 4
