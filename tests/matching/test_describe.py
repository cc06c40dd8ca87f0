"""Views described together are those described one by one."""

import pytest
import torch

from curvireg_torch.geometry import projected_boxes, sample_views
from curvireg_torch.matching.describe import ViewDescriber, quarter_turns
from curvireg_torch.settings import BankSettings
from curvireg_torch.synthetic import example_mesh


@pytest.mark.parametrize("camera", ["perspective", "orthographic"])
def test_quarter_turns_are_described_as_each_by_itself(camera):
    describe = ViewDescriber(example_mesh(), BankSettings(image_size=64, camera=camera))
    views = sample_views(azimuth_step=180, elevations=[20], thetas=[0, 35, 90, 180, 215, 270, 305])
    rotations, distances = views.rotations, views.distance * describe.radius
    rendered = []
    render = describe.renderer.render

    class Counting:
        def render(self, T, *arguments, **options):
            rendered.append(len(T))
            return render(T, *arguments, **options)

    describe.renderer = Counting()
    together = describe(rotations, distances)
    assert rendered == [4]  # two directions, at 0 and 35 degrees
    for i in range(len(rotations)):
        alone = describe(rotations[i : i + 1], distances[i : i + 1])
        assert (together.descriptors[i] - alone.descriptors[0]).norm() < 0.02 * alone.descriptors[0].norm()
        assert (together.points[i] ^ alone.points[0]).float().mean() < 0.01
        assert (together.silhouettes[i] ^ alone.silhouettes[0]).float().mean() < 0.001
        torch.testing.assert_close(together.boxes[i], alone.boxes[0], rtol=0, atol=1e-6 * describe.radius)


def test_which_views_are_quarter_turns():
    views = sample_views(azimuth_step=180, elevations=[20], thetas=[0, 90, 180, 270, 45])
    rotations, distances = views.rotations, views.distance.clone()
    distances[1] *= 1.001
    first, turns = quarter_turns(rotations, distances)
    theta = views.theta.round().long()
    own = {(float(a), float(t)) for a, t in zip(views.azimuth[first], views.theta[first], strict=True)}
    assert len(own) == len(set(first.tolist())) == 5  # 0 and 45 of two directions, and the one farther away
    assert first[1] == 1
    assert turns.tolist() == ((theta[first] - theta) // 90 % 4).tolist()


def test_a_parallel_view_seen_from_far_away_fills_the_box_of_the_photograph():
    """Without a camera matrix, an object of a parallel bank is seen from 20 distances farther away, as large as its
    box: but for perspective of one radius in 21 distances, its projection is the box."""
    describe = ViewDescriber(example_mesh(), BankSettings(image_size=64, camera="orthographic"))
    views = sample_views(azimuth_step=90, elevations=[20])
    rotations, distances = views.rotations.double(), 5.0 * views.distance.double() * describe.radius
    _, _, flat = describe.cameras(rotations, distances)
    boxes = 130.0 * flat / (flat[:, 2:] - flat[:, :2]).amax(dim=1, keepdim=True) + torch.tensor([200.0, 150.0] * 2)
    T, K = describe.cameras_of_boxes(rotations, distances, boxes)
    near = describe.cameras(rotations, distances)[0]
    torch.testing.assert_close(T[:, 2, 3] + (near[:, :3, :3] @ describe.centre)[:, 2], 21.0 * distances)
    assert float((projected_boxes(describe.hull, T, K) - boxes).abs().max()) < 130.0 * 0.02
