"""Detectors against their definitions, and against OpenCV, kornia and scikit-image."""

import math

import cv2
import numpy as np
import pytest
import torch
from kornia.feature import gftt_response, harris_response
from skimage.feature import canny as skimage_canny
from skimage.feature import corner_harris, corner_shi_tomasi

from curvireg_torch import detectors
from curvireg_torch.detectors.fast_hessian import _determinant
from curvireg_torch.filters import gaussian_smooth

from ..filters.layer_cases import photos
from .test_contracts import fraction_near


def neighbourhood_maximum(stack: torch.Tensor) -> torch.Tensor:
    """(H, W) maximum of (N, H, W) over all N and 3 x 3 px."""
    H, W = stack.shape[-2:]
    padded = torch.nn.functional.pad(stack, (1, 1, 1, 1), value=-torch.inf)
    return torch.stack([padded[:, y : y + H, x : x + W] for y in range(3) for x in range(3)]).flatten(0, 1).amax(0)


def sobel_by_opencv(image: np.ndarray) -> list[np.ndarray]:
    border = cv2.BORDER_REPLICATE
    return [cv2.Sobel(image, cv2.CV_32F, *order, ksize=3, borderType=border) for order in ((1, 0), (0, 1))]


def test_corner_detectors_are_the_peaks_of_kornias_responses() -> None:
    image = photos(1, 40, seed=4)
    for ours, theirs in (
        (detectors.harris(image, k=0.06, fraction=1.0), harris_response(image, k=0.06)),
        (detectors.minimum_eigenvalue(image, fraction=1.0), gftt_response(image)),
    ):
        torch.testing.assert_close(ours.response, theirs.clamp(min=0.0))
        r = ours.response[0, 0]
        assert torch.equal(ours.points[0, 0], (r == neighbourhood_maximum(r[None])) & (r > 0))


def test_corner_responses_against_scikit_image() -> None:
    image = photos(1, 64, seed=6)
    grey = image[0, 0].numpy()
    for ours, theirs in (
        (detectors.harris(image), corner_harris(grey, k=0.04, sigma=1.0)),
        (detectors.minimum_eigenvalue(image), corner_shi_tomasi(grey, sigma=1.0)),
    ):
        # Both have a Gaussian window of 1 px, cut at 3 px here and at 4 px there; the units differ.
        a, b = ours.response[0, 0, 6:-6, 6:-6].flatten().numpy(), np.maximum(theirs[6:-6, 6:-6], 0).ravel()
        assert np.corrcoef(a, b)[0, 1] > 0.99


def test_sobel_against_opencv() -> None:
    image = photos(1, 32)
    dx, dy = sobel_by_opencv(image[0, 0].numpy())
    np.testing.assert_allclose(detectors.sobel(image).response[0, 0], np.hypot(dx, dy) / 8, atol=1e-6)


def test_canny_against_opencv_with_explicit_thresholds() -> None:
    image = photos(1, 64, seed=5)
    detection = detectors.canny(image, sigma=1.8, edges=0.2, fraction=1.0)
    grey = (image[0, 0] * 255).round().numpy().astype(np.float32)
    dx, dy = sobel_by_opencv(cv2.GaussianBlur(grey, (0, 0), 1.8, borderType=cv2.BORDER_REPLICATE))
    length = np.hypot(dx, dy)
    np.testing.assert_allclose(detection.response[0, 0], length / 8 / 255, atol=1e-6)
    high = np.quantile(length, 0.8)
    edges = cv2.Canny(
        *((d * 32).round().astype(np.int16) for d in (dx, dy)), 0.4 * high * 32, high * 32, L2gradient=True
    )
    assert np.array_equal(detection.points[0, 0].numpy(), edges > 0)
    # Hysteresis: all edges exceed the lower threshold, some not the upper one.
    assert length[edges > 0].min() >= 0.39 * high
    assert length[edges > 0].min() < 0.9 * high


def test_canny_against_scikit_image() -> None:
    image = gaussian_smooth(photos(1, 64, seed=5), 2.0)
    ours = detectors.canny(image, fraction=1.0).points[0, 0].numpy()
    theirs = skimage_canny(image[0, 0].numpy(), sigma=1.4, low_threshold=0.5, high_threshold=0.7, use_quantiles=True)
    assert fraction_near(ours, theirs, 1) > 0.85
    assert fraction_near(theirs, ours, 1) > 0.8


