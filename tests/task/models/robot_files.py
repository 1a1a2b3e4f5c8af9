"""Robots in URDF and MJCF: random ones and named ones, for comparisons with MuJoCo and trainings."""

import numpy as np


def urdf(seed, joints=4, kinds=("revolute", "continuous", "prismatic", "fixed"), friction=0.0):
    """A tree of links with joints of all kinds, each turned and displaced at random."""
    random = np.random.default_rng(seed)

    def numbers(scale=1.0, count=3):
        return " ".join(f"{value:.6f}" for value in scale * random.normal(size=count))

    text = '<robot name="robot"><link name="link0"/>'
    for k in range(1, joints + 1):
        parent, kind = int(random.integers(0, k)), kinds[int(random.integers(len(kinds)))] if k > 1 else "revolute"
        axis = random.normal(size=3)
        axis = " ".join(f"{value:.8f}" for value in axis / np.linalg.norm(axis))
        base = random.uniform(0.01, 0.03, 3)
        inertia = 'ixx="{:.6f}" iyy="{:.6f}" izz="{:.6f}" ixy="0.001" ixz="0.0005" iyz="-0.0003"'.format(*(base + 0.02))
        text += (
            f'<link name="link{k}"><inertial><origin xyz="{numbers(0.2)}" rpy="{numbers()}"/>'
            f'<mass value="{random.uniform(0.5, 2):.4f}"/><inertia {inertia}/></inertial></link>'
            f'<joint name="joint{k}" type="{kind}"><parent link="link{parent}"/><child link="link{k}"/>'
            f'<origin xyz="{numbers(0.3)}" rpy="{numbers()}"/><axis xyz="{axis}"/>'
            f'<dynamics damping="{random.uniform(0, 1):.4f}" friction="{friction}"/>'
            '<limit effort="10" velocity="1" lower="-9" upper="9"/></joint>'
        )
    return text + "</robot>"


def mjcf(seed, depth=3):
    """A chain of bodies with one or two joints each: hinges and slides with anchors, springs, armature and motors."""
    random = np.random.default_rng(seed)

    def numbers(scale=1.0):
        return " ".join(f"{value:.5f}" for value in scale * random.normal(size=3))

    inner, motors, count = "", "", 0
    for k in reversed(range(depth)):
        joints = ""
        for _ in range(int(random.integers(1, 3))):
            kind = ("hinge", "slide")[int(random.integers(2))]
            joints += (
                f'<joint name="j{count}" type="{kind}" axis="{numbers()}" pos="{numbers(0.2)}" damping="0.1" '
                f'armature="{random.uniform(0, 0.1):.4f}" stiffness="{random.uniform(0, 2):.4f}" '
                f'ref="{random.uniform(-1, 1):.4f}" springref="{random.uniform(-1, 1):.4f}"/>'
            )
            motors += f'<motor name="m{count}" joint="j{count}" gear="{random.uniform(1, 5):.4f}" ctrlrange="-3 3"/>'
            count += 1
        inner = (
            f'<body name="b{k}" pos="{numbers(0.4)}" euler="{numbers(40)}">{joints}<geom type="box" '
            f'size="0.1 0.2 0.15" pos="{numbers(0.2)}" euler="{numbers(40)}"/>{inner}</body>'
        )
    motors += '<position name="servo" joint="j0" kp="3" gear="2"/>'
    return f'<mujoco><option gravity="1 2 -9"/><worldbody>{inner}</worldbody><actuator>{motors}</actuator></mujoco>'


def _link(name, mass, center, inertia, ixy=0):
    """A link with the inertia (ixx, iyy, izz) and ixy about its center, as URDF writes it."""
    moments = "".join(f' i{2 * axis}="{value}"' for axis, value in zip("xyz", inertia, strict=True))
    return (
        f'<link name="{name}"><inertial><origin xyz="{center}"/><mass value="{mass}"/>'
        f'<inertia{moments} ixy="{ixy}" ixz="0" iyz="0"/></inertial></link>'
    )


def _joint(name, parent, child, origin, axis, effort, damping, turn="0 0 0"):
    return (
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{origin}" rpy="{turn}"/><axis xyz="{axis}"/><dynamics damping="{damping}"/>'
        f'<limit effort="{effort}" velocity="20" lower="-3" upper="3"/></joint>'
    )


