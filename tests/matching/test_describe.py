from unittest.mock import Mock

import pytest
import torch
import trimesh

from curvireg_torch.geometry import sample_views
from curvireg_torch.matching.describe import VIEW_FACES, ViewDescriber, quarter_turns
from curvireg_torch.pipeline import BankSettings
from curvireg_torch.rendering import make_renderer


@pytest.mark.parametrize("camera", ["perspective", "orthographic"])
def test_describer_renders_quarter_turns_once(truck, camera):
    describe = ViewDescriber(truck, BankSettings(image_size=64, camera=camera))
    views = sample_views(azimuth_step=180, elevations=[20], thetas=[0, 35, 90, 180, 215, 270, 305])
    rotations, distances = views.rotations, views.distance * describe.radius
    describe.view_renderer = Mock(wraps=describe.view_renderer)
    together = describe(rotations, distances)
    (call,) = describe.view_renderer.render.call_args_list
    assert len(call.args[0]) == 4, "two directions, 0 and 35"
    for i in range(len(rotations)):
        alone = describe(rotations[i : i + 1], distances[i : i + 1])
        assert (together["descriptors"][i] - alone["descriptors"][0]).norm() < 0.02 * alone["descriptors"][0].norm()
        assert (together["points"][i] ^ alone["points"][0]).float().mean() < 0.01
        assert (together["silhouettes"][i] ^ alone["silhouettes"][0]).float().mean() < 0.001
        torch.testing.assert_close(together["boxes"][i], alone["boxes"][0], rtol=0, atol=1e-6 * describe.radius)


def test_views_of_a_fine_mesh_equal_those_of_a_simplified_one():
    fine = trimesh.util.concatenate([trimesh.creation.icosphere(5), trimesh.creation.box((0.4, 0.5, 2.6))])
    views = sample_views(azimuth_step=120, elevations=[-20, 35])
    exact = ViewDescriber(fine, BankSettings(), renderer=make_renderer(fine))
    quick = ViewDescriber(fine, BankSettings())
    assert len(fine.faces) > 2 * VIEW_FACES
    expected, found = (each(views.rotations, views.distance * exact.radius) for each in (exact, quick))
    assert float((expected["silhouettes"] ^ found["silhouettes"]).float().mean()) < 1e-3
    assert float(torch.cosine_similarity(expected["descriptors"], found["descriptors"]).min()) > 0.995
    torch.testing.assert_close(found["boxes"], expected["boxes"])


def test_quarter_turns_groups_views_of_equal_direction_and_distance():
    views = sample_views(azimuth_step=180, elevations=[20], thetas=[0, 90, 180, 270, 45])
    rotations, distances = views.rotations, views.distance.clone()
    distances[1] *= 1.001
    first, quarters = quarter_turns(rotations, distances)
    assert len(set(first.tolist())) == 5  # 0 and 45 degrees of two directions, and the more distant view
    assert first[1] == 1
    theta = views.theta.round().long()
    assert quarters.tolist() == ((theta[first] - theta) // 90 % 4).tolist()
    assert torch.equal(views.azimuth[first], views.azimuth)
