"""Robots from URDF and MJCF files, as CasADi functions (x, u) ↦ ẋ with x = (q, q̇).

adam-robotics computes the mass matrix M(q) and the bias forces h(q, q̇) (Featherstone's algorithms on CasADi symbols);
ẋ is then (q̇, M⁻¹(τ(u) − h − D q̇ − friction)). MuJoCo reads MJCF, and the result is compared with its forward dynamics.
Like casadi_functions, this runs in a process without access to files, and imports nothing that needs torch.
"""

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from lyapnet.base.errors import UsageError
from lyapnet.base.names import identifier
from lyapnet.task.models.casadi_functions import Model, model_of_function
from lyapnet.task.models.robot_drawings import Body, bodies_of_mjcf, bodies_of_urdf, drawing_of

GRAVITY = 9.81  # m/s², in the direction −z, for URDF, which has no gravity
RATE, TORQUE, FORCE = "_rate", "_torque", "_force"  # endings of the names of a joint's rate and of its motor
SLIDING = 0.05  # rad/s or m/s, width of the transition of dry friction −friction · tanh(speed / SLIDING)
TOLERANCE = 1e-9  # largest relative difference from MuJoCo's accelerations


class Joint(NamedTuple):
    """A joint that moves.

    Args:
        slides: whether it is prismatic (m, N) instead of an angle (rad, N·m).
        damping, friction: of its rate, in N·m s/rad and N·m, or N s/m and N.
        armature: inertia that is added to the diagonal of M.
        stiffness, rest: those of a spring with the force −stiffness (q − rest).
        zero: q in the pose of the file.
    """

    name: str
    slides: bool
    damping: float = 0.0
    friction: float = 0.0
    armature: float = 0.0
    stiffness: float = 0.0
    rest: float = 0.0
    zero: float = 0.0


class Actuator(NamedTuple):
    """A force on a joint, τ = gear (gain u + offset + of_position gear q + of_rate gear q̇), with limits of u."""

    name: str
    joint: int
    lower: float
    upper: float
    gear: float = 1.0
    gain: float = 1.0
    offset: float = 0.0
    of_position: float = 0.0
    of_rate: float = 0.0


class Robot(NamedTuple):
    """Links in URDF, with joints and actuators."""

    urdf: str
    joints: list[Joint]
    actuators: list[Actuator]
    gravity: Sequence[float] = (0.0, 0.0, -GRAVITY)
    bodies: Sequence[Body] = ()  # the shapes of the file


def model_of_urdf(content: bytes, states: Sequence[str] = (), controls: Sequence[str] = ()) -> Model:
    """The equations of a robot in URDF whose first link is fixed.

    Joints are revolute, continuous, prismatic or fixed. A joint with an effort limit of 0 has no motor; without a limit
    its motor has no bound.
    """
    return _model(_robot_of_urdf(content.decode()), states, controls)


def model_of_mjcf(content: bytes, states: Sequence[str] = (), controls: Sequence[str] = ()) -> Model:
    """The equations of a robot in MJCF with hinges, slides and actuators on joints; no contacts, no limits of q."""
    mujoco: Any = import_module("mujoco")  # whose types are not declared
    text = content.decode()
    _tree(text)
    model = mujoco.MjModel.from_xml_string(text)
    robot = _robot_of_mjcf(mujoco, model)
    _require_actuators(robot)
    _require_equal(mujoco, model, robot)
    return _model(robot, states, controls)


