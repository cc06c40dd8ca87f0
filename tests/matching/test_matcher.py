import math
from copy import copy
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch
from torch.testing import assert_close

from curvireg_torch import ViewMatcher
from curvireg_torch.geometry import rotation_error, rotation_from_axis_angle, sample_views
from curvireg_torch.matching import distinct_views
from curvireg_torch.rendering import make_renderer
from curvireg_torch.terms import Appearance, Correlation, Repeatability
from tests._support import double, eye, refused, scene


@pytest.fixture(scope="module")
def matcher(bank):
    return ViewMatcher(bank)


def batch(*seeds):
    return torch.stack([scene(s)[0] for s in seeds]), torch.stack([scene(s)[1] for s in seeds])


def test_views_of_the_bank_match_themselves(bank):
    views = [0, 7, 60]
    query = SimpleNamespace(
        descriptors=bank.descriptors[views, None], points=bank.points_at(views)[:, None]
    )
    assert Correlation().build(bank)(query).argmax(dim=1).tolist() == views
    similarity = Repeatability().build(bank)(query)[:, views].diag()
    assert_close(similarity, torch.ones(3), rtol=0, atol=0.05)


def test_ranking_is_sorted_bounded_and_a_product(bank, matcher):
    ranking = matcher(*batch(0, 1))
    assert ranking.scores.shape == ranking.order.shape == (2, len(bank))
    sorted_scores = ranking.scores.gather(1, ranking.order)
    assert (sorted_scores[:, :-1] >= sorted_scores[:, 1:]).all()
    for scores in (ranking.scores, ranking.hog, ranking.repeatability, ranking.terms["box"]):
        assert scores.min() >= 0
        assert scores.max() <= 1 + 1e-6
    product = Correlation().log_score(ranking.hog).exp() * ranking.terms["box"]
    product = product * Repeatability().log_score(ranking.repeatability).exp()
    assert_close(ranking.scores, product)
    assert ranking.top(3).equal(ranking.order[:, :3])
    tied = matcher(torch.full((1, 1, 64, 64), 0.5), torch.tensor([[0.0, 0, 50, 50]]))
    assert tied.order[0].tolist() == list(range(len(bank)))


def test_matcher_is_batch_independent_and_takes_bytes_and_mixed_channels(matcher):
    images, boxes = batch(0, 1, 2)
    together = matcher(images, boxes)
    assert torch.equal(matcher(list(images), boxes).scores, together.scores)
    for i in range(3):
        alone = matcher(images[[i]], boxes[[i]])
        assert_close(alone.scores[0], together.scores[i], rtol=1e-4, atol=1e-5)
        assert_close(alone.hog[0], together.hog[i], rtol=1e-5, atol=1e-5)
    pixels = (images * 255).round().to(torch.uint8)
    exact = matcher(pixels / 255, boxes).scores
    assert_close(matcher(pixels, boxes).scores, exact)
    grey = images[1].mean(dim=0, keepdim=True)
    mixed = matcher([pixels[0], grey], boxes[:2]).scores
    assert_close(mixed[0], exact[0], rtol=1e-4, atol=1e-5)
    assert_close(mixed[1:], matcher([grey], boxes[[1]]).scores, rtol=1e-4, atol=1e-5)


def test_matcher_refuses_unusable_input(matcher):
    image = torch.rand(1, 3, 64, 64)
    box = torch.tensor([[5.0, 5, 50, 50]])
    for images, boxes, message in (
        (image, torch.tensor([[5.0, 5, 5, 50]]), "X0 < X1"),
        (image, box.repeat(3, 1), r"shape \(1, 4\), one for each image, got \(3, 4\)"),
        (image.short(), box, "uint8, or floating"),
    ):
        with refused(message):
            matcher(images, boxes)


@pytest.mark.parametrize("channels", [3, 1])
def test_matcher_passes_colours_to_colour_fields(bank, channels):
    class Field(torch.nn.Module):
        colour = channels == 3

        def forward(self, image):
            assert image.shape[1] == channels
            return image[:, :1].expand(-1, 2, -1, -1)

    ViewMatcher(bank, field=Field())(*batch(0))


def test_matcher_weights_terms(bank):
    without = bank.pipeline.with_term("repeatability", weight=0).with_term("box", weight=0)
    wide = bank.pipeline.with_term("repeatability", sigma=1e6).with_term("box", sigma=1e6)
    alone = replace(bank.pipeline, terms=(Correlation(),))
    plain, squared, wide, alone = (
        ViewMatcher(bank, pipeline=pipeline)(*batch(0, 1))
        for pipeline in (without, without.with_term("hog", weight=2), wide, alone)
    )
    assert_close(plain.scores, Correlation().log_score(plain.hog).exp())
    assert set(plain.terms) == {"hog"}, "a term without weight is not computed"
    assert_close(squared.scores, plain.scores**2)
    assert_close(wide.scores, plain.scores, atol=1e-5, rtol=0)
    assert set(alone.terms) == {"hog"}


def test_distinct_views_applies_symmetries_to_the_model():
    R = rotation_from_axis_angle(double([0.9, -0.4, 0.7]))
    quarter = rotation_from_axis_angle(double([0.0, 0.0, math.pi / 2]))
    symmetries = torch.stack([eye(3), quarter, quarter @ quarter, quarter.T])
    views = torch.stack([R, R @ quarter, quarter @ R, R @ quarter.T])
    order = torch.arange(4)
    assert distinct_views(order, views, count=4).equal(order)
    for some, expected in ((order, [0, 2]), (order.flip(0), [3, 2])):
        assert distinct_views(some, views, count=4, symmetries=symmetries).tolist() == expected


