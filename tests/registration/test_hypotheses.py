"""Evidence of hypotheses, and which of them are peaks of their own."""

import torch

from curvireg_torch.geometry import rotation_from_axis_angle
from curvireg_torch.registration.hypotheses import Hypotheses, distinct_mask
from curvireg_torch.registration.rescoring import gather_pose_features


def found(photograph: list[int], degrees: list[float], score: list[float], model: list[int] | None = None):
    """Hypotheses that differ by turns about one axis."""
    turn = torch.zeros(len(degrees), 3, dtype=torch.float64)
    turn[:, 1] = torch.deg2rad(torch.tensor(degrees, dtype=torch.float64))
    n = torch.tensor(photograph)
    models = torch.zeros_like(n) if model is None else torch.tensor(model)
    scores = torch.tensor(score, dtype=torch.float64)
    return Hypotheses(
        n, torch.arange(len(n)), models, rotation_from_axis_angle(turn), torch.ones(len(n)).double(), scores
    )


def test_a_hypothesis_within_15_degrees_of_a_better_one_is_no_peak_of_its_own():
    score = [0.9, 0.8, 0.7, 0.6]
    some = found([0, 0, 0, 0], [0.0, 14.0, 16.0, 180.0], score)
    assert distinct_mask(some, some.score).tolist() == [True, False, True, True]
    other_photograph = found([0, 1, 1, 1], [0.0, 1.0, 14.0, 180.0], score)
    assert distinct_mask(other_photograph, other_photograph.score).tolist() == [True, True, False, True]
    other_model = found([0, 0, 0, 0], [0.0, 1.0, 2.0, 3.0], score, [0, 1, 0, 1])
    assert distinct_mask(other_model, other_model.score).tolist() == [True, True, False, False]
    worse_first = found([0, 0], [0.0, 10.0], [0.1, 0.2])
    assert distinct_mask(worse_first, worse_first.score).tolist() == [False, True]


def test_ranks_are_told_beside_the_best_of_the_same_photograph():
    """Logarithms of scores, whatever those of other photographs are."""
    starts = found([0, 0, 1, 1], [0.0, 90.0, 0.0, 90.0], [1.0, 0.5, 0.01, 0.04])
    similarity = torch.tensor([0.6, 0.7, 0.8, 0.9]).double()
    edge_support, appearance_scores = (
        torch.tensor([0.1, 0.2, 0.3, 0.4]).double(),
        torch.tensor([-1.0, -2.0, -3.0, -4.0]).double(),
    )
    evidence = gather_pose_features(starts, similarity, edge_support, appearance_scores)
    rank = torch.tensor([1.0, 0.5, 0.25, 1.0], dtype=torch.float64).log()
    torch.testing.assert_close(evidence, torch.stack([rank, similarity, edge_support, appearance_scores], dim=1))