def test_canny_of_more_than_16_million_pixels() -> None:
    image = torch.zeros(1, 1, 4001, 4000)
    image[..., 2000:] = 1.0
    points = detectors.canny(image, edges=0.002, fraction=1e-3).points[0, 0]
    assert points[:, 1990:2010].sum() >= 4001
    assert not points[:, :1990].any()
    assert not points[:, 2010:].any()


@pytest.mark.parametrize("fraction", [0.002, 0.04])
def test_sift_keeps_the_strongest_keypoint_of_each_pixel(fraction: float) -> None:
    image = photos(1, 96, seed=7)
    grey = (image[0, 0] * 255).round().byte().numpy()
    detection = detectors.sift(image, fraction=fraction)
    contrast: dict[tuple[int, int], float] = {}
    for k in cv2.SIFT.create(nfeatures=int(fraction * 96 * 96)).detect(grey, None):
        pixel = (round(k.pt[0]), round(k.pt[1]))
        contrast[pixel] = max(contrast.get(pixel, 0.0), k.response)
    found = {(x, y): float(detection.response[0, 0, y, x]) for x, y in detection.coordinates()[0].tolist()}
    assert found == pytest.approx(contrast)
    assert torch.equal(detection.points, detection.response > 0)


@pytest.mark.parametrize("contrast", [1.0, -0.5])
@pytest.mark.parametrize("transposed", [False, True])
def test_laplacian_of_gaussian_finds_a_step_through_a_pixel_centre(contrast: float, transposed: bool) -> None:
    """0, ..., 0, 1/2, 1, ..., 1: the Laplacian is 0 on the edge and has opposite signs beside it."""
    image = torch.zeros(1, 1, 24, 31)
    image[..., 15] = 0.5
    image[..., 16:] = 1.0
    image = contrast * (image.mT if transposed else image)

    def response_of(sigma: float) -> torch.Tensor:
        response = detectors.laplacian_of_gaussian(image, sigma=sigma, fraction=1.0).response
        return (response.mT if transposed else response)[0, 0]

    # With almost no smoothing the Laplacian is exact: contrast / 2, 0, -contrast / 2, one crossing.
    assert response_of(0.05).tolist() == [[0.5 * abs(contrast) * (i == 15) for i in range(31)]] * 24
    response = response_of(2.0)
    strong = response > 0.1 * response.max()
    assert float(response.max()) > 1e-3
    # Where rounding makes the 0 positive or negative, the crossing is on one side of the edge.
    assert strong.any(dim=0).nonzero().flatten().tolist() in ([14], [15], [14, 15])
    assert bool(strong.any(dim=1).all())


@pytest.mark.parametrize(("sigma", "tolerance"), [(1.0, 0.15), (2.0, 0.06), (3.0, 0.06), (3.5, 0.05)])
@pytest.mark.parametrize("transposed", [False, True])
def test_laplacian_of_gaussian_of_a_step_has_the_closed_form(sigma: float, tolerance: float, transposed: bool) -> None:
    """Beside a step of height A smoothed by s, L(x) = -A x exp(-x^2 / 2 s^2) / (sqrt(2 pi) s^3), sampled at +-1/2."""
    image = (0.8 * (torch.arange(64) >= 30).double()).expand(1, 1, 40, 64)
    image = image.mT if transposed else image
    response = detectors.laplacian_of_gaussian(image, sigma=sigma, fraction=1.0).response[0, 0]
    line = response[:, 20] if transposed else response[20]
    expected = 0.8 * math.exp(-0.125 / sigma**2) / (math.sqrt(2 * math.pi) * sigma**3)
    assert int(line.argmax()) == 29  # the left or upper one of the two pixels
    assert float(line.max()) == pytest.approx(expected, rel=tolerance)


def test_fuzzy_edges_rules() -> None:
    """The response is 1 - min(mu(Ix), mu(Iy)) of the derivatives divided by the largest one."""
    image = torch.zeros(1, 1, 9, 40)
    image[..., 10:] += 1.0
    image[..., 30:] -= 0.05
    response = detectors.fuzzy_edges(image).response[0, 0, 4]
    assert float(response[9:11].max()) == pytest.approx(1.0, abs=1e-6)
    assert float(response[29:31].max()) == pytest.approx(1 - math.exp(-0.5 * (0.05 / 0.1) ** 2), rel=1e-3)


