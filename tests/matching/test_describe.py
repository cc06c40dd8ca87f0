from unittest.mock import Mock

import pytest
import torch
import trimesh
from torch.testing import assert_close

from curvireg_torch.geometry import sample_views
from curvireg_torch.matching import ViewBank
from curvireg_torch.matching.describe import VIEW_FACES, ViewDescriber
from curvireg_torch.pipeline import BankSettings, Pipeline
from curvireg_torch.rendering import make_renderer
from curvireg_torch.terms import Correlation

CAMERAS = ("perspective", "orthographic")


@pytest.mark.parametrize(("camera", "pictures"), [("perspective", 5), ("orthographic", 4)])
def test_pictures_that_differ_by_quarter_turns_are_rendered_once(truck, camera, pictures):
    """Of two directions, turned by 0 and 35 degrees; the second view is a little farther away,
    which an orthographic camera does not see."""
    describe = ViewDescriber(truck, BankSettings(image_size=64, camera=camera))
    views = sample_views(azimuth_step=180, elevations=[20], thetas=[0, 35, 90, 180, 215, 270, 305])
    rotations = views.rotations
    distances = views.distance * describe.radius
    distances[1] *= 1.001
    describe.view_renderer = Mock(wraps=describe.view_renderer)
    together = describe(rotations, distances)
    (call,) = describe.view_renderer.render.call_args_list
    assert len(call.args[0]) == pictures
    for i in range(len(rotations)):
        alone = {name: x[0] for name, x in describe(rotations[[i]], distances[[i]]).items()}
        found = {name: x[i] for name, x in together.items()}
        off = (found["descriptors"] - alone["descriptors"]).norm()
        assert off < 0.02 * alone["descriptors"].norm()
        assert (found["points"] ^ alone["points"]).float().mean() < 0.01
        assert (found["silhouettes"] ^ alone["silhouettes"]).float().mean() < 0.001
        assert_close(found["boxes"], alone["boxes"], rtol=0, atol=1e-6 * describe.radius)


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