def _model(robot: Robot, states: Sequence[str], controls: Sequence[str]) -> Model:
    joints = robot.joints
    own = [f"{identifier(each.name)}{end}" for end in ("", RATE) for each in joints]
    motors = [identifier(each.name) for each in robot.actuators]
    taken = {*own}
    motors = [name if name not in taken else f"{name}{FORCE if joints[each.joint].slides else TORQUE}"
              for name, each in zip(motors, robot.actuators, strict=True)]  # fmt: skip
    function = _function(robot)
    model = model_of_function(function, list(states) or own, list(controls) or motors)
    lengths = ["m" if each.slides else "rad" for each in joints]
    forces = ["N" if joints[each.joint].slides else "N·m" for each in robot.actuators]
    return model._replace(
        units=[*lengths, *(f"{unit}/s" for unit in lengths), *forces],
        angles=[name for name, each in zip(model.states, joints, strict=False) if not each.slides],
        limits=[[each.lower for each in robot.actuators], [each.upper for each in robot.actuators]],
        drawing=_drawing(robot, [*model.states, *model.controls]),
    )


def _drawing(robot: Robot, names: Sequence[str]) -> str:
    """The lines that draw a robot in the plane in which it moves, or obliquely."""
    import casadi

    links, q = _links(robot), casadi.SX.sym("q", len(robot.joints))
    given = [each.get("name", "") for each in ET.fromstring(robot.urdf).findall("link")]
    frames = {name: links.forward_kinematics_fun(name)(casadi.DM.eye(4), _drawn(robot, q)) for name in given}
    return drawing_of(robot.urdf, robot.bodies, frames, q, names)


def _links(robot: Robot) -> Any:
    """adam's algorithms for the links."""
    from adam.casadi import KinDynComputations

    gravity = np.array([*robot.gravity, 0.0, 0.0, 0.0])
    return KinDynComputations(_with_turns_apart(robot.urdf), [each.name for each in robot.joints], gravity=gravity)


def _drawn(robot: Robot, q: Any) -> Any:
    """The positions of the joints relative to the pose of the file."""
    return q - np.array([each.zero for each in robot.joints])


def _function(robot: Robot, friction: bool = True) -> Any:
    """(x, u) ↦ ẋ as a CasADi function."""
    import casadi

    d, links = len(robot.joints), _links(robot)
    q, rate, u = casadi.SX.sym("q", d), casadi.SX.sym("v", d), casadi.SX.sym("u", len(robot.actuators))
    base = casadi.DM.eye(4)  # the first link stands still
    drawn = _drawn(robot, q)
    M = links.mass_matrix_fun()(base, drawn)[6:, 6:] + casadi.diag(casadi.DM([each.armature for each in robot.joints]))
    force = -links.bias_force_fun()(base, drawn, casadi.DM.zeros(6), rate)[6:]
    for i, each in enumerate(robot.joints):
        force[i] -= each.damping * rate[i] + each.stiffness * (q[i] - each.rest)
        if friction and each.friction:
            force[i] -= each.friction * casadi.tanh(rate[i] / SLIDING)
    for j, each in enumerate(robot.actuators):
        i, gear = each.joint, each.gear
        command = each.gain * u[j] + each.offset + each.of_position * gear * q[i] + each.of_rate * gear * rate[i]
        force[i] += gear * command
    D, LT, order = casadi.ldl(M)
    xdot = casadi.cse(casadi.vertcat(rate, casadi.ldl_solve(force, D, LT, order)))
    return casadi.Function("robot", [casadi.vertcat(q, rate), u], [xdot], ["x", "u"], ["xdot"])


def _with_turns_apart(urdf: str) -> str:
    """URDF in which a fixed joint before each prismatic one has its rotation; adam-robotics 0.3 requires this."""
    root = ET.fromstring(urdf)
    for joint in root.findall("joint"):
        if joint.get("type") == "prismatic":
            name, parent, origin = joint.get("name"), joint.find("parent"), joint.find("origin")
            assert parent is not None
            assert origin is not None
            before = f"before {name}"
            _add_link(root, before)
            turn = ET.SubElement(root, "joint", name=f"turn {name}", type="fixed")
            ET.SubElement(turn, "parent", link=parent.get("link", ""))
            ET.SubElement(turn, "child", link=before)
            ET.SubElement(turn, "origin", xyz=origin.get("xyz", ""), rpy=origin.get("rpy", ""))
            parent.set("link", before)
            origin.set("xyz", "0 0 0")
            origin.set("rpy", "0 0 0")
    return ET.tostring(root, encoding="unicode")


