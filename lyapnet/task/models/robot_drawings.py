"""Drawings of robots in a plane: lines of text with the shapes of links, whose positions are expressions of q.

Boxes, cylinders, capsules and spheres of the file are drawn. A link without any is drawn as lines from its origin to
the joints on it or, if all of them are at the origin, as the box of its inertia. Like robots.py, this imports nothing
that needs torch.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from lyapnet.task.models.casadi_functions import assignments

MOST = 100  # largest number of bodies that are drawn
WATER = 1000.0  # kg/m³, the density of the ball that represents a point mass
SAME = 1e-9  # largest difference of directions or positions (m) that counts as rounding
COSINE, SINE = math.cos(math.pi / 6) / 2, math.sin(math.pi / 6) / 2  # the y axis in oblique views: 30°, half as long
# views as (axis that they look along, its two rows of (x, y, z)); the last one is oblique, for robots in space
VIEWS = (
    (1, np.array([[1, 0, 0], [0, 0, 1]])),
    (0, np.array([[0, 1, 0], [0, 0, 1]])),
    (2, np.array([[1, 0, 0], [0, 1, 0]])),
    (None, np.array([[1, COSINE, 0], [0, SINE, 1]])),
)


class Body(NamedTuple):
    """A body on a link, in the frame of the link.

    Args:
        kind: box, cylinder, capsule, sphere or bone, a line from the link's origin to `place`.
        place, turn: its centre, and its axes as columns; the last one is the axis of a cylinder or capsule.
        size: half lengths along the axes in m; (radius, radius, half length) of cylinders and capsules.
    """

    link: str
    kind: str
    place: Any
    turn: Any = None
    size: Sequence[float] = ()


def bodies_of_urdf(root: ET.Element) -> list[Body]:
    """The boxes, cylinders and spheres of the links of a URDF tree; shapes that cannot be read are left out."""
    found = list[Body]()
    for link in root.findall("link"):
        for elements in (link.findall("visual"), link.findall("collision")):
            bodies = [body for element in elements for body in _read(link.get("name", ""), element)]
            if bodies:
                found += bodies
                break
    return found


def bodies_of_mjcf(mujoco: Any, model: Any) -> Iterator[Body]:
    """The geoms of the moving bodies of a MuJoCo model, on the links that robots.py makes of these."""
    kinds = {
        int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")): kind
        for kind in ("box", "cylinder", "capsule", "sphere")
    }
    for k in range(model.ngeom):
        kind, body, size = kinds.get(int(model.geom_type[k])), int(model.geom_bodyid[k]), model.geom_size[k]
        if kind and body:
            half = size if kind == "box" else (size[0], size[0], 0.0 if kind == "sphere" else size[1])
            turn = np.zeros(9)
            mujoco.mju_quat2Mat(turn, model.geom_quat[k])
            yield Body(f"body_{body}", kind, model.geom_pos[k], turn.reshape(3, 3), [float(each) for each in half])


def drawing_of(urdf: str, bodies: Sequence[Body], frames: Mapping[str, Any], q: Any, names: Sequence[str]) -> str:
    """The lines of a drawing of a robot.

    Args:
        urdf: its links and joints.
        bodies: those of the file.
        frames: link ↦ its frame (4, 4), an expression of q.
        q: symbols of the joints' positions.
        names: of states and controls, these positions first.
    """
    import casadi

    drawn = {body.link for body in bodies}
    every = [*bodies, *(body for body in _bodies_of_inertia(ET.fromstring(urdf)) if body.link not in drawn)][:MOST]
    axis, view, at_zero = _view(casadi, frames, q)
    shapes, numbers = list[tuple[str, int, Sequence[float]]](), list[Any]()  # kind, count of numbers, what follows them
    for body in every:
        frame = frames[body.link]
        for kind, points, after in _shapes(body, None if axis is None else at_zero[body.link][axis, :3]):
            numbers += [casadi.DM(view) @ (frame[:3, :3] @ casadi.DM(point) + frame[:3, 3]) for point in points]
            shapes.append((kind, 2 * len(points), after))
    function = casadi.Function("drawing", [q], [casadi.cse(casadi.densify(casadi.vertcat(*numbers)))])
    lines, (texts,) = assignments(function, {0: names[: q.shape[0]]}, names)
    given = iter(texts.get(k, "0") for k in range(len(texts)))
    for kind, count, after in shapes:
        lines.append(f"{kind}({', '.join([*(next(given) for _ in range(count)), *map(repr, after)])})")
    return "\n".join(lines)


def _view(casadi: Any, frames: Mapping[str, Any], q: Any) -> tuple[int | None, Any, dict[str, Any]]:
    """(the axis along which a robot is seen or None, the rows of the view, its frames at q = 0).

    All links turn only about this axis, and none moves along it; a robot without such an axis is seen obliquely.
    """
    function, random = casadi.Function("frames", [q], list(frames.values())), np.random.default_rng(0)
    d = q.shape[0]
    first, *others = (
        [np.array(frame) for frame in function.call([casadi.DM(each)])]
        for each in (np.zeros(d), *random.normal(size=(3, d)))
    )

    def stays(axis: int | None) -> bool:
        pairs = (pair for each in others for pair in zip(first, each, strict=True))
        return axis is None or all(np.abs(a[axis] - b[axis]).max() < SAME for a, b in pairs)

    axis, view = next((axis, view) for axis, view in VIEWS if stays(axis))
    return axis, view, dict(zip(frames, first, strict=True))


def _shapes(body: Body, normal: Any) -> Iterator[tuple[str, list[Any], Sequence[float]]]:
    """The shapes of a body, each as (kind, points (x, y, z) in the frame of its link, further arguments).

    Args:
        normal: the direction of the view in that frame; None if it changes with q.
    """
    place = np.asarray(body.place, dtype=float)
    if body.kind == "bone":
        yield "line", [np.zeros(3), place], []
        return
    radius, turn = body.size[0], np.asarray(body.turn, dtype=float)
    is_round = body.kind in ("cylinder", "capsule")
    if body.kind == "sphere" or (is_round and normal is not None and abs(normal @ turn[:, 2]) > 1 - SAME):
        yield "disk", [place], [radius]
        return
    if is_round and normal is not None:
        across = np.cross(normal, turn[:, 2])
        across /= np.linalg.norm(across)
        turn = np.stack([across, np.cross(turn[:, 2], across), turn[:, 2]], 1)
    if body.kind == "capsule":
        for side in (-1, 1):
            yield "disk", [place + side * body.size[2] * turn[:, 2]], [radius]
    axes = turn * np.asarray(body.size)  # as columns, with their half lengths
    along = [k for k in range(3) if normal is not None and abs(normal @ turn[:, k]) > 1 - SAME]
    faces = [(k, 0) for k in along[:1]] or [(k, side) for k in range(3) for side in (-1, 1)]
    for k, side in faces:
        u, v = axes[:, (k + 1) % 3], axes[:, (k + 2) % 3]
        yield (
            "polygon",
            [place + side * axes[:, k] + a * u + b * v for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))],
            [],
        )


def _bodies_of_inertia(root: ET.Element) -> Iterator[Body]:
    """Lines from each link to its joints; without joints, the box with its mass and inertia, or a ball of water."""
    bearing = set[str]()
    for joint in root.findall("joint"):
        parent, (place, _) = joint.find("parent"), _origin(joint)
        if parent is not None and np.linalg.norm(place) > SAME:
            bearing.add(parent.get("link", ""))
            yield Body(parent.get("link", ""), "bone", place)
    for link in root.findall("link"):
        if link.get("name") in bearing:
            continue
        inertial = link.find("inertial")
        mass, inertia = (None, None) if inertial is None else (inertial.find("mass"), inertial.find("inertia"))
        if inertial is None or mass is None or inertia is None or float(mass.get("value", 0)) <= 0:
            continue
        m, (place, turn) = float(mass.get("value", 0)), _origin(inertial)
        xx, xy, xz, yy, yz, zz = (float(inertia.get(f"i{key}", 0)) for key in ("xx", "xy", "xz", "yy", "yz", "zz"))
        moments, axes = np.linalg.eigh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        half = np.sqrt(np.clip(6 * (moments.sum() - 2 * moments) / m, 0, None)) / 2
        if half.max() > SAME:
            yield Body(link.get("name", ""), "box", place, turn @ axes, half.tolist())
        else:
            yield Body(link.get("name", ""), "sphere", place, turn, [(3 * m / (4 * math.pi * WATER)) ** (1 / 3)])


def _read(link: str, element: ET.Element) -> Iterator[Body]:
    """The body of a <visual> or <collision>, if it can be read."""
    geometry = element.find("geometry")
    for shape in [] if geometry is None else geometry:
        try:
            place, turn = _origin(element)
            if shape.tag == "box":
                half = _numbers(shape.get("size")) / 2
            else:
                radius, length = (float(shape.get(key, 0)) for key in ("radius", "length"))
                half = np.array([radius, radius, length / 2])
        except ValueError:
            continue
        if shape.tag in ("box", "cylinder", "capsule", "sphere") and np.isfinite([*place, *half]).all():
            yield Body(link, shape.tag, place, turn, half.tolist())


def _origin(element: ET.Element) -> tuple[Any, Any]:
    """The place of an element's <origin>, and its axes as columns."""
    from scipy.spatial.transform import Rotation

    origin = element.find("origin")
    place, angles = (_numbers(None if origin is None else origin.get(key)) for key in ("xyz", "rpy"))
    return place, Rotation.from_euler("xyz", angles).as_matrix()


def _numbers(text: str | None) -> Any:
    """Three numbers of an attribute, 0 by default."""
    numbers = np.array([float(each) for each in (text or "0 0 0").split()])
    if numbers.shape != (3,):
        raise ValueError(f"Expected three numbers, got {text!r}.")
    return numbers
