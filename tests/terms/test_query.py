"""Crops of a box and of jittered copies of it."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from curvireg_torch import ViewMatcher
from curvireg_torch.terms import jittered_boxes


def test_jittered_boxes_are_shifted_and_scaled():
    box = torch.tensor([[10.0, 20, 110, 70]])
    jittered = jittered_boxes(box, 0.2)
    assert jittered[0, 0].equal(box[0])
    centres = 0.5 * (jittered[0, :, :2] + jittered[0, :, 2:]) - torch.tensor([60.0, 45])
    expected = torch.tensor([[0.0, 0], [-15, 0], [15, 0], [0, -15], [0, 15], [0, 0], [0, 0]])
    torch.testing.assert_close(centres, expected)
    width = jittered[0, :, 2] - jittered[0, :, 0]
    assert width.tolist() == pytest.approx([100] * 5 + [100 / 1.2, 120], rel=1e-5)
    assert jittered_boxes(box, 0.0).equal(box[None])
    assert jittered_boxes(box, 0.45).shape == (1, 7, 4)


def test_box_jitter_recovers_a_shifted_view(bank):
    S, margin = bank.settings.image_size, bank.settings.margin
    picture = bank.silhouettes_at(slice(30, 31))[:, None].float().expand(-1, 3, -1, -1)
    side = S / (1 + 2 * margin)
    box = torch.tensor([[(S - side) / 2, (S - side) / 2, (S + side) / 2, (S + side) / 2]]) - 0.5
    shifted = box + 0.075 * side * torch.tensor([1.0, 0, 1, 0])
    pipelines = (replace(bank.pipeline, box_jitter=jitter) for jitter in (0.0, 0.1))
    exact, jitter = (ViewMatcher(bank, field=_Gradient(), pipeline=pipeline) for pipeline in pipelines)
    cases = ((exact, box), (exact, shifted), (jitter, shifted))
    reference, lost, recovered = (matcher(picture, b).hog[0, 30].item() for matcher, b in cases)
    assert lost < reference - 0.05
    assert recovered > reference - 0.01


class _Gradient(nn.Module):
    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return torch.stack(torch.gradient(image[:, 0], dim=(2, 1)), dim=1)
