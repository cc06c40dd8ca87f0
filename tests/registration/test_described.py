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
from tests._support import CAMERA, SIZE, double, eye, learned_registrar, scene, zeros
from tests._support.hypotheses import HALF_TURN, placed_at


def frame_of(target, box):
    settings = target.bank.settings
    shown = photograph_box(SIZE)
    return CropFrame.of(box, shown, side=settings.image_size, margin=settings.margin)


def described(target, T, *frames):
    """A photograph in frames, whose descriptor is that of the pose T (4, 4) in the last one."""
    camera = (frames[-1].transform @ CAMERA)[None]
    (field,), _ = target.describer.seen_by(T[None], camera, shaded=False)
    count = len(frames)
    return Described(
        query=None,
        rankings=[Ranking.none()] * count,
        descriptor=target.describer.descriptor(field[None]).expand(count, -1),
        crops=None,
        keypoints=[None] * count,
        frames=list(frames),
    )


@pytest.mark.parametrize(("chance", "expected"), [(2, [0.0, 0.0, 1.0, 20.0]), (0, [0, 2, 3, 22])])
def test_keypoints_that_agree_by_chance_do_not_count(chance, expected):
    counts = double([0.0, 2.0, 3.0, 22.0])
    pipeline = Pipeline(fit=FitSettings(chance_keypoints=chance))
    poses = placed_at(eye(4).repeat(4, 1, 1), zeros(3), eye(3))
    described = SimpleNamespace(keypoints=[SimpleNamespace(agreeing=lambda *_: counts), None])
    target = SimpleNamespace(pipeline=pipeline)
    assert counting_keypoints(target, described, poses).tolist() == expected
    elsewhere = replace(poses, photograph=torch.ones_like(poses.photograph))
    assert counting_keypoints(target, described, elsewhere).tolist() == [0.0] * 4


def test_what_lies_outside_the_photograph_is_not_compared():
    target = learned_registrar()
    _, box, T = scene(0)
    poses = placed_at(T[None], target.describer.centre)
    photograph = described(target, T, frame_of(target, box))
    (frame,) = photograph.frames
    assert float(evidence_of(target, photograph, poses).similarity) == pytest.approx(1.0)
    unseen = replace(frame, inside=torch.zeros_like(frame.inside))
    hidden = replace(photograph, frames=[unseen])
    assert float(evidence_of(target, hidden, poses).similarity) == 0.0


def test_poses_in_frames_and_poses_by_themselves_keep_their_order():
    target = learned_registrar()
    _, box, T = scene(0)
    turned = torch.stack([T, T, T @ HALF_TURN, T])
    poses = placed_at(turned, target.describer.centre, photograph=torch.tensor([1, 0, 1, 0]))
    two = described(target, T, None, frame_of(target, box))
    together = evidence_of(target, two, poses).similarity
    for row in range(4):
        alone = evidence_of(target, two, poses[row : row + 1]).similarity
        assert float(together[row]) == pytest.approx(float(alone), abs=1e-6)
    assert float(together[0]) > float(together[2]) + 0.01