def _tree(text: str) -> ET.Element:
    """The elements of an XML text without definitions of its own."""
    if re.search(r"<!(DOCTYPE|ENTITY)", text, re.I):
        raise UsageError("Expected XML without <!DOCTYPE> and <!ENTITY>, got some; remove them.")
    return ET.fromstring(text)


def _robot_of_urdf(text: str) -> Robot:
    root = _tree(text)
    if root.tag != "robot":
        raise UsageError(f"Expected a URDF file, whose root is <robot>, got <{root.tag}>; for MJCF write name: mjcf.")
    bodies = bodies_of_urdf(root)
    for link in root.findall("link"):
        _require_positive(link)
        for shown in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shown)
    for element in [*root.findall("joint"), *root.iter("inertial")]:  # adds URDF's defaults, which adam requires
        origin = element.find("origin")
        origin = ET.SubElement(element, "origin") if origin is None else origin
        for key in ("xyz", "rpy"):
            origin.set(key, origin.get(key, "0 0 0"))
        if element.tag == "joint":
            _normalise_axis(element)
    joints, actuators = list[Joint](), list[Actuator]()
    for element in root.findall("joint"):
        name, kind = element.get("name", ""), element.get("type", "")
        if kind == "fixed":
            continue
        if kind not in ("revolute", "continuous", "prismatic") or element.find("mimic") is not None:
            what = kind if element.find("mimic") is None else "mimic"
            raise UsageError(
                f"Expected joints that are revolute, continuous, prismatic or fixed, got {name}, which is {what}; "
                "replace it."
            )
        dynamics, limit = element.find("dynamics"), element.find("limit")
        damping, friction = (
            0.0 if dynamics is None else _number(dynamics, key, 0.0) for key in ("damping", "friction")
        )
        effort = math.inf if limit is None else _number(limit, "effort", math.inf)
        if effort > 0:
            actuators.append(Actuator(name, len(joints), -effort, effort))
        joints.append(Joint(name, kind == "prismatic", damping, friction))
    for element in root.findall(
        "joint"
    ):  # removes limits of q: the equations ignore them, and adam would require all of their numbers
        for read in element.findall("limit") + element.findall("dynamics"):
            element.remove(read)
    robot = Robot(ET.tostring(root, encoding="unicode"), joints, actuators, bodies=bodies)
    _require_actuators(robot)
    return robot


def _require_actuators(robot: Robot) -> None:
    if not robot.actuators:
        raise UsageError(
            f"Expected a robot with motors, got {len(robot.joints)} moving joints and none; add an actuator in MJCF, "
            "or set the effort of a joint's limit above 0 in URDF."
        )


def _require_positive(link: ET.Element) -> None:
    """Refuse a negative mass or moment of inertia."""
    mass, inertia = link.find("inertial/mass"), link.find("inertial/inertia")
    least = 0.0 if mass is None else _number(mass, "value", 0.0)
    if inertia is not None:
        xx, xy, xz, yy, yz, zz = (_number(inertia, f"i{key}", 0.0) for key in ("xx", "xy", "xz", "yy", "yz", "zz"))
        moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        least = min(least, float(moments[0]) + 1e-9 * abs(float(moments[-1])))  # up to the digits of the file
    if least < 0:
        raise UsageError(
            f"Expected mass and inertia of {link.get('name')} to be positive, got {least:.3g}; correct the file."
        )


def _normalise_axis(joint: ET.Element) -> None:
    """Give a joint an axis of length 1, by default x."""
    axis = joint.find("axis")
    axis = ET.SubElement(joint, "axis") if axis is None else axis
    direction = np.array([float(each) for each in axis.get("xyz", "1 0 0").split()])
    length = float(np.linalg.norm(direction))
    if direction.shape != (3,) or not 0 < length < math.inf:
        raise UsageError(
            f"Expected an axis of three numbers for {joint.get('name')}, got {axis.get('xyz')!r}; give its direction."
        )
    axis.set("xyz", _text(direction / length))


