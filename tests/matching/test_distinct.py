"""Views that are the same up to the object's symmetries, and what a view shows."""

import math

import torch

from curvireg_torch import ViewBank
from curvireg_torch.geometry import rotation_from_axis_angle, sample_views
from curvireg_torch.matching import distinct_views
from curvireg_torch.synthetic import example_mesh


def test_symmetries_turn_the_model_and_not_the_camera():
    R = rotation_from_axis_angle(torch.tensor([0.9, -0.4, 0.7], dtype=torch.float64))
    quarter = rotation_from_axis_angle(torch.tensor([0.0, 0.0, math.pi / 2], dtype=torch.float64))
    turns = torch.stack([torch.eye(3, dtype=torch.float64), quarter, quarter @ quarter, quarter.T])
    views = torch.stack([R, R @ quarter, quarter @ R, R @ quarter.T])
    assert distinct_views(torch.arange(4), views, count=4, symmetries=turns).tolist() == [0, 2]
    assert distinct_views(torch.tensor([3, 2, 1, 0]), views, count=4, symmetries=turns).tolist() == [3, 2]
    assert distinct_views(torch.arange(4), views, count=4).tolist() == [0, 1, 2, 3]


def test_a_banks_silhouettes_fill_their_crops_but_for_the_margin():
    views = sample_views(azimuth_step=90, elevations=[20])
    bank = ViewBank.build(example_mesh(), views, image_size=96, progress=False)
    share = bank.settings.image_size / (1.0 + 2.0 * bank.settings.margin)
    for one in bank.silhouettes:
        y, x = one.nonzero(as_tuple=True)
        longer = max(int(y.max() - y.min()), int(x.max() - x.min())) + 1
        assert abs(longer - share) < 2.5
        assert bool(one[bank.settings.image_size // 2].any())
