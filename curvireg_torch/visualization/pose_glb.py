"""The mesh at its pose, the camera and the photograph behind it, as one glTF binary file."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
import trimesh
from PIL import Image
from torch import Tensor

from ..errors import InvalidInputError
from ..mesh import Mesh, as_mesh, mesh_centre, mesh_radius
from ..mesh.colours import colours_at
from ..utils.aliases import Fields
from ..utils.checks import check_camera_matrix, check_photograph, check_pose, check_tensor
from ..utils.choices import UNITS
from ..utils.likes import MeshLike
from ..utils.srgb import linear_colours
from .encoding import shrink, to_uint8

_PHOTO_SIDE = 1024
# from OpenCV's camera to glTF's, which has y up and looks along -z
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_MATT = {
    "name": "matt",
    "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.9},
    "doubleSided": True,
}


def pose_glb(
    mesh: MeshLike, T_cam_from_model: Tensor, camera_matrix: Tensor, image: Tensor
) -> bytes:
    """A GLB file: the mesh at its pose, a camera at the origin, and the photograph on a plane
    behind the mesh.

    Lengths are metres and y points up, as glTF requires. A glTF camera has no principal point, so
    the exact camera and the pose, in the mesh's unit, are in the ``extras`` of the node
    "photograph". Textures become colours of vertices.

    Args:
        mesh: from :func:`curvireg_torch.load_mesh`, with its unit.
        T_cam_from_model, camera_matrix: (4, 4), OpenCV camera, in the mesh's unit; (3, 3) px.
        image: (1 or 3, H, W) floating in [0, 1] or uint8.

    Raises:
        InvalidInputError: a pose that is not rigid, an unusable camera or image, or an object
            behind the camera.

    Example:
        >>> K = torch.tensor([[100.0, 0, 31.5], [0, 100.0, 31.5], [0, 0, 1]], dtype=torch.float64)
        >>> T = torch.eye(4, dtype=torch.float64); T[2, 3] = 4.0
        >>> pose_glb(trimesh.creation.box(), T, K, torch.rand(3, 64, 64))[:4]
        b'glTF'
    """
    check_tensor(T_cam_from_model, "T_cam_from_model", (4, 4))
    check_pose(T_cam_from_model, "T_cam_from_model")
    return scene_glb(as_mesh(mesh), T_cam_from_model, [(torch.eye(4), camera_matrix, image)])


def mesh_glb(mesh: Mesh, transform: Tensor) -> bytes:
    """A GLB file of the mesh alone, moved by a (4, 4) transform to glTF's axes and metres."""
    scene = trimesh.Scene()
    scene.add_geometry(_coloured(mesh), transform=transform.numpy())
    return _exported(scene, _make_matt)


