"""The appearance term among the others: over whole small banks, over the best distinct views of large ones."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from curvireg_torch import Pipeline, Registrar, ViewBank, ViewMatcher, rotation_error, sample_views
from curvireg_torch.io.meshes.mesh import as_mesh
from curvireg_torch.matching import distinct_views
from curvireg_torch.matching import matcher as matcher_module
from curvireg_torch.models.appearance import describe, similarity
from curvireg_torch.models.backbone import Backbone
from curvireg_torch.synthetic import example_mesh
from curvireg_torch.terms import Appearance
from tests._support.scenes import CAMERA, scene

VIEWS = sample_views(azimuth_step=30, elevations=[0, 30])
PIPELINE = replace(Pipeline(field="focus", box_jitter=0.0), bank=replace(Pipeline().bank, image_size=64))


@pytest.fixture(scope="module")
def bank() -> ViewBank:
    return ViewBank.build(example_mesh(), VIEWS, pipeline=PIPELINE, progress=False)


def late(**options) -> Pipeline:
    return PIPELINE.with_term("appearance", exhaustive_limit=0, **options)


def test_a_small_bank_describes_all_its_views(bank, tmp_path):
    matcher = ViewMatcher(bank)
    pictures = matcher._shaded(torch.arange(len(bank)))
    assert pictures.shape == (len(bank), 1, 64, 64)
    expected = describe(pictures, Backbone())
    torch.testing.assert_close(bank.reranking_features["appearance"], expected, atol=2e-3, rtol=0)
    image, box, _ = scene(0)
    query = matcher.query([image], box[None])
    ranking = matcher.rank(query)
    raw = similarity(describe(query.crops, Backbone())[:, None], expected)
    torch.testing.assert_close(ranking.terms["appearance"], raw, atol=2e-3, rtol=0)
    bank.save(tmp_path / "bank.safetensors")
    loaded = ViewMatcher(ViewBank.load(tmp_path / "bank.safetensors"))([image], box[None])
    torch.testing.assert_close(loaded.scores, ranking.scores, atol=1e-3, rtol=1e-2)


def test_its_weight_multiplies_a_score_that_is_1_for_the_best(bank):
    image, box, _ = scene(1)
    plain = ViewMatcher(bank, pipeline=PIPELINE.with_term("appearance", weight=0))([image], box[None])
    weighed = ViewMatcher(bank, pipeline=PIPELINE.with_term("appearance", weight=3))([image], box[None])
    raw = weighed.terms["appearance"]
    factor = torch.exp(3 * (raw - raw.max()) / raw.std(correction=0))
    torch.testing.assert_close(weighed.scores, plain.scores * factor, rtol=1e-3, atol=1e-6)


def test_a_large_bank_is_asked_for_its_best_distinct_views(bank):
    image, box, _ = scene(2)
    before = ViewMatcher(bank, pipeline=replace(PIPELINE, terms=PIPELINE.terms[:3]))([image], box[None])
    large = ViewBank.build(example_mesh(), VIEWS, pipeline=late(), progress=False)
    assert large.reranking_features == {}
    matcher = ViewMatcher(large, pipeline=late(top=5, min_angle=40.0))
    ranking = matcher([image], box[None])
    chosen = distinct_views(before.order[0], bank.rotations, count=5, angle=40.0)
    raw = ranking.terms["appearance"][0]
    assert sorted(raw.isfinite().nonzero()[:, 0].tolist()) == sorted(chosen.tolist())
    whole = ViewMatcher(bank)([image], box[None]).terms["appearance"][0]
    torch.testing.assert_close(raw[chosen], whole[chosen], atol=3e-3, rtol=0)
    # Every other view has the score of the chosen one nearest to it.
    score = Appearance().log_score(raw[chosen][None])[0]
    away = rotation_error(bank.rotations[:, None], bank.rotations[chosen][None])
    first, second = away.sort(dim=1).values[:, :2].T
    clear = second - first > 1.0
    assert int(clear.sum()) > 10
    expected = before.scores[0] * torch.exp(2.0 * score[away.argmin(dim=1)])
    torch.testing.assert_close(ranking.scores[0, clear], expected[clear], rtol=1e-4, atol=1e-7)
    again = matcher([image], box[None])
    assert torch.equal(again.scores, ranking.scores), "features that were kept"


def test_a_picture_of_a_view_looks_most_like_that_view(bank):
    matcher = ViewMatcher(bank)
    for view in (0, 9, 20):
        query = matcher.features(matcher._shaded(torch.tensor([view])))
        assert int(matcher.rank(query).terms["appearance"].argmax()) == view


def test_poses_are_judged_on_the_scale_of_the_views(bank):
    """The pose of a view is worth what the view is worth."""
    image, box, _ = scene(0)
    matcher = ViewMatcher(bank)
    query = matcher.query([image], box[None])
    ranking = matcher.rank(query)
    views = torch.tensor([3, 11, 3])
    scores = matcher.reranking_score(
        "appearance", query, ranking, matcher._shaded(views), torch.zeros(3, dtype=torch.long)
    )
    raw = ranking.terms["appearance"].double()
    expected = Appearance().log_score(raw)[0, views]
    torch.testing.assert_close(scores, expected, atol=0.1, rtol=0.1)
    assert float(scores[0]) == float(scores[2])


def test_hypotheses_tell_how_they_look():
    image, box, T = scene(0)
    bank = ViewBank.build(example_mesh(), VIEWS, pipeline=PIPELINE, progress=False)
    result = Registrar(bank)([image], box[None], CAMERA)[0]
    assert float(rotation_error(result.rotation, T[:3, :3])) < 5
    appearance_scores = [h.evidence["appearance"] for h in result.hypotheses]
    assert appearance_scores[0] == max(appearance_scores)
    assert appearance_scores[0] != 0


def painted() -> trimesh.Trimesh:
    """A box whose front is red and whose back is blue: turned by 180 degrees, only its colours differ."""
    box = trimesh.creation.box((0.6, 0.6, 1.0)).subdivide().subdivide()
    colours = np.full((len(box.faces), 4), 255, np.uint8)
    colours[box.triangles_center[:, 1] < -0.29] = [220, 30, 30, 255]
    colours[box.triangles_center[:, 1] > 0.29] = [30, 30, 220, 255]
    box.visual.face_colors = colours
    return as_mesh(box)


@pytest.mark.parametrize("coarse", [1000, 0])
def test_colours_tell_the_front_from_the_back(tmp_path, coarse):
    mesh, pipeline = painted(), PIPELINE.with_term("appearance", exhaustive_limit=coarse)
    bank = ViewBank.build(mesh, VIEWS, pipeline=pipeline, progress=False)
    bank.save(tmp_path / "bank.safetensors")
    bank = ViewBank.load(tmp_path / "bank.safetensors")  # the colours travel with the mesh
    describe = ViewMatcher(bank, pipeline=pipeline).describers[0]
    views = [v for v in range(len(VIEWS)) if float(VIEWS.elevation[v]) == 30 and float(VIEWS.azimuth[v]) in (0, 180)]
    pictures = describe.shaded(bank.rotations[views], bank.distances[views])
    assert pictures.shape == (2, 4, 64, 64)
    box = torch.tensor([[4.0, 4, 59, 59]])
    for view, picture in zip(views, pictures, strict=True):
        registrar = Registrar(bank, pipeline=replace(pipeline, search=False, contours=False, hypotheses=2))
        best = registrar([picture[1:]], box)[0]
        assert rotation_error(best.rotation, bank.rotations[view].double()) < 20
        assert best.hypotheses[0].view != best.hypotheses[1].view


def test_a_bank_of_coloured_and_grey_meshes_is_one_bank():
    meshes = painted(), example_mesh()
    banks = [ViewBank.build(m, VIEWS, pipeline=PIPELINE, progress=False) for m in meshes]
    both = ViewBank.join(banks)
    coloured, grey = both.reranking_features["appearance"].split(len(VIEWS))
    assert torch.equal(coloured, banks[0].reranking_features["appearance"])
    assert torch.equal(grey, banks[1].reranking_features["appearance"].repeat(1, 2))
    image, box, _ = scene(1)
    alone = ViewMatcher(banks[1])([image], box[None]).terms["appearance"]
    joined = ViewMatcher(both)([image], box[None]).terms["appearance"][:, len(VIEWS) :]
    torch.testing.assert_close(joined, alone, atol=1e-5, rtol=0)


def test_features_that_are_made_anew_when_too_many_were_kept_are_the_same(monkeypatch):
    """A photograph that asks for views of which some were kept, and for more than may be kept, is ranked as by a
    matcher that kept none."""
    large = ViewBank.build(example_mesh(), VIEWS, pipeline=late(), progress=False)
    pipeline = late(top=6, min_angle=20.0)
    queries = [ViewMatcher(large, pipeline=pipeline).query([scene(k)[0]], scene(k)[1][None]) for k in range(3)]
    fresh = [ViewMatcher(large, pipeline=pipeline).rank(query).scores for query in queries]
    monkeypatch.setattr(matcher_module, "CACHED", 8)
    matcher, asked = ViewMatcher(large, pipeline=pipeline), []
    for query, expected in zip(queries, fresh, strict=True):
        known = set(matcher._feature_cache.get("appearance", {}))
        ranking = matcher.rank(query)
        wanted = set(ranking.terms["appearance"][0].isfinite().nonzero()[:, 0].tolist())
        asked.append(bool(known & wanted) and len(known | wanted) > 8)
        torch.testing.assert_close(ranking.scores, expected, rtol=1e-4, atol=1e-7)
        assert len(matcher._feature_cache["appearance"]) <= 8
    assert any(asked), "views kept and wanted again, and too many in all"
