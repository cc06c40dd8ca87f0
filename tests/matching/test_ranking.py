import math

import torch

from curvireg_torch.geometry import rotation_from_axis_angle
from curvireg_torch.matching import distinct_views


def test_distinct_views_applies_symmetries_to_the_model():
    R = rotation_from_axis_angle(torch.tensor([0.9, -0.4, 0.7], dtype=torch.float64))
    quarter = rotation_from_axis_angle(torch.tensor([0.0, 0.0, math.pi / 2], dtype=torch.float64))
    symmetries = torch.stack([torch.eye(3, dtype=torch.float64), quarter, quarter @ quarter, quarter.T])
    views = torch.stack([R, R @ quarter, quarter @ R, R @ quarter.T])
    assert distinct_views(torch.arange(4), views, count=4, symmetries=symmetries).tolist() == [0, 2]
    assert distinct_views(torch.tensor([3, 2, 1, 0]), views, count=4, symmetries=symmetries).tolist() == [3, 2]
    assert distinct_views(torch.arange(4), views, count=4).tolist() == [0, 1, 2, 3]
