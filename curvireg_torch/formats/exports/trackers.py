"""A start pose and the mesh as other trackers read them: M3T (and pym3t), and ViSP; in metres."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation
from trimesh.transformations import transform_points

from ...errors import InvalidInputError
from ...utils.aliases import Document
from ...utils.arrays import Floats, Integers
from ...utils.choices import UNITS
from ...utils.files import write_file

M3T_FILES = ("object.obj", "object.yaml", "object_detector.yaml")
"""The mesh in its own unit, M3T's body and its static detector, whose world is the camera."""

VISP_FILES = ("object.cao", "object.init", "object.pos")
"""The mesh, points of it with the pixels where they are (``initFromPoints``), and the pose
(``initFromPose``)."""

INIT_POINTS = 12
FLAT_ANGLE = 1e-3  # radians between triangles that are one polygon


def write_m3t(
    out: Path,
    vertices: Floats,
    faces: Integers,
    document: Document,
    *,
    is_closed: bool,
) -> None:
    """Write the ``M3T_FILES`` into the folder ``out``.

    Args:
        out: the folder.
        vertices: (V, 3) of the mesh whose pose it is, in its unit.
        faces: (F, 3), counter-clockwise from outside.
        document: the content of ``result.json``.
        is_closed: whether the back sides of the faces are never seen.

    Raises:
        InvalidInputError: the pose has no translation.
        OutputError: a file cannot be written.
    """
    T, metres = _pose_in_metres(document, "m3t")
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in faces + 1]
    _write_lines(out / "object.obj", lines)
    body = [
        "%YAML:1.2",
        'geometry_path: "object.obj"',
        f"geometry_unit_in_meter: {metres:.9g}",
        "geometry_counterclockwise: 1",
        f"geometry_enable_culling: {int(is_closed)}",
        f"geometry2body_pose: {_opencv_matrix(np.eye(4))}",
    ]
    _write_lines(out / "object.yaml", body)
    detector = ["%YAML:1.2", f"link2world_pose: {_opencv_matrix(T)}"]
    _write_lines(out / "object_detector.yaml", detector)


def _write_lines(path: Path, lines: Iterable[str]) -> None:
    write_file(path, "".join(f"{line}\n" for line in lines).encode())


def _opencv_matrix(T: Floats) -> str:
    """(4, 4) in the YAML of OpenCV."""
    numbers = ", ".join(f"{x:.12g}" for x in T.ravel())
    return f"!!opencv-matrix\n  rows: 4\n  cols: 4\n  dt: d\n  data: [{numbers}]"


def write_visp(out: Path, vertices: Floats, faces: Integers, document: Document) -> None:
    """Write the ``VISP_FILES`` into the folder ``out``; arguments and errors are those of
    :func:`write_m3t`. Coplanar triangles are one polygon."""
    T, metres = _pose_in_metres(document, "visp")
    points = metres * vertices
    polygons = polygons_of(trimesh.Trimesh(points, faces, process=False))
    cao = [
        "V1",
        "# 3D points, in metres",
        str(len(points)),
        *(f"{x:.9g} {y:.9g} {z:.9g}" for x, y, z in points),
        "# 3D lines",
        "0",
        "# Faces from 3D lines",
        "0",
        "# Faces from 3D points: their number, and their indices",
        str(len(polygons)),
        *(" ".join(map(str, (len(polygon), *polygon))) for polygon in polygons),
        "# 3D cylinders",
        "0",
        "# 3D circles",
        "0",
    ]
    _write_lines(out / "object.cao", cao)
    some = points[_spread(points, INIT_POINTS)]
    seen = transform_points(some, T) @ np.array(document["camera"]["matrix"]).T
    init = [
        "# 3D points, in metres",
        str(len(some)),
        *(f"{x:.9g} {y:.9g} {z:.9g}" for x, y, z in some),
        "# 2D points: row and column, in pixels",
        str(len(some)),
        *(f"{v:.6f} {u:.6f}" for u, v in seen[:, :2] / seen[:, 2:]),
    ]
    _write_lines(out / "object.init", init)
    turn = Rotation.from_quat(document["quaternion"], scalar_first=True).as_rotvec()
    numbers = [*T[:3, 3], *turn]
    _write_lines(out / "object.pos", (f"{x:.12g}" for x in numbers))


def _pose_in_metres(document: Document, name: str) -> tuple[Floats, float]:
    """(4, 4) of the pose in the camera, and the length of the mesh's unit in metres."""
    if document["translation"] is None:
        raise InvalidInputError(f"--format {name}: a pose without translation; give a camera")
    if document["frame"] == "world":
        raise InvalidInputError(
            f"--format {name}: a tracker starts in one camera; register one photograph"
        )
    metres = UNITS[document["unit"] or "m"]
    T = np.eye(4)
    T[:3, :3] = document["rotation"]
    T[:3, 3] = metres * np.array(document["translation"])
    return T, metres


def _spread(points: Floats, count: int) -> list[int]:
    """Indices of at most ``count`` points (N, 3), each as far as possible from those before it."""
    chosen = [int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmax())]
    nearest = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(count, len(points)) and nearest.max() > 0:
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return chosen


def polygons_of(mesh: trimesh.Trimesh) -> list[list[int]]:
    """Corners of the polygons of a mesh, counter-clockwise from outside: triangles in one plane are
    one polygon, unless it would have holes."""
    flat = mesh.face_adjacency[mesh.face_adjacency_angles < FLAT_ANGLE]
    label = trimesh.graph.connected_component_labels(flat, node_count=len(mesh.faces))
    polygons: list[list[int]] = []
    for number in np.unique(label):
        faces = mesh.faces[label == number]
        outline = _outline(faces)
        polygons += faces.tolist() if outline is None else [outline]
    return polygons


def _outline(faces: Integers) -> list[int] | None:
    """The corners around triangles (F, 3) in their order; None if that is no single loop."""
    edges = set(map(tuple, trimesh.geometry.faces_to_edges(faces).tolist()))
    outer = [(a, b) for a, b in edges if (b, a) not in edges]
    following = dict(outer)
    corners = [a for a, _ in outer[:1]]
    for _ in outer[1:]:
        corners.append(following.get(corners[-1], -1))
    is_loop = bool(outer) and len(outer) == len(following) == len(following.keys() & corners)
    return corners if is_loop else None
