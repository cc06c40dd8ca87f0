"""A can looks the same upside down except for its label: only a mesh with a texture tells the two apart."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from curvireg_torch import Pipeline, Registrar, load_mesh, rotation_error, rotation_from_viewpoint, sample_views
from curvireg_torch.geometry import transform, up_rotation
from curvireg_torch.geometry.cameras import projected_boxes
from curvireg_torch.io.meshes.mesh import extreme_points
from curvireg_torch.rendering import render_colour
from tests._support.scenes import CAMERA, SIZE

VIEWS = sample_views(azimuth_step=30, elevations=[-25, 25], thetas=[0, 180]).for_up("y")
PIPELINE = replace(Pipeline(field="focus", box_jitter=0.0, hypotheses=4), bank=replace(Pipeline().bank, image_size=64))
UNREFINED = replace(PIPELINE, search=False, contours=False)


@pytest.fixture(scope="module")
def cans(tmp_path_factory) -> dict[str, trimesh.Trimesh]:
    """A closed cylinder about y with a label, read from GLB, and without, from STL."""
    label = np.full((128, 256, 3), 235, np.uint8)
    label[:36] = (170, 30, 40)
    cv2.putText(label, "BEANS", (20, 100), cv2.FONT_HERSHEY_SIMPLEX, 1.6, (20, 60, 130), 5)
    angle = np.linspace(0, 2 * np.pi, 49)
    ring = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    side = [np.c_[ring[:, 0], np.full(49, y), ring[:, 1]] for y in (-1.3, 1.3)]
    lids = [*(np.c_[ring[:, 0], np.full(49, y), ring[:, 1]] for y in (-1.3, 1.3)), [[0, -1.3, 0], [0, 1.3, 0]]]
    places = [np.c_[angle / (2 * np.pi), np.full(49, v)] for v in (0.0, 1.0)]
    k = np.arange(48)
    faces = [np.c_[k, k + 1, k + 50], np.c_[k, k + 50, k + 49]]
    faces += [np.c_[k + 99, k + 98, k * 0 + 196], np.c_[k + 147, k + 148, k * 0 + 197]]
    uv = np.concatenate([*places, np.full((100, 2), (0.5, 0.02))])
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(label))
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    can = trimesh.Trimesh(np.concatenate([*side, *lids]), np.concatenate(faces), visual=visual, process=False)
    folder = tmp_path_factory.mktemp("cans")
    can.export(folder / "printed.glb")
    can.export(folder / "grey.stl")
    return {"printed": load_mesh(folder / "printed.glb"), "grey": load_mesh(folder / "grey.stl", up="y")}


def photograph(mesh, T):
    """In other light than the views, in front of a floor and a wall, blurred and with noise."""
    picture, (H, W) = render_colour(mesh, T, CAMERA, SIZE)[0], SIZE
    room = torch.full((H, W), 0.45)
    room[2 * H // 3 :] = 0.75
    lit = picture * torch.linspace(0.95, 0.6, W) * torch.tensor([1.0, 0.95, 0.85])[:, None, None]
    image = torch.where(picture.amin(dim=0) < 0.999, lit, room)
    image = torch.from_numpy(cv2.GaussianBlur(image.permute(1, 2, 0).numpy(), (0, 0), 0.8)).permute(2, 0, 1)
    noise = torch.randn(image.shape, generator=torch.Generator().manual_seed(0))
    return (image + 0.02 * noise).clamp(0, 1)


def is_upright(hypothesis) -> bool:
    return float(hypothesis.rotation[1, 1]) < 0


@pytest.mark.parametrize("upright", [True, False])
def test_texture_tells_top_from_bottom(cans, upright):
    view = (17.0, 22.0, 0.0) if upright else (17.0, -22.0, 180.0)
    R = rotation_from_viewpoint(*torch.tensor(view, dtype=torch.float64)) @ up_rotation("y")
    T = transform(R[None], torch.tensor([[0.1, -0.05, 7.0]], dtype=torch.float64))
    image, box = photograph(cans["printed"], T), projected_boxes(extreme_points(cans["printed"]), T, CAMERA)
    printed, grey = (
        Registrar(cans[name], views=VIEWS, pipeline=pipeline, symmetries=torch.eye(4)[None])([image], box, CAMERA)[0]
        for name, pipeline in (("printed", PIPELINE), ("grey", UNREFINED))
    )
    assert float(rotation_error(printed.rotation, R)) < 15
    assert is_upright(printed.hypotheses[0]) == upright
    assert all(h.evidence["rank"] < -0.3 for h in printed.hypotheses if is_upright(h) != upright)
    best_of_grey = {is_upright(h) for h in grey.hypotheses if h.evidence["rank"] > -0.001}
    assert best_of_grey == {True, False}
