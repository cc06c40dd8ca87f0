import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
import torch.nn.functional as F
from scipy.ndimage import distance_transform_edt
from torch.testing import assert_close

from curvireg_torch import ViewMatcher, terms
from curvireg_torch.features import LearnedCurvilinearSaliency
from curvireg_torch.features.whitening import ledoit_wolf
from tests._support import refused, scene, seeded
from tests._support.tables import text_table


def test_correlation_is_the_cosine_of_the_better_crop_scored_by_standard_deviations():
    queries = torch.tensor([[3.0, 4.0], [1.0, 0.0]])
    views = torch.tensor([[4.0, 3.0], [0.0, 2.0], [5.0, 12.0]])
    expected = torch.tensor([[24 / 25, 4 / 5, 63 / 65], [4 / 5, 0.0, 5 / 13]])
    module = terms.Correlation().build(SimpleNamespace(descriptors=views))
    assert_close(module(SimpleNamespace(descriptors=queries[:, None])), expected)
    together = module(SimpleNamespace(descriptors=queries[None]))
    assert_close(together, expected.amax(dim=0, keepdim=True))
    score = terms.Correlation().log_score(
        torch.tensor([[0.0, 0.0, 0.0, 1.0], [3.0, 3.0, 3.0, 5.0], [2.0] * 4])
    )
    low = -4.0 / math.sqrt(3.0)  # the standard deviation of 0, 0, 0, 1 is sqrt(3) / 4
    assert_close(score, torch.tensor([[low, low, low, 0.0]] * 2 + [[0.0] * 4]))


def ranked(bank, whitening):
    """A matcher, a photograph that it has described, and its ranking."""
    image, box, _ = scene(0)
    pipeline = replace(bank.pipeline.with_term("hog", whitening=whitening), box_jitter=0.0)
    matcher = ViewMatcher(bank, pipeline=pipeline)
    query = matcher.query([image], box[None])
    return matcher, query, matcher.rank(query)


def test_matcher_ranks_by_whitened_correlation(bank):
    _, query, ranking = ranked(bank, "bank")
    mean, covariance = ledoit_wolf(bank.descriptors)
    factor = torch.linalg.cholesky(covariance.double())
    both = query.descriptors[:, 0], bank.descriptors
    a, b = (torch.linalg.solve(factor, (x - mean).double().T).T for x in both)
    expected = F.cosine_similarity(a[:, None], b[None], dim=2).float()
    assert_close(ranking.hog, expected, atol=1e-4, rtol=1e-3)


def test_matcher_ranks_by_the_product_that_the_paper_prints(bank):
    matcher, query, ranking = ranked(bank, "paper")
    mean, covariance = ledoit_wolf(bank.descriptors)
    solved = torch.linalg.solve(covariance.double(), query.descriptors[0].T.double())
    expected = ((bank.descriptors - mean).double() @ solved).T.float()
    assert_close(ranking.hog, expected, atol=2e-3 * float(expected.abs().max()), rtol=0)
    # Further views are compared by the bank's mean and covariance.
    few = bank.views[10:14]
    score = terms.Correlation(whitening="paper").log_score(expected[:, 10:14])
    for term in matcher.pipeline.terms:
        if term.name in ("repeatability", "box"):
            score = score + term.log_score(ranking.terms[term.name][:, 10:14])
    score = score[0]
    difference = matcher.compare_views(query, few) - (score - score.max())
    assert_close(difference - difference.mean(), torch.zeros(4), rtol=0, atol=0.05)


@pytest.mark.parametrize("eps", [0.0, 1.0, 2.0, 2.5, 2.9, 3.0, 4.0])
def test_dilate_points_uses_a_euclidean_disc(eps):
    points = torch.rand(3, 31, 40, generator=seeded(0)) < 0.02
    points[0] = False
    dilated = terms.dilate_points(points, eps)
    assert not dilated[0].any()
    assert terms.dilate_points(points[:, :, :0], eps).shape == (3, 31, 0)
    for plane, expected in zip(dilated[1:], points[1:], strict=True):
        assert (plane.numpy() == (distance_transform_edt(~expected.numpy()) <= eps)).all()


def test_repeatability_score_has_the_closed_form():
    rep = torch.tensor([[0.2, 0.5, 0.8]])
    # favours average views
    assert int(terms.Repeatability(mode="paper").log_score(rep).argmax()) == 1
    for sigma in (0.1, 0.2):
        expected = [-(d**2) / (2 * sigma**2) for d in (0.6, 0.3, 0.0)]
        assert_close(terms.Repeatability(sigma=sigma).log_score(rep)[0], torch.tensor(expected))
    with refused("mode"):
        terms.Repeatability(mode="other")


def test_repeatability_is_the_fraction_of_points_with_one_of_the_view_near_them():
    """In cells of 2 px, the last ones of which are cut."""
    S = 131
    views = torch.zeros(3, S, S, dtype=torch.bool)
    queries = torch.zeros(1, 2, S, S, dtype=torch.bool)
    queries[0, 0, [20, 60, 130], [20, 60, 130]] = True  # the second crop has no points
    views[0, [20, 60, 130], [20, 60, 130]] = True
    views[1, [20, 60], [20, 90]] = True
    facts = {
        "settings": SimpleNamespace(image_size=S),
        "descriptors": views,
        "points_at": lambda _, i: views[i],
    }
    known = type("Views", (), {"__len__": lambda _: len(views), **facts})()
    compare = terms.Repeatability(eps=2.0 / S).build(known)
    assert_close(compare(SimpleNamespace(points=queries)), torch.tensor([[1.0, 1 / 3, 0.0]]))
    assert compare(SimpleNamespace(points=queries[:0])).shape == (0, 3)


