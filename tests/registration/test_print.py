"""A can looks the same upside down except for its label: only a mesh with a texture tells the two apart."""

from dataclasses import replace

import pytest
import torch
import trimesh

from curvireg_torch import Pipeline, Registrar, load_mesh, rotation_error, rotation_from_viewpoint, sample_views
from curvireg_torch.geometry import transform, up_rotation
from curvireg_torch.geometry.cameras import projected_boxes
from curvireg_torch.mesh.mesh import extreme_points
from tests._support.cans import can, photograph
from tests._support.scenes import CAMERA

VIEWS = sample_views(azimuth_step=30, elevations=[-25, 25], thetas=[0, 180]).for_up("y")
PIPELINE = replace(Pipeline(field="focus", box_jitter=0.0, hypotheses=4), bank=replace(Pipeline().bank, image_size=64))
UNREFINED = replace(PIPELINE, contours=False)


@pytest.fixture(scope="module")
def cans(tmp_path_factory) -> dict[str, trimesh.Trimesh]:
    """A can, read from GLB, and without its label, from STL."""
    folder = tmp_path_factory.mktemp("cans")
    can().export(folder / "printed.glb")
    can().export(folder / "grey.stl")
    return {"printed": load_mesh(folder / "printed.glb"), "grey": load_mesh(folder / "grey.stl", up="y")}


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
    assert float(rotation_error(printed.rotation, R)) < 2
    assert is_upright(printed.hypotheses[0]) == upright
    assert all(h.evidence["rank"] < -0.3 for h in printed.hypotheses if is_upright(h) != upright)
    best_of_grey = {is_upright(h) for h in grey.hypotheses if h.evidence["rank"] > -0.001}
    assert best_of_grey == {True, False}
