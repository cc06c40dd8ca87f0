"""The axes and the lines of code on the page about Blender and Unity, against ``pose.glb`` as
trimesh reads it."""

import json
import re
import sys
from io import BytesIO
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose

from curvireg_torch.visualization import pose_glb

from .._support.pages import DOCS
from .._support.scenes import CAMERA, scene

PAGE = (DOCS / "guides" / "blender-unity.md").read_text(encoding="utf-8")
METRES = 0.001


class Matrix(np.ndarray):
    """Stands for that of mathutils."""

    def __new__(cls, rows):
        return np.array(rows, dtype=float).view(cls)


@pytest.fixture(scope="module")
def posed():
    """(P, 3) points of a mesh in mm, its (4, 4) pose, and the points in ``pose.glb``."""
    image, _, T = scene(0)
    mesh = trimesh.creation.box((30.0, 50.0, 20.0))
    mesh.units = "mm"
    pose = T.clone()
    pose[:3, 3] /= METRES
    content = BytesIO(pose_glb(mesh, pose, CAMERA, image))
    scene_of_file = trimesh.load(content, file_type="glb")
    transform, name = scene_of_file.graph["object"]
    corners = scene_of_file.geometry[name].vertices
    in_file = trimesh.transform_points(corners, transform)
    return mesh.triangles.reshape(-1, 3), pose.numpy(), in_file


def table_row(tool):
    """The signed axes of a tool as a (3, 3) matrix that takes OpenCV's points to it."""
    (row,) = re.findall(rf"^\| {tool}[^|]*\|([^|]*)\|([^|]*)\|([^|]*)\|", PAGE, flags=re.MULTILINE)
    matrix = np.zeros((3, 3))
    for index, cell in enumerate(row):
        axis = cell.strip()
        matrix[index, "xyz".index(axis[-1])] = -1.0 if axis.startswith("-") else 1.0
    return matrix


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", PAGE, flags=re.DOTALL)


def in_camera(posed):
    """The points in OpenCV's camera, metres."""
    points, T, _ = posed
    return METRES * trimesh.transform_points(points, T)


# what the importers do with the axes of glTF
BLENDER_IMPORT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
UNITY_IMPORT = np.diag([-1.0, 1.0, 1.0])


@pytest.mark.parametrize(
    ("tool", "imported"),
    [("glTF", np.eye(3)), ("Blender", BLENDER_IMPORT), ("Unity", UNITY_IMPORT)],
)
def test_the_table_of_axes_is_that_of_the_file(posed, tool, imported):
    expected = posed[2] @ imported.T
    assert_allclose(in_camera(posed) @ table_row(tool).T, expected, atol=1e-5)


def test_six_lines_for_each_way():
    for block in (*blocks("py"), *blocks("csharp")):
        assert len(block.split("\n")) - block.split("\n").count("") == 6


def test_the_lines_for_blender_move_a_mesh_to_its_pose(posed, tmp_path, monkeypatch):
    points, T, in_file = posed
    camera = Matrix(trimesh.transformations.random_rotation_matrix(np.array([0.1, 0.5, 0.7])))
    part = SimpleNamespace(matrix_world=None)
    scene_in_blender = SimpleNamespace(camera=SimpleNamespace(matrix_world=camera))
    bpy = SimpleNamespace(
        data=SimpleNamespace(objects={"part": part}),
        context=SimpleNamespace(scene=scene_in_blender),
    )
    monkeypatch.setitem(sys.modules, "bpy", bpy)
    mathutils = SimpleNamespace(Matrix=Matrix)
    monkeypatch.setitem(sys.modules, "mathutils", mathutils)
    folder = tmp_path / "out" / "part"
    folder.mkdir(parents=True)
    (folder / "result.json").write_text(json.dumps({"T_cam_from_model": T.tolist()}))
    monkeypatch.chdir(tmp_path)
    exec(blocks("py")[1], {"metres": METRES})
    moved = trimesh.transform_points(METRES * points, part.matrix_world)
    # the camera of the file is at its origin, and looks along -z as that of Blender does
    assert_allclose(moved, trimesh.transform_points(in_file, camera), atol=1e-5)


def test_the_lines_for_unity_move_a_mesh_to_its_pose(posed):
    points, T, in_file = posed
    names = {"R": T[:3, :3], "t": METRES * T[:3, 3]}
    vectors = {}
    for name, values in re.findall(r"Vector3 (\w+) = new\((.*)\);", blocks("csharp")[0]):
        vectors[name] = np.array(eval(f"[{values}]", names))
    # LookRotation: its third column is forward, its second one up, in a left-handed frame
    right = np.cross(vectors["up"], vectors["forward"])
    turn = np.stack([right, vectors["up"], vectors["forward"]], axis=1)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    imported_mesh = METRES * points @ UNITY_IMPORT.T
    moved = imported_mesh @ turn.T + vectors["place"]
    # seen from the imported camera, which is turned around to look along its z
    around = np.diag([-1.0, 1.0, -1.0])
    assert_allclose(moved, in_file @ UNITY_IMPORT.T @ around.T, atol=1e-5)
    assert "forward, up)" in blocks("csharp")[0]