def _number(element: ET.Element, key: str, otherwise: float) -> float:
    value = float(element.get(key, otherwise))
    if math.isnan(value):
        raise UsageError(f"Expected a number for {key} of <{element.tag}>, got {element.get(key)}; correct it.")
    return value


def _robot_of_mjcf(mujoco: Any, model: Any) -> Robot:
    """The bodies of a MuJoCo model as URDF links: one for each joint of a body, and one for its inertia."""
    hinge, slide = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)

    def name_of(kind: Any, i: int, otherwise: str) -> str:
        return mujoco.mj_id2name(model, kind, i) or f"{otherwise}_{i}"

    root = ET.Element("robot", name="robot")
    _add_link(root, "body_0")
    joints = list[Joint]()
    for body in range(1, model.nbody):
        place, turn = model.body_pos[body], model.body_quat[body]
        last = f"body_{model.body_parentid[body]}"
        first = int(model.body_jntadr[body])
        offset = np.zeros(3)
        for k in range(first, first + int(model.body_jntnum[body])):
            name = name_of(mujoco.mjtObj.mjOBJ_JOINT, k, "joint")
            if model.jnt_type[k] not in (hinge, slide):
                raise UsageError(
                    f"Expected hinges and slides, got {name}, which is a free or ball joint; replace it by others."
                )
            slides, dof = bool(model.jnt_type[k] == slide), int(model.jnt_dofadr[k])
            anchor = model.jnt_pos[k] - offset
            _add_link(root, f"{name}_link")
            _add_joint(root, name, "prismatic" if slides else "continuous", last, f"{name}_link",
                       place + _rotated(turn, anchor), turn, model.jnt_axis[k])  # fmt: skip
            place, turn, last, offset = np.zeros(3), np.array([1.0, 0, 0, 0]), f"{name}_link", model.jnt_pos[k]
            zero, spring = float(model.qpos0[model.jnt_qposadr[k]]), float(model.qpos_spring[model.jnt_qposadr[k]])
            joints.append(Joint(
                name, slides, float(np.atleast_1d(model.dof_damping[dof])[0]), float(model.dof_frictionloss[dof]),
                float(model.dof_armature[dof]), float(np.atleast_1d(model.jnt_stiffness[k])[0]), spring, zero,
            ))  # fmt: skip
        _add_link(root, f"body_{body}", model, body)
        _add_joint(root, f"body_{body}_mount", "fixed", last, f"body_{body}", place - _rotated(turn, offset), turn)
    urdf, bodies = ET.tostring(root, encoding="unicode"), list(bodies_of_mjcf(mujoco, model))
    return Robot(urdf, joints, list(_actuators(mujoco, model)), model.opt.gravity, bodies)


def _actuators(mujoco: Any, model: Any) -> Iterator[Actuator]:
    """The actuators of a MuJoCo model; refused unless their forces are affine in q, q̇ and u."""
    for k in range(model.nu):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, k) or f"actuator_{k}"
        gain, bias = model.actuator_gainprm[k], model.actuator_biasprm[k]
        simple = (
            model.actuator_trntype[k] == int(mujoco.mjtTrn.mjTRN_JOINT)
            and model.actuator_dyntype[k] == int(mujoco.mjtDyn.mjDYN_NONE)
            and model.actuator_gaintype[k] == int(mujoco.mjtGain.mjGAIN_FIXED)
            and model.actuator_biastype[k] in (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))
            and not model.actuator_forcelimited[k]
        )
        if not simple:
            raise UsageError(
                f"Expected actuators on joints without dynamics and force limits, got {name}; make it a motor with "
                "ctrlrange."
            )
        affine = model.actuator_biastype[k] == int(mujoco.mjtBias.mjBIAS_AFFINE)
        lower, upper = model.actuator_ctrlrange[k] if model.actuator_ctrllimited[k] else (-math.inf, math.inf)
        yield Actuator(
            name, int(model.actuator_trnid[k][0]), float(lower), float(upper), float(model.actuator_gear[k][0]),
            float(gain[0]), *(map(float, bias[:3]) if affine else (0.0, 0.0, 0.0)),
        )  # fmt: skip


