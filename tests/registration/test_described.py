"""Poses beside a photograph: keypoints that agree by chance are no evidence."""

from types import SimpleNamespace

import pytest
import torch

from curvireg_torch import Pipeline
from curvireg_torch.pipeline import FitSettings
from curvireg_torch.registration.described import ComparedPoses


@pytest.mark.parametrize(("chance", "expected"), [(2, [0.0, 0.0, 1.0, 20.0]), (0, [0, 2, 3, 22])])
def test_keypoints_that_agree_by_chance_do_not_count(chance, expected):
    counts = torch.tensor([0.0, 2.0, 3.0, 22.0]).double()
    pipeline = Pipeline(fit=FitSettings(chance_keypoints=chance))
    poses = SimpleNamespace(T=torch.zeros(4, 4, 4), cameras=torch.zeros(4, 3, 3))
    found = SimpleNamespace(keypoints=SimpleNamespace(agreeing=lambda *_: counts))
    compared = ComparedPoses(SimpleNamespace(pipeline=pipeline), found, poses)
    assert compared.keypoints.tolist() == expected
