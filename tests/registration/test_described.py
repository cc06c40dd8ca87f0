"""Poses beside a photograph: what counts for them, and what does not."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from curvireg_torch import Pipeline
from curvireg_torch.matching import Ranking
from curvireg_torch.pipeline import FitSettings
from curvireg_torch.registration.described import ComparedPoses, DescribedPhotograph
from curvireg_torch.registration.framing import CropFrame
from curvireg_torch.registration.poses import Poses
from tests._support.scenes import CAMERA, SIZE, learned_registrar, scene


@pytest.mark.parametrize(("chance", "expected"), [(2, [0.0, 0.0, 1.0, 20.0]), (0, [0, 2, 3, 22])])
def test_keypoints_that_agree_by_chance_do_not_count(chance, expected):
    counts = torch.tensor([0.0, 2.0, 3.0, 22.0]).double()
    pipeline = Pipeline(fit=FitSettings(chance_keypoints=chance))
    poses = SimpleNamespace(T=torch.zeros(4, 4, 4), cameras=torch.zeros(4, 3, 3))
    found = SimpleNamespace(keypoints=SimpleNamespace(agreeing=lambda *_: counts))
    compared = ComparedPoses(SimpleNamespace(pipeline=pipeline), found, poses)
    assert compared.keypoints.tolist() == expected


def test_what_lies_outside_the_photograph_is_not_compared():
    target = learned_registrar()
    _, box, T = scene(0)
    nothing = torch.zeros(1)
    poses = Poses.at(
        T[None], CAMERA[None], target.describer.centre, nothing.long(), nothing.double()
    )
    frame = CropFrame.of(box, SIZE, target.bank.settings)
    (field,), _ = target.describer.seen_by(T[None], (frame.transform @ CAMERA)[None], shaded=False)
    photograph = DescribedPhotograph(
        query=None,
        ranking=Ranking.none(),
        descriptor=target.describer.descriptor(field[None]),
        crops=None,
        keypoints=None,
        frame=frame,
    )
    assert float(ComparedPoses(target, photograph, poses).similarity) == pytest.approx(1.0)
    unseen = replace(frame, inside=torch.zeros_like(frame.inside))
    hidden = replace(photograph, frame=unseen)
    assert float(ComparedPoses(target, hidden, poses).similarity) == 0.0
