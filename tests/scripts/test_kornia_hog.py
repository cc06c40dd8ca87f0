"""The HOG that kornia lacks: the tests of kornia's BaseTester, and scikit-image as a reference."""

import numpy as np
import pytest
import torch
from skimage.feature import hog
from torch.autograd import gradcheck

from scripts.kornia.hog import HistogramOfOrientedGradients, histogram_of_oriented_gradients
from tests._support import uniform

CELL = (6, 5)
BLOCK = (2, 3)


def images(kind):
    """(2, 3, 45, 38) float64; 45 and 38 are no multiples of the cell."""
    noise = uniform(2, 3, 45, 38)
    y, x = torch.meshgrid(torch.arange(45.0), torch.arange(38.0), indexing="ij")
    pictures = {
        "random": noise,
        "constant": torch.tensor(0.4),
        "checkerboard": (x // 3 + y // 3) % 2,
        "ramp": x + 2.0 * y,
    }
    return pictures[kind].to(noise).expand_as(noise).contiguous()


class TestHistogramOfOrientedGradients:
    @pytest.mark.parametrize(("batch", "height", "width"), [(1, 24, 24), (3, 40, 33)])
    def test_cardinality(self, batch, height, width):
        out = histogram_of_oriented_gradients(torch.rand(batch, 1, height, width))
        assert out.shape == (batch, height // 8 - 2, width // 8 - 2, 3, 3, 9)
        assert histogram_of_oriented_gradients(torch.rand(0, 1, height, width)).shape[0] == 0

    def test_exception(self):
        image = torch.rand(1, 1, 32, 32)
        for wrong, options, error in (
            (image.numpy(), {}, TypeError),
            (image[0], {}, ValueError),
            (image.byte(), {}, TypeError),
            (image[..., :20], {}, ValueError),
            (image[..., :20, :], {}, ValueError),
            (image, {"num_orientations": 0}, ValueError),
        ):
            with pytest.raises(error):
                histogram_of_oriented_gradients(wrong, **options)

    @pytest.mark.parametrize("kind", ["random", "constant", "checkerboard", "ramp"])
    @pytest.mark.parametrize("channels", [1, 3])
    def test_scikit_image(self, kind, channels):
        image = images(kind)[:, :channels]
        out = histogram_of_oriented_gradients(image, 8, CELL, BLOCK)
        for mine, picture in zip(out, image, strict=True):
            options = {
                "orientations": 8,
                "pixels_per_cell": CELL,
                "cells_per_block": BLOCK,
                "feature_vector": False,
            }
            theirs = hog(
                np.moveaxis(picture.numpy(), 0, -1), channel_axis=-1, block_norm="L2-Hys", **options
            )
            # scikit-image counts in float32
            np.testing.assert_allclose(mine.numpy(), theirs, atol=1e-6)

    @pytest.mark.parametrize("kind", ["constant", "checkerboard"])
    def test_gradients_are_finite(self, kind):
        image = images(kind).requires_grad_()
        histogram_of_oriented_gradients(image).square().sum().backward()
        assert image.grad.isfinite().all()

    def test_gradcheck(self):
        image = images("random")[:1, :, :12, :12].contiguous().requires_grad_()
        assert gradcheck(
            lambda x: histogram_of_oriented_gradients(x, 9, (4, 4), (2, 2)), image, fast_mode=True
        )

    def test_module(self):
        image = images("random")
        module = HistogramOfOrientedGradients(6, CELL, BLOCK, 0.3, 1e-4)
        assert torch.equal(
            module(image), histogram_of_oriented_gradients(image, 6, CELL, BLOCK, 0.3, 1e-4)
        )
        assert "num_orientations=6" in repr(module)

    def test_dynamo(self):
        image = images("random")
        graph = torch.compile(histogram_of_oriented_gradients, fullgraph=True, backend="eager")
        torch.testing.assert_close(graph(image), histogram_of_oriented_gradients(image))
