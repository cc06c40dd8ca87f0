"""A result does not depend on its batch, on what was registered before, or on the number of
threads."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from curvireg_torch import Pipeline, Registrar, ViewBank, sample_views
from curvireg_torch.registration import Registration
from curvireg_torch.synthetic import example_mesh
from curvireg_torch.utils.threads import one_torch_thread
from tests._support.scenes import CAMERA, scene

IMAGES = [scene(seed)[0] for seed in (0, 1)]
BOXES = torch.stack([scene(seed)[1] for seed in (0, 1)])


@pytest.fixture(scope="module")
def bank() -> ViewBank:
    """The default pipeline; the appearance of views is described on demand, as in large banks."""
    views = sample_views(azimuth_step=30, elevations=[0, 30, 60])
    pipeline = Pipeline().with_term("appearance", exhaustive_limit=10, top=8)
    pipeline = replace(
        pipeline, hypotheses=2, detection=replace(pipeline.detection, views=12, proposals=4)
    )
    return ViewBank.build(example_mesh(), views, pipeline=pipeline, progress=False)


def numbers(result: Registration) -> list[torch.Tensor]:
    """Everything in a result, as tensors."""
    poses = [
        t
        for h in result.hypotheses
        for t in (h.rotation, h.translation, torch.tensor(list(h.evidence.values())))
    ]
    values = [
        result.confidence,
        result.score,
        result.edge_support,
        *result.confidence_features.values(),
    ]
    return [
        *poses,
        torch.tensor(values, dtype=torch.float64),
        result.ranking.scores,
        result.ranking.order,
    ]


def test_registration_is_bit_identical_in_any_company(
    bank: ViewBank, threads: Callable[[int], None]
) -> None:
    threads(1)
    alone = [Registrar(bank)([i], b[None], CAMERA)[0] for i, b in zip(IMAGES, BOXES, strict=True)]
    threads(3)
    together = Registrar(bank)(IMAGES, BOXES, CAMERA)
    registrar = Registrar(bank)
    later = [registrar([IMAGES[k]], BOXES[k : k + 1], CAMERA)[0] for k in (1, 0)][::-1]
    with one_torch_thread():
        command = [
            Registrar(bank)([i], b[None], CAMERA)[0] for i, b in zip(IMAGES, BOXES, strict=True)
        ]
    for one, *others in zip(alone, together, later, command, strict=True):
        for other in others:
            assert all(map(torch.equal, numbers(one), numbers(other)))


def test_detection_is_bit_identical_in_any_company(
    bank: ViewBank, threads: Callable[[int], None]
) -> None:
    threads(1)
    alone = Registrar(bank)(IMAGES[1:])[0]
    threads(2)
    together = Registrar(bank)(IMAGES)[1]
    assert torch.equal(alone.detection.boxes, together.detection.boxes)
    assert torch.equal(alone.rotation, together.rotation)
    assert alone.confidence == together.confidence
