import pytest
import torch
from torch import nn

from curvireg_torch import ViewMatcher
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.geometry import crop_images
from curvireg_torch.terms import crop_regions, jittered_boxes
from tests._support.scenes import scene, truck_bank


def test_boxes_move_and_scale_as_said():
    box = torch.tensor([[10.0, 20, 110, 70]])
    several = jittered_boxes(box, 0.2)
    assert several.shape == (1, 7, 4)
    assert several[0, 0].equal(box[0])
    centres = 0.5 * (several[0, :, :2] + several[0, :, 2:]) - torch.tensor([60.0, 45])
    expected = torch.tensor([[0.0, 0], [-15, 0], [15, 0], [0, -15], [0, 15], [0, 0], [0, 0]])
    torch.testing.assert_close(centres, expected)
    width = several[0, :, 2] - several[0, :, 0]
    assert width.tolist() == pytest.approx([100] * 5 + [100 / 1.2, 120], rel=1e-5)
    assert jittered_boxes(box, 0.0).equal(box[None])


def test_regions_give_the_crops_of_whole_images():
    generator = torch.Generator().manual_seed(0)
    images = [torch.rand(3, 90, 120, generator=generator), torch.rand(3, 400, 300, generator=generator)]
    boxes = torch.tensor([[-4.0, 30, 50, 110], [20, 20, 290, 380]])
    several = jittered_boxes(boxes, 0.1)
    crops = crop_regions(images, several, size=32, margin=0.1)
    for i, image in enumerate(images):
        for k in range(7):
            whole = crop_images([image], several[i, k : k + 1], size=32, margin=0.1)[0][0]
            torch.testing.assert_close(crops[i, k], whole, atol=1e-5, rtol=0)


def test_a_moved_box_outside_the_image_gives_way():
    image = torch.rand(1, 1, 40, 40)
    several = jittered_boxes(torch.tensor([[38.0, 5, 58, 25]]), 0.2)
    crops = crop_regions(image, several, size=16, margin=0.1)
    assert crops[0, 2].equal(crops[0, 0])
    assert not crops[0, 1].equal(crops[0, 0])


def test_parts_are_the_best_over_the_crops():
    image, box, _ = scene(0)
    exact, box_jitter = ViewMatcher(truck_bank(), box_jitter=0), ViewMatcher(truck_bank())
    several = jittered_boxes(box[None], box_jitter.pipeline.box_jitter)[0]
    each = [exact([image], b[None]) for b in several]
    together = box_jitter([image], box[None])
    for part in ("hog", "repeatability"):
        best = torch.stack([getattr(r, part) for r in each]).amax(dim=0)
        torch.testing.assert_close(getattr(together, part), best, atol=1e-5, rtol=1e-4)


def test_a_shifted_view_is_found_with_slack():
    """A view's own field, cut with its box off by 7 %: with slack its correlation comes back."""
    bank = truck_bank()
    S, margin = bank.settings.image_size, bank.settings.margin
    picture = bank.silhouettes_at(slice(30, 31))[:, None].float().expand(-1, 3, -1, -1)
    side = S / (1 + 2 * margin)
    box = torch.tensor([[(S - side) / 2, (S - side) / 2, (S + side) / 2, (S + side) / 2]]) - 0.5
    off = box + 0.075 * side * torch.tensor([1.0, 0, 1, 0])
    field = _Gradient()
    exact, box_jitter = (ViewMatcher(bank, field=field, box_jitter=s) for s in (0.0, 0.1))
    here, lost, found = (m(picture, b).hog[0, 30].item() for m, b in ((exact, box), (exact, off), (box_jitter, off)))
    assert lost < here - 0.05
    assert found > here - 0.01


class _Gradient(nn.Module):
    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return torch.stack(torch.gradient(image[:, 0], dim=(2, 1)), dim=1)


@pytest.mark.parametrize("box_jitter", [-0.1, 0.5, float("nan")])
def test_bad_slack_is_named(box_jitter):
    with pytest.raises(InvalidInputError, match="box_jitter"):
        ViewMatcher(truck_bank(), box_jitter=box_jitter)
