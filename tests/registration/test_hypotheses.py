"""Distinct hypotheses, and the feature of their rank."""

import pytest
import torch

from curvireg_torch.geometry import rotation_from_axis_angle
from curvireg_torch.registration.hypotheses import Hypotheses, distinct_mask
from curvireg_torch.registration.rescoring import rank_feature


def hypotheses(image: list[int], degrees: list[float], score: list[float], model: list[int] | None = None):
    """Hypotheses that differ by rotations about one axis."""
    n = torch.tensor(image)
    axis_angle = torch.zeros(len(n), 3, dtype=torch.float64)
    axis_angle[:, 1] = torch.deg2rad(torch.tensor(degrees, dtype=torch.float64))
    models = torch.zeros_like(n) if model is None else torch.tensor(model)
    scores = torch.tensor(score, dtype=torch.float64)
    R, one = rotation_from_axis_angle(axis_angle), torch.ones_like(scores)
    return Hypotheses(n, torch.arange(len(n)), models, R, one, scores, one)


@pytest.mark.parametrize(
    ("image", "degrees", "score", "model", "expected"),
    [
        ([0, 0, 0, 0], [0.0, 14.0, 16.0, 180.0], [0.9, 0.8, 0.7, 0.6], [0] * 4, [True, False, True, True]),
        ([0, 1, 1, 1], [0.0, 1.0, 14.0, 180.0], [0.9, 0.8, 0.7, 0.6], [0] * 4, [True, True, False, True]),
        ([0, 0, 0, 0], [0.0, 1.0, 2.0, 3.0], [0.9, 0.8, 0.7, 0.6], [0, 1, 0, 1], [True, True, False, False]),
        ([0, 0], [0.0, 10.0], [0.1, 0.2], [0, 0], [False, True]),
    ],
    ids=["15 degrees", "per image", "per model", "best is kept"],
)
def test_distinct_mask(image, degrees, score, model, expected):
    some = hypotheses(image, degrees, score, model)
    assert distinct_mask(some, some.ranking_score).tolist() == expected


def test_rank_feature_is_relative_to_the_best_of_the_same_image():
    starts = hypotheses([0, 0, 1, 1], [0.0, 90.0, 0.0, 90.0], [1.0, 0.5, 0.01, 0.04])
    expected = torch.tensor([1.0, 0.5, 0.25, 1.0], dtype=torch.float64).log()
    torch.testing.assert_close(rank_feature(starts), expected)
