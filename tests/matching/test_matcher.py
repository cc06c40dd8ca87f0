from dataclasses import replace

import pytest
import torch

from curvireg_torch import ViewMatcher
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.terms import (
    Correlation,
    dilate_points,
    normalized_correlation,
    repeatability,
    repeatability_score,
    unit_score,
)
from tests._support.scenes import scene, truck_bank


@pytest.fixture(scope="module")
def matcher() -> ViewMatcher:
    return ViewMatcher(truck_bank())


def batch(*seeds: int) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.stack([scene(s)[0] for s in seeds]), torch.stack([scene(s)[1] for s in seeds])


def test_a_view_of_the_bank_finds_itself():
    """The depth field itself as the photograph's field: the identity of the whole matching step."""
    bank = truck_bank()
    for i in (0, 7, 60):
        similarity = normalized_correlation(bank.descriptors[i : i + 1], bank.descriptors)
        rep = repeatability(bank.points[i : i + 1], dilate_points(bank.points, 0.02 * bank.settings.image_size))
        assert int(similarity.argmax()) == i
        assert float(rep[0, i]) == 1.0


def test_ranking_is_ordered_bounded_and_a_product(matcher):
    ranking = matcher(*batch(0, 1))
    assert ranking.scores.shape == ranking.order.shape == (2, len(truck_bank()))
    sorted_scores = ranking.scores.gather(1, ranking.order)
    assert bool((sorted_scores[:, :-1] >= sorted_scores[:, 1:]).all())
    for part in (ranking.scores, ranking.hog, ranking.repeatability, ranking.box):
        assert float(part.min()) >= 0
        assert float(part.max()) <= 1 + 1e-6
    product = unit_score(ranking.hog) * repeatability_score(ranking.repeatability) * ranking.box
    torch.testing.assert_close(ranking.scores, product)
    assert ranking.top(3).equal(ranking.order[:, :3])


def test_batched_equals_one_by_one_and_any_chunk_size(matcher):
    images, boxes = batch(0, 1, 2)
    together = matcher(images, boxes)
    for chunked in (
        ViewMatcher(truck_bank(), chunk_size=2)(images, boxes),
        ViewMatcher(truck_bank())(list(images), boxes),
    ):
        torch.testing.assert_close(together.scores, chunked.scores, rtol=1e-4, atol=1e-5)
    for i in range(3):
        alone = matcher(images[i : i + 1], boxes[i : i + 1])
        torch.testing.assert_close(together.hog[i], alone.hog[0], rtol=1e-5, atol=1e-5)


def test_images_of_different_sizes_and_grey_images(matcher):
    image, box, _ = scene(0)
    ranking = matcher([image, image[:, 20:]], torch.stack([box, box - torch.tensor([0, 20.0, 0, 20.0])]))
    torch.testing.assert_close(ranking.hog[0], ranking.hog[1], atol=1e-3, rtol=0)
    grey = matcher(image.mean(dim=0, keepdim=True)[None], box[None])
    assert len(grey) == 1


def test_ties_keep_the_order_of_the_bank(matcher):
    ranking = matcher(torch.full((1, 1, 64, 64), 0.5), torch.tensor([[0.0, 0, 50, 50]]))
    assert ranking.order[0].tolist() == list(range(len(truck_bank())))


@pytest.mark.parametrize(
    ("boxes", "message"),
    [
        ([[5, 5, 5, 50]], "X0 < X1"),
        ([[500, 5, 600, 50]], "wholly outside"),
        ([[5, 5, float("nan"), 50]], "finite"),
        ([[5, 5, 50]], "shape"),
    ],
)
def test_unusable_boxes_are_named(matcher, boxes, message):
    with pytest.raises(InvalidInputError, match=message):
        matcher(torch.rand(1, 3, 64, 64), torch.tensor(boxes, dtype=torch.float32))


def test_wrong_channels_and_integer_images_are_named(matcher):
    box = torch.tensor([[5.0, 5, 50, 50]])
    with pytest.raises(InvalidInputError, match="channels"):
        matcher(torch.rand(1, 4, 64, 64), box)
    with pytest.raises(InvalidInputError, match="uint8, or floating"):
        matcher(torch.zeros(1, 3, 64, 64, dtype=torch.int16), box)


