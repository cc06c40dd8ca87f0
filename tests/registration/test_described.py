"""Poses beside a photograph: what counts for them, and what does not."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from curvireg_torch import Pipeline
from curvireg_torch.geometry.framing import CropFrame, photograph_box
from curvireg_torch.matching import Ranking
from curvireg_torch.pipeline import FitSettings
from curvireg_torch.registration.block import Described, counting_keypoints, evidence_of
from curvireg_torch.registration.hypotheses import Hypotheses
from tests._support import CAMERA, SIZE, double, eye, learned_registrar, scene


def frame_of(target, box):
    settings = target.bank.settings
    shown = photograph_box(SIZE)
    return CropFrame.of(box, shown, side=settings.image_size, margin=settings.margin)


@pytest.mark.parametrize(("chance", "expected"), [(2, [0.0, 0.0, 1.0, 20.0]), (0, [0, 2, 3, 22])])
def test_keypoints_that_agree_by_chance_do_not_count(chance, expected):
    counts = double([0.0, 2.0, 3.0, 22.0])
    pipeline = Pipeline(fit=FitSettings(chance_keypoints=chance))
    none = torch.zeros(4, dtype=torch.float64)
    T = eye(4).repeat(4, 1, 1)
    poses = Hypotheses.at(T, T[:, :3, :3], none[:3], none.long(), none)
    described = SimpleNamespace(keypoints=[SimpleNamespace(agreeing=lambda *_: counts), None])
    target = SimpleNamespace(pipeline=pipeline)
    assert counting_keypoints(target, described, poses).tolist() == expected
    elsewhere = replace(poses, photograph=torch.ones_like(poses.photograph))
    assert counting_keypoints(target, described, elsewhere).tolist() == [0.0] * 4


def test_what_lies_outside_the_photograph_is_not_compared():
    target = learned_registrar()
    _, box, T = scene(0)
    nothing = torch.zeros(1)
    poses = Hypotheses.at(
        T[None], CAMERA[None], target.describer.centre, nothing.long(), nothing.double()
    )
    frame = frame_of(target, box)
    (field,), _ = target.describer.seen_by(T[None], (frame.transform @ CAMERA)[None], shaded=False)
    photograph = Described(
        query=None,
        rankings=[Ranking.none()],
        descriptor=target.describer.descriptor(field[None]),
        crops=None,
        keypoints=[None],
        frames=[frame],
    )
    assert float(evidence_of(target, photograph, poses).similarity) == pytest.approx(1.0)
    unseen = replace(frame, inside=torch.zeros_like(frame.inside))
    hidden = replace(photograph, frames=[unseen])
    assert float(evidence_of(target, hidden, poses).similarity) == 0.0


def test_poses_in_frames_and_poses_by_themselves_keep_their_order():
    target = learned_registrar()
    _, box, T = scene(0)
    none = torch.zeros(4, dtype=torch.float64)
    photograph = torch.tensor([1, 0, 1, 0])
    turned = torch.stack([T, T, T @ torch.diag(double([-1.0, -1, 1, 1])), T])
    poses = Hypotheses.at(
        turned, CAMERA.expand(4, 3, 3), target.describer.centre, none.long(), none, photograph
    )
    frame = frame_of(target, box)
    (field,), _ = target.describer.seen_by(T[None], (frame.transform @ CAMERA)[None], shaded=False)
    descriptor = target.describer.descriptor(field[None]).expand(2, -1)
    two = Described(
        query=None,
        rankings=[Ranking.none()] * 2,
        descriptor=descriptor,
        crops=None,
        keypoints=[None] * 2,
        frames=[None, frame],
    )
    together = evidence_of(target, two, poses).similarity
    for row in range(4):
        alone = evidence_of(target, two, poses[row : row + 1]).similarity
        assert float(together[row]) == pytest.approx(float(alone), abs=1e-6)
    assert float(together[0]) > float(together[2]) + 0.01