def scene_glb(
    mesh: Mesh,
    T_world_from_model: Tensor,
    cameras: Sequence[tuple[Tensor, Tensor, Tensor]],
) -> bytes:
    """:func:`pose_glb` of a pose in the world and of cameras: ``T_cam_from_world``, camera matrix
    and photograph."""
    T = T_world_from_model.detach().cpu().double()
    unit = mesh.unit or "m"
    metres = UNITS[unit]
    scale = np.diag([metres, metres, metres, 1.0])
    scene = trimesh.Scene()
    scene.add_geometry(_coloured(mesh), node_name="object", transform=scale @ _FLIP @ T.numpy())
    lenses = []
    nodes = []
    for number, (pose, matrix, image) in enumerate(cameras):
        check_camera_matrix(matrix)
        check_photograph(image, "image")
        P = pose.detach().cpu().double()
        K = matrix.detach().cpu().double()
        depth = float((P @ T @ torch.cat([mesh_centre(mesh), torch.ones(1)]))[2])
        if depth <= 0:
            raise InvalidInputError(
                "T_cam_from_model: the object is behind the camera; check the pose"
            )
        H, W = image.shape[-2:]
        world_from_camera = scale @ _FLIP @ np.linalg.inv(P.numpy())
        plane = _photograph_plane(image, K, depth + 1.05 * mesh_radius(mesh))
        scene.add_geometry(plane, node_name=f"picture {number}", transform=world_from_camera)
        yfov = 2 * math.atan(H / (2 * float(K[1, 1])))
        aspect = W * float(K[1, 1]) / (H * float(K[0, 0]))
        lens = {"yfov": yfov, "aspectRatio": aspect, "znear": 0.01 * depth * metres}
        lenses.append({"type": "perspective", "perspective": lens})
        exact = {
            "T_cam_from_model": (P @ T).tolist(),
            "camera_matrix": K.tolist(),
            "size": [W, H],
            "unit": unit,
        }
        place = world_from_camera @ _FLIP @ np.linalg.inv(scale)
        name = "photograph" if len(cameras) == 1 else f"photograph {number}"
        nodes.append(
            {"name": name, "camera": number, "matrix": place.T.flatten().tolist(), "extras": exact}
        )

    def with_cameras(tree: Fields) -> None:
        tree["cameras"] = lenses
        tree["scenes"][0]["nodes"] += range(len(tree["nodes"]), len(tree["nodes"]) + len(nodes))
        tree["nodes"] += nodes
        _make_matt(tree)
        for material in tree["materials"]:
            if material.get("name") == "picture":  # keeps its brightness
                material["extensions"] = {"KHR_materials_unlit": {}}
                tree["extensionsUsed"] = ["KHR_materials_unlit"]

    return _exported(scene, with_cameras)


def _exported(scene: trimesh.Scene, change: Callable[[Fields], None]) -> bytes:
    """A GLB file of a scene whose tree is changed before it is written."""
    export = trimesh.exchange.gltf.export_glb
    return bytes(export(scene, include_normals=True, tree_postprocessor=change))


def _make_matt(tree: Fields) -> None:
    """Give a matt material to the parts of a glTF file that have none."""
    tree.setdefault("materials", []).append(_MATT)
    for mesh in tree["meshes"]:
        for part in mesh["primitives"]:
            part.setdefault("material", len(tree["materials"]) - 1)


def _coloured(mesh: Mesh) -> trimesh.Trimesh:
    """The mesh with vertex colours; faces share no vertices, so that edges stay sharp."""
    faces = np.arange(mesh.faces.size).reshape(-1, 3)
    rgb = np.full(3, 190 / 255)
    if mesh.colours is not None:
        face = np.repeat(np.arange(len(faces), dtype=np.int32), 3)
        corners = np.tile(np.eye(3, dtype=np.float32), (len(faces), 1))
        rgb = colours_at(mesh.colours, face, corners[:, 1], corners[:, 2])
    # From sRGB: the vertex colours of glTF are linear.
    rgba = np.full((faces.size, 4), 255, np.uint8)
    rgba[:, :3] = (linear_colours(rgb) * 255).round()
    vertices = mesh.vertices[mesh.faces].reshape(-1, 3)
    return trimesh.Trimesh(vertices, faces, vertex_colors=rgba, process=False)


def _photograph_plane(image: Tensor, K: Tensor, depth: float) -> trimesh.Trimesh:
    """The photograph as a plane at a depth, in OpenCV's camera frame."""
    H, W = image.shape[-2:]
    uv = np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])
    pixels = np.column_stack([W * uv[:, 0] - 0.5, H * (1.0 - uv[:, 1]) - 0.5, np.ones(4)])
    corners = depth * pixels @ np.linalg.inv(K.numpy()).T
    faces = np.array([[0, 3, 2], [0, 2, 1]])  # counterclockwise after the flip
    texture = Image.fromarray(shrink(to_uint8(image), _PHOTO_SIDE))
    texture.format = "JPEG"  # in which exporters write it
    material = trimesh.visual.material.PBRMaterial(
        name="picture",
        baseColorTexture=texture,
        metallicFactor=0.0,
        roughnessFactor=1.0,
        doubleSided=True,
    )
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return trimesh.Trimesh(corners, faces, visual=visual, process=False)
