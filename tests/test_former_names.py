"""Names that stages in batches took the place of still work, and say what to use."""

import pytest
import torch

from curvireg_torch import registration, rendering, rotation_error
from curvireg_torch.geometry import rotation_from_axis_angle
from curvireg_torch.matching import ViewDescriber
from tests._support.scenes import CAMERA, truck_bank


def test_refine_pose_searches_around_the_best_of_the_views():
    bank = truck_bank()
    describe, z = ViewDescriber(bank.mesh, bank.settings), bank.distances[:1]
    truth = (
        rotation_from_axis_angle(torch.tensor([0.03, 0.06, -0.02], dtype=torch.float64)) @ bank.rotations[5].double()
    )
    query = describe.descriptors(truth[None], z)
    with pytest.warns(DeprecationWarning, match="refine_pose is deprecated; use registration.search"):
        found = registration.refine_pose(
            describe, query, bank.rotations[[4, 5, 6]], distance=float(z), radius=describe.radius, step=5.0
        )
    assert isinstance(found, registration.RefinedPose)
    assert float(rotation_error(found.rotation, truth)) < 1.0
    assert found.score > 0.95
    assert found.distance == float(z)  # no camera: nothing to tell it by


def test_render_views_renders():
    renderer = ViewDescriber(truck_bank().mesh, truck_bank().settings).renderer
    T = torch.eye(4, dtype=torch.float64)[None]
    T[0, 2, 3] = 6.0
    with pytest.warns(DeprecationWarning, match="render_views is deprecated; use renderer.render"):
        depth = rendering.render_views(renderer, T, CAMERA, (180, 240))
    assert torch.equal(depth, renderer.render(T, CAMERA, (180, 240)))
    assert float(depth.max()) > 0.0
