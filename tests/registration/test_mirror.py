"""The mirror image of a mesh beside the mesh."""

from unittest.mock import Mock

import numpy as np
import pytest
import torch
import trimesh

from curvireg_torch.geometry.cameras import projected
from curvireg_torch.registration import doubts, stages
from curvireg_torch.registration.photograph import as_photograph
from tests._support import (
    CAMERA,
    SIZE,
    answer_of,
    answer_to,
    bank_around,
    double,
    exact_registrar,
    eye,
    learned_registrar,
    scene,
    truck_registrar,
)
from tests._support.spies import spied


def chiral_mesh():
    parts = [
        trimesh.creation.box((1.0, 0.6, 0.4)),
        trimesh.creation.box((0.3, 0.3, 0.5)).apply_translation((0.5, 0.2, 0.3)),
        trimesh.creation.box((0.2, 0.7, 0.2)).apply_translation((-0.4, 0.4, 0.1)),
    ]
    return trimesh.util.concatenate(parts)


def mirrored(surface):
    """The mirror image of a surface, with its faces turned."""
    return surface.copy().apply_transform(np.diag([-1.0, 1.0, 1.0, 1.0]))


def test_a_mirror_shows_the_mirror_image_of_a_mesh():
    """Points of the mesh project onto the flipped photograph where those of the image are."""
    item = as_photograph(*scene(0)[:2], None, mask=torch.rand(SIZE))
    K = double([[200.0, 0.0, 100.0], [0.0, 210.0, 80.0], [0.0, 0.0, 1.0]])
    seen = doubts.flipped(item, K)
    points = torch.rand(5, 3, dtype=torch.float64) + double([-0.5, -0.5, 2.0])
    uv = projected(points, eye(4)[None], K[None])[0]
    in_mirror = projected(
        points * double([-1.0, 1.0, 1.0]), torch.eye(4).double()[None], seen.K[None]
    )[0]
    last = SIZE[1] - 1
    torch.testing.assert_close(in_mirror[:, 0], last - uv[:, 0])
    torch.testing.assert_close(in_mirror[:, 1], uv[:, 1])
    assert torch.equal(seen.image[..., 7], item.image[..., last - 7])
    assert torch.equal(seen.mask[..., 7], item.mask[..., last - 7])
    x0, y0, x1, y1 = item.box.tolist()
    assert seen.box.tolist() == pytest.approx([last - x1, y0, last - x0, y1])
    again = doubts.flipped(seen, seen.K)
    assert torch.equal(again.image, item.image)
    assert torch.equal(again.K, K)


def test_confidence_falls_where_the_mirror_image_fits_better_and_is_another_mesh(monkeypatch):
    for gain, is_same, is_doubted in ((0.4, False, False), (1.5, False, True), (1.5, True, False)):
        monkeypatch.setattr(doubts, "mirror_gain", Mock(return_value=double([gain])))
        monkeypatch.setattr(doubts, "is_its_own_mirror_image", Mock(return_value=is_same))
        result = answer_to(0, learned_registrar())
        assert (doubts.MIRROR_WARNING in result.warnings) == is_doubted
        assert result.reliable != is_doubted
        if is_doubted:
            assert result.confidence < 0.5


@pytest.mark.parametrize(("gain", "boxes"), [(-1.0, 3), (1.5, 1)])
def test_a_mirrored_mesh_is_not_sought_in_other_boxes(gain, boxes, monkeypatch):
    """In which the flipped photograph may be seen in a wrong one."""
    monkeypatch.setattr(doubts, "LEAST_CONFIDENCE", 0.0)
    monkeypatch.setattr(doubts, "mirror_gain", lambda *given: double([gain] * len(given[-1])))
    registered = spied(monkeypatch, stages, "register_boxes")
    image, box, _ = scene(0)
    answer_of(truck_registrar(box_jitter=0.1), image, box + double([0.0, 0.0, 12.0, 12.0]))
    assert sum(len(items) for _, items in registered) == boxes


def test_mirrored_mesh_is_told_from_the_mesh(monkeypatch):
    given = spied(monkeypatch, doubts, "mirror_gain")
    bank = bank_around(mirrored(learned_registrar().bank.mesh.surface), 30, [0, 30, 60])
    monkeypatch.setattr(doubts, "LEAST_CONFIDENCE", 0.0)
    image, box, _ = scene(0)
    last = image.shape[-1] - 1
    x0, y0, x1, y1 = box.tolist()
    boxes = torch.tensor([[last - x1, y0, last - x0, y1], [x0, y0, x1, y1]])
    both = exact_registrar(bank)([image.flip(-1), image], boxes, CAMERA)
    assert [doubts.MIRROR_WARNING in result.warnings for result in both] == [False, True]
    right, wrong = doubts.mirror_gain(*given[0])
    assert right < -1.0
    assert wrong > 1.0
    *known, best = given[0]
    alone = doubts.mirror_gain(*known, best[[1]])
    assert alone.tolist() == pytest.approx([float(wrong)], abs=0.05)
    monkeypatch.setattr(doubts, "LESS_ALIKE", 0.0)
    right, wrong = doubts.mirror_gain(*given[0])
    assert right == -torch.inf
    assert wrong > 1.0
