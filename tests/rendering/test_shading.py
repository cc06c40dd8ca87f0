import math

import pytest
import torch
from torch.testing import assert_close

from curvireg_torch.geometry import camera_matrix
from curvireg_torch.rendering.shading import AMBIENT, LIT, shade
from tests._support import double

from .conftest import pixel_grid

K = camera_matrix(80.0, 90.0, 20.0, 40.0)
RAYS = (pixel_grid((64, 64)) @ torch.linalg.inv(K).T).permute(2, 0, 1)


@pytest.mark.parametrize("normal", [[0.3, -0.2, 1.0], [-0.4, 0.5, 1.0], [0.0, 0.0, 1.0]])
def test_shade_is_exact_for_planes(normal):
    n = double(normal)
    along = torch.einsum("i,ihw->hw", n, RAYS)
    cosine = along / n.norm() / RAYS.norm(dim=0)
    grey = shade((5.0 / along)[None, None], K)[0, 0]
    assert_close(grey, AMBIENT + (LIT - AMBIENT) * cosine, atol=2e-4, rtol=0)
    depth = (7.0 + 0.3 * RAYS[0] - 0.6 * RAYS[1])[None, None]
    expected = AMBIENT + (LIT - AMBIENT) / math.sqrt(1 + 0.3**2 + 0.6**2)
    assert_close(
        shade(depth, K, orthographic=True), torch.full_like(depth, expected), atol=2e-4, rtol=0
    )


def test_shade_is_sharp_at_contours_and_steps():
    depth = torch.zeros(1, 1, 12, 24)
    depth[..., 3:9, 2:8] = 4.0
    depth[..., 3:9, 8:14] = 9.0  # a step
    depth[..., 1, 20] = 3.0  # a single pixel
    grey = shade(depth, camera_matrix(1000.0, 1000.0, 11.5, 5.5))
    assert (grey[depth > 0] > LIT - 1e-3).all()
    assert (grey[depth == 0] == 1.0).all()
