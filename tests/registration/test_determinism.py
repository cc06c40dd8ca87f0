"""A result does not depend on its batch, on what was registered before or, on a CPU, on the number
of threads."""

from dataclasses import replace

import pytest
import torch

from curvireg_torch import Pipeline, Registrar
from curvireg_torch.synthetic import example_mesh
from tests._support import (
    CAMERA,
    answer_to,
    bank_around,
    check_agreement,
    first_scenes,
    seeded,
    skip_unless_products_are_exact,
)

IMAGES, BOXES, _ = first_scenes(2)


@pytest.fixture(scope="module")
def bank():
    """The default pipeline; the appearance of views is described on demand, as in large banks."""
    pipeline = Pipeline().with_term("appearance", exhaustive_limit=10, top=8)
    detection = replace(pipeline.detection, views=12, proposals=4)
    pipeline = replace(pipeline, hypotheses=2, detection=detection)
    return bank_around(example_mesh(), 30, [0, 30, 60], pipeline=pipeline, image_size=64)


def test_runs_of_the_same_call_are_bit_identical(bank):
    """What was registered before does not matter."""
    first = answer_to(0, Registrar(bank))
    registrar = Registrar(bank)
    answer_to(1, registrar)
    again = answer_to(0, registrar)
    assert again.to_dict() == first.to_dict()
    assert again.ranking.scores.equal(first.ranking.scores)


def test_a_photograph_alone_agrees_with_that_of_a_batch(bank, threads):
    threads(1)
    alone = answer_to(1, Registrar(bank))
    threads(3)
    check_agreement(alone, Registrar(bank)(IMAGES, BOXES, CAMERA)[1])


def test_where_rounding_decides_neither_the_batch_nor_the_threads_do(bank, threads):
    """In noise, fits that differ in the last bit end degrees apart."""
    skip_unless_products_are_exact()
    images = torch.rand(2, 3, 100, 120, generator=seeded(0)).unbind()
    boxes = torch.tensor([[20.0, 10, 90, 80], [30, 20, 100, 90]])
    registrar = Registrar(bank)
    threads(1)
    (alone,) = registrar(images[:1], boxes[:1], CAMERA)
    threads(3)
    together = registrar(images, boxes, CAMERA)[0]
    assert alone.edge_support > 0
    assert together.T_cam_from_model.equal(alone.T_cam_from_model)
    assert together.confidence == pytest.approx(alone.confidence, abs=1e-6)


@pytest.mark.slow
def test_a_detection_alone_agrees_with_that_of_a_batch(bank, threads):
    threads(1)
    alone = Registrar(bank)(IMAGES[1:])[0]
    threads(2)
    together = Registrar(bank)(IMAGES)[1]
    boxes = alone.detection.boxes, together.detection.boxes
    torch.testing.assert_close(*boxes, rtol=0.0, atol=1e-3)  # px
    check_agreement(alone, together)
