"""Pictures as figures."""

import numpy as np

from curvireg_torch.visualization import plots


def test_picture_shows_every_pixel():
    pixels = np.random.default_rng(0).integers(0, 255, (60, 90, 3), dtype=np.uint8)
    figure = plots.picture(pixels)
    assert figure.get_size_inches().tolist() == [0.6, 0.4]
    np.testing.assert_array_equal(np.asarray(figure.axes[0].images[0].get_array()), pixels)