def test_views_exactly_as_far_apart_as_the_angle_count_as_one():
    views = sample_views(azimuth_step=10, elevations=[0, 35])
    order = torch.arange(len(views)).roll(5)
    chosen = distinct_views(order, views.rotations, count=99, angle=20.0)
    rotations = views.rotations[chosen]
    apart = rotation_error(rotations[:, None], rotations).fill_diagonal_(180.0)
    assert len(chosen) > 12
    assert apart.min() > 20.01
    assert chosen[0] == order[0]
    for angle, count in ((9.99, len(views)), (360.0, 1)):
        assert len(distinct_views(order, views.rotations, count=99, angle=angle)) == count
    assert len(distinct_views(order, views.rotations.bfloat16(), count=9, angle=20.0)) == 9


def test_the_best_view_outside_the_limits_is_more_than_30_degrees_away(bank, matcher):
    """For each view that alone is allowed, against a loop over all others."""
    images, boxes = batch(0)
    query = matcher.query(images, boxes)
    scores = matcher.rank(query).scores[0]
    angles = rotation_error(bank.rotations[:, None].double(), bank.rotations.double())
    distances = []
    for view in range(len(bank)):
        allowed = torch.zeros(1, len(bank), dtype=torch.bool)
        allowed[0, view] = True
        ranking = matcher.rank(query, allowed)
        assert ranking.order[0, 0] == view
        outside = int(ranking.outside[0])
        far = angles[view] > 30.0 + 1e-3  # views of the bank are exactly 30 degrees apart
        assert scores[outside] == scores[far].max()
        distances.append(float(angles[view, outside]))
    assert min(distances) < 40.0


def test_appearance_is_compared_with_the_views_that_were_compared(small_bank):
    """Views without a raw score are no views of score 0."""
    matcher = ViewMatcher(small_bank)
    first = torch.tensor([0.20, 0.30])
    second = torch.tensor([0.10, 0.40])
    appearance = Mock(term=matcher._appearance.term)
    appearance.compare.return_value = torch.tensor([[0.35, 0.9, 0.25], [0.8, 0.45, 0.7]])
    matcher.__dict__["_modules"]["_appearance"] = appearance
    features = torch.zeros(3, 4)
    photograph = torch.tensor([0, 1, 0])
    poses = ((first, 0.35), (second, 0.45), (first, 0.25))
    for raw in (first, torch.tensor([torch.nan, 0.20, torch.nan, torch.nan, 0.30])):
        rankings = [SimpleNamespace(terms={Appearance.name: one[None]}) for one in (raw, second)]
        scores = matcher.appearance_scores(SimpleNamespace(), rankings, features, photograph)
        for score, (compared, mine) in zip(scores.tolist(), poses, strict=True):
            values = torch.cat([compared.double(), double([mine])])
            expected = (mine - float(compared.max())) / float(values.std(correction=0))
            assert score == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("allowed", [torch.ones(2, 1).bool(), torch.ones(1, 3)])
def test_views_that_are_allowed_are_flags_of_all_views(small_bank, allowed):
    matcher = ViewMatcher(small_bank)
    image, box, _ = scene(0)
    query = matcher.query([image], box[None])
    with refused("allowed: expected bool of shape"):
        matcher.rank(query, allowed)


def test_features_of_pictures_are_kept_by_the_name_of_their_renderer(small_bank, tmp_path):
    """What another renderer draws differs; a custom one has no name by which to find it again."""
    small_bank = copy(small_bank)
    small_bank.described_views_file = tmp_path / f"views-{'0' * 32}.safetensors"

    def known(renderer, value):
        """Features of view 0, which are ``value`` if they are described now."""
        matcher = ViewMatcher(small_bank, renderer=renderer)
        return matcher._described_views.features([0], lambda _: torch.tensor([[value]])).item()

    assert known(make_renderer(small_bank.mesh), 1.0) == 1.0
    assert not list(tmp_path.iterdir())
    for value, name in ((2.0, "auto"), (3.0, "embree")):
        assert known(name, value) == value
        assert known(name, 4.0) == value, "read from the file"
        assert known(make_renderer(small_bank.mesh), 5.0) == 5.0
    assert len(list(tmp_path.glob("views-*.safetensors"))) == 2


def test_flipped_photographs_are_described_as_they_look(bank, matcher):
    images, boxes = batch(0, 1)
    query = matcher.query(images, boxes)
    flipped, ranking = matcher.flipped(query)
    assert torch.equal(flipped.crops, query.crops.flip(-1))
    assert torch.equal(flipped.points, query.points.flip(-1))
    assert torch.equal(flipped.field[:, 0], -query.field[:, 0].flip(-1))
    assert torch.equal(flipped.field[:, 1], query.field[:, 1].flip(-1))
    again = matcher.descriptor(flipped.field)
    assert_close(flipped.descriptors[:, 0], again, rtol=0, atol=1e-4)
    known = bank.descriptors[5].expand_as(flipped.descriptors)
    likeness = torch.cosine_similarity(flipped.descriptors, known, dim=2)
    assert_close(ranking.hog[:, 5], likeness.amax(dim=1), rtol=0, atol=1e-5)


def test_described_photographs_are_split_with_what_terms_have_computed(matcher):
    query = matcher.query(*batch(0, 1))
    query.computed["of a term"] = torch.tensor([3.0, 4.0])
    assert [one.computed["of a term"].tolist() for one in query.split()] == [[3.0], [4.0]]
    assert torch.equal(query[torch.tensor([1])].points, query.points[1:])
