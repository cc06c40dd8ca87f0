"""Public functions that share their checks, and a scene to call them with."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

import curvireg_torch as cr
from curvireg_torch import geometry, metrics
from curvireg_torch.errors import CurviregError
from curvireg_torch.geometry.cameras import transform
from curvireg_torch.matching import distinct_views
from curvireg_torch.mesh import mesh_centre, mesh_radius
from curvireg_torch.registration import fit_contours, localize
from curvireg_torch.rendering import make_renderer, render_colour
from curvireg_torch.rendering.shading import shade
from curvireg_torch.synthetic import synthesize_photograph
from curvireg_torch.visualization import contour_overlay, pose_glb, registration_sheet
from tests._support.scenes import unrefined

BACKENDS = ("torch", "embree")
CAMERA = torch.tensor([[220.1, 0.0, 63.5], [0.0, 220.1, 47.5], [0.0, 0.0, 1.0]], dtype=torch.float64)


@pytest.fixture(scope="module")
def pose(truck: trimesh.Trimesh) -> Tensor:
    R = cr.rotation_from_viewpoint(30.0, 20.0).double()
    return transform(R, torch.tensor([0.0, 0.0, 6.0 * mesh_radius(truck)]).double() - R @ mesh_centre(truck))


@pytest.fixture(scope="module")
def photograph(truck: trimesh.Trimesh, pose: Tensor) -> tuple[Tensor, Tensor]:
    return synthesize_photograph(truck, pose, CAMERA, (96, 128), torch.Generator().manual_seed(0))


@pytest.fixture(scope="module")
def default_registrar(truck: trimesh.Trimesh) -> cr.Registrar:
    views = cr.sample_views(azimuth_step=30, elevations=[20])
    return cr.Registrar(cr.ViewBank.build(truck, views, image_size=64, progress=False))


@pytest.fixture(scope="module")
def registrar(default_registrar: cr.Registrar) -> cr.Registrar:
    return cr.Registrar(default_registrar.bank, pipeline=unrefined(default_registrar.bank, box_jitter=0.0))


class Entries:
    """Public functions as calls of one argument: a camera, a pose, a rotation, a photograph or a box."""

    def __init__(self, mesh: trimesh.Trimesh, pose: Tensor, photograph: tuple[Tensor, Tensor], registrar: Any) -> None:
        (image, box), R = photograph, pose[:3, :3]
        points = torch.from_numpy(np.array(mesh.vertices))
        renderers = {name: make_renderer(mesh, name) for name in BACKENDS}
        size, radius, centre, bank = (24, 32), mesh_radius(mesh), mesh_centre(mesh), registrar.bank
        depth = torch.rand(1, 1, 16, 16) + 1.0
        result = registrar([image], box[None], CAMERA)[0]
        symmetries = torch.eye(4, dtype=torch.float64)[None]
        views = cr.sample_views(azimuth_step=90, elevations=[0])

        def fit(photo: Any = image, boxes: Any = box[None], K: Tensor = CAMERA, start: Tensor = pose) -> object:
            return fit_contours(renderers["embree"], [photo], boxes, K, start[None], centre=centre, radius=radius)

        def one(result: list[Any]) -> object:
            return result[0].rotation  # raises the error of a failed registration

        self.cameras: dict[str, Callable[[Tensor], object]] = {
            "Registrar": lambda K: one(registrar([image], box[None], K[None])),
            "Registrar, no box": lambda K: one(registrar([image], None, K)),
            "localize": lambda K: one(localize(registrar, [image], K)[0]),
            "Locator": lambda K: registrar.locator([image], camera_matrices=[K]),
            "locate": lambda K: cr.locate(registrar.pipeline, bank, [image], camera_matrices=[K]),
            "fit_contours": lambda K: fit(K=K),
            "render_depth": lambda K: cr.render_depth(mesh, pose, K, size),
            "render_colour": lambda K: render_colour(mesh, pose, K, size),
            **{f"{b}.render": lambda K, b=b: renderers[b].render(pose[None], K, size) for b in BACKENDS},
            "shade": lambda K: shade(depth, K),
            "project_points": lambda K: cr.project_points(points, pose, K),
            "projected_boxes": lambda K: geometry.projected_boxes(points, pose, K),
            "translation_from_box": lambda K: geometry.translation_from_box(points, R, box, K),
            "pose_from_box": lambda K: geometry.pose_from_box(points, R, box, K),
            "opengl_projection": lambda K: geometry.opengl_projection(K, size, near=1.0, far=9.0),
            "mspd_error": lambda K: metrics.mspd_error(pose[None], pose[None], points, K),
            "pose_glb": lambda K: pose_glb(mesh, pose, K, image),
            "contour_overlay": lambda K: contour_overlay(registrar, result, image, box, K),
            "registration_sheet": lambda K: registration_sheet(registrar, result, image, box, K),
            "average_shading_gradient": lambda K: cr.average_shading_gradient(depth, camera_matrix=K.float()),
            "AverageShadingGradient": lambda K: cr.AverageShadingGradient(camera_matrix=K.float()),
            "apparent_ridges": lambda K: cr.apparent_ridges(depth, camera_matrix=K.float()),
            "ApparentRidges": lambda K: cr.ApparentRidges(camera_matrix=K.float()),
        }
        self.needs_square_pixels = ("Registrar", "Registrar, no box", "localize", "Locator", "locate")
        self.poses: dict[str, Callable[[Tensor], object]] = {
            "fit_contours": lambda T: fit(start=T),
            "render_depth": lambda T: cr.render_depth(mesh, T, CAMERA, size),
            "render_colour": lambda T: render_colour(mesh, T, CAMERA, size),
            **{f"{b}.render": lambda T, b=b: renderers[b].render(T[None], CAMERA, size) for b in BACKENDS},
            "project_points": lambda T: cr.project_points(points, T, CAMERA),
            "projected_boxes": lambda T: geometry.projected_boxes(points, T, CAMERA),
            "opengl_from_opencv": geometry.opengl_from_opencv,
            "opencv_from_opengl": geometry.opencv_from_opengl,
            "pose_glb": lambda T: pose_glb(mesh, T, CAMERA, image),
            "add_error": lambda T: metrics.add_error(pose[None], T[None], points),
            "adds_error": lambda T: metrics.adds_error(pose[None], T[None], points),
            "mssd_error": lambda T: metrics.mssd_error(pose[None], T[None], points),
            "mspd_error": lambda T: metrics.mspd_error(pose[None], T[None], points, CAMERA),
            "mssd_error, symmetries": lambda T: metrics.mssd_error(pose[None], pose[None], points, symmetries=T[None]),
            "Registrar, symmetries": lambda T: cr.Registrar(bank, symmetries=torch.cat([symmetries, T[None]])),
            "distinct_views": lambda T: distinct_views(torch.arange(4), views.rotations, count=2, symmetries=T[None]),
        }
        self.rotations: dict[str, Callable[[Tensor], object]] = {
            "rotation_error": lambda R: cr.rotation_error(pose[:3, :3], R),
            "rotation_error, first": lambda R: cr.rotation_error(R, pose[:3, :3]),
            "viewpoint_from_rotation": cr.viewpoint_from_rotation,
            "quaternion_from_rotation": geometry.quaternion_from_rotation,
            "axis_angle_from_rotation": geometry.axis_angle_from_rotation,
            "translation_from_box": lambda R: geometry.translation_from_box(points, R, box, CAMERA),
            "pose_from_box": lambda R: geometry.pose_from_box(points, R, box, CAMERA),
            "symmetric_rotation_error": lambda R: metrics.symmetric_rotation_error(R, pose[:3, :3], pose[None, :3, :3]),
            "axis_rotation_error": lambda R: metrics.axis_rotation_error(R, pose[:3, :3], torch.ones(3).double()),
            "symmetries": lambda R: metrics.symmetric_rotation_error(pose[:3, :3], pose[:3, :3], R[None]),
        }
        self.photographs: dict[str, Callable[[Any], object]] = {
            "Registrar": lambda x: one(registrar([x], box[None])),
            "localize": lambda x: one(localize(registrar, [x])[0]),
            "ViewMatcher": lambda x: registrar.matcher([x], box[None]),
            "Locator": lambda x: registrar.locator([x]),
            "locate": lambda x: cr.locate(registrar.pipeline, bank, [x]),
            "fit_contours": fit,
            "pose_glb": lambda x: pose_glb(mesh, pose, CAMERA, x),
            "contour_overlay": lambda x: contour_overlay(registrar, result, x, box),
        }
        self.boxes: dict[str, Callable[[Any], object]] = {
            "Registrar": lambda b: one(registrar([image], b)),
            "ViewMatcher": lambda b: registrar.matcher([image], b),
            "fit_contours": lambda b: fit(boxes=b),
            "crop_images": lambda b: cr.crop_images([image], b),
        }


@pytest.fixture(scope="module")
def entries(truck: trimesh.Trimesh, pose: Tensor, photograph: tuple[Tensor, Tensor], registrar: Any) -> Entries:
    return Entries(truck, pose, photograph, registrar)


def refused(name: str, call: Callable[[Any], object], given: Any, match: str = ".") -> CurviregError:
    """The one-line error with which an entry refuses ``given``."""
    with pytest.raises(CurviregError, match=match) as caught:
        call(given)
    assert "\n" not in str(caught.value), name
    return caught.value


def changed(matrix: Tensor, *changes: tuple[int, int, float]) -> Tensor:
    matrix = matrix.clone()
    for i, j, value in changes:
        matrix[i, j] = value
    return matrix