def test_bytes_and_mixed_channels_rank_as_floats_do(matcher):
    images, boxes = batch(0, 1)
    exact = (images * 255).round() / 255
    pixels = (images * 255).round().to(torch.uint8)
    torch.testing.assert_close(matcher(pixels, boxes).scores, matcher(exact, boxes).scores)
    grey = exact[1].mean(dim=0, keepdim=True)
    mixed = matcher([pixels[0], grey], boxes)
    torch.testing.assert_close(mixed.scores[0], matcher(exact[:1], boxes[:1]).scores[0], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(mixed.scores[1], matcher([grey], boxes[1:]).scores[0], rtol=1e-4, atol=1e-5)


def test_counts_that_differ_are_refused_and_none_is_no_error(matcher):
    images, boxes = batch(0, 1)
    with pytest.raises(InvalidInputError, match=r"shape \(2, 4\), one for each image, got \(3, 4\)"):
        matcher(images, boxes[[0, 1, 1]])
    none = matcher([], torch.zeros(0, 4))
    assert none.scores.shape == none.order.shape == none.hog.shape == (0, len(truck_bank()))


def test_a_ranking_of_one_photograph_does_not_hold_on_to_the_batch(matcher):
    ranking = matcher(*batch(0, 1, 2))[1:2]
    for part in (ranking.scores, ranking.order, *ranking.terms.values()):
        assert part.untyped_storage().nbytes() == part.numel() * part.element_size()


@pytest.mark.parametrize("eps", [0.0, 1.0, 2.5, 4.0])
def test_dilation_is_a_euclidean_disc(eps):
    from scipy.ndimage import distance_transform_edt

    points = torch.rand(3, 31, 40, generator=torch.Generator().manual_seed(0)) < 0.02
    points[0] = False
    dilated = dilate_points(points, eps)
    assert not bool(dilated[0].any())
    for plane, expected in zip(dilated[1:], points[1:], strict=True):
        assert (plane.numpy() == (distance_transform_edt(~expected.numpy()) <= eps)).all()


def test_repeatability_counts_like_a_loop():
    generator = torch.Generator().manual_seed(1)
    query = torch.rand(2, 12, 12, generator=generator) < 0.2
    views = torch.rand(3, 12, 12, generator=generator) < 0.1
    got = repeatability(query, dilate_points(views, 1.5))
    for b in range(2):
        for n in range(3):
            near = [
                bool(((views[n].nonzero() - p).float().norm(dim=1) <= 1.5).any()) if views[n].any() else False
                for p in query[b].nonzero()
            ]
            assert float(got[b, n]) == pytest.approx(sum(near) / len(near))


def test_repeatability_scores():
    rep = torch.tensor([[0.2, 0.5, 0.8]])
    assert int(repeatability_score(rep).argmax()) == 2
    assert int(repeatability_score(rep, mode="paper").argmax()) == 1  # the paper's formula favours the average view
    assert float(repeatability_score(rep)[0, 1]) == pytest.approx(2.718281828 ** (-(0.3**2) / 0.02), rel=1e-4)
    with pytest.raises(InvalidInputError, match="mode"):
        repeatability_score(rep, mode="other")


@pytest.mark.parametrize(("colour", "channels"), [(True, 3), (False, 1)])
def test_colours_go_to_the_fields_that_want_them(colour, channels):
    seen = []

    class Field(torch.nn.Module):
        def forward(self, image):
            seen.append(image.shape[1])
            return torch.cat([image[:, :1], image[:, :1]], dim=1)

    field = Field()
    field.colour = colour
    ViewMatcher(truck_bank(), field=field)(*batch(0))
    assert set(seen) == {channels}


def test_terms_are_weighted():
    images, boxes = batch(0, 1)
    bank = truck_bank()
    without = bank.pipeline.with_term("repeatability", weight=0).with_term("box", weight=0)
    plain = ViewMatcher(bank, pipeline=without)(images, boxes)
    torch.testing.assert_close(plain.scores, unit_score(plain.hog))
    assert float(plain.box.min()) < 1, "computed and reported, and not counted"
    twice = ViewMatcher(bank, pipeline=without.with_term("hog", weight=2))(images, boxes)
    torch.testing.assert_close(twice.scores, plain.scores**2)
    wide = bank.pipeline.with_term("repeatability", sigma=1e6).with_term("box", sigma=1e6)
    torch.testing.assert_close(ViewMatcher(bank, pipeline=wide)(images, boxes).scores, plain.scores, atol=1e-5, rtol=0)


def test_a_term_that_is_not_in_the_pipeline_is_not_computed():
    bank = truck_bank()
    ranking = ViewMatcher(bank, pipeline=replace(bank.pipeline, terms=(Correlation(),)))(*batch(0))
    assert set(ranking.terms) == {"hog"}