def _box_filters(side: int) -> np.ndarray:
    """(3, side, side): xx, yy, xy of Bay et al., fig. 2."""
    lobe, r = side // 3, side // 2
    filters = np.zeros((3, side, side))
    for k, weight in enumerate((1, -2, 1)):
        filters[0, lobe // 2 + 1 : side - lobe // 2 - 1, k * lobe : (k + 1) * lobe] = weight
    filters[1] = filters[0].T
    before, after = slice(r - lobe, r), slice(r + 1, r + 1 + lobe)
    for rows, columns, weight in ((before, before, 1), (after, after, 1), (before, after, -1), (after, before, -1)):
        filters[2, rows, columns] = weight
    return filters


def _slow_determinants(x: np.ndarray, side: int) -> np.ndarray:
    xx, yy, xy = (cv2.filter2D(x, cv2.CV_64F, f, borderType=cv2.BORDER_REPLICATE) / side**2 for f in _box_filters(side))
    return xx * yy - 0.81 * xy**2


@pytest.mark.parametrize("side", [9, 15, 21, 27])
def test_fast_hessian_determinants_against_opencv(side: int) -> None:
    x = photos(1, 32, seed=8, dtype=torch.float64)
    np.testing.assert_allclose(_determinant(x, side)[0, 0], _slow_determinants(x[0, 0].numpy(), side), atol=1e-12)


def test_fast_hessian_response_is_the_maximum_over_all_sides_that_fit() -> None:
    axis = torch.arange(54.0, dtype=torch.float64) - 27
    saddle = 0.5 + 0.001 * axis[:, None] * axis + 0.001 * (axis[:, None] ** 2 + axis**2)  # D_xx, D_yy and D_xy != 0
    for image in (photos(1, 54, seed=8, dtype=torch.float64), saddle[None, None] / 4.0):
        response = detectors.fast_hessian(image).response[0, 0]
        want = np.max([_slow_determinants(image[0, 0].numpy(), side) for side in (9, 15, 21, 27, 39, 51)], axis=0)
        np.testing.assert_allclose(response, np.maximum(want, 0.0), rtol=1e-4, atol=1e-9)
        assert float(response[27, 27]) > 0.0


def test_fast_hessian_points_are_maxima_over_pixels_and_sides() -> None:
    octaves = ((9, 15, 21, 27), (15, 27, 39, 51), (27, 51, 75, 99))
    image = photos(1, 104, seed=8, dtype=torch.float64)
    det = {s: _determinant(image, s)[0, 0] for s in {s for o in octaves for s in o}}
    expected = torch.zeros(104, 104, dtype=torch.bool)
    for octave in octaves:
        stack = torch.stack([det[s] for s in octave])
        for level in range(1, 3):
            peaks = stack[level] == neighbourhood_maximum(stack[level - 1 : level + 2])
            expected |= peaks & (stack[level] > 5e-5)
    detection = detectors.fast_hessian(image, threshold=5e-5, fraction=1.0)
    assert int(expected.sum()) > 3
    assert torch.equal(detection.points[0, 0], expected)
    tiny = detectors.fast_hessian(image[..., :5, :7])  # smaller than the smallest filter
    assert tiny.response.shape == (1, 1, 5, 7)
    assert not tiny.points.any()


def _blob(size: int, sigma: float) -> torch.Tensor:
    axis = torch.arange(float(size)) - size // 2
    return torch.exp(-0.5 * (axis[:, None] ** 2 + axis**2) / sigma**2)[None, None]


def test_fast_hessian_threshold() -> None:
    blob = _blob(65, 3.0)
    strongest = float(detectors.fast_hessian(blob).response.max())
    for contrast, found in ((0.95, False), (1.05, True)):  # the determinant is quadratic in contrast
        faint = contrast * math.sqrt(1e-4 / strongest) * blob
        assert bool(detectors.fast_hessian(faint).points.any()) is found
    assert not detectors.fast_hessian(blob, threshold=1.01 * strongest).points.any()
    assert detectors.fast_hessian(blob, threshold=0.99 * strongest).points.sum() == 1


@pytest.mark.parametrize("sigma", [1.2 * side / 9 for side in (21, 27, 51, 75)] + [2.5])
def test_fast_hessian_finds_blobs_of_all_octaves(sigma: float) -> None:
    """A side of 9 corresponds to a Gaussian of 1.2 px."""
    assert detectors.fast_hessian(_blob(161, sigma), threshold=1e-3).coordinates()[0][0].tolist() == [80, 80]