def box_score(shapes, boxes, **options):
    return terms.BoxShape(**options).build(SimpleNamespace(boxes=boxes))(
        SimpleNamespace(shapes=shapes)
    )


def test_box_shape_score_is_a_gaussian_of_the_log_aspect_ratio():
    boxes = torch.tensor([[0.0, 0, 20, 10], [0, 0, 10, 10], [0, 0, 10, 20]]) + 3.0
    expected = [math.exp(-((k * math.log(2)) ** 2) / (2 * 0.5**2)) for k in (0, 1, 2)]
    assert box_score(terms.box_shapes(boxes[:1]), boxes, sigma=0.5)[0].tolist() == pytest.approx(
        expected, rel=1e-5
    )
    assert box_score(torch.tensor([-9.0]), boxes)[0, 2] == 1.0


BOXES = """
[10, 10, 60, 40]    | true
[-0.5, 10, 60, 40]  | false
[10, 10, 98.8, 40]  | false
[10, 0, 60, 40]     | false
[10, 10, 60, 99]    | false
[-9, -9, 200, 200]  | false
[1.4, 20, 81.4, 60] | true
[1.2, 20, 81.2, 60] | false
"""


@pytest.mark.parametrize(("box", "whole"), text_table(BOXES))
def test_the_shape_of_a_box_at_the_border_says_nothing(box, whole):
    """The border is 1 px and 1/100 of the longer side, 80 px: 1.8 px."""
    shape = terms.whole_box_shapes(torch.tensor([box], dtype=torch.float32), [(80, 100)])
    assert bool(shape.isfinite()) == whole
    score = box_score(shape, torch.tensor([[0.0, 0, 1, 1], [0, 0, 1, 9]]))
    assert bool((score == 1).all()) != whole


def test_jittered_fields_are_those_of_shifted_and_scaled_boxes():
    x, y = torch.meshgrid(torch.arange(160.0), torch.arange(120.0), indexing="xy")
    picture = 0.5 + 0.2 * torch.stack([(0.06 * x).sin() + (0.05 * y).cos(), (0.04 * (x + y)).sin()])
    picture = torch.cat([picture, picture[:1]])
    x0, y0, x1, y1 = box = (40.0, 30, 100, 70)
    half = 0.5 * torch.tensor([x1 - x0, y1 - y0])
    middle = torch.tensor([x0, y0]) + half
    # 3/4 of 0.2 of the longer side, 60 px, is 9 px
    copies = [((0, 0), 1.0), ((-9, 0), 1.0), ((9, 0), 1.0), ((0, -9), 1.0), ((0, 9), 1.0)]
    copies += [((0, 0), 1 / 1.2), ((0, 0), 1.2)]
    boxes = torch.stack(
        [
            torch.cat([middle + torch.tensor(shift) + sign * scale * half for sign in (-1, 1)])
            for shift, scale in copies
        ]
    )
    size = {"size": 64, "margin": 0.1}
    direct = terms.crop_photographs([picture] * 7, boxes, **size)[:, :2]
    field = terms.crop_photographs([picture], torch.tensor([box]), **size)[:, :2]
    jittered = terms.jittered_fields(field, 0.2, 0.1)
    assert jittered.shape == (1, 7, 2, 64, 64)
    assert jittered[:, 0].equal(field)
    inner = (..., slice(12, 52), slice(12, 52))
    assert_close(jittered[0][inner], direct[inner], atol=0.01, rtol=0)
    assert jittered[0, 2, :, :, -1].eq(0).all()  # beyond the crop
    both = terms.jittered_fields(torch.cat([field, 2 * field]), 0.2, 0.1)
    assert_close(both[1], 2 * both[0])
    assert terms.jittered_fields(field, 0.0, 0.1).equal(field[:, None])
    with refused("box_jitter"):
        terms.jittered_fields(field, 0.5, 0.1)


def test_a_field_that_changes_the_learned_one_is_used():
    class Doubled(LearnedCurvilinearSaliency):
        def forward(self, image):
            return 2.0 * super().forward(image)

    crops = torch.rand(2, 3, 64, 64, generator=seeded(0))
    (once, mask), (twice, same) = (
        terms.photograph_field(f(), crops) for f in (LearnedCurvilinearSaliency, Doubled)
    )
    assert torch.equal(twice, 2.0 * once)
    assert torch.equal(mask, same)


@pytest.mark.parametrize("cell", [1, 2, 15, 16, 22])
def test_full_cells_have_as_many_pixels_as_they_are_large(cell):
    points = torch.ones(1, 3 * cell + 1, 3 * cell + 1, dtype=torch.bool)
    counts = terms.cell_counts(points, cell)[0]
    assert set(counts[:3, :3].flatten().tolist()) == {cell**2}
