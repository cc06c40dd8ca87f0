"""An answer does not depend on what is registered beside it, before it, or on how many threads."""

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch

from curvireg_torch import Pipeline, Registrar, ViewBank, sample_views
from curvireg_torch.registration import Registration
from curvireg_torch.synthetic import example_mesh
from tests._support.scenes import CAMERA, scene

SEEDS = (0, 1)


@pytest.fixture(autouse=True)
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def bank() -> ViewBank:
    """The default pipeline; the appearance of views is described when a photograph asks for it, as in large banks."""
    views = sample_views(azimuth_step=30, elevations=[0, 30, 60])
    pipeline = Pipeline().with_term("appearance", exhaustive_limit=10, top=8)
    pipeline = replace(pipeline, hypotheses=2, locate=replace(pipeline.locate, views=12, proposals=4, candidates=2))
    return ViewBank.build(example_mesh(), views, pipeline=pipeline, progress=False)


def numbers(result: Registration) -> list[torch.Tensor]:
    """Everything that a result says, as tensors."""
    poses = [t for h in result.hypotheses for t in (h.rotation, h.translation, torch.tensor(list(h.evidence.values())))]
    known = torch.tensor([result.confidence, result.score, result.edge_support], dtype=torch.float64)
    features = torch.tensor(list(result.confidence_features.values()), dtype=torch.float64)
    return [*poses, known, features, result.ranking.scores, result.ranking.order]


def test_alone_in_a_batch_and_on_any_number_of_threads_to_the_bit(bank: ViewBank) -> None:
    images, boxes = [scene(s)[0] for s in SEEDS], torch.stack([scene(s)[1] for s in SEEDS])
    torch.set_num_threads(1)
    alone = [Registrar(bank)([i], b[None], CAMERA)[0] for i, b in zip(images, boxes, strict=True)]
    torch.set_num_threads(3)
    together = Registrar(bank)(images, boxes, CAMERA)
    registrar = Registrar(bank)
    later = [registrar([images[k]], boxes[k : k + 1], CAMERA)[0] for k in reversed(range(len(images)))][::-1]
    for one, other, last in zip(alone, together, later, strict=True):
        for expected, *got in zip(numbers(one), numbers(other), numbers(last), strict=True):
            assert all(torch.equal(expected, x) for x in got)


def test_looked_for_alone_or_beside_others_to_the_bit(bank: ViewBank) -> None:
    images = [scene(s)[0] for s in SEEDS[:2]]
    torch.set_num_threads(1)
    alone = Registrar(bank)(images[1:])[0]
    torch.set_num_threads(2)
    together = Registrar(bank)(images)[1]
    assert torch.equal(alone.localization.boxes, together.localization.boxes)
    assert torch.equal(alone.rotation, together.rotation)
    assert alone.confidence == together.confidence
