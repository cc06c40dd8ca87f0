"""The appearance term: exhaustive in small banks, on the best distinct views of large banks."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from torch.testing import assert_close

from curvireg_torch import Pipeline, Registrar, ViewBank, ViewMatcher, rotation_error, sample_views
from curvireg_torch.features.backbone import Backbone, describe, similarity
from curvireg_torch.matching import distinct_views
from curvireg_torch.mesh.mesh import as_mesh
from curvireg_torch.terms import Appearance
from tests._support import bank_of, scene

VIEWS = sample_views(azimuth_step=30, elevations=[0, 30])  # those of `small_bank`
PIPELINE = Pipeline(field="focus", box_jitter=0.0, bank=replace(Pipeline().bank, image_size=64))


def large(**options):
    """A pipeline for which every bank is a large one."""
    return PIPELINE.with_term("appearance", exhaustive_limit=0, **options)


@pytest.fixture(scope="module")
def matcher(small_bank):
    return ViewMatcher(small_bank, pipeline=PIPELINE)


def photograph(seed):
    image, box, _ = scene(seed)
    return [image], box[None]


def test_small_bank_stores_features_of_all_views(small_bank, matcher, tmp_path):
    pictures = matcher.describer.shaded(small_bank.rotations, small_bank.distances)
    assert pictures.shape == (len(small_bank), 1, 64, 64)
    expected = describe(pictures, Backbone())
    assert_close(small_bank.appearance, expected, atol=2e-3, rtol=0)
    query = matcher.query(*photograph(0))
    ranking = matcher.rank(query)
    raw = similarity(describe(query.crops, Backbone()), expected)
    assert_close(ranking.terms["appearance"], raw, atol=2e-3, rtol=0)
    small_bank.save(tmp_path / "bank.safetensors")
    loaded = ViewMatcher(ViewBank.load(tmp_path / "bank.safetensors"), pipeline=PIPELINE)(
        *photograph(0)
    )
    assert_close(loaded.scores, ranking.scores, atol=1e-3, rtol=1e-2)


def test_large_bank_compares_the_cells_of_the_best_views(small_bank, truck, matcher):
    large_bank = bank_of(truck, VIEWS, pipeline=large())
    before = ViewMatcher(small_bank, pipeline=replace(PIPELINE, terms=PIPELINE.terms[:3]))(
        *photograph(2)
    )
    assert large_bank.appearance is None
    reranking = ViewMatcher(large_bank, pipeline=large(top=5, min_angle=40.0))
    ranking = reranking(*photograph(2))
    R = large_bank.rotations
    packing = distinct_views(torch.arange(len(R)), R, count=len(R), angle=40.0)
    assert 5 < len(packing) < len(R)
    nearest = packing[rotation_error(R[:, None], R[packing][None]).argmin(dim=1)]
    compared = torch.tensor(list(dict.fromkeys(nearest[before.order[0]].tolist()))[:5])
    raw = ranking.terms["appearance"][0]
    assert sorted(raw.isfinite().nonzero()[:, 0].tolist()) == sorted(compared.tolist())
    exhaustive = matcher(*photograph(2)).terms["appearance"][0]
    assert_close(raw[compared], exhaustive[compared], atol=3e-3, rtol=0)
    # Every other view has the score of the nearest compared view.
    score = Appearance().log_score(raw[compared][None])[0]
    angles = rotation_error(large_bank.rotations[:, None], large_bank.rotations[compared][None])
    first, second = angles.sort(dim=1).values[:, :2].T
    unique = second - first > 1.0
    assert unique.sum() > 10
    expected = before.scores[0] * torch.exp(2.0 * score[angles.argmin(dim=1)])
    assert_close(ranking.scores[0, unique], expected[unique], rtol=1e-4, atol=1e-7)
    assert torch.equal(reranking(*photograph(2)).scores, ranking.scores), "cached features"


@pytest.fixture(scope="module")
def painted_bank():
    """A box with a red front and a blue back: rotated by 180 degrees, only its colours differ."""
    box = trimesh.creation.box((0.6, 0.6, 1.0)).subdivide().subdivide()
    colours = np.full((len(box.faces), 4), 255, np.uint8)
    colours[box.triangles_center[:, 1] < -0.29] = [220, 30, 30, 255]
    colours[box.triangles_center[:, 1] > 0.29] = [30, 30, 220, 255]
    box.visual.face_colors = colours
    return bank_of(as_mesh(box), VIEWS, pipeline=PIPELINE)


@pytest.mark.parametrize("exhaustive_limit", [1000, 0])
def test_colours_distinguish_front_and_back(painted_bank, tmp_path, exhaustive_limit):
    pipeline = replace(
        PIPELINE.with_term("appearance", exhaustive_limit=exhaustive_limit), hypotheses=2
    )
    painted_bank.save(tmp_path / "bank.safetensors")
    bank = ViewBank.load(tmp_path / "bank.safetensors")  # with the mesh's colours
    if exhaustive_limit == 0:
        bank.appearance = None
    views = [
        v
        for v in range(len(VIEWS))
        if float(VIEWS.elevation[v]) == 30 and float(VIEWS.azimuth[v]) in (0, 180)
    ]
    describer = ViewMatcher(bank, pipeline=pipeline).describer
    pictures = describer.shaded(bank.rotations[views], bank.distances[views])
    assert pictures.shape == (2, 4, 64, 64)
    registrar = Registrar(bank, pipeline=replace(pipeline, contours=False))
    for view, picture in zip(views, pictures, strict=True):
        best = registrar([picture[1:]], [[4.0, 4, 59, 59]])[0]
        assert rotation_error(best.rotation, bank.rotations[view].double()) < 20
        assert best.hypotheses[0].view != best.hypotheses[1].view
