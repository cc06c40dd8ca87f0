import numpy as np
import pytest

from curvireg_torch.mesh.colours import SurfaceColours, colours_at

TEXTURE = np.arange(60, dtype=np.uint8).reshape(4, 5, 3) * 4


def at(uv, corners=(255, 255, 255)):
    """The colour (0 to 255) of a face whose points all have the texture coordinates ``uv``."""
    colours = SurfaceColours.plain(1, corners).with_texture([0], TEXTURE, [uv] * 3)
    third = np.full(1, 1.0 / 3.0, np.float32)
    return (255.0 * colours_at(colours, np.zeros(1, np.int32), third, third)[0]).tolist()


@pytest.mark.parametrize(("row", "column"), [(0, 0), (3, 4), (1, 2)])
def test_at_returns_the_colour_of_a_texel_at_its_centre(row, column):
    """(0, 0) is the bottom left corner of the texture, rows run down from its top."""
    uv = ((column + 0.5) / 5.0, 1.0 - (row + 0.5) / 4.0)
    expected = TEXTURE[row, column].astype(float)
    assert at(uv) == pytest.approx(expected, abs=1e-3)
    assert at((uv[0] + 2.0, uv[1] - 1.0)) == pytest.approx(expected, abs=1e-3), "it repeats"
    assert at(uv, (127, 127, 127)) == pytest.approx(0.5 * expected, rel=0.01, abs=1e-3)


def test_at_interpolates_between_texels_and_across_the_seam():
    below = 0.75 * TEXTURE[1, 2] + 0.25 * TEXTURE[2, 2]
    assert at((2.5 / 5.0, 1.0 - 1.75 / 4.0)) == pytest.approx(below.tolist(), abs=1e-3)
    seam = 0.5 * TEXTURE[1, 4].astype(float) + 0.5 * TEXTURE[1, 0]
    assert at((1.0, 1.0 - 1.5 / 4.0)) == pytest.approx(seam.tolist(), abs=1e-3)
