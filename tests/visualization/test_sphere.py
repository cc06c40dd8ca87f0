import numpy as np
import pytest
import torch

from curvireg_torch import Ranking, Registrar, ViewBank, sample_views, uniform_views
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.synthetic import example_mesh
from curvireg_torch.visualization.plots import direction_scores, sphere_map, viewpoints
from tests._support.scenes import CAMERA, scene, unrefined


@pytest.fixture(scope="module")
def bank():
    views = sample_views(azimuth_step=90, elevations=[0, 30], thetas=[0, 90], distances=[4, 5])
    return ViewBank.build(example_mesh(), views, image_size=64, progress=False)


def ranked(scores):
    return Ranking(scores, scores.argsort(dim=1, descending=True), {"hog": scores})


def test_direction_scores_take_the_best_in_plane_rotation_and_distance(bank):
    scores = torch.rand(2, len(bank), generator=torch.Generator().manual_seed(0))
    azimuth, elevation, best = direction_scores(bank, ranked(scores), image_index=1)
    assert len(best) == 8
    for a, e, s in zip(azimuth.tolist(), elevation.tolist(), best.tolist(), strict=True):
        views = (bank.views.azimuth == a) & (bank.views.elevation == e)
        assert int(views.sum()) == 4
        assert s == float(scores[1][views].max())
    with pytest.raises(InvalidInputError, match="image 2"):
        direction_scores(bank, ranked(scores), image_index=2)


def test_sphere_map_shows_the_nearest_direction():
    views = uniform_views(200)
    score = torch.arange(200.0)
    picture = sphere_map(views.azimuth, views.elevation, score, size=(18, 36))
    assert picture.shape == (18, 36)
    assert not np.isnan(picture).any()
    for row, column in ((0, 3), (9, 30), (17, 17)):
        e, a = np.radians(90 - (row + 0.5) * 10), np.radians((column + 0.5) * 10)
        az, el = np.radians(views.azimuth.numpy()), np.radians(views.elevation.numpy())
        cosine = np.sin(el) * np.sin(e) + np.cos(el) * np.cos(e) * np.cos(az - a)
        assert picture[row, column] == cosine.argmax()
    # NaN far from all directions.
    upright = sample_views(azimuth_step=10, elevations=[0, 10, 20])
    picture = sphere_map(upright.azimuth, upright.elevation, torch.ones(len(upright)), size=(18, 36))
    assert np.isnan(picture[[*range(5), *range(11, 18)]]).all()
    assert not np.isnan(picture[7:9]).any()


def test_viewpoints_draws_the_map_and_the_hypotheses(bank):
    image, box, _ = scene(0)
    registrar = Registrar(bank, pipeline=unrefined(bank, hypotheses=3))
    result = registrar([image], box[None], CAMERA)[0]
    figure = viewpoints(bank, result)
    axes = figure.axes[0]
    expected = sphere_map(*direction_scores(bank, result.ranking))
    np.testing.assert_array_equal(np.asarray(axes.images[0].get_array().filled(np.nan)), expected)
    assert axes.images[0].get_extent() == [0, 360, -90, 90]
    drawn = [(line.get_xdata()[0], line.get_ydata()[0]) for line in axes.lines]
    assert drawn == [(h.viewpoint[0] % 360, h.viewpoint[1]) for h in result.hypotheses]
    assert [text.get_text() for text in axes.texts] == ["1", "2", "3"]
    assert not any(line.get_clip_on() for line in axes.lines)  # complete at the border
    assert not viewpoints(bank, result.ranking).axes[0].lines
