from unittest.mock import Mock

import pytest
import torch
import trimesh
from torch.testing import assert_close

from curvireg_torch.geometry import sample_views
from curvireg_torch.matching import ViewBank
from curvireg_torch.matching.describe import VIEW_FACES, ViewDescriber, quarter_turns
from curvireg_torch.pipeline import BankSettings, Pipeline
from curvireg_torch.rendering import make_renderer
from curvireg_torch.terms import Correlation

CAMERAS = ("perspective", "orthographic")


@pytest.mark.parametrize("camera", CAMERAS)
def test_describer_renders_quarter_turns_once(truck, camera):
    describe = ViewDescriber(truck, BankSettings(image_size=64, camera=camera))
    views = sample_views(azimuth_step=180, elevations=[20], thetas=[0, 35, 90, 180, 215, 270, 305])
    rotations = views.rotations
    distances = views.distance * describe.radius
    describe.view_renderer = Mock(wraps=describe.view_renderer)
    together = describe(rotations, distances)
    (call,) = describe.view_renderer.render.call_args_list
    assert len(call.args[0]) == 4, "two directions, 0 and 35"
    for i in range(len(rotations)):
        alone = describe(rotations[i : i + 1], distances[i : i + 1])
        assert (together["descriptors"][i] - alone["descriptors"][0]).norm() < 0.02 * alone[
            "descriptors"
        ][0].norm()
        assert (together["points"][i] ^ alone["points"][0]).float().mean() < 0.01
        assert (together["silhouettes"][i] ^ alone["silhouettes"][0]).float().mean() < 0.001
        assert_close(together["boxes"][i], alone["boxes"][0], rtol=0, atol=1e-6 * describe.radius)


def test_views_of_a_fine_mesh_equal_those_of_a_simplified_one():
    fine = trimesh.util.concatenate(
        [trimesh.creation.icosphere(5), trimesh.creation.box((0.4, 0.5, 2.6))]
    )
    views = sample_views(azimuth_step=120, elevations=[-20, 35])
    exact = ViewDescriber(fine, BankSettings(), renderer=make_renderer(fine))
    quick = ViewDescriber(fine, BankSettings())
    assert len(fine.faces) > 2 * VIEW_FACES
    expected, found = (
        each(views.rotations, views.distance * exact.radius) for each in (exact, quick)
    )
    assert (expected["silhouettes"] ^ found["silhouettes"]).float().mean() < 1e-3
    assert torch.cosine_similarity(expected["descriptors"], found["descriptors"]).min() > 0.995
    assert_close(found["boxes"], expected["boxes"])


def test_quarter_turns_groups_views_of_equal_direction_and_distance():
    views = sample_views(azimuth_step=180, elevations=[20], thetas=[0, 90, 180, 270, 45])
    rotations = views.rotations
    distances = views.distance.clone()
    distances[1] *= 1.001
    first, quarters = quarter_turns(rotations, distances)
    # 0 and 45 degrees of two directions, and the more distant view
    assert len(set(first.tolist())) == 5
    assert first[1] == 1
    theta = views.theta.round().long()
    assert quarters.tolist() == ((theta[first] - theta) // 90 % 4).tolist()
    assert torch.equal(views.azimuth[first], views.azimuth)


def lengths(mesh, name, camera):
    """(P,) lengths of the fields of six views."""
    describe = ViewDescriber(mesh, BankSettings(depth_field=name, camera=camera))
    views = sample_views(azimuth_step=120, elevations=[0, 30])
    return describe.fields(views.rotations, views.distance * describe.radius).norm(dim=1).flatten()


@pytest.mark.parametrize("name", ["ASG", "AR"])
def test_shading_and_apparent_ridges_see_the_surface_of_perspective_views(truck, name):
    """Without the camera they are nearly the Hessian's Frobenius norm."""
    found = {
        kind: torch.stack([lengths(truck, n, kind) for n in (name, "HFN")]) for kind in CAMERAS
    }
    correlation = {kind: float(torch.corrcoef(x)[0, 1]) for kind, x in found.items()}
    assert correlation["perspective"] < 0.6
    assert correlation["orthographic"] > 0.7
    settings = BankSettings(depth_field=name)
    describe = ViewDescriber(truck, settings)
    views = sample_views(azimuth_step=180, elevations=[20])
    at = views.rotations, views.distance * describe.radius
    bank = ViewBank.build(
        truck, views, pipeline=Pipeline(bank=settings, terms=(Correlation(),)), progress=False
    )
    assert_close(bank.descriptors, describe.descriptor(describe.fields(*at)), rtol=0, atol=2e-3)
    assert_close(describe.descriptors(*at), describe.descriptor(describe.fields(*at)))
    T, K, _ = describe.cameras(*at)
    field, pictures = describe.seen_by(T, K, shaded=True)
    assert_close(field, describe.fields(*at))
    assert_close(pictures, describe.shaded(*at))
    assert describe.seen_by(T, K, shaded=False)[1] is None


def test_an_orthographic_view_is_rendered_once_for_all_distances(truck):
    describe = ViewDescriber(truck, BankSettings(image_size=64, camera="orthographic"))
    views = sample_views(azimuth_step=180, elevations=[20], distances=[2.0, 3.0, 8.0])
    describe.view_renderer = Mock(wraps=describe.view_renderer)
    together = describe(views.rotations, views.distance * describe.radius)
    (call,) = describe.view_renderer.render.call_args_list
    assert len(call.args[0]) == 2
    assert torch.equal(together["descriptors"][0], together["descriptors"][2])
    assert not torch.equal(together["descriptors"][0], together["descriptors"][3])