TWO_LINK = "".join([
    '<robot name="two_link"><link name="base"/>', _link("upper", 1, "0 0 0.25", (0.021, 0.021, 0.001)),
    _link("lower", 1, "0 0 0.25", (0.021, 0.021, 0.001)),
    _joint("shoulder", "base", "upper", "0 0 0", "0 1 0", 20, 0.1),
    _joint("elbow", "upper", "lower", "0 0 0.5", "0 1 0", 10, 0.1), "</robot>",
])  # fmt: skip
CART_POLE = """<mujoco><worldbody><body name="cart"><joint name="slider" type="slide" axis="1 0 0" damping="0.1"/>
<geom type="box" size="0.1 0.05 0.05" mass="1"/>
<body name="pole"><joint name="hinge" type="hinge" axis="0 1 0" damping="0.01"/>
<geom type="capsule" fromto="0 0 0 0 0 0.6" size="0.02" mass="0.3"/></body></body></worldbody>
<actuator><motor name="force" joint="slider" ctrlrange="-10 10"/></actuator></mujoco>"""
LEG = "".join([  # masses, lengths and torques of the size of a small quadruped's, moments of rods
    '<robot name="leg"><link name="trunk"/>', _link("hip", 0.54, "0 0.036 0", (4e-4, 6e-4, 4e-4)),
    _link("thigh", 0.63, "0 0.016 -0.02", (2e-3, 2e-3, 4e-4)), _link("shank", 0.2, "0 0 -0.1", (7e-4, 7e-4, 2e-5)),
    _joint("abduction", "trunk", "hip", "0 0 0", "1 0 0", 17, 0.05),
    _joint("flexion", "hip", "thigh", "0 0.062 0", "0 1 0", 17, 0.05),
    _joint("knee", "thigh", "shank", "0 0 -0.209", "0 1 0", 17, 0.05), "</robot>",
])  # fmt: skip


def _arm():
    """Six joints with the lengths and masses of a UR5, products of inertia, and a bend in the third joint."""
    lengths, masses = (0.089, 0.425, 0.392, 0.093, 0.095, 0.082), (3.7, 8.4, 2.3, 1.2, 1.2, 0.19)
    centers = ("0 -0.02 0", "0 0 0.2125", "0 0 0.15", "0 0 0.05", "0 0 0.05", "0 0 0.02")
    text, below = '<robot name="arm"><link name="link0"/>', 0
    for k, (length, mass, center) in enumerate(zip(lengths, masses, centers, strict=True), 1):
        moment = mass * length**2 / 12 + 0.01 * mass
        text += _link(f"link{k}", mass, center, (moment, 1.1 * moment, 0.6 * moment), 0.05 * moment) + _joint(
            f"joint{k}", f"link{k - 1}", f"link{k}", f"0 {0.1 if k == 2 else 0} {below}",
            "0 0 1" if k in (1, 5) else "0 1 0", 150 if k < 4 else 28, 0.5 if k < 4 else 0.02,
            "0 0.3 0" if k == 3 else "0 0 0",
        )  # fmt: skip
        below = length
    return text + "</robot>"


# name ↦ kind of file, its text, and the further sections of a YAML that trains on it
ROBOTS = {
    "two_link": ("urdf", TWO_LINK, {
        "cost": {"Q": [10, 10, 0.1, 0.1], "R": [0.01, 0.01], "Q_T": [100, 100, 1, 1]},
        "initial_states": {"lower": [-0.5, -0.5, -0.5, -0.5], "upper": [0.5, 0.5, 0.5, 0.5]},
        "horizon": {"steps": 100, "dt": 0.01},
    }),
    "cart_pole": ("mjcf", CART_POLE, {
        "cost": {"Q": [1, 10, 0.1, 0.1], "R": 0.01, "Q_T": [10, 100, 1, 1]},
        "initial_states": {"lower": [-0.5, -0.5, -0.5, -0.5], "upper": [0.5, 0.5, 0.5, 0.5]},
        "horizon": {"steps": 100, "dt": 0.02},
    }),
    "leg": ("urdf", LEG, {  # a swing leg, brought to a crouched stance in the air
        "target": [0, 0.8, -1.6, 0, 0, 0],
        "cost": {"Q": [10, 10, 10, 0.05, 0.05, 0.05], "R": [0.1, 0.1, 0.1], "Q_T": [20, 20, 20, 0.1, 0.1, 0.1]},
        "initial_states": {"lower": [-0.4, 0.4, -2, -1, -1, -1], "upper": [0.4, 1.2, -1.2, 1, 1, 1]},
        "horizon": {"steps": 100, "dt": 0.005},
    }),
    "arm": ("urdf", _arm(), {
        "target": [0] * 12,
        "cost": {
            "Q": [10] * 6 + [0.1] * 6, "R": [0.001, 0.001, 0.001, 0.03, 0.03, 0.1], "Q_T": [100] * 6 + [1] * 6,
        },
        "initial_states": {"lower": [-0.5] * 6 + [0] * 6, "upper": [0.5] * 6 + [0] * 6},
        "horizon": {"steps": 100, "dt": 0.01},
    }),
}  # fmt: skip