def _add_link(root: ET.Element, name: str, model: Any = None, body: int = 0) -> None:
    """A link with the inertia of a body, or with none."""
    inertial = ET.SubElement(ET.SubElement(root, "link", name=name), "inertial")
    mass = 0.0 if model is None else float(model.body_mass[body])
    inertia = np.zeros(3) if model is None else model.body_inertia[body]
    place, turn = (np.zeros(3), np.array([1.0, 0, 0, 0])) if model is None else (
        model.body_ipos[body], model.body_iquat[body]
    )  # fmt: skip
    _add_origin(inertial, place, turn)
    ET.SubElement(inertial, "mass", value=repr(mass))
    moments = dict(zip(("ixx", "iyy", "izz"), (repr(float(each)) for each in inertia), strict=True))
    ET.SubElement(inertial, "inertia", **moments, ixy="0", ixz="0", iyz="0")


def _add_joint(
    root: ET.Element, name: str, kind: str, parent: str, child: str, place: Any, turn: Any, axis: Any = None
) -> None:
    joint = ET.SubElement(root, "joint", name=name, type=kind)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    _add_origin(joint, place, turn)
    if axis is not None:
        ET.SubElement(joint, "axis", xyz=_text(axis))
        ET.SubElement(joint, "limit", effort="0", velocity="0", lower="-1e9", upper="1e9")


def _add_origin(element: ET.Element, place: Any, turn: Any) -> None:
    from scipy.spatial.transform import Rotation

    angles = Rotation.from_quat(turn, scalar_first=True).as_euler("xyz")
    ET.SubElement(element, "origin", xyz=_text(place), rpy=_text(angles))


def _rotated(turn: Any, vector: Any) -> Any:
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(turn, scalar_first=True).apply(vector)


def _text(numbers: Any) -> str:
    return " ".join(repr(float(each)) for each in numbers)


def _require_equal(mujoco: Any, model: Any, robot: Robot) -> None:
    """Refuse accelerations that differ from MuJoCo's at random states, without contacts, limits and dry friction."""
    flags = mujoco.mjtDisableBit
    model.opt.disableflags |= flags.mjDSBL_CONTACT | flags.mjDSBL_LIMIT | flags.mjDSBL_FRICTIONLOSS
    data, function = mujoco.MjData(model), _function(robot, friction=False)
    random = np.random.default_rng(0)
    for _ in range(8):
        q, rate, u = (random.standard_normal(k) for k in (model.nq, model.nv, model.nu))
        data.qpos[:], data.qvel[:] = q, rate
        data.ctrl[:] = [min(max(a, each.lower), each.upper) for a, each in zip(u, robot.actuators, strict=True)]
        mujoco.mj_forward(model, data)
        got = np.array(function(np.concatenate([q, rate]), data.ctrl)).ravel()[model.nv :]
        if not np.abs(got - data.qacc).max() <= TOLERANCE * (1 + np.abs(data.qacc).max()):
            raise UsageError(
                f"Expected a model of hinges, slides, motors, damping and springs, got one whose accelerations differ "
                f"from MuJoCo's by {np.abs(got - data.qacc).max():.3g}; leave out fluids, tendons, equalities and the "
                "like."
            )


SMALLEST_URDF = b"""<robot name="pendulum"><link name="base"/><link name="rod"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="pivot" type="continuous">
<parent link="base"/><child link="rod"/></joint></robot>"""
SMALLEST_MJCF = b"""<mujoco><worldbody><body><joint name="pivot" axis="0 1 0"/><geom size="0.1" pos="0 0 -1"/></body>
</worldbody><actuator><motor joint="pivot"/></actuator></mujoco>"""
