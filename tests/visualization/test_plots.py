import numpy as np
import pytest

from curvireg_torch import Registrar, ViewBank, sample_views
from curvireg_torch.synthetic import example_mesh
from curvireg_torch.visualization.plots import viewpoints
from tests._support import CAMERA, scene, unrefined


def test_viewpoints_draws_the_best_score_of_each_direction_last_and_the_hypotheses():
    views = sample_views(azimuth_step=90, elevations=[0, 30], thetas=[0, 90], distances=[4, 5])
    bank = ViewBank.build(example_mesh(), views, image_size=64, progress=False)
    image, box, _ = scene(0)
    result = Registrar(bank, pipeline=unrefined(bank, hypotheses=3))([image], box[None], CAMERA)[0]
    axes = viewpoints(bank, result).axes[0]
    (drawn,) = axes.collections
    shown = {
        tuple(at): score
        for at, score in zip(drawn.get_offsets().tolist(), drawn.get_array(), strict=True)
    }
    assert len(shown) == 8
    for (azimuth, elevation), score in shown.items():
        same = (bank.views.azimuth == azimuth) & (bank.views.elevation == elevation)
        assert score == pytest.approx(float(result.ranking.scores[0][same].max()))
    marks = [(line.get_xdata()[0], line.get_ydata()[0]) for line in axes.lines]
    np.testing.assert_allclose(
        marks, [(h.viewpoint[0] % 360, h.viewpoint[1]) for h in result.hypotheses]
    )
    assert [text.get_text() for text in axes.texts] == ["1", "2", "3"]
