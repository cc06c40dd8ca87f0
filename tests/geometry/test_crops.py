import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch.testing import assert_close

from curvireg_torch import geometry as g
from curvireg_torch.geometry.crops import check_boxes, crop_squares, image_transforms
from curvireg_torch.utils.checks import check_camera_matrix
from tests._support import double, eye, refused
from tests._support.tables import text_table


def ramp(height, width):
    """(1, 2, H, W): each pixel's x and y."""
    y, x = torch.meshgrid(torch.arange(float(height)), torch.arange(float(width)), indexing="ij")
    return torch.stack([x, y])[None]


def test_image_transforms_invert_crop_transforms_with_exact_zeros():
    # A camera matrix with 1e-16 in place of 0, which some versions of LAPACK leave, is refused.
    squares = double([[10.0, 30.0, 26.3, 46.3], [-3.7, 2.1, 0.4, 6.2]])
    back = image_transforms(squares, 32)
    assert_close(back @ g.crop_transforms(squares, 32), eye(3).expand(2, 3, 3))
    check_camera_matrix(back)


@pytest.mark.parametrize(
    ("side", "size", "off"), [(8.0, 8, 2e-4), (8.0, 16, 2e-4), (24.0, 8, 2e-4), (20.5, 12, 0.1)]
)
def test_crop_images_agrees_with_its_transforms_on_a_ramp(side, size, off):
    # Bilinear weights preserve a ramp exactly, also if widened by an integer factor, else nearly.
    image = ramp(60, 80)
    box = torch.tensor([[30.2, 18.3, 30.2 + side, 18.3 + 0.5 * side]])
    crops, A = g.crop_images(image, box, size=size, margin=0.0)
    source = F.pad(ramp(size, size)[0].flatten(1), (0, 0, 0, 1), value=1.0).double()
    expected = (torch.linalg.inv(A[0].double()) @ source)[:2].view(2, size, size)
    assert_close(crops[0].double(), expected, rtol=0, atol=off)


@pytest.mark.parametrize("side", [3.0, 9.5, 40.0, 200.0])
def test_crop_squares_are_triangle_filtered(side):
    image = torch.rand(2, 70, 90, dtype=torch.float64)
    size = 11
    corners = double([[40.3, 31.2], [30.1, -1.7], [88.0, 60.0]])
    squares = torch.cat([corners, corners + torch.tensor([[side], [1.1 * side], [side]])], dim=1)
    crops = crop_squares(image, squares, size)

    def weights(low, high, length):
        scale = (high - low) / size
        centres = (low + (torch.arange(size) + 0.5).double() * scale).clamp(0, length - 1)
        w = (1.0 - (torch.arange(length) - centres[:, None]).abs() / max(scale, 1.0)).clamp(min=0.0)
        return w / w.sum(dim=1, keepdim=True)

    for crop, (x0, y0, x1, y1) in zip(crops, squares.tolist(), strict=True):
        assert_close(crop, weights(y0, y1, 70) @ image @ weights(x0, x1, 90).mT)


BOXES = r"""
[NaN, 0, 5, 5]   | finite
[0, 0, 1e9, 5]   | beyond 1e\+06 px; give pixel coordinates of the 30 x 20
[5, 0, 5, 5]     | X0 < X1
[-9, 0, -0.5, 5] | entirely outside the 30 x 20 image
[29.5, 0, 40, 5] | entirely outside
"""


@pytest.mark.parametrize(("box", "words"), text_table(BOXES))
def test_check_boxes_refuses_boxes_without_pixels(box, words):
    with refused(rf"box 1 .*{words}"):
        check_boxes(torch.tensor([[0.0, 0.0, 5.0, 5.0], box]), [(20, 30), (20, 30)])


def test_crop_images_takes_sizes_of_numpy():
    crops, _ = g.crop_images(ramp(8, 8), [[1, 1, 5, 5]], size=np.int64(6))
    assert crops.shape == (1, 2, 6, 6)


def test_crop_images_resamples_in_full_precision_under_autocast():
    image = torch.rand(1, 3, 60, 80)
    expected, _ = g.crop_images(image, [[30, 20, 60, 50]], size=32)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        crops, _ = g.crop_images(image, [[30, 20, 60, 50]], size=32)
    assert torch.equal(crops, expected)


def test_crop_images_refuses_a_list_of_grey_and_colour():
    images = [torch.rand(3, 20, 30), torch.rand(1, 20, 30)]
    with refused(r"images: expected shape \(3, \*, \*\), got \(1,"):
        g.crop_images(images, [[0, 0, 5, 5], [0, 0, 5, 5]])


def test_crop_images_spreads_missing_pixels_no_further_than_its_filter():
    image = torch.rand(1, 3, 60, 80)
    boxes = torch.tensor([[30.0, 20.0, 60.0, 50.0]])
    clean, _ = g.crop_images(image, boxes, size=32)
    outside = image.clone()
    inside = image.clone()
    outside[0, :, 2, 3], outside[0, 1, 59, 79] = math.nan, math.inf
    assert torch.equal(g.crop_images(outside, boxes, size=32)[0], clean)
    inside[0, 1, 35, 45] = math.nan
    crop, A = g.crop_images(inside, boxes, size=32)
    lost = crop.isnan()
    at = A[0] @ torch.tensor([45.0, 35.0, 1.0])
    rows, columns = lost[0, 1].nonzero().unbind(1)
    assert 1 <= int(lost.sum()) == int(lost[0, 1].sum()) <= 9
    assert (columns - at[0]).abs().max() < 2.0
    assert (rows - at[1]).abs().max() < 2.0
    assert_close(crop[~lost], clean[~lost], rtol=0, atol=0)
    crops, _ = g.crop_images(torch.cat([inside, image]), boxes.expand(2, 4), size=32)
    assert_close(crops[1], clean[0])
