"""A made-up registration."""

import torch

from curvireg_torch import Registration
from curvireg_torch.matching import Ranking
from curvireg_torch.registration import Hypothesis

FEATURES = {
    "similarity": 0.7,
    "margin": 0.1,
    "edge_support": 0.6,
    "contours": 0.4,
    "ranking_share": 0.3,
    "keypoints": 0.0,
    "unmatched": 0.0,
    "undetermined": 1.2,
    "outside": 0.0,
    "border": 0.0,
    "focal": 0.0,
}
"""Of an answer that is likely, and not certain."""


def registration(covariance=None, confidence=0.9, detection=None):
    """A registration to a bank of two views, the second of which one term did not compare."""
    terms = {"hog": torch.tensor([[0.5, 0.4]]), "appearance": torch.tensor([[0.3, torch.nan]])}
    ranking = Ranking(torch.tensor([[0.9, 0.8]]), torch.tensor([[0, 1]]), terms)
    eye = torch.eye(3, dtype=torch.float64)
    common = {
        "rotation": eye,
        "translation": 2.0 * eye[2],
        "allocentric_rotation": eye,
        "distance": 2.0,
    }
    common |= {
        "evidence": {"rank": 0.0},
        "projection": (torch.eye(4).double(), eye),
        "covariance": covariance,
    }
    hypotheses = tuple(Hypothesis(**common, score=0.7 - 0.1 * view, view=view) for view in (0, 1))
    return Registration(hypotheses, (confidence, 0.0), ranking, detection=detection)
