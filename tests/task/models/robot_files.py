"""Random robots in URDF and MJCF, for comparisons with MuJoCo."""

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
