"""The GLB is read back; its camera projects the mesh and the photograph to their pixels."""

import json
import os
import struct
from io import BytesIO

import numpy as np
import pytest
import torch
import trimesh
from numpy.testing import assert_allclose

from curvireg_torch.geometry import project_points, rotation_from_axis_angle, transform
from curvireg_torch.mesh import as_mesh
from curvireg_torch.visualization import pose_glb
from curvireg_torch.visualization.pose_glb import scene_glb
from tests._support import CAMERA, SIZE, double, eye, refused, scene


def tree_of(data):
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length])


def placed(scene_of_file, node):
    """The mesh of a node in the world."""
    transform, name = scene_of_file.graph[node]
    return scene_of_file.geometry[name].copy().apply_transform(transform)


def project(points, tree):
    """Pixels of points in metres in the file's camera, which is at the origin and looks along
    -z."""
    H, W = SIZE
    lens = tree["cameras"][0]["perspective"]
    up = 1 / np.tan(lens["yfov"] / 2)
    x = points[:, 0] / -points[:, 2] * up / lens["aspectRatio"]
    y = points[:, 1] / -points[:, 2] * up
    return np.stack([(x + 1) / 2 * W - 0.5, (1 - y) / 2 * H - 0.5], axis=1)


@pytest.mark.parametrize(("unit", "metres"), [("m", 1.0), ("mm", 0.001)])
def test_pose_glb_camera_projects_mesh_and_photograph(unit, metres):
    image, _, T = scene(0)
    mesh = trimesh.creation.box((0.1, 0.2, 0.05))
    mesh.units = unit
    data = pose_glb(mesh, T, CAMERA, image)
    tree = tree_of(data)
    back = trimesh.load(BytesIO(data), file_type="glb")
    points = placed(back, "object").vertices
    expected = project_points(
        torch.from_numpy(np.array(mesh.triangles.reshape(-1, 3))), T, CAMERA
    ).numpy()
    assert_allclose(project(points, tree), expected, atol=1e-2)
    extras = next(node for node in tree["nodes"] if "camera" in node)["extras"]
    assert (extras["T_cam_from_model"], extras["camera_matrix"]) == (T.tolist(), CAMERA.tolist())
    assert -points[:, 2].mean() == pytest.approx(float(T[2, 3]) * metres, rel=1e-3)
    # The corners of the photograph's plane are behind the mesh.
    plane = placed(back, "picture 0")
    corners = plane.vertices
    H, W = SIZE
    expected = np.array([(-0.5, -0.5), (W - 0.5, -0.5), (W - 0.5, H - 0.5), (-0.5, H - 0.5)])
    assert_allclose(project(corners, tree), expected, atol=1e-2)
    assert corners[:, 2].max() < points[:, 2].min()
    # It faces the camera, and its top is the picture's top.
    assert plane.face_normals[0][2] > 0
    texture = plane.visual.material.baseColorTexture
    shown = np.asarray(texture.convert("RGB"), float) / 255
    assert np.abs(shown - image.permute(1, 2, 0).numpy()).mean() < 0.03
    assert_allclose(plane.visual.uv[0], [0, 1], atol=1e-6)


def test_pose_glb_keeps_vertex_colours():
    image, _, T = scene(0)
    mesh = trimesh.creation.box()
    mesh.visual.face_colors = [[200, 20, 20, 255]] * 6 + [[20, 20, 200, 255]] * 6
    data = pose_glb(mesh, T, CAMERA, image)
    tree = tree_of(data)
    part = tree["meshes"][0]["primitives"][0]
    accessor = tree["accessors"][part["attributes"]["COLOR_0"]]
    view = tree["bufferViews"][accessor["bufferView"]]
    start = data.index(b"BIN\0") + 4 + view["byteOffset"]
    colours = np.frombuffer(data[start : start + view["byteLength"]], np.uint8).reshape(
        accessor["count"], -1
    )
    assert {tuple(c[:3]) for c in colours.tolist()} == {(147, 2, 2), (2, 2, 147)}, "linear"
    # Metal would be black without surroundings to reflect.
    assert tree["materials"][part["material"]]["pbrMetallicRoughness"]["metallicFactor"] == 0


def test_pose_glb_needs_no_working_directory(monkeypatch):
    """It may have been removed, and the file go elsewhere."""
    T = eye(4)
    T[2, 3] = 4.0

    def removed():
        raise FileNotFoundError

    monkeypatch.setattr(os, "getcwd", removed)
    tree = tree_of(pose_glb(trimesh.creation.box(), T, CAMERA, torch.rand(3, *SIZE)))
    assert [picture["mimeType"] for picture in tree["images"]] == ["image/jpeg"]


@pytest.mark.parametrize(("z", "message"), [(-2.0, "behind the camera"), (torch.nan, "finite")])
def test_pose_glb_refuses_unusable_poses(z, message):
    T = eye(4)
    T[2, 3] = z
    with refused(message):
        pose_glb(trimesh.creation.box(), T, CAMERA, torch.rand(3, *SIZE))


def test_scene_glb_places_each_camera_where_its_photograph_was_taken():
    """Cameras beside each other that are turned, with pixels that are not square."""
    image, _, T = scene(0)
    mesh = trimesh.creation.box((0.1, 0.2, 0.05))
    mesh.units = "mm"
    K = CAMERA.clone()
    K[1, 1] *= 1.25
    axis = torch.deg2rad(double([0.1, 1.0, 0.3]))
    poses = [
        transform(rotation_from_axis_angle(degrees * axis), double(shift))
        for degrees, shift in ((0.0, (0.1, 0.0, 0.0)), (25.0, (-0.2, 0.3, 0.1)))
    ]
    data = scene_glb(as_mesh(mesh), T, [(pose, K, image) for pose in poses])
    tree = tree_of(data)
    world = placed(trimesh.load(BytesIO(data), file_type="glb"), "object").vertices
    nodes = [node for node in tree["nodes"] if "camera" in node]
    names = [(node["name"], node["camera"]) for node in nodes]
    assert names == [("photograph 0", 0), ("photograph 1", 1)]
    corners = torch.from_numpy(np.array(mesh.triangles.reshape(-1, 3)))
    for node, pose in zip(nodes, poses, strict=True):
        world_from_camera = np.array(node["matrix"]).reshape(4, 4).T  # glTF writes columns
        seen = trimesh.transform_points(world, np.linalg.inv(world_from_camera))
        assert_allclose(
            project(seen, tree), project_points(corners, pose @ T, K).numpy(), atol=1e-2
        )
        assert node["extras"]["T_cam_from_model"] == (pose @ T).tolist()
